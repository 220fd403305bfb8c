"""Common parts of tasks on poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError, unknown_name
from ..execution._backends import Backend
from ..execution._computed import by_kernel, side_by_side
from ..kinematics._kernels import Call
from ..kinematics._pose_forms import Pose, PoseLike, as_pose
from ..robot import Robot
from ._bases import FramedTask
from ._curvature import pose_curvature
from ._gain import AdaptiveGain
from ._leaves import as_bounds, as_vector, check_not_negative, home_kinematics
from ._repr import ROWS
from ._rotation import cross_matrix, dot, inverse_left_jacobian, rotation_log
from ._task import DEFAULT_GAIN, POSE, CoreCard, TaskRows

RADIAN = 0.1
"""Length [m] that an error of one radian counts as in pose tasks by default, and in ``inverse_kinematics``: a hand that
turns by a radian about its wrist moves its fingertips by about this.
"""
_Parts = tuple[Float[Array, "3"], Float[Array, "3 nv"], Float[Array, "3"]]
_Blocks = list[tuple[Sequence[bool], tuple[Array, Array, Array, Array]]]
"""Blocks of a pose task's rows: mask of the chosen rows, error, Jacobian, feedforward and weight."""
_Wrench = Float[Array, "6 6"] | None
"""Matrix from a pull on all six rows to force and torque on the frame, in the outer axes; None is the identity."""


