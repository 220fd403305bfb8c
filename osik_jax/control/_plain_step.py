"""Steps outside ``jit``: one call of the core, with numbers that were laid out once.

A program of JAX takes every leaf of robot, tasks and limits at each call, which is ten times the work of the step. Here
they are recognised by their identity, and only the configuration and what is new are copied.
"""

from __future__ import annotations

import itertools
import operator
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from ..core._plain import functions
from ..limits import CollisionAvoidanceLimit, Limit, NoLimits, with_own_limits
from ..numerics._host import float_now, is_traced, untraced
from ..robot import Robot
from ..schemes import Scheme
from ..schemes._default import scheme_for
from ..tasks import Task
from ._checks import LARGEST_GAIN, plain_configuration
from ._compiled_step import given_rows, is_compiled, leaf_places, missing_part, row_parts, solution_shapes
from ._packed_step import arguments_of, pack
from ._plain_rows import PlainRows, with_plain_rows
from ._solution import Solution

_MOST = 64
"""Number of steps that are kept; each has its workspace in the core, some hundred kilobytes."""
_kept: OrderedDict[Any, Checked] = OrderedDict()
"""Steps by the structure of their arguments, those used last at the end."""
_lock = threading.Lock()
_UNKNOWN = object()
"""Stands for arguments whose numbers are being copied: an interrupted copy is made again."""


def kept_step(robot: Any, tasks: Any, scheme: Any, limits: Any) -> Checked | None:
    """Return the step for arguments of this structure, None if there is none."""
    key = _key(robot, tasks, scheme, limits)
    with _lock:
        step = _kept.get(key)
        if step is not None:
            _kept.move_to_end(key)
    return step


def keep_step(
    robot: Robot,
    q: Any,
    tasks: Mapping[str, Task],
    scheme: Scheme | None,
    limits: tuple[Limit, ...] | None,
    dt: Any,
) -> Checked | None:
    """Return a step for checked arguments, and keep it; None if a number is traced, or may be changed in place."""
    key, numbers = _key(robot, tasks, scheme, limits), (robot, dict(tasks), scheme, limits)
    if key is None or is_traced((q, dt)) or _is_open(numbers) or robot.q0.dtype != float_now():
        return None
    with untraced():  # the call may stand inside a program that has these numbers as constants
        step = plain_step(robot, tasks, scheme, limits, dt) or Checked(robot, tasks, scheme, limits)
    with _lock:
        _kept[key] = step
        if len(_kept) > _MOST:
            _kept.popitem(last=False)
    return step


def _key(robot: Any, tasks: Any, scheme: Any, limits: Any) -> Any:
    """Return the structure of the arguments, None where they are no arguments of ``solve`` or have none."""
    if not isinstance(robot, Robot) or type(tasks) is not dict:
        return None
    if not (limits is None or isinstance(limits, tuple | list | NoLimits)):
        return None
    kinds = *map(type, _given(limits)), None if scheme is None else jax.tree.structure(scheme)
    key = robot.tree, float_now(), *kinds, *tasks, *map(jax.tree.structure, tasks.values())
    try:
        hash(key)
    except TypeError:  # of something static in a task
        return None
    return key


def _given(limits: Any) -> Sequence[Any]:
    """Return the limits beside the robot's own."""
    return () if limits is None else limits if isinstance(limits, tuple | list) else (limits,)


def plain_step(
    robot: Robot, tasks: Mapping[str, Task], scheme: Scheme | None, limits: Any, dt: Any
) -> PlainStep | None:
    """Return the step for checked arguments, none of them traced; None if the core has none."""
    if float_now() != np.float64 or _is_open((robot, dict(tasks), scheme, limits)):
        return None
    chosen = scheme_for(tasks, robot.q0.dtype) if scheme is None else scheme
    bounds = with_own_limits(robot, _given(limits))
    if not is_compiled(robot, robot.q0, dict(tasks), chosen, bounds, np.float64(dt), None):
        return None
    others = [limit for limit in bounds if limit not in with_plain_rows(bounds)]
    if missing_part(robot, {}, chosen, others) is not None:
        return None
    if any(type(task).after is not Task.after for task in tasks.values() if isinstance(task.core(robot), str)):
        return None  # their rows are of the step before, too
    return PlainStep(robot, tasks, scheme, limits, float(dt), chosen, bounds)


