"""Two motions of NAO: the waist sways over both feet, and one foot is lifted (after Ramos, Fig. 1)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..kinematics._forward import home_kinematics
from ..physics._world import contact_corners
from ..robot import Robot, load_robot
from ..tasks import ComTask, PostureTask, Task, support_polygon
from ._motion import GAIN, MARGIN, Goal, Motion, Path, Stance, Stroke, along, minimum_jerk, tracking

FEET = ("l_sole", "r_sole")
WAIST, HANDS = "torso", ("l_gripper", "r_gripper")
SWAY = 0.05
"""Distance of the waist's motion to its left [m]."""
WEIGHTS = {"feet": 1e4, "com": 1e3, "waist": 1e2, "hands": 1e1, "posture": 1e-2}
"""Weights of the weighted scheme; the hierarchical schemes use priorities instead."""


def double_support(duration: float = 8.0) -> Motion:
    """Return the motion on both feet: the waist goes 5 cm to its left and back."""
    robot = load_robot("nao")
    paths = _home_paths(robot, (*FEET, WAIST))
    waist = Goal(WAIST, _moved(paths[WAIST], _there_and_back(duration, 0.5, 3.0, 4.5, 7.0, (0.0, SWAY, 0.0))))
    left, right = (tracking(robot, Goal(foot, paths[foot]), weight=WEIGHTS["feet"], priority=1) for foot in FEET)
    polygon = support_polygon(robot, robot.q0, FEET, margin=MARGIN)
    still = {
        "left_foot": left,
        "right_foot": right,
        "com": ComTask(robot, polygon=polygon, weight=WEIGHTS["com"], gain=GAIN, priority=2),
        "posture": PostureTask(robot, weight=WEIGHTS["posture"], gain=1.0, priority=4),
    }
    moving = tracking(robot, waist, weight=WEIGHTS["waist"], priority=3)
    return Motion(
        name="double-support",
        title="NAO in double support",
        robot=robot,
        q0=robot.q0,
        tasks=lambda t: still | {"waist": along(moving, waist, t)},
        duration=duration,
        stances=tuple(Stance(foot, contact_corners(robot, foot)) for foot in FEET),
        goals={"waist": waist},
    )


def single_support(duration: float = 8.0) -> Motion:
    """Return the motion on one foot: weight on the left foot, right foot lifted, arms opened, and back."""
    robot = load_robot("nao")
    paths = _home_paths(robot, (*FEET, WAIST, *HANDS))
    with_waist = _there_and_back(duration, 0.25, 2.0, 5.75, 7.75, (0.0, SWAY, -0.01))
    # up, back and slightly inwards; no tilt, because one motor drives both hip yaw-pitch joints
    swing = _there_and_back(duration, 2.25, 3.5, 4.25, 5.5, (-0.045, 0.01, 0.055))
    goals = {
        "waist": Goal(WAIST, _moved(paths[WAIST], with_waist)),
        "right_foot": Goal("r_sole", _moved(paths["r_sole"], swing)),
    }
    for label, hand, side in zip(("left_hand", "right_hand"), HANDS, (1.0, -1.0), strict=True):
        # outwards and up, on top of the waist's motion
        reach = _there_and_back(duration, 1.5, 3.25, 4.5, 6.25, (-0.02, 0.055 * side, 0.08))
        goals[label] = Goal(hand, _moved(paths[hand], with_waist + reach), "position")
    ranks = {"waist": ("waist", 3), "right_foot": ("feet", 1), "left_hand": ("hands", 4), "right_hand": ("hands", 4)}
    followers = {
        label: tracking(robot, goals[label], weight=WEIGHTS[kind], priority=priority)
        for label, (kind, priority) in ranks.items()
    }
    stance = tracking(robot, Goal("l_sole", paths["l_sole"]), weight=WEIGHTS["feet"], priority=1)
    posture = PostureTask(robot, weight=WEIGHTS["posture"], gain=1.0, priority=5)
    foot = support_polygon(robot, robot.q0, ("l_sole",), margin=MARGIN)
    com = ComTask(robot, polygon=foot, weight=WEIGHTS["com"], gain=GAIN, priority=2)
    # the edges of the left foot's polygon, moved out until the polygon of both feet fits in
    both = support_polygon(robot, robot.q0, FEET, margin=MARGIN)
    wide = jnp.max(foot.normals @ both.vertices.T, 1)

    def tasks(t: Any) -> Mapping[str, Task]:
        onto, _ = minimum_jerk(t, 0.25 * duration / 8.0, 1.75 * duration / 8.0)
        back, _ = minimum_jerk(t, 5.75 * duration / 8.0, 2.0 * duration / 8.0)
        # the task reads normals and offsets alone, so the vertices may be those of the foot
        polygon = dataclasses.replace(foot, offsets=wide + (onto - back) * (foot.offsets - wide))
        return {
            "left_foot": stance,
            "com": com.replace(polygon=polygon),
            "posture": posture,
        } | {label: along(task, goals[label], t) for label, task in followers.items()}

    lifted = (2.25 * duration / 8.0, 5.5 * duration / 8.0)
    return Motion(
        name="single-support",
        title="NAO lifts a foot",
        robot=robot,
        q0=robot.q0,
        tasks=tasks,
        duration=duration,
        stances=(
            Stance("l_sole", contact_corners(robot, "l_sole")),
            Stance("r_sole", contact_corners(robot, "r_sole"), lifted=lifted),
        ),
        goals=goals,
    )


def _home_paths(robot: Robot, frames: tuple[str, ...]) -> dict[str, Path]:
    """Return a constant path for each frame, at its pose at ``q0``."""
    positions, rotations = home_kinematics(robot).frame_poses(robot, frames)
    return {name: Path(np.asarray(p), np.asarray(R)) for name, p, R in zip(frames, positions, rotations, strict=True)}


def _moved(path: Path, strokes: tuple[Stroke, ...]) -> Path:
    return dataclasses.replace(path, strokes=strokes)


def _there_and_back(
    duration: float, start: float, there: float, leave: float, end: float, by: tuple[float, float, float]
) -> tuple[Stroke, Stroke]:
    """Return strokes by a vector and back; the times are eighths of the duration."""
    u = duration / 8.0
    return Stroke(start * u, there * u, by), Stroke(leave * u, end * u, (-by[0], -by[1], -by[2]))