class PoseTask(FramedTask):
    """Base of tasks on a pose, in the world or in another frame; ``FrameTask`` states the formulas."""

    units: ClassVar[Mapping[str, str]] = {
        "": "m or rad",
        "target[0]": "m",
        "target[1]": "1 (rotation matrix)",
        "target_velocity": "m/s, rad/s",
    }
    frame: str = eqx.field(static=True)
    kept: tuple[bool, ...] = eqx.field(static=True)
    axes: str = eqx.field(static=True)
    error: str = eqx.field(static=True)
    orientation_jacobian: str = eqx.field(static=True)
    target: Pose
    target_velocity: Float[Array, "6"]
    lower: Float[Array, " m"] | None
    upper: Float[Array, " m"] | None
    position_weight: Float[Array, "3"]
    orientation_weight: Float[Array, "3"]

    outer_axes: ClassVar[str] = "world"

    def __init__(
        self,
        robot: Robot,
        frame: str,
        *,
        target: PoseLike | None = None,
        target_velocity: ArrayLike | Array | None = None,
        lower: ArrayLike | Array | None = None,
        upper: ArrayLike | Array | None = None,
        position_weight: ArrayLike | Array = 1.0,
        # a square, because weights multiply squared errors: a radian counts as RADIAN metres
        orientation_weight: ArrayLike | Array = RADIAN**2,
        weight: ArrayLike | Array = 1.0,
        rows: Literal["pose", "position", "orientation"] | Sequence[bool] = "pose",
        axes: Literal["world", "root", "frame"] | None = None,
        error: Literal["decoupled", "se3"] = "decoupled",
        orientation_jacobian: Literal["analytic", "geometric"] = "analytic",
        gain: ArrayLike | Array | AdaptiveGain = DEFAULT_GAIN,
        priority: int = 1,
        hard: bool = False,
    ):
        robot.tree.frame(frame)
        self.frame, self.kept = frame, row_mask(rows)
        self.error = option("error", error, ("decoupled", "se3"))
        self.axes = self._row_axes(axes)
        self.orientation_jacobian = option("orientation_jacobian", orientation_jacobian, ("analytic", "geometric"))
        if self.coupled and self.orientation_jacobian == "geometric":
            raise OsikValueError(
                "error='se3' has its own Jacobian; orientation_jacobian='geometric' goes with 'decoupled'"
            )
        dtype = self._set_up(robot, weight, priority, hard, gain)
        home: Pose = self._held(robot, home_kinematics(robot), robot.q0)["target"]
        self.target = as_pose(home if target is None else target, dtype, rest=_rest(home, self.kept, self.coupled))
        velocity = 0.0 if target_velocity is None else target_velocity
        self.target_velocity = as_vector(velocity, (6,), "target_velocity", dtype)
        self.lower, self.upper = as_bounds(lower, upper, sum(self.kept), dtype)
        self.position_weight = _row_weight(position_weight, "position_weight", dtype)
        self.orientation_weight = _row_weight(orientation_weight, "orientation_weight", dtype)

    def _row_axes(self, axes: str | None) -> str:
        """Return the axes of the rows: the outer ones by default, the frame's own for a twist."""
        if not self.coupled:
            return self.outer_axes if axes is None else option("axes", axes, (self.outer_axes, "frame"))
        if axes not in (None, "frame"):
            raise OsikValueError(f"axes is {axes!r}; the rows of error='se3' are along the frame's own axes, 'frame'")
        return "frame"

    @property
    def bounded(self) -> bool:
        """Return whether the task keeps the pose within bounds."""
        return self.lower is not None

    @property
    def coupled(self) -> bool:
        """Return whether the error is the logarithm on SE(3)."""
        return self.error == "se3"

    def are_lengths(self, count: int) -> Bool[np.ndarray, " m"]:
        """Return which of the kept rows are in metres: those of the position."""
        del count
        return np.flatnonzero(self.kept) < 3

    def core_leaves(self) -> list[Any]:
        """Return the leaves in the order of the card in ``core/tasks``."""
        bounds, weights = (self.lower, self.upper), (self.position_weight, self.orientation_weight)
        return [self.gain, self.weight, self.target_velocity, *bounds, *self.target, *weights]

    def _card(self, robot: Robot) -> CoreCard | str:
        if self.coupled:
            return "has error='se3'"
        options = map(int, (self.axes == "frame", self.orientation_jacobian == "geometric", *self.kept))
        return CoreCard(POSE, sum(self.kept), [*options, *self.frame_options(robot)])

    def pose_rows(
        self,
        position: Float[Array, "3"],
        rotation: Float[Array, "3 3"],
        jacobian: Float[Array, "6 nv"],
        backend: Backend = "jax",
    ) -> TaskRows:
        """Return the chosen rows (m <= 6) of a pose and its Jacobian, in the order x, y, z, rotation x, y, z.

        Pose, target and Jacobian are in the outer axes: the world's, or those of the frame that the pose is in.
        """
        if self._in_core(backend):
            return equality_rows(*_by_kernel(self, position, rotation, jacobian))
        return self._plain_rows(position, rotation, jacobian)

    def _in_core(self, backend: Backend) -> bool:
        """Return whether the compiled core may compute the rows."""
        return backend != "jax" and not (self.coupled or self.bounded or isinstance(self.gain, AdaptiveGain))

    def _plain_rows(
        self, position: Float[Array, "3"], rotation: Float[Array, "3 3"], jacobian: Float[Array, "6 nv"]
    ) -> TaskRows:
        form = self._twist_parts if self.coupled else self._decoupled_parts
        parts, wrench = form(position, rotation, jacobian)
        chosen = [_chosen(kept, arrays) for kept, arrays in parts]
        error, rows, feedforward, weight = (jnp.concatenate(arrays) for arrays in zip(*chosen, strict=True))
        return TaskRows.of(
            error,
            rows,
            gain=self.gain,
            weight=self.weight * weight,
            lower=self.lower,
            upper=self.upper,
            feedforward=feedforward,
            curvature=partial(self._curvature, wrench=wrench, jacobian=jacobian),
        )

    def _twist_parts(self, position: Array, rotation: Array, jacobian: Array) -> tuple[_Blocks, _Wrench]:
        """Return error, Jacobian and feedforward of the logarithm of the pose in the target's frame."""
        wanted, own = self.target[1].T, rotation.T
        offset, between = dot(wanted, position - self.target[0]), dot(wanted, rotation)
        # log(T*' T), the pose as seen from the target: it grows along the frame's own twist
        error, factor = pose_log(offset, between)
        twist = jnp.concatenate([dot(own, jacobian[:3]), dot(own, jacobian[3:])])
        target_twist = jnp.concatenate([dot(wanted, self.target_velocity[:3]), dot(wanted, self.target_velocity[3:])])
        feedforward = dot(factor, seen_from(offset, between, target_twist))
        # the logarithm is in m and rad as well, so the same weights give a radian the same length
        weight = jnp.concatenate([self.position_weight, self.orientation_weight])
        return [(self.kept, (error, dot(factor, twist), feedforward, weight))], dot(_twice(rotation), factor.T)

    def _decoupled_parts(self, position: Array, rotation: Array, jacobian: Array) -> tuple[_Blocks, _Wrench]:
        """Return the chosen rows of position and of orientation."""
        parts = []
        if any(self.kept[:3]):
            parts.append((self.kept[:3], (*self._position_rows(position, rotation, jacobian), self.position_weight)))
        if any(self.kept[3:]):
            parts.append((self.kept[3:], (*self._orientation_rows(rotation, jacobian[3:]), self.orientation_weight)))
        return parts, _twice(rotation) if self.axes == "frame" else None

    def _curvature(self, pull: Float[Array, " m"], wrench: _Wrench, jacobian: Float[Array, "6 nv"]) -> Float[Array, ""]:
        """Return the curvature bound for the weighted pull of the chosen rows."""
        whole = jnp.zeros(6, pull.dtype).at[np.flatnonzero(self.kept)].set(pull)
        whole = whole if wrench is None else dot(wrench, whole)
        return pose_curvature(whole[:3], whole[3:], jacobian)

    def _position_rows(self, position: Array, rotation: Array, jacobian: Array) -> _Parts:
        offset, velocity = position - self.target[0], self.target_velocity[:3]
        if self.axes != "frame":
            return offset, jacobian[:3], velocity
        # the axes turn under the offset: d/dt R'(p - p*) = R'(p' + (p - p*) x w)
        turning = dot(cross_matrix(offset), jacobian[3:])
        own = rotation.T
        return dot(own, offset), dot(own, jacobian[:3] + turning), dot(own, velocity)

    def _orientation_rows(self, rotation: Array, jacobian: Array) -> _Parts:
        # R R*' is the turn from target to frame in the outer axes; R*' R is the same turn in the frame's axes
        if self.axes == "frame":
            error = rotation_log(dot(self.target[1].T, rotation))
            factor = dot(self._factor(error).T, rotation.T)
            return error, dot(factor, jacobian), dot(factor, self.target_velocity[3:])
        between = dot(rotation, self.target[1].T)
        error = rotation_log(between)
        factor = self._factor(error)
        return error, dot(factor, jacobian), dot(factor, dot(between, self.target_velocity[3:]))

    def _factor(self, error: Float[Array, "3"]) -> Float[Array, "3 3"]:
        """Return the inverse left Jacobian (transposed: the right one), or the identity for a geometric Jacobian."""
        if self.orientation_jacobian == "geometric":
            return jnp.eye(3, dtype=error.dtype)
        return inverse_left_jacobian(error)

    def _convert(self, name: str, value: Any) -> Any:
        own = vars(self)  # Equinox looks at each attribute that is asked for
        if name == "target":
            rest = _rest(own["target"], own["kept"], own["error"] == "se3")
            return as_pose(value, own["weight"].dtype, rest=rest, numbers=np)
        if name in ("position_weight", "orientation_weight"):
            return _row_weight(value, name, self.weight.dtype)
        return super()._convert(name, value)


