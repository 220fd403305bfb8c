"""Base of tasks whose rows follow from the poses and Jacobians of a few frames."""

from __future__ import annotations

import abc
from typing import ClassVar

from jaxtyping import Array, Float

from ..execution._backends import Backend
from ..kinematics import Kinematics
from ..kinematics._forward import moving_frames
from ..robot import Robot
from ._task import Task, TaskRows


class FramedTask(Task):
    """Base of tasks on frames; tasks of the same structure are evaluated in one batch (``rows_of``)."""

    is_goal: ClassVar[bool] = True
    sees_places: ClassVar[bool] = True

    @property
    @abc.abstractmethod
    def frames(self) -> tuple[str, ...]:
        """Return the names of the frames."""

    @property
    @abc.abstractmethod
    def bounded(self) -> bool:
        """Return whether the rows are inequalities."""

    @abc.abstractmethod
    def rows_at(
        self,
        positions: Float[Array, "k 3"],
        rotations: Float[Array, "k 3 3"],
        jacobians: Float[Array, "k 6 nv"],
        backend: Backend = "jax",
    ) -> TaskRows:
        """Return the rows from the world poses and Jacobians of the frames, by a kernel if the task has one."""

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return error, Jacobian and wanted velocities at configuration q with given kinematics."""
        del q
        return self.rows_at(*moving_frames(robot, kinematics, self.frames), kinematics.backend)
