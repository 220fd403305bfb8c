"""Record of a retargeted motion together with the person's motion."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
from jaxtyping import Bool, Float

from ..robot import Robot
from ._body import TouchGoal
from ._person import Person
from ._profile import Profile
from ._robot_motion import RobotMotion, in_mujoco_order
from ._roles import bones


@dataclasses.dataclass(frozen=True)
class Retargeted:
    """Retargeted motion of a robot, with the person's motion it was made from.

    Attributes:
        robot: the robot.
        profile: its profile.
        motion: the motion in MuJoCo's order, as written to files.
        q: configurations of ``robot``. (F, nq)
        human: positions of the person's joints, floor at height 0 [m]. (F, J, 3)
        human_names: roles of these joints, and ``root``, the midpoint of the hips.
        turns: forward, left and up axes of the person's pelvis and chest as columns. (F, 2, 3, 3)
        contact: whether left heel, left toe, right heel and right toe stand, or the points of ``Profile.standing`` of a
            robot of another shape. (F, 4)
        off_plan: largest distance of a joint from the plan in each frame because of a limit [rad or m]. (F,)
        iterations: iterations of the plan; 0 for a live stream.
        cost: final cost of the goals, and of the violated bounds; 0 for a live stream.
        objects: poses of the clip's objects in the robot's world. (F, 7) each
        touches: what the robot's joints hold.
    """

    robot: Robot
    profile: Profile
    motion: RobotMotion
    q: Float[np.ndarray, "F nq"]
    human: Float[np.ndarray, "F J 3"]
    human_names: tuple[str, ...]
    turns: Float[np.ndarray, "F 2 3 3"]
    contact: Bool[np.ndarray, "F 4"]
    off_plan: Float[np.ndarray, " F"]
    iterations: int = 0
    cost: tuple[float, float] = (0.0, 0.0)
    objects: Mapping[str, Float[np.ndarray, "F 7"]] = dataclasses.field(default_factory=dict)
    touches: tuple[TouchGoal, ...] = ()

    @classmethod
    def of(cls, robot: Robot, profile: Profile, person: Person, q: np.ndarray, off: np.ndarray, **more: Any) -> Self:
        """Return the record of a motion (F, nq) made from a person's motion; ``off`` is ``off_plan`` (F,)."""
        return cls(
            robot=robot,
            profile=profile,
            motion=in_mujoco_order(robot, q, person.fps),
            q=q,
            human=np.stack([*person.points.values(), person.root], 1),
            human_names=(*person.points, "root"),
            turns=np.stack([person.pelvis, person.torso], 1),
            contact=person.contact,
            off_plan=off,
            **more,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an ``.npz`` file.

        Arrays: ``fps``, ``qpos``, ``joint_names``, ``human``, ``human_names``, ``contact`` and ``ground`` (0); for
        pictures ``human_bones``, pairs of indices into ``human_names``, and ``human_standing``, those of the points of
        ``contact``; ``object.NAME``, the poses of objects.
        """
        names = self.human_names
        pairs = [(names.index(a), names.index(b)) for a, b in bones(names)]
        standing = [names.index(name) for name in self.profile.standing if name in names]
        objects: dict[str, Any] = {f"object.{name}": poses for name, poses in self.objects.items()}
        np.savez_compressed(
            Path(path),
            fps=self.motion.fps,
            qpos=self.motion.qpos,
            joint_names=np.array(self.motion.joint_names),
            human=self.human,
            human_names=np.array(self.human_names),
            human_bones=np.array(pairs, int).reshape(-1, 2),
            human_standing=np.array(standing, int),
            contact=self.contact,
            ground=0.0,
            **objects,
        )