def _is_open(tree: Any) -> bool:
    """Return whether a number is traced, or of NumPy and so may change in place."""
    return any(isinstance(leaf, Tracer | np.ndarray) for leaf in jax.tree.leaves(tree))


class Checked:
    """Arguments of ``solve`` that were checked, recognised by their identity."""

    def __init__(self, robot: Robot, tasks: Mapping[str, Task], scheme: Scheme | None, limits: Any) -> None:
        self._seen: dict[str, Any] = dict(tasks)
        self._scheme: Any = scheme
        self._setting: tuple[Any, ...] = robot, *_given(limits)
        self._look_at_gains()

    def has_checked(self, robot: Robot, tasks: Mapping[str, Task], limits: Any, dt: Any) -> bool:
        """Return whether nothing but targets and the scheme's numbers is new, and dt is ordinary."""
        if not isinstance(tasks, dict) or tasks.keys() != self._seen.keys() or not self._has(robot, limits):
            return False
        same = all(self._seen[name] is task or _is_aimed(task, self._seen[name]) for name, task in tasks.items())
        return same and isinstance(dt, float) and 0.0 < dt <= self._longest

    def _has(self, robot: Robot, limits: Any) -> bool:
        given = robot, *_given(limits)
        return len(given) == len(self._setting) and all(map(operator.is_, given, self._setting))

    def note(self, robot: Robot, tasks: Mapping[str, Task], limits: Any) -> None:
        """Recognise these arguments from now on, which were checked, unless their numbers may change."""
        if not _is_open((robot, dict(tasks), limits)):
            self._setting, self._seen = (robot, *_given(limits)), dict(tasks)
            self._look_at_gains()

    def _look_at_gains(self) -> None:
        """Find the longest time of a step in which no gain is too large."""
        gains = [getattr(task, "gain", 0.0) for task in self._seen.values()]
        largest = max(float(np.asarray(getattr(gain, "maximum", gain))) for gain in gains)
        self._longest = LARGEST_GAIN / largest if largest > 0.0 else np.inf


