"""Base poses: targets and scenes in the axes of each base, and whether a base stands free."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._errors import OsikTypeError, OsikValueError
from ..collision import Scene
from ..collision._core import core_robot, core_scene, gaps_at
from ..collision._robot_shapes import Given, robot_shapes
from ..collision._scene import Labels, _with
from ..collision._table import ConvexShape, RobotShapes, shape_table
from ..kinematics._rigid import compose, rotate
from ..numerics._host import Numbers, module_of
from ..robot import Robot

AXES = ("x", "y", "yaw", "height")
"""Coordinates of a base, in the order of the grid's axes."""
_ROUNDING = 1e-6
"""Largest error of distances by rounding [m]."""


def checked_axis(name: str, given: Any) -> Float[np.ndarray, " n"]:
    """Return the coordinates of a grid along one axis, checked."""
    try:
        axis = np.atleast_1d(np.asarray(given, float))
    except (TypeError, ValueError):
        raise OsikTypeError(
            f"{name} is {type(given).__name__}; it is numbers, such as np.linspace(-1, 1, 11)"
        ) from None
    if axis.ndim != 1 or not axis.size or not np.isfinite(axis).all() or (np.diff(axis) <= 0.0).any():
        raise OsikValueError(f"{name} is {given!r}; it is finite numbers that increase, such as [0.0, 0.1]")
    return axis


def grid_bases(axes: Sequence[np.ndarray]) -> Float[np.ndarray, "n 4"]:
    """Return all bases of a grid: x [m], y [m], yaw [rad], height [m]."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(AXES))


def base_poses(bases: Float[Numbers, "n 4"]) -> tuple[Float[Numbers, "n 3"], Float[Numbers, "n 3 3"]]:
    """Return position [m] and rotation (base axes to world axes) of bases."""
    numbers = module_of(bases)
    cos, sin, zero = numbers.cos(bases[:, 2]), numbers.sin(bases[:, 2]), numbers.zeros(len(bases))
    rows = (cos, -sin, zero), (sin, cos, zero), (zero, zero, zero + 1.0)
    return bases[:, [0, 1, 3]], numbers.stack([numbers.stack(row, -1) for row in rows], -2)


def in_bases(bases: Float[Numbers, "n 4"], position: Any, rotation: Any) -> tuple[Numbers, Numbers]:
    """Return poses in the axes of each base, from the world's: (k, 3) [m] and (k, 3, 3), or those of each base."""
    origin, turn = base_poses(bases)
    inverse = turn.swapaxes(-1, -2)[:, None]
    return rotate(inverse, position - origin[:, None]), compose(inverse, rotation)


def scenes_in_bases(scene: Scene, bases: Float[np.ndarray, "n 4"]) -> Scene:
    """Return a stack of the scene in the axes of each base; held objects stay in their hands."""
    count, table = len(bases), scene.table
    given, held = [np.asarray(part) for part in (table.position, table.rotation)], np.asarray(scene.body) >= 0
    moved = in_bases(bases, *given)
    position = np.where(held[:, None], given[0], moved[0])
    rotation = np.where(held[:, None, None], given[1], moved[1])
    parts = table, scene.body, scene.contact, scene.among
    table, body, contact, among = jax.tree.map(lambda a: np.broadcast_to(a, (count, *np.shape(a))), parts)
    labels = Labels((scene.labels.names,) * count, (scene.labels.objects,) * count)
    table = table._replace(position=position, rotation=rotation)
    return _with(scene, table=table, body=body, contact=contact, among=among, labels=labels)


def base_clearances(
    robot: Robot, bases: Float[np.ndarray, "n 4"], scene: Scene, srdf: Given, footprint: Sequence[ConvexShape]
) -> tuple[Float[np.ndarray, " n"], list[tuple[str, str]]]:
    """Return the distance from the scene to the shapes that stand with each base [m], and the nearest object and link.

    These are the robot's shapes that no joint moves, and the footprint; infinite if there are none. ``Scene.allow``
    says what may touch them.
    """
    shapes = _fixed_shapes(robot_shapes(robot, srdf), footprint)
    distance, pairs = shape_clearances(robot, bases, scene, shapes, robot.q0)
    objects, links = scene.labels.objects, shapes.links
    return distance, [
        (objects[max(pair) - len(links)], links[min(pair)]) if min(pair) >= 0 else ("", "") for pair in pairs
    ]


def stands_free(gap: Any, clearance: Any) -> Any:
    """Return whether bases stand free; those that touch within rounding all do not."""
    return gap >= clearance + _ROUNDING


def shape_clearances(
    robot: Robot, bases: Float[np.ndarray, "n 4"], scene: Scene, shapes: RobotShapes, q: Any
) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, "n 2"]]:
    """Return the distance of the nearest pair of shapes at each base [m], and its numbers; q is (n, nq) or (nq,)."""
    q = np.broadcast_to(q, (len(bases), robot.nq))
    near = gaps_at(core_robot(robot, shapes), jnp.asarray(q), core_scene(scenes_in_bases(scene, bases), shapes))
    return np.asarray(near.distance), np.asarray(near.pair)


def _fixed_shapes(shapes: RobotShapes, footprint: Sequence[ConvexShape]) -> RobotShapes:
    """Return the shapes so that those that no joint moves, and the footprint, meet the scene, and nothing else does."""
    more = shape_table(footprint)
    count, table = len(more.kind), shapes.table
    more = more._replace(first=more.first + len(table.vertices))
    return shapes._replace(
        names=(*shapes.names, *(f"footprint:{k}" for k in range(count))),
        links=(*shapes.links, *["footprint"] * count),
        bodies=np.concatenate([shapes.bodies, np.zeros(count, np.int32)]),
        table=jax.tree.map(lambda a, b: np.concatenate([a, b]), table, more),
        pairs=np.zeros((0, 2), np.int32),
        world=np.concatenate([~shapes.world, np.ones(count, bool)]),
    )
