"""Shapes and pairs of a ``CollisionAvoidanceLimit`` as plain data, and as the text of a Python program."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..._errors import OsikValueError
from ...collision import CollisionShape
from ...collision._geometry import Kind
from ...limits import CollisionAvoidanceLimit
from ...robot import Robot
from ._covers import SUFFIX

_KINDS = {"capsule": Kind.SEGMENT, "box": Kind.BOX, "cylinder": Kind.CYLINDER, "half-space": Kind.PLANE}


def describe_shapes(limit: CollisionAvoidanceLimit, robot: Robot) -> dict[str, dict[str, Any]]:
    """Return the shapes added to the robot's own, by name.

    Raises:
        ValueError: a convex hull, whose points are not kept.
    """
    scene, out = limit.scene, {}
    own = len(scene.geoms)
    kinds = {kind: name for name, kind in _KINDS.items()}
    for number, name in enumerate(scene.names[own:]):
        if scene.kinds[own + number] not in kinds:
            raise OsikValueError(
                f"a session file cannot hold the shape {name!r} of a CollisionAvoidanceLimit: it is a hull"
            )
        out[name] = {
            "shape": kinds[scene.kinds[own + number]],
            "frame": robot.frame_names[scene.frames[number]],
            **{k: np.asarray(getattr(limit.shapes, k))[number].tolist() for k in ("position", "rotation", "size")},
        }
    return out


def rebuild_shape(described: Mapping[str, Any]) -> CollisionShape:
    """Return the shape of a description, equal to the last bit.

    Raises:
        ValueError: a kind that is not known.
    """
    kind = _KINDS.get(described["shape"])
    if kind is None:
        raise OsikValueError(f"{described['shape']!r} is no shape: there are {', '.join(_KINDS)}")
    plain = CollisionShape.sphere(1.0)
    numbers = {k: np.asarray(described[k], plain.position.dtype) for k in ("position", "rotation", "size")}
    return CollisionShape(kind, described["frame"], **numbers)  # type: ignore[arg-type]


def shape_python(described: Mapping[str, Any]) -> str:
    """Return Python text that makes the described shape, with its numbers rounded."""
    position, turn, size = (np.asarray(described[k]) for k in ("position", "rotation", "size"))
    kind, frame = described["shape"], f"frame={described['frame']!r}"
    if kind == "box":
        return f"osik.CollisionShape.box({size.tolist()}, {position.tolist()}, np.array({turn.tolist()}), {frame})"
    if kind == "half-space":
        return f"osik.CollisionShape.half_space({position.tolist()}, {turn[:, 2].tolist()}, {frame})"
    if kind == "capsule" and size[1] == 0.0:
        return f"osik.CollisionShape.sphere({float(size[0])!r}, {position.tolist()}, {frame})"
    ends = [(position + sign * (turn[:, 2] * size[1])).tolist() for sign in (-1.0, 1.0)]
    return f"osik.CollisionShape.{kind}({float(size[0])!r}, {ends[0]}, {ends[1]}, {frame})"


def describe_pairs(limit: CollisionAvoidanceLimit, *, short: bool) -> dict[str, list[list[str]]]:
    """Return the pairs that are kept apart: by name, or in short form with a glob for the shapes of links."""
    if not short:
        return {"pairs": [list(pair) for pair in limit.pairs], "exclude": []}

    def glob(name: str) -> str:
        return f"*{SUFFIX}" if name.endswith(SUFFIX) else name

    patterns = sorted({(glob(a), glob(b)) for a, b in limit.pairs})
    covers = [name for name in limit.scene.names if name.endswith(SUFFIX)]
    kept = {frozenset(pair) for pair in limit.pairs}
    left_out: list[list[str]] = []
    if (f"*{SUFFIX}",) * 2 in patterns:
        left_out = [[a, b] for k, a in enumerate(covers) for b in covers[:k] if frozenset((a, b)) not in kept]
    return {"pairs": [list(pair) for pair in patterns], "exclude": left_out}
