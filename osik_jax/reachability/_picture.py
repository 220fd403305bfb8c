"""Figure of a map as slices across its axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure

from .._errors import OsikValueError

NOTHING = "#e6e8eb"
"""Colour of cells where no orientation was found and none is proven out of reach."""
_PALE = 0.15
"""Share of the colours at the light end that is left out, so that a small share differs from none."""
_INK, _GREY = "#2b2f36", "#5b636d"
_PLANES = ((0, 1), (0, 2), (1, 2))


def draw_slices(found: Any, at: tuple[float, float, float] | None = None) -> Figure:
    """Return three slices of a ``ReachabilityMap``, one across each axis.

    They go through ``at`` [m], by default where most is reached along each axis.
    """
    axes, share = found.axes, found.share
    spot = _fullest(share) if at is None else _nearest(axes, at)
    planes = [plane for plane in _PLANES if all(len(axes[i]) > 1 for i in plane)] or [_PLANES[0]]
    figure = Figure(figsize=(4.4 * len(planes) + 0.9, 5.0), dpi=130, facecolor="white")
    figure.set_layout_engine("constrained", rect=(0.005, 0.01, 0.99, 0.87))
    FigureCanvasAgg(figure)
    for place, plane in zip(figure.subplots(1, len(planes), squeeze=False)[0], planes, strict=True):
        _draw_slice(place, found, spot, plane)
    colors = ScalarMappable(Normalize(0.0, 100.0), share_colors())
    bar = figure.colorbar(colors, ax=figure.axes, shrink=0.8, pad=0.015)
    bar.set_label(f"of {len(found.rotations)} orientations reached [%]", color=_INK)
    note = "grey: none found; white: proven out of reach; line: the joints at home"
    figure.text(0.012, 0.945, f"Reach of {found.frame}", fontsize=13, weight="bold", color=_INK)
    figure.text(0.012, 0.905, note, fontsize=8.5, color=_GREY)
    return figure


def _draw_slice(place: Axes, found: Any, spot: tuple[int, int, int], plane: tuple[int, int]) -> None:
    across, axes = 3 - sum(plane), found.axes
    values, beyond = (np.take(field, spot[across], across).T for field in (found.share, found.beyond_reach > 0.0))
    edges = [cell_edges(axes)[i] for i in plane]
    nothing = np.ma.masked_where(beyond | (values > 0.0), np.zeros_like(values))
    place.pcolormesh(*edges, nothing, cmap=ListedColormap([NOTHING]))
    place.pcolormesh(*edges, np.ma.masked_where(values == 0.0, values), cmap=share_colors(), vmin=0.0, vmax=1.0)
    place.plot(*found.links[:, plane].T, "-o", color="#f08c3a", linewidth=2.0, markersize=3.5, alpha=0.9)
    place.set_aspect("equal")
    names = "xyz"
    place.set_xlabel(f"{names[plane[0]]} [m]", color=_INK)
    place.set_ylabel(f"{names[plane[1]]} [m]", color=_INK)
    place.set_title(f"{names[across]} = {axes[across][spot[across]]:.3g} m", fontsize=10, color=_INK)
    place.tick_params(labelsize=8)


def share_colors() -> ListedColormap:
    """Return the colours of the share of orientations reached, from 0 to 1."""
    return ListedColormap(colormaps["YlGnBu"](np.linspace(_PALE, 1.0, 256)))


def _fullest(share: Float[np.ndarray, "nx ny nz"]) -> tuple[int, int, int]:
    """Return for each axis the index of the slice with the largest sum."""
    sums = (share.sum(tuple(j for j in range(3) if j != i)) for i in range(3))
    return tuple(int(values.argmax()) for values in sums)  # pyright: ignore[reportReturnType]


def _nearest(axes: Sequence[np.ndarray], at: Any) -> tuple[int, int, int]:
    """Return for each axis the index of the coordinate that is nearest to the point ``at``."""
    try:
        point = np.asarray(at, float)
    except (TypeError, ValueError):
        point = np.zeros(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise OsikValueError(f"at is {at!r}; it is a point x y z [m]")
    return tuple(  # pyright: ignore[reportReturnType]
        int(np.abs(axis - value).argmin()) for axis, value in zip(axes, point, strict=True)
    )


def cell_edges(axes: Sequence[Float[np.ndarray, " n"]]) -> list[Float[np.ndarray, " n_1"]]:
    """Return the edges of the cells along each axis; a single cell is as wide as the smallest cell."""
    width = min((float(np.diff(axis).min()) for axis in axes if len(axis) > 1), default=0.01)
    return [_edges(axis, width) for axis in axes]


def _edges(axis: Float[np.ndarray, " n"], width: float) -> Float[np.ndarray, " n_1"]:
    between = 0.5 * (axis[1:] + axis[:-1])
    ends = (axis[:2].mean(), axis[-2:].mean()) if len(axis) > 1 else (axis[0] + 0.5 * width,) * 2
    return np.concatenate([[2.0 * axis[0] - ends[0]], between, [2.0 * axis[-1] - ends[1]]])
