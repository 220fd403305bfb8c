"""Slices across the axes of a map: their cells and colours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8

from .._errors import OsikValueError

if TYPE_CHECKING:
    from matplotlib.colors import ListedColormap

NOTHING = "#e6e8eb"
"""Colour of cells where no orientation was found and none is proven out of reach."""
_PALE = 0.15
"""Share of the colours at the light end that is left out, so that a small share differs from none."""


def share_colors() -> ListedColormap:
    """Return the colours of the share of orientations reached, from 0 to 1."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    return ListedColormap(colormaps["YlGnBu"](np.linspace(_PALE, 1.0, 256)))


def fullest(share: Float[np.ndarray, "nx ny nz"]) -> tuple[int, int, int]:
    """Return for each axis the index of the slice with the largest sum."""
    sums = (share.sum(tuple(j for j in range(3) if j != i)) for i in range(3))
    return tuple(int(values.argmax()) for values in sums)  # pyright: ignore[reportReturnType]


def nearest(axes: Sequence[np.ndarray], at: Any) -> tuple[int, int, int]:
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


def slice_colors(share: Float[np.ndarray, "n m"], beyond_reach: Float[np.ndarray, "n m"]) -> UInt8[np.ndarray, "n m 4"]:
    """Return red, green, blue and alpha of the cells of a slice; clear where proven out of reach."""
    from matplotlib.colors import to_rgba

    colors = np.where((share > 0.0)[..., None], share_colors()(share), to_rgba(NOTHING))
    return np.round(255.0 * np.where(((beyond_reach > 0.0) & (share == 0.0))[..., None], 0.0, colors)).astype(np.uint8)
