"""Smooth references: sums of minimum-jerk strokes and their velocities."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike


def minimum_jerk(t: ArrayLike | Array, start: float, duration: float) -> tuple[Array, Array]:
    """Return value and rate [1/s] of a minimum-jerk curve from 0 at ``start`` to 1 at ``start + duration`` [s]."""
    s = jnp.clip((jnp.asarray(t) - start) / duration, 0.0, 1.0)
    # the quintic with zero velocity and acceleration at both ends, and its derivative
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2), 30.0 * s**2 * (1.0 - s) ** 2 / duration


@dataclasses.dataclass(frozen=True)
class Stroke:
    """Minimum-jerk move by ``amount`` between two times.

    Attributes:
        start: when it starts [s].
        end: when it ends [s].
        amount: how far, one number for each coordinate.
    """

    start: float
    end: float
    amount: tuple[float, ...]


def follow(strokes: Sequence[Stroke], t: ArrayLike | Array, size: int) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return the sum of the strokes at time t [s], and its velocity. (size,) each."""
    value = rate = jnp.zeros(size)
    for stroke in strokes:
        s, speed = minimum_jerk(t, stroke.start, stroke.end - stroke.start)
        amount = jnp.asarray(stroke.amount)
        value, rate = value + s * amount, rate + speed * amount
    return value, rate


@dataclasses.dataclass(frozen=True)
class Path:
    """Reference of a frame over time: strokes of its position, and of its angle about one world axis.

    Attributes:
        position: at the start [m]. (3,)
        rotation: at the start, frame axes to world axes. (3, 3)
        moves: strokes of the position [m].
        turns: strokes of the angle about ``axis`` [rad].
        axis: unit vector in the world. (3,)
    """

    position: np.ndarray
    rotation: np.ndarray
    moves: tuple[Stroke, ...] = ()
    turns: tuple[Stroke, ...] = ()
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0)

    def at(self, t: ArrayLike | Array) -> tuple[tuple[Float[Array, "3"], Float[Array, "3 3"]], Float[Array, "6"]]:
        """Return pose (p, R) and velocity [linear; angular] in world axes at time t [s]."""
        shift, velocity = follow(self.moves, t, 3)
        angle, speed = follow(self.turns, t, 1)
        axis = jnp.asarray(self.axis)
        pose = (jnp.asarray(self.position) + shift, _rotation(axis, angle[0]) @ jnp.asarray(self.rotation))
        return pose, jnp.concatenate([velocity, speed * axis])

    @property
    def strokes(self) -> tuple[Stroke, ...]:
        """Return all strokes of position and angle."""
        return (*self.moves, *self.turns)

    def still(self, t: np.ndarray) -> np.ndarray:
        """Return whether the path has moved before and is at rest, for each time [s]. (T,)."""
        begun = np.zeros(len(t), bool)
        moving = np.zeros(len(t), bool)
        for stroke in self.strokes:
            begun |= t >= stroke.end
            moving |= (t > stroke.start) & (t < stroke.end)
        return begun & ~moving


def _rotation(axis: Float[Array, "3"], angle: Array) -> Float[Array, "3 3"]:
    """Return the rotation matrix about an axis by an angle [rad] (Rodrigues' formula)."""
    x, y, z = axis
    cross = jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return jnp.eye(3) + jnp.sin(angle) * cross + (1.0 - jnp.cos(angle)) * cross @ cross
