"""Obstacles of a page: the shapes that a ``CollisionAvoidanceLimit`` has in its scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from ...collision._core import core_scene, gaps_at
from ...collision._table import ShapeKind, table_shapes
from ...limits import CollisionAvoidanceLimit, Limit
from .._parts import Part

_GEOM = mujoco.mjtGeom
_KINDS = {
    ShapeKind.SPHERE: _GEOM.mjGEOM_SPHERE,
    ShapeKind.CAPSULE: _GEOM.mjGEOM_CAPSULE,
    ShapeKind.CYLINDER: _GEOM.mjGEOM_CYLINDER,
    ShapeKind.BOX: _GEOM.mjGEOM_BOX,
    ShapeKind.HULL: _GEOM.mjGEOM_MESH,
}


class Obstacle(NamedTuple):
    """Draggable shape of the world."""

    name: str  # in its limit
    part: Part  # how it looks
    position: Float[np.ndarray, "3"]  # of its middle [m]
    rotation: Float[np.ndarray, "3 3"]  # from its axes to the world's


class NearestPair(NamedTuple):
    """The nearest pair of shapes of a limit's scene."""

    names: tuple[str, str]
    distance: float  # [m]
    kept: float  # distance that the limit keeps [m]
    points: Float[np.ndarray, "2 3"]  # nearest points of both [m]


def obstacles_in(limits: Sequence[Limit]) -> dict[str, Obstacle]:
    """Return the obstacles by name."""
    return {one.name: one for limit in limits for one in _in_scene(limit)}


def _in_scene(limit: Limit) -> Iterator[Obstacle]:
    """Return the shapes of a limit's scene that nothing carries, but half spaces."""
    scene = limit.scene if isinstance(limit, CollisionAvoidanceLimit) else None
    if scene is None:
        return
    for name, body, shape in zip(scene.names, np.asarray(scene.body), table_shapes(scene.table), strict=False):
        if shape.kind in _KINDS and body < 0:
            mesh = _hull(np.asarray(shape.vertices, float).tobytes()) if shape.kind == ShapeKind.HULL else None
            part = Part(_KINDS[shape.kind], shape.size, np.ones(4), mesh)
            yield Obstacle(name, part, shape.position, shape.rotation)


@lru_cache
def _hull(vertices: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a hull, once for all poses that it is dragged to."""
    from trimesh.convex import convex_hull  # comes with viser

    hull = convex_hull(np.unique(np.frombuffer(vertices).reshape(-1, 3), axis=0))
    return np.asarray(hull.vertices), np.asarray(hull.faces)


def nearest_pair(limits: Sequence[Limit], q: Float[np.ndarray, " nq"]) -> NearestPair | None:
    """Return the nearest of the pairs that limits with a scene keep apart and see, if there is one."""
    found: NearestPair | None = None
    for limit in limits:
        if not isinstance(limit, CollisionAvoidanceLimit) or limit.kept is None or limit.scene is None:
            continue
        shapes = limit.kept.shapes
        one = gaps_at(limit.kept.core, jnp.asarray(q)[None], core_scene(limit.scene, shapes))
        gaps = jax.tree.map(lambda a: np.asarray(a)[0], one)
        if gaps.distance < (float(limit.detection_distance) if found is None else found.distance):
            names = (*shapes.names, *limit.scene.names)
            pair = names[gaps.pair[0]], names[gaps.pair[1]]
            found = NearestPair(pair, float(gaps.distance), float(limit.minimum_distance), gaps.points)
    return found


def moved(
    limits: Sequence[Limit], name: str, position: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "3 3"]
) -> tuple[Limit, ...]:
    """Return the limits with an obstacle moved."""

    def one(limit: Limit) -> Limit:
        if not isinstance(limit, CollisionAvoidanceLimit) or limit.scene is None or name not in limit.scene.names:
            return limit
        return limit.replace(scene=limit.scene.moved(name, (position, rotation)))

    return tuple(one(limit) for limit in limits)
