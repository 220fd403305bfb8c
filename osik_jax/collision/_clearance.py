"""Distances of the nearest pairs of shapes at configurations, and whether these are free."""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._errors import OsikTypeError, OsikValueError
from ..execution._computed import in_shared_lanes
from ..kinematics import Kinematics, forward_kinematics
from ..numerics._arguments import as_array, as_host_numbers, concrete
from ..numerics._host import is_traced
from ..robot import Robot
from ._core import (
    CoreRobot,
    CoreScene,
    Gaps,
    are_free,
    check_length,
    core_robot,
    core_scene,
    gaps_at,
    require_core,
)
from ._robot_shapes import Given, robot_shapes
from ._scene import Scene, check_scene
from ._table import RobotShapes


class Clearance(eqx.Module):
    """The nearest pairs of shapes at many configurations.

    Attributes:
        distance: signed distance of the nearest pair [m]; infinite if there is no pair. (...)
        pair: numbers of its two shapes: those of the robot come first, then the rows of the scene. (..., 2)
        names: of the robot's shapes, and of the scene's (in a stack, of each scene's); empty inside ``jit`` (static).
    """

    distance: Float[Array, "*n"]
    pair: Int[Array, "*n 2"]
    names: tuple[Any, ...] = eqx.field(default=(), static=True)

    def pair_names(self, index: int = 0) -> tuple[str, str]:
        """Return the names of the nearest pair; ``index``: of the configuration, where there are many.

        Raises:
            TypeError: this was made inside ``jit``, where names are unknown.
        """
        if not self.names:
            raise OsikTypeError("names are unknown inside jit: call osik_jax.clearance outside")
        own, rows = self.names
        return shape_names(own, rows, np.asarray(self.pair).reshape(-1, 2)[index], index)


def clearance(robot: Robot, q: Float[ArrayLike, "*n nq"], scene: Scene, *, srdf: Given = None) -> Clearance:
    """Return the signed distance of the nearest pair of shapes, of the robot with itself and with a scene.

    The derivative of ``distance`` is that of the nearest points, with respect to q and to the scene's poses. Second
    derivatives are wrong: they leave out that nearest points slide along the surfaces. Take differences of the first
    ones. A depth of shapes that overlap is the length of a translation that separates them. Distances are exact for the
    convex shapes; a mesh counts as its convex hull.

    Args:
        robot: the robot; its numbers are known, not traced.
        q: configurations. (..., nq)
        scene: a ``Scene``, or as many as there are configurations.
        srdf: pairs that may touch, as for ``inverse_kinematics``.

    Raises:
        OsikError: no compiled core for this device.
        TypeError: no scene, or q is not numbers.
        ValueError: numbers of scenes and configurations that do not go together; q of another length.
    """
    shapes, q, lead = _prepared(robot, q, scene, srdf, "clearance")
    distance, pair = distances(robot, shapes, q, scene)
    names = () if is_traced((q, scene)) else (shapes.names, scene.names)
    return Clearance(distance.reshape(lead), pair.reshape(*lead, 2), names)


def is_free(
    robot: Robot,
    q: Float[ArrayLike, "*n nq"],
    scene: Scene,
    clearance: Float[Array, ""] | float = 0.0,
    *,
    srdf: Given = None,
) -> Bool[Array, "*n"]:
    """Return whether all pairs of shapes keep ``clearance`` [m] at each configuration.

    Arguments and errors as in ``osik_jax.clearance``; a ``clearance`` below 0 is a ValueError. The result has the
    leading axes of q.
    """
    shapes, q, lead = _prepared(robot, q, scene, srdf, "is_free")
    least = jnp.asarray(checked_clearance(clearance), q.dtype)
    own, arrays = core_robot(robot, shapes), core_scene(scene, shapes)
    return _free(own, jax.lax.stop_gradient((q, arrays, least))).reshape(lead)


def checked_clearance(value: Any) -> Any:
    """Return a clearance as an array (1,); raise ValueError unless it is one number, 0 or more."""
    out = as_host_numbers(value, "clearance").astype(float)
    seen = concrete(out)
    if out.shape != () or (seen is not None and not (np.isfinite(seen) and seen >= 0.0)):
        raise OsikValueError(f"clearance is {value!r}; it is one number, 0 or more, in metres")
    return out.reshape(1)


@jax.jit
def _free(own: CoreRobot, given: tuple[Array, CoreScene, Array]) -> Bool[Array, " lanes"]:
    return _in_lanes(are_free, own, *given)


def _in_lanes(call: Any, own: CoreRobot, q: Array, scene: CoreScene, *more: Array) -> Any:
    """Return what a method of the core says of each configuration, with a rule for ``vmap``."""
    one = in_shared_lanes(call)
    each, alone = 0 if len(scene.integers) > 1 else None, jax.tree.map(lambda a: a[0], (scene, more))
    scene = scene if each == 0 else alone[0]
    return jax.vmap(one, (None, 0, each, *[None] * len(more)))(own, q, scene, *alone[1])


