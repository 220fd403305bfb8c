"""Tasks, limits, schemes and gains as plain data for JSON: the public class name and the constructor's arguments."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import osik_jax

from .._errors import OsikValueError, OsikWarning
from ..collision import CollisionShape
from ..collision._geometry import Kind, UnitCore
from ..limits import CollisionAvoidanceLimit, Limit, NoLimits, no_limits
from ..robot import Robot
from ..schemes import Scheme
from ..tasks import AdaptiveGain, SupportPolygon, Task
from ..tasks._repr import ROW_NAMES

Data = dict[str, Any]
"""``{"kind": name of a public class, argument: value, ...}``; an argument that is missing has its default."""

_CLASSES = (Task, Limit, Scheme, AdaptiveGain, SupportPolygon)
_NO_LIMITS = "no_limits"
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


def encode_parts(robot: Robot, tasks: Mapping[str, Task], scheme: Scheme, limits: Sequence[Limit]) -> Data:
    """Return the data of a controller's tasks, scheme and limits, for ``decode_parts``."""
    return {
        "scheme": encode(scheme, robot, "scheme"),
        "limits": [encode(limit, robot, f"limits[{place}]") for place, limit in enumerate(limits)],
        "tasks": {name: encode(task, robot, f"tasks[{name!r}]") for name, task in tasks.items()},
    }


def decode_parts(content: Mapping[str, Any], robot: Robot) -> tuple[dict[str, Task], Scheme, tuple[Limit, ...]]:
    """Return tasks, scheme and limits of data from ``encode_parts``."""
    tasks = {name: decode(one, robot, f"tasks[{name!r}]") for name, one in dict(content["tasks"]).items()}
    limits = [decode(one, robot, f"limits[{place}]") for place, one in enumerate(content["limits"])]
    return tasks, decode(content["scheme"], robot, "scheme"), tuple(limits)


def encode(part: Any, robot: Robot, where: str) -> Data:
    """Return a task, limit, scheme or gain as plain data.

    ``where`` is its name in messages.
    """
    if isinstance(part, NoLimits):
        return {"kind": _NO_LIMITS}
    kind = type(part).__name__
    if getattr(osik_jax, kind, None) is not type(part):
        raise OsikValueError(
            f"{where} is a {kind}, which is no class of osik_jax: a file cannot hold it. Make it again after loading, "
            "and add it to the tasks or limits"
        )
    if isinstance(part, CollisionAvoidanceLimit):
        data = {"kind": kind} | collision_data(part, robot)
    else:
        names = [name for name in inspect.signature(type(part)).parameters if name != "robot"]
        data = {"kind": kind} | {name: _argument(part, robot, name, where) for name in names}
    if not makes(data, robot, part):
        raise OsikValueError(
            f"{where} is a {kind} that its constructor does not make again, which a file cannot hold: use {kind}(...)"
        )
    return data


def makes(data: Data, robot: Robot, part: Any) -> bool:
    """Return whether data makes an object of the same structure and with the same numbers, to the last bit."""
    with warnings.catch_warnings(action="ignore", category=OsikWarning):
        try:
            made = decode(data, robot, "it")
        except (KeyError, ValueError):
            return False
    (numbers, structure), (given, wanted) = jax.tree.flatten(made), jax.tree.flatten(part)
    return structure == wanted and all(map(np.array_equal, numbers, given))


def decode(data: Any, robot: Robot, where: str) -> Any:
    """Return the object of data from ``encode``, made by its constructor for this robot."""
    kind = data.get("kind") if isinstance(data, Mapping) else None
    if kind == _NO_LIMITS:
        return no_limits
    cls: Any = getattr(osik_jax, str(kind), None)
    if not _is_kept(cls):
        raise OsikValueError(f"{where} is {kind or data!r}, which is no task, limit, scheme or gain of this version")
    given = {name: _value(one, robot, f"{where}.{name}") for name, one in data.items() if name != "kind"}
    if kind == "SupportPolygon":  # its constructor converts nothing
        given = {name: np.asarray(one, float) for name, one in given.items()}
    try:
        if cls is CollisionAvoidanceLimit:
            return _collision_limit(robot, given)
        made = cls(robot, **given) if "robot" in inspect.signature(cls).parameters else cls(**given)
    except TypeError as error:
        raise OsikValueError(f"{where}: {error}") from error
    return _with_exact_directions(made, given)


