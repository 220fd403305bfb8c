"""Whole searches for poses outside of programs, by one call of the core (``core/chain_find.hpp``).

What does not change from call to call is found by the identity of the robot and of the limits of its joints.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..collision._core import CoreRobot, CoreScene, call_here, nearest_pairs
from ..execution._backends import core_is_here
from ..execution._lanes import first_set
from ..execution._platform import cuda_is_default
from ..numerics._constants import SINGLE_TOUCH, TOUCH
from ..numerics._remembered import remembered
from ..robot import Robot
from ..robot._joint_selection import dof_names, dof_of_entries
from ._chain_kernel import integers_of, numbers_of
from ._chain_problem import STOPPED, ChainRoute, Settings, carried, search_of
from ._chain_search import DAMPING, LEAST_DAMPING, ChainSearch, Goal
from ._fixed import LAST, SETTLED, Searches, or_far, with_placeholders
from ._linear import ISOLATED
from ._pool import CHECK, PROGRESS, TRIAL
from ._seeds import increments, shift_of
from ._solution import InverseKinematicsSolution

_MOST_THREADS = 1 << 18
"""Threads that keep a GPU busy."""
_FIRST, _SOME, _MEMBERS = 16, 16, 32
"""Searches of each target at first, where there are many; threads of each where few are left, and for more searches."""
EVERY_SOLUTION = 3
"""``InverseKinematicsSolution.obstruction`` where something is in the way of the best configuration."""
_STILL = 1e-9
"""A search is at its end if no coordinate moves by more in a step [rad or m]."""


class Whole(NamedTuple):
    """Results of whole searches."""

    answer: InverseKinematicsSolution  # the answers, as of ``ChainRoute.answer``
    score: Float[Array, "*targets"] | None  # of the answers, where all searches run
    # with ``every``, of each search its end point, the score there, and whether it is an isolated solution
    ends: Float[Array, "*targets seeds n_and_2"] | None
    # with a scene, numbers of the two shapes of the nearest pair, and why there is no free solution, as in
    # ``core/freedom.hpp``
    pair: Int[Array, "*targets 3"] | None = None


class Around(NamedTuple):
    """Arrays of the robot's shapes and of the obstacles for the core."""

    robot: CoreRobot  # its shapes
    scene: CoreScene  # the obstacles
    clearance: Float[Array, "1"] | np.ndarray  # distance that all pairs keep [m]


class _Known(NamedTuple):
    """Numbers of a robot and its limits, their structure, and the programs that take them."""

    leaves: list[Array]
    structure: Any
    programs: dict[tuple[ChainRoute, Searches, bool], Callable[..., Whole]]


def whole_is_possible(route: Any, *, every: bool) -> bool:
    """Return whether ``whole`` runs here, for concrete arguments.

    ``every``: all searches for a target, and not as many as it needs, which a GPU does not do by one call.
    """
    possible = isinstance(route, ChainRoute) and route.by_core and core_is_here()
    return possible and not (every and cuda_is_default())


def whole(
    robot: Robot,
    route: ChainRoute,
    goals: Goal,
    settings: Settings,
    most: np.ndarray,
    hopeless: int,
    steps: int,
    how: Searches,
    *,
    single: bool,
    around: Around | None = None,
) -> Whole:
    """Return the results of whole searches.

    Args:
        most: number of searches for each target at most, where they do not all run. (targets,)
        hopeless: the same for targets that are out of reach.
        steps: of one search at most.
        how: static settings. All searches run where ``near`` or ``every`` is set.
        single: whether there is one target, and results have no axis of targets (static).
        around: what the robot may not touch.
    """
    known = _known(robot, settings.lower, settings.upper, frames=route.frames)
    program = known.programs.get((route, how, single))
    if program is None:
        dofs = dof_of_entries(robot)[route.entries(robot)].tolist()
        program = _program(known.structure, route, how, single, tuple(dofs), tuple(dof_names(robot)))
        known.programs[route, how, single] = program
    shift = _shift(settings.key, len(route.entries(robot)))
    counts = np.append(most, (hopeless, steps)).astype(np.int32)
    return program(known.leaves, *goals, settings.home, shift, settings.tolerance, counts, around)


@remembered
def _known(robot: Robot, lower: Array, upper: Array, *, frames: tuple[str, ...]) -> _Known:
    return _Known(*jax.tree.flatten(carried_by(robot, lower, upper, frames=frames)), {})


