"""A control step in one call of the compiled core (``core/step.hpp``).

The core computes the rows of the tasks that it knows. JAX computes those of all other tasks and hands them over as
arrays: they are GIVEN.

``_step.py`` is the definition, the derivative, and what runs for hard tasks, limits with rows beside priorities, other
schemes and other platforms. No search of plain JAX stands beside the call: XLA makes place for all of its numbers in
every step, searched or not, which costs more than the call.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..core import _library
from ..execution._backends import cuda_is_default, on_platforms, takes
from ..execution._computed import in_shared_lanes, over_lanes, side_by_side
from ..execution._lanes import lanes_of
from ..execution._rules import custom_jvp
from ..kinematics._forward import kinematics_by
from ..kinematics._kernels import dof_columns, tree_integers
from ..limits import Limit, LimitRows, limit_box, limit_rows
from ..numerics._constants import ENTRY_ROUNDOFF, FEASIBILITY, HIERARCHY_RANK, KKT_TOLERANCE
from ..numerics._placeholder import never_infinite, positive, with_placeholder
from ..robot import Robot
from ..robot._joint_selection import scalar_layout
from ..schemes import HierarchicalQP, NullSpace, Scheme, WeightedQP
from ..solvers.hqp import Tolerances, WorkingSet
from ..tasks import AdaptiveGain, PostureTask, Task, TaskRows
from ..tasks._rows import rows_of
from ..tasks._task import GIVEN, POSTURE, CoreCard
from ._checks import check_rows
from ._solution import Solution

_WEIGHTED, _HIERARCHICAL, _CLASSICAL, _SATURATED = range(4)
_HARD_ROWS = 2
"""``StepLimit`` of the core."""
Step = Callable[..., Solution]


def is_compiled(
    robot: Robot,
    q: Array,
    tasks: Mapping[str, Task],
    scheme: Scheme,
    limits: Sequence[Limit],
    dt: Any,
    warm_start: Any,
) -> bool:
    """Return whether the core takes steps of this kind and is there.

    It takes none on a GPU, where XLA runs each part of a step by a kernel of its own.
    """
    has_rows = any(limit.has_rows(robot) for limit in limits) and type(scheme) is not WeightedQP
    apart = has_rows or any(task.hard for task in tasks.values())
    if cuda_is_default() or apart or unknown_scheme(scheme) is not None:
        return False
    kinds = {jnp.result_type(a) for a in jax.tree.leaves((robot, q, tasks, scheme, limits, dt))}
    one_precision = {kind for kind in kinds if jnp.issubdtype(kind, jnp.floating)} == {jnp.result_type(float)}
    return (
        one_precision
        and takes(getattr(scheme, "backend", "jax"), "core", fits=True)
        and (warm_start is None or _fits(warm_start, robot, q, tasks, scheme, limits, dt))
    )


def _fits(
    warm_start: Any, robot: Robot, q: Array, tasks: Mapping[str, Task], scheme: Scheme, limits: Any, dt: Any
) -> bool:
    rows, of_limits = jax.eval_shape(given_rows, robot, q, tasks, scheme, limits, dt)
    labels = Layout(robot, tasks, scheme, rows, row_count(of_limits)).labels
    return [jnp.shape(a) for a in jax.tree.leaves(warm_start)] == labels


def row_count(of_limits: LimitRows | None) -> int:
    """Return how many rows limits have."""
    return 0 if of_limits is None else of_limits.lower.shape[-1]


def unknown_scheme(scheme: Scheme) -> str | None:
    """Return a scheme that the core does not know in words; None if it knows it."""
    if _kind(scheme) is None:
        return f"the scheme {type(scheme).__name__}"
    if getattr(scheme, "max_iterations", None) is not None:  # what a search has then is its own
        return f"a {type(scheme).__name__} with max_iterations"
    return None


def missing_part(robot: Robot, tasks: Mapping[str, Task], scheme: Scheme, limits: Sequence[Limit]) -> str | None:
    """Return the first part of a step that the core cannot compute alone, in words; None if there is none."""
    if unknown_scheme(scheme) is not None:
        return unknown_scheme(scheme)
    for limit in limits:
        if not limit.core_has_box:
            return f"the limit {type(limit).__name__}"
        if limit.has_rows(robot):
            return "the limit ConfigurationLimit of a robot with ball joints"
    reasons = ((name, _unknown(robot, task)) for name, task in tasks.items())
    return next((f"the task {name!r}, which {reason}" for name, reason in reasons if reason), None)


def _kind(scheme: Scheme) -> int | None:
    """Return the core's number of a scheme (``StepScheme``), None for one that it does not know."""
    if type(scheme) is NullSpace:
        return _SATURATED if scheme.saturates else _CLASSICAL
    return {WeightedQP: _WEIGHTED, HierarchicalQP: _HIERARCHICAL}.get(type(scheme))


