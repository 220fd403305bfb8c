"""Support polygon of a standing robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy  # loads its parts when they are used
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from .._errors import OsikTypeError, OsikValueError
from ..kinematics._forward import kinematics_on_host
from ..numerics._guarded import greatest
from ..numerics._host import to_jax
from ..robot import Robot

_COLLINEAR = 1e-6


class SupportPolygon(eqx.Module):
    """Convex polygon on the ground: ``normals @ xy <= offsets`` inside. Edge i ends at vertex i + 1.

    Attributes:
        normals: unit vectors across the edges, outward. (m, 2)
        offsets: distance of each edge's line from the origin along its normal [m]. (m,)
        vertices: counter-clockwise [m]. (m, 2)
    """

    normals: Float[Array, "m 2"]
    offsets: Float[Array, " m"]
    vertices: Float[Array, "m 2"]

    def distance(self, xy: Float[Array, "... 2"] | ArrayLike) -> Float[Array, "..."]:
        """Return the distance [m] to the nearest edge, positive inside.

        Outside it is minus the largest violation of an edge's line.
        """
        return -greatest(jnp.sum(self.normals * jnp.asarray(xy)[..., None, :], -1) - self.offsets)

    def contains(self, xy: Float[Array, "... 2"] | ArrayLike) -> Bool[Array, "..."]:
        """Return whether points lie inside or on the edge."""
        return self.distance(xy) >= 0.0


def support_polygon(
    robot: Robot,
    q: Float[Array, " nq"],
    frames: Sequence[str],
    *,
    margin: float = 0.0,
    corners: Mapping[str, ArrayLike] | None = None,
) -> SupportPolygon:
    """Return the convex hull of the supporting frames' contact corners on the ground, reduced by a margin.

    Runs on the host (SciPy), outside jit. Vertices within a micrometre of the line through their neighbours are
    dropped, so that the polygon of two aligned feet has no edge twice.

    Args:
        robot: the robot.
        q: the configuration at which it stands. (nq,)
        frames: names of the frames on the ground. Their corners are the frames ``NAME_corner_0``, ``..._1`` and so on.
        margin: how far the polygon is drawn in [m].
        corners: for frames without such corners (or instead of them): points (k, 3) in the frame [m].

    Raises:
        KeyError: no such frame.
        ValueError: a frame has no corners, the corners lie on a line, or the margin leaves nothing.
    """
    given = dict(corners or {})
    for name in given:
        if name not in frames:
            raise OsikValueError(f"corners are given for {name!r}, which is not among the frames: {', '.join(frames)}")
    if isinstance(frames, str):
        raise OsikTypeError(f"frames is a sequence of names, not one string: use ({frames!r},)")
    if not margin >= 0.0:
        raise OsikValueError(f"margin is {margin}; it has to be 0 or more, in metres")
    points = np.concatenate([_ground_points(robot, q, name, given.get(name)) for name in frames] or [np.zeros((0, 2))])
    polygon = hull(points)
    if polygon is None:
        raise OsikValueError(f"the contact corners of {', '.join(frames)} span no area on the ground:\n{points}")
    drawn_in = _draw_in(polygon, margin) if margin else polygon
    if drawn_in is None:
        raise OsikValueError(
            f"a margin of {margin} m leaves nothing of the support polygon with vertices\n{polygon[2]}"
        )
    normals, offsets, vertices = (to_jax(x, robot.q0.dtype) for x in drawn_in)
    return SupportPolygon(normals, offsets, vertices)


Polygon = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Normals, offsets and vertices, as in ``SupportPolygon``."""


def _ground_points(robot: Robot, q: Array, frame: str, corners: ArrayLike | None) -> np.ndarray:
    """Return the corners of one frame, projected to the ground [m]. (k, 2)."""
    robot.tree.frame(frame)
    robot.check_configuration(q)
    kinematics = kinematics_on_host(robot, q)
    if corners is None:
        names = _corner_names(robot, frame)
        return np.asarray(kinematics.frame_poses(robot, names)[0])[:, :2]
    local = np.asarray(corners, float)
    if local.ndim != 2 or local.shape[1] != 3 or not np.isfinite(local).all():
        raise OsikValueError(f"the corners of {frame!r} are finite points (k, 3) in its frame, got shape {local.shape}")
    position, rotation = map(np.asarray, kinematics.frame_pose(robot, frame))
    return (position + local @ rotation.T)[:, :2]


def _corner_names(robot: Robot, frame: str) -> list[str]:
    known = set(robot.frame_names)
    names = []
    while f"{frame}_corner_{len(names)}" in known:
        names.append(f"{frame}_corner_{len(names)}")
    if not names:
        having = sorted(name.removesuffix("_corner_0") for name in known if name.endswith("_corner_0"))
        raise OsikValueError(
            f"frame {frame!r} has no contact corners: give corners={{{frame!r}: points (k, 3) in its frame [m]}}, or "
            f"put sites {frame}_corner_0, {frame}_corner_1, ... in the model; frames that have them: "
            f"{', '.join(having) or '(none)'}"
        )
    return names


def hull(points: np.ndarray) -> Polygon | None:
    """Return normals, offsets and vertices of the convex hull; None if its area is 0."""
    if len(points) < 3:
        return None
    try:
        vertices = points[scipy.spatial.ConvexHull(points).vertices]
    except scipy.spatial.QhullError:
        return None
    vertices = _merge_collinear(vertices)
    if len(vertices) < 3:
        return None
    edges = np.roll(vertices, -1, 0) - vertices
    # to the right of edges that go counter-clockwise: outward
    normals = np.stack([edges[:, 1], -edges[:, 0]], -1) / np.linalg.norm(edges, axis=1, keepdims=True)
    return normals, np.sum(normals * vertices, 1), vertices


def _merge_collinear(vertices: np.ndarray) -> np.ndarray:
    """Remove vertices that lie almost on the line through their neighbours, the nearest first, until none is left."""
    while len(vertices) >= 3:
        before, after = np.roll(vertices, 1, 0), np.roll(vertices, -1, 0)
        chord, arm = after - before, vertices - before
        height = np.abs(chord[:, 0] * arm[:, 1] - chord[:, 1] * arm[:, 0]) / np.linalg.norm(chord, axis=1)
        if height.min() > _COLLINEAR:
            break
        vertices = np.delete(vertices, height.argmin(), 0)
    return vertices


def _draw_in(polygon: Polygon, margin: float) -> Polygon | None:
    """Return the polygon with each edge moved inwards; edges that become redundant are dropped."""
    normals, offsets = polygon[0], polygon[1] - margin
    i, j = np.triu_indices(len(offsets), 1)
    pairs = np.stack([normals[i], normals[j]], 1)
    # nearly parallel edges have no reliable intersection
    crossing = np.abs(np.linalg.det(pairs)) > 1e-9
    points = np.linalg.solve(pairs[crossing], np.stack([offsets[i], offsets[j]], 1)[crossing][..., None])[..., 0]
    # vertices lie on their own two edges only up to rounding
    inside = (points @ normals.T <= offsets + 1e-9).all(1)
    return hull(points[inside])
