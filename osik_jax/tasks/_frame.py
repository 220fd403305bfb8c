"""Tasks on the pose of a frame, in the world or in another frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..execution._backends import Backend
from ..execution._computed import by_kernel, side_by_side
from ..kinematics import Kinematics
from ..kinematics._forward import moving_frames
from ..kinematics._kernels import Call, dof_columns
from ..kinematics._pose_forms import PoseLike
from ..robot import Robot
from ._bases import Frames
from ._gain import AdaptiveGain
from ._pose import (
    RADIAN,
    Fields,
    PoseTask,
    equality_rows,
    fields_by_core,
    goal_arguments,
    pose_fields,
)
from ._rotation import cross_matrix, dot
from ._task import DEFAULT_GAIN, TaskRows


class FrameTask(PoseTask):
    """Task that brings a frame to a pose, or keeps it within bounds around one.

    With p (3,), R (3, 3) the frame's pose, p*, R* the target's, and v*, w* the target's velocity (world axes):

    - ``axes="world"``: ``e = [p - p*; log(R R*')]`` and ``e' = [J_lin; E J_ang] v - [v*; E Q w*]``, with
      ``Q = R R*'`` and E the inverse left Jacobian of SO(3) at ``log Q`` (the matrix E of Ramos' analytic Jacobian).
    - ``axes="frame"``, the frame's own axes: ``e = [R' (p - p*); log(R*' R)]`` and
      ``e' = [R' (J_lin + [p - p*] J_ang); E R' J_ang] v - [R' v*; E R' w*]``, with E the inverse right Jacobian at
      ``log(R*' R)``. Leaving a row out frees, for instance, the rotation of a tool about its own z axis.
    - ``error="se3"``: the logarithm on SE(3) of the pose in the target, ``e = log(T*^-1 T)``, [linear; angular] along
      the frame's own axes, and ``e' = L (twist - Ad twist*)``, with L Pinocchio's ``Jlog6`` at e. It is what pink and
      mink use (their error is -e). Position and orientation are coupled: the linear rows are ``E R*' (p - p*)``, so
      that the target's rotation counts in them too, also where the orientation rows are left out or weigh nothing.

    The task asks for ``e' = -gain(e) e`` (``AdaptiveGain`` is Ramos, eq. 3). As an inequality
    (``lower``, ``upper``) it keeps the same e, the pose relative to the target, within bounds:
    ``gain (lower - e) <= e' <= gain (upper - e)``. Rows are metres and radians; angles up to pi.

    Args:
        robot: the robot.
        frame: name of a body, link, site or geom.
        target: ``(p (3,), R (3, 3))``, ``(p (3,), quaternion w x y z (4,))``, a (4, 4) matrix or a ``jaxlie.SE3`` (or
            mink's, or Pinocchio's); default: the frame's pose at ``robot.q0``. With position rows alone p will do, with
            orientation rows alone R or the quaternion; what is left out stays as it is.
        target_velocity: of the target, (6,), [linear; angular] in world axes [m/s, rad/s]; default 0.
        lower: makes an inequality task: lower bounds on the rows of e, one for each row that is kept, or a scalar.
        upper: upper bounds; one of the two may be left out, infinite entries bound nothing.
        position_weight: weight of the squared position rows, scalar or (3,) along the axes of ``axes``.
        orientation_weight: weight of the squared orientation rows, scalar or (3,). A row of weight 0 costs nothing.
            Beside a ``position_weight`` of 1 it is the square of the length [m] that a radian counts as. The default,
            0.01, is a length of 0.1 m, as in ``inverse_kinematics``; 1 is a length of 1 m.
        weight: multiplies all rows' weights.
        rows: ``"pose"``, ``"position"``, ``"orientation"``, or six booleans (x, y, z, rotation about x, y, z): the rows
            that the task has. Static; weights are not.
        axes: ``"world"`` or ``"frame"``; default: the world's, the frame's for ``error="se3"``.
        error: ``"decoupled"``: position and orientation apart. ``"se3"``: the coupled error of pink and mink.
        orientation_jacobian: ``"analytic"`` (exact), or ``"geometric"``: E = I. Both ask for the same motion where
            the task can be met; where it cannot, they weigh the residual across the error's axis differently, by a
            factor (angle/2) / sin(angle/2), at most pi/2.
        gain: [1/s], a number or an ``AdaptiveGain``.

    Raises:
        KeyError: no such frame.
        ValueError: a wrong shape, a rotation that is not one, a negative weight, lower > upper, an unknown option.
    """

    __init__, _card = PoseTask.__init__, PoseTask._card

    @property
    def frames(self) -> tuple[str, ...]:
        """Return the name of the frame."""
        return (self.frame,)

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return error, Jacobian and wanted velocities at configuration q with given kinematics."""
        columns, _ = dof_columns(robot.tree)
        if self._in_core(kinematics.backend) and np.array_equal(columns, np.arange(robot.tree.nv)):
            return equality_rows(*_by_kernel(self, robot, replace(kinematics, backend="jax")))
        return super().rows(robot, kinematics, q)

    def grip(self) -> tuple[Array, Array | None] | None:
        """Return the target's pose, or None if the task has bounds."""
        position, rotation = self.target
        return None if self.bounded else (position, rotation if any(self.kept[3:]) else None)

    def gripped(self, position: Float[np.ndarray, "3"], rotation: np.ndarray) -> Any:
        """Return the target at a pose; a target that does not turn keeps its rotation."""
        return position, rotation if any(self.kept[3:]) else self.target[1]

    def rows_at(self, frames: Frames, backend: Backend = "jax") -> TaskRows:
        """Return the chosen rows in the order x, y, z, rotation x, y, z. (m <= 6)."""
        return self.pose_rows(frames.positions[0], frames.rotations[0], frames.jacobians[0], backend)

    def _held(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> dict[str, Any]:
        del q
        return dict(target=kinematics.frame_pose(robot, self.frame))


class RelativeFrameTask(PoseTask):
    """Task that brings a frame to a pose in another frame, its root, or keeps it within bounds around one.

    A ``FrameTask`` whose world is the root: p and R are the frame's pose in the root, ``p = R_r' (p_f - p_r)`` and
    ``R = R_r' R_f``, with the Jacobians ``R_r' (J_f,lin - J_r,lin + [p_f - p_r] J_r,ang)`` and
    ``R_r' (J_f,ang - J_r,ang)``. The robot may move either of the two, or both as one: two hands on one tray, a foot
    under the pelvis.

    Args:
        robot: the robot.
        frame: name of a body, link, site or geom.
        root: the frame that the pose is in; another one.
        target: the pose in the root, in any of the forms that ``FrameTask`` takes; default: what holds at
            ``robot.q0``.
        target_velocity: of the target in the root, (6,), [linear; angular] in the root's axes [m/s, rad/s]; default 0.
        axes: ``"root"`` or ``"frame"``; default: the root's, the frame's for ``error="se3"``.
        lower: this and all others as those of a ``FrameTask``.

    Raises:
        KeyError: no such frame.
        ValueError: frame and root are the same, a wrong shape, a rotation that is not one, a negative weight,
            lower > upper, an unknown option.
    """

    outer_axes: ClassVar[str] = "root"
    root: str = eqx.field(static=True)

    def __init__(
        self,
        robot: Robot,
        frame: str,
        root: str,
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
        axes: Literal["root", "frame"] | None = None,
        error: Literal["decoupled", "se3"] = "decoupled",
        orientation_jacobian: Literal["analytic", "geometric"] = "analytic",
        gain: ArrayLike | Array | AdaptiveGain = DEFAULT_GAIN,
        priority: int = 1,
        hard: bool = False,
    ):
        robot.tree.frame(frame)
        robot.tree.frame(root)
        if frame == root:
            raise OsikValueError(f"frame and root are both {frame!r}; the pose of a frame in itself never changes")
        self.root = root
        super().__init__(
            robot,
            frame,
            target=target,
            target_velocity=target_velocity,
            lower=lower,
            upper=upper,
            position_weight=position_weight,
            orientation_weight=orientation_weight,
            weight=weight,
            rows=rows,
            axes=axes,
            error=error,
            orientation_jacobian=orientation_jacobian,
            gain=gain,
            priority=priority,
            hard=hard,
        )

    _card = PoseTask._card

    @property
    def frames(self) -> tuple[str, ...]:
        """Return the name of the frame, then of its root."""
        return self.frame, self.root

    def rows_at(self, frames: Frames, backend: Backend = "jax") -> TaskRows:
        """Return the chosen rows in the order x, y, z, rotation x, y, z. (m <= 6)."""
        positions, rotations, (frame, root) = frames
        turn = rotations[1].T
        apart = positions[0] - positions[1]
        # seen from a root that turns by w, a point at rest moves by apart x w
        linear = frame[:3] - root[:3] + dot(cross_matrix(apart), root[3:])
        jacobian = jnp.concatenate([dot(turn, linear), dot(turn, frame[3:] - root[3:])])
        return self.pose_rows(dot(turn, apart), dot(turn, rotations[0]), jacobian, backend)

    def _held(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> dict[str, Any]:
        del q
        positions, rotations = kinematics.frame_poses(robot, self.frames)
        turn = rotations[1].T
        return dict(target=(dot(turn, positions[0] - positions[1]), dot(turn, rotations[0])))


def _fields(task: FrameTask, robot: Robot, kinematics: Kinematics) -> Fields:
    return pose_fields(task, *(a[0] for a in moving_frames(robot, kinematics, task.frames)))


def _fields_by_kernel(call: Call, task: FrameTask, robot: Robot, kinematics: Kinematics) -> Fields:
    """Return the fields of a batch of robots in which each dof has a column of its own, computed by the core."""
    tree = robot.tree
    frame = tree.frame(task.frame)
    body = tree.frame_bodies[frame]
    goal, options, weight = goal_arguments(task)
    place = dof_columns(tree)[1][None], robot.frame_position[:, frame], robot.frame_rotation[:, frame]
    integers = np.concatenate([[body], tree.moves[body], options]).astype(np.int32)
    given = *jax.tree.leaves(kinematics), side_by_side(*place), side_by_side(*goal), integers
    return fields_by_core(call, "frame_rows", tree.nv, weight, *given)


_by_kernel = by_kernel(_fields, _fields_by_kernel)
