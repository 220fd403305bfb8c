"""Tasks whose rows follow from where a few frames are and how they move."""

from __future__ import annotations

import abc

from jaxtyping import Array, Float

from ..execution._backends import Backend
from ..kinematics import Kinematics
from ..kinematics._forward import moving_frames
from ..robot import Robot
from ._task import Task, TaskRows


class FramedTask(Task):
    """Base of tasks on frames; a step works on many of them in one go (``rows_of``)."""

    @property
    @abc.abstractmethod
    def frames(self) -> tuple[str, ...]:
        """Names of the frames."""

    @property
    @abc.abstractmethod
    def bounded(self) -> bool:
        """Whether the rows are inequalities."""

    @abc.abstractmethod
    def rows_at(
        self,
        positions: Float[Array, "k 3"],
        rotations: Float[Array, "k 3 3"],
        jacobians: Float[Array, "k 6 nv"],
        backend: Backend = "jax",
    ) -> TaskRows:
        """The rows, from the poses and Jacobians of the frames in the world; by a kernel where there is one for it."""

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Error, Jacobian and wanted velocities at configuration q, whose kinematics are given."""
        del q
        return self.rows_at(*moving_frames(robot, kinematics, self.frames), kinematics.backend)
