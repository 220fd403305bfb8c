"""Two motions of NAO: the waist sways over both feet, and one foot is lifted (after Ramos, Fig. 1)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..kinematics._home import home_kinematics
from ..limits import ConfigurationLimit, VelocityLimit
from ..robot import Robot, load_robot
from ..tasks import ComTask, PostureTask, Task, support_polygon
from ._motion import GAIN, Goal, Motion, Stance, along, blended, circumscribed, contact_corners, tracking
from ._references import Path, Stroke, minimum_jerk

FEET = ("l_sole", "r_sole")
WAIST, HANDS = "torso", ("l_gripper", "r_gripper")
SWAY = 0.05
"""Distance of the waist's motion to its left [m]."""
MARGIN = 0.01
"""Margin of the centre of mass inside the support polygon [m]."""
WEIGHTS = {"feet": 1e4, "com": 1e3, "foot": 1e3, "waist": 1e2, "hands": 1e1, "posture": 1e-2}
"""Weights of the weighted scheme; the hierarchical schemes use priorities instead."""


def double_support(duration: float = 8.0) -> Motion:
    """Return the motion on both feet: the waist goes 5 cm to its left and back."""
    robot = load_robot("nao")
    paths = _home_paths(robot, (*FEET, WAIST))
    u = duration / 8.0
    waist = Goal(
        WAIST, _with(paths[WAIST], [(0.5 * u, 3.0 * u, (0.0, SWAY, 0.0)), (4.5 * u, 7.0 * u, (0.0, -SWAY, 0.0))])
    )
    feet = {foot: tracking(robot, Goal(foot, paths[foot]), weight=WEIGHTS["feet"], priority=1) for foot in FEET}
    still = {
        "left_foot": feet["l_sole"],
        "right_foot": feet["r_sole"],
        "com": ComTask(
            robot,
            polygon=support_polygon(robot, robot.q0, FEET, margin=MARGIN),
            weight=WEIGHTS["com"],
            gain=GAIN,
            priority=2,
        ),
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
        limits=(ConfigurationLimit(robot), VelocityLimit(robot)),
    )


def single_support(duration: float = 8.0) -> Motion:
    """Return the motion on one foot: weight on the left foot, right foot lifted, arms opened, and back."""
    robot = load_robot("nao")
    u = duration / 8.0
    paths = _home_paths(robot, (*FEET, WAIST, *HANDS))
    goals = {
        "waist": Goal(WAIST, _with(paths[WAIST], _there_and_back(u, 0.25, 2.0, 5.75, 7.75, (0.0, SWAY, -0.01)))),
        "foot": Goal("r_sole", _swing(paths["r_sole"], u)),
        "left_hand": Goal(HANDS[0], _with(paths[HANDS[0]], _reach(u, 1.0)), "position"),
        "right_hand": Goal(HANDS[1], _with(paths[HANDS[1]], _reach(u, -1.0)), "position"),
    }
    moving = {
        "right_foot": (tracking(robot, goals["foot"], weight=WEIGHTS["feet"], priority=1), goals["foot"]),
        "waist": (tracking(robot, goals["waist"], weight=WEIGHTS["waist"], priority=3), goals["waist"]),
        "left_hand": (tracking(robot, goals["left_hand"], weight=WEIGHTS["hands"], priority=4), goals["left_hand"]),
        "right_hand": (tracking(robot, goals["right_hand"], weight=WEIGHTS["hands"], priority=4), goals["right_hand"]),
    }
    stance = tracking(robot, Goal("l_sole", paths["l_sole"]), weight=WEIGHTS["feet"], priority=1)
    posture = PostureTask(robot, weight=WEIGHTS["posture"], gain=1.0, priority=5)
    tight = support_polygon(robot, robot.q0, ("l_sole",), margin=MARGIN)
    wide = circumscribed(tight.normals, support_polygon(robot, robot.q0, FEET, margin=MARGIN))
    com = ComTask(robot, polygon=wide, weight=WEIGHTS["com"], gain=GAIN, priority=2)

    def tasks(t: Any) -> Mapping[str, Task]:
        onto, _ = minimum_jerk(t, 0.25 * u, 1.75 * u)
        back, _ = minimum_jerk(t, 5.75 * u, 2.0 * u)
        return {
            "left_foot": stance,
            "com": com.replace(polygon=blended(wide, tight, onto - back)),
            "posture": posture,
        } | {name: along(task, goal, t) for name, (task, goal) in moving.items()}

    return Motion(
        name="single-support",
        title="NAO lifts a foot",
        robot=robot,
        q0=robot.q0,
        tasks=tasks,
        duration=duration,
        stances=(
            Stance("l_sole", contact_corners(robot, "l_sole")),
            Stance("r_sole", contact_corners(robot, "r_sole"), lifted=(2.25 * u, 5.5 * u)),
        ),
        goals=goals,
        limits=(ConfigurationLimit(robot), VelocityLimit(robot)),
    )


def _home_paths(robot: Robot, frames: tuple[str, ...]) -> dict[str, Path]:
    """Return a constant path for each frame, at its pose at ``q0``."""
    kinematics = home_kinematics(robot)
    positions, rotations = kinematics.frame_poses(robot, frames)
    return {name: Path(np.asarray(p), np.asarray(R)) for name, p, R in zip(frames, positions, rotations, strict=True)}


def _with(path: Path, moves: list[tuple[float, float, tuple[float, float, float]]], **changes: Any) -> Path:
    return Path(path.position, path.rotation, tuple(Stroke(*move) for move in moves), **changes)


def _there_and_back(
    u: float, start: float, there: float, leave: float, end: float, by: tuple[float, float, float]
) -> list[tuple[float, float, tuple[float, float, float]]]:
    """Return strokes by a vector and back; times are multiples of u [s]."""
    return [(start * u, there * u, by), (leave * u, end * u, (-by[0], -by[1], -by[2]))]


def _swing(path: Path, u: float) -> Path:
    """Return the path of the right foot: up, back and slightly inwards, without tilting.

    A tilt is not possible because one motor drives both hip yaw-pitch joints.
    """
    return _with(path, _there_and_back(u, 2.25, 3.5, 4.25, 5.5, (-0.045, 0.01, 0.055)))


def _reach(u: float, side: float) -> list[tuple[float, float, tuple[float, float, float]]]:
    """Return the path of a hand (side +1 left, -1 right): with the waist, then outwards and up, and back."""
    with_waist = _there_and_back(u, 0.25, 2.0, 5.75, 7.75, (0.0, SWAY, -0.01))
    return with_waist + _there_and_back(u, 1.5, 3.25, 4.5, 6.25, (-0.02, 0.055 * side, 0.08))
