"""Report of a demonstration: JSON for programs and a table for people."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Mapping, Sequence
from typing import Any

import jax
from rich.markup import escape
from rich.table import Table

from ..solvers import Status
from ._figures import Figure
from ._motion import Motion
from ._run import TITLES, Run

_PACKAGES = ("osik-jax", "jax", "jaxlib", "mujoco", "equinox", "numpy", "scipy", "matplotlib")


def report(
    motion: Motion, runs: Sequence[Run], figures: Mapping[str, Sequence[Figure]], *, dt: float, files: Sequence[str]
) -> dict[str, Any]:
    """Return all figures of a demonstration, by the names of the schemes."""
    versions = {name: importlib.metadata.version(name) for name in _PACKAGES}
    schemes = {}
    for run in runs:
        found = figures[run.scheme]
        status = {status.name: int((run.solution.status == status).sum()) for status in Status}
        missed = [figure.name for figure in found if figure.missed]
        schemes[run.scheme] = {figure.name: figure.worst for figure in found} | {"status": status, "missed": missed}
    return {
        "motion": motion.name,
        "title": motion.title,
        "duration_s": motion.duration,
        "dt_s": dt,
        "steps": round(motion.duration / dt),
        "scale": motion.scale,
        "precision": str(motion.robot.q0.dtype),
        "schemes": schemes,
        "versions": versions | {"python": platform.python_version(), "platform": platform.platform()},
        "device": str(jax.devices()[0]),
        "cores": os.cpu_count(),
        "files": list(files),
        "notes": list(motion.notes),
    }


def table(title: str, figures: Mapping[str, Sequence[Figure]]) -> Table:
    """Return the figures as a table with one column per scheme; those in red miss their requirement."""
    out = Table(title=title, title_justify="left", title_style="bold")
    out.add_column("")
    for scheme in figures:
        out.add_column(TITLES[scheme], justify="right")
    for row in zip(*figures.values(), strict=True):
        if any(figure.worst is not None for figure in row):
            out.add_row(escape(row[0].label), *map(_cell, row))
    return out


def _cell(figure: Figure) -> str:
    """Return a figure as a cell, in red outside its range."""
    worst = figure.worst
    if worst is None:
        return "-"
    text = (f"{worst:.2g}" if abs(worst) < 10.0 else f"{worst:.1f}") if isinstance(worst, float) else str(worst)
    return f"[red]{text}[/red]" if figure.missed else text
