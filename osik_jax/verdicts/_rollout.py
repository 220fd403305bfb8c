"""Verdict on a rollout: which targets it met, and what stops it at the end."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from ..batching._structure import Static, put_together, taken_apart
from ..control import Trajectory
from ..control._checks import check_setting, check_targets
from ..control._rollout import remembering
from ..control._step import Targets, Tasks, aim
from ..limits import Limits
from ..robot import Robot
from ..schemes import Scheme
from ..solvers import Status
from ._step import StepVerdict, as_tolerances, check_concrete, errors_of, explain_step, in_words


class RolloutVerdict(NamedTuple):
    """Verdict on a rollout; ``print`` shows it in words.

    Attributes:
        errors: of each goal after each step, against the target of that step: [m] and [rad]. {name: (steps, 2)}
        missed: number of steps after which each goal is beyond its tolerance, by name.
        met_from: the step after which each goal is within its tolerance up to the end; None if it ends beyond.
        failed: number of steps that are not SOLVED.
        last: verdict on the last step, if a goal ends beyond its tolerance.
        text: the verdict in words.
    """

    errors: dict[str, Float[np.ndarray, "steps 2"]]
    missed: dict[str, int]
    met_from: dict[str, int | None]
    failed: int
    last: StepVerdict | None
    text: str

    def __str__(self) -> str:
        return self.text


def explain_rollout(
    robot: Robot,
    path: Trajectory,
    tasks: Tasks | Callable[[Array], Tasks],
    *,
    scheme: Scheme | None = None,
    limits: Limits | None = None,
    dt: float = 0.005,
    targets: Targets | None = None,
    position_tolerance: float = 1e-3,
    orientation_tolerance: float = 1e-2,
) -> RolloutVerdict:
    """Return how many targets a rollout met, from which step on, and what stops it at the end.

    SOLVED says that each step is the best one, not that targets are met. Give the arguments of the rollout.

    Args:
        robot: the robot.
        path: of one robot, what ``rollout`` returned.
        tasks: as in ``rollout``.
        scheme: as in ``rollout``.
        limits: as in ``rollout``.
        dt: as in ``rollout``.
        targets: as in ``rollout``.
        position_tolerance: error up to which a goal is met [m]; errors in other units count as metres.
        orientation_tolerance: the same for angles [rad].

    Raises:
        KeyError, TypeError, ValueError: as in ``rollout``; something is traced, or a tolerance is not positive.
    """
    check_concrete("explain_rollout", robot, path, tasks, targets)
    check_setting("explain_rollout(robot, path, tasks)", robot, scheme, dt)
    steps = len(path.time)
    check_targets(tasks, targets, steps, robot)
    allowed = as_tolerances(position_tolerance, orientation_tolerance)
    numbers, static = taken_apart(tasks if callable(tasks) else dict(tasks))
    errors = jax.device_get(_errors(robot, path.q[1:], path.time, numbers, targets, static=static))
    beyond = {name: (error > allowed).any(1) for name, error in errors.items()}
    last = None
    if steps and any(own[-1] for own in beyond.values()):
        now = dict(tasks(path.time[-1]) if callable(tasks) else tasks)
        now, limits = remembering((now, limits), path.solution.velocity[-1], True)
        settings: Any = dict(scheme=scheme, limits=limits, dt=dt, targets=jax.tree.map(lambda a: a[-1], targets))
        settings |= dict(position_tolerance=position_tolerance, orientation_tolerance=orientation_tolerance)
        last = explain_step(robot, path.q[-1], now, **settings)
    failed = int((np.asarray(path.solution.status) != Status.SOLVED).sum())
    return _verdict(errors, beyond, failed, last)


@partial(jax.jit, static_argnames="static")
def _errors(
    robot: Robot, q: Array, time: Array, numbers: Any, targets: Targets | None, *, static: Static
) -> dict[str, Float[Array, "steps 2"]]:
    tasks: Any = put_together(numbers, static)

    def one(now: tuple[Array, Array, Targets | None]) -> dict[str, Array]:
        here, t, target = now
        aimed: Any = tasks(t) if callable(tasks) else aim(tasks, target)
        return errors_of(robot, here, aimed)

    return jax.lax.map(one, (q, time, targets), batch_size=16)


def _verdict(
    errors: dict[str, np.ndarray], beyond: dict[str, np.ndarray], failed: int, last: StepVerdict | None
) -> RolloutVerdict:
    steps = len(next(iter(beyond.values()), ()))
    missed = {name: int(own.sum()) for name, own in beyond.items()}
    met_from = {name: _met_from(own) for name, own in beyond.items()}
    lines = [f"{failed} of {steps} steps are not SOLVED"] if failed else []
    for name, error in errors.items():
        if not missed[name]:
            lines.append(f"{name}: met after each of the {steps} steps, at most {in_words(error.max(0))} off")
            continue
        first = met_from[name]
        end = f"{in_words(error[-1])} off at the end" if first is None else f"met from step {first} on"
        lines.append(f"{name}: {missed[name]} of {steps} targets missed, by at most {in_words(error.max(0))}; {end}")
    if last is not None:
        lines += ["the last step:", *(f"  {line}" for line in last.text.splitlines())]
    return RolloutVerdict(errors, missed, met_from, failed, last, "\n".join(lines))


def _met_from(beyond: np.ndarray) -> int | None:
    """Return the first step from which no later step is beyond the tolerance; None if the last one is."""
    if len(beyond) and beyond[-1]:
        return None
    return int(np.flatnonzero(beyond).max(initial=-1)) + 1
