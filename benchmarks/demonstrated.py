"""Waist or hand motion of any robot, for the demonstrations of ``contact_sheet``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from osik_jax._errors import OsikValueError
from osik_jax.demo._motion import GAIN, MARGIN, Motion, Rows, Stance, along, tracking
from osik_jax.kinematics import forward_kinematics
from osik_jax.physics._world import contact_corners
from osik_jax.robot import Robot
from osik_jax.robot._guesses import find_hands, guess_feet
from osik_jax.tasks import ComTask, FrameTask, PostureTask, Task, support_polygon
from osik_jax.viewer._crouch import crouched

from .swaying import SWAY, dexterous_start, robot_outline, sway, sway_of


def file_motion(
    robot: Robot,
    *,
    name: str,
    frame: str | None = None,
    support: Sequence[str] = (),
    duration: float = 8.0,
) -> Motion:
    """Return a motion in which a frame goes 5 cm to its left and back while the supporting frames stay.

    A robot smaller than 30 cm or larger than 10 m moves by the same share of its size. A frame that its joints cannot
    move left moves in its best direction. A floating robot is placed on the floor, with its lowest point at height 0.
    Without a ``frame`` the floating base moves, or the tip of a robot that is bolted down. Without ``support`` the
    frames of a floating robot that look like feet stand.

    Raises:
        KeyError: no such frame; the message lists those that exist.
        ValueError: a floating robot of which no frame looks like a foot, or the moving frame is one that stands.
    """
    moving = guess_moving_frame(robot) if frame is None else frame
    standing = tuple(support) or guess_feet(robot)
    _check_frames(robot, moving, standing)
    # one or two feet are flat, more feet are points
    rows: Rows = "pose" if len(standing) <= 2 else "position"
    outline = robot_outline(robot, robot.q0)
    if robot.floating_base:
        q0 = crouched(robot, standing)
        height = robot.tree.qpos_address[robot.tree.free_bases[0]] + 2
        q0 = q0.at[height].add(-robot_outline(robot, q0).lowest)
    else:
        q0 = dexterous_start(robot, outline, moving)
    kinematics = forward_kinematics(robot, q0)
    still: dict[str, Task] = {
        foot: FrameTask(
            robot,
            foot,
            target=kinematics.frame_pose(robot, foot),
            rows=rows,
            weight=1e4,
            orientation_weight=1.0,  # soles have to stay level
            gain=GAIN,
        )
        for foot in standing
    }
    # weak and slow: the posture only decides between motions that serve the other tasks
    still["posture"] = PostureTask(robot, target=q0, weight=1e-2, gain=1.0, priority=4)
    corners = {foot: _corners(robot, foot) for foot in standing}
    balanced = sum(len(points) for points in corners.values()) >= 3
    if balanced:
        polygon = support_polygon(robot, q0, standing, margin=MARGIN, corners=corners)
        still["com"] = ComTask(robot, polygon=polygon, weight=1e3, gain=GAIN, priority=2)
    goal = sway(robot, q0, moving, size=outline.size, duration=duration)
    follower, label = tracking(robot, goal, weight=1e2, priority=3), "waist" if robot.floating_base else "hand"
    return Motion(
        name=label,
        title=f"{name}: {moving} sways",
        robot=robot,
        q0=q0,
        tasks=lambda t: still | {label: along(follower, goal, t)},
        duration=duration,
        stances=tuple(Stance(foot, points, flat=rows == "pose") for foot, points in corners.items()),
        goals={label: goal},
        balanced=balanced,
        scale=sway_of(outline.size) / SWAY,
    )


def _check_frames(robot: Robot, moving: str, standing: Sequence[str]) -> None:
    """Raise an error if a frame does not exist, no frame stands, or the moving frame stands."""
    for chosen in (moving, *standing):
        robot.tree.frame(chosen)
    if robot.floating_base and not standing:
        raise OsikValueError(
            "the base floats and none of the frames looks like a foot: name those that stand; "
            f"frames: {', '.join(robot.frame_names)}"
        )
    if moving in standing:
        raise OsikValueError(f"frame {moving!r} cannot both move and stand; choose another")


def _corners(robot: Robot, foot: str) -> Float[np.ndarray, "k 3"]:
    """Return a foot's contact corners in its frame [m]; its origin if it has none."""
    known = contact_corners(robot, foot)
    return known if len(known) else np.zeros((1, 3))


def guess_moving_frame(robot: Robot) -> str:
    """Return the free joint's body; without one, the first hand, else the tip."""
    if robot.floating_base:
        return robot.tree.body_names[robot.tree.root]
    return find_hands(robot)[0]
