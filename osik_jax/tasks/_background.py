"""Default weights of background tasks: postures and dampings of the whole robot."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..robot import Robot
from ..robot._size import robot_size

_BACKGROUND = 1e-4
"""Default weight of a background task: small against the positions and, 100 times less so, orientations of a pose."""
_FULL_SIZE = 0.5
"""Robot size [m] from which joint angles have their full weight."""
_LEAST_SIZE = 0.016
"""Robot size [m] below which the weight stays constant, so that it stays above the schemes' damping."""


def background_weight(robot: Robot) -> Float[Array, ""] | float:
    """Return the default weight of background rows of joint angles: 1e-4 for robots of half a metre or more.

    A joint moves a frame by its angle times a lever arm, so squared angles outweigh squared distances on a small robot.
    Below half a metre the weight falls with the square of the robot's size (``robot_size``).
    """
    return _BACKGROUND * angle_scale(robot)


def angle_scale(robot: Robot) -> Float[Array, ""] | float:
    """Return the factor on weights of joint angles relative to distances: 1 for robots of half a metre or more."""
    size = robot_size(robot)
    if isinstance(size, float):
        # squared, because weights multiply squared errors
        return min(max(size / _FULL_SIZE, _LEAST_SIZE / _FULL_SIZE), 1.0) ** 2
    return jnp.clip(size / _FULL_SIZE, _LEAST_SIZE / _FULL_SIZE, 1.0) ** 2
