"""Last pass of retargeting: follow a plan frame by frame inside limits that hold exactly."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..control._rollout import remembering
from ..kinematics import difference, integrate
from ..limits import AccelerationLimit, Limit, limit_box
from ..limits._acceleration import stopping_speed
from ..robot import Robot
from ..robot._joint_selection import scalar_layout
from ..robot._ranges import independent_balls, with_balls_inside

_SPARE = 0.1
"""Share of the acceleration limit that is used to return to the plan."""


@jax.jit
def follow(
    robot: Robot, plan: Float[Array, "F nq"], limits: Sequence[Limit], dt: Float[Array, ""] | float
) -> tuple[Float[Array, "F nq"], Float[Array, " F"]]:
    """Follow a plan as far as the limits allow, and return to it without overshoot after a limit was active.

    The velocity of a frame is the plan's plus a correction towards the plan. The correction is the highest speed that
    10 % of the acceleration limit can still stop at the plan. The motion starts inside the joint ranges at the speed of
    the plan's first step.

    Returns:
        the configurations, and how far the farthest joint of each is from the plan's [rad or m]. (F, nq), (F,)
    """
    dt = jnp.asarray(dt, plan.dtype)

    def step(state: tuple[Array, Array], goals: tuple[Array, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        velocity, _, _ = velocity_inside(robot, *state, *goals, limits, dt)
        q, velocity = moved(robot, state[0], velocity, dt)
        return (q, velocity), (q, jnp.abs(difference(robot, q, goals[1])).max())

    start = inside_ranges(robot, plan[0])
    others = [part for limit in limits for part in limit.parts() if part.kind != "acceleration"]
    velocity = difference(robot, start, plan[jnp.minimum(1, len(plan) - 1)]) / dt
    velocity = jnp.clip(velocity, *limit_box(robot, start, others, dt))
    _, (q, off) = jax.lax.scan(step, (start, velocity), (plan[:-1], plan[1:]))
    first = jnp.abs(difference(robot, start, plan[0])).max()
    return jnp.concatenate([start[None], q]), jnp.concatenate([first[None], off])


def velocity_inside(
    robot: Robot,
    q: Float[Array, " nq"],
    velocity: Float[Array, " nv"],
    goal: Float[Array, " nq"],
    following: Float[Array, " nq"],
    limits: Sequence[Limit],
    dt: Float[Array, ""],
) -> tuple[Float[Array, " nv"], Float[Array, " nv"], Float[Array, " nv"]]:
    """Return the next velocity, from near ``goal`` to ``following``, and its lower and upper bounds. (nv,) each."""
    spare = _SPARE * _accelerations(robot, limits)
    lower, upper = limit_box(robot, q, remembering(tuple(limits), velocity, True), dt)
    behind = difference(robot, q, goal)
    # at this speed the joint can still stop at the plan with the spare acceleration: no overshoot
    back = jnp.sign(behind) * stopping_speed(jnp.abs(behind), spare, dt)
    return jnp.clip(difference(robot, goal, following) / dt + back, lower, upper), lower, upper


def moved(
    robot: Robot, q: Float[Array, " nq"], velocity: Float[Array, " nv"], dt: Float[Array, ""]
) -> tuple[Float[Array, " nq"], Float[Array, " nv"]]:
    """Return the configuration after a step, ball joints inside their ranges, and the velocity that leads to it."""
    after = integrate(robot, q, velocity, dt)
    if not independent_balls(robot.tree):
        return after, velocity
    after = with_balls_inside(robot.tree, after, robot.position_upper)  # the box alone does not bound their angles
    return after, difference(robot, q, after) / dt


def _accelerations(robot: Robot, limits: Sequence[Limit]) -> Float[Array, " nv"]:
    """Return the smallest acceleration limit of each dof [rad/s^2 or m/s^2]; infinite where none applies. (nv,)."""
    most = jnp.full(robot.nv, jnp.inf, robot.q0.dtype)
    for limit in limits:
        if isinstance(limit, AccelerationLimit):
            most = jnp.minimum(most, limit.acceleration)
    return most


def inside_ranges(robot: Robot, q: Float[Array, " nq"]) -> Float[Array, " nq"]:
    """Return a configuration with its joints clipped to their ranges. (nq,)."""
    scalar, index = scalar_layout(robot)
    at = index[scalar]
    q = q.at[at].set(jnp.clip(q[at], robot.position_lower[scalar], robot.position_upper[scalar]))
    return with_balls_inside(robot.tree, q, robot.position_upper)
