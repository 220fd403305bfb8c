"""Readout of a control loop as short lines of Markdown."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from ...solvers import Status
from ...tasks import Task
from ._loop import Snapshot
from ._timing import Timing

_VISIBLE = 5e-4
"""Distance [m or rad] outside of bounds below which an error counts as inside: it would read as 0 mm outside."""


def state_text(snapshot: Snapshot) -> str:
    """Return one line on whether the loop runs, and how well."""
    if snapshot.problem:
        return f"**refused:** {snapshot.problem}"
    if not snapshot.ready:
        return "**compiling the first step …**"
    doing = "**paused**" if snapshot.paused else "**running**"
    if snapshot.preparing:
        doing += " · compiling the change …"
    return doing


def timing_text(snapshot: Snapshot, timing: Timing) -> str:
    """Return status and time of the last step, and the rate of the loop, as text."""
    status = Status(snapshot.status).name.lower().replace("_", " ")
    if not timing.steps:
        return status
    rate = 1.0 / timing.period[0] if timing.period[0] > 0.0 else 0.0
    return f"{status} · step {1e3 * timing.step[0]:.2f} ms · {rate:.0f} Hz, period p99 {1e3 * timing.period[1]:.1f} ms"


def error_table(tasks: Mapping[str, Task], off: frozenset[str], errors: Mapping[str, np.ndarray]) -> str:
    """Return a table of the errors of the active tasks."""
    rows = [f"| {name} | {error_text(task, errors.get(name))} |" for name, task in tasks.items() if name not in off]
    return "\n".join(["| task | error |", "|:--|--:|", *rows])


def error_text(task: Task, error: Float[np.ndarray, " m"] | None) -> str:
    """Return an error with its unit; for an inequality, its violation."""
    if error is None:
        return "…"
    bounds = task.error_bounds()
    if bounds is None:
        return _length_text(task, error)
    lower, upper = (np.asarray(bound) for bound in bounds)
    outside = np.maximum(lower - error, error - upper)
    if outside.max() > _VISIBLE:
        return f"{_length_text(task, np.maximum(outside, 0.0))} outside"
    return f"{-1e3 * outside.max():.0f} mm inside" if task.unit_of("error") == "m" else "inside"


def _length_text(task: Task, error: Float[np.ndarray, " m"]) -> str:
    """Return the length of an error: of rows in metres in mm, of rows in radians in degrees, of others as a number."""
    unit = task.unit_of("error")
    if unit not in ("m", "rad", "m or rad"):
        return f"{np.linalg.norm(error):.3g}"
    lengths = task.are_lengths(len(error))
    parts = [f"{1e3 * np.linalg.norm(error[lengths]):.1f} mm"] if lengths.any() else []
    return ", ".join([*parts, *([] if lengths.all() else [f"{np.rad2deg(np.linalg.norm(error[~lengths])):.1f}°"])])
