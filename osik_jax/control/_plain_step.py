"""Steps outside ``jit``: one call of the core, with numbers that were laid out once.

A program of JAX takes every leaf of robot, tasks and limits at each call, which is ten times the work of the step. Here
they are recognised by their identity, and only the configuration and what is new are copied.
"""

from __future__ import annotations

import operator
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from itertools import chain
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from ..core._plain import functions
from ..limits import Limits, with_own_limits
from ..numerics._host import float_now
from ..robot import Robot
from ..schemes import HierarchicalQP, Scheme, WeightedQP
from ..schemes._default import scheme_for
from ..solvers.hqp import WorkingSet
from ..tasks import Task
from ._checks import LARGEST_GAIN, plain_configuration
from ._compiled_step import is_compiled
from ._packed_step import missing_part, pack
from ._solution import Solution

_MOST = 32
"""Number of steps that are kept; each has its workspace in the core, some hundred kilobytes."""
_kept: dict[tuple[Any, ...], Checked] = {}


def kept_step(robot: Any, tasks: Any, scheme: Any, limits: Any) -> Checked | None:
    """Return what is kept for arguments of the same structure, if anything."""
    known = isinstance(robot, Robot) and type(tasks) is dict
    return _kept.get(_key(robot, tasks, scheme, limits)) if known else None


def keep_step(
    robot: Robot, q: Any, tasks: Mapping[str, Task], scheme: Scheme | None, limits: Limits | None, dt: Any
) -> Checked | None:
    """Return a step of the core for checked arguments, and keep it, or that all was checked; None if traced."""
    if _is_traced((robot, q, dict(tasks), scheme, limits, dt)) or robot.q0.dtype != float_now():
        return None
    key = _key(robot, tasks, scheme, limits)
    step = _kept.get(key)
    if step is None or not step.fits(tasks):
        while len(_kept) >= _MOST:
            _kept.pop(next(iter(_kept)))
        with jax.ensure_compile_time_eval():  # the call may stand inside a program that has these numbers as constants
            step = plain_step(robot, tasks, scheme, limits, dt) or Checked(robot, tasks, scheme, limits)
        _kept[key] = step
    return step


def _key(robot: Robot, tasks: Mapping[str, Task], scheme: Any, limits: Any) -> tuple[Any, ...]:
    of_scheme = None if scheme is None else jax.tree.structure(scheme)
    return robot.tree, of_scheme, *map(type, _given(limits)), jax.config.jax_enable_x64, *tasks  # pyright: ignore[reportAttributeAccessIssue]


def _given(limits: Any) -> Sequence[Any]:
    return () if limits is None else limits if isinstance(limits, tuple | list) else (limits,)


def plain_step(
    robot: Robot, tasks: Mapping[str, Task], scheme: Scheme | None, limits: Any, dt: Any
) -> PlainStep | None:
    """Return the step for checked arguments, none of them traced; None if the core has none."""
    if float_now() != np.float64:
        return None
    chosen = scheme_for(tasks, robot.q0.dtype) if scheme is None else scheme
    bounds = with_own_limits(robot, _given(limits))
    if not is_compiled(robot, robot.q0, dict(tasks), chosen, bounds, np.float64(dt), None):
        return None
    return None if missing_part(robot, tasks, chosen, bounds) else PlainStep(robot, tasks, scheme, limits, float(dt))


def _is_traced(tree: Any) -> bool:
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


