"""Files of ``osik retarget``, and the implementation of ``osik retarget --fit`` for a folder of clips."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .._whole_file import write_text
from ..robot import Robot
from ._film import film
from ._fit import Fit, fit
from ._load import Reader, clips_in
from ._page import write_report
from ._profile import Profile
from ._profile_file import save_profile
from ._report import report
from ._retargeted import Retargeted

_HELD_OUT = 4
"""Every fourth clip is held out of a fit: it selects the step that is kept but not its direction."""


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
    """Fit a profile to the clips of a folder (``fit``) and write it to a TOML file.

    Every fourth clip in order of name is held out; none if there are fewer than four.

    Returns:
        the fit, the number of training clips and the number of held-out clips.

    Raises:
        OSError: the file cannot be written.
        ImportError, ValueError, KeyError: as of ``fit`` and ``load_motion``; the latter's start with the clip's name.
    """
    motions = []
    for name, path in clips_in(folder)[0].items():
        try:
            motions.append(reader.in_folder(path))
        except (ValueError, KeyError) as error:
            raise type(error)(f"{name}: {error.args[0]}") from error
    held_out = motions[_HELD_OUT - 1 :: _HELD_OUT]
    learned = [motion for motion in motions if all(motion is not other for other in held_out)]
    found = fit(robot, learned, held_out=held_out, profile=profile, mapping=mapping, acceleration=acceleration)
    save_profile(found.profile, file)
    return found, len(learned), len(held_out)


def write_folder(result: Retargeted, name: str, out: Path, *, animation: bool, page: bool = False) -> dict[str, Any]:
    """Write motion (.npz and .csv), report, profile and optionally GIF and page; return the report."""
    figures = {"clip": name, **report(result)}
    write_motion(result, figures, out, page)
    save_profile(result.profile, out / "profile.toml")
    if animation:
        film(result, out / "motion.gif")
    return figures


def write_motion(result: Retargeted, figures: dict[str, Any], out: Path, page: bool = False) -> None:
    """Write ``motion.npz``, ``motion.csv``, the page and, last of all, ``report.json`` to an existing folder."""
    result.save(out / "motion.npz")
    result.motion.save_csv(out / "motion.csv")
    if page:
        write_report(result, figures, out / "motion.npz", out / "report.html")
    write_json(figures, out / "report.json")


def write_json(figures: dict[str, Any], path: Path) -> None:
    """Write a JSON file, so that a file of this name is always complete."""
    write_text(path, json.dumps(figures, indent=2, allow_nan=False) + "\n")
