"""Task on the pose of a frame relative to another frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..execution._backends import Backend
from ..kinematics import Kinematics
from ..kinematics._pose_forms import Pose, PoseLike
from ..robot import Robot
from ._gain import AdaptiveGain
from ._leaves import home_kinematics
from ._pose import RADIAN, PoseTask
from ._rotation import cross_matrix, dot
from ._task import DEFAULT_GAIN, CoreCard, TaskRows


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
        lower: makes an inequality task: lower bounds on the rows of e, one for each row that is kept, or a scalar.
        upper: upper bounds; one of the two may be left out, infinite entries bound nothing.
        position_weight: weight of the squared position rows, scalar or (3,) along the axes of ``axes``.
        orientation_weight: weight of the squared orientation rows, scalar or (3,), see ``FrameTask``. A row of weight 0
            costs nothing.
        weight: multiplies all rows' weights.
        rows: ``"pose"``, ``"position"``, ``"orientation"``, or six booleans (x, y, z, rotation about x, y, z): the rows
            that the task has. Static; weights are not.
        axes: ``"root"`` or ``"frame"``; default: the root's, the frame's for ``error="se3"``.
        error: ``"decoupled"`` or ``"se3"``, see ``FrameTask``.
        orientation_jacobian: ``"analytic"`` or ``"geometric"``, see ``FrameTask``.
        gain: [1/s], a number or an ``AdaptiveGain``.
        priority: 1 is the most important.
        hard: makes it a constraint, see ``Task``.

    Raises:
        KeyError: no such frame.
        ValueError: frame and root are the same, a wrong shape, a rotation that is not one, a negative weight,
            lower > upper, an unknown option.
    """

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
            home=_pose_in(robot, home_kinematics(robot), frame, root),
            target=target,
            target_velocity=target_velocity,
            lower=lower,
            upper=upper,
            position_weight=position_weight,
            orientation_weight=orientation_weight,
            weight=weight,
            rows=rows,
            axes=axes,
            outer_axes="root",
            error=error,
            orientation_jacobian=orientation_jacobian,
            gain=gain,
            priority=priority,
            hard=hard,
        )

    @property
    def frames(self) -> tuple[str, ...]:
        """Return the name of the frame, then of its root."""
        return self.frame, self.root

    def core(self, robot: Robot) -> CoreCard | str:
        """Return the card of a pose, or in words why there is none."""
        return self._core_card(robot) if type(self) is RelativeFrameTask else super().core(robot)

    def rows_at(
        self,
        positions: Float[Array, "2 3"],
        rotations: Float[Array, "2 3 3"],
        jacobians: Float[Array, "2 6 nv"],
        backend: Backend = "jax",
    ) -> TaskRows:
        """Return the chosen rows in the order x, y, z, rotation x, y, z. (m <= 6)."""
        turn, (frame, root) = rotations[1].T, jacobians
        apart = positions[0] - positions[1]
        # seen from a root that turns by w, a point at rest moves by apart x w
        linear = frame[:3] - root[:3] + dot(cross_matrix(apart), root[3:])
        jacobian = jnp.concatenate([dot(turn, linear), dot(turn, frame[3:] - root[3:])])
        return self.pose_rows(dot(turn, apart), dot(turn, rotations[0]), jacobian, backend)

    def _held(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> dict[str, Any]:
        del q
        return dict(target=_pose_in(robot, kinematics, self.frame, self.root))


def _pose_in(robot: Robot, kinematics: Kinematics, frame: str, root: str) -> Pose:
    """Return the frame's pose in the root."""
    positions, rotations = kinematics.frame_poses(robot, (frame, root))
    turn = rotations[1].T
    return dot(turn, positions[0] - positions[1]), dot(turn, rotations[0])
