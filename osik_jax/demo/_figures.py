"""Figures of a motion, and the table that compares schemes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from rich.markup import escape
from rich.table import Table

from ..robot import Robot
from ..robot._joint_selection import scalar_layout
from ..solvers import Status
from ._motion import Motion
from ._run import TITLES, Run

DRIFT = 1e-4
"""Largest drift of a standing foot for a motion of 5 cm: position [m] and orientation [rad]."""

_ROOM = -1e-9
"""Room to a limit that counts as 0, because of rounding."""


@dataclasses.dataclass(frozen=True)
class Figure:
    """Number of a motion, or values over time of which the worst counts."""

    label: str  # in the table, with its unit
    values: Float[np.ndarray, "*T"] | float | int  # a number, or one value a configuration
    least: float | None = None  # smallest value that is wanted
    most: float | None = None  # largest value that is wanted

    @property
    def worst(self) -> float | int | None:
        """Return the number, or the worst of the values over time; None if all are NaN."""
        if not isinstance(self.values, np.ndarray):
            return self.values
        known = self.values[~np.isnan(self.values)]
        return None if not len(known) else float(known.max() if self.least is None else known.min())

    @property
    def missed(self) -> bool:
        """Return whether the figure is outside its range."""
        worst = self.worst
        if worst is None:
            return False
        return (self.least is not None and worst < self.least) or (self.most is not None and worst > self.most)


def figures(motion: Motion, run: Run) -> list[Figure]:
    """Return the figures of a run that exist for its robot; required lengths grow with the scale of the motion."""
    seen = run.seen
    feet = [
        Figure("standing feet, drift [mm]", 1e3 * seen.drift, most=1e3 * DRIFT * motion.scale),
        Figure("standing feet, turn [mrad]", 1e3 * seen.turn, most=1e3 * DRIFT),
    ]
    goals = [Figure(f"{label.replace('_', ' ')}, from path [mm]", 1e3 * seen.off_path(label)) for label in motion.goals]
    return [
        *(feet if motion.stances else []),
        *([Figure("centre of mass inside [mm]", 1e3 * seen.com_inside, least=0.0)] if seen.support else []),
        *goals,
        Figure("room to position limits (0 to 1)", _position_room(motion.robot, run.q), least=_ROOM),
        Figure("room to speed limits (0 to 1)", _speed_room(motion.robot, run), least=_ROOM),
        Figure("steps not solved", int((run.solution.status != Status.SOLVED).sum()), most=0),
        Figure("compile [s]", run.compile_seconds),
        Figure("a step [µs]", 1e6 * run.run_seconds / len(run.solution.status)),
    ]


def _position_room(robot: Robot, q: Float[np.ndarray, "T nq"]) -> Float[np.ndarray, " T"]:
    """Return the least distance of a joint to a limit relative to half its range: 1 in the middle, negative beyond."""
    lower, upper = np.asarray(robot.position_lower), np.asarray(robot.position_upper)
    scalar, index = scalar_layout(robot)
    limited = scalar & np.isfinite(upper - lower)
    value, lower, upper = q[:, index[limited]], lower[limited], upper[limited]
    # the guard keeps a joint with an empty range finite
    room = 2.0 * np.minimum(value - lower, upper - value) / np.maximum(upper - lower, 1e-12)
    return room.min(-1, initial=1.0)


def _speed_room(robot: Robot, run: Run) -> Float[np.ndarray, " steps"]:
    """Return the least distance of a velocity to its limit: 1 at rest, 0 at the limit."""
    limit = np.asarray(robot.velocity_limit)
    bounded = np.isfinite(limit)
    return 1.0 - (np.abs(run.solution.velocity)[:, bounded] / limit[bounded]).max(-1, initial=0.0)


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
