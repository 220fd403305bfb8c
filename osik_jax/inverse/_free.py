"""Searches for configurations in which nothing touches, by the core (``core/chain_find.hpp``, ``core/freedom.hpp``)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap, sequential_vmap
from jaxtyping import Array, Int

from .._errors import OsikError, OsikValueError
from ..collision._clearance import checked_clearance, differentiable, distances, shape_names
from ..collision._core import (
    CoreRobot,
    CoreScene,
    check_length,
    core_robot,
    core_scene,
    read_gaps,
    require_core,
)
from ..collision._robot_shapes import Given, robot_shapes
from ..collision._scene import Scene, check_scene
from ..collision._table import RobotShapes
from ..execution._blocks import first_axes_as_one
from ..execution._platform import cuda_is_default, on_host
from ..limits import CollisionAvoidanceLimit, Limit
from ..numerics._host import is_traced
from ..numerics._remembered import remembered
from ..robot import Robot
from ..robot._joint_selection import dof_names, dof_of_entries
from ._chain_problem import ChainRoute, Settings, answer
from ._chain_search import Goal
from ._fixed import Explored, Searches, or_far, with_placeholders
from ._run import with_ends
from ._solution import InverseKinematicsSolution, with_fields
from ._task_search import CLEAR
from ._whole import EVERY_SOLUTION, Around, by_core, named, whole

_SURE = 1e-6
"""Distance beyond the clearance, against rounding [m]."""
SEEDS = 256
"""Searches for a target, to begin with: free solutions can be one in a hundred."""


class Obstacles(NamedTuple):
    """The robot's shapes and the obstacles that a search keeps apart."""

    route: ChainRoute  # the frames
    shapes: RobotShapes  # of the robot
    scene: Scene  # the user's
    around: Around  # both for the core

    @property
    def many(self) -> bool:
        """Return whether each target has a scene of its own."""
        return self.scene.is_stack


def read_obstacles(robot: Robot, route: ChainRoute, scene: Scene, clearance: Any, srdf: Given) -> Obstacles:
    """Return the obstacles of a search, checked."""
    require_core("inverse_kinematics with a scene", on_gpu=True)
    check_scene(scene)
    shapes = robot_shapes(robot, srdf)
    own = _known(robot, shapes, route=route)
    return Obstacles(route, shapes, scene, Around(own, core_scene(scene, shapes), checked_clearance(clearance)))


@remembered
def _known(robot: Robot, shapes: RobotShapes, *, route: ChainRoute) -> CoreRobot:
    """Return the core's arrays of a robot for a search; by its shapes, as an SRDF may change under its path."""
    posed = tuple(name if all(rows) else None for name, rows in zip(route.frames, route.rows, strict=True))
    return core_robot(robot, shapes, entries=tuple(route.entries(robot).tolist()), posed=posed)


def find_free(
    robot: Robot,
    goals: Goal,
    settings: Settings,
    most: int,
    steps: int,
    how: Searches,
    obstacles: Obstacles,
    *,
    single: bool,
) -> Explored:
    """Return free configurations; arguments as of ``whole``. Without numbers, ``settings`` and so on may be traced."""
    traced = is_traced((goals, settings, obstacles.around, robot))
    if (how.near or how.every) and cuda_is_default():
        with nullcontext() if traced else on_host():
            if cuda_is_default():
                where = (
                    "call jit under jax.default_device(jax.devices('cpu')[0])" if traced else "add cpu to JAX_PLATFORMS"
                )
                raise OsikError(f"nearest and all run on a CPU where there is a scene: {where}")
            return find_free(robot, goals, settings, most, steps, how, obstacles, single=single)
    route, scenes = obstacles.route, len(obstacles.around.scene.integers)
    if len(goals.position) == 1 and scenes > 1:
        goals = jax.tree.map(lambda a: a.repeat(scenes, 0), goals)
    count = len(goals.position)
    check_length(obstacles.around.scene, count, "targets")
    if traced:
        return Explored(_traced(robot, goals, settings, most, steps, how, obstacles))
    counts, around = np.full(count, most), obstacles.around
    if not (how.near or how.every):
        how = how._replace(seeds=0)  # static, and ``counts`` says how many
    results = whole(robot, route, goals, settings, counts, most, steps, how, single=single, around=around)
    pair = np.asarray(results.pair)
    names = _pair_fields(pair[..., :2], obstacles.shapes, obstacles.scene)
    found = with_fields(results.answer, **names, obstruction=pair[..., 2])
    return with_ends(found, None if results.ends is None else np.asarray(results.ends))


def _pair_fields(pairs: Int[np.ndarray, "*n 2"], shapes: RobotShapes, scene: Scene) -> dict[str, Any]:
    """Return the fields of an answer that name its nearest pairs."""
    if pairs.ndim == 1:
        return dict(nearest_pair=np.zeros((), np.int32), pairs=(shape_names(shapes.names, scene.names, pairs, 0),))
    flat, have_own_names = pairs.reshape(-1, 2), len(scene.names) > 1 and isinstance(scene.names[0], tuple)
    of_scene = np.where(have_own_names & (flat.max(-1, initial=-1) >= len(shapes.names)), np.arange(len(flat)), 0)
    codes = np.ravel_multi_index((of_scene, *(flat.T + 1)), (len(flat), *[flat.max(initial=-1) + 2] * 2))
    _, first, place = np.unique(codes, return_index=True, return_inverse=True)
    named = [shape_names(shapes.names, scene.names, flat[k], int(of_scene[k])) for k in first]
    kinds = {pair: k for k, pair in enumerate(dict.fromkeys(named))}
    number = np.array([kinds[pair] for pair in named], np.int32)[place].reshape(pairs.shape[:-1])
    return dict(nearest_pair=number, pairs=tuple(kinds))