def _prepared(robot: Robot, q: Any, scene: Scene, srdf: Given, what: str) -> tuple[RobotShapes, Array, tuple[int, ...]]:
    """Return the robot's shapes, the configurations as (lanes, nq), and their leading axes."""
    require_core(what, on_gpu=True)
    check_scene(scene)
    q = as_array(q, "q", robot.q0.dtype)
    if q.ndim == 0 or q.shape[-1] != robot.nq:
        raise OsikValueError(f"q has shape {q.shape}; the last axis has the robot's {robot.nq} entries")
    shapes, lead, q = robot_shapes(robot, srdf), q.shape[:-1], q.reshape(-1, robot.nq)
    if scene.is_stack and lead == ():
        lead = scene.table.kind.shape[:1]
        q = jnp.broadcast_to(q, (*lead, robot.nq))
    check_length(core_scene(scene, shapes), len(q), "configurations")
    return shapes, q, lead


def distances(robot: Robot, shapes: RobotShapes, q: Float[Array, "lanes nq"], scene: Scene) -> tuple[Array, Array]:
    """Return the distance of the nearest pair at each configuration, with its derivative, and the pair's numbers."""
    gaps = _gaps(core_robot(robot, shapes), jax.lax.stop_gradient((q, core_scene(scene, shapes))))
    return differentiable(robot, shapes, q, scene, gaps), gaps.pair


@jax.jit
def _gaps(own: CoreRobot, given: tuple[Array, CoreScene]) -> Gaps:
    return _in_lanes(gaps_at, own, *given)


def differentiable(
    robot: Robot, shapes: RobotShapes, q: Float[Array, "lanes nq"], scene: Scene, gaps: Gaps
) -> Float[Array, " lanes"]:
    """Return the distances of nearest pairs at each configuration with their derivatives."""
    return _differentiable(robot, jnp.asarray(shapes.bodies), q, scene, gaps)


@jax.jit
def _differentiable(
    robot: Robot, bodies: Int[Array, " k"], q: Float[Array, "lanes nq"], scene: Scene, gaps: Gaps
) -> Float[Array, " lanes"]:
    rows: Any = scene.table.position, scene.table.rotation, scene.body
    if scene.is_stack and len(scene.body) == 1:
        rows = tuple(a[0] for a in rows)
    each = 0 if rows[2].ndim == 2 else None
    lane = partial(_moved, robot, bodies)
    moved = jax.vmap(lane, (0, 0, 0, 0, each, each, each))(q, gaps.points, gaps.normal, gaps.pair, *rows)
    slope = jnp.where(jnp.isfinite(gaps.distance), moved - jax.lax.stop_gradient(moved), 0.0)
    return gaps.distance + slope


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
    turn, at = shape_frames(forward_kinematics(robot, q), bodies, position, rotation, carrying, pair)
    stopped = jax.lax.stop_gradient((turn, at))
    local = jnp.einsum("kji,kj->ki", stopped[0], points - stopped[1])
    here = at + jnp.einsum("kij,kj->ki", turn, local)
    return jnp.dot(normal, here[1] - here[0])


def shape_frames(
    kinematics: Kinematics,
    bodies: Int[Array, " shapes"],
    position: Float[Array, "rows 3"],
    rotation: Float[Array, "rows 3 3"],
    carrying: Int[Array, " rows"],
    pair: Int[Array, "2"],
) -> tuple[Float[Array, "2 3 3"], Float[Array, "2 3"]]:
    """Return the rotations and positions in the world that a pair of shapes goes along with.

    Args:
        kinematics: where the robot is.
        bodies: of the robot's shapes, whose places in their bodies are constant.
        position: of the scene's shapes, in the world or in the body that carries them.
        rotation: likewise.
        carrying: bodies that carry them, -1 for none.
        pair: numbers of the two shapes.
    """
    count, dtype = len(bodies), position.dtype
    row = jnp.clip(pair - count, 0, max(len(position) - 1, 0))
    is_row = pair >= count
    carrier = jnp.where(is_row, carrying[row], bodies[jnp.clip(pair, 0, count - 1)]) if len(position) else bodies[pair]
    turn, at = kinematics.body_rotation[carrier], kinematics.body_position[carrier]
    if len(position):
        fixed = carrier < 0
        turn = jnp.where(fixed[:, None, None], jnp.eye(3, dtype=dtype), turn)
        at = jnp.where(fixed[:, None], 0.0, at)
        inner = jnp.where(is_row[:, None, None], rotation[row], jnp.eye(3, dtype=dtype))
        turn, at = turn @ inner, at + jnp.einsum("kij,kj->ki", turn, jnp.where(is_row[:, None], position[row], 0.0))
    return turn, at


def shape_names(own: tuple[str, ...], rows: tuple[Any, ...], pair: np.ndarray, index: int) -> tuple[str, str]:
    """Return the names of a pair of shapes.

    Args:
        own: names of the robot's shapes.
        rows: of the scene's shapes; in a stack, of each scene's.
        pair: numbers of the two shapes. (2,)
        index: which scene, in a stack.
    """
    if pair[0] < 0:
        return "nothing", "nothing"
    if rows and isinstance(rows[0], tuple):
        rows = rows[index if len(rows) > 1 else 0]
    first, second = (own[k] if k < len(own) else rows[k - len(own)] for k in pair)
    return first, second