carried_by = jax.jit(carried, static_argnames="frames")


def _shift(key: Any, dimensions: int) -> Array:
    if isinstance(key, int | np.integer):
        return _shift_of(key=int(key), dimensions=dimensions)
    return shift_of(key, dimensions)


_shift_of = remembered(shift_of)


@lru_cache
def _program(
    structure: Any, route: ChainRoute, how: Searches, single: bool, dofs: tuple[int, ...], joints: tuple[str, ...]
) -> Callable[..., Whole]:
    """Return the compiled program for robots of one structure; ``dofs``: entries of v of the coordinates."""

    def program(
        leaves: list[Array],
        position: Array,
        rotation: Array,
        home: Array,
        shift: Array,
        tolerance: Array,
        counts: Array,
        around: Around | None,
    ) -> Whole:
        own, (goals, valid) = jax.tree.unflatten(structure, leaves), with_placeholders(Goal(position, rotation))
        search = search_of(own, route, home, shift, tolerance, how.seeds, warm=how.warm, near=how.near)
        beyond = route.beyond(search, goals)
        most, (hopeless, steps) = counts[:-2], counts[-2:]
        most = jnp.where(beyond > 0.0, jnp.minimum(most, hopeless), most)
        results = by_core(search, goals, most, steps, how, dofs, joints, around)
        whole = named(route.frames, joints, beyond, how.every, *results)
        whole = whole._replace(answer=or_far(whole.answer, valid))
        if not (how.near or how.every):  # XLA gives some of more than eight operations at a time to another thread
            whole = whole._replace(score=None)
        return jax.tree.map(lambda a: a[0], whole) if single else whole

    return jax.jit(program)


