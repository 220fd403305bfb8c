"""Visual shapes of a robot's links."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class LinkShape:
    """A shape of a link, in the link's frame."""

    link: str  # name of the link
    kind: mujoco.mjtGeom  # MuJoCo's geom type
    size: Float[np.ndarray, "3"]  # MuJoCo's geom sizes [m]
    # centre of a simple shape [m]; 0 for a mesh, whose vertices are in the link's frame
    position: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]  # rotation of a simple shape in the link's frame
    color: tuple[float, ...] | None  # red, green, blue, alpha, 0 to 1; ``None``: the URDF gives none
    mesh: tuple[np.ndarray, np.ndarray] | None = None  # vertices (k, 3) [m] and triangles (m, 3) of a mesh


@dataclasses.dataclass(frozen=True)
class Look:
    """Visual shapes of a robot's links."""

    shapes: tuple[LinkShape, ...]
    missing: tuple[str, ...]  # addresses of mesh files that were not found or could not be read
