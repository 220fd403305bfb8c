"""Bases of tasks: on poses and Jacobians of a few frames, and on motions, as inverse kinematics reads them."""

from __future__ import annotations

import abc
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..execution._backends import Backend
from ..kinematics import Kinematics, difference
from ..kinematics._forward import moving_frames
from ..robot import Robot
from ._curvature import no_curvature
from ._gain import as_gain
from ._task import Task, TaskRows


class Frames(NamedTuple):
    """World poses and Jacobians of the frames of a task."""

    positions: Float[Array, "k 3"]
    rotations: Float[Array, "k 3 3"]
    jacobians: Float[Array, "k 6 nv"]


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
    def rows_at(self, frames: Frames, backend: Backend = "jax") -> TaskRows:
        """Return the rows from the poses and Jacobians of the frames, by a kernel if the task has one."""

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return error, Jacobian and wanted velocities at configuration q with given kinematics."""
        del q
        return self.rows_at(Frames(*moving_frames(robot, kinematics, self.frames)), kinematics.backend)

    def frame_options(self, robot: Robot) -> list[int]:
        """Return the frames as ``FramedCard`` in ``core/tasks`` reads them."""
        tree, options = robot.tree, [len(self.frames)]
        for frame in map(tree.frame, self.frames):
            carrier = tree.frame_bodies[frame]
            options += [frame, carrier, *map(int, tree.moves[carrier])]
        return options


class MotionTask(Task):
    """Base of tasks on a motion: no error that could decay, and no gain.

    In ``inverse_kinematics`` they ask for no motion from ``q0`` along their rows.
    """

    def sought(self, robot: Robot, q0: Float[Array, " nq"]) -> Task:
        """Return a task for no motion from q0."""
        del robot
        return StayTask(self, q0)

    @property
    def replaceable(self) -> tuple[str, ...]:
        """Return the names that ``replace`` accepts."""
        return tuple(name for name in super().replaceable if name != "gain")


class StayTask(Task):
    """Task that asks for the motion from a configuration to be 0 along another task's rows: ``J difference(q0, q)``.

    What the other task asks of a velocity is asked of the whole motion, with its rows, weights and priority.
    """

    ties_joints: ClassVar[bool] = True
    moving: Task
    start: Float[Array, " nq"]

    def __init__(self, moving: Task, start: Float[Array, " nq"]):
        self.moving, self.start = moving, start
        self.weight, self.priority, self.hard = moving.weight, moving.priority, moving.hard
        self.gain = as_gain(1.0, moving.weight.dtype)

    @property
    def is_goal(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Return whether the other task is a goal."""
        return self.moving.is_goal

    def counted_dofs(self, robot: Robot) -> tuple[int, ...]:
        """Return those of the other task."""
        return self.moving.counted_dofs(robot)

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return the rows of the other task, whose error is the motion along them."""
        own = self.moving.rows(robot, kinematics, q)
        away = difference(robot, self.start, q)
        # q minus q0 along the rows: 0 at the start, so the task asks for no motion there
        moved = away[jnp.array(own.dofs)] if own.dofs else jnp.matmul(own.jacobian, away, precision="highest")
        return TaskRows.of(
            moved,
            own.jacobian,
            gain=self.gain,
            weight=jnp.broadcast_to(self.weight, moved.shape),
            dofs=own.dofs,
            curvature=no_curvature,
        )
