"""Contact correction of a stream: standing points stay at their landing place, and soles stay above the floor."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..kinematics import forward_kinematics, integrate
from ._terms import Body, soles

# Bounds the time of a frame; Newton's method converges quadratically.
_MOST_ITERATIONS = 6
_SMALL = 1e-6
"""Error at which the iterations end [m]."""
_DAMPING = 1e-9
"""Damping of the normal equations [m^2/rad^2]: rows of a rigid foot are linearly dependent, and inactive rows are 0."""


class Stance(NamedTuple):
    """Contact points and their landing places."""

    landed: Float[Array, "4 2"]  # x and y of the landing place of left heel, left toe, right heel and right toe [m]
    stands: Bool[Array, "4"]  # whether each is in contact since then


class Held(NamedTuple):
    """Step of a robot that holds its contacts."""

    step: Float[Array, " nv"]  # the step [rad or m]
    stance: Stance  # contacts after the step
    # largest distance of a contact point from its landing place or the floor, or of a sole below the floor [m]
    off: Float[Array, ""]


class _State(NamedTuple):
    """A step, the dofs that may still change, and the best step so far with its largest error [m]."""

    step: Float[Array, " nv"]
    free: Float[Array, " nv"]
    best: Float[Array, " nv"]
    error: Float[Array, ""]
    iterations: Int[Array, ""]


def hold_feet(
    body: Body,
    q: Float[Array, " nq"],
    step: Float[Array, " nv"],
    lower: Float[Array, " nv"],
    upper: Float[Array, " nv"],
    contact: Bool[Array, "4"],
    stance: Stance,
) -> Held:
    """Change a step as little as possible so that contacts hold, inside bounds that hold exactly.

    Newton's method on the heights of the soles' corners and on the places of contact points. Each iteration takes the
    minimum-norm change of the step; dofs that reach a bound stay there. If the bounds do not allow a solution, the step
    is the best of all iterations, the planned one included, and ``off`` is the remaining error. Steps and bounds are in
    rad or m; ``contact`` is that of left heel, left toe, right heel and right toe after the step.
    """
    if not body.corners:
        return Held(step, stance, jnp.zeros((), step.dtype))
    held = contact & stance.stands & (not body.rolls)

    def goes_on(state: _State) -> Bool[Array, ""]:
        return (state.error > _SMALL) & (state.iterations < _MOST_ITERATIONS)

    def improved(state: _State) -> _State:
        residual, jacobian, state = evaluated(state)
        rates = jacobian * state.free
        gram = rates @ rates.T + _DAMPING * jnp.eye(len(residual), dtype=residual.dtype)
        wanted = state.step - rates.T @ jnp.linalg.solve(gram, residual)
        new = jnp.clip(wanted, lower, upper)
        return state._replace(step=new, free=state.free * (new == wanted), iterations=state.iterations + 1)

    def evaluated(state: _State) -> tuple[Array, Array, _State]:
        residual, jacobian = _rows(body, integrate(body.robot, q, state.step), contact, held, stance.landed)
        slip = jnp.linalg.norm(residual[:8].reshape(4, 2), axis=-1)
        error = jnp.maximum(slip.max(), jnp.abs(residual[8:]).max())
        is_better = error < state.error  # not so if the step is not finite
        best, least = jnp.where(is_better, state.step, state.best), jnp.where(is_better, error, state.error)
        return residual, jacobian, state._replace(best=best, error=least)

    first = _State(step, jnp.ones_like(step), step, jnp.asarray(jnp.inf, step.dtype), jnp.array(0))
    # with most dofs at their bounds the others may make steps that the linear model does not describe
    last = evaluated(jax.lax.while_loop(goes_on, improved, first))[2]
    points = soles(body, forward_kinematics(body.robot, integrate(body.robot, q, last.best)))[0]
    landed = jnp.where(held[:, None], stance.landed, points.reshape(4, 2, 3).mean(1)[:, :2])
    return Held(last.best, Stance(landed, contact), last.error)


def _rows(
    body: Body, q: Float[Array, " nq"], contact: Bool[Array, "4"], held: Bool[Array, "4"], landed: Float[Array, "4 2"]
) -> tuple[Float[Array, "16"], Float[Array, "16 nv"]]:
    """Return residuals and Jacobian: places of held points, and heights of corners in contact or below the floor."""
    points, rates = soles(body, forward_kinematics(body.robot, q))
    middles, moves = points.reshape(4, 2, 3).mean(1), rates.reshape(4, 2, 3, -1).mean(1)
    counts = jnp.repeat(contact, 2) | (points[:, 2] < 0.0)
    off, above = jnp.where(held[:, None], middles[:, :2] - landed, 0.0), jnp.where(counts, points[:, 2], 0.0)
    sideways = jnp.where(held[:, None, None], moves[:, :2], 0.0).reshape(8, -1)
    upwards = jnp.where(counts[:, None], rates[:, 2], 0.0)
    return jnp.concatenate([off.ravel(), above]), jnp.concatenate([sideways, upwards])
