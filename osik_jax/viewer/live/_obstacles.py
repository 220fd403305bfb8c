"""Obstacles of a page: the balls and boxes that a ``CollisionAvoidanceLimit`` has in the world or in its scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ...collision._geometry import Kind
from ...collision._table import ShapeKind
from ...limits import CollisionAvoidanceLimit, Limit


class Obstacle(NamedTuple):
    """Draggable shape of the world."""

    name: str  # in its limit
    kind: str  # ball or box
    position: Float[np.ndarray, "3"]  # of its middle [m]
    rotation: Float[np.ndarray, "3 3"]  # from its axes to the world's
    size: Float[np.ndarray, "3"]  # of a ball, the radius first; of a box, half its edges [m]


def obstacles_in(limits: Sequence[Limit]) -> dict[str, Obstacle]:
    """Return the obstacles by name."""
    return {one.name: one for limit in limits for one in (*_added(limit), *_in_scene(limit))}


def _added(limit: Limit) -> Iterator[Obstacle]:
    """Return the balls and boxes that were added to a collision limit in the world."""
    if not isinstance(limit, CollisionAvoidanceLimit):
        return
    layout, own = limit.layout, len(limit.layout.geoms)
    places = tuple(
        np.asarray(part, float) for part in (limit.shapes.position, limit.shapes.rotation, limit.shapes.size)
    )
    for number, name in enumerate(layout.names[own:]):
        position, rotation, size = (part[number] for part in places)
        kind = {Kind.SEGMENT: "ball", Kind.BOX: "box"}.get(layout.kinds[own + number])
        if layout.bodies[own + number] == 0 and kind and not (kind == "ball" and size[1] > 0.0):
            yield Obstacle(name, kind, position, rotation, size)


def _in_scene(limit: Limit) -> Iterator[Obstacle]:
    """Return the balls and boxes of a limit's scene that nothing carries."""
    scene = limit.scene if isinstance(limit, CollisionAvoidanceLimit) else None
    if scene is None:
        return
    kinds, table = {ShapeKind.SPHERE: "ball", ShapeKind.BOX: "box"}, jax.tree.map(np.asarray, scene.table)
    for row, name in enumerate(scene.names):
        kind = kinds.get(ShapeKind(int(table.kind[row])))
        if kind and int(scene.body[row]) < 0:
            yield Obstacle(name, kind, table.position[row], table.rotation[row], table.size[row])


def moved(
    limits: Sequence[Limit], name: str, position: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "3 3"]
) -> tuple[Limit, ...]:
    """Return the limits with an obstacle moved."""

    def one(limit: Limit) -> Limit:
        if not isinstance(limit, CollisionAvoidanceLimit):
            return limit
        if name in limit.layout.names[len(limit.layout.geoms) :]:
            return limit.moved(name, position=position, rotation=rotation)
        if limit.scene is None or name not in limit.scene.names:
            return limit
        return limit.replace(scene=limit.scene.moved(name, (position, rotation)))

    return tuple(one(limit) for limit in limits)