def _rest(pose: Pose, kept: Sequence[bool], coupled: bool) -> tuple[Any, Any]:
    """Return position and rotation if the rows do not depend on them, None otherwise: targets may omit them."""
    if coupled:
        return None, None
    position, rotation = pose
    return (None if any(kept[:3]) else position), (None if any(kept[3:]) else rotation)


Fields = tuple[Array, Array, Array, Array, Array, Array, Array, Array]


def fields_of(rows: TaskRows) -> Fields:
    """Return the arguments of ``equality_rows`` that give these rows; ``lower`` is used for both bounds."""
    fields = rows.error, rows.jacobian, rows.lower, rows.weight, rows.curvature, rows.pull, rows.levers
    return *fields, rows.squared_lengths()


def fields_by_core(
    call: Call, method: str, nv: int, weight: Float[Array, "lanes m"], *given: Array | np.ndarray
) -> Fields:
    """Return the arguments of ``equality_rows`` for a batch: arrays with an axis of lanes, or of length 1, in front."""
    count, lanes = weight.shape[1], max(len(a) for a in given if jnp.issubdtype(a.dtype, jnp.floating))
    shapes = (lanes, count), (lanes, count, nv), (lanes, count), (lanes,), (lanes, count), (lanes, nv), (lanes, count)
    error, rows, wanted, *rest = call(method, [(shape, float) for shape in shapes], *given)
    curvature, pull, levers, squares = rest
    return error, rows, wanted, jnp.broadcast_to(weight, error.shape), curvature, pull, levers, squares


