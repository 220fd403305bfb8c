"""A task that aligns an axis of a frame with a direction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ..execution._backends import Backend
from ..kinematics import Kinematics
from ..numerics._host import Numbers, on_host
from ..robot import Robot
from ._gain import AdaptiveGain
from ._leaves import home_kinematics
from ._pointing import PointingTask, as_direction, check_frames, unit
from ._rotation import cross_matrix, dot
from ._task import DEFAULT_GAIN, TaskRows


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
        priority: 1 is the most important.
        hard: makes it a constraint, see ``Task``.

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
        check_frames(robot, frame, target_frame)
        home = home_kinematics(robot)
        direction = _pointed(robot, home, frame, target_frame, axis) if target is None else target
        super().__init__(
            robot,
            frame,
            target_frame,
            axis=axis,
            target=as_direction(direction, "target", robot.q0.dtype),
            target_velocity=0.0 if target_velocity is None else target_velocity,
            half_angle=half_angle,
            weight=weight,
            gain=gain,
            priority=priority,
            hard=hard,
        )

    def rows_at(
        self,
        positions: Float[Array, "k 3"],
        rotations: Float[Array, "k 3 3"],
        jacobians: Float[Array, "k 6 nv"],
        backend: Backend = "jax",
    ) -> TaskRows:
        """Return two rows along the axes across ``axis`` [rad], or one row for a cone."""
        del positions, backend
        turn, spin = rotations[0].T, jacobians[0, 3:]
        direction, velocity = unit(self.target), self.target_velocity
        if self.target_frame is not None:
            direction, velocity = dot(rotations[1], direction), dot(rotations[1], velocity)
            # where the direction turns with another frame, the relative turn counts
            spin = spin - jacobians[1, 3:]
        # a direction d, seen from a frame that turns by w, changes by d x w; its own turning has the other sign
        turned = dot(turn, cross_matrix(direction))
        return self.pointing_rows(dot(turn, direction), dot(turned, spin), -dot(turned, velocity))

    def _held(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> dict[str, Any]:
        del q
        return dict(target=_pointed(robot, kinematics, self.frame, self.target_frame, self.axis))

    def _convert(self, name: str, value: Any) -> Any:
        if name == "target":
            return as_direction(value, name, self.weight.dtype)
        return super()._convert(name, value)


def _pointed(
    robot: Robot, kinematics: Kinematics, frame: str, target_frame: str | None, axis: ArrayLike | Array
) -> Float[Numbers, "3"]:
    """Return the direction of the axis, in the world or in the target frame."""
    names = (frame,) if target_frame is None else (frame, target_frame)
    _, rotations = kinematics.frame_poses(robot, names)
    direction = dot(rotations[0], unit(on_host(as_direction(axis, "axis", rotations.dtype))))
    return direction if target_frame is None else dot(rotations[1].T, direction)
