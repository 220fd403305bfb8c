"""Geometry of shapes: a unit core of each kind, scaled by a shape's sizes; convex hulls of points and meshes."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import scipy  # loads its parts when they are used
from jaxtyping import Array, Float

from .._errors import OsikValueError
from ..kinematics._rigid import rotate
from ..numerics._guarded import greatest
from ._distance import Core

CYLINDER_SIDES = 16
"""Number of sides of the prism around a cylinder; its corners are 2 % of the radius outside."""

MOST_EDGES = 24
"""Edge directions of a hull with more of them are left out of the search for separating axes."""

MOST_NORMALS = 64
"""A hull with more face normals is searched along the 40 directions of ``_spread_normals`` instead."""

MOST_VERTICES = 256
"""A hull with more vertices is replaced by one of so many of them, with a radius that covers the others."""

_FIRST_VERTICES = 32
_VERTICES_A_ROUND = 16
"""Number of vertices with which a large hull starts, and that each round adds: those farthest outside the hull so far.
"""

_FLAT = 1e-12
"""Heights above a face are roundoff below this, relative to the size of the points."""

_MERGED = 1e-6
"""Normals and edge directions that differ by less are one."""


class Kind(enum.Enum):
    """Core shape from which a geom's distances are computed."""

    SEGMENT = enum.auto()
    BOX = enum.auto()
    CYLINDER = enum.auto()
    ELLIPSOID = enum.auto()
    HULL = enum.auto()
    PLANE = enum.auto()


KINDS = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): Kind.PLANE,
    int(mujoco.mjtGeom.mjGEOM_SPHERE): Kind.SEGMENT,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): Kind.SEGMENT,
    int(mujoco.mjtGeom.mjGEOM_BOX): Kind.BOX,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): Kind.CYLINDER,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): Kind.ELLIPSOID,
    int(mujoco.mjtGeom.mjGEOM_MESH): Kind.HULL,
}
"""Kind of each of MuJoCo's geom types; other types have no distance here."""


class UnitCore(NamedTuple):
    """A core before it is scaled, turned and moved.

    Attributes:
        vertices: (v, 3)
        normals: of its faces, each or its opposite. (f, 3)
        edges: directions of its edges, each or its opposite. (e, 3)
        radius: of the ball that is added to it. ()
    """

    vertices: Float[np.ndarray, "v 3"] | Array
    normals: Float[np.ndarray, "f 3"] | Array
    edges: Float[np.ndarray, "e 3"] | Array
    radius: Float[np.ndarray, ""] | Array = np.zeros(())


@cache
def unit_core(kind: Kind) -> UnitCore:
    """Return the core that shapes of a kind share; a hull has its own."""
    if kind is Kind.SEGMENT:
        ends = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
        return UnitCore(ends, np.zeros((0, 3)), ends[1:])
    if kind is Kind.BOX:
        corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), -1).reshape(-1, 3)
        return UnitCore(corners, np.eye(3), np.eye(3))
    return convex_hull(prism() if kind is Kind.CYLINDER else round_polyhedron(1))


def convex_hull(points: np.ndarray) -> UnitCore:
    """Return the hull of points that do not lie in a plane.

    A hull of more than ``MOST_VERTICES`` vertices is covered by one of fewer vertices and a radius around it.

    Args:
        points: [m]. (k, 3)

    Raises:
        ValueError: the points lie in a plane, or are not finite.
    """
    hull = qhull(points)
    outermost = hull.points[hull.vertices]
    radius = 0.0
    if len(outermost) > MOST_VERTICES:
        hull = thinned(outermost, MOST_VERTICES)
        radius = reach_outside(outermost, hull)
    faces, normals = hull.simplices, hull.equations[:, :3]
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    normals_of_edges = np.tile(np.arange(len(faces)), 3)
    edges = _different(_bent_edges(hull.points, np.sort(ends, axis=1), normals[normals_of_edges]))
    normals = _different(normals)
    return UnitCore(
        hull.points[hull.vertices],
        normals if len(normals) <= MOST_NORMALS else _spread_normals(),
        edges if len(edges) <= MOST_EDGES else edges[:0],
        np.asarray(radius),
    )


