"""Robot shapes as triangles for a page: smooth where round, sharp at edges, limited in number."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int

from .._parts import Part

if TYPE_CHECKING:
    from trimesh import Trimesh

_GEOM = mujoco.mjtGeom
_CREASE = np.deg2rad(35.0)
"""Angle between faces below which they are shaded as one smooth surface."""
_SECTIONS = 32
"""Number of meridians of a round shape."""
_MOST_FACES = 4000
"""Maximum number of faces of a mesh; larger meshes are simplified by merging close vertices."""
_CELLS = (160, 120, 96, 80, 64, 48, 40, 32, 24, 16, 12, 8)
"""Number of cells along a mesh's longest side, from fine to coarse."""


class Surface(NamedTuple):
    """Triangle surface."""

    vertices: Float[np.ndarray, "k 3"]  # [m]
    faces: Int[np.ndarray, "m 3"]  # indices of vertices, counter-clockwise seen from outside


def part_triangles(part: Part) -> Surface:
    """Return a part's surface in its own frame; vertices at creases are doubled, because a page shades shared ones."""
    from trimesh import Trimesh, graph  # comes with viser

    mesh = _primitive(part) if part.mesh is None else _fewer(Trimesh(*part.mesh))
    mesh.update_faces(mesh.nondegenerate_faces())
    smooth = graph.smooth_shade(mesh, angle=_CREASE, facet_minarea=None)
    return Surface(np.asarray(smooth.vertices), np.asarray(smooth.faces))


def _primitive(part: Part) -> Trimesh:
    """Return the surface of a part that is no mesh."""
    from trimesh import creation

    radius, half_length, _ = part.size
    round_shape = dict(count=(_SECTIONS, _SECTIONS))
    match part.kind:
        case _GEOM.mjGEOM_SPHERE:
            return creation.uv_sphere(radius, **round_shape)
        case _GEOM.mjGEOM_ELLIPSOID:
            return creation.uv_sphere(1.0, **round_shape).apply_scale(part.size)
        case _GEOM.mjGEOM_CAPSULE:
            capsule = creation.capsule(2.0 * half_length, radius, **round_shape)
            return capsule.apply_translation(-capsule.bounds.mean(0))  # releases differ in where its middle is
        case _GEOM.mjGEOM_CYLINDER:
            return creation.cylinder(radius, 2.0 * half_length, sections=_SECTIONS)
        case _:
            return creation.box(2.0 * part.size)


def _fewer(mesh: Trimesh) -> Trimesh:
    """Return the mesh with at most ``_MOST_FACES`` faces, by clustering vertices on a grid."""
    for cells in _CELLS:
        if len(mesh.faces) <= _MOST_FACES:
            break
        mesh = _clustered(mesh, float(np.ptp(mesh.vertices, axis=0).max()) / cells)
    return mesh


def _clustered(mesh: Trimesh, cell: float) -> Trimesh:
    """Return the mesh with the vertices of each grid cell replaced by their mean."""
    _, index, count = np.unique(np.floor(mesh.vertices / cell), axis=0, return_inverse=True, return_counts=True)
    index, means = index.reshape(-1), np.zeros((len(count), 3))
    np.add.at(means, index, mesh.vertices / count[index, None])
    mesh.vertices, mesh.faces = means, index[mesh.faces]
    # clustering folds several faces onto the same three vertices: one of each is kept
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    return mesh
