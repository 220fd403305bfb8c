"""Closed loop in MuJoCo: sense, solve, command the servos, simulate until the next step."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._errors import OsikValueError
from ..batching._structure import Static, put_together, taken_apart
from ..control import Solution, solve
from ..control._checks import check_targets, checked_limits
from ..control._rollout import remembering
from ..control._step import Targets, Tasks, aim
from ..kinematics import integrate
from ..limits import Limit, Limits
from ..robot import Robot
from ..schemes import Scheme
from ._simulation import Simulation


@dataclasses.dataclass(frozen=True)
class Recording:
    """MuJoCo data at the start and after every step; ``simulate`` says what the fields are."""

    time: Float[np.ndarray, " T"]
    q: Float[np.ndarray, "T nq"]
    command: Float[np.ndarray, "steps nq"]
    effort: Float[np.ndarray, "T n"]
    com: Float[np.ndarray, "T 3"]
    contact_points: Float[np.ndarray, "T k 3"]
    contact_forces: Float[np.ndarray, "T k 3"]
    solution: Solution
    fell: bool


def simulate(
    simulation: Simulation,
    tasks: Tasks | Callable[[Array], Tasks],
    *,
    scheme: Scheme | None = None,
    limits: Limits | None = None,
    dt: float = 0.005,
    steps: int,
    targets: Targets | None = None,
    command: float | None = None,
    before_step: Callable[[float, Simulation], None] | None = None,
) -> Recording:
    """Run the loop from the simulation's present state, and stop if the robot falls.

    Each step senses the configuration, base and joints, solves for the velocity there, makes a servo target of it and
    lets MuJoCo run for ``dt``. One compiled program a step; MuJoCo runs on the host. As in ``rollout``, every
    step applies its velocity, whatever the status.

    Args:
        simulation: the robot in its world; it is left where the run ended.
        tasks: by name, or a function from time [s] to tasks, as in ``rollout``.
        scheme: as in ``rollout``.
        limits: hard bounds on the velocity, as in ``rollout``.
        dt: control period [s], a whole number of the world's timesteps.
        steps: number of steps.
        targets: targets of some tasks at each step, by task name, as in ``rollout``.
        command: how a velocity becomes the configuration to servo to.

            - None: the last command is integrated; the sensed configuration enters by the tasks alone. Under load a
              servo deflects by effort over stiffness. The command moves on until the tasks are met: this is integral
              action, and steady errors vanish. The tasks' gains must stay below those at which servos and contact
              oscillate: 3 to 10 / s for a standing robot, where the kinematic loop allows 20 / s and more.
            - A time [s]: the sensed configuration is integrated over it. This is proportional control without memory.
              A steady error remains, as with a servo whose stiffness is multiplied by gain times time. With a gain of
              20 / s and 0.05 s, a servo holds its load as if the plan were its target. With one step as the time the
              robot sinks.
        before_step: called with the time [s] since the start and the simulation, to push the robot, say.

    Returns:
        A recording with MuJoCo's data at the start and after every step, as NumPy arrays; T is the number of steps
        plus one.

        - ``time``: [s]. (T,)
        - ``q``: sensed configurations. (T, nq)
        - ``command``: configurations that the servos were sent to. (T - 1, nq)
        - ``effort``: of each servo [N m or N]. (T, n)
        - ``com``: centre of mass [m]. (T, 3)
        - ``contact_points``: of all feet, foot after foot [m]. (T, k, 3)
        - ``contact_forces``: of the floor on each of them [N]. (T, k, 3)
        - ``solution``: of each step; every leaf has a leading axis. (T - 1, ...)
        - ``fell``: whether the run ended by a fall, at ``time[-1]``.

    Raises:
        KeyError: ``targets`` names a task that does not exist.
        TypeError, ValueError: as in ``solve``; ``dt`` is no whole number of timesteps; ``targets`` do not fit.
    """
    if steps < 1:
        raise OsikValueError(f"steps is {steps}; there has to be one step at least")
    check_targets(tasks, targets, steps)
    robot = simulation.world.robot
    numbers, static = taken_apart(tasks if callable(tasks) else dict(tasks))
    own = checked_limits(robot, limits)
    how = None if command is None else np.asarray(command, float)
    program = partial(_control_step, robot, numbers, scheme, own, how, np.asarray(dt))
    step = partial(program, static=static)
    held = jnp.asarray(simulation.sense())
    paths = jax.tree.map(np.asarray, targets)
    targets_of = [jax.tree.map(itemgetter(k), paths) for k in range(steps)]
    # traced and not run, so that the first step finds its program compiled
    first = jax.eval_shape(lambda: step(0.0, held, held, (None, None), targets_of[0])[1])
    memory = jax.tree.map(jnp.zeros_like, (first.velocity, first.warm_start))
    frames, commands, solutions = [_frame(simulation)], [], []
    for k in range(steps):
        if before_step is not None:
            before_step(k * dt, simulation)
        held, solution = step(k * dt, held, simulation.sense(), memory, targets_of[k])
        memory = solution.velocity, solution.warm_start
        simulation.step(held, dt)
        frames.append(_frame(simulation))
        commands.append(held)
        solutions.append(solution)
        if simulation.fallen():
            break
    return Recording(
        time=dt * np.arange(len(frames)),
        command=np.array(commands),
        solution=jax.tree.map(lambda *leaves: np.stack(leaves), *solutions),
        fell=simulation.fallen(),
        **{name: np.array([frame[name] for frame in frames]) for name in frames[0]},
    )


@partial(jax.jit, static_argnames="static")
def _control_step(
    robot: Robot,
    numbers: Any,
    scheme: Scheme | None,
    limits: tuple[Limit, ...] | None,
    command: Array | None,
    dt: Array,
    t: Array,
    last: Array,
    sensed: Array,
    memory: tuple[Any, Any],
    target: Targets | None,
    *,
    static: Static,
) -> tuple[Array, Solution]:
    """Return command and solution of a step: its pure part."""
    tasks: Any = put_together(numbers, static)
    todo: Any = tasks(t) if callable(tasks) else aim(tasks, target)
    velocity, warm_start = memory
    todo, kept = remembering((todo, limits), velocity, t > 0.0)
    solution = solve(robot, sensed, todo, scheme=scheme, limits=kept, dt=dt, warm_start=warm_start)
    start, time = (last, dt) if command is None else (sensed, command)
    return integrate(robot, start, solution.velocity, time), solution


def _frame(simulation: Simulation) -> dict[str, np.ndarray]:
    """Return MuJoCo's data of the present state, by the field of a recording."""
    return dict(
        q=simulation.sense(),
        effort=simulation.effort(),
        com=simulation.com(),
        contact_points=simulation.contact_points(),
        contact_forces=simulation.contact_forces(),
    )
