"""From a person's motion to a robot's."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from .._errors import OsikValueError
from .._joint_selection import scalar_layout
from .._tree import FREE
from ..limits import AccelerationLimit, ConfigurationLimit, Limit, VelocityLimit
from ..robot import Robot
from ..scaling import Saved, run_in_chunks
from ._body import Build, pairs_apart
from ._finish import follow
from ._goals import Goals, Weights
from ._motion import HumanMotion
from ._person import Person, read_person
from ._plan import make_plan
from ._profile import Profile
from ._profile_file import check_profile, find_profile
from ._robot_motion import RobotMotion
from ._skeletons import find_roles
from ._terms import Body, Bounds

ACCELERATION = 240.0
_LENGTHS = 16


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


class Retargeter:
    """Retargets any number of clips to one robot; what does not depend on the clip is computed once.

    Args:
        robot: with a free base, two legs and two arms; x forward, y left, z up at home.
        profile: how the robot is seen. None: the package's own for NAO and G1, or a guess (``find_profile``).
        acceleration: greatest acceleration of all joints, or by joint name or glob [rad/s^2 or m/s^2].
        max_iterations: of the plan.

    Raises:
        ValueError: no two legs and two arms are found, or a number is out of range.
        KeyError: the profile or ``acceleration`` names something that the robot does not have.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        profile: Profile | None = None,
        acceleration: float | Mapping[str, float] = ACCELERATION,
        max_iterations: int = 100,
    ):
        if not robot.floating_base:
            raise OsikValueError("retargeting moves a robot's base: load the robot with floating_base=True")
        self.robot = robot
        self.profile = find_profile(robot) if profile is None else profile
        check_profile(robot, self.profile)
        self.limits = own_limits(robot, acceleration)
        self.max_iterations = max_iterations
        self._body = Body.of(robot, self.profile, pairs_apart(robot, self.profile))
        self._build = Build.of(robot, self.profile)
        self._acceleration = np.asarray(self.limits[2].acceleration)

    def retarget(
        self, motion: HumanMotion, *, mapping: Mapping[str, str] | None = None, fps: float | None = None
    ) -> Retargeted:
        """The robot does what a person did; see ``retarget``."""
        clip = self._prepared(motion, mapping, fps)
        plan = make_plan(self._body, clip.goals, self.profile.weights, clip.bounds, clip.start, self.max_iterations)
        q, off = follow(self.robot, plan.q, self.limits, clip.dt)
        return self._finished(clip, Solved(q, off, plan.iterations, plan.cost))

    def retarget_all(
        self,
        motions: Sequence[HumanMotion],
        *,
        mapping: Mapping[str, str] | None = None,
        fps: float | None = None,
        chunk: int = 32,
        out: str | os.PathLike[str] | None = None,
        progress: bool = True,
    ) -> list[Retargeted]:
        """Many clips of any lengths, some at a time, in one program for all clips of about one length.

        Args:
            motions: the clips.
            mapping: as of ``retarget``, the same for all.
            fps: as of ``retarget``.
            chunk: how many are worked on at once; about 100 kB of memory a frame of each.
            out: a folder for what is finished, so that a job that was killed goes on where it was
                (``osik_jax.scaling.run_in_chunks``). None: none.
            progress: whether to show a bar.

        Returns:
            the results, in the order of the clips.

        Raises:
            ValueError, KeyError: as of ``retarget``; the message starts with the clip's name.
        """
        clips = [self._prepared_by_name(motion, mapping, fps) for motion in motions]
        groups: dict[int, list[int]] = {}
        for i, clip in enumerate(clips):
            groups.setdefault(_rounded_up(clip.frames), []).append(i)
        found: dict[int, Retargeted] = {}
        shared = (self._body, self.profile.weights, self.limits, np.asarray(self.max_iterations))
        for length, members in sorted(groups.items()):
            lanes = [_lane(clips[i], length) for i in members]
            solved = run_in_chunks(
                _solve_lanes,
                jax.tree.map(lambda *leaves: np.stack(leaves), *lanes),
                chunk=min(chunk, len(members)),
                shared=shared,
                out=None if out is None else Path(out) / f"frames_{length}",
                progress=progress,
                unit="clips",
            )
            results = solved[:] if isinstance(solved, Saved) else solved
            for lane, i in enumerate(members):
                found[i] = self._finished(clips[i], jax.tree.map(lambda leaf, lane=lane: leaf[lane], results))
        return [found[i] for i in range(len(clips))]

    def _prepared(self, motion: HumanMotion, mapping: Mapping[str, str] | None, fps: float | None) -> _Clip:
        """What a clip asks for."""
        motion = motion if fps is None else motion.resampled(fps)
        if motion.frames < 3:
            raise OsikValueError(f"the clip has {motion.frames} frames; it takes three to have an acceleration")
        person = read_person(motion, find_roles(motion.joint_names, mapping))
        goals = self._build.goals(person)
        goals, start = padded(goals, self._build.first_guess(goals), -motion.frames % _LENGTHS)
        dt = 1.0 / motion.fps
        return _Clip(person, motion.frames, goals, start, self._build.bounds(self._acceleration, dt), dt)

    def _prepared_by_name(self, motion: HumanMotion, mapping: Mapping[str, str] | None, fps: float | None) -> _Clip:
        try:
            return self._prepared(motion, mapping, fps)
        except (ValueError, KeyError) as error:
            raise type(error)(f"{motion.name}: {error.args[0]}") from error

    def _finished(self, clip: _Clip, solved: Solved) -> Retargeted:
        q, off = (np.asarray(part)[: clip.frames] for part in (solved.q, solved.off_plan))
        cost = float(solved.cost[0]), float(solved.cost[1])
        made = as_retargeted(self.robot, self.profile, clip.person, q, off)
        return dataclasses.replace(made, iterations=int(solved.iterations), cost=cost)


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


