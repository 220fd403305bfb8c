"""Weight of what goes on in the background: postures and dampings of the whole robot."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..robot import Robot
from ..robot._size import robot_size

_BACKGROUND = 1e-3
"""Other tasks of the same priority win against this weight."""
_FULL_SIZE = 0.5
"""Size [m] from which on rows of joint angles weigh as they are."""
_LEAST_SIZE = 0.005
"""Size [m] below which their weight falls no further, so that it stays above the schemes' own damping."""


def background_weight(robot: Robot) -> Float[Array, ""] | float:
    """Return the default weight of rows of joint angles in the background, 1e-3 for robots of half a metre and more.

    A joint moves a frame by its angle times a lever arm, so squared angles outweigh squared distances on a small robot.
    Below half a metre the weight falls with the square of the robot's size (``robot_size``).
    """
    return _BACKGROUND * angle_scale(robot)


def angle_scale(robot: Robot) -> Float[Array, ""] | float:
    """Return the factor of weights of joint angles against those of distances in metres: 1 from half a metre on."""
    size = robot_size(robot)
    if isinstance(size, float):
        return min(max(size / _FULL_SIZE, _LEAST_SIZE / _FULL_SIZE), 1.0) ** 2
    return jnp.clip(size / _FULL_SIZE, _LEAST_SIZE / _FULL_SIZE, 1.0) ** 2
