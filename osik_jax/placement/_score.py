"""Scores of bases: how many poses each reaches, how far from its joints' limits, and how manipulable."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..collision import Scene
from ..inverse._chain_problem import ChainRoute, dof_of_entries
from ..inverse._chain_search import Goal
from ..inverse._inverse_kinematics import inverse_kinematics, joint_box
from ..inverse._solution import InverseKinematicsSolution
from ..reachability._frame import Frame
from ..robot import Robot
from ._bases import in_bases, scenes_in_bases

_NUMBERS = 8_000_000
"""Largest number of entries of all scenes of one call, so that they take about 100 MB."""


class Task(NamedTuple):
    """Poses, obstacles and settings by which bases are compared.

    Attributes:
        robot: the robot.
        frames: those that the poses are of, with their kinematics.
        rows: of each frame, which rows of its pose count.
        goal: the poses, in world axes. (poses, frames, ...)
        scene: in world axes; None: collisions do not count.
        settings: other arguments of ``inverse_kinematics``.
    """

    robot: Robot
    frames: tuple[Frame, ...]
    rows: tuple[tuple[bool, ...], ...]
    goal: Goal
    scene: Scene | None
    settings: dict[str, Any]


class Scores(NamedTuple):
    """Scores of bases, the last axis of each array is that of the poses.

    Attributes:
        reached: whether a configuration is found for each pose. (n, poses)
        margin: distance of the nearest joint from its limit, over the joint's range; NaN if none is found. (n, poses)
        manipulability: Yoshikawa's index, the smallest of the frames; NaN if none is found. (n, poses)
        q: the configurations; NaN if none is found. (n, poses, nq)
    """

    reached: Bool[np.ndarray, "n poses"]
    margin: Float[np.ndarray, "n poses"]
    manipulability: Float[np.ndarray, "n poses"]
    q: Float[np.ndarray, "n poses nq"]

    @property
    def table(self) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return for each base the number of poses reached, the smallest margin and the smallest index of them."""
        none = ~self.reached.any(1)
        fields = self.margin, self.manipulability
        margin, index = (np.where(none, np.nan, np.where(self.reached, part, np.inf).min(1)) for part in fields)
        return self.reached.sum(1), margin, index


def score_bases(task: Task, bases: Float[np.ndarray, "n 4"], *, every: bool = False) -> Scores:
    """Return the scores of bases, with all their poses in one batch, or in several if memory asks for it.

    Args:
        task: the poses and the scene.
        bases: x, y, yaw, height. (n, 4)
        every: take the configuration with the largest margin of all that are found, not the first one.
    """
    each = 1 if task.scene is None else max(_numbers_of(task.scene), 1)
    chunk = max(_NUMBERS // each // len(task.goal.position), 1)
    parts = [_searched(task, bases[k : k + chunk], every) for k in range(0, len(bases), chunk)]
    reached, q = (np.concatenate(part) for part in zip(*parts, strict=True))
    # all bases at once, because each number of configurations compiles anew
    index = np.min([np.asarray(frame.manipulability(q)) for frame in task.frames], 0)  # pyright: ignore[reportArgumentType]
    margin, shape = joint_margin(task, q), (len(bases), len(task.goal.position))
    margin, index = (np.where(reached, part, np.nan).reshape(shape) for part in (margin, index))
    return Scores(reached.reshape(shape), margin, index, np.where(reached[:, None], q, np.nan).reshape(*shape, -1))


def _numbers_of(scene: Scene) -> int:
    """Return about how many numbers the core reads of a scene."""
    rows, vertices = scene.capacity, len(scene.table.vertices)
    return rows * (rows + 100) + 3 * vertices


def _searched(task: Task, bases: np.ndarray, every: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return whether each pose is reached at each base, and the configurations. (n * poses,), (n * poses, nq)."""
    found = solve_bases(task, bases, all=every)
    q = np.asarray(found.q)
    if every:
        others = np.asarray(found.solutions)
        pick = np.nan_to_num(joint_margin(task, others), nan=-1.0).argmax(-1)  # rows without a solution are NaN
        q = np.take_along_axis(others, pick[:, None, None], 1)[:, 0]
    return np.asarray(found.converged), q


def solve_bases(task: Task, bases: Float[np.ndarray, "n 4"], **settings: Any) -> InverseKinematicsSolution:
    """Return the answers for all poses at all bases: the poses of the first base, then those of the second."""
    count, number = len(bases), len(task.goal.position)
    parts = [np.asarray(part).reshape(-1, *part.shape[2:]) for part in task.goal]
    position, rotation = in_bases(bases, parts[0], parts[1])
    position = position.reshape(count * number, -1, 3)
    rotation = rotation.reshape(count * number, -1, 3, 3)
    poses = {
        frame.name: (position[:, k], rotation[:, k]) if all(rows) else position[:, k]
        for k, (frame, rows) in enumerate(zip(task.frames, task.rows, strict=True))
    }
    scene = None if task.scene is None else scenes_in_bases(task.scene, bases.repeat(number, 0))
    return inverse_kinematics(task.robot, poses, scene=scene, **{**task.settings, **settings})


def joint_margin(task: Task, q: Float[np.ndarray, "*n nq"]) -> Float[np.ndarray, "*n"]:
    """Return the smallest distance of a joint of the frames from its limits, over its range: 0.5 at the middle."""
    robot = task.robot
    entries = ChainRoute(tuple(frame.name for frame in task.frames), task.rows).entries(robot)
    lower, upper = (np.asarray(end)[dof_of_entries(robot)[entries]] for end in joint_box(robot, None))
    limited = np.isfinite(upper - lower) & (upper > lower)
    own, lower, upper = q[..., entries[limited]], lower[limited], upper[limited]
    return np.min(np.minimum(own - lower, upper - own) / (upper - lower), -1, initial=0.5)
