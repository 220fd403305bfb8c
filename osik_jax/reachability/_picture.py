"""Figure of a map as slices."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure

from ._slices import NOTHING, cell_edges, fullest, nearest, share_colors

_INK, _GREY = "#2b2f36", "#5b636d"
_PLANES = ((0, 1), (0, 2), (1, 2))


class Field(NamedTuple):
    """Data of a figure; arrays as in ``ReachabilityMap``."""

    axes: tuple[np.ndarray, np.ndarray, np.ndarray]  # x, y and z of the positions [m]
    share: Float[np.ndarray, "nx ny nz"]
    beyond_reach: Float[np.ndarray, "nx ny nz"]
    links: Float[np.ndarray, "l 3"]


def draw_slices(found: Field, frame: str, orientations: int, at: tuple[float, float, float] | None = None) -> Figure:
    """Return three slices of a map, one across each axis.

    They go through ``at`` [m], by default where most is reached along each axis.
    """
    axes, share = found.axes, found.share
    spot = fullest(share) if at is None else nearest(axes, at)
    planes = [plane for plane in _PLANES if all(len(axes[i]) > 1 for i in plane)] or [_PLANES[0]]
    figure = Figure(figsize=(4.4 * len(planes) + 0.9, 5.0), dpi=130, facecolor="white")
    figure.set_layout_engine("constrained", rect=(0.005, 0.01, 0.99, 0.87))
    FigureCanvasAgg(figure)
    for place, plane in zip(figure.subplots(1, len(planes), squeeze=False)[0], planes, strict=True):
        _draw_slice(place, found, spot, plane)
    colors = ScalarMappable(Normalize(0.0, 100.0), share_colors())
    bar = figure.colorbar(colors, ax=figure.axes, shrink=0.8, pad=0.015)
    bar.set_label(f"of {orientations} orientations reached [%]", color=_INK)
    note = "grey: none found; white: proven out of reach; line: the joints at home"
    figure.text(0.012, 0.945, f"Reach of {frame}", fontsize=13, weight="bold", color=_INK)
    figure.text(0.012, 0.905, note, fontsize=8.5, color=_GREY)
    return figure


def _draw_slice(place: Axes, found: Field, spot: tuple[int, int, int], plane: tuple[int, int]) -> None:
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
