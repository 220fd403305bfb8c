"""``osik demo``."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Literal

from ._messages import CommandError, told, writing


@dataclasses.dataclass(frozen=True)
class Demo:
    """Moves NAO with each scheme, and writes a film, a figure and the motion to a folder.

    NAO sways over both feet (double-support), or lifts one (single-support).
    """

    motion: Literal["double-support", "single-support"] = "double-support"
    """Motion of the NAO."""
    duration: float = 8.0
    """Length of the motion [s]."""
    frequency: float = 200.0
    """Control steps a second [Hz]."""
    schemes: tuple[Literal["weighted", "null-space", "hierarchical"], ...] = ("weighted", "null-space", "hierarchical")
    """Schemes to run, one after the other; the film shows the last."""
    out: Path = Path("osik-demo")
    """Folder to write to."""
    animation: bool = True
    """Write the film (motion.gif; motion.mp4 too where the program ffmpeg is installed)."""

    def run(self) -> int:
        """Run the command; return the exit code."""
        from rich.console import Console
        from rich.markup import escape

        from ..demo._demo import run_demo
        from ..demo._nao import double_support, single_support

        console = Console()
        _check(self)
        make = single_support if self.motion == "single-support" else double_support
        motion, dt = make(self.duration), 1.0 / self.frequency
        with told():
            self.out.mkdir(parents=True, exist_ok=True)
        console.print(escape(motion.title))
        with writing(self.out), console.status("starting") as status:
            shown, _ = run_demo(
                motion, self.out, schemes=self.schemes, dt=dt, animation=self.animation, announce=status.update
            )
        console.print(shown)
        console.print(f"written to {self.out}: {', '.join(sorted(os.listdir(self.out)))}", markup=False)
        return 0


def _check(command: Demo) -> None:
    """Raise an error for values out of range."""
    if not command.frequency > 0.0:
        raise CommandError(f"--frequency is {command.frequency:g}; it has to be positive")
    if not command.duration * command.frequency >= 2.0:
        raise CommandError(f"--duration is {command.duration:g} s; it has to last two control steps at least")
    if not command.schemes:
        raise CommandError("--schemes is empty; name at least one of: weighted, null-space, hierarchical")