def _unknown(robot: Robot, task: Task) -> str | None:
    """Return why JAX computes the rows of a task, in words; None if the core does."""
    if task.hard:
        return "is hard"
    card = task.core(robot)
    if isinstance(card, str):
        return card
    return "has an AdaptiveGain" if isinstance(task.gain, AdaptiveGain) else None


def _card(robot: Robot, task: Task) -> CoreCard:
    card = task.core(robot)
    assert not isinstance(card, str), card
    return card


def given_rows(
    robot: Robot, q: Array, tasks: Mapping[str, Task], scheme: Scheme, limits: Sequence[Limit], dt: Array | float
) -> tuple[dict[str, TaskRows], LimitRows | None]:
    """Return the rows of tasks and of limits that JAX computes, from placeholders for numbers that are not valid."""
    given = {name: task for name, task in tasks.items() if _unknown(robot, task)}
    with_rows = tuple(limit for limit in limits if limit.has_rows(robot))
    if not given and not with_rows:
        return {}, None
    (robot, q, dt, given, with_rows), _ = with_placeholder((robot, q, positive(dt), given, with_rows))
    kinematics = kinematics_by(getattr(scheme, "backend", "jax"), robot, q)
    of_limits = limit_rows(robot, kinematics, q, with_rows, dt)
    rows = rows_of(robot, kinematics, q, {name: task.during(dt) for name, task in given.items()}) if given else {}
    check_rows(rows, given, robot)
    return {name: _of_full_shape(own) for name, own in rows.items()}, of_limits


def _of_full_shape(rows: TaskRows) -> TaskRows:
    """Return the rows with a number for each row and dof where a task of one's own may give one for all."""
    pull = jnp.broadcast_to(rows.pull, rows.error.shape)
    return replace(rows, pull=pull, levers=jnp.broadcast_to(rows.levers, rows.jacobian.shape[-1:]))


class _Arrays:
    """The arrays in which the numbers of a step are handed to the core, and where each leaf of the arguments is.

    What usually changes from step to step (configuration, poses and points to reach, dt, warm start) is an array by
    itself. All else is side by side in one array of what lanes share and one of what is their own: usually constants,
    which are then made once, where each would cost an operation in every step.

    Attributes:
        arrays: with a leading axis, of the lanes or of length 1.
        lanes: their number.
    """

    def __init__(self, given: tuple[Any, ...]) -> None:
        paths, self.tree = jax.tree_util.tree_flatten_with_path(given)
        leaves = [leaf for _, leaf in paths]
        self.lanes = lanes_of(leaves)
        groups: dict[Any, list[int]] = {False: [], True: []}
        for i, (path, leaf) in enumerate(paths):
            alone = _is_moving(given, path) or not jnp.issubdtype(leaf.dtype, jnp.floating)
            groups.setdefault(i + 2 if alone else len(leaf) > 1, []).append(i)
        # integers and flags come last: the core counts the arrays of numbers alone
        is_number = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves]
        members = sorted(filter(None, groups.values()), key=lambda of: not is_number[of[0]])
        self.places, self.arrays, self.shapes = {}, [], [leaf.shape[1:] for leaf in leaves]
        for own in members:
            sizes = [leaves[i][0].size for i in own]
            for i, size, end in zip(own, sizes, np.cumsum(sizes), strict=True):
                self.places[i] = len(self.arrays), int(end) - size, size
            self.arrays.append(leaves[own[0]] if len(own) == 1 else side_by_side(*(leaves[i] for i in own)))

    def leaves(self, arrays: Sequence[Array]) -> tuple[Any, ...]:
        """Return the arguments again, from the arrays of all lanes or of some."""
        found = []
        for i, shape in enumerate(self.shapes):
            array, start, size = self.places[i]
            lanes = len(arrays[array])
            found.append(arrays[array].reshape(lanes, -1)[:, start : start + size].reshape(lanes, *shape))
        return jax.tree.unflatten(self.tree, found)

    def numbered(self) -> tuple[Any, ...]:
        """Return the arguments with the number of each leaf in its place."""
        return jax.tree.unflatten(self.tree, range(len(self.shapes)))


