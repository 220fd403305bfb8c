"""Logarithm of a rotation and the matrix from angular velocity to its rate, with matrix products in full precision."""

from __future__ import annotations

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from ..execution._platform import cuda_is_default
from ..kinematics._rigid import compose, rotate
from ..numerics._constants import SMALL_ANGLE_SQUARED, SMALL_SINE_SQUARED
from ..numerics._host import Numbers, module_of


def rotation_log(rotation: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Return the rotation vector [rad], axis times angle in [0, pi]; derivatives are exact at 0 and pi.

    ``jaxlie.SO3.log`` holds the angle constant very near pi, which makes its derivative there wrong; the quaternion is
    taken from jaxlie, the angle from an arctangent that is smooth over the whole range. Beyond pi the vector flips to
    the other end of the axis; the derivative is that of the side it is on.
    """
    wxyz = jaxlie.SO3.from_matrix(rotation).wxyz
    wxyz = jnp.where(wxyz[0] < 0.0, -wxyz, wxyz)
    cosine, vector = wxyz[0], wxyz[1:]
    sine_squared = jnp.sum(vector**2)
    small = sine_squared < SMALL_SINE_SQUARED
    sine = jnp.sqrt(jnp.where(small, 1.0, sine_squared))
    safe_cosine = jnp.where(small, cosine, 1.0)
    tangent_squared = sine_squared / safe_cosine**2
    # 2 atan(t) / t / cos, by the Taylor series of atan to t^4
    series = (2.0 - tangent_squared * (2.0 / 3.0 - tangent_squared * (2.0 / 5.0))) / safe_cosine
    return jnp.where(small, series, 2.0 * jnp.arctan2(sine, cosine) / sine) * vector


def inverse_left_jacobian(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the inverse left Jacobian of SO(3) at a rotation vector (matrix E of the paper).

    With ``Q = exp(vector)`` and angular velocity w in the axes on the left (``Q' = [w] Q``), ``vector' = E w``. Its
    transpose is the inverse right Jacobian (``Q' = Q [w]``). E = I - [e]/2 + c(angle) [e]^2 with
    ``c = (1 - (angle/2) cot(angle/2)) / angle^2``, which is 1/12 at 0 and 1/pi^2 at pi.
    """
    squared = jnp.sum(vector**2)
    small = squared < SMALL_ANGLE_SQUARED
    safe = jnp.where(small, 1.0, squared)
    half = 0.5 * jnp.sqrt(safe)
    exact = (1.0 - half * jnp.cos(half) / jnp.sin(half)) / safe
    series = 1 / 12 + squared * (1 / 720 + squared * (1 / 30240 + squared * (1 / 1209600 + squared / 47900160)))
    factor = jnp.where(small, series, exact)
    square = jnp.outer(vector, vector) - squared * jnp.eye(3, dtype=vector.dtype)
    return jnp.eye(3, dtype=vector.dtype) - 0.5 * cross_matrix(vector) + factor * square


def cross_matrix(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return [a], the matrix with [a] b = a x b."""
    x, y, z = vector
    zero = jnp.zeros_like(x)
    return jnp.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])


def dot(a: Numbers, b: Numbers) -> Numbers:
    """Return the matrix product, in full precision on every device.

    On a GPU, products over three entries are written out as sums, because its matrix library is slow for batches of
    such small matrices. On a CPU this would make gradients slower.
    """
    if module_of(a) is np and module_of(b) is np:
        return np.matmul(a, b)
    if cuda_is_default() and a.ndim == 2 and a.shape[1] == 3:
        return compose(a, b) if b.ndim == 2 else rotate(a, b)
    return jnp.matmul(a, b, precision="highest")
