"""Steps outside ``jit``: one call of the core, with numbers that were laid out once.

A program of JAX takes every leaf of robot, tasks and limits at each call, which is ten times the work of the step. Here
they are recognised by their identity, and only the configuration and what is new are copied.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from functools import cache, partial
from itertools import chain
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ..core._plain import functions
from ..limits import Limit, Limits, with_own_limits
from ..robot import Robot
from ..schemes import HierarchicalQP, Scheme, WeightedQP
from ..schemes._default import scheme_for
from ..solvers.hqp import WorkingSet
from ..tasks import Task
from ._checks import LARGEST_GAIN, checked_limits, plain_configuration
from ._compiled_step import SIMPLE_LIMITS, is_compiled
from ._packed_step import missing_part, pack
from ._solution import Solution

_MOST = 32
"""Number of steps that are kept; each has its workspace in the core, some hundred kilobytes."""
_kept: dict[tuple[Any, ...], tuple[Checked, Any]] = {}
"""Steps, with the objects by whose identity each is found: they have to live as long."""


def kept_step(robot: Robot, tasks: Any, scheme: Any, limits: Any) -> Checked | None:
    """Return what is kept for the same robot, scheme and limits, and for tasks of the same names, if anything."""
    return _kept.get(_key(robot, tasks, scheme, limits), (None,))[0] if type(tasks) is dict else None


def keep_step(
    robot: Robot, q: Any, tasks: Mapping[str, Task], scheme: Scheme | None, limits: Limits | None, dt: Any
) -> Checked | None:
    """Return a step of the core for checked arguments, and keep it, or that all was checked; None if traced."""
    if _is_traced((robot, q, dict(tasks), scheme, limits, dt)) or robot.q0.dtype != jnp.result_type(float):
        return None
    key = _key(robot, tasks, scheme, limits)
    step = _kept[key][0] if key in _kept else None
    if step is None or not step.fits(tasks):
        while len(_kept) >= _MOST:
            _kept.pop(next(iter(_kept)))
        with jax.ensure_compile_time_eval():  # the call may stand inside a program that has these numbers as constants
            step = plain_step(robot, tasks, scheme, checked_limits(robot, limits), dt) or Checked(tasks)
        _kept[key] = step, (robot, scheme, tuple(limits) if isinstance(limits, tuple | list) else limits)
    return step


def _key(robot: Robot, tasks: Mapping[str, Task], scheme: Any, limits: Any) -> tuple[Any, ...]:
    """Return what a step is found by; limits that the core does not have change from step to step."""
    given = limits if isinstance(limits, tuple | list) else (limits,)
    of_limits = [id(limit) if limit is None or type(limit) in SIMPLE_LIMITS else type(limit) for limit in given]
    return id(robot), id(scheme), *of_limits, jax.config.jax_enable_x64, *tasks  # pyright: ignore[reportAttributeAccessIssue]


def plain_step(
    robot: Robot, tasks: Mapping[str, Task], scheme: Scheme | None, limits: tuple[Limit, ...] | None, dt: Any
) -> PlainStep | None:
    """Return the step for checked arguments, none of them traced; None if the core has none."""
    if jnp.result_type(float) != np.float64:
        return None
    chosen, bounds = scheme_for(tasks, robot.q0.dtype) if scheme is None else scheme, with_own_limits(robot, limits)
    if not is_compiled(robot, robot.q0, dict(tasks), chosen, bounds, np.float64(dt), None):
        return None
    return None if missing_part(robot, tasks, chosen, bounds) else PlainStep(robot, tasks, chosen, bounds, float(dt))


def _is_traced(tree: Any) -> bool:
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


class Checked:
    """Tasks that were checked, recognised by their identity.

    Args:
        tasks: by name.
    """

    def __init__(self, tasks: Mapping[str, Task]) -> None:
        self._seen = dict(tasks)
        self._look_at_gains()

    def has_checked(self, tasks: Mapping[str, Task], dt: Any) -> bool:
        """Return whether nothing but targets is new in the tasks, and dt is ordinary."""
        same = all(self._seen[name] is task or _is_aimed(task, self._seen[name]) for name, task in tasks.items())
        return same and isinstance(dt, float) and 0.0 < dt <= self._longest

    def fits(self, tasks: Mapping[str, Task]) -> bool:
        """Return whether ``solution`` takes these tasks."""
        del tasks
        return True

    def solution(
        self, robot: Robot, q: Any, tasks: Mapping[str, Task], targets: Any, dt: Any, warm_start: Any
    ) -> Solution | None:
        """Return the solution as ``control.solve`` does, which has checked all but q; None if the core has it not."""
        del robot, q, targets, dt, warm_start
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
        scheme: how they share the robot.
        bounds: all limits.
        dt: time of a step [s].

    Attributes:
        as_arrays: from what ``solve`` returns to a solution, with JAX's arrays.
        unpacked: the same with NumPy's.
    """

    def __init__(
        self, robot: Robot, tasks: Mapping[str, Task], scheme: Scheme, bounds: Sequence[Limit], dt: float
    ) -> None:
        packed = pack(robot, tasks, scheme, bounds, dt)
        _, q, numbered, _, _, of_dt, _ = packed.numbered
        self._q, self._of_dt, self._dt = packed.place(q), packed.place(of_dt), dt
        super().__init__(tasks)
        self._leaves = {name: _places(packed, task) for name, task in numbered.items()}
        self._targets = {name: _places(packed, getattr(task, "target", None)) for name, task in numbered.items()}
        self._structures = {name: jax.tree.structure(task) for name, task in tasks.items()}
        self._labels = packed.rows.labels
        self._numbers, self._constants = packed.numbers, packed.constants
        self._result = np.zeros(robot.nv + 2 + 2 * packed.rows.rows)
        sizes = [int(np.prod(shape)) for shape in self._labels]
        self._guess, self._integers = np.zeros(sum(sizes), np.int32), np.zeros(3 + sum(sizes), np.int32)
        structure = _structure(tuple(sorted(tasks)), type(scheme))
        self.unpacked = partial(_unpacked, structure, *_leaf_places(robot.nv, packed.rows.count, self._labels))
        self.as_arrays = jax.jit(self.unpacked)
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
        self, robot: Robot, q: Any, tasks: Mapping[str, Task], targets: Any, dt: Any, warm_start: Any
    ) -> Solution | None:
        """Return the solution as ``control.solve`` does, which has checked all but q; None if a number is traced."""
        values = None if isinstance(dt, Tracer) else plain_configuration(robot, q)
        if values is None:
            return None
        found = self.solve(values, tasks, targets or {}, float(dt), warm_start)
        return None if found is None else self.as_arrays(*found)

    def solve(
        self, q: np.ndarray, tasks: Mapping[str, Task], targets: Mapping[str, Any], dt: float, warm_start: Any
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return numbers and integers of the answer; None where structures differ, or numbers are traced.

        Args:
            q: a checked configuration. (nq,)
            tasks: by name; those that are new are copied.
            targets: of some tasks, as ``replace(target=...)`` takes them.
            dt: time of the step [s].
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

    def _takes(self, name: str, task: Task) -> bool:
        """Copy the numbers of a task; return whether it has the structure of the one that was laid out."""
        if _is_aimed(task, self._seen[name]):
            places, leaves = self._targets[name], jax.tree.leaves(vars(task)["target"])
        else:
            places, (leaves, structure) = self._leaves[name], jax.tree.flatten(task)
            if structure != self._structures[name]:
                return False
        sizes = [place.stop - place.start for place in places]
        if [np.size(leaf) for leaf in leaves] != sizes or _is_traced(leaves):
            return False
        for place, leaf in zip(places, leaves, strict=True):
            self._put(place, leaf)
        self._seen[name], self._clean = task, not np.isnan(self._numbers).any()
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
def _structure(names: tuple[str, ...], scheme: type[Scheme]) -> Any:
    """Return the tree of a solution: making it by its constructor takes as long as the step."""
    warm_start = {HierarchicalQP: WorkingSet(0, 0), WeightedQP: 0}.get(scheme)  # pyright: ignore[reportArgumentType]
    by_name = dict.fromkeys(names, 0)
    return jax.tree.structure(Solution(0, 0, 0, 0, 0, 0, by_name, by_name, warm_start))  # pyright: ignore[reportArgumentType]