class Checked:
    """Arguments that were checked, recognised by their identity.

    Args:
        robot: the robot.
        tasks: by name.
        scheme: how they share the robot, None for the default.
        limits: beside the robot's own, as they are given.
    """

    def __init__(self, robot: Robot, tasks: Mapping[str, Task], scheme: Scheme | None, limits: Any) -> None:
        self._seen, self._scheme, self._setting = dict(tasks), scheme, (robot, *_given(limits))
        self._look_at_gains()

    def has_checked(self, robot: Robot, tasks: Mapping[str, Task], limits: Any, dt: Any) -> bool:
        """Return whether nothing but targets and the scheme's numbers is new, and dt is ordinary."""
        same = all(self._seen[name] is task or _is_aimed(task, self._seen[name]) for name, task in tasks.items())
        return same and self._has(robot, limits) and isinstance(dt, float) and 0.0 < dt <= self._longest

    def _has(self, robot: Robot, limits: Any) -> bool:
        given = robot, *_given(limits)
        return len(given) == len(self._setting) and all(map(operator.is_, given, self._setting))

    def fits(self, tasks: Mapping[str, Task]) -> bool:
        """Return whether ``solution`` takes these tasks."""
        del tasks
        return True

    def solution(
        self,
        robot: Robot,
        q: Any,
        tasks: Mapping[str, Task],
        scheme: Any,
        limits: Any,
        dt: Any,
        targets: Any,
        warm_start: Any,
    ) -> Solution | None:
        """Return the solution as ``control.solve`` does, which has checked all but q; None if the core has it not."""
        del q, scheme, targets, dt, warm_start
        self._setting = robot, *_given(limits)
        if any(self._seen[name] is not task for name, task in tasks.items()):
            self._seen = dict(tasks)
            self._look_at_gains()
        return None

    def _look_at_gains(self) -> None:
        """Find the longest time of a step in which no gain is too large."""
        gains = [getattr(task, "gain", 0.0) for task in self._seen.values()]
        largest = max(float(np.asarray(getattr(gain, "maximum", gain))) for gain in gains)
        self._longest = LARGEST_GAIN / largest if largest > 0.0 else np.inf


