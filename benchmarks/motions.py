"""Motions and what the judge says of them: at once, or later from a file where Pinocchio is not installed."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .workload import Workload

PARTS = ("one_robot", "many_robots")
"""Of the results, whose rows have motions."""
KEPT_STEPS = 1000
"""First steps of a motion that go into a file, in single precision; they hold the slowest part of the curve twice."""


def moving(result: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Rows that have motions."""
    for part in PARTS:
        yield from result[part]


def judged(result: dict[str, Any], work: Workload) -> dict[str, Any]:
    """The results with a verdict on each motion in its place."""
    from .judge import verdict  # loads Pinocchio

    for row in moving(result):
        row |= verdict(work, row.pop("motion"))
    return result


def kept(result: dict[str, Any], work: Workload, path: Path | None) -> dict[str, Any]:
    """The results without verdicts; their motions go into a file beside theirs, if that has a name."""
    arrays = {str(i): row.pop("motion")[:, :KEPT_STEPS].astype(np.float32) for i, row in enumerate(moving(result))}
    if path is not None:
        np.savez_compressed(_beside(path), allow_pickle=False, workload=np.array(work.to_json()), **arrays)
    for row in moving(result):
        row |= dict(score=None, failures=[])
    return result


def judged_later(path: Path) -> dict[str, Any]:
    """The results of a file with verdicts, from the motions that ``kept`` wrote beside it.

    Raises:
        FileNotFoundError: there are no results, or no motions: they have been judged before.
    """
    result = json.loads(path.read_text(encoding="utf-8"))
    with np.load(_beside(path), allow_pickle=False) as file:
        work = Workload.from_json(str(file["workload"]))
        for i, row in enumerate(moving(result)):
            row["motion"] = file[str(i)].astype(float)
    return judged(result, work)


def _beside(path: Path) -> Path:
    return path.with_suffix(".motions.npz")