def _with_exact_directions(made: Any, given: Mapping[str, Any]) -> Any:
    """Set the directions that a constructor has made unit again, which changes their last bit, to those of the data."""
    for name, value in given.items():
        own: Any = getattr(made, name, None)
        if isinstance(value, list) and _is_real(own) and np.shape(value) == own.shape:
            exact = np.asarray(value, own.dtype)
            if np.allclose(own, exact, rtol=0.0, atol=8.0 * np.finfo(own.dtype).eps):
                object.__setattr__(made, name, jnp.asarray(exact))
    return made


def _is_real(value: Any) -> bool:
    return isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating)


def _is_kept(cls: Any) -> bool:
    return inspect.isclass(cls) and issubclass(cls, _CLASSES)


def _collision_limit(robot: Robot, given: Mapping[str, Any]) -> CollisionAvoidanceLimit:
    """Return the limit of data; its pairs are those that were kept, so none is left out (``q0_distance=-inf``)."""
    arguments = {"q0_distance": -np.inf, **given}
    left_out = tuple((first, second) for first, second in arguments.pop("left_out", ()))
    if "pairs" in arguments:
        arguments["pairs"] = [tuple(pair) for pair in arguments["pairs"]]
    arguments["shapes"] = {name: _shape(one) for name, one in arguments.get("shapes", {}).items()}
    made = CollisionAvoidanceLimit(robot, **arguments)
    object.__setattr__(made, "left_out", left_out)  # a record alone
    return made


def _argument(part: Any, robot: Robot, name: str, where: str) -> Any:
    """Return the constructor's argument that makes this part of the object, as plain data."""
    names = robot.tree.joint_names
    if name == "rows":
        return ROW_NAMES.get(part.kept, list(part.kept))
    if name == "joint":
        return names[part.joint]
    if name == "joints":
        joints = part.joints if hasattr(part, "joints") else _joints_of(robot, part.dofs)
        return [names[joint] for joint in joints]
    if name == "ratios":
        return dict(zip((names[joint] for joint in part.joints), np.asarray(part.ratios).tolist(), strict=True))
    if name == "constraints":
        return [constraint.name for constraint in part.constraints]
    if not hasattr(part, name):
        raise OsikValueError(f"{where} is a {type(part).__name__}, whose {name} a file cannot hold")
    return _plain(getattr(part, name), robot, f"{where}.{name}")


def _joints_of(robot: Robot, dofs: Sequence[int]) -> list[int]:
    """Return the joints of some entries of v, each once."""
    owners = robot.tree.dof_joint[robot.tree.own_dofs]
    return list(dict.fromkeys(owners[list(dofs)].tolist()))


def _plain(value: Any, robot: Robot, where: str) -> Any:
    """Return numbers as floats and lists of floats, and objects as their data."""
    if isinstance(value, _CLASSES):
        return encode(value, robot, where)
    if isinstance(value, tuple | list):
        return [_plain(one, robot, where) for one in value]
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return np.asarray(value).tolist()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise OsikValueError(f"{where} is a {type(value).__name__}, which a file cannot hold")


def _value(data: Any, robot: Robot, where: str) -> Any:
    """Return an argument from plain data."""
    return decode(data, robot, where) if isinstance(data, Mapping) and "kind" in data else data


def collision_data(limit: CollisionAvoidanceLimit, robot: Robot) -> dict[str, Any]:
    """Return the constructor's arguments for the pairs that are kept apart, and the pairs left out as a record."""
    if limit.scene is not None:
        raise OsikValueError("a CollisionAvoidanceLimit has a scene, which a file cannot hold: make it after loading")
    numbers = {name: np.asarray(getattr(limit, name)).tolist() for name in limit.replaceable}
    pairs = {name: [list(pair) for pair in getattr(limit, name)] for name in ("pairs", "left_out")}
    return {**pairs, "shapes": _shapes_data(limit, robot), **numbers, "max_pairs": limit.max_pairs}


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
