"""The exact pass for feet in a stream: what stands stays where it landed, and soles stay above the floor."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..kinematics import forward_kinematics, integrate
from ._terms import Body, soles

_MOST_ITERATIONS = 6
_SMALL = 1e-6
"""Error at which the iterations end [m]."""
_DAMPING = 1e-9
"""Of the rows of rigid feet, some of which are combinations of others, and of rows that are 0 [m^2/rad^2]."""


class Stance(NamedTuple):
    """Where feet stand.

    Attributes:
        landed: x and y of left heel and toe and of right heel and toe where they landed [m]. (4, 2)
        stands: whether each stands since. (4,)
    """

    landed: Float[Array, "4 2"]
    stands: Bool[Array, "4"]


class Held(NamedTuple):
    """A step that holds the feet.

    Attributes:
        q: the configuration after it. (nq,)
        step: the step [rad or m]. (nv,)
        stance: where feet stand after it.
        off: how far a point that stands is from where it landed or from the floor, or a sole below the floor, at most
            [m].
    """

    q: Float[Array, " nq"]
    step: Float[Array, " nv"]
    stance: Stance
    off: Float[Array, ""]


class _State(NamedTuple):
    step: Float[Array, " nv"]
    free: Float[Array, " nv"]
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
    """Change a step as little as it takes for feet to hold, inside bounds that hold exactly.

    Newton's method on heights of the soles' corners and on the places of what stands; each iteration takes the least
    change of the step, with the dofs that reached a bound held there. Where the bounds do not allow it, ``off`` says
    what is left.

    Args:
        body: the robot.
        q: configuration before the step.
        step: the step as planned, inside its bounds [rad or m].
        lower: bounds of the step [rad or m].
        upper: the other bounds [rad or m].
        contact: whether left heel, left toe, right heel and right toe stand after it.
        stance: where feet stood before it.
    """
    held = contact & stance.stands

    def goes_on(state: _State) -> Bool[Array, ""]:
        return (state.error > _SMALL) & (state.iterations < _MOST_ITERATIONS)

    def improved(state: _State) -> _State:
        residual, jacobian = _rows(body, integrate(body.robot, q, state.step), contact, held, stance.landed)
        rates = jacobian * state.free
        gram = rates @ rates.T + _DAMPING * jnp.eye(len(residual), dtype=residual.dtype)
        wanted = state.step - rates.T @ jnp.linalg.solve(gram, residual)
        new = jnp.clip(wanted, lower, upper)
        error = jnp.abs(residual).max()
        return _State(new, state.free * (new == wanted), error, state.iterations + 1)

    first = _State(step, jnp.ones_like(step), jnp.asarray(jnp.inf, step.dtype), jnp.array(0))
    step = jax.lax.while_loop(goes_on, improved, first).step
    after = integrate(body.robot, q, step)
    points = soles(body, forward_kinematics(body.robot, after))[0]
    places = points.reshape(4, 2, 3).mean(1)[:, :2]
    landed = jnp.where(held[:, None], stance.landed, places)
    slip = jnp.linalg.norm(places - landed, axis=-1).max()
    heights = jnp.where(jnp.repeat(contact, 2), jnp.abs(points[:, 2]), jnp.maximum(-points[:, 2], 0.0))
    return Held(after, step, Stance(landed, contact), jnp.maximum(slip, heights.max()))


def _rows(
    body: Body, q: Float[Array, " nq"], contact: Bool[Array, "4"], held: Bool[Array, "4"], landed: Float[Array, "4 2"]
) -> tuple[Float[Array, "16"], Float[Array, "16 nv"]]:
    """Return what is off, and its derivative: places of what is held, heights of what stands or is below the floor."""
    points, rates = soles(body, forward_kinematics(body.robot, q))
    middles, moves = points.reshape(4, 2, 3).mean(1), rates.reshape(4, 2, 3, -1).mean(1)
    counts = jnp.repeat(contact, 2) | (points[:, 2] < 0.0)
    residual = jnp.concatenate(
        [jnp.where(held[:, None], middles[:, :2] - landed, 0.0).ravel(), jnp.where(counts, points[:, 2], 0.0)]
    )
    jacobian = jnp.concatenate(
        [
            jnp.where(held[:, None, None], moves[:, :2], 0.0).reshape(8, -1),
            jnp.where(counts[:, None], rates[:, 2], 0.0),
        ]
    )
    return residual, jacobian
