"""Waist or hand motion for a user's robot."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float

from .._errors import OsikValueError
from ..kinematics._home import compiled_kinematics
from ..limits import ConfigurationLimit, VelocityLimit
from ..robot import Robot
from ..robot._feet import find_feet
from ..tasks import ComTask, FrameTask, PostureTask, SupportPolygon, Task, support_polygon
from ..viewer import Look
from ..viewer._outline import robot_outline
from ._motion import GAIN, Goal, Motion, Stance, along, contact_corners, tracking
from ._start import Rows, raised, start
from ._sway import SWAY, sway, sway_of

# margin of the centre of mass inside the support polygon [m], as in NAO's motions
_MARGIN = 0.01
_HANDS = (r"tcp|tool|gripper|end_?effector|\bee\b", r"hand", r"flange|wrist")


def file_motion(
    robot: Robot,
    *,
    name: str,
    frame: str | None = None,
    support: Sequence[str] = (),
    duration: float = 8.0,
    look: Look | None = None,
) -> Motion:
    """Return a motion in which a frame goes 5 cm to its left and back while the supporting frames stay.

    A robot smaller than 30 cm or larger than 10 m moves by the same share of its size. A frame that its joints cannot
    move left moves in its best direction. A floating robot is placed on the floor, with its lowest point at height 0.

    Args:
        robot: the robot.
        name: for people.
        frame: what moves; ``None``: the floating base, or the tip of a robot that is bolted down.
        support: frames on the ground; none: those of a floating robot that look like feet.
        duration: [s].
        look: what the robot's URDF shows, from ``viewer.read_look``.

    Raises:
        KeyError: no such frame; the message lists those that exist.
        ValueError: a floating robot of which no frame looks like a foot, or the moving frame is one that stands.
    """
    moving = guess_moving_frame(robot) if frame is None else frame
    standing = tuple(support) or (guess_feet(robot) if robot.floating_base else ())
    for chosen in (moving, *standing):
        robot.tree.frame(chosen)
    if robot.floating_base and not standing:
        raise OsikValueError(
            "the base floats and none of the frames looks like a foot: say which ones stand with --support NAME..., or "
            "--base fixed; "
            f"frames: {', '.join(robot.frame_names)}"
        )
    if moving in standing:
        raise OsikValueError(f"frame {moving!r} cannot both move and stand; choose another --frame or --support")
    outline = robot_outline(robot, robot.q0, look)
    q0 = start(robot, outline, moving, standing, _foot_rows(standing))
    if robot.floating_base:
        q0 = raised(robot, q0, -robot_outline(robot, q0, look).lowest)
    polygon, notes = _polygon(robot, q0, standing)
    flat = _foot_rows(standing) == "pose"
    stances = tuple(Stance(foot, _corners(robot, foot), flat=flat) for foot in standing)
    goal = sway(robot, q0, moving, size=outline.size, duration=duration)
    still, follower = _tasks(robot, q0, goal, standing, polygon)
    label = "waist" if robot.floating_base else "hand"
    return Motion(
        name="waist" if robot.floating_base else "hand",
        title=f"{name}: {moving} sways",
        robot=robot,
        q0=q0,
        tasks=lambda t: still | {label: along(follower, goal, t)},
        duration=duration,
        stances=stances,
        goals={label: goal},
        limits=(ConfigurationLimit(robot), VelocityLimit(robot)),
        balanced=polygon is not None,
        notes=(*notes, *_remarks(look)),
        look=look,
        scale=sway_of(outline.size) / SWAY,
    )


def _remarks(look: Look | None) -> tuple[str, ...]:
    """Return a remark on the meshes of a URDF that could not be drawn; empty if there are none."""
    if look is None or not look.missing:
        return ()
    first, *others = look.missing
    more = f" and {len(others)} more" if others else ""
    return (f"the pictures do without mesh files that cannot be read: {first}{more}",)


def guess_moving_frame(robot: Robot) -> str:
    """Return the free joint's body; without one, the deepest frame named like a tool or hand, else the last tip."""
    tree = robot.tree
    if robot.floating_base:
        return tree.body_names[tree.root]
    depth = [0] * len(tree.body_parents)
    for body, parent in enumerate(tree.body_parents[1:], 1):
        depth[body] = depth[parent] + 1
    for pattern in _HANDS:
        found = [k for k, name in enumerate(tree.frame_names) if re.search(pattern, name, re.IGNORECASE)]
        if found:
            return tree.frame_names[max(found, key=lambda k: depth[tree.frame_bodies[k]])]
    last = depth.index(max(depth))
    own = [k for k, body in enumerate(tree.frame_bodies) if body == last]
    reach = np.linalg.norm(np.asarray(robot.frame_position)[own], axis=-1)
    return tree.frame_names[own[int(np.argmax(np.round(reach, 9)))]]


def guess_feet(robot: Robot) -> tuple[str, ...]:
    """Return the frames with contact corners, else childless frames of different bodies named like feet."""
    tree = robot.tree
    with_corners = tuple(
        name.removesuffix("_corner_0")
        for name in tree.frame_names
        if name.endswith("_corner_0") and name.removesuffix("_corner_0") in tree.frame_names
    )
    if with_corners:
        return with_corners
    return find_feet(zip(tree.frame_names, tree.frame_bodies, strict=True), tree.body_parents)


def _corners(robot: Robot, foot: str) -> Float[np.ndarray, "k 3"]:
    """Return a foot's contact corners in its frame [m]; its origin if it has none. (k, 3)."""
    known = contact_corners(robot, foot)
    return known if len(known) else np.zeros((1, 3))


def _polygon(robot: Robot, q0: Array, standing: Sequence[str]) -> tuple[SupportPolygon | None, tuple[str, ...]]:
    """Return the support polygon if the feet's corners span one, and a remark if they do not."""
    if not standing:
        return None, ()
    corners = {foot: _corners(robot, foot) for foot in standing}
    if sum(len(points) for points in corners.values()) < 3:
        known = f"no contact corners are known of {', '.join(standing)} (sites NAME_corner_0, NAME_corner_1, ...)"
        return None, (f"{known}, so balance is neither asked for nor reported",)
    return support_polygon(robot, q0, standing, margin=_MARGIN, corners=corners), ()


def _tasks(
    robot: Robot, q0: Array, goal: Goal, standing: Sequence[str], polygon: SupportPolygon | None
) -> tuple[dict[str, Task], FrameTask]:
    """Return the tasks of standing feet, balance and posture, and the task that moves."""
    kinematics = compiled_kinematics(robot, q0)
    still: dict[str, Task] = {
        foot: FrameTask(
            robot, foot, target=kinematics.frame_pose(robot, foot), rows=_foot_rows(standing), weight=1e4, gain=GAIN
        )
        for foot in standing
    }
    if polygon is not None:
        still["com"] = ComTask(robot, polygon=polygon, weight=1e3, gain=GAIN, priority=2)
    # weak and slow: the posture only decides between motions that serve the other tasks
    still["posture"] = PostureTask(robot, target=q0, weight=1e-2, gain=1.0, priority=4)
    return still, tracking(robot, goal, weight=1e2, priority=3)


def _foot_rows(standing: Sequence[str]) -> Rows:
    """Return the rows of a foot task: pose for one or two feet, position for more feet, which stand on points."""
    return "pose" if len(standing) <= 2 else "position"
