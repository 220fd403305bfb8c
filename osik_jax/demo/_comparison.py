"""Plot that compares schemes over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Page
from matplotlib.ticker import MaxNLocator

from ._figures import Figure
from ._run import TITLES

_COLORS = ("#f08c3a", "#8a8f98", "#1565c0")
_INK, _BAD, _GRID = "#2b2f36", "#d7263d", "#e3e7ec"


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
