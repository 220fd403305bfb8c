"""Motion of a demonstration: tasks over time, and the references to judge it by."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import Array, Float

from ..robot import Robot
from ..tasks import FrameTask, Task
from ._references import Path

GAIN = 20.0
"""Gain of all tasks but the posture [1/s]: at 200 Hz a step removes a tenth of an error."""
MARGIN = 0.01
"""Margin of the centre of mass inside the support polygon [m]."""

Rows = Literal["pose", "position"]


@dataclasses.dataclass(frozen=True)
class Goal:
    """Frame that follows a path."""

    frame: str  # name of the frame
    path: Path  # reference of its pose
    rows: Rows = "pose"  # tracked part of the pose: ``"pose"`` or ``"position"``


@dataclasses.dataclass(frozen=True)
class Stance:
    """Frame that stands on the ground for a time."""

    frame: str  # name of the frame
    corners: np.ndarray  # its contact corners in the frame [m]; empty: not part of the support polygon. (k, 3)
    lifted: tuple[float, float] | None = None  # start and end of the time in the air [s]; ``None``: never
    flat: bool = True  # whether its orientation must stay too; a point foot may rotate

    def on_ground(self, t: np.ndarray) -> np.ndarray:
        """Return whether the frame stands at each time [s]. (T,)."""
        if self.lifted is None:
            return np.ones(len(t), bool)
        return (t <= self.lifted[0]) | (t >= self.lifted[1])


@dataclasses.dataclass(frozen=True)
class Motion:
    """Tasks over time, and the references to judge them by.

    Attributes:
        name: name in files and reports.
        title: title for display.
        robot: the robot.
        q0: start configuration. (nq,)
        tasks: function from time [s] to the tasks; traced by JAX.
        duration: length of the motion [s].
        stances: frames that stand.
        goals: label to moving frame; pictures show the first one.
        balanced: whether a task keeps the centre of mass over the support polygon.
        notes: remarks for the user.
        scale: size of the motion relative to 5 cm; required errors grow with it.
    """

    name: str
    title: str
    robot: Robot
    q0: Float[Array, " nq"]
    tasks: Callable[[Any], Mapping[str, Task]]
    duration: float
    stances: tuple[Stance, ...]
    goals: Mapping[str, Goal]
    balanced: bool = True
    notes: tuple[str, ...] = ()
    scale: float = 1.0


def tracking(robot: Robot, goal: Goal, *, weight: float, priority: int) -> FrameTask:
    """Return the task that follows a goal, with its target at the start of the path."""
    numbers: Any = dict(target=(goal.path.position, goal.path.rotation), weight=weight, gain=GAIN, priority=priority)
    # a radian counts as 1 m: feet and waist have to stay level
    return FrameTask(robot, goal.frame, rows=goal.rows, orientation_weight=1.0, **numbers)


def along(task: FrameTask, goal: Goal, t: Any) -> FrameTask:
    """Return the task with the target of the path at time t [s]."""
    pose, velocity = goal.path.at(t)
    return task.replace(target=pose, target_velocity=velocity)
