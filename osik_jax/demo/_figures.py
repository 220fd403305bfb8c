"""Figures of a motion: one list for the table and for the plots that compare schemes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Page
from matplotlib.ticker import MaxNLocator
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
_COLORS = ("#f08c3a", "#8a8f98", "#1565c0")
_INK, _BAD, _GRID = "#2b2f36", "#d7263d", "#e3e7ec"


@dataclasses.dataclass(frozen=True)
class Figure:
    """Number of a motion, or values over time of which the worst counts."""

    label: str  # in the table and over its plot, with its unit
    values: Float[np.ndarray, "*T"] | float | int  # a number, or one value a configuration
    least: float | None = None  # smallest value that is wanted
    most: float | None = None  # largest value that is wanted
    floor: float | None = None  # its plot has a logarithmic axis that ends here; ``None``: a linear axis
    span: float = 1e-3  # a linear axis shows this much at least

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
    seen, scale = run.seen, motion.scale
    most, turn = 1e3 * DRIFT * scale, 1e3 * DRIFT
    feet = [
        Figure("standing feet, drift [mm]", 1e3 * seen.drift, most=most, floor=1e-6 * most),
        Figure("standing feet, turn [mrad]", 1e3 * seen.turn, most=turn, floor=1e-6 * turn),
    ]
    goals = [
        Figure(f"{label.replace('_', ' ')}, from path [mm]", 1e3 * seen.off_path(label), floor=1e-5 * scale)
        for label in motion.goals
    ]
    return [
        *(feet if motion.stances else []),
        *([Figure("centre of mass inside [mm]", 1e3 * seen.com_inside, least=0.0, span=scale)] if seen.support else []),
        *goals,
        Figure("room to position limits (0 to 1)", _position_room(motion.robot, run.q), least=_ROOM, span=0.1),
        Figure("room to speed limits (0 to 1)", _speed_room(motion.robot, run), least=_ROOM, span=0.1),
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


def comparison(title: str, figures: Mapping[str, Sequence[Figure]], dt: float) -> Page:
    """Return a page with a plot for each figure that has values over time, with a line at its requirement.

    Values are ``dt`` [s] apart.
    """
    rows = [row for row in zip(*figures.values(), strict=True) if np.ndim(row[0].values) and row[0].worst is not None]
    columns = min(3, len(rows))
    lines = -(-len(rows) // columns)
    page = Page(figsize=(4.3 * columns, 2.75 * lines + 1.1), dpi=130, layout="constrained")
    FigureCanvasAgg(page)
    grid = page.subplots(lines, columns, squeeze=False).ravel()
    for axes, row in zip(grid, rows, strict=False):
        _draw(axes, row, [TITLES[scheme] for scheme in figures], dt)
    for axes in grid[len(rows) :]:
        axes.set_axis_off()
    page.suptitle(title, x=0.012, ha="left", fontsize=14, weight="bold", color=_INK)
    page.legend(*grid[0].get_legend_handles_labels(), loc="outside upper right", ncols=len(figures), frameon=False)
    page.supxlabel("time [s]", fontsize=9, color=_INK)
    return page


def _draw(axes: Axes, row: Sequence[Figure], names: Sequence[str], dt: float) -> None:
    """Draw one figure of all schemes."""
    first = row[0]
    for order, (figure, name) in enumerate(zip(row, names, strict=True)):
        values = np.asarray(figure.values, float)
        shown = values if first.floor is None else np.maximum(values, first.floor)
        width = max(3.8 - 1.2 * order, 1.3)  # curves that coincide stay visible
        axes.plot(dt * np.arange(len(shown)), shown, color=_COLORS[order], lw=width, zorder=3 + order, label=name)
    for bound in (first.least, first.most):
        if bound is not None:
            axes.axhline(bound, color=_BAD, lw=1.1, ls="--")
    low, high = axes.get_ylim()
    if first.floor is None:
        more = 0.5 * max(first.span - (high - low), 0.0)  # rounding errors of a constant do not look like curves
        axes.set_ylim(low - more, high + more)
        axes.yaxis.set_major_locator(MaxNLocator(5))
    else:
        axes.set_yscale("log")
        axes.set_ylim(first.floor, max(2.0 * high, 100.0 * first.floor))
    axes.set_title(first.label, loc="left", fontsize=10.5, color=_INK)
    axes.grid(color=_GRID, lw=0.7)
    axes.tick_params(labelsize=8.5, colors=_INK, length=3)
    axes.spines[["top", "right"]].set_visible(False)
