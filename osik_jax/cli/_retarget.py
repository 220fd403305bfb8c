"""``osik retarget``."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from .._errors import OsikValueError
from ._inputs import read_robot
from ._messages import told

if TYPE_CHECKING:
    from ..retargeting import Retargeter

_COLUMNS = {
    "slip\n[mm]": "slip_mm_max",
    "float\n[mm]": "float_mm_max",
    "below\n[mm]": "below_floor_mm_max",
    "overlap\n[mm]": "penetration_mm_max",
    "accel.\n[rad/s²]": "acceleration_max",
    "off\n[deg]": "segment_angle_deg_mean",
}
_MOST_ROWS, _MOST_NOTES = 50, 10


@dataclasses.dataclass(frozen=True)
class Retarget:
    """Retargets a person's motion to a robot: reads a motion file or a folder of them, and writes a folder.

    Writes motion.npz (MuJoCo's order, with the person's joints), motion.csv (position, quaternion x y z w, joints; no
    headings), report.json (figures recomputed by MuJoCo) and profile.toml (the robot's profile).
    For a folder, each clip gets its own folder in --out, and report.json has the figures of all clips. The same
    command resumes an interrupted job.
    """

    clip: Annotated[str, tyro.conf.Positional]
    """A BVH file, keypoints as .npz, or a folder of such files."""
    robot: str = "nao"
    """A URDF or MJCF file, or a robot by name: nao, g1, talos, or one of robot_descriptions."""
    base: Literal["floating", "fixed"] = "floating"
    """Base of a robot that comes as a file: "floating" moves, "fixed" stands still and only the limbs follow."""
    out: Path = Path("osik-retarget")
    """Folder to write to."""
    profile: str | None = None
    """Profile of the robot (TOML). Default: a bundled one for NAO, G1 and Talos, else a guess."""
    mapping: tuple[str, ...] = ()
    """Joints of the clip as ROLE=NAME pairs, for all needed roles. Default: inferred from the names."""
    fps: float | None = None
    """Frames a second of the result. Default: the clip's."""
    acceleration: float = 240.0
    """Greatest acceleration of the joints [rad/s^2]."""
    smooth: float = 0.0
    """Smooth out motion that is faster than about this time [s]; 0: none."""
    balance: float | None = None
    """Margin of the centre of mass inside the support polygon while both feet stand [m]. Default: not bounded."""
    unit: str | None = None
    """Unit of a BVH: m, cm, mm, inch, cmu, or metres a unit as a number. Default: found from the skeleton's size."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """The clip's axis that points up, as --up=y. Default: found from the motion; where that does not say, the axis of a
    BVH's rest pose, and z of keypoints."""

    def run(self) -> int:
        """Run the command; return the exit code."""
        if os.path.isdir(self.clip):
            return _retarget_folder(self)
        from ..retargeting import load_motion
        from ..retargeting._folder import write_folder
        from ..retargeting._report import notes, picked

        with told():
            motion = load_motion(self.clip, **_reading(self))
            retargeter, mapping = _retargeter(self), _mapping(self.mapping)
            print(f"{motion.name}: {motion.frames} frames at {motion.fps:g} a second")
            self.out.mkdir(parents=True, exist_ok=True)
            result = retargeter.retarget(motion, mapping=mapping, fps=self.fps)
            figures = write_folder(result, motion.name, self.out)
        _print_figures([(motion.name, {"frames": figures["frames"], **picked(figures)})])
        print(f"written to {self.out}: {', '.join(sorted(os.listdir(self.out)))}")
        for note in notes(figures, self.balance):
            print(f"note: {note}")
        return 0


def _reading(command: Retarget) -> dict[str, Any]:
    """Return the arguments of ``load_motion``."""
    unit: Any = command.unit
    with contextlib.suppress(TypeError, ValueError):  # no option, or a unit by name
        unit = float(unit)
    return {"unit": unit, "up": command.up}


def _retargeter(command: Retarget) -> Retargeter:
    """Return the retargeter of whole clips that the command describes; a robot of the package is as it is."""
    from .. import retargeting
    from ..robot.loading import ROBOTS

    base = "auto" if command.robot in ROBOTS and command.base == "floating" else command.base
    return retargeting.Retargeter(
        read_robot(command.robot, base),
        profile=None if command.profile is None else retargeting.load_profile(command.profile),
        acceleration=command.acceleration,
        smoothness=command.smooth,
        balance=command.balance,
    )


def _retarget_folder(command: Retarget) -> int:
    """Retarget all clips of a folder; return the exit code."""
    from ..retargeting._folder import retarget_folder
    from ..retargeting._skeletons import shortened

    with told():
        summary = retarget_folder(
            _retargeter(command),
            Path(command.clip),
            command.out,
            **_reading(command),
            mapping=_mapping(command.mapping),
            fps=command.fps,
        )
    failed: dict[str, str] = summary["failed"]
    noted = [f"{name}: {note}" for name, notes in summary["notes"].items() for note in notes]
    if summary["clips"]:
        rows = summary["figures"].items() if summary["clips"] <= _MOST_ROWS else ()
        _print_figures([*rows, ("worst", {"frames": summary["frames"], **summary["worst"]})])
    print(
        f"{summary['clips']} clips, {summary['frames']:,} frames, written to {command.out}; all figures are in "
        f"{command.out / 'report.json'}"
    )
    if summary["no_clips"]:
        print(f"no clips, and not read: {shortened(summary['no_clips'])}")
    for note in noted[:_MOST_NOTES]:
        print(f"note: {note}")
    if len(noted) > _MOST_NOTES:
        print(f"note: {len(noted) - _MOST_NOTES} more are in report.json")
    for name, reason in failed.items():
        print(f"osik: {name}: {reason}", file=sys.stderr)
    if failed:
        print(f"osik: {len(failed)} of {len(failed) + summary['clips']} clips failed", file=sys.stderr)
    return 1 if failed else 0


def _print_figures(rows: Sequence[tuple[str, dict[str, Any]]]) -> None:
    """Print a line of figures for each clip."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table()
    for title in ("clip", "frames", *_COLUMNS):
        table.add_column(escape(title), justify="left" if title == "clip" else "right")
    for name, row in rows:
        values = ["-" if row.get(key) is None else f"{row[key]:.2f}" for key in _COLUMNS.values()]
        table.add_row(escape(name), f"{row['frames']:,}", *values)
    Console().print(table)


def _mapping(pairs: Sequence[str]) -> dict[str, str] | None:
    """Return a mapping from texts ROLE=NAME; None without any."""
    wrong = [pair for pair in pairs if "=" not in pair]
    if wrong:
        raise OsikValueError(f"--mapping takes ROLE=NAME; got {', '.join(wrong)}")
    return {role: name for role, _, name in (pair.partition("=") for pair in pairs)} or None