def _is_moving(given: tuple[Any, ...], path: tuple[Any, ...]) -> bool:
    """Return whether an array usually changes from step to step, from its path among the arguments ``(robot, ...)``."""
    if path[0].idx != 2:
        return path[0].idx in (1, 5)
    of_task = any(isinstance(key, jax.tree_util.GetAttrKey) and key.name == "target" for key in path)
    return of_task and not isinstance(given[2][path[1].key], PostureTask)


class Layout:
    """Sizes and indices of a step's rows, in the order of the core's ``StepSizes``.

    Of the rows that JAX computes, ``given`` by task, structure and shapes count. ``limit_rows`` is how many rows limits
    have.

    Attributes:
        labels: shapes of the warm start's arrays.
        rows: of all tasks.
    """

    def __init__(
        self,
        robot: Robot,
        tasks: Mapping[str, Task],
        scheme: Scheme,
        given: Mapping[str, TaskRows] | None = None,
        limit_rows: int = 0,
    ) -> None:
        self.robot, self.tasks, self.kind, self.given = robot, tasks, _kind(scheme), given or {}
        own = self.given
        nv, by_weight = robot.nv, self.kind == _WEIGHTED
        self.parts = {
            name: CoreCard(GIVEN, own[name].error.shape[-1], []) if name in own else _card(robot, task)
            for name, task in tasks.items()
        }
        self.count = count = {name: rows for name, (_, rows, _) in self.parts.items()}
        self.rows = sum(count.values())
        self.bounded = bounded = {
            name: not own[name].is_equality if name in own else task.core_leaves()[4] is not None
            for name, task in tasks.items()
        }
        of_dofs = {
            name: own[name].dofs is not None if name in own else kind == POSTURE
            for name, (kind, _, _) in self.parts.items()
        }
        self.single = single = {name: by_weight and of_dofs[name] and not bounded[name] for name in tasks}
        ranks = sorted({task.priority for task in tasks.values()})
        self.level = level = {name: ranks.index(task.priority) for name, task in tasks.items()}
        self.of_level = [sum(count[name] for name in tasks if level[name] == k) for k in range(len(ranks))] + [0]
        mixed = {level[name] for name in tasks if bounded[name]}
        projects = self.kind in (_CLASSICAL, _SATURATED)  # no rows of a level bind those below; a step has no labels
        self.hard = [(k, row) for k in sorted(mixed) for row in range(self.of_level[k]) if not projects]
        intervals, dense = (
            sum(count[name] for name in tasks if bounded[name] == flag and not single[name]) for flag in (True, False)
        )
        levels, longest, h = len(self.of_level), max(self.of_level), nv + len(self.hard)
        if by_weight:
            bounded_rows = intervals + limit_rows
            self.labels, self.sizes = [(nv + bounded_rows,)], (dense, bounded_rows, 0, 0, 20 * (nv + bounded_rows))
        else:
            self.labels = [] if projects else [(levels, h), (levels, longest)]
            self.sizes = longest, 0, levels, h, 10 * (nv + (2 if projects else longest))

    def integers(
        self,
        places: Mapping[int, tuple[int, int, int]],
        numbered: tuple[Any, ...],
        box: int,
        given: Mapping[str, list[int]] | None = None,
        limit_rows: Sequence[int] = (),
    ) -> np.ndarray:
        """Return what ``Step`` in ``core/step.hpp`` reads.

        Args:
            places: of the leaves: array, offset and size.
            numbered: the arguments of the step with the numbers of leaves in their place.
            box: number of the leaf with the lower bounds of the box, before that of the upper ones; -1: by the limits.
            given: numbers of the leaves with the rows that JAX computes, by task (``_placed``).
            limit_rows: numbers of the leaves with the rows of limits; empty for none.
        """
        robot, q, tasks, scheme, limits, dt, _ = numbered
        tree, nv, by_weight = self.robot.tree, self.robot.nv, self.kind == _WEIGHTED
        of_limits = [leaves for limit in limits if (leaves := limit.core_leaves())]
        if limit_rows:
            of_limits.append([_HARD_ROWS, *limit_rows, limit_rows[0]])
        bodies, joints, full = len(tree.body_names), len(tree.joint_types), len(tree.dof_joint)
        nq, *of_tree = tree_integers(tree)
        scalar, place = scalar_layout(self.robot)
        numbers = [self.kind, len(places), nq, self.robot.nq, bodies, joints, full, nv, len(tasks)]
        numbers += [len(of_limits), self.rows, *self.sizes]
        numbers += [number for leaf in sorted(places) for number in places[leaf]]
        numbers += [q, dt, scheme.damping, scheme.curvature_damping, box, box + 1]
        numbers += [getattr(scheme, name, -1) for name in ("potential_gain", "margin", "rank_tolerance")]
        numbers += [robot.qpos_offset, robot.joint_reference, robot.body_position, robot.body_quaternion]
        numbers += [robot.joint_position, robot.joint_axis, robot.body_mass, robot.body_com]
        numbers += [robot.frame_position, robot.frame_rotation]
        numbers += [number for own in sorted(of_limits) for number in own]
        numbers += [*of_tree, *dof_columns(tree)[0], *tree.dof_body, *tree.turning, *np.where(scalar, place, -1)]
        if not by_weight:
            numbers += [*self.of_level, *([-1] * nv), *(k for k, _ in self.hard), *(row for _, row in self.hard)]
        first = _offsets(
            self.count,
            sorted(tasks, key=lambda name: 2 * self.single[name] + self.bounded[name] if by_weight else 0),
        )
        out = _offsets(self.count, sorted(tasks))
        for name, (kind, rows, options) in self.parts.items():
            numbers += [kind, rows, first[name], out[name], self.level[name], self.bounded[name], self.single[name]]
            if kind == GIVEN:
                leaves, options = (given or {})[name], self._options_of_given(name, tasks[name])
            else:
                leaves = [-1 if leaf is None else leaf for leaf in tasks[name].core_leaves()]
            numbers += [len(options), *leaves, *options]
        return np.array(numbers, np.int32)

    def _options_of_given(self, name: str, numbered: Any) -> list[int]:
        """Return whether the rows close a loop, the task's leaves (first, end, those never infinite), and dofs."""
        rows, leaves = self.given[name], jax.tree_util.tree_leaves_with_path(numbered)
        kinds = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in jax.tree.leaves(self.tasks[name])]
        finite = [leaf for (path, leaf), kind in zip(leaves, kinds, strict=True) if kind and never_infinite(path)]
        first, end = leaves[0][1], leaves[-1][1] + 1
        return [rows.closes_loop, first, end, len(finite), *finite, *(rows.dofs or ())]

    def constants(self, dtype: Any) -> np.ndarray:
        """Return what ``StepData`` has under this name."""
        tree = self.robot.tree
        if self.kind == _WEIGHTED:
            tolerances = [FEASIBILITY, KKT_TOLERANCE[dtype]]
        elif self.kind == _HIERARCHICAL:
            tolerances = list(Tolerances(rank=HIERARCHY_RANK[dtype]))
        else:
            tolerances = [ENTRY_ROUNDOFF * jnp.finfo(dtype).eps]
        return np.concatenate([tree.qpos_source[1], dof_columns(tree)[1], [jnp.finfo(dtype).max, *tolerances]])


