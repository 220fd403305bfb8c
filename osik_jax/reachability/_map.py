"""Map of a frame's reach: positions, orientations, manipulability and configurations."""

from __future__ import annotations

import dataclasses
import os
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from .._errors import OsikValueError
from .._npz import open_npz
from .._whole_file import whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FORMAT = 1


@dataclasses.dataclass(frozen=True, eq=False)
class ReachabilityMap:
    """Orientations that a frame can take at each position of a grid; ``reachability_map`` says what the fields are."""

    frame: str
    x: Float[np.ndarray, " nx"]
    y: Float[np.ndarray, " ny"]
    z: Float[np.ndarray, " nz"]
    rotations: Float[np.ndarray, "m 3 3"]
    reached: Bool[np.ndarray, "nx ny nz m"]
    beyond_reach: Float[np.ndarray, "nx ny nz"]
    manipulability: Float[np.ndarray, "nx ny nz"]
    q: Float[np.ndarray, "nx ny nz nq"]
    links: Float[np.ndarray, "k 3"]

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the coordinates of the positions along x, y and z [m]."""
        return self.x, self.y, self.z

    @property
    def share(self) -> Float[np.ndarray, "nx ny nz"]:
        """Return the share of the orientations that are reached at each position."""
        return self.reached.mean(-1)

    @property
    def positions(self) -> Float[np.ndarray, "nx ny nz 3"]:
        """Return the positions [m]."""
        return np.stack(np.meshgrid(*self.axes, indexing="ij"), -1)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a ``.npz`` with an array for each attribute, under its name only when complete.

        Raises:
            OSError: it cannot be written.
        """
        arrays = {field.name: np.asarray(getattr(self, field.name)) for field in dataclasses.fields(self)}
        with whole_file(path) as file:
            np.savez_compressed(file, allow_pickle=False, format=np.array(_FORMAT), **arrays)

    def figure(self, at: tuple[float, float, float] | None = None) -> Figure:
        """Return a matplotlib figure of slices across x, y and z, coloured by the share of orientations, robot at home.

        Args:
            at: a point that the slices go through; each is the grid's nearest [m]. Default: of each axis, where most
                is reached.

        Returns:
            A figure, which ``savefig`` writes to a file.

        Raises:
            ValueError: ``at`` is no point.
        """
        from ._picture import draw_slices  # matplotlib, an extra

        return draw_slices(self, at)


def load_map(path: str | os.PathLike[str]) -> ReachabilityMap:
    """Return the map that ``save``, or ``osik reach``, has written.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no map, or one of another version.
    """
    names = [field.name for field in dataclasses.fields(ReachabilityMap)]
    with open_npz(path) as file:
        missing = [name for name in ("format", *names) if name not in file.files]
        if missing:
            raise OsikValueError(f"{os.fspath(path)} is no reachability map: it has no {missing[0]}")
        if int(file["format"]) != _FORMAT:
            raise OsikValueError(f"{os.fspath(path)} has format {file['format']}; this version reads {_FORMAT}")
        arrays: dict[str, Any] = {name: file[name] for name in names}
    arrays["frame"] = str(arrays["frame"])
    return ReachabilityMap(**arrays)