class Solved(NamedTuple):
    """What both passes give; of many clips, every leaf has a leading axis."""

    q: Array
    off_plan: Array
    iterations: Array
    cost: Array


class _Clip(NamedTuple):
    """A clip in the form that is computed with."""

    person: Person
    frames: int
    goals: Goals
    start: np.ndarray
    bounds: Bounds
    dt: float


def _lane(clip: _Clip, length: int) -> tuple[Goals, Array, Bounds, np.ndarray]:
    """A clip as one of a batch whose clips have this many frames, padding included."""
    frames = len(clip.start)
    goals, start = (clip.goals, clip.start) if frames >= length else padded(clip.goals, clip.start, length - frames)
    return jax.tree.map(np.asarray, (goals, start, clip.bounds, np.asarray(clip.dt)))


def _rounded_up(frames: int) -> int:
    """A length that clips of about as many frames share: at most a quarter more, and few different ones."""
    step = max(_LENGTHS, (1 << (frames - 1).bit_length()) // 8)
    return -(-frames // step) * step


@jax.jit
def _solve_lanes(
    lanes: tuple[Goals, Array, Bounds, Array],
    body: Body,
    weights: Weights,
    limits: Sequence[Limit],
    max_iterations: Array,
) -> Solved:
    def one(lane: tuple[Goals, Array, Bounds, Array]) -> Solved:
        goals, start, bounds, dt = lane
        plan = make_plan(body, goals, weights, bounds, start, max_iterations)
        q, off = follow(body.robot, plan.q, limits, dt)
        return Solved(q, off, plan.iterations, plan.cost)

    return jax.vmap(one)(lanes)


def retarget(
    robot: Robot,
    motion: HumanMotion,
    *,
    profile: Profile | None = None,
    mapping: Mapping[str, str] | None = None,
    fps: float | None = None,
    acceleration: float | Mapping[str, float] = ACCELERATION,
    max_iterations: int = 100,
) -> Retargeted:
    """The robot does what a person did: limbs in the same directions, feet that stay where they stand.

    Two passes. The plan looks at all frames at once: directions of limbs, turns of pelvis, chest and feet, and the path
    of the hips, scaled by the legs, are wishes with weights. That heels and toes that stand do not move and are at
    height 0, that nothing is below the floor, that shapes are apart and joints inside their ranges, speeds and
    accelerations, weighs a thousand times more and up. The last pass follows the plan inside limits of position, speed
    and acceleration that hold exactly; ``Retargeted.off_plan`` says by how much they held it back.

    Args:
        robot: with a free base, two legs and two arms; x forward, y left, z up at home.
        motion: the clip.
        profile: how the robot is seen. None: the package's own for NAO and G1, or a guess (``find_profile``).
        mapping: role to the clip's name of it, see ``find_roles``. None: by the names that files use.
        fps: frames a second of the result; None: the clip's.
        acceleration: greatest acceleration of all joints, or by joint name or glob [rad/s^2 or m/s^2].
        max_iterations: of the plan.

    Raises:
        ValueError: the clip has no three frames, joints that are needed are missing from it, or the robot has no two
            legs and two arms.
        KeyError: the profile or ``acceleration`` names something that the robot does not have.
    """
    own = Retargeter(robot, profile=profile, acceleration=acceleration, max_iterations=max_iterations)
    return own.retarget(motion, mapping=mapping, fps=fps)


def own_limits(
    robot: Robot, acceleration: float | Mapping[str, float]
) -> tuple[ConfigurationLimit, VelocityLimit, AccelerationLimit]:
    """The robot's own limits, and that on accelerations of its joints."""
    if isinstance(acceleration, Mapping):
        most = AccelerationLimit(robot, acceleration)
    else:
        if not acceleration > 0.0:
            raise OsikValueError(f"acceleration is {acceleration}; it has to be more than 0")
        most = AccelerationLimit(robot, np.where(scalar_layout(robot)[0], acceleration, np.inf))
    return ConfigurationLimit(robot), VelocityLimit(robot), most


def padded(goals: Goals, start: Float[np.ndarray, "F nq"], more: int) -> tuple[Goals, Float[np.ndarray, "T nq"]]:
    """Goals and first guess with frames behind the end, so that clips of about one length share a program."""
    frames = len(start)

    def longer(leaf: np.ndarray) -> np.ndarray:
        return np.concatenate([leaf, np.repeat(leaf[-1:], more, 0)])

    goals, start = jax.tree.map(longer, (goals, start))
    present = np.where(np.arange(frames + more) < frames, goals.present, 0.0).astype(start.dtype)
    return dataclasses.replace(goals, present=present, contact=goals.contact * present[:, None]), start


def in_mujoco_order(robot: Robot, q: Float[np.ndarray, "F nq"], fps: float) -> RobotMotion:
    """A motion with all joints of the robot's model, those that are locked and those that follow others too."""
    tree = robot.tree
    index, coefficient = tree.qpos_source
    qpos = q[:, index] * coefficient + np.asarray(robot.qpos_offset)
    joints = [j for j, kind in enumerate(tree.joint_types) if kind != FREE]
    base = next(j for j, kind in enumerate(tree.joint_types) if kind == FREE)
    at = int(tree.full_qpos_address[base])
    columns = [*range(at, at + 7), *(int(tree.full_qpos_address[j]) for j in joints)]
    return RobotMotion(float(fps), tuple(tree.joint_names[j] for j in joints), qpos[:, columns])
