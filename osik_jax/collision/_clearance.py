"""Whether configurations are free, and the distances of their nearest pairs."""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._errors import OsikValueError
from ..execution._computed import in_shared_lanes
from ..kinematics import forward_kinematics
from ..numerics._host import is_traced
from ..robot import Robot
from ._core import CoreRobot, CoreScene, are_free, check_length, core_robot, core_scene, gaps_at, require_core
from ._robot_shapes import Given, robot_shapes
from ._table import RobotShapes


class Clearance(eqx.Module):
    """The nearest pairs of shapes at many configurations.

    Attributes:
        distance: signed distance of the nearest pair [m]; infinite if there is no pair. (...)
        pair: numbers of its two shapes in ``names``. (..., 2)
        names: of the robot's shapes, then of the scene's; empty inside ``jit`` (static).
    """

    distance: Float[Array, "*n"]
    pair: Int[Array, "*n 2"]
    names: tuple[str, ...] = eqx.field(default=(), static=True)

    def pair_names(self, *index: int) -> tuple[str, str]:
        """Return the names of the nearest pair at a configuration, whose index is given where there are many."""
        first, second = np.asarray(self.pair)[index]
        return self.names[first], self.names[second]


def clearance(
    robot: Robot, q: Float[Array, "*n nq"], scene: Any, *, srdf: Given = None
) -> Clearance:
    """Return the signed distance of the nearest pair of shapes, of the robot with itself and with a scene.

    The derivative of ``distance`` is that of the nearest points, with respect to q and to the scene's poses. A depth of
    shapes that overlap is the length of a translation that separates them. Distances are exact for the convex shapes;
    a mesh counts as its convex hull.

    Args:
        robot: the robot; its numbers are known, not traced.
        q: configurations. (..., nq)
        scene: a ``Scene``, or as many as there are configurations.
        srdf: pairs that may touch, as for ``inverse_kinematics``.

    Raises:
        OsikError: no compiled core, or no CPU.
        ValueError: numbers of scenes and configurations that do not go together; q of another length.
    """
    shapes, q, lead = _prepared(robot, q, scene, srdf, "clearance")
    distance, pair = (_jitted if not is_traced((q, scene)) else distances)(robot, shapes, q, scene)
    names = () if is_traced((q, scene)) else (*shapes.names, *row_names(scene, 0))
    return Clearance(distance.reshape(lead), pair.reshape(*lead, 2), names)


def is_free(
    robot: Robot,
    q: Float[Array, "*n nq"],
    scene: Any,
    clearance: Float[Array, ""] | float = 0.0,
    *,
    srdf: Given = None,
) -> Bool[Array, "*n"]:
    """Return whether all pairs of shapes keep ``clearance`` [m] at each configuration. (...)

    Arguments and errors as in ``osik_jax.clearance``.
    """
    shapes, q, lead = _prepared(robot, q, scene, srdf, "is_free")
    least = jnp.reshape(jnp.asarray(clearance, q.dtype), (1,))
    own, arrays = core_robot(robot, shapes), core_scene(scene, shapes)
    return _free(own, jax.lax.stop_gradient((q, arrays, least))).reshape(lead)


@jax.jit
def _free(own: CoreRobot, given: tuple[Array, CoreScene, Array]) -> Bool[Array, " lanes"]:
    q, scene, least = given
    return _in_lanes(q, scene, partial(_are_free, own), least)


def _are_free(own: CoreRobot, q: Array, scene: CoreScene, least: Array) -> Array:
    return are_free(own, q, scene, least)


def _in_lanes(q: Array, scene: CoreScene, call: Any, *more: Array) -> Any:
    """Return what a method of the core says of each configuration, with a rule for ``vmap``."""
    one = in_shared_lanes(lambda q, scene, *more: call(q, CoreScene(*scene), *more))
    own = tuple(scene)
    if len(scene.integers) == 1:
        return jax.vmap(one, (0, None, *[None] * len(more)))(q, tuple(a[0] for a in own), *(a[0] for a in more))
    return jax.vmap(one, (0, 0, *[None] * len(more)))(q, own, *(a[0] for a in more))


def _prepared(robot: Robot, q: Any, scene: Any, srdf: Given, what: str) -> tuple[RobotShapes, Array, tuple[int, ...]]:
    """Return the robot's shapes, the configurations as (lanes, nq), and their leading axes."""
    require_core(what)
    q = jnp.asarray(q, robot.q0.dtype)
    if q.ndim == 0 or q.shape[-1] != robot.nq:
        raise OsikValueError(f"q has shape {q.shape}; the last axis has the robot's {robot.nq} entries")
    shapes, lead, q = robot_shapes(robot, srdf), q.shape[:-1], q.reshape(-1, robot.nq)
    scenes = scene.table.kind.shape[0] if np.ndim(scene.table.kind) == 2 else 1
    if scenes > 1 and lead == ():
        q, lead = jnp.broadcast_to(q, (scenes, robot.nq)), (scenes,)
    check_length(core_scene(scene, shapes), len(q), "configurations")
    return shapes, q, lead


