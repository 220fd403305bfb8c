"""Common parts of tasks that point a frame's axis: the angle to a direction, as two rows or as a cone."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..numerics._constants import POINTING_SINE_SQUARED
from ..numerics._guarded import safe_norm
from ..numerics._host import Numbers, module_of
from ..robot import Robot
from ._curvature import jacobian_curvature
from ._framed import FramedTask
from ._gain import AdaptiveGain, as_gain
from ._leaves import as_scalar, as_vector, concrete
from ._rotation import dot
from ._task import TaskRows, check_priority

_BEHIND = -0.5
"""Cosine below which a direction counts as behind. The formulas for behind divide by the cosine, those for ahead by one
plus the cosine.
"""
_LEAST_SINE = 0.1
"""Least sine of the error's angle that is divided by; angle / sine has no bound near the opposite direction."""
_TIP = 0.01
"""Angle [rad] below which a cone's angle is rounded off, so that its gradient is 0 at 0."""


class PointingTask(FramedTask):
    """Base of tasks that bring an axis a of a frame to a direction d, or keep it in a cone around d.

    All in the frame's own axes, with t the angle from a to d, u the unit vector from a towards d across a, and B (3, 2)
    two unit vectors across a:

    - equality: ``e = -t B' u``, two rows [rad] whose norm is the angle; the turn about the axis is free;
    - cone: ``x = t <= half_angle``, one row [rad], asked to follow ``x' <= gain (half_angle - x)``.

    The Jacobians are exact, with two exceptions that keep them bounded. Within 0.1 rad of the opposite direction the
    row across the error, t / sin(t) there, stays as it is at 0.1 rad; both ask for the same motion where the task can
    be met. At the opposite direction itself, where every way is the shortest, the axis turns towards the first column
    of B. A cone's angle is rounded off below 0.01 rad (``t^2 / 0.02 + 0.005``), its bound likewise.
    """

    frame: str = eqx.field(static=True)
    target_frame: str | None = eqx.field(static=True)
    axis: Float[Array, "3"]
    target: Float[Array, "3"]
    target_velocity: Float[Array, "3"]
    half_angle: Float[Array, ""] | None

    def __init__(
        self,
        robot: Robot,
        frame: str,
        target_frame: str | None,
        *,
        axis: ArrayLike | Array,
        target: ArrayLike | Array,
        target_velocity: ArrayLike | Array,
        half_angle: ArrayLike | Array | None,
        weight: ArrayLike | Array,
        gain: ArrayLike | Array | AdaptiveGain,
        priority: int,
        hard: bool,
    ):
        self.frame, self.target_frame = frame, target_frame
        self.priority, self.hard = check_priority(priority), hard
        dtype = robot.q0.dtype
        self.axis = as_direction(axis, "axis", dtype)
        self.target = as_vector(target, (3,), "target", dtype)
        self.target_velocity = as_vector(target_velocity, (3,), "target_velocity", dtype)
        self.half_angle = None if half_angle is None else _as_half_angle(half_angle, dtype)
        self.weight = as_scalar(weight, "weight", dtype)
        self.gain = as_gain(gain, dtype)

    def are_lengths(self, count: int) -> Bool[np.ndarray, " m"]:
        """Return that no row is in metres."""
        return np.zeros(count, bool)

    def error_bounds(self) -> tuple[Any, Any] | None:
        """Return the bounds on the angle of a cone [rad], rounded off as the angle is."""
        return None if self.half_angle is None else (-np.inf, _rounded(self.half_angle**2))

    @property
    def frames(self) -> tuple[str, ...]:
        """Return the name of the frame, then that of the target if it has one."""
        return (self.frame,) if self.target_frame is None else (self.frame, self.target_frame)

    @property
    def bounded(self) -> bool:
        """Return whether the task is an inequality, which keeps the axis in a cone."""
        return self.half_angle is not None

    def pointing_rows(
        self, direction: Float[Array, "3"], jacobian: Float[Array, "3 nv"], drift: Float[Array, "3"]
    ) -> TaskRows:
        """Return the rows that turn the frame's axis towards a unit vector d.

        d is in the frame's axes, where its rate is ``jacobian v + drift``.
        """
        error, derivative = deviation(unit(self.axis), direction)
        upper = None
        if self.half_angle is not None:
            # the angle is the norm of the error, so its rate is the error's rate along the error
            derivative = dot(error, derivative)[None] / jnp.maximum(safe_norm(error), _TIP)
            error, upper = _rounded(jnp.sum(error**2))[None], _rounded(self.half_angle**2)[None]
        return TaskRows.of(
            error,
            dot(derivative, jacobian),
            gain=self.gain,
            weight=jnp.broadcast_to(self.weight, error.shape),
            # an angle is never below 0: inside the cone nothing is asked
            lower=None if upper is None else jnp.full_like(upper, -jnp.inf),
            upper=upper,
            # minus: the drift changes the error by itself, so the joints have to take it back
            feedforward=-dot(derivative, drift),
            curvature=partial(jacobian_curvature, jacobian=jacobian),
        )

    def _convert(self, name: str, value: Any) -> Any:
        if name == "axis":
            return as_direction(value, name, self.weight.dtype)
        if name == "half_angle":
            return _as_half_angle(value, self.weight.dtype)
        return super()._convert(name, value)


