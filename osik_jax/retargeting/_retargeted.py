"""A robot's motion, and the person's that it was made from."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from ..robot import Robot
from ._person import Person
from ._profile import Profile
from ._robot_motion import RobotMotion, in_mujoco_order


@dataclasses.dataclass(frozen=True)
class Retargeted:
    """A robot's motion, and the person's that it was made from.

    Attributes:
        robot: the robot.
        profile: how it was seen.
        motion: in MuJoCo's order: what files hold.
        q: configurations of ``robot``. (F, nq)
        human: where the person's joints were, the floor at height 0 [m]. (F, J, 3)
        human_names: of them: roles, and ``root``, the midpoint of the hips.
        contact: whether left heel, left toe, right heel and right toe stand. (F, 4)
        iterations: systems that the plan took; 0 where it was made frame by frame.
        cost: what is left of the wishes, and of the bounds that have to hold; 0 where it was made frame by frame.
        off_plan: how far the farthest joint is from the plan in each frame because a limit held it [rad or m]. (F,)
    """

    robot: Robot
    profile: Profile
    motion: RobotMotion
    q: Float[np.ndarray, "F nq"]
    human: Float[np.ndarray, "F J 3"]
    human_names: tuple[str, ...]
    contact: Bool[np.ndarray, "F 4"]
    iterations: int
    cost: tuple[float, float]
    off_plan: Float[np.ndarray, " F"]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes an ``.npz`` with ``fps``, ``qpos``, ``joint_names``, ``human``, ``human_names`` and ``contact``."""
        np.savez_compressed(
            Path(path),
            fps=self.motion.fps,
            qpos=self.motion.qpos,
            joint_names=np.array(self.motion.joint_names),
            human=self.human,
            human_names=np.array(self.human_names),
            contact=self.contact,
            ground=0.0,
        )


def as_retargeted(
    robot: Robot, profile: Profile, person: Person, q: Float[np.ndarray, "F nq"], off_plan: Float[np.ndarray, " F"]
) -> Retargeted:
    """The record of a motion that was made from a person's."""
    return Retargeted(
        robot=robot,
        profile=profile,
        motion=in_mujoco_order(robot, q, person.fps),
        q=q,
        human=np.stack([*person.points.values(), person.root], 1),
        human_names=(*person.points, "root"),
        contact=person.contact,
        iterations=0,
        cost=(0.0, 0.0),
        off_plan=off_plan,
    )
