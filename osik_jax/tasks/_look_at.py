"""A task that points an axis of a frame at a point."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import jax.numpy as jnp
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

NEAREST = 1e-3
"""Distance [m] below which there is no line of sight."""


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
        priority: 1 is the most important.
        hard: makes it a constraint, see ``Task``.

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
        check_frames(robot, frame, target_frame)
        if target is None and target_frame is None:
            target = _ahead(robot, home_kinematics(robot), frame, axis)
        super().__init__(
            robot,
            frame,
            target_frame,
            axis=axis,
            target=0.0 if target is None else target,
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
        del backend
        position, rotation, jacobian = positions[0], rotations[0], jacobians[0]
        point, velocity, moves = self.target, self.target_velocity, jnp.zeros_like(jacobian[:3])
        if self.target_frame is not None:
            arm = dot(rotations[1], self.target)
            point, velocity = positions[1] + arm, dot(rotations[1], self.target_velocity)
            moves = jacobians[1, :3] - dot(cross_matrix(arm), jacobians[1, 3:])
        line = point - position
        squared = jnp.sum(line**2)
        near = squared < NEAREST**2
        distance = jnp.sqrt(jnp.where(near, 1.0, squared))
        sight = jnp.where(near, dot(rotation, unit(self.axis)), line / distance)
        narrowing = (jnp.eye(3, dtype=sight.dtype) - jnp.outer(sight, sight)) / distance
        turn = jnp.where(near, 0.0, rotation.T)
        # the line follows the point and leaves the camera: minus its motion; seen from the turning camera, + sight x w
        rate = dot(narrowing, moves - jacobian[:3]) + dot(cross_matrix(sight), jacobian[3:])
        return self.pointing_rows(dot(rotation.T, sight), dot(turn, rate), dot(turn, dot(narrowing, velocity)))

    def _held(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> dict[str, Any]:
        """Return the field ``target`` that the camera sees at q: a point 1 m ahead, in the frame that carries it."""
        del q
        point = _ahead(robot, kinematics, self.frame, self.axis)
        if self.target_frame is not None:
            position, rotation = kinematics.frame_pose(robot, self.target_frame)
            point = dot(rotation.T, point - position)
        return dict(target=point)


def _ahead(robot: Robot, kinematics: Kinematics, frame: str, axis: ArrayLike | Array) -> Float[Numbers, "3"]:
    """Return the point 1 m along the axis [m]."""
    position, rotation = kinematics.frame_pose(robot, frame)
    return position + dot(rotation, unit(on_host(as_direction(axis, "axis", position.dtype))))
