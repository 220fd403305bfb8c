"""Tasks that point a frame's axis along a direction or at a point: the angle to it, as two rows or as a cone."""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..execution._backends import Backend
from ..kinematics import Kinematics
from ..numerics._constants import BEHIND, CONE_TIP, LEAST_SINE, NEAREST_SIGHT, POINTING_SINE_SQUARED
from ..numerics._guarded import safe_norm
from ..numerics._host import Numbers, module_of, on_host
from ..robot import Robot
from ._bases import FramedTask, Frames
from ._curvature import jacobian_curvature
from ._gain import AdaptiveGain
from ._leaves import as_vector, concrete, home_kinematics
from ._rotation import cross_matrix, dot
from ._task import DEFAULT_GAIN, POINTING, CoreCard, TaskRows


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
        axis: ArrayLike | Array,
        target: ArrayLike | Array | None,
        target_frame: str | None,
        target_velocity: ArrayLike | Array | None,
        half_angle: ArrayLike | Array | None,
        weight: ArrayLike | Array,
        gain: ArrayLike | Array | AdaptiveGain,
        priority: int,
        hard: bool,
    ):
        for name in (frame,) if target_frame is None else (frame, target_frame):
            robot.tree.frame(name)
        if frame == target_frame:
            raise OsikValueError(
                f"frame and target_frame are both {frame!r}; the one never moves as seen from the other"
            )
        self.frame, self.target_frame = frame, target_frame
        dtype = self._set_up(robot, weight, priority, hard, gain)
        self.axis = as_direction(axis, "axis", dtype)
        self.target = self._as_target(self._ahead(robot, home_kinematics(robot)) if target is None else target, dtype)
        velocity = 0.0 if target_velocity is None else target_velocity
        self.target_velocity = as_vector(velocity, (3,), "target_velocity", dtype)
        self.half_angle = None if half_angle is None else _as_half_angle(half_angle, dtype)

    @abc.abstractmethod
    def _ahead(self, robot: Robot, kinematics: Kinematics) -> Any:
        """Return the default target."""

    def _as_target(self, value: Any, dtype: Any) -> Float[Array, "3"]:
        return as_vector(value, (3,), "target", dtype)

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

    def core_leaves(self) -> list[Any]:
        """Return the leaves in the order of the card in ``core/tasks``."""
        return [self.gain, self.weight, self.target_velocity, None, self.half_angle, self.axis, self.target, None, None]

    def _card_of(self, robot: Robot, at_point: bool) -> CoreCard:
        return CoreCard(POINTING, 1 if self.bounded else 2, [int(at_point), *self.frame_options(robot)])

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
            derivative = dot(error, derivative)[None] / jnp.maximum(safe_norm(error), CONE_TIP)
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
        if name == "target":
            return self._as_target(value, self.weight.dtype)
        if name == "half_angle":
            return _as_half_angle(value, self.weight.dtype)
        return super()._convert(name, value)


