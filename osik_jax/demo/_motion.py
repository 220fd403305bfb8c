"""Motion of a demonstration: tasks over time, and the references to judge it by."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..physics._world import contact_corners as contact_corners
from ..robot import Robot
from ..tasks import FrameTask, SupportPolygon, Task
from ..viewer import Look
from ._references import Path

GAIN = 20.0
"""Gain of all tasks but the posture [1/s]: at 200 Hz a step removes a tenth of an error."""


@dataclasses.dataclass(frozen=True)
class Goal:
    """Frame that follows a path.

    Attributes:
        frame: name of the frame.
        path: reference of its pose.
        rows: tracked part of the pose: ``"pose"`` or ``"position"``.
    """

    frame: str
    path: Path
    rows: Literal["pose", "position"] = "pose"


@dataclasses.dataclass(frozen=True)
class Stance:
    """Frame that stands on the ground for a time.

    Attributes:
        frame: name of the frame.
        corners: its contact corners in the frame [m]; empty: not part of the support polygon. (k, 3)
        lifted: start and end of the time in the air [s]; ``None``: never.
        flat: whether its orientation must stay too; a point foot may rotate.
    """

    frame: str
    corners: np.ndarray
    lifted: tuple[float, float] | None = None
    flat: bool = True

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
        limits: limits given to the schemes.
        balanced: whether a task keeps the centre of mass over the support polygon.
        notes: remarks for the user.
        look: visual shapes for pictures; ``None``: those of the model.
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
    limits: Sequence[Any]
    balanced: bool = True
    notes: tuple[str, ...] = ()
    look: Look | None = None
    scale: float = 1.0


def tracking(robot: Robot, goal: Goal, *, weight: float, priority: int, gain: float = GAIN) -> FrameTask:
    """Return the task that follows a goal, with its target at the start of the path."""
    pose = (goal.path.position, goal.path.rotation)
    return FrameTask(robot, goal.frame, target=pose, rows=goal.rows, weight=weight, gain=gain, priority=priority)


def along(task: FrameTask, goal: Goal, t: Any) -> FrameTask:
    """Return the task with the target of the path at time t [s]."""
    pose, velocity = goal.path.at(t)
    return task.replace(target=pose, target_velocity=velocity)


def circumscribed(normals: Float[Array, "m 2"], polygon: SupportPolygon) -> SupportPolygon:
    """Return the smallest polygon with the given normals that contains another polygon."""
    edges = np.asarray(normals)
    offsets = (np.asarray(polygon.vertices) @ edges.T).max(0)
    before = np.roll(edges, 1, 0)
    pairs = np.stack([before, edges], 1)
    vertices = np.linalg.solve(pairs, np.stack([np.roll(offsets, 1), offsets], 1)[..., None])[..., 0]
    return SupportPolygon(jnp.asarray(edges), jnp.asarray(offsets), jnp.asarray(vertices))


def blended(wide: SupportPolygon, tight: SupportPolygon, s: Any) -> SupportPolygon:
    """Return the polygon between two with the same normals: ``wide`` at s = 0, ``tight`` at s = 1."""
    offsets = (1.0 - s) * wide.offsets + s * tight.offsets
    return SupportPolygon(tight.normals, offsets, (1.0 - s) * wide.vertices + s * tight.vertices)
