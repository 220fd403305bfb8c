"""Convex parts of triangle meshes."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from .._errors import OsikTypeError, OsikValueError, warn
from ..robot.loading._meshes import joined, read_mesh
from ..robot.loading._packages import Packages
from ._geometry import qhull
from ._table import hull_vertices

_CONVEX = 0.99
"""A closed mesh that fills this share of its hull is taken for convex."""

_CONCAVITY = 0.02
"""Concavity that CoACD leaves in a part, relative to the size of the mesh."""


def triangles(source: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [m] and faces of a mesh file, or of a pair of arrays.

    Raises:
        TypeError: neither a path nor a pair.
        ValueError: the file cannot be read, or the arrays have the wrong shape.
    """
    if isinstance(source, str | os.PathLike):
        return joined(read_mesh(Packages().path(source)))
    if not isinstance(source, tuple | list) or len(source) != 2:
        raise OsikTypeError(f"a mesh is a path, or vertices (n, 3) and faces (m, 3); got {type(source).__name__}")
    vertices, faces = np.asarray(source[0], float), np.asarray(source[1], int)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise OsikValueError(f"the vertices of a mesh have shape {vertices.shape}, expected (n, 3)")
    return vertices, faces


def convex_parts(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> list[Float[np.ndarray, "v 3"]]:
    """Return the corners [m] of convex parts whose union contains a mesh: its hull if it is convex, else by CoACD.

    Wei et al., Approximate Convex Decomposition for 3D Meshes with Collision-Aware Concavity and Tree Search, 2022.

    Raises:
        ValueError: the mesh has no hull, or its faces name vertices that it lacks.

    Warns:
        OsikWarning: the mesh is not convex and CoACD (the extra ``meshes``) is not installed, so its hull is taken.
    """
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.min(initial=0) < 0 or faces.max(initial=0) >= len(vertices):
        raise OsikValueError(f"faces of shape {faces.shape} are no triangles of {len(vertices)} vertices")
    whole = hull_vertices(vertices)
    share = abs(_volume(vertices, faces)) / qhull(whole).volume
    if share > _CONVEX:
        return [whole]
    try:
        import coacd  # pyright: ignore[reportMissingImports]
    except ImportError:
        warn(
            f"a mesh fills {share:.0%} of its convex hull, and the hull stands for it: "
            'pip install ".[meshes]" in the folder of osik-jax splits such meshes into convex parts'
        )
        return [whole]
    coacd.set_log_level("error")
    found = coacd.run_coacd(coacd.Mesh(vertices, faces), threshold=_CONCAVITY)
    return [hull_vertices(np.asarray(points, float)) for points, _ in found]


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = np.moveaxis(vertices[faces] - vertices.mean(0), 1, 0)
    return float((np.cross(a, b) * c).sum() / 6.0)
