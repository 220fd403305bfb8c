"""Tasks, limits and schemes as plain data for JSON, and as Python expressions."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from ..._errors import OsikValueError
from ...limits import CollisionAvoidanceLimit, NoLimits, no_limits
from ...robot import Robot
from ...tasks import AdaptiveGain, PostureTask, SupportPolygon
from ...tasks._pose import PoseTask
from ._shape_description import describe_pairs, describe_shapes, rebuild_shape, shape_python

Description = dict[str, Any]
"""Plain data ``{"kind": class name, argument: value, ...}``; arguments at their defaults are left out."""

_PARTS = {"AdaptiveGain": AdaptiveGain, "SupportPolygon": SupportPolygon}
_NO_LIMITS = "no_limits"
_ROWS = {(True,) * 6: "pose", (True,) * 3 + (False,) * 3: "position", (False,) * 3 + (True,) * 3: "orientation"}


def describe(part: Any, robot: Robot) -> Description:
    """Return a task, limit or scheme of this package as plain data.

    Raises:
        ValueError: a class of somebody's own, or an object that its constructor's arguments do not tell all of.
    """
    if isinstance(part, NoLimits):
        return {"kind": _NO_LIMITS}
    kind = type(part).__name__
    if getattr(importlib.import_module("osik_jax"), kind, None) is not type(part):
        raise OsikValueError(f"{kind} is no class of osik_jax, so a session file cannot hold it")
    names = [name for name in inspect.signature(type(part)).parameters if name != "robot"]
    if isinstance(part, CollisionAvoidanceLimit):
        return _describe_collisions(part, robot)
    described = {"kind": kind} | {name: _argument(part, robot, name) for name in names}
    if not _makes(described, robot, part):
        raise OsikValueError(f"this {kind} has settings that a session file cannot hold")
    for name in names:
        without = {key: value for key, value in described.items() if key != name}
        described = without if _makes(without, robot, part) else described
    return described


def _describe_collisions(limit: CollisionAvoidanceLimit, robot: Robot) -> Description:
    """Return a collision limit's pairs as globs if these select the same pairs, else by name."""
    numbers = {name: _plain(getattr(limit, name)) for name in (*limit.replaceable, "max_pairs")}
    shapes, any_distance = describe_shapes(limit, robot), {"q0_distance": -np.inf}
    for short in (True, False):
        pairs = describe_pairs(limit, short=short)
        described = {"kind": "CollisionAvoidanceLimit", **pairs, "shapes": shapes, **any_distance, **numbers}
        made = rebuild(described, robot)
        if made.scene == limit.scene and made.max_pairs == limit.max_pairs:
            return described
    raise OsikValueError("this CollisionAvoidanceLimit has settings that a session file cannot hold")


def _makes(described: Description, robot: Robot, part: Any) -> bool:
    """Return whether a description rebuilds the object with the same structure and numbers."""
    try:
        first, second = jax.tree.flatten(rebuild(described, robot)), jax.tree.flatten(part)
    except ValueError:
        return False
    return first[1] == second[1] and all(np.array_equal(x, y) for x, y in zip(first[0], second[0], strict=True))


def rebuild(described: Mapping[str, Any], robot: Robot) -> Any:
    """Return the object of a description.

    Raises:
        ValueError: a description of nothing that is known, or arguments that do not fit.
    """
    if described.get("kind") == _NO_LIMITS:
        return no_limits
    found = getattr(importlib.import_module("osik_jax"), str(described.get("kind")), None)
    if not inspect.isclass(found):
        raise OsikValueError(f"{described.get('kind')!r} is no class of osik_jax")
    cls: Any = found
    arguments = {name: _live(value) for name, value in described.items() if name != "kind"}
    if cls is CollisionAvoidanceLimit:
        arguments |= {
            "pairs": [tuple(pair) for pair in described["pairs"]],
            "exclude": [tuple(pair) for pair in described["exclude"]],
            "shapes": {name: rebuild_shape(one) for name, one in described["shapes"].items()},
        }
    try:
        return cls(robot, **arguments) if _takes_robot(cls) else cls(**arguments)
    except TypeError as error:
        raise OsikValueError(f"{cls.__name__}: {error}") from error


def python(described: Mapping[str, Any]) -> str:
    """Return the expression that makes an object, for a program with ``import osik_jax as osik`` and a ``robot``."""
    kind = described["kind"]
    if kind == _NO_LIMITS:
        return f"osik.{_NO_LIMITS}"
    first = ["robot"] if _takes_robot(getattr(importlib.import_module("osik_jax"), kind)) else []
    own: dict[str, str] = {}
    if kind == "CollisionAvoidanceLimit":
        shapes = ", ".join(f"{name!r}: {shape_python(one)}" for name, one in described["shapes"].items())
        own = {name: repr([tuple(pair) for pair in described[name]]) for name in ("pairs", "exclude")}
        own["shapes"] = f"{{{shapes}}}"
    given = [f"{name}={own[name] if name in own else _text(value)}" for name, value in described.items()][1:]
    return f"osik.{kind}({', '.join(first + given)})"


def _takes_robot(cls: type) -> bool:
    return next(iter(inspect.signature(cls).parameters), None) == "robot"


def _argument(part: Any, robot: Robot, name: str) -> Any:
    """Return a constructor argument that reproduces this part of the object, as plain data."""
    if name == "rows" and isinstance(part, PoseTask):
        return _ROWS.get(part.kept, list(part.kept))
    if name == "joints" and isinstance(part, PostureTask):
        return [robot.tree.joint_names[joint] for joint in part.joints]
    if not hasattr(part, name):
        raise OsikValueError(f"a session file cannot hold a {type(part).__name__}: its {name} is not kept")
    return _plain(getattr(part, name))


def _plain(value: Any) -> Any:
    """Return numbers as floats and lists of floats."""
    for kind, cls in _PARTS.items():
        if isinstance(value, cls):
            names = ("maximum", "minimum", "decay") if cls is AdaptiveGain else ("normals", "offsets", "vertices")
            return {"kind": kind} | {name: _plain(getattr(value, name)) for name in names}
    if isinstance(value, tuple | list):
        return [_plain(one) for one in value]
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return np.asarray(value).tolist()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise OsikValueError(f"a session file cannot hold a {type(value).__name__}")


def _live(value: Any) -> Any:
    """Return the value for a constructor's argument from plain data: a number, a name, or a target by its kind."""
    if isinstance(value, Mapping) and "kind" in value:
        cls = _PARTS[value["kind"]]
        return cls(**{name: np.asarray(one, float) for name, one in value.items() if name != "kind"})
    return value


def _text(value: Any) -> str:
    """Return plain data as Python source."""
    if isinstance(value, Mapping):
        given = ", ".join(f"{name}=np.array({_text(one)})" for name, one in value.items() if name != "kind")
        return f"osik.{value['kind']}({given})"
    if isinstance(value, list):
        return f"[{', '.join(map(_text, value))}]"
    if isinstance(value, float) and not np.isfinite(value):
        return "np.nan" if np.isnan(value) else f"{'-' if value < 0.0 else ''}np.inf"
    return repr(value)
