"""Evenly spread orientations."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..kinematics._rigid import rotation_matrix

_FIRST = np.sqrt(2.0)
_SECOND = 1.533751168755204288118041413
"""The positive root of x**4 = x + 4. It and the square root of 2 are the windings for which the points are spread most
evenly."""


def spread_rotations(count: int) -> Float[np.ndarray, "count 3 3"]:
    """Return evenly spread rotations, one or more; the same ones every time.

    They lie on a spiral around the unit quaternions, at constant density (M. Alexa, "Super-Fibonacci spirals: fast,
    low-discrepancy sampling of SO(3)", CVPR 2022). Sets of different sizes share no rotation.
    """
    along = np.arange(count) + 0.5
    inner, outer = np.sqrt(along / count), np.sqrt(1.0 - along / count)
    alpha, beta = 2.0 * np.pi * along / _FIRST, 2.0 * np.pi * along / _SECOND
    parts = inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)
    return np.asarray(rotation_matrix(jnp.asarray(np.stack(parts, -1))))