def qhull(points: np.ndarray) -> scipy.spatial.ConvexHull:
    """Return the convex hull of points; ValueError if they lie in a plane or are not finite."""
    try:
        return scipy.spatial.ConvexHull(np.asarray(points, float))
    except (scipy.spatial.QhullError, ValueError) as error:
        raise OsikValueError(f"these {len(points)} points have no convex hull: {str(error).splitlines()[0]}") from None


def thinned(points: np.ndarray, most: int) -> scipy.spatial.ConvexHull:
    """Return the hull of ``most`` of these vertices, chosen so that the others are only slightly outside."""
    chosen = scipy.spatial.ConvexHull(points, qhull_options=f"TA{_FIRST_VERTICES}").vertices
    hull = qhull(points[chosen])
    while len(chosen) < most:
        outside = points @ hull.equations[:, :3].T + hull.equations[:, 3]
        furthest = np.argmax(outside, 0)  # of each face
        order = np.argsort(-outside[furthest, np.arange(len(furthest))])
        new = dict.fromkeys(furthest[order].tolist())
        new = [point for point in new if point not in set(chosen.tolist())]
        room = min(_VERTICES_A_ROUND, most - len(chosen))
        if not new:
            break
        chosen = np.concatenate([chosen, new[:room]])
        hull = qhull(points[chosen])
    return hull


def reach_outside(points: np.ndarray, hull: scipy.spatial.ConvexHull) -> float:
    """Return the largest distance of a point to the hull [m].

    The face whose plane a point is furthest above need not be the nearest one: triangles of a flat side share a plane.
    """
    height = (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(1)
    outside = points[height > _FLAT * np.ptp(points)]
    squares = np.full(len(outside), np.inf)
    for corners in hull.points[hull.simplices]:
        squares = np.minimum(squares, _squares_to_triangles(outside, np.broadcast_to(corners, (len(outside), 3, 3))))
    return float(np.sqrt(squares.max(initial=0.0)))


def _squares_to_triangles(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the squared distance of each point (k, 3) to its triangle (k, 3, 3)."""
    ends = np.roll(corners, -1, axis=1) - corners
    arms = points[:, None] - corners
    share = np.clip((arms * ends).sum(-1) / np.maximum((ends * ends).sum(-1), 1e-300), 0.0, 1.0)
    to_edges = np.square(arms - share[..., None] * ends).sum(-1).min(1)
    normal = np.cross(ends[:, 0], ends[:, 1])
    inside = (np.cross(normal[:, None], ends) * arms).sum(-1) >= 0.0
    height = np.square((arms[:, 0] * normal).sum(-1)) / np.maximum(np.square(normal).sum(-1), 1e-300)
    return np.where(inside.all(1), height, to_edges)


@cache
def _spread_normals() -> np.ndarray:
    """Return 40 evenly spread directions: the face normals of the polyhedron that stands for an ellipsoid."""
    return _different(scipy.spatial.ConvexHull(round_polyhedron(1)).equations[:, :3])


def padded(cores: Sequence[UnitCore]) -> UnitCore:
    """Return the cores stacked and padded to one size by repeating rows; either all have edges or none has."""
    complete = all(len(core.edges) for core in cores)
    whole = [core if complete else core._replace(edges=np.zeros((0, 3))) for core in cores]
    array = jnp if any(isinstance(core.radius, jax.Array) for core in cores) else np
    vertices, normals, edges = (_of_one_length([core[k] for core in whole]) for k in range(3))
    return UnitCore(vertices, normals, edges, array.stack([core.radius for core in cores]))


def scaling(kinds: Sequence[Kind]) -> tuple[np.ndarray, np.ndarray]:
    """Return which of MuJoCo's sizes scale x, y, z of a unit core (k, 3), and whether size 0 is a radius (k,)."""
    entries = {Kind.SEGMENT: (1, 1, 1), Kind.CYLINDER: (0, 0, 1)}
    return np.array([entries.get(kind, (0, 1, 2)) for kind in kinds]), np.array([k is Kind.SEGMENT for k in kinds])


def world_cores(
    kinds: Sequence[Kind],
    unit: UnitCore,
    size: Float[Array, "k 3"],
    position: Float[Array, "k 3"],
    rotation: Float[Array, "k 3 3"],
) -> Core:
    """Return the cores of shapes of MuJoCo's sizes, placed in the world; all with a leading axis."""
    entries, rounded = scaling(kinds)
    vertices, normals, edges, radius = (jnp.asarray(rows, size.dtype) for rows in unit)
    x, y, z = (size[np.arange(len(kinds)), entries[:, i], None] for i in range(3))
    factors, areas = jnp.stack([x, y, z], -1), jnp.stack([y * z, x * z, x * y], -1)
    turn = rotation[:, None]
    return Core(
        position[:, None] + rotate(turn, vertices * factors),
        rotate(turn, unit_rows(normals * areas)),
        rotate(turn, edges * factors),
        jnp.where(rounded, size[:, 0], radius * greatest(jnp.abs(factors[:, 0]))),
    )


def unit_rows(rows: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """Return the rows scaled to length 1; rows of length 0 stay 0, with derivatives 0."""
    square = jnp.sum(rows * rows, -1, keepdims=True)
    is_zero = square == 0.0
    return jnp.where(is_zero, 0.0, rows / jnp.sqrt(jnp.where(is_zero, 1.0, square)))


def prism() -> np.ndarray:
    """Return a prism around the cylinder of radius 1 between z = -1 and 1."""
    angle = 2.0 * np.pi * np.arange(CYLINDER_SIDES) / CYLINDER_SIDES
    ring = np.stack([np.cos(angle), np.sin(angle)], -1) / np.cos(np.pi / CYLINDER_SIDES)
    return np.concatenate([np.insert(ring, 2, z, axis=1) for z in (-1.0, 1.0)])


def round_polyhedron(halvings: int) -> np.ndarray:
    """Return the corners of a polyhedron around the unit ball: an icosahedron with its edges halved some times."""
    golden = 0.5 * (1.0 + np.sqrt(5.0))
    corners = [(0.0, a, b * golden) for a in (-1.0, 1.0) for b in (-1.0, 1.0)]
    points = np.array([np.roll(corner, k) for corner in corners for k in range(3)])
    for _ in range(halvings):
        faces = scipy.spatial.ConvexHull(points).simplices
        ends = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2), axis=1), axis=0)
        points = np.concatenate([points, points[ends].sum(1)])
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points / -scipy.spatial.ConvexHull(points).equations[:, 3].max()


