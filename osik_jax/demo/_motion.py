"""Motion of a demonstration: tasks over time, and the paths to judge it by."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ..robot import Robot
from ..tasks import FrameTask, Task

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


def minimum_jerk(t: ArrayLike | Array, start: float, duration: float) -> tuple[Array, Array]:
    """Return value and rate [1/s] of a minimum-jerk curve from 0 at ``start`` to 1 at ``start + duration`` [s]."""
    s = jnp.clip((jnp.asarray(t) - start) / duration, 0.0, 1.0)
    # the quintic with zero velocity and acceleration at both ends, and its derivative
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2), 30.0 * s**2 * (1.0 - s) ** 2 / duration


@dataclasses.dataclass(frozen=True)
class Stroke:
    """Minimum-jerk move by ``amount`` between two times."""

    start: float  # when it starts [s]
    end: float  # when it ends [s]
    amount: tuple[float, ...]  # how far, one number for each coordinate


def follow(strokes: Sequence[Stroke], t: ArrayLike | Array, size: int) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return the sum of the strokes at time t [s], and its velocity. (size,) each."""
    value = rate = jnp.zeros(size)
    for stroke in strokes:
        s, speed = minimum_jerk(t, stroke.start, stroke.end - stroke.start)
        amount = jnp.asarray(stroke.amount)
        value, rate = value + s * amount, rate + speed * amount
    return value, rate


@dataclasses.dataclass(frozen=True)
class Path:
    """Reference of a frame over time: its position moves by strokes, its rotation stays."""

    position: np.ndarray  # at the start [m]. (3,)
    rotation: np.ndarray  # frame axes to world axes. (3, 3)
    strokes: tuple[Stroke, ...] = ()  # moves of the position [m]

    def at(self, t: ArrayLike | Array) -> tuple[tuple[Float[Array, "3"], Float[Array, "3 3"]], Float[Array, "6"]]:
        """Return pose (p, R) and velocity [linear; angular] in world axes at time t [s]."""
        shift, velocity = follow(self.strokes, t, 3)
        pose = jnp.asarray(self.position) + shift, jnp.asarray(self.rotation)
        return pose, jnp.concatenate([velocity, jnp.zeros(3)])
