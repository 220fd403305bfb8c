"""Obstacles of a page, and the limits that avoid them and self-collision.

Obstacles are the world's shapes of the session's ``CollisionAvoidanceLimit``s, and the balls and boxes of their scenes.
The limit that the page adds has a fixed number of each kind. Unused ones are far below the floor, so adding, moving and
removing one compiles nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import NamedTuple

import equinox as eqx
import jax
import mujoco
import numpy as np
from jaxtyping import Float

from ..._errors import OsikValueError
from ...collision import CollisionShape
from ...collision._geometry import Kind
from ...collision._pairs import candidate_pairs, members
from ...collision._table import ShapeKind
from ...limits import CollisionAvoidanceLimit, Limit
from ...numerics._host import replaced_at
from ...robot import Robot
from ...robot._mujoco import mujoco_frame_pose, mujoco_poses

SLOTS = {"ball": 3, "box": 3}
"""Number of obstacles of each kind that a page may have."""
MARGIN = 0.01
"""Least distance to obstacles, and of links that are farther apart at the start [m]."""
PARKED = np.array([0.0, 0.0, -1e3])
"""Position of obstacles out of use [m]."""
_ROWS = 12


class Obstacle(NamedTuple):
    """Draggable shape of the world."""

    name: str  # in its limit
    kind: str  # ball or box
    position: Float[np.ndarray, "3"]  # of its middle [m]
    rotation: Float[np.ndarray, "3 3"]  # from its axes to the world's
    size: Float[np.ndarray, "3"]  # of a ball, the radius first; of a box, half its edges [m]


def obstacles_in(limits: Sequence[Limit]) -> dict[str, Obstacle]:
    """Return the obstacles in use by name."""
    own = (one for limit in limits for one in (*_slots(limit), *_in_scene(limit)))
    return {one.name: one for one in own if not _is_parked(one)}


def free_slot(limits: Sequence[Limit], kind: str) -> str | None:
    """Return the name of an unused obstacle of a kind, or None."""
    parked = (one.name for limit in limits for one in _slots(limit) if one.kind == kind and _is_parked(one))
    return next(parked, None)


def keeps_off_world(limit: Limit) -> bool:
    """Return whether a limit has obstacles of a page, used or not."""
    return any(True for _ in _slots(limit))


def _is_parked(one: Obstacle) -> bool:
    return bool(one.position[2] < 0.5 * PARKED[2])


def _slots(limit: Limit) -> Iterator[Obstacle]:
    """Return the balls and boxes that a collision limit has in the world, whether in use or put away."""
    if not isinstance(limit, CollisionAvoidanceLimit):
        return
    scene, own = limit.layout, len(limit.layout.geoms)
    places = tuple(
        np.asarray(part, float) for part in (limit.shapes.position, limit.shapes.rotation, limit.shapes.size)
    )
    for number, name in enumerate(scene.names[own:]):
        position, rotation, size = (part[number] for part in places)
        kind = {Kind.SEGMENT: "ball", Kind.BOX: "box"}.get(scene.kinds[own + number])
        if scene.bodies[own + number] == 0 and kind and not (kind == "ball" and size[1] > 0.0):
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


def world_limit(robot: Robot, covers: Mapping[str, CollisionShape], size: float) -> CollisionAvoidanceLimit:
    """Return the limit between links and obstacles, with all obstacles out of use; ``size`` is the robot's [m]."""
    edge = 0.06 * size
    slots = {f"ball {number + 1}": CollisionShape.sphere(edge, PARKED) for number in range(SLOTS["ball"])}
    slots |= {f"box {number + 1}": CollisionShape.box((edge, edge, edge), PARKED) for number in range(SLOTS["box"])}
    pairs, shapes = list(product(slots, covers)), {**covers, **slots}
    return CollisionAvoidanceLimit(
        robot, pairs=pairs, shapes=shapes, minimum_distance=MARGIN, q0_distance=-np.inf, max_pairs=_ROWS
    )


def own_limit(
    robot: Robot, covers: Mapping[str, CollisionShape], q: Float[np.ndarray, " nq"]
) -> CollisionAvoidanceLimit:
    """Return the limit of self-collision, without pairs that are too near at q, such as links two joints apart."""
    found = members(robot, covers)[len(robot.tree.geom_names) :]
    model, data = _as_model(robot, covers, q)
    kept = [
        (found[i].name, found[j].name)
        for i, j in candidate_pairs(robot, found, None, ())
        # MuJoCo computes distances up to its cutoff, which only has to exceed the margin
        if mujoco.mj_geomDistance(model, data, i, j, 10.0 * MARGIN, None) > MARGIN
    ]
    if not kept:
        raise OsikValueError("no two links of this robot are apart where it starts")
    return CollisionAvoidanceLimit(
        robot, pairs=kept, shapes=covers, minimum_distance=MARGIN, q0_distance=-np.inf, max_pairs=_ROWS
    )


def _as_model(
    robot: Robot, covers: Mapping[str, CollisionShape], q: Float[np.ndarray, " nq"]
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return a MuJoCo model of the shapes at q, as geoms in their order."""
    spec, posed = mujoco.MjSpec(), next(mujoco_poses(robot, q))
    for shape in covers.values():
        position, rotation = mujoco_frame_pose(robot, posed, str(shape.frame))
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, (rotation @ np.asarray(shape.rotation, float)).ravel())
        kind = mujoco.mjtGeom.mjGEOM_BOX if shape.kind is Kind.BOX else mujoco.mjtGeom.mjGEOM_CAPSULE
        place = position + rotation @ np.asarray(shape.position, float)
        spec.worldbody.add_geom(type=kind, size=np.asarray(shape.size, float), pos=place, quat=quaternion)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return model, data
