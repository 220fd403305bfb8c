"""Logarithm of a pose, and the matrix from a frame's twist to its rate."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._rotation import cross_matrix, dot, inverse_left_jacobian, rotation_log


def pose_log(
    position: Float[Array, "3"], rotation: Float[Array, "3 3"]
) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
    """Return the logarithm (6,) of a pose T, [linear; angular], and L (6, 6) with ``log(T)' = L twist``.

    The twist is the frame's own, [linear; angular] in its own axes: ``T' = T [twist]``. With phi = log(R) and E the
    inverse left Jacobian of SO(3) at phi, the logarithm is (E p, phi). Its rate is

        phi' = E' w        (E p)' = E R v + d(E p)/d(phi) phi' = E' v + D E' w

    because E R = E', the inverse right Jacobian. L is Pinocchio's ``Jlog6`` and mink's ``jlog``, the inverse right
    Jacobian of SE(3) at log(T).
    """
    angle = rotation_log(rotation)
    left = inverse_left_jacobian(angle)
    derivative = jax.jacfwd(lambda phi: dot(inverse_left_jacobian(phi), position))(angle)
    right = left.T
    top = jnp.concatenate([right, dot(derivative, right)], axis=1)
    bottom = jnp.concatenate([jnp.zeros_like(right), right], axis=1)
    return jnp.concatenate([dot(left, position), angle]), jnp.concatenate([top, bottom])


def seen_from(position: Float[Array, "3"], rotation: Float[Array, "3 3"], twist: Float[Array, "6 ..."]) -> Array:
    """Return twists (6, ...) of a frame in its own axes as twists of a second frame, whose relative pose is given."""
    linear, angular = twist[:3], twist[3:]
    # v + w x p at the second frame's origin, and w x p = -p x w
    return jnp.concatenate([dot(rotation.T, linear - dot(cross_matrix(position), angular)), dot(rotation.T, angular)])
