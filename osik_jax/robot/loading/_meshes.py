"""Mesh files as triangles in metres: COLLADA and text STL read here, all else by MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, Int

from ..._errors import OsikValueError
from .._tree import UnreadMesh
from ._collada import Triangles, read_collada
from ._mjmodel import rotation_matrix
from ._packages import Packages

SUFFIXES = (".dae", ".stl", ".obj", ".msh")


def read_mesh(path: Path) -> list[Triangles]:
    """Return the triangles of a mesh file, in the file's axes."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise OsikValueError(f"{path}: a mesh has to be one of {', '.join(SUFFIXES)}")
    if is_read_by_mujoco(path):
        parts = [_by_mujoco(path)]
    else:
        parts = read_collada(path) if suffix == ".dae" else [_text_stl(path)]
    solid = [part for part in parts if _has_area(part)]
    if not solid:
        raise OsikValueError(f"{path}: nothing in it has a surface")
    return solid


def is_read_by_mujoco(path: Path) -> bool:
    """Return whether MuJoCo reads a mesh file itself: neither COLLADA nor STL as text."""
    return path.suffix.lower() != ".dae" and not (path.suffix.lower() == ".stl" and _is_text(path))


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
    return Triangles(*shell(name="mesh", file=str(path.absolute())), None)


def shell(**mesh: Any) -> tuple[Float[np.ndarray, "k 3"], Int[np.ndarray, "m 3"]]:
    """Return vertices and triangles as MuJoCo reads them, moved back from the mesh's own centre and axes.

    The mesh may be open or flat. The arguments are those of ``MjSpec.add_mesh``.
    """
    open_surface = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    model = compiled_mesh(mesh | {"inertia": open_surface}, collides=False)
    return model.mesh_vert @ rotation_matrix(model.mesh_quat[0]).T + model.mesh_pos[0], model.mesh_face.copy()


def compiled_mesh(mesh: dict[str, Any], *, collides: bool) -> mujoco.MjModel:
    """Return a model of one mesh; one that collides gets its hull, which a flat mesh has not."""
    spec = mujoco.MjSpec()
    spec.add_mesh(**mesh)
    kind = mujoco.mjtGeom.mjGEOM_MESH
    spec.worldbody.add_geom(type=kind, meshname=mesh["name"], contype=int(collides), conaffinity=int(collides))
    return spec.compile()