def _placed(
    rows: Mapping[str, TaskRows], of_limits: LimitRows | None, places: dict[int, tuple[int, int, int]], array: int
) -> tuple[dict[str, list[int]], list[int], list[Array]]:
    """Return numbers of new leaves with the rows of lanes that JAX computes, by task and of limits, and the leaves.

    The leaves stand side by side in one array; ``places`` gets theirs. Numbers are in the order of
    ``GivenTask::add`` (``core/tasks/given.hpp``), -1 for what it does not need.
    """
    found: dict[str, list[int]] = {}
    parts: list[Array] = []

    def add(part: Array | None) -> int:
        if part is None:
            return -1
        end = sum(own[0].size for own in parts)
        places[len(places)] = array, end, part[0].size
        parts.append(part)
        return len(places) - 1

    for name, own in rows.items():
        found[name] = [add(part) for part in row_parts(own)]
    limit_rows = [] if of_limits is None else [add(part) for part in jax.tree.leaves(of_limits)]
    return found, limit_rows, parts


def row_parts(rows: TaskRows) -> tuple[Any, ...]:
    """Return the numbers of rows that JAX computes, in the order of ``GivenTask::add``; None: it needs none."""
    upper, jacobian = (None if rows.is_equality else rows.upper), (None if rows.dofs is not None else rows.jacobian)
    return rows.error, rows.lower, upper, rows.weight, rows.pull, rows.levers, rows.curvature, jacobian, None


def _offsets(count: Mapping[str, int], order: Sequence[str]) -> dict[str, int]:
    """Return where the rows of each task begin, if the tasks stand in this order."""
    ends = np.cumsum([0, *(count[name] for name in order)])
    return dict(zip(order, ends.tolist(), strict=False))


def compiled(plain: Step) -> Step:
    """Return the step by the compiled core, for arguments that ``is_compiled`` accepts.

    ``plain`` is the definition: it gives the derivative, and runs on platforms without the core.
    """
    lanes = in_shared_lanes(partial(_steps, plain))

    @custom_jvp
    def computed(*given: Any) -> Solution:
        return lanes(*given)

    @computed.defjvp
    def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
        return jax.jvp(plain, primals, tangents)

    return computed