def _bent_edges(points: np.ndarray, ends: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the directions of the edges whose two triangles are not in one plane; each edge is given twice."""
    order = np.lexsort(ends.T)
    ends, normals = ends[order].reshape(-1, 2, 2)[:, 0], normals[order].reshape(-1, 2, 3)
    bent = np.linalg.norm(normals[:, 0] - normals[:, 1], axis=1) > _MERGED
    along = np.diff(points[ends[bent]], axis=1)[:, 0]
    return along / np.linalg.norm(along, axis=1, keepdims=True)


def _different(directions: np.ndarray) -> np.ndarray:
    """Return unit vectors without repetitions of an earlier vector or its opposite."""
    apart = np.linalg.norm(directions[:, None] - directions, axis=-1)
    opposite = np.linalg.norm(directions[:, None] + directions, axis=-1)
    repeats = np.tril(np.minimum(apart, opposite) <= _MERGED, -1).any(1)
    return directions[~repeats].reshape(-1, 3)


def _of_one_length(parts: Sequence[Float[np.ndarray, "_ 3"] | Array]) -> Float[np.ndarray, "k n 3"] | Array:
    longest = max(map(len, parts))
    array = jnp if any(isinstance(part, jax.Array) for part in parts) else np
    rows = [np.minimum(np.arange(longest), max(len(part) - 1, 0)) for part in parts]
    return array.stack(
        [part[index] if len(part) else array.zeros((longest, 3)) for part, index in zip(parts, rows, strict=True)]
    )