class PlainStep(Checked):
    """A step of the core with its numbers; one thread at a time computes.

    Args:
        robot: the robot.
        tasks: by name.
        scheme: how they share the robot, None for the default.
        limits: beside the robot's own, as they are given.
        dt: time of a step [s].

    Attributes:
        as_arrays: from what ``solve`` returns to a solution, with JAX's arrays.
        unpacked: the same with NumPy's.
    """

    def __init__(self, robot: Robot, tasks: Mapping[str, Task], scheme: Scheme | None, limits: Any, dt: float) -> None:
        super().__init__(robot, tasks, scheme, limits)
        self._default = scheme_for(tasks, robot.q0.dtype) if scheme is None else scheme
        bounds = with_own_limits(robot, _given(limits))
        packed = pack(robot, tasks, self._default, bounds, dt)
        of_robot, q, numbered, of_scheme, of_limits, of_dt, _ = packed.numbered
        self._q, self._of_dt, self._dt = packed.place(q), packed.place(of_dt), dt
        self._parts, self._of_scheme = _places(packed, (of_robot, of_limits)), _places(packed, of_scheme)
        self._structure, self._own = jax.tree.structure((robot, bounds)), bounds[len(_given(limits)) :]
        self._leaves = {name: _places(packed, task) for name, task in numbered.items()}
        self._targets = {name: _places(packed, getattr(task, "target", None)) for name, task in numbered.items()}
        self._structures = {name: jax.tree.structure(task) for name, task in tasks.items()}
        self._labels = packed.rows.labels
        self._numbers, self._constants = packed.numbers, packed.constants
        self._result = np.zeros(robot.nv + 2 + 2 * packed.rows.rows)
        sizes = [int(np.prod(shape)) for shape in self._labels]
        self._guess, self._integers = np.zeros(sum(sizes), np.int32), np.zeros(3 + sum(sizes), np.int32)
        counts = tuple(sorted(packed.rows.count.items()))
        self.unpacked, self.as_arrays = _makers(type(self._default), robot.nv, counts, tuple(self._labels))
        self._free = functions().free  # while the process ends, modules are gone before objects
        self._handle = functions().new(packed.layout.ctypes.data, len(packed.layout))
        if not self._handle:
            raise MemoryError("there is no memory for a step")
        self._inputs = self._handle, self._constants.ctypes.data, self._numbers.ctypes.data
        guess = self._guess.ctypes.data
        self._guesses = guess, guess + self._guess.itemsize * sizes[0] if len(sizes) > 1 else None
        self._results = self._result.ctypes.data, self._integers.ctypes.data
        self._lock, self._clean = threading.Lock(), not np.isnan(self._numbers).any()

    def __del__(self) -> None:
        if getattr(self, "_handle", None):
            self._free(self._handle)

    def fits(self, tasks: Mapping[str, Task]) -> bool:
        """Return whether the tasks have the structure of those that were laid out."""
        return all(jax.tree.structure(task) == self._structures[name] for name, task in tasks.items())

    def solution(
        self,
        robot: Robot,
        q: Any,
        tasks: Mapping[str, Task],
        scheme: Any,
        limits: Any,
        dt: Any,
        targets: Any,
        warm_start: Any,
    ) -> Solution | None:
        """Return the solution as ``control.solve`` does, which has checked all but q; None if a number is traced."""
        values = None if isinstance(dt, Tracer) else plain_configuration(robot, q)
        if values is None:
            return None
        found = self.solve(robot, values, tasks, scheme, limits, float(dt), targets or {}, warm_start)
        return None if found is None else self.as_arrays(*found)

    def solve(
        self,
        robot: Robot,
        q: np.ndarray,
        tasks: Mapping[str, Task],
        scheme: Any,
        limits: Any,
        dt: float,
        targets: Mapping[str, Any],
        warm_start: Any = None,
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return numbers and integers of the answer; None where structures differ, or numbers are traced.

        Robot, tasks, scheme and limits that are new are copied.

        Args:
            robot: the robot.
            q: a checked configuration. (nq,)
            tasks: by name.
            scheme: None for the default.
            limits: as they are given.
            dt: time of the step [s].
            targets: of some tasks, as ``replace(target=...)`` takes them.
            warm_start: as in ``solve``.

        Raises:
            TypeError, ValueError: as ``replace``.
        """
        if tasks.keys() != self._seen.keys():
            return None
        aims = {name: self._converted(name, tasks[name], target) for name, target in targets.items()}
        guess = jax.tree.leaves(warm_start)
        if any(isinstance(number, Tracer) for parts in (*aims.values(), guess) for number in parts):
            return None
        if guess and [np.shape(labels) for labels in guess] != self._labels:
            return None
        with self._lock:
            if not (self._has(robot, limits) or self._takes_setting(robot, limits)):
                return None
            if scheme is not self._scheme and not self._takes_scheme(scheme):
                return None
            if not all([self._seen[name] is task or self._takes(name, task) for name, task in tasks.items()]):
                return None
            if dt != self._dt:
                self._numbers[self._of_dt] = self._dt = dt
            self._numbers[self._q] = q
            if guess:
                np.concatenate([np.asarray(labels).ravel() for labels in guess], out=self._guess, casting="unsafe")
            aimed = [self._aimed(name, tasks[name], parts) for name, parts in aims.items()]
            functions().step(*self._inputs, *(self._guesses if guess else (None, None)), self._clean, *self._results)
            for place, own in chain(*aimed):
                self._numbers[place] = own
            return self._result.copy(), self._integers.copy()

    def _converted(self, name: str, task: Task, target: Any) -> list[Any]:
        """Return the parts of a target as ``replace`` converts it."""
        if not self._targets[name]:
            task.replace(target=target)  # raises: the task has none
        return jax.tree.leaves(type(task)._convert(task, "target", target))

    def _takes_setting(self, robot: Robot, limits: Any) -> bool:
        """Copy the numbers of robot and limits; return whether they have the structure that was laid out."""
        given = _given(limits)
        if robot is not self._setting[0]:
            self._own = with_own_limits(robot, given)[len(given) :]
        leaves, structure = jax.tree.flatten((robot, (*given, *self._own)))
        if structure != self._structure or not self._fill(self._parts, leaves):
            return False
        self._setting = robot, *_given(limits)
        return True

    def _takes_scheme(self, scheme: Scheme) -> bool:
        """Copy the numbers of a scheme, whose structure is known; return whether none is traced."""
        if not self._fill(self._of_scheme, jax.tree.leaves(scheme)):
            return False
        self._scheme = scheme
        return True

    def _fill(self, places: Sequence[slice], leaves: Sequence[Any]) -> bool:
        """Copy numbers to their places; return whether they have the sizes of these, and none is traced."""
        sizes = [place.stop - place.start for place in places]
        if [np.size(leaf) for leaf in leaves] != sizes or _is_traced(leaves):
            return False
        for place, leaf in zip(places, leaves, strict=True):
            self._put(place, leaf)
        self._clean = not np.isnan(self._numbers).any()
        return True

    def _takes(self, name: str, task: Task) -> bool:
        """Copy the numbers of a task; return whether it has the structure of the one that was laid out."""
        if _is_aimed(task, self._seen[name]):
            places, leaves = self._targets[name], jax.tree.leaves(vars(task)["target"])
        else:
            places, (leaves, structure) = self._leaves[name], jax.tree.flatten(task)
            if structure != self._structures[name]:
                return False
        if not self._fill(places, leaves):
            return False
        self._seen[name] = task
        self._look_at_gains()
        return True

    def _aimed(self, name: str, task: Task, parts: Sequence[Any]) -> list[tuple[slice, np.ndarray]]:
        """Put the parts of a target in their places; return these with the numbers that were there."""
        before = []
        for place, part, own in zip(self._targets[name], parts, jax.tree.leaves(vars(task)["target"]), strict=True):
            if part is not own:
                before.append((place, self._numbers[place].copy()))
                self._put(place, part)
        return before

    def _put(self, place: slice, part: Any) -> None:
        self._numbers[place] = np.asarray(part).ravel()  # NumPy's ravel would run JAX's


def _is_aimed(task: Task, seen: Task) -> bool:
    """Return whether a task is another one with nothing but another target."""
    fields, before = vars(task), vars(seen)
    if type(task) is not type(seen) or fields.keys() != before.keys() or fields.get("target") is None:
        return False
    return before["target"] is not None and all(
        before[name] is value or name == "target" for name, value in fields.items()
    )


def _places(packed: Any, numbered: Any) -> list[slice]:
    return [packed.place(leaf) for leaf in jax.tree.leaves(numbered)]


def _unpacked(
    structure: Any,
    of_numbers: Sequence[Any],
    of_labels: Sequence[tuple[slice, tuple[int, ...]]],
    numbers: Any,
    integers: Any,
) -> Solution:
    """Return the solution whose leaves are in these places of the results."""
    velocity, *others = [numbers[place] for place in of_numbers]
    labels = [integers[place].reshape(shape) for place, shape in of_labels]
    leaves = [velocity, integers[0].astype(int), integers[1], integers[2], *others, *labels]
    return jax.tree.unflatten(structure, leaves)


def _leaf_places(
    nv: int, rows: Mapping[str, int], labels: Sequence[tuple[int, ...]]
) -> tuple[list[Any], list[tuple[slice, tuple[int, ...]]]]:
    """Return where the leaves of a solution are in ``StepResult`` of ``core/step_rows.hpp``."""
    of_numbers: list[Any] = [slice(nv), nv, nv + 1]
    at = nv + 2
    for count in [rows[name] for name in sorted(rows)] * 2:  # slacks, then errors
        of_numbers.append(slice(at, at + count))
        at += count
    of_labels, at = [], 3
    for shape in labels:
        of_labels.append((slice(at, at + int(np.prod(shape))), shape))
        at += int(np.prod(shape))
    return of_numbers, of_labels


@cache
def _makers(
    scheme: type[Scheme], nv: int, rows: tuple[tuple[str, int], ...], labels: tuple[tuple[int, ...], ...]
) -> tuple[Callable[..., Solution], Callable[..., Solution]]:
    """Return the functions from the core's results to a solution, with NumPy's arrays and with JAX's.

    Args:
        scheme: class of the scheme.
        nv: length of the velocity.
        rows: names of the tasks in their order, with the number of rows of each.
        labels: shapes of the warm start's arrays.
    """
    warm_start = {HierarchicalQP: WorkingSet(0, 0), WeightedQP: 0}.get(scheme)  # pyright: ignore[reportArgumentType]
    by_name = dict.fromkeys(dict(rows), 0)
    # a solution is made from its leaves, because its constructor takes as long as the step
    structure = jax.tree.structure(Solution(0, 0, 0, 0, 0, 0, by_name, by_name, warm_start))  # pyright: ignore[reportArgumentType]
    unpacked = partial(_unpacked, structure, *_leaf_places(nv, dict(rows), labels))
    return unpacked, jax.jit(unpacked)
