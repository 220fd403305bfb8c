"""Smooth references: positions moved by minimum-jerk strokes, and their velocities."""

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
    """Minimum-jerk move by ``amount`` between two times."""

    start: float  # when it starts [s]
    end: float  # when it ends [s]
    amount: tuple[float, ...]  # how far, one number for each coordinate


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
    """Reference of a frame over time: its position moves by strokes, its rotation stays."""

    position: np.ndarray  # at the start [m]. (3,)
    rotation: np.ndarray  # frame axes to world axes. (3, 3)
    strokes: tuple[Stroke, ...] = ()  # moves of the position [m]

    def at(self, t: ArrayLike | Array) -> tuple[tuple[Float[Array, "3"], Float[Array, "3 3"]], Float[Array, "6"]]:
        """Return pose (p, R) and velocity [linear; angular] in world axes at time t [s]."""
        shift, velocity = follow(self.strokes, t, 3)
        pose = jnp.asarray(self.position) + shift, jnp.asarray(self.rotation)
        return pose, jnp.concatenate([velocity, jnp.zeros(3)])
