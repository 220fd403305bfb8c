"""What a demonstration asks of a robot."""

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
"""[1/s], of all tasks but the posture: at 200 Hz a tenth of an error goes in a step."""


@dataclasses.dataclass(frozen=True)
class Goal:
    """A frame that follows a path.

    Attributes:
        frame: its name.
        path: where it should be.
        rows: what of it counts: ``"pose"`` or ``"position"``.
    """

    frame: str
    path: Path
    rows: Literal["pose", "position"] = "pose"


@dataclasses.dataclass(frozen=True)
class Stance:
    """A frame on the ground, and when it has to stay there.

    Attributes:
        frame: its name.
        corners: its contact corners in the frame [m]; none: it takes no part in the support polygon. (k, 3)
        lifted: from when to when it is in the air [s]; ``None``: never.
        flat: whether it may not turn either; a foot that is a point may.
    """

    frame: str
    corners: np.ndarray
    lifted: tuple[float, float] | None = None
    flat: bool = True

    def on_ground(self, t: np.ndarray) -> np.ndarray:
        """For each time [s], whether it stands."""
        if self.lifted is None:
            return np.ones(len(t), bool)
        return (t <= self.lifted[0]) | (t >= self.lifted[1])


@dataclasses.dataclass(frozen=True)
class Motion:
    """Tasks over time, and what is needed to judge how well they were done.

    Attributes:
        name: for files and reports.
        title: for people.
        robot: the robot.
        q0: where it starts. (nq,)
        tasks: from time [s] to the tasks; traced by JAX.
        duration: [s].
        stances: frames that stand.
        goals: label to what moves; the first is the one that pictures tell of.
        limits: those that the schemes get.
        balanced: whether a task keeps the centre of mass over the support polygon.
        notes: remarks for the user.
        look: what pictures show of it; ``None``: the model's own shapes.
        scale: how large the motion is against one of 5 cm; the errors that are wanted grow with it.
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
    """The task that follows a goal, standing at its start."""
    pose = (goal.path.position, goal.path.rotation)
    return FrameTask(robot, goal.frame, target=pose, rows=goal.rows, weight=weight, gain=gain, priority=priority)


def along(task: FrameTask, goal: Goal, t: Any) -> FrameTask:
    """The task at time t [s]."""
    pose, velocity = goal.path.at(t)
    return task.replace(target=pose, target_velocity=velocity)


def circumscribed(normals: Float[Array, "m 2"], polygon: SupportPolygon) -> SupportPolygon:
    """The smallest polygon with the given normals, in order around it, that contains another polygon."""
    edges = np.asarray(normals)
    offsets = (np.asarray(polygon.vertices) @ edges.T).max(0)
    before = np.roll(edges, 1, 0)
    pairs = np.stack([before, edges], 1)
    vertices = np.linalg.solve(pairs, np.stack([np.roll(offsets, 1), offsets], 1)[..., None])[..., 0]
    return SupportPolygon(jnp.asarray(edges), jnp.asarray(offsets), jnp.asarray(vertices))


def blended(wide: SupportPolygon, tight: SupportPolygon, s: Any) -> SupportPolygon:
    """Between two polygons with the same normals: ``wide`` at s = 0, ``tight`` at s = 1."""
    offsets = (1.0 - s) * wide.offsets + s * tight.offsets
    return SupportPolygon(tight.normals, offsets, (1.0 - s) * wide.vertices + s * tight.vertices)