def equality_rows(
    error: Array,
    jacobian: Array,
    wanted: Array,
    weight: Array,
    curvature: Array,
    pull: Array,
    levers: Array,
    squares: Array,
) -> TaskRows:
    """Return the rows of an equality from their fields, as the compiled core computes them."""
    fields = error, jacobian, wanted, wanted, weight, curvature, pull, levers
    return TaskRows(*fields, is_equality=True, squares=squares)


def pose_fields(task: PoseTask, position: Array, rotation: Array, jacobian: Array) -> Fields:
    """Return the arguments of ``equality_rows`` for a pose task."""
    return fields_of(task._plain_rows(position, rotation, jacobian))


def _fields_by_kernel(call: Call, task: PoseTask, position: Array, rotation: Array, jacobian: Array) -> Fields:
    """Return ``pose_fields`` for a batch of frames, computed by the core."""
    numbers, options, weight = goal_arguments(task)
    given = position, rotation, jacobian, side_by_side(*numbers), options
    return fields_by_core(call, "pose_rows", jacobian.shape[-1], weight, *given)


def goal_arguments(task: PoseTask) -> tuple[tuple[Array, ...], np.ndarray, Float[Array, "lanes m"]]:
    """Return the numbers and the options of a batch of tasks as the core takes them, and their weights."""
    assert not isinstance(task.gain, AdaptiveGain)
    both = jnp.concatenate([task.position_weight, task.orientation_weight], 1) * task.weight[:, None]
    weight = jnp.concatenate([both[:, i, None] for i in np.flatnonzero(task.kept)], 1)
    options = np.array([*task.kept, task.axes == "frame", task.orientation_jacobian == "geometric"], np.int32)
    return (*task.target, task.target_velocity, weight, task.gain), options, weight


_by_kernel = by_kernel(pose_fields, _fields_by_kernel)


def _twice(rotation: Float[Array, "3 3"]) -> Float[Array, "6 6"]:
    """Return the (6, 6) matrix that rotates both halves of a wrench or twist."""
    zero = jnp.zeros_like(rotation)
    return jnp.block([[rotation, zero], [zero, rotation]])


def _chosen(kept: Sequence[bool], arrays: Sequence[Array]) -> list[Array]:
    """Return the chosen rows of each array."""
    return list(arrays) if all(kept) else [array[np.flatnonzero(kept)] for array in arrays]


def _row_weight(value: Any, name: str, dtype: Any) -> Float[Array, "3"]:
    out = as_vector(value, (3,), name, dtype)
    check_not_negative(out, name)
    return out


def option(name: str, value: str, available: tuple[str, ...]) -> str:
    """Return a value that is one of the available options."""
    if value not in available:
        raise OsikValueError(f"{name} is {value!r}; it is one of: {', '.join(map(repr, available))}")
    return value


def row_mask(rows: str | Sequence[bool]) -> tuple[bool, ...]:
    """Return six booleans from the name of a set of rows, or from six booleans."""
    if isinstance(rows, str):
        if rows not in ROWS:
            raise OsikValueError(unknown_name("row set", rows, tuple(ROWS)).args[0])
        return ROWS[rows]
    mask = tuple(bool(row) for row in rows)
    if len(mask) != 6 or not any(mask):
        raise OsikValueError(f"rows has six booleans (x, y, z, rotation about x, y, z), at least one true; got {rows}")
    return mask


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
