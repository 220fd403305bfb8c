"""Arguments of a ``CollisionAvoidanceLimit`` as plain data: its pairs by name, and the shapes that were added."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._errors import OsikValueError
from ..collision import CollisionShape
from ..collision._geometry import Kind, UnitCore
from ..limits import CollisionAvoidanceLimit
from ..robot import Robot

_KINDS = {
    "capsule": Kind.SEGMENT,
    "box": Kind.BOX,
    "cylinder": Kind.CYLINDER,
    "half-space": Kind.PLANE,
    "hull": Kind.HULL,
}
_NAMES = {kind: name for name, kind in _KINDS.items()}
_PLACE = ("position", "rotation", "size")
_CORE = UnitCore._fields


def collision_data(limit: CollisionAvoidanceLimit, robot: Robot) -> dict[str, Any]:
    """Return the constructor's arguments for the pairs that are kept apart, and the pairs left out as a record."""
    if limit.scene is not None:
        raise OsikValueError("a CollisionAvoidanceLimit has a scene, which a file cannot hold: make it after loading")
    numbers = {name: np.asarray(getattr(limit, name)).tolist() for name in limit.replaceable}
    pairs = {name: [list(pair) for pair in getattr(limit, name)] for name in ("pairs", "left_out")}
    return {**pairs, "shapes": _shapes_data(limit, robot), **numbers, "max_pairs": limit.max_pairs}


def collision_arguments(given: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[tuple[str, str], ...]]:
    """Return the constructor's arguments of data, and the pairs that were left out.

    The pairs are those that were kept, so the constructor leaves none out (``q0_distance=-inf``). Data of a session may
    have globs as pairs and an ``exclude``.
    """
    arguments = {"q0_distance": -np.inf, **given}
    left_out = tuple((first, second) for first, second in arguments.pop("left_out", ()))
    for name in ("pairs", "exclude"):
        if name in arguments:
            arguments[name] = [tuple(pair) for pair in arguments[name]]
    arguments["shapes"] = {name: _shape(one) for name, one in arguments.get("shapes", {}).items()}
    return arguments, left_out


def _shapes_data(limit: CollisionAvoidanceLimit, robot: Robot) -> dict[str, dict[str, Any]]:
    """Return the shapes added to the robot's own, by name."""
    scene, out = limit.layout, {}
    own = len(scene.geoms)
    for number, name in enumerate(scene.names[own:]):
        kind = scene.kinds[own + number]
        out[name] = {
            "shape": _NAMES[kind],
            "frame": robot.frame_names[scene.frames[number]],
            **{field: np.asarray(getattr(limit.shapes, field))[number].tolist() for field in _PLACE},
        }
        if kind is Kind.HULL:
            hull = scene.hulls[own + number]
            out[name]["hull"] = {field: np.asarray(getattr(limit.hulls, field))[hull].tolist() for field in _CORE}
    return out


def _shape(data: Mapping[str, Any]) -> CollisionShape:
    """Return the shape of data, equal to the last bit."""
    kind = _KINDS.get(data["shape"])
    if kind is None:
        raise OsikValueError(f"{data['shape']!r} is no shape: there are {', '.join(_KINDS)}")
    place = {field: jnp.asarray(data[field], float) for field in _PLACE}
    hull = data.get("hull")
    core = hull and UnitCore(*(np.reshape(hull[field], () if field == "radius" else (-1, 3)) for field in _CORE))
    return CollisionShape(kind, data["frame"], **place, hull=core)
