"""Picture of residuals before and after a fit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ._residuals import Residuals, lengths, root_mean_square

_BEFORE, _AFTER, _INK = "#c98b2b", "#2f6fb0", "#2b2f36"
_OUTLIER = 0.1
"""Weight below which a reading is marked as an outlier."""


def draw_residuals(parts: Sequence[Residuals]) -> Figure:
    """Return one plot for each measurement: the size of each reading's residual before and after, as bars.

    The axis is logarithmic, because a fit shrinks residuals by orders of magnitude. Outliers have a cross.
    """
    figure = Figure(figsize=(9.0, 0.5 + 2.9 * len(parts)), dpi=130, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    for place, part in zip(figure.subplots(len(parts), 1, squeeze=False)[:, 0], parts, strict=True):
        unit, scale = ("mm", 1e3) if part.unit.startswith("m") else (part.unit, 1.0)
        before, after = (scale * lengths(rows) for rows in (part.before, part.after))
        first, last = (scale * root_mean_square(rows) for rows in (part.before, part.after))
        number = np.arange(1, len(after) + 1)
        place.plot(number, before, "o", color=_BEFORE, ms=4, label=f"before, rms {first:.3g} {unit}")
        place.plot(number, after, "o", color=_AFTER, ms=4, label=f"after, rms {last:.3g} {unit}")
        out = np.asarray(part.weights) < _OUTLIER
        if out.any():
            place.plot(number[out], after[out], "x", color=_INK, ms=9, label=f"{int(out.sum())} outliers")
        place.set_yscale("log")
        place.set_title(part.kind, color=_INK, fontsize=10, loc="left")
        place.set_ylabel(f"residual [{unit}]", color=_INK)
        place.set_xlabel("reading", color=_INK)
        place.xaxis.set_major_locator(MaxNLocator(integer=True))
        place.grid(alpha=0.3)
        place.legend(frameon=False, fontsize=9)
    return figure
