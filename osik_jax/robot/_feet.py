"""Recognition of feet among frames, which decides whether a base floats if the user does not say so."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

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
    """Return the frames with contact corners, else childless frames of different bodies named like feet."""
    tree = robot.tree
    frames = zip(tree.frame_names, tree.frame_bodies, strict=True)
    return with_corners(tree.frame_names) or find_feet(frames, tree.body_parents)