def distances(robot: Robot, shapes: RobotShapes, q: Float[Array, "lanes nq"], scene: Any) -> tuple[Array, Array]:
    """Return the distance of the nearest pair at each configuration, with its derivative, and the pair's numbers."""
    return _distances(robot, core_robot(robot, shapes), shapes.bodies, q, core_scene(scene, shapes), scene)


def _jitted(robot: Robot, shapes: RobotShapes, q: Array, scene: Any) -> tuple[Array, Array]:
    given = core_robot(robot, shapes), shapes.bodies, q, core_scene(scene, shapes), (scene.table, scene.body)
    return _program(robot, *given)


def _distances(
    robot: Robot, own: CoreRobot, bodies: Array, q: Array, arrays: CoreScene, scene: Any
) -> tuple[Array, Array]:
    table, carrying = (scene.table, scene.body) if hasattr(scene, "table") else scene
    gaps = _in_lanes(*jax.lax.stop_gradient((q, arrays)), partial(gaps_at, own))
    many = np.ndim(table.kind) == 2 and len(table.kind) > 1
    rows = [jnp.asarray(a) if many or np.ndim(table.kind) == 1 else jnp.asarray(a)[0] for a in (table.position, table.rotation)]
    rows.append(jnp.broadcast_to(jnp.asarray(carrying), np.shape(table.kind)) if many else jnp.reshape(jnp.asarray(carrying), -1))
    lane = partial(_moved, robot, jnp.asarray(bodies))
    moved = jax.vmap(lane, (0, 0, 0, 0, *[0 if many else None] * 3))(q, gaps.points, gaps.normal, gaps.pair, *rows)
    known = jnp.isfinite(gaps.distance)
    return jnp.where(known, gaps.distance + jnp.where(known, moved - jax.lax.stop_gradient(moved), 0.0), jnp.inf), gaps.pair


_program = jax.jit(_distances)


def _moved(
    robot: Robot,
    bodies: Int[Array, " shapes"],
    q: Float[Array, " nq"],
    points: Float[Array, "2 3"],
    normal: Float[Array, "3"],
    pair: Int[Array, "2"],
    position: Float[Array, "rows 3"],
    rotation: Float[Array, "rows 3 3"],
    carrying: Int[Array, " rows"],
) -> Float[Array, ""]:
    """Return ``normal' (b - a)`` of the nearest points a and b, which go along with their shapes.

    Its derivative is that of the distance: to first order nearest points slide along the surfaces.
    """
    kinematics = forward_kinematics(robot, q)
    count = len(bodies)
    row = jnp.clip(pair - count, 0, max(len(position) - 1, 0))
    is_row = pair >= count
    carrier = jnp.where(is_row, carrying[row], bodies[jnp.clip(pair, 0, count - 1)]) if len(position) else bodies[pair]
    turn, at = kinematics.body_rotation[carrier], kinematics.body_position[carrier]
    if len(position):
        fixed = carrier < 0
        turn = jnp.where(fixed[:, None, None], jnp.eye(3, dtype=q.dtype), turn)
        at = jnp.where(fixed[:, None], 0.0, at)
        inner = jnp.where(is_row[:, None, None], rotation[row], jnp.eye(3, dtype=q.dtype))
        turn, at = turn @ inner, at + jnp.einsum("kij,kj->ki", turn, jnp.where(is_row[:, None], position[row], 0.0))
    stopped = jax.lax.stop_gradient((turn, at))
    local = jnp.einsum("kji,kj->ki", stopped[0], points - stopped[1])
    here = at + jnp.einsum("kij,kj->ki", turn, local)
    return jnp.dot(normal, here[1] - here[0])


def row_names(scene: Any, index: int) -> tuple[str, ...]:
    """Return the names of a scene's rows; ``index``: which scene, where there are many."""
    del index
    return tuple(scene.names)


def shape_names(shapes: RobotShapes, scene: Any, pair: np.ndarray, index: int) -> tuple[str, str]:
    """Return the names of a pair of shapes; ``index``: which scene, where there are many."""
    if pair[0] < 0:
        return "nothing", "nothing"
    rows, count = row_names(scene, index), len(shapes.names)
    first, second = (shapes.names[k] if k < count else rows[k - count] for k in pair)
    return first, second
