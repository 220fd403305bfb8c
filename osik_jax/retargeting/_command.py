"""What ``osik retarget`` does: from a clip to a folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ._film import film
from ._motion import HumanMotion
from ._profile_file import save_profile
from ._report import report
from ._retarget import Retargeted, Retargeter
from ._robot_motion import write_csv


def retarget_to_folder(
    retargeter: Retargeter,
    motion: HumanMotion,
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


def write_folder(result: Retargeted, name: str, out: Path, *, animation: bool) -> dict[str, Any]:
    """Writes what ``retarget_to_folder`` says, and returns the report."""
    result.save(out / "motion.npz")
    write_csv(result.motion, out / "motion.csv")
    figures = {"clip": name, **report(result)}
    (out / "report.json").write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    save_profile(result.profile, out / "profile.toml")
    if animation:
        film(result, out / "motion.gif")
    return figures
