"""Status codes of solvers."""

from __future__ import annotations

import enum
from typing import Any

import numpy as np


class Status(enum.IntEnum):
    """Status of a solver's answer, one per problem; an integer array under ``vmap``."""

    SOLVED = 0
    MAX_ITERATIONS = 1
    INFEASIBLE = 2
    NUMERICAL_ERROR = 3


_ADVICE = {
    Status.MAX_ITERATIONS: "raise max_iterations, or look for nearly parallel rows and rescale them",
    Status.INFEASIBLE: "some bounds cross, or rows cannot hold together with the box: turn one into a task",
    Status.NUMERICAL_ERROR: "a NaN, infinity or negative weight: look at q, targets, gains and weights of that lane",
}


def raise_if_failed(solution: Any) -> None:
    """Raise on the host if any lane of a solution is not SOLVED.

    Args:
        solution: anything with a ``status`` array, of any batch shape. Do not call it inside ``jit``.

    Raises:
        RuntimeError: names each verdict, the lanes that have it and what to try.
    """
    status = np.asarray(solution.status)
    if not status.any():
        return
    lines = []
    for code, advice in _ADVICE.items():
        lanes = np.argwhere(status == code)
        if len(lanes):
            shown = ", ".join(str(tuple(lane.tolist())) for lane in lanes[:10]) if status.ndim else "the only one"
            more = f" and {len(lanes) - 10} more" if len(lanes) > 10 else ""
            lines.append(f"{code.name} in {len(lanes)} of {status.size} lanes ({shown}{more}): {advice}")
    if lines:
        raise RuntimeError("\n".join(lines))
