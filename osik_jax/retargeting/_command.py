"""Files of ``osik retarget``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from .._whole_file import write_text
from ._film import film
from ._page import write_report
from ._profile_file import save_profile
from ._report import report
from ._retargeted import Retargeted


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