class PlainStep(Checked):
    """A step of the core with its numbers; one thread at a time computes.

    ``scheme`` and ``limits`` are those that ``solve`` was given; ``chosen`` is the scheme that is used, and ``bounds``
    are all limits, the given ones first.

    Attributes:
        as_arrays: from what ``solve`` returns to a solution, with JAX's arrays.
        unpacked: the same with NumPy's.
    """

    def __init__(
        self,
        robot: Robot,
        tasks: Mapping[str, Task],
        scheme: Scheme | None,
        limits: Any,
        dt: float,
        chosen: Scheme,
        bounds: Sequence[Limit],
    ) -> None:
        super().__init__(robot, tasks, scheme, limits)
        avoiding = with_plain_rows(bounds)
        arguments = arguments_of(robot, tasks, chosen, bounds, dt)
        leaves, structure = jax.tree.flatten(arguments)
        shapes = tuple((np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
        given, _ = jax.eval_shape(given_rows, *arguments[:4], (), dt)
        packed = pack(robot, tasks, chosen, bounds, dt, sum(limit.max_pairs for limit in avoiding), given)
        self._given, self._given_rows = packed.given, _given_program(structure, shapes) if given else None
        of_robot, q, numbered, of_scheme, of_limits, of_dt, _ = packed.numbered
        self._q, self._of_dt = packed.place(q), packed.place(of_dt)
        self._dt: Any = dt
        self._parts, self._of_scheme = _places(packed, (of_robot, of_limits)), _places(packed, of_scheme)
        self._structure, self._scheme_structure = jax.tree.structure((robot, bounds)), jax.tree.structure(chosen)
        self._own, self._own_robot = bounds[len(_given(limits)) :], robot
        self._leaves = {name: _places(packed, task) for name, task in numbered.items()}
        self._targets = {name: _places(packed, getattr(task, "target", None)) for name, task in numbered.items()}
        self._structures = {name: jax.tree.structure(task) for name, task in tasks.items()}
        self._labels = packed.rows.labels
        self._numbers, self._constants = packed.numbers, packed.constants
        self._rows = self._rows_in(packed, avoiding)
        self._result = np.zeros(robot.nv + 2 + 2 * packed.rows.rows)
        sizes = [int(np.prod(shape)) for shape in self._labels]
        self._guess, self._integers = np.zeros(sum(sizes), np.int32), np.zeros(3 + sum(sizes), np.int32)
        counts = tuple(sorted(packed.rows.count.items()))
        self.unpacked, self.as_arrays = _makers(type(chosen), robot.nv, counts, tuple(self._labels))
        self._free = functions().free  # while the process ends, modules are gone before objects
        self._handle = functions().new(packed.layout.ctypes.data, len(packed.layout))
        if not self._handle:
            raise MemoryError("there is no memory for a step")
        self._inputs = self._handle, self._constants.ctypes.data, self._numbers.ctypes.data
        self._q_address = self._numbers[self._q].ctypes.data
        guess = self._guess.ctypes.data
        self._guesses = guess, guess + self._guess.itemsize * sizes[0] if len(sizes) > 1 else None
        self._results = self._result.ctypes.data, self._integers.ctypes.data
        self._lock, self._clean = threading.Lock(), not np.isnan(self._numbers).any()

    def __del__(self) -> None:
        if getattr(self, "_handle", None):
            self._free(self._handle)

    def is_of(self, robot: Robot, tasks: Mapping[str, Task], scheme: Scheme, limits: Any) -> bool:
        """Return whether the arguments have the structure that was laid out."""
        structure = jax.tree.structure
        same = {name: structure(task) for name, task in tasks.items()} == self._structures
        bounds = None if self._has(robot, limits) else with_own_limits(robot, _given(limits))
        same = same and (bounds is None or structure((robot, bounds)) == self._structure)
        return same and structure(scheme) == self._scheme_structure and self.fits(tasks)

    def fits(self, tasks: Mapping[str, Task]) -> bool:
        """Return whether tasks of the same structure have numbers of the sizes that were laid out."""
        sizes = {name: [place.stop - place.start for place in places] for name, places in self._leaves.items()}
        return {name: [np.size(leaf) for leaf in jax.tree.leaves(task)] for name, task in tasks.items()} == sizes

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
        """Return the answer of ``solve``, which has checked all but q; None: it takes a program of JAX."""
        is_program = isinstance(dt, Tracer) or jax.config.jax_disable_jit  # pyright: ignore[reportAttributeAccessIssue]
        values = None if is_program else plain_configuration(robot, q)
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

        The arguments are those of ``solve``, and q is checked. Robot, tasks, scheme and limits that are new are copied.

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
                self._dt = _UNKNOWN
                self._numbers[self._of_dt] = dt
                self._dt = dt
            self._numbers[self._q] = q
            if guess:
                np.concatenate([np.asarray(labels).ravel() for labels in guess], out=self._guess, casting="unsafe")
            guesses = self._guesses if guess else (None, None)
            own: list[tuple[slice, np.ndarray]] = []
            try:
                for name, parts in aims.items():
                    self._aim(name, tasks[name], parts, own)
                for rows in self._rows:
                    rows.fill(self._q_address, dt)
                if self._given_rows is not None:
                    with untraced():
                        self._numbers[self._given] = self._given_rows(self._numbers)
                functions().step(*self._inputs, *guesses, self._clean, *self._results)
            finally:  # also where Ctrl-C ends the call
                for place, numbers in own:
                    self._numbers[place] = numbers
            return self._result.copy(), self._integers.copy()

    def _rows_in(self, packed: Any, avoiding: Sequence[CollisionAvoidanceLimit]) -> list[PlainRows]:
        """Return the rows of limits, each in its part of the last leaves."""
        if not avoiding:
            return []
        count = len(packed.places)
        jacobian, lower = (self._numbers[packed.place(count - k)] for k in (3, 2))
        jacobian, ends = jacobian.reshape(len(lower), -1), np.cumsum([limit.max_pairs for limit in avoiding])
        parts = zip(np.split(jacobian, ends[:-1]), np.split(lower, ends[:-1]), strict=True)
        return [PlainRows(limit, *part) for limit, part in zip(avoiding, parts, strict=True)]

    def _converted(self, name: str, task: Task, target: Any) -> list[Any]:
        """Return the parts of a target as ``replace`` converts it."""
        if not self._targets[name]:
            task.replace(target=target)  # raises: the task has none
        return jax.tree.leaves(type(task)._convert(task, "target", target))

    def _takes_setting(self, robot: Robot, limits: Any) -> bool:
        """Copy the numbers of robot and limits; return whether they have the structure that was laid out."""
        given, own = tuple(_given(limits)), self._own
        if robot is not self._own_robot:
            with jax.ensure_compile_time_eval():
                own = with_own_limits(robot, given)[len(given) :]
        leaves, structure = jax.tree.flatten((robot, (*given, *own)))
        self._setting = (_UNKNOWN,)
        if structure != self._structure or not self._fill(self._parts, leaves):
            return False
        for rows, limit in zip(self._rows, with_plain_rows(given), strict=True):
            rows.take(limit)
        self._own, self._own_robot, self._setting = own, robot, (robot, *given)
        return True

    def _takes_scheme(self, scheme: Any) -> bool:
        """Copy the numbers of a scheme; return whether it has the structure that was laid out."""
        leaves, structure = jax.tree.flatten(scheme)
        self._scheme = _UNKNOWN
        if structure != self._scheme_structure or not self._fill(self._of_scheme, leaves):
            return False
        self._scheme = scheme
        return True

    def _fill(self, places: Sequence[slice], leaves: Sequence[Any]) -> bool:
        """Copy numbers to their places; return whether they have the sizes of these, and stay as they are."""
        sizes = [place.stop - place.start for place in places]
        if [np.size(leaf) for leaf in leaves] != sizes or _is_open(leaves):
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
        self._seen[name] = _UNKNOWN
        if not self._fill(places, leaves):
            return False
        self._seen[name] = task
        self._look_at_gains()
        return True

    def _aim(self, name: str, task: Task, parts: Sequence[Any], before: list[tuple[slice, np.ndarray]]) -> None:
        """Put the parts of a target in their places, and those that were there into ``before``."""
        for place, part, own in zip(self._targets[name], parts, jax.tree.leaves(vars(task)["target"]), strict=True):
            if part is not own:
                before.append((place, self._numbers[place].copy()))
                self._put(place, part)

    def _put(self, place: slice, part: Any) -> None:
        self._numbers[place] = np.asarray(part).ravel()  # NumPy's ravel would run JAX's


@lru_cache
def _given_program(structure: Any, shapes: tuple[tuple[tuple[int, ...], Any], ...]) -> Callable[[Any], Array]:
    """Return the program from the numbers of a step to the rows that JAX computes, as ``pack`` lays out both."""
    ends = np.cumsum([0, *(int(np.prod(shape)) for shape, _ in shapes)]).tolist()

    def given(numbers: Array) -> Array:
        parts = [numbers[first:end] for first, end in itertools.pairwise(ends)]
        leaves = [part.reshape(shape).astype(kind) for part, (shape, kind) in zip(parts, shapes, strict=True)]
        robot, q, tasks, scheme, _, dt, _ = jax.tree.unflatten(structure, leaves)
        rows, _ = given_rows(robot, q, tasks, scheme, (), dt)
        return jnp.concatenate([part.ravel() for own in rows.values() for part in row_parts(own) if part is not None])

    return jax.jit(given)


def _is_aimed(task: Any, seen: Any) -> bool:
    """Return whether a task is the one that was seen, with another target."""
    if type(task) is not type(seen) or not isinstance(task, Task):
        return False
    fields, before = vars(task), vars(seen)
    if fields.keys() != before.keys() or fields.get("target") is None or before["target"] is None:
        return False
    return all(before[name] is value or name == "target" for name, value in fields.items())


def _places(packed: Any, numbered: Any) -> list[slice]:
    return [packed.place(leaf) for leaf in jax.tree.leaves(numbered)]


@lru_cache(maxsize=256)
def _makers(
    scheme: type[Scheme], nv: int, rows: tuple[tuple[str, int], ...], labels: tuple[tuple[int, ...], ...]
) -> tuple[Callable[..., Solution], Callable[..., Solution]]:
    """Return the functions from the core's results to a solution, with NumPy's arrays and with JAX's.

    The arguments are those of ``solution_shapes``, with the rows as pairs.
    """
    leaves, structure = jax.tree.flatten(solution_shapes(scheme, nv, dict(rows), labels))
    # numbers by their index: a slice and its shape take longer
    places = [
        (kind, place if leaf.shape else place.start)
        for leaf, (kind, place) in zip(leaves, leaf_places(leaves), strict=True)
    ]
    matrices = [(k, leaf.shape) for k, leaf in enumerate(leaves) if leaf.ndim > 1]

    def unpacked(numbers: Any, integers: Any) -> Solution:
        found = [(integers, numbers)[kind][place] for kind, place in places]
        found[1] = found[1].astype(int)  # the status
        for k, shape in matrices:
            found[k] = found[k].reshape(shape)
        return jax.tree.unflatten(structure, found)

    return unpacked, jax.jit(unpacked)
