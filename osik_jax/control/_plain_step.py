"""Steps outside ``jit``: one call of the core, with numbers that were laid out once.

A program of JAX takes every leaf of robot, tasks and limits at each call, which is ten times the work of the step. Here
they are recognised by their identity, and only the configuration and what is new are copied.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from functools import cache, partial
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
from ._compiled_step import is_compiled
from ._packed_step import missing_part, pack
from ._solution import Solution

_MOST = 32
"""Number of steps that are kept; each has its workspace in the core, some hundred kilobytes."""
_kept: dict[tuple[Any, ...], tuple[PlainStep | None, Any]] = {}
"""Steps, None where the core has none, with the objects by whose identity each is found: they have to live as long."""


def kept_step(robot: Robot, tasks: Any, scheme: Any, limits: Any) -> PlainStep | None:
    """Return the step that is kept for the same robot, scheme and limits, and for tasks of the same names, if any."""
    return _kept.get(_key(robot, tasks, scheme, limits), (None,))[0] if type(tasks) is dict else None


def keep_step(
    robot: Robot, q: Any, tasks: Mapping[str, Task], scheme: Scheme | None, limits: Limits | None, dt: Any
) -> PlainStep | None:
    """Return the step for checked arguments, and keep it; None if the core has none, or numbers are traced."""
    if _is_traced((robot, q, dict(tasks), scheme, limits, dt)):
        return None
    key = _key(robot, tasks, scheme, limits)
    step, _ = _kept.get(key, (None, None))
    if key not in _kept or (step is not None and not step.fits(tasks)):
        while len(_kept) >= _MOST:
            _kept.pop(next(iter(_kept)))
        with jax.ensure_compile_time_eval():  # the call may stand inside a program that has these numbers as constants
            step = plain_step(robot, tasks, scheme, checked_limits(robot, limits), dt)
        _kept[key] = step, (robot, scheme, tuple(limits) if isinstance(limits, tuple | list) else limits)
    return step


def _key(robot: Robot, tasks: Mapping[str, Task], scheme: Any, limits: Any) -> tuple[Any, ...]:
    of_limits = tuple(map(id, limits)) if isinstance(limits, tuple | list) else id(limits)
    return id(robot), id(scheme), of_limits, jax.config.jax_enable_x64, *tasks  # pyright: ignore[reportAttributeAccessIssue]


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


class PlainStep:
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
        self._seen = dict(tasks)
        self._leaves = {name: _places(packed, task) for name, task in numbered.items()}
        self._targets = {name: _places(packed, getattr(task, "target", None)) for name, task in numbered.items()}
        self._structures = {name: jax.tree.structure(task) for name, task in tasks.items()}
        self._labels = packed.rows.labels
        self._numbers, self._constants = packed.numbers, packed.constants
        self._result = np.zeros(robot.nv + 2 + 2 * packed.rows.rows)
        sizes = [int(np.prod(shape)) for shape in self._labels]
        self._guess, self._integers = np.zeros(sum(sizes), np.int32), np.zeros(3 + sum(sizes), np.int32)
        structure = _structure(tuple(sorted(tasks)), type(scheme))
        self.unpacked = partial(_unpacked, structure, _leaf_places(robot.nv, packed.rows.count, self._labels))
        self.as_arrays = jax.jit(self.unpacked)
        self._free = functions().free  # while the process ends, modules are gone before objects
        self._handle = functions().new(packed.layout.ctypes.data, len(packed.layout))
        if not self._handle:
            raise MemoryError("there is no memory for a step")
        self._inputs = self._handle, self._constants.ctypes.data, self._numbers.ctypes.data
        guess = self._guess.ctypes.data
        self._guesses = guess, guess + self._guess.itemsize * sizes[0] if len(sizes) > 1 else None
        self._results = self._result.ctypes.data, self._integers.ctypes.data
        self._lock = threading.Lock()
        self._look_at_numbers()

    def __del__(self) -> None:
        if getattr(self, "_handle", None):
            self._free(self._handle)

    def has_checked(self, tasks: Mapping[str, Task], dt: Any) -> bool:
        """Return whether nothing but targets is new since the tasks were laid out or taken, and dt is ordinary."""
        same = all(self._seen[name] is task or _is_aimed(task, self._seen[name]) for name, task in tasks.items())
        return same and isinstance(dt, float) and 0.0 < dt <= self._longest

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
                np.concatenate([np.ravel(labels) for labels in guess], out=self._guess, casting="unsafe")
            own = {name: self._exchanged(self._targets[name], parts) for name, parts in aims.items()}
            functions().step(*self._inputs, *(self._guesses if guess else (None, None)), self._clean, *self._results)
            for name, parts in own.items():
                self._exchanged(self._targets[name], parts)
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
        self._exchanged(places, leaves)
        self._seen[name] = task
        self._look_at_numbers()
        return True

    def _exchanged(self, places: Sequence[slice], parts: Sequence[Any]) -> list[np.ndarray]:
        """Put numbers in their places; return those that were there."""
        before = [self._numbers[place].copy() for place in places]
        for place, part in zip(places, parts, strict=True):
            self._numbers[place] = np.ravel(part)
        return before

    def _look_at_numbers(self) -> None:
        """Find whether no number is NaN, and the longest time of a step in which no gain is too large."""
        self._clean = not np.isnan(self._numbers).any()
        gain = max(float(np.asarray(task.gain)) for task in self._seen.values())
        self._longest = LARGEST_GAIN / gain if gain > 0.0 else np.inf


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
    structure: Any, places: Sequence[tuple[bool, Any, tuple[int, ...]]], numbers: Any, integers: Any
) -> Solution:
    """Return the solution; places are those of its leaves: whether they are integers, where, and their shape."""
    leaves = [(integers if is_integer else numbers)[place] for is_integer, place, _ in places]
    shaped = [leaf.reshape(shape) if len(shape) > 1 else leaf for leaf, (*_, shape) in zip(leaves, places, strict=True)]
    shaped[1] = shaped[1].astype(int)
    return jax.tree.unflatten(structure, shaped)


def _leaf_places(nv: int, rows: Mapping[str, int], labels: Sequence[tuple[int, ...]]) -> list[tuple[bool, Any, Any]]:
    """Return where the leaves of a solution are in ``StepResult`` of ``core/step_rows.hpp``."""
    found: list[tuple[bool, Any, Any]] = [(False, slice(nv), ()), *((True, k, ()) for k in range(3))]
    found += [(False, nv, ()), (False, nv + 1, ())]
    at = nv + 2
    for count in [rows[name] for name in sorted(rows)] * 2:  # slacks, then errors
        found.append((False, slice(at, at + count), ()))
        at += count
    at = 3
    for shape in labels:
        found.append((True, slice(at, at + int(np.prod(shape))), shape))
        at += int(np.prod(shape))
    return found


@cache
def _structure(names: tuple[str, ...], scheme: type[Scheme]) -> Any:
    """Return the tree of a solution: making it by its constructor takes as long as the step."""
    warm_start = {HierarchicalQP: WorkingSet(0, 0), WeightedQP: 0}.get(scheme)  # pyright: ignore[reportArgumentType]
    by_name = dict.fromkeys(names, 0)
    return jax.tree.structure(Solution(0, 0, 0, 0, 0, 0, by_name, by_name, warm_start))  # pyright: ignore[reportArgumentType]
