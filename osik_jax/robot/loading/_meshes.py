"""Mesh files as triangles in metres: COLLADA and text STL read here, all else by MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float, Int

from ..._errors import OsikValueError
from .._tree import UnreadMesh
from ._collada import Triangles, read_collada
from ._packages import Packages
from ._poses import rotation_matrix

_SUFFIXES = (".dae", ".stl", ".obj", ".msh")
_THICKNESS = 1e-3
"""Thickness given to a flat mesh [m]."""
_LINE = 1e-6
"""A mesh whose extent in a second direction is less than this share of its extent in the first is a line."""


def read_mesh(path: Path) -> list[Triangles]:
    """Return the triangles of a mesh file, in the file's axes."""
    suffix = path.suffix.lower()
    if suffix not in _SUFFIXES:
        raise OsikValueError(f"{path}: a mesh has to be one of {', '.join(_SUFFIXES)}")
    if suffix == ".dae":
        parts = read_collada(path)
    else:
        parts = [_text_stl(path) if suffix == ".stl" and _is_text(path) else _by_mujoco(path)]
    solid = [part for part in parts if _has_area(part)]
    if not solid:
        raise OsikValueError(f"{path}: nothing in it has a surface")
    return solid


def joined(parts: Sequence[Triangles]) -> tuple[Float[np.ndarray, "k 3"], Int[np.ndarray, "m 3"]]:
    """Return vertices [m] and triangles of the parts of a mesh as one."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    return np.concatenate([part.vertices for part in parts]), np.concatenate(faces)


def unread_points(mesh: UnreadMesh) -> Float[np.ndarray, "k 3"]:
    """Return the vertices of a collision mesh [m], in the axes of its shape."""
    beside = None if mesh.beside is None else Path(mesh.beside)
    path = Packages(mesh.folders).path(mesh.file, beside=beside)
    return joined(read_mesh(path))[0] * np.array(mesh.scale)


def thickened(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Return points on both sides of the plane that the given ones are in; ValueError where they are on one line."""
    _, extents, axes = np.linalg.svd(points - points.mean(0), full_matrices=False)
    if not extents[1] > _LINE * extents[0]:
        raise OsikValueError("the points are on one line")
    aside = 0.5 * _THICKNESS * axes[2]
    return np.concatenate([points + aside, points - aside])


def _has_area(part: Triangles) -> bool:
    """Return whether a mesh has the four points and the surface that MuJoCo needs to draw it."""
    if len(part.vertices) < 4 or not np.isfinite(part.vertices).all():
        return False
    a, b, c = np.moveaxis(part.vertices[part.faces], 1, 0)
    # twice the area relative to the squared size: below it all triangles are slivers, which MuJoCo refuses
    return bool(np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum() > 1e-12 * np.ptp(part.vertices, 0).max() ** 2)


def _is_text(path: Path) -> bool:
    """Return whether an STL file is text; binary files may start with the word "solid" too."""
    with path.open("rb") as file:
        start = file.read(512)
    return start.lstrip().startswith(b"solid") and b"facet" in start


def _text_stl(path: Path) -> Triangles:
    words = path.read_text(encoding="utf-8", errors="replace").split()
    starts = [k + 1 for k, word in enumerate(words) if word == "vertex"]
    corners = np.array([words[k : k + 3] for k in starts], float).reshape(-1, 3)
    vertices, index = np.unique(corners[: 3 * (len(corners) // 3)], axis=0, return_inverse=True)
    return Triangles(vertices, index.reshape(-1, 3), None)


def _by_mujoco(path: Path) -> Triangles:
    """Return vertices and triangles as MuJoCo reads them, moved back from the mesh's own centre and axes."""
    spec = mujoco.MjSpec()
    # as a shell that collides with nothing, a mesh may be open or flat
    spec.add_mesh(name="mesh", file=str(path.absolute()), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh", contype=0, conaffinity=0)
    model = spec.compile()
    vertices = model.mesh_vert @ rotation_matrix(model.mesh_quat[0]).T + model.mesh_pos[0]
    return Triangles(vertices, model.mesh_face.copy(), None)
