"""``osik demo``."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ._messages import CommandError, progress, told, writing
from ._robots import read_robot

if TYPE_CHECKING:
    from ..demo._motion import Motion
    from ..robot import Robot


@dataclasses.dataclass(frozen=True)
class Demo:
    """Moves a robot with each scheme, and writes a film, a figure and the motion to a folder.

    NAO sways over both feet (double-support), or lifts one (single-support). With --robot, the base or the tip of your
    own robot goes 5 cm to its left and back.
    """

    motion: Literal["double-support", "single-support"] | None = None
    """Motion of the NAO; default: double-support. Other robots sway."""
    physics: bool = False
    """Run NAO in MuJoCo: feet on the floor with contact, position servos, what is sensed fed back every step."""
    robot: str | None = None
    """A URDF or MJCF file to move instead, or a robot by name: nao, ur5, g1 and others, or of robot_descriptions."""
    base: Literal["auto", "floating", "fixed"] = "auto"
    """Base of --robot. auto: as in the file; a URDF without a statement floats if it has feet (or --support)."""
    frame: str | None = None
    """Frame of --robot that moves. Default: the floating base, or the tip of a robot with a fixed base."""
    support: tuple[str, ...] = ()
    """Frames of --robot that stand on the ground. Default: frames named or shaped like feet."""
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
    picture: bool = False
    """Write picture.png as well: three instants side by side."""

    def run(self) -> int:
        """Run the command; return the exit code."""
        from rich.console import Console
        from rich.markup import escape

        from ..demo._demo import run_demo, writable_folder

        console = Console()
        motion, dt = demo_motion(self), 1.0 / self.frequency
        with told():
            out = writable_folder(self.out, motion, schemes=len(self.schemes), dt=dt)
        for note in motion.notes:
            console.print(f"[yellow]note:[/yellow] {escape(note)}")
        console.print(escape(motion.title))
        with writing(out), progress(console) as announce:
            shown, _ = run_demo(
                motion,
                out,
                schemes=self.schemes,
                dt=dt,
                physics=self.physics,
                animation=self.animation,
                picture=self.picture,
                announce=announce,
            )
        console.print(shown)
        console.print(f"written to {self.out}: {', '.join(sorted(os.listdir(self.out)))}", markup=False)
        return 0


def demo_motion(command: Demo) -> Motion:
    """Return the motion that the options ask for."""
    from ..demo._file import file_motion
    from ..demo._nao import double_support, single_support

    _check(command)
    if command.robot is not None:
        robot = read_demo_robot(command, command.robot)
        with told():
            return file_motion(
                robot,
                name=Path(command.robot).stem,
                frame=command.frame,
                support=command.support,
                duration=command.duration,
            )
    make = single_support if command.motion == "single-support" else double_support
    return make(command.duration)


def _check(command: Demo) -> None:
    """Raise an error for options that exclude each other, and for values out of range."""
    if command.robot is None and (command.frame is not None or command.support):
        raise CommandError("--frame and --support go with --robot FILE; NAO's motions choose their own")
    if command.robot is not None and command.motion is not None:
        raise CommandError(
            f"--motion {command.motion} is NAO's, and --robot moves another: its waist or its tip sways; "
            "--frame, --support and --duration say what, on what and how long"
        )
    if command.physics and command.robot is not None:
        raise CommandError("--physics goes with NAO's motions; for a robot of yours, see osik_jax.physics")
    if not command.frequency > 0.0:
        raise CommandError(f"--frequency is {command.frequency:g}; it has to be positive")
    if not command.duration * command.frequency >= 2.0:
        raise CommandError(f"--duration is {command.duration:g} s; it has to last two control steps at least")
    if not command.schemes:
        raise CommandError("--schemes is empty; name at least one of: weighted, null-space, hierarchical")


def read_demo_robot(command: Demo, source: str) -> Robot:
    """Return the robot to move; if a URDF does not say whether its base moves, it does if --support names feet."""
    from ..robot.loading import is_mjcf

    stands = command.base == "auto" and command.support and Path(source).is_file() and not is_mjcf(source)
    return read_robot(source, "floating" if stands else command.base)