def check_frames(robot: Robot, frame: str, target_frame: str | None) -> None:
    """Raise KeyError if a frame does not exist, ValueError if both are the same."""
    robot.tree.frame(frame)
    if target_frame is not None:
        robot.tree.frame(target_frame)
    if frame == target_frame:
        raise OsikValueError(f"frame and target_frame are both {frame!r}; the one never moves as seen from the other")


def as_direction(value: Any, what: str, dtype: Any) -> Float[Array, "3"]:
    """Return a vector (3,), or raise ValueError if its length is 0."""
    out = as_vector(value, (3,), what, dtype)
    seen = concrete(out)
    if seen is not None and not (np.isfinite(seen).all() and seen.any()):
        raise OsikValueError(f"{what} is {seen}; a direction is finite and not 0")
    return out


def unit(vector: Float[Numbers, "3"]) -> Float[Numbers, "3"]:
    """Return the vector scaled to length 1; 0 stays 0."""
    length = safe_norm(vector)
    return vector / module_of(vector).where(length > 0.0, length, 1.0)


def deviation(axis: Float[Array, "3"], direction: Float[Array, "3"]) -> tuple[Float[Array, "2"], Float[Array, "2 3"]]:
    """Return the error e of ``PointingTask`` for two unit vectors, and D with ``e' = D d'`` for a rate d' across d."""
    basis = across(axis)
    cosine, beside = dot(axis, direction), dot(basis, direction)
    behind = cosine < _BEHIND
    front = _in_front(axis, basis, jnp.where(behind, 1.0, cosine), jnp.where(behind, 0.0, beside))
    back = _behind(basis, jnp.where(behind, cosine, -1.0), jnp.where(behind, beside, 0.0))
    return jnp.where(behind, back[0], front[0]), jnp.where(behind, back[1], front[1])


def _in_front(
    axis: Array, basis: Array, cosine: Float[Array, ""], beside: Float[Array, "2"]
) -> tuple[Float[Array, "2"], Float[Array, "2 3"]]:
    """Return e and D for vectors at most 120 degrees apart: a rate is carried from d to a, then scaled.

    With s the sine, ``k = t / s`` and ``g = (1 - k) / s^2``, which is -1/6 at 0: ``e = -k y``, ``y = B' d``, and
    ``D = -(k I + g y y') (B' - y a' / (1 + cos t))``.
    """
    squared = jnp.sum(beside**2)
    small = (squared < POINTING_SINE_SQUARED) & (cosine > 0.0)
    safe = jnp.where(small, 1.0, squared)
    sine = jnp.sqrt(safe)
    series = 1 / 6 + squared * (3 / 40 + squared * (5 / 112 + squared * (35 / 1152 + squared * 63 / 2816)))
    growth = jnp.where(small, -series, (1.0 - jnp.arctan2(sine, cosine) / sine) / safe)
    ratio = 1.0 - growth * squared
    carried = basis - jnp.outer(beside, axis) / (1.0 + cosine)
    return -ratio * beside, -(ratio * carried + growth * jnp.outer(beside, dot(beside, carried)))


def _behind(
    basis: Array, cosine: Float[Array, ""], beside: Float[Array, "2"]
) -> tuple[Float[Array, "2"], Float[Array, "2 3"]]:
    """Return e and D for vectors over 120 degrees apart: ``e = -t u``, ``D = -(k I + (1 / cos t - k) u u') B'``."""
    squared = jnp.sum(beside**2)
    clear = squared > jnp.finfo(squared.dtype).eps ** 2
    sine = jnp.sqrt(jnp.where(clear, squared, 1.0))
    way = jnp.where(clear, beside / sine, jnp.array([1.0, 0.0], beside.dtype))
    sine = jnp.where(clear, sine, 0.0)
    angle = jnp.arctan2(sine, cosine)
    ratio = angle / jnp.maximum(sine, _LEAST_SINE)
    return -angle * way, -(ratio * basis + (1.0 / cosine - ratio) * jnp.outer(way, dot(way, basis)))


def across(axis: Float[Array, "3"]) -> Float[Array, "2 3"]:
    """Return two unit vectors that complete a unit vector to a right-handed basis (Duff et al., JCGT 6(1), 2017)."""
    x, y, z = axis
    sign = jnp.where(z < 0.0, -1.0, 1.0).astype(axis.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    return jnp.array([[1.0 + sign * x * x * a, sign * b, -sign * x], [b, sign + y * y * a, -y]])


def _rounded(squared: Float[Array, ""]) -> Float[Array, ""]:
    """Return an angle from its square, rounded off near 0 [rad]."""
    tip = squared < _TIP**2
    return jnp.where(tip, squared / (2.0 * _TIP) + 0.5 * _TIP, jnp.sqrt(jnp.where(tip, 1.0, squared)))


def _as_half_angle(value: Any, dtype: Any) -> Float[Array, ""]:
    out = as_vector(value, (), "half_angle", dtype)
    seen = concrete(out)
    if seen is not None and not (0.0 < seen <= math.pi):
        raise OsikValueError(f"half_angle is {seen}; it is an angle in rad, above 0 and up to pi. None: an equality")
    return out
