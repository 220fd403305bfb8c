"""What ``osik retarget`` does: from a clip to a folder, and from a folder of clips to a profile."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..robot import Robot
from ._film import film
from ._fit import Fit, fit
from ._load import Reader, clips_in
from ._motion import HumanMotion
from ._profile import Profile
from ._profile_file import save_profile
from ._report import report
from ._retarget import Retargeter
from ._retargeted import Retargeted
from ._robot_motion import write_csv
from ._source_motion import SourceMotion

_HELD_OUT = 4
"""One clip in so many has a say in which step of a fit is taken, and none in the steps."""


def retarget_to_folder(
    retargeter: Retargeter,
    motion: HumanMotion | SourceMotion,
    out: Path,
    *,
    mapping: dict[str, str] | None,
    fps: float | None,
    animation: bool,
) -> tuple[Retargeted, dict[str, Any]]:
    """Retargets a clip; writes motion (.npz and .csv), report, profile and, with ``animation``, a film to a folder.

    Returns:
        what came of it, and the report that was written.

    Raises:
        OSError: the folder cannot be written to.
        ValueError, KeyError: as of ``retarget``.
    """
    out.mkdir(parents=True, exist_ok=True)
    result = retargeter.retarget(motion, mapping=mapping, fps=fps)
    return result, write_folder(result, motion.name, out, animation=animation)


def fit_to_file(
    robot: Robot,
    folder: Path,
    file: Path,
    *,
    profile: Profile | None,
    mapping: Mapping[str, str] | None,
    acceleration: float,
    reader: Reader,
) -> tuple[Fit, int, int]:
    """Finds a profile by the clips of a folder (``fit``) and writes it.

    Every fourth clip, by name, is held out; of fewer than four none is.

    Returns:
        what came of it, and how many clips were learned from and held out.

    Raises:
        OSError: the file cannot be written.
        ImportError, ValueError, KeyError: as of ``fit`` and ``load_motion``; the latter's start with the clip's name.
    """
    motions = []
    for name, path in clips_in(folder).items():
        try:
            motions.append(reader(path))
        except (ValueError, KeyError) as error:
            raise type(error)(f"{name}: {error.args[0]}") from error
    held_out = motions[_HELD_OUT - 1 :: _HELD_OUT]
    learned = [motion for motion in motions if all(motion is not other for other in held_out)]
    found = fit(robot, learned, held_out=held_out, profile=profile, mapping=mapping, acceleration=acceleration)
    save_profile(found.profile, file)
    return found, len(learned), len(held_out)


def write_folder(result: Retargeted, name: str, out: Path, *, animation: bool) -> dict[str, Any]:
    """Writes what ``retarget_to_folder`` says, and returns the report."""
    figures = {"clip": name, **report(result)}
    write_motion(result, figures, out)
    save_profile(result.profile, out / "profile.toml")
    if animation:
        film(result, out / "motion.gif")
    return figures


def write_motion(result: Retargeted, figures: dict[str, Any], out: Path) -> None:
    """Writes ``motion.npz``, ``motion.csv`` and, when these are whole, ``report.json`` to a folder that is there."""
    result.save(out / "motion.npz")
    write_csv(result.motion, out / "motion.csv")
    write_json(figures, out / "report.json")


def write_json(figures: dict[str, Any], path: Path) -> None:
    """Writes a file of JSON, under its name only when complete."""
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    partial.replace(path)
