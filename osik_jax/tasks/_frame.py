"""A task on the pose of a frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._tree import unknown_name
from ..kinematics import Kinematics, frame_jacobian
from ..robot import Robot
from ._gain import AdaptiveGain, as_gain
from ._leaves import Pose, as_bounds, as_pose, as_scalar, as_vector, check_bounds, check_not_negative, home_kinematics
from ._rotation import cross_matrix, inverse_left_jacobian, rotation_log
from ._task import DEFAULT_GAIN, Task, TaskRows, check_priority, task_rows

_ROWS = {
    "pose": (True,) * 6,
    "position": (True,) * 3 + (False,) * 3,
    "orientation": (False,) * 3 + (True,) * 3,
}
_Parts = tuple[Float[Array, "3"], Float[Array, "3 nv"], Float[Array, "3"]]


class FrameTask(Task):
    """Brings a frame to a pose, or keeps it within bounds around one.

    With p (3,), R (3, 3) the frame's pose, p*, R* the target's, and v*, w* the target's velocity (world axes):

    - ``axes="world"``: ``e = [p - p*; log(R R*')]`` and ``e' = [J_lin; E J_ang] v - [v*; E Q w*]``, with
      ``Q = R R*'`` and E the inverse left Jacobian of SO(3) at ``log Q`` (the matrix E of Ramos' analytic Jacobian).
    - ``axes="frame"``, the frame's own axes: ``e = [R' (p - p*); log(R*' R)]`` and
      ``e' = [R' (J_lin + [p - p*] J_ang); E R' J_ang] v - [R' v*; E R' w*]``, with E the inverse right Jacobian at
      ``log(R*' R)``. Leaving a row out frees, for instance, the rotation of a tool about its own z axis.

    The task asks for ``e' = -gain(e) e`` (``AdaptiveGain`` is Ramos, eq. 3). As an inequality
    (``lower``, ``upper``) it keeps the same e, the pose relative to the target, within bounds:
    ``gain (lower - e) <= e' <= gain (upper - e)``. Rows are metres and radians; angles up to pi.

    Args:
        robot: the robot.
        frame: name of a body, link, site or geom.
        target: ``(p (3,), R (3, 3))`` or a (4, 4) matrix; default: the frame's pose at ``robot.q0``.
        target_velocity: of the target, (6,), [linear; angular] in world axes [m/s, rad/s]; default 0.
        lower: makes an inequality task: lower bounds on the rows of e, one for each row that is kept, or a scalar.
        upper: upper bounds; one of the two may be left out, infinite entries bound nothing.
        position_weight: weight of the squared position rows, scalar or (3,) along the axes of ``axes``.
        orientation_weight: weight of the squared orientation rows, scalar or (3,). A row of weight 0 costs nothing.
        weight: multiplies all rows' weights.
        rows: ``"pose"``, ``"position"``, ``"orientation"``, or six booleans (x, y, z, rotation about x, y, z): the rows
            that the task has. Static; weights are not.
        axes: ``"world"`` or ``"frame"``.
        orientation_jacobian: ``"analytic"`` (exact), or ``"geometric"``: E = I. Both ask for the same motion where
            the task can be met; where it cannot, they weigh the residual across the error's axis differently, by a
            factor (angle/2) / sin(angle/2), at most pi/2.
        gain: [1/s], a number or an ``AdaptiveGain``.
        priority: 1 is the most important.
        hard: makes it a constraint, see ``Task``.

    Raises:
        KeyError: no such frame.
        ValueError: a wrong shape, a rotation that is not one, a negative weight, lower > upper, an unknown option.
    """

    frame: str = eqx.field(static=True)
    kept: tuple[bool, ...] = eqx.field(static=True)
    axes: str = eqx.field(static=True)
    orientation_jacobian: str = eqx.field(static=True)
    target: Pose
    target_velocity: Float[Array, "6"]
    lower: Float[Array, " m"] | None
    upper: Float[Array, " m"] | None
    position_weight: Float[Array, "3"]
    orientation_weight: Float[Array, "3"]

    def __init__(
        self,
        robot: Robot,
        frame: str,
        *,
        target: tuple[ArrayLike | Array, ArrayLike | Array] | ArrayLike | Array | None = None,
        target_velocity: ArrayLike | Array | None = None,
        lower: ArrayLike | Array | None = None,
        upper: ArrayLike | Array | None = None,
        position_weight: ArrayLike | Array = 1.0,
        orientation_weight: ArrayLike | Array = 1.0,
        weight: ArrayLike | Array = 1.0,
        rows: Literal["pose", "position", "orientation"] | Sequence[bool] = "pose",
        axes: Literal["world", "frame"] = "world",
        orientation_jacobian: Literal["analytic", "geometric"] = "analytic",
        gain: ArrayLike | Array | AdaptiveGain = DEFAULT_GAIN,
        priority: int = 1,
        hard: bool = False,
    ):
        robot.tree.frame(frame)
        self.frame = frame
        self.kept = _row_mask(rows)
        self.axes = _option("axes", axes, ("world", "frame"))
        self.orientation_jacobian = _option("orientation_jacobian", orientation_jacobian, ("analytic", "geometric"))
        self.priority, self.hard = check_priority(priority), hard
        dtype = robot.q0.dtype
        pose = home_kinematics(robot).frame_pose(robot, frame) if target is None else target
        self.target = as_pose(pose, dtype)
        self.target_velocity = as_vector(
            0.0 if target_velocity is None else target_velocity, (6,), "target_velocity", dtype
        )
        self.lower, self.upper = as_bounds(lower, upper, sum(self.kept), dtype)
        self.position_weight = _row_weight(position_weight, "position_weight", dtype)
        self.orientation_weight = _row_weight(orientation_weight, "orientation_weight", dtype)
        self.weight = as_scalar(weight, "weight", dtype)
        self.gain = as_gain(gain, dtype)

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Rows in the order x, y, z, rotation x, y, z, those left out skipped. (m <= 6)."""
        del q
        return self.rows_at(*kinematics.frame_pose(robot, self.frame), frame_jacobian(robot, kinematics, self.frame))

    def rows_at(
        self, position: Float[Array, "3"], rotation: Float[Array, "3 3"], jacobian: Float[Array, "6 nv"]
    ) -> TaskRows:
        """The same from the frame's pose and Jacobian."""
        parts = []
        if any(self.kept[:3]):
            linear = self._position_in_world if self.axes == "world" else self._position_in_frame
            parts.append((self.kept[:3], (*linear(position, rotation, jacobian), self.position_weight)))
        if any(self.kept[3:]):
            angular = self._orientation_in_world if self.axes == "world" else self._orientation_in_frame
            parts.append((self.kept[3:], (*angular(rotation, jacobian[3:]), self.orientation_weight)))
        chosen = [_chosen(kept, arrays) for kept, arrays in parts]
        error, rows, feedforward, weight = (jnp.concatenate(arrays) for arrays in zip(*chosen, strict=True))
        return task_rows(
            error,
            rows,
            gain=self.gain,
            weight=self.weight * weight,
            lower=self.lower,
            upper=self.upper,
            feedforward=feedforward,
        )

    def _position_in_world(self, position: Array, rotation: Array, jacobian: Array) -> _Parts:
        del rotation
        return position - self.target[0], jacobian[:3], self.target_velocity[:3]

    def _position_in_frame(self, position: Array, rotation: Array, jacobian: Array) -> _Parts:
        offset = position - self.target[0]
        turning = _dot(cross_matrix(offset), jacobian[3:])
        own = rotation.T
        return _dot(own, offset), _dot(own, jacobian[:3] + turning), _dot(own, self.target_velocity[:3])

    def _orientation_in_world(self, rotation: Array, jacobian: Array) -> _Parts:
        between = _dot(rotation, self.target[1].T)
        error = rotation_log(between)
        factor = self._factor(error)
        return error, _dot(factor, jacobian), _dot(factor, _dot(between, self.target_velocity[3:]))

    def _orientation_in_frame(self, rotation: Array, jacobian: Array) -> _Parts:
        error = rotation_log(_dot(self.target[1].T, rotation))
        factor = _dot(self._factor(error).T, rotation.T)
        return error, _dot(factor, jacobian), _dot(factor, self.target_velocity[3:])

    def _factor(self, error: Float[Array, "3"]) -> Float[Array, "3 3"]:
        """The inverse left Jacobian (its transpose is the right one), or the identity for the geometric Jacobian."""
        if self.orientation_jacobian == "geometric":
            return jnp.eye(3, dtype=error.dtype)
        return inverse_left_jacobian(error)

    def _convert(self, name: str, value: Any) -> Any:
        if name == "target":
            return as_pose(value, self.weight.dtype)
        if name in ("position_weight", "orientation_weight"):
            return _row_weight(value, name, self.weight.dtype)
        return super()._convert(name, value)

    def _check(self) -> None:
        check_bounds(self.lower, self.upper)


def _chosen(kept: Sequence[bool], arrays: Sequence[Array]) -> list[Array]:
    """The rows that are kept, of each array."""
    return list(arrays) if all(kept) else [array[np.flatnonzero(kept)] for array in arrays]


def _dot(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")


def _row_weight(value: Any, name: str, dtype: Any) -> Float[Array, "3"]:
    out = as_vector(value, (3,), name, dtype)
    check_not_negative(out, name)
    return out


def _option(name: str, value: str, available: tuple[str, ...]) -> str:
    if value not in available:
        raise ValueError(f"{name} is {value!r}; it is one of: {', '.join(map(repr, available))}")
    return value


def _row_mask(rows: str | Sequence[bool]) -> tuple[bool, ...]:
    """Six booleans from the name of a set of rows or from themselves."""
    if isinstance(rows, str):
        if rows not in _ROWS:
            raise ValueError(str(unknown_name("set of rows", rows, tuple(_ROWS))))
        return _ROWS[rows]
    mask = tuple(bool(row) for row in rows)
    if len(mask) != 6 or not any(mask):
        raise ValueError(f"rows has six booleans (x, y, z, rotation about x, y, z), at least one true; got {rows}")
    return mask