def _steps(plain: Step, *given: Any) -> Solution:
    """Return the steps of all lanes; every array has a leading axis, of the lanes or of length 1."""
    packed = _Arrays(given)

    def by_core(*arrays: Array) -> Solution:
        return _by_core(packed, *arrays)

    def elsewhere(*arrays: Array) -> Solution:
        return over_lanes(plain)(*packed.leaves(arrays))

    return on_platforms({"core": by_core}, elsewhere, *packed.arrays)


def _by_core(packed: _Arrays, *arrays: Array) -> Solution:
    """Return the solutions of all lanes."""
    robot, q, tasks, scheme, limits, dt, warm_start = packed.leaves(arrays)
    rows, of_limits = over_lanes(given_rows)(robot, q, tasks, scheme, limits, dt)
    layout, numbered = Layout(robot, tasks, scheme, rows, row_count(of_limits)), packed.numbered()
    guesses, box = jax.tree.leaves(warm_start), -1
    given = [a for a in arrays if jnp.issubdtype(a.dtype, jnp.floating)]
    nowhere = np.iinfo(np.int32).max  # of integers, which the core does not look at
    places = {leaf: (own[0] if own[0] < len(given) else nowhere, *own[1:]) for leaf, own in packed.places.items()}
    guesses = [a.reshape(len(a), -1) for a in guesses] + [np.zeros((1, 0), np.int32)] * (2 - len(guesses))
    boxed = [limit for limit in limits if any(type(part).box is not Limit.box for part in limit.parts())]
    by_limits = all(limit.core_has_box and not limit.has_rows(robot) for limit in boxed)  # JAX computes ball joints
    if not (q.dtype == jnp.float64 and by_limits):
        box = len(places)
        for bound in over_lanes(lambda robot, q, limits, dt: limit_box(robot, q, limits, dt))(robot, q, limits, dt):
            places[len(places)] = len(given), 0, robot.tree.nv
            given.append(bound)
    rows_at, limit_rows_at, parts = _placed(rows, of_limits, places, len(given))
    given += [side_by_side(*parts)] if parts else []
    integers = layout.integers(places, numbered, box, rows_at, limit_rows_at)
    labels = sum(int(np.prod(shape)) for shape in layout.labels)
    shapes = ((packed.lanes, robot.tree.nv + 2 + 2 * layout.rows), float), ((packed.lanes, 3 + labels), int)
    numbers, integers = _library.call("step", shapes, integers, *guesses, *given, layout.constants(q.dtype))
    # the numbers of a lane stand one after another
    leaves, tree = jax.tree.flatten(solution_shapes(type(scheme), robot.tree.nv, layout.count, layout.labels))
    parts = [(integers, numbers)[kind][:, place] for kind, place in leaf_places(leaves)]
    found = [part.reshape(-1, *leaf.shape).astype(leaf.dtype) for part, leaf in zip(parts, leaves, strict=True)]
    return jax.tree.unflatten(tree, found)


def solution_shapes(
    scheme: type[Scheme], nv: int, rows: Mapping[str, int], labels: Sequence[tuple[int, ...]]
) -> Solution:
    """Return the solution of one step with shapes and types in place of arrays.

    ``rows`` is the number of rows of each task, ``labels`` are the shapes of the warm start's arrays.
    """
    number, integer = (partial(jax.ShapeDtypeStruct, dtype=kind) for kind in (jnp.result_type(float), np.int32))
    own: list[Any] = [integer(shape) for shape in labels]
    by_name = {name: number((count,)) for name, count in rows.items()}
    # without its constructor, which wants arrays
    like, names = object.__new__(Solution), (field.name for field in fields(Solution))
    warm_start = own[0] if scheme is WeightedQP else WorkingSet(*own) if scheme is HierarchicalQP else None
    status = jax.ShapeDtypeStruct((), jnp.result_type(int))
    values = number((nv,)), status, *[integer(())] * 2, *[number(())] * 2, by_name, by_name, warm_start
    vars(like).update(zip(names, values, strict=True))
    return like


def leaf_places(leaves: Sequence[Any]) -> list[tuple[bool, slice]]:
    """Return for each leaf of one solution whether it is in the core's numbers, not its integers, and where."""
    ends, found = [0, 0], []
    for leaf in leaves:
        kind = jnp.issubdtype(leaf.dtype, jnp.floating)
        found.append((kind, slice(ends[kind], ends[kind] + leaf.size)))
        ends[kind] += leaf.size
    return found
