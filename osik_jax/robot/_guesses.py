"""Frames of a robot that are named like feet or hands."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import numpy as np

from ._model import RobotModel

_FEET = (r"sole(?!.*corner)", r"foot", r"ankle", r"toe")


def find_feet(frames: Iterable[tuple[str, int]], parents: Sequence[int]) -> tuple[str, ...]:
    """Return one frame of each of two or more outermost bodies that are called like feet; none if there are fewer.

    ``frames`` has names, and the body that each is fixed to; body 0 is its own parent.
    """
    outermost = set(range(1, len(parents))) - set(parents)
    candidates = [(name, body) for name, body in frames if body in outermost]
    for pattern in _FEET:
        found: dict[int, str] = {}
        for name, body in candidates:
            if re.search(pattern, name, re.IGNORECASE):
                found.setdefault(body, name)
        if len(found) > 1:
            return tuple(found.values())
    return ()


def with_corners(frames: Sequence[str]) -> tuple[str, ...]:
    """Return the frames NAME of which the contact corner ``NAME_corner_0`` is a frame too."""
    names = (frame.removesuffix("_corner_0") for frame in frames if frame.endswith("_corner_0"))
    return tuple(name for name in names if name in frames)


def guess_feet(robot: RobotModel) -> tuple[str, ...]:
    """Return the frames with contact corners, else childless frames named like feet; none if the base is fixed."""
    if not robot.floating_base:
        return ()
    tree = robot.tree
    frames = zip(tree.frame_names, tree.frame_bodies, strict=True)
    return with_corners(tree.frame_names) or find_feet(frames, tree.body_parents)


_HANDS = (r"gripper|tcp|tool|end_?effector|\bee\b", r"rubber_hand|palm|hand(?!.*(index|middle|thumb|finger))", r"wrist")
_SIDES = {"left": r"(^|_)(l|left)(_|$)|left|^L(?=[A-Z])", "right": r"(^|_)(r|right)(_|$)|right|^R(?=[A-Z])"}


def find_hands(robot: RobotModel) -> tuple[str, ...]:
    """Return one frame of the left and one of the right hand.

    Where no names tell sides, return one frame that is named like a hand, else the tip of a robot with a fixed base. Of
    several frames of one kind, return the one that most joints move.
    """
    tree = robot.tree
    depth = [0] * len(tree.body_parents)
    for body, parent in enumerate(tree.body_parents[1:], 1):
        depth[body] = depth[parent] + 1
    moving = [(name, depth[body]) for name, body in zip(tree.frame_names, tree.frame_bodies, strict=True) if body]
    sided = [hand for side in _SIDES.values() if (hand := _named([f for f in moving if re.search(side, f[0])]))]
    if len(set(sided)) == len(_SIDES):
        return tuple(sided)
    hand = _named(moving)
    if hand is None and not robot.floating_base:
        hand = _tip(robot, depth)
    return () if hand is None else (hand,)


def _tip(robot: RobotModel, depth: Sequence[int]) -> str:
    """Return the frame of the deepest body that is farthest from the body's origin; the first of equally far ones."""
    last = depth.index(max(depth))
    own = [k for k, body in enumerate(robot.tree.frame_bodies) if body == last]
    reach = np.linalg.norm(np.asarray(robot.frame_position)[own], axis=-1)
    return robot.tree.frame_names[own[int(np.argmax(np.round(reach, 9)))]]


def _named(frames: Sequence[tuple[str, int]]) -> str | None:
    """Return the deepest of the frames that are named like a hand."""
    for pattern in _HANDS:
        found = [frame for frame in frames if re.search(pattern, frame[0], re.IGNORECASE)]
        if found:
            return max(found, key=lambda frame: frame[1])[0]
    return None