class AxisAlignTask(PointingTask):
    """Task that aligns an axis of a frame with a direction, or keeps it in a cone around one.

    With R the frame's rotation and x* the direction (world), ``d = R' x*`` is the direction in the frame's axes. The
    rows are those of a ``LookAtTask`` at a point infinitely far away: two [rad], whose norm is the angle t between the
    axis and d. With ``half_angle`` there is one inequality row, ``t <= half_angle``: a cup that may tilt that much. The
    turn about the axis stays free. An axis that points the opposite way is turned round about a fixed axis.

    Args:
        robot: the robot.
        frame: name of a body, link, site or geom.
        axis: in the frame's axes, of any length.
        target: the direction (3,), of any length, in the world's or the target frame's axes. Default: where the axis
            points at ``robot.q0``.
        target_frame: a frame of the robot in which the direction is fixed. Default: the world.
        target_velocity: angular velocity of the direction (3,) [rad/s], in the same axes; default 0.
        half_angle: makes an inequality task: half the cone's opening [rad], above 0.
        weight: of each squared row.
        gain: [1/s], a number or an ``AdaptiveGain``.

    Raises:
        KeyError: no such frame.
        ValueError: frame and target frame are the same, a wrong shape, a direction of length 0, a negative weight.
    """

    units: ClassVar[Mapping[str, str]] = {
        "": "rad",
        "axis": "1 (direction)",
        "target": "1 (direction)",
        "target_velocity": "rad/s",
    }

    def __init__(
        self,
        robot: Robot,
        frame: str,
        *,
        axis: ArrayLike | Array = (0.0, 0.0, 1.0),
        target: ArrayLike | Array | None = None,
        target_frame: str | None = None,
        target_velocity: ArrayLike | Array | None = None,
        half_angle: ArrayLike | Array | None = None,
        weight: ArrayLike | Array = 1.0,
        gain: ArrayLike | Array | AdaptiveGain = DEFAULT_GAIN,
        priority: int = 1,
        hard: bool = False,
    ):
        to, common = (axis, target, target_frame, target_velocity, half_angle), (weight, gain, priority, hard)
        super().__init__(robot, frame, *to, *common)

    def rows_at(self, frames: Frames, backend: Backend = "jax") -> TaskRows:
        """Return two rows along the axes across ``axis`` [rad], or one row for a cone."""
        del backend
        _, rotations, jacobians = frames
        turn, spin = rotations[0].T, jacobians[0, 3:]
        direction, velocity = unit(self.target), self.target_velocity
        if self.target_frame is not None:
            direction, velocity = dot(rotations[1], direction), dot(rotations[1], velocity)
            # where the direction turns with another frame, the relative turn counts
            spin = spin - jacobians[1, 3:]
        # a direction d, seen from a frame that turns by w, changes by d x w; its own turning has the other sign
        turned = dot(turn, cross_matrix(direction))
        return self.pointing_rows(dot(turn, direction), dot(turned, spin), -dot(turned, velocity))

    def _card(self, robot: Robot) -> CoreCard:
        return self._card_of(robot, at_point=False)

    def _ahead(self, robot: Robot, kinematics: Kinematics) -> Float[Numbers, "3"]:
        """Return the direction of the axis, in the world or in the target frame."""
        _, rotations = kinematics.frame_poses(robot, self.frames)
        direction = dot(rotations[0], unit(on_host(self.axis)))
        return direction if self.target_frame is None else dot(rotations[1].T, direction)

    def _as_target(self, value: Any, dtype: Any) -> Float[Array, "3"]:
        return as_direction(value, "target", dtype)

    def _held(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> dict[str, Any]:
        del q
        return dict(target=self._ahead(robot, kinematics))


class LookAtTask(PointingTask):
    """Task that points an axis of a frame at a point, or keeps the point in the frame's field of view.

    With p, R the frame's pose and x* the point (world), the direction is ``d = R' (x* - p) / |x* - p|``; frame and
    point may both move. Two rows [rad], of which the norm is the angle t between axis and line of sight; with
    ``half_angle`` one inequality row, ``t <= half_angle``, a visual field (Ramos). Both ask for the shortest turn, and
    the turn about the axis stays free. A point right behind is looked at by a half turn about a fixed axis. Closer
    than 1 mm there is no line of sight, and the task asks for nothing.

    Args:
        robot: the robot.
        frame: name of a body, link, site or geom: a camera, a head.
        axis: what looks, in the frame's axes, of any length.
        target: the point (3,) [m], in the world or in ``target_frame``. Default: 1 m ahead at ``robot.q0``; with a
            ``target_frame`` its origin.
        target_frame: a frame of the robot that carries the point, such as a hand. Default: the world.
        target_velocity: of the point (3,) [m/s], in the world's or the target frame's axes; default 0.
        half_angle: makes an inequality task: half the cone's opening [rad], above 0.
        weight: of each squared row.
        gain: [1/s], a number or an ``AdaptiveGain``.

    Raises:
        KeyError: no such frame.
        ValueError: frame and target frame are the same, a wrong shape, an axis of length 0, a negative weight.
    """

    units: ClassVar[Mapping[str, str]] = {"": "rad", "axis": "1 (direction)", "target": "m", "target_velocity": "m/s"}

    def __init__(
        self,
        robot: Robot,
        frame: str,
        *,
        axis: ArrayLike | Array = (0.0, 0.0, 1.0),
        target: ArrayLike | Array | None = None,
        target_frame: str | None = None,
        target_velocity: ArrayLike | Array | None = None,
        half_angle: ArrayLike | Array | None = None,
        weight: ArrayLike | Array = 1.0,
        gain: ArrayLike | Array | AdaptiveGain = DEFAULT_GAIN,
        priority: int = 1,
        hard: bool = False,
    ):
        to, common = (axis, target, target_frame, target_velocity, half_angle), (weight, gain, priority, hard)
        super().__init__(robot, frame, *to, *common)

    def rows_at(self, frames: Frames, backend: Backend = "jax") -> TaskRows:
        """Return two rows along the axes across ``axis`` [rad], or one row for a cone."""
        del backend
        positions, rotations, jacobians = frames
        position, rotation, jacobian = positions[0], rotations[0], jacobians[0]
        point, velocity = self.target, self.target_velocity
        if self.target_frame is not None:
            arm = dot(rotations[1], self.target)
            point, velocity = positions[1] + arm, dot(rotations[1], self.target_velocity)
        line = point - position
        squared = jnp.sum(line**2)
        near = squared < NEAREST_SIGHT**2
        distance = jnp.sqrt(jnp.where(near, 1.0, squared))
        sight = jnp.where(near, dot(rotation, unit(self.axis)), line / distance)
        turn = jnp.where(near, 0.0, rotation.T)
        narrowing = dot(turn, (jnp.eye(3, dtype=sight.dtype) - jnp.outer(sight, sight)) / distance)
        # the line follows the point and leaves the camera: minus its motion; seen from the turning camera, + sight x w
        rate = dot(jnp.concatenate([-narrowing, dot(turn, cross_matrix(sight))], 1), jacobian)
        if self.target_frame is not None:
            rate = rate + dot(jnp.concatenate([narrowing, -dot(narrowing, cross_matrix(arm))], 1), jacobians[1])
        return self.pointing_rows(dot(rotation.T, sight), rate, dot(narrowing, velocity))

    def _card(self, robot: Robot) -> CoreCard:
        return self._card_of(robot, at_point=True)

    def _ahead(self, robot: Robot, kinematics: Kinematics) -> Any:
        """Return the point 1 m along the axis [m]; with a target frame, its origin."""
        if self.target_frame is not None:
            return 0.0
        position, rotation = kinematics.frame_pose(robot, self.frame)
        return position + dot(rotation, unit(on_host(self.axis)))

    def _held(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> dict[str, Any]:
        """Return the field ``target`` that the camera sees at q: a point 1 m ahead, in the frame that carries it."""
        del q
        positions, rotations = kinematics.frame_poses(robot, self.frames)
        point = positions[0] + dot(rotations[0], unit(self.axis))
        return dict(target=point if self.target_frame is None else dot(rotations[1].T, point - positions[1]))


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
    behind = cosine < BEHIND
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
    ratio = angle / jnp.maximum(sine, LEAST_SINE)
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
    tip = squared < CONE_TIP**2
    return jnp.where(tip, squared / (2.0 * CONE_TIP) + 0.5 * CONE_TIP, jnp.sqrt(jnp.where(tip, 1.0, squared)))


def _as_half_angle(value: Any, dtype: Any) -> Float[Array, ""]:
    out = as_vector(value, (), "half_angle", dtype)
    seen = concrete(out)
    if seen is not None and not (0.0 < seen <= math.pi):
        raise OsikValueError(f"half_angle is {seen}; it is an angle in rad, above 0 and up to pi. None: an equality")
    return out