def by_core(
    search: ChainSearch,
    goal: Goal,
    most: Int[Array, " targets"],
    steps: Int[Array, ""],
    how: Searches,
    dofs: tuple[int, ...],
    joints: tuple[str, ...],
    around: Around | None,
) -> list[Array]:
    """Return the results of ``core/chain_find.hpp``.

    These are configurations (targets, nq). Then position and orientation error, score, and
    residuals (targets, 3 + 6 frames). Then whether it has converged, the number of the search, steps, and at_limit
    (targets, 3 + nv). With ``every``, also end points, score and whether isolated (targets, seeds, n + 2). With
    ``around``, also the gap of the nearest pair (targets, 10), and the pair and the reason (targets, 3).

    Many targets on a GPU are searched for in stages, each for the targets that the ones before have left: a few
    searches by one thread, whose first solutions may touch something; the same, with each solution checked; then more,
    by several threads, so that no thread works on when all others are done.
    """
    kind, nv = search.first.dtype, len(joints)
    targets, frames, n, nq = len(most), len(search.rows), len(search.first), len(search.home)
    goals = jnp.concatenate([goal.position[..., None, :], goal.rotation], -2).reshape(targets, frames, 12)
    tuned = np.array([PROGRESS, SETTLED, ISOLATED, STOPPED, _STILL], kind)
    numbers = [*numbers_of(search, (DAMPING, LEAST_DAMPING)), search.low, search.high, search.home, tuned]
    flags = [how.warm, how.near, how.every, kind == jnp.float32, False]
    bits = [jax.lax.bitcast_convert_type(search.shift, jnp.int32), increments(n).view(np.int32)]
    options = jnp.stack([jnp.int32(a) for a in (steps, CHECK, TRIAL, LAST, how.seeds, nq, nv, *flags)])
    lists = jnp.stack([jnp.asarray(a, jnp.int32) for a in (*bits, search.turns, search.chain.layout.dofs, dofs)])
    shapes: list[Any] = [((targets, nq), kind), ((targets, 3 + 6 * frames), kind), ((targets, 3 + nv), int)]
    shapes += [((targets, how.seeds, n + 2), kind)] * how.every
    sizes = (n, frames, len(search.chain.layout.joints), nq)
    shared = jnp.concatenate([jnp.ravel(a) for a in numbers])[None], integers_of(search, 0)

    def given(members: int, goals: Array, most: Array, options: Array) -> tuple[list[Any], tuple[Any, ...]]:
        outputs = [((len(most), *shape[1:]), own) for shape, own in shapes]
        return outputs, (goals, most[:, None], *shared, jnp.append(options, members), lists)

    def plain(members: int, goals: Array, most: Array, *, unchecked: bool = False) -> list[Array]:
        outputs, own = given(members, goals, most, options.at[-1].set(unchecked))
        return call_here("chain_find", outputs, *own, sizes=sizes, members=members)

    def in_scene(members: int, goals: Array, most: Array, *scene: Array) -> list[Array]:
        assert around is not None
        outputs, own = given(members, goals, most, options)
        outputs += [((len(most), 10), kind), ((len(most), 3), int)]
        more = around.robot.integers, around.robot.numbers[None], *scene, around.clearance
        wide = *sizes, *around.robot.sizes, around.scene.rows(around.robot.sizes[2])
        return call_here("free_find", outputs, *own, *more, sizes=wide, members=members)

    lanes = goals, most, *(() if around is None else map(jnp.asarray, around.scene))
    call = plain if around is None else in_scene
    if not cuda_is_default():
        return call(1, *lanes)
    if _MEMBERS * len(most) <= _MOST_THREADS:
        return call(_MEMBERS, *lanes)
    first, goes_on = jnp.minimum(most, _FIRST), most > _FIRST
    found = plain(1, goals, first, unchecked=around is not None)
    if around is None:
        return gone_on(plain, found, goes_on & ~(found[1][:, 2] <= search.enough), _MEMBERS, *lanes)[0]
    gap, pair = nearest_pairs(around.robot, found[0], around.scene)
    found += [gap, jnp.pad(pair, ((0, 0), (0, 1)))]
    least = around.clearance[0] + (SINGLE_TOUCH if kind == jnp.float32 else TOUCH)
    left, again = ~((found[2][:, 0] > 0) & (gap[:, 0] >= least)), (goals, first, *lanes[2:])
    found, left = gone_on(in_scene, found, left, 1, *again, enough=_MOST_THREADS // _SOME)
    found, _ = gone_on(in_scene, found, left, _SOME, *again)
    reason = found[-1][:, 2]  # see ``core/freedom.hpp``
    left = goes_on & (found[2][:, 0] <= 0) & ((reason == 0) | (reason == EVERY_SOLUTION))
    return gone_on(in_scene, found, left, _MEMBERS, *lanes)[0]


def gone_on(
    call: Callable[..., list[Array]], found: list[Array], left: Array, members: int, *lanes: Array, enough: int = 0
) -> tuple[list[Array], Array]:
    """Return ``found`` with what ``call(members, *lanes)`` finds for the targets that are left, and which still are.

    As many targets at a time as keep a GPU busy, until ``enough`` or fewer are left.
    """
    targets, size = len(left), min(len(left), _MOST_THREADS // members)

    def body(state: tuple[list[Array], Array]) -> tuple[list[Array], Array]:
        found, left = state
        place = first_set(left, size)
        at = jnp.minimum(place, targets - 1)
        goals, most, *scene = (a[at] if len(a) > 1 else a for a in lanes)
        new = call(members, goals, jnp.where(place < targets, most, 0), *scene)
        new[2] = new[2].at[:, 2].add(found[2][at, 2])
        found = [a.at[place].set(b, mode="drop") for a, b in zip(found, new, strict=True)]
        return found, left.at[place].set(False, mode="drop")

    return jax.lax.while_loop(lambda state: state[1].sum() > enough, body, (found, left))


def named(
    frames: tuple[str, ...],
    joints: tuple[str, ...],
    beyond: Array,
    every: bool,
    q: Array,
    sizes: Array,
    labels: Array,
    *more: Array,
) -> Whole:
    """Return the results of ``by_core`` by their names."""
    ends, around = (more[0] if every else None), more[every:]
    residual = sizes[:, 3:].reshape(-1, len(frames), 6)
    answer = InverseKinematicsSolution(
        q=q,
        converged=labels[:, 0] > 0,
        position_error=sizes[:, 0],
        orientation_error=sizes[:, 1],
        seed=labels[:, 1],
        steps=labels[:, 2],
        residual={name: residual[:, at] for at, name in enumerate(frames)},
        at_limit=labels[:, 3:],
        beyond_reach=beyond,
        clearance=around[0][:, 0] if around else None,
        joints=joints,
    )
    return Whole(answer, sizes[:, 2], ends, around[1] if around else None)