def find_free_by_steps(
    robot: Robot,
    solve: Callable[..., InverseKinematicsSolution],
    limits: Sequence[Limit],
    scene: Scene,
    clearance: Any,
    srdf: Given,
    position_tolerance: Any,
) -> InverseKinematicsSolution:
    """Return free configurations for tasks, a scheme or a free base: steps keep off the nearest pairs.

    Args:
        solve: ``inverse_kinematics`` of the tasks, without limits.
        limits: the user's.
        position_tolerance: of the tasks [m]; rows of limits may be off by a part of it.

    Raises:
        OsikError: there is no core for this device.
        TypeError, ValueError: no scene, or a stack of scenes; a clearance that is negative.
    """
    check_scene(scene)
    if scene.is_stack:
        raise OsikValueError(
            "tasks take one scene for all targets, and this is a stack of scenes: call for each of them"
        )
    least = checked_clearance(clearance)[0]
    apart = least + CLEAR * position_tolerance + _SURE
    limit = CollisionAvoidanceLimit(robot, scene=scene, srdf=srdf, minimum_distance=apart, q0_distance=-np.inf)
    found, shapes = solve(limits=(*limits, limit)), robot_shapes(robot, srdf)
    gap, pair = distances(robot, shapes, found.q.reshape(-1, robot.nq), scene)
    gap, pair = gap.reshape(found.converged.shape), pair.reshape(*found.converged.shape, 2)
    is_free = found.converged & (gap >= least)
    reason = jnp.where(is_free | (gap >= apart + _SURE), 0, EVERY_SOLUTION).astype(jnp.int32)
    names: dict[str, Any] = dict(nearest_pair=None, pairs=())
    if not is_traced((found.q, scene)):
        names = _pair_fields(np.asarray(pair), shapes, scene)
    return with_fields(found, converged=is_free, clearance=gap, obstruction=reason, **names)


def _traced(
    robot: Robot, goals: Goal, settings: Settings, most: int, steps: int, how: Searches, obstacles: Obstacles
) -> InverseKinematicsSolution:
    """Return the answers as differentiable functions of what is traced; pairs have no names there."""
    route, (goals, valid) = obstacles.route, with_placeholders(goals)
    search, entries = route.search(robot, settings, warm=how.warm, near=how.near), route.entries(robot)
    fixed, there, around = jax.lax.stop_gradient((search, goals, obstacles.around))
    dofs, joints = tuple(dof_of_entries(robot)[entries].tolist()), tuple(dof_names(robot))
    counts = jnp.full(len(valid), most, jnp.int32)
    results = _in_one_call(how, dofs, joints)(fixed, there, counts, jnp.int32(steps), around)
    found = named(route.frames, joints, route.beyond(fixed, there), False, *results)
    own = answer(robot, route, search, goals, found.answer.q[:, entries], found.answer.seed, found.answer.steps)
    gaps, reason = read_gaps(results[-2], results[-1][:, :2]), results[-1][:, 2]
    gap = differentiable(robot, obstacles.shapes, own.q, obstacles.scene, gaps)
    is_free = own.converged & (gap >= around.clearance[0])
    return or_far(dataclasses.replace(own, converged=is_free, clearance=gap, obstruction=reason), valid)


def _in_one_call(how: Searches, dofs: tuple[int, ...], joints: tuple[str, ...]) -> Callable[..., list[Array]]:
    """Return ``by_core`` with a rule for ``vmap``: targets and scenes of all lanes in one call.

    Where lanes have starts or settings of their own, one lane is solved after another.
    """

    @custom_vmap
    def searched(search: Any, goal: Goal, most: Array, steps: Array, around: Around) -> list[Array]:
        return by_core(search, goal, most, steps, how, dofs, joints, around)

    @searched.def_vmap
    def _(lanes: int, batched: list[Any], *given: Any) -> tuple[list[Array], list[bool]]:
        (search, goal, most, steps, around), targets = given, given[2].shape[-1]
        alike = batched[0], batched[3], batched[4].robot, batched[4].clearance
        if any(jax.tree.leaves(alike)):
            axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(batched))
            found = jax.vmap(sequential_vmap(searched), axes)(*given)
            return found, [True] * len(found)

        def together(array: Array, is_batched: bool) -> Array:
            wide = array if is_batched else array[None]
            return first_axes_as_one(jnp.broadcast_to(wide, (lanes, targets, *wide.shape[2:])))

        def of_scene(array: Array, is_batched: bool) -> Array:
            return together(array, is_batched) if is_batched or len(array) > 1 else array

        goal, most = jax.tree.map(together, (goal, most), (batched[1], batched[2]))
        scene = CoreScene(*map(of_scene, around.scene, batched[4].scene))
        found = searched(search, goal, most, steps, around._replace(scene=scene))
        return [a.reshape(lanes, targets, *a.shape[1:]) for a in found], [True] * len(found)

    return searched
