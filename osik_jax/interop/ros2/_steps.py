"""The two compiled programs of a controller: its start, and one step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array

from ..._errors import OsikValueError, unknown_name
from ...control import solve
from ...control._rollout import remembering
from ...kinematics import Kinematics, forward_kinematics, integrate
from ...kinematics._pose_forms import Pose
from ...limits import AccelerationLimit, ConfigurationLimit, Limit, VelocityLimit, limit_box, with_own_limits
from ...limits._own import keeps_own
from ...numerics._guarded import clipped
from ...robot import Robot
from ...robot._guesses import find_hands, guess_feet
from ...robot._joint_selection import scalar_layout
from ...saving import load_controller
from ...schemes import Scheme, WeightedQP
from ...tasks import ComTask, FrameTask, PostureTask, Task
from ...tasks._leaves import background_weight
from ._settings import Settings

_GAIN = 5.0
"""[1/s]. At most acceleration / speed of the default settings, so that a joint can brake as its task asks."""
_SUPPORT, _BALANCE, _POSITION, _ORIENTATION = 1e4, 1e3, 10.0, 0.1
"""Weights of feet, of the centre of mass, and of a target: an arm with fewer than six joints goes to its position."""


class Advance(NamedTuple):
    """Answer of one step."""

    q: Array  # the next configuration. (nq,)
    velocity: Array  # that leads there. (nv,)
    warm_start: Any  # for the next step
    poses: dict[str, Pose]  # of the frames, at the next configuration
    status: Array  # a ``Status`` code


class Steps:
    """Tasks, scheme and limits of a robot, and their compiled programs; for the arguments see ``Controller``."""

    def __init__(self, robot: Robot | None, settings: Settings):
        self.scheme: Scheme = WeightedQP()
        limits: tuple[Limit, ...] = ()
        self.dt = settings.dt
        if settings.controller is not None:
            if robot is not None or settings.rate is not None:
                raise OsikValueError("the settings' controller has its own robot and rate: leave them out")
            self.robot, tasks, self.scheme, limits, self.dt = load_controller(settings.controller)
            self.task_names = _tasks_of_frames(tasks, settings.frames)
            at_start = set(self.task_names.values())
        elif robot is None:
            raise OsikValueError("give a robot, or a controller in the settings")
        else:
            self.robot = robot
            tasks, frames = _default_tasks(robot, settings)
            self.task_names = {frame: frame for frame in frames}
            at_start = set(tasks)
        self.tasks = dict(tasks)
        self._at_start = frozenset(at_start)
        self.limits = _bounded(self.robot, limits, settings)
        self.support = _support(self.robot, settings)[:1]
        self.references = _references(self.robot)
        self.begin = jax.jit(self._begin)
        self.advance = jax.jit(self._advance)
        q, tasks, poses = self.begin(self.robot.q0)
        targets, still = {frame: poses[frame] for frame in self.task_names}, jnp.zeros(self.robot.nv)
        warm = jax.eval_shape(self._advance, q, still, None, tasks, targets).warm_start
        self.no_warm_start = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), warm)

    def _begin(self, q: Array) -> tuple[Array, dict[str, Task], dict[str, Pose]]:
        """Return a configuration with its base placed by the support, the tasks with targets there, and the poses."""
        q = _stood(self.robot, q, self.support)
        tasks = {n: t.at(self.robot, q) if n in self._at_start else t for n, t in self.tasks.items()}
        return q, tasks, self._poses(forward_kinematics(self.robot, q))

    def _advance(
        self, q: Array, velocity: Array, warm_start: Any, tasks: dict[str, Task], targets: Mapping[str, Pose]
    ) -> Advance:
        tasks, limits = remembering((tasks, self.limits), velocity, True)
        aims = {self.task_names[frame]: target for frame, target in targets.items()}
        options: Any = dict(scheme=self.scheme, limits=limits, dt=self.dt, targets=aims, warm_start=warm_start)
        answer = solve(self.robot, q, tasks, **options)
        # no change where a scheme keeps its box; the classical null space may not
        velocity = clipped(answer.velocity, *limit_box(self.robot, q, with_own_limits(self.robot, limits), self.dt))
        q = integrate(self.robot, q, velocity, self.dt)
        poses = self._poses(forward_kinematics(self.robot, q))
        return Advance(q, velocity, answer.warm_start, poses, answer.status)

    def _poses(self, kinematics: Kinematics) -> dict[str, Pose]:
        return {frame: kinematics.frame_pose(self.robot, frame) for frame in {*self.task_names, *self.references}}


def _default_tasks(robot: Robot, settings: Settings) -> tuple[dict[str, Task], tuple[str, ...]]:
    """Return the default tasks of a robot, and the frames that receive targets."""
    frames, feet = settings.frames or find_hands(robot), _support(robot, settings)
    if not frames:
        raise OsikValueError("no frame looks like a hand: name those that get targets in the setting frames")
    tasks: dict[str, Task] = {
        foot: FrameTask(robot, foot, weight=_SUPPORT, orientation_weight=1.0, gain=_GAIN) for foot in feet
    }
    if feet:
        tasks["centre of mass"] = ComTask(robot, axes="xy", weight=_BALANCE, gain=_GAIN)
    for frame in frames:
        if frame in tasks:
            raise OsikValueError(f"{frame!r} stands on the ground and is to be led: name it in support or in frames")
        weights: Any = dict(position_weight=_POSITION, orientation_weight=_ORIENTATION)
        tasks[frame] = FrameTask(robot, frame, gain=_GAIN, **weights)
    return tasks | {"posture": PostureTask(robot, gain=1.0, weight=background_weight(robot))}, tuple(frames)


def _support(robot: Robot, settings: Settings) -> tuple[str, ...]:
    """Return the frames on which a robot stands; none for a fixed base."""
    if not robot.floating_base:
        return ()
    feet = settings.support or guess_feet(robot)
    if not feet:
        raise OsikValueError("the robot moves freely and nothing looks like feet: name what stands in support")
    for foot in feet:
        robot.tree.frame(foot)
    return feet


def _tasks_of_frames(tasks: Mapping[str, Task], frames: tuple[str, ...]) -> dict[str, str]:
    """Return the task name of each frame that receives targets."""
    found: dict[str, str] = {}
    for name, task in tasks.items():
        if isinstance(task, FrameTask) and not task.bounded and (not frames or task.frame in frames):
            if task.frame in found:
                raise OsikValueError(f"the controller has two tasks for frame {task.frame!r}; a target leads one")
            found[task.frame] = name
    for frame in frames:
        if frame not in found:
            raise unknown_name("frame task", frame, tuple(found))
    if not found:
        raise OsikValueError("the controller has no FrameTask that a target could lead")
    return found


def _bounded(robot: Robot, limits: tuple[Limit, ...], settings: Settings) -> tuple[Limit, ...]:
    """Return the limits with the settings' speeds and accelerations, and the robot's own limits."""
    hinges_and_slides, _ = scalar_layout(robot)
    speed = jnp.where(hinges_and_slides, jnp.minimum(robot.velocity_limit, settings.speed), robot.velocity_limit)
    own = robot.acceleration_limit
    rate = jnp.where(hinges_and_slides & ~jnp.isfinite(own), settings.acceleration, own)
    bounds: tuple[Limit, ...] = (*limits, VelocityLimit(robot, velocity=speed))
    if keeps_own(limits, ConfigurationLimit):
        bounds = (*bounds, ConfigurationLimit(robot))
    if not any(isinstance(limit, AccelerationLimit) for limit in limits):
        bounds = (*bounds, AccelerationLimit(robot, rate))
    return bounds


def _references(robot: Robot) -> tuple[str, ...]:
    """Return the frames in which targets may be given: those fixed to the world, and a free base."""
    tree = robot.tree
    fixed = [name for name, body in zip(tree.frame_names, tree.frame_bodies, strict=True) if body == 0]
    return (*fixed, tree.body_names[tree.root]) if robot.floating_base else tuple(fixed)


def _stood(robot: Robot, q: Array, support: tuple[str, ...]) -> Array:
    """Return q with the free base placed so that the supporting frame stands as at home."""
    if not support:
        return q
    base = robot.tree.qpos_address[robot.tree.free_bases[0]]
    home = forward_kinematics(robot, robot.q0).frame_pose(robot, support[0])
    q = q.at[base : base + 7].set(robot.q0[base : base + 7])
    here = forward_kinematics(robot, q).frame_pose(robot, support[0])
    turn = home[1] @ here[1].T
    position = home[0] + turn @ (q[base : base + 3] - here[0])
    own = jaxlie.SO3(q[base + 3 : base + 7])
    return q.at[base : base + 7].set(jnp.concatenate([position, (jaxlie.SO3.from_matrix(turn) @ own).wxyz]))
