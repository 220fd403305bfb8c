"""Robot shapes as triangles for a page: smooth where round, sharp at edges, limited in number."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .._parts import Part
from .._shapes import Quads, part_surface

_CREASE = np.cos(np.deg2rad(35.0))
"""Angle between faces below which they are shaded as one smooth surface."""
_DETAIL = 8
"""Number of rings of a round shape; a sphere has four times as many meridians."""
_MOST_FACES = 4000
"""Maximum number of faces of a mesh; larger meshes are simplified by merging close vertices."""
_CELLS = (160, 120, 96, 80, 64, 48, 40, 32, 24, 16, 12, 8)
"""Number of cells along a mesh's longest side, from fine to coarse."""


class Surface(NamedTuple):
    """Triangle surface.

    Attributes:
        vertices: [m]. (k, 3)
        faces: indices of vertices, counter-clockwise seen from outside. (m, 3)
    """

    vertices: Float[np.ndarray, "k 3"]
    faces: Int[np.ndarray, "m 3"]


def part_triangles(part: Part) -> Surface:
    """Return a part's surface in its own frame."""
    if part.mesh is None:
        return _split_at_creases(_triangulated(part_surface(part, _DETAIL)))
    vertices, faces = part.mesh
    return _split_at_creases(_fewer(_merged(Surface(np.asarray(vertices, float), np.asarray(faces)), decimals=7)))


def _triangulated(quads: Quads) -> Surface:
    """Return two triangles per quad, without those of zero area."""
    corners = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3, 3)
    return _merged(Surface(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)), decimals=9)


def _merged(surface: Surface, *, decimals: int) -> Surface:
    """Return the surface with vertices at the same place merged."""
    _, first, index = np.unique(np.round(surface.vertices, decimals), axis=0, return_index=True, return_inverse=True)
    return _proper(surface.vertices[first], index.reshape(-1)[surface.faces])


def _proper(vertices: np.ndarray, faces: np.ndarray) -> Surface:
    """Return the surface without degenerate faces and without unused vertices."""
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    used, index = np.unique(faces, return_inverse=True)
    return Surface(vertices[used], index.reshape(-1, 3))


def _fewer(surface: Surface) -> Surface:
    """Return the surface with at most ``_MOST_FACES`` faces, by clustering vertices on a grid."""
    for cells in _CELLS:
        if len(surface.faces) <= _MOST_FACES:
            break
        surface = _clustered(surface, float(np.ptp(surface.vertices, axis=0).max()) / cells)
    return surface


def _clustered(surface: Surface, cell: float) -> Surface:
    """Return the surface with the vertices of each grid cell replaced by their mean."""
    _, index = np.unique(np.floor(surface.vertices / cell), axis=0, return_inverse=True)
    index = index.reshape(-1)
    sums = np.zeros((index.max() + 1, 3))
    np.add.at(sums, index, surface.vertices)
    means = sums / np.bincount(index)[:, None]
    # clustering folds several faces onto the same three vertices: one of each is kept
    faces = np.unique(np.sort(index[surface.faces], axis=1), axis=0, return_index=True)[1]
    return _proper(means, index[surface.faces[faces]])


def _split_at_creases(surface: Surface) -> Surface:
    """Return the surface with vertices duplicated at creases, because a page shades shared vertices smoothly."""
    vertices, faces = surface
    if not len(faces):
        return surface
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normals = np.cross(b - a, c - a)
    # a sliver may have an area of 0 in floating point
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
    corners = np.argsort(faces.ravel(), kind="stable")
    ends = np.searchsorted(faces.ravel()[corners], np.arange(len(vertices) + 1))
    group, owners = np.zeros(faces.size, int), []
    for vertex in range(len(vertices)):
        for alike in _alike(corners[ends[vertex] : ends[vertex + 1]], normals):
            group[alike] = len(owners)
            owners.append(vertex)
    return Surface(vertices[np.array(owners)], group.reshape(-1, 3))


def _alike(corners: Int[np.ndarray, " k"], normals: Float[np.ndarray, "m 3"]) -> Iterator[Int[np.ndarray, " j"]]:
    """Return groups of corners around a vertex by similar face normals; corner c belongs to face floor(c / 3)."""
    while len(corners):
        # compared by cosine with the first face of the group
        own = normals[corners // 3] @ normals[corners[0] // 3] > _CREASE
        own[0] = True
        yield corners[own]
        corners = corners[~own]
