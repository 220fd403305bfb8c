"""Obstacles of a page: the balls and boxes that a ``CollisionAvoidanceLimit`` has in the world or in its scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from ...collision._geometry import Kind
from ...collision._table import ShapeKind
from ...limits import CollisionAvoidanceLimit, Limit
from ...numerics._host import replaced_at


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


def _with_scene(limit: CollisionAvoidanceLimit, name: str, **changes: Float[np.ndarray, "..."]) -> Limit:
    """Return the limit with an obstacle of its scene moved or resized."""
    one, scene = next(one for one in _in_scene(limit) if one.name == name)._replace(**changes), limit.scene
    assert scene is not None
    scene, row = scene.moved(name, (one.position, one.rotation)), scene.names.index(name)
    size = replaced_at(scene.table.size, row, one.size)
    return limit.replace(scene=eqx.tree_at(lambda scene: scene.table.size, scene, size))


def moved(limits: Sequence[Limit], name: str, **changes: Float[np.ndarray, "..."]) -> tuple[Limit, ...]:
    """Return the limits with an obstacle moved or resized."""
    return tuple(
        limit.moved(name, **changes)
        if isinstance(limit, CollisionAvoidanceLimit) and name in limit.layout.names[len(limit.layout.geoms) :]
        else _with_scene(limit, name, **changes)
        if isinstance(limit, CollisionAvoidanceLimit) and any(one.name == name for one in _in_scene(limit))
        else limit
        for limit in limits
    )
