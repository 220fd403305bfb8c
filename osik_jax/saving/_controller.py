"""A controller, robot and all, as one file."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from .._errors import OsikValueError, OsikWarning
from ..control._checks import check_setting, check_tasks, checked_limits
from ..limits import CollisionAvoidanceLimit, Limit, Limits
from ..robot import Robot, load_robot
from ..robot.loading import is_mjcf
from ..schemes import Scheme
from ..schemes._default import scheme_for
from ..tasks import Task
from ._parts import decode, encode

_FORMAT = "osik-jax controller 1"


class Controller(NamedTuple):
    """Result of ``load_controller``: the arguments of ``solve`` and ``rollout``.

    Attributes:
        robot: the robot.
        tasks: by name.
        scheme: how they share the robot.
        limits: as ``solve`` takes them.
        dt: time of a step [s].
    """

    robot: Robot
    tasks: dict[str, Task]
    scheme: Scheme
    limits: tuple[Limit, ...]
    dt: float


def save_controller(
    path: str | os.PathLike[str],
    robot: Robot,
    tasks: Mapping[str, Task],
    *,
    scheme: Scheme | None = None,
    limits: Limits | Sequence[Limit] | None = None,
    dt: float = 0.005,
    source: str | os.PathLike[str] | None = None,
) -> None:
    """Write a controller to a JSON file, for ``load_controller``.

    All numbers of the robot are in the file, so a robot that was scaled or moved home comes back as it is. Joints,
    frames and bodies are in it by name.

    Args:
        path: of the file.
        robot: the robot.
        tasks: by name, as ``solve`` takes them.
        scheme: as in ``solve``.
        limits: as in ``solve``.
        dt: time of a step [s].
        source: where the robot comes from: a name that ``load_robot`` takes, or the path of a URDF or MJCF file, which
            has to be there when the controller is loaded; the robot's numbers then are in the file to the last bit.
            Default: the file has the robot as ``Robot.to_mjcf`` writes it, without meshes and locked joints.

    Raises:
        TypeError, ValueError: as in ``solve``; a task, limit or scheme of a class that is not in osik_jax; a robot that
            its source does not make again, or without one a limit on the distances of its meshes.
        OSError: the file cannot be written.
    """
    check_setting("save_controller(path, robot, tasks)", robot, scheme, dt)
    check_tasks(tasks, robot)
    given = checked_limits(robot, limits) or ()
    used, tree = scheme_for(tasks, robot.q0.dtype) if scheme is None else scheme, robot.tree
    content = {
        "format": _FORMAT,
        "robot": _source(robot, source, given),
        "dt": float(dt),
        "scheme": encode(used, "scheme", tree),
        "limits": [encode(limit, f"limits[{place}]", tree) for place, limit in enumerate(given)],
        "tasks": [[name, encode(task, f"tasks[{name!r}]", tree)] for name, task in tasks.items()],
    }
    Path(path).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def load_controller(path: str | os.PathLike[str]) -> Controller:
    """Return the controller that ``save_controller`` wrote.

    Raises:
        FileNotFoundError: no such file, or the robot's file is not where it was.
        ValueError: the file is no controller, or one of another version; the robot's file has changed.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
        known = isinstance(content, dict) and content.get("format") == _FORMAT
    except ValueError:
        known = False
    if not known:
        raise OsikValueError(f"{path} is no controller that save_controller wrote ({_FORMAT})")
    robot = _robot(content["robot"])
    return Controller(
        robot=robot,
        tasks={name: decode(task, robot.tree) for name, task in content["tasks"]},
        scheme=decode(content["scheme"], robot.tree),
        limits=tuple(decode(limit, robot.tree) for limit in content["limits"]),
        dt=content["dt"],
    )


def _source(robot: Robot, source: str | os.PathLike[str] | None, limits: Sequence[Limit]) -> dict[str, Any]:
    """Return how to make the robot again: its model; or a name or a file with its hash, and all of its numbers."""
    if source is None:
        found: dict[str, Any] = {"mjcf": robot.to_mjcf()}
    elif Path(source).is_file():
        found = {"file": str(Path(source).resolve()), "sha256": _hash(Path(source))}
    else:
        found = {"name": str(source)}
    found |= {"floating_base": robot.floating_base, "locked_joints": list(robot.locked_joints)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OsikWarning)  # what the robot does not keep was said when it was loaded
        again = _loaded(found)
    if source is None:
        _check_written(robot, again, limits)
        return found
    if _structure(again) != _structure(robot):
        raise OsikValueError(
            "the robot cannot be made again from its source: its joints, frames or shapes differ. Give source= as the "
            "name or file that it was loaded from, without options other than floating_base and locked_joints"
        )
    return found | {"numbers": {name: encode(getattr(robot, name), name, robot.tree) for name in _numbers(robot)}}


def _check_written(robot: Robot, again: Robot, limits: Sequence[Limit]) -> None:
    """Raise where tasks or limits need a part of the robot that its MJCF does not have."""
    if again.tree.dof_owners != robot.tree.dof_owners or set(again.frame_names) != set(robot.frame_names):
        raise OsikValueError("the robot's MJCF does not have all of its joints and frames: give source=")
    own = any(isinstance(limit, CollisionAvoidanceLimit) and limit.scene.geoms for limit in limits)
    if own and again.tree.geom_names != robot.tree.geom_names:
        raise OsikValueError(
            "a CollisionAvoidanceLimit needs meshes, which the robot's MJCF does not have: give source= as the name or "
            "file that the robot was loaded from"
        )


def _robot(described: Mapping[str, Any]) -> Robot:
    robot = _loaded(described)
    numbers = {name: decode(one, robot.tree) for name, one in described.get("numbers", {}).items()}
    return eqx.tree_at(lambda own: [getattr(own, name) for name in numbers], robot, list(numbers.values()))


def _loaded(described: Mapping[str, Any]) -> Robot:
    options: Any = {"floating_base": described["floating_base"]}
    if "mjcf" in described:
        return Robot.from_mjcf(described["mjcf"], **options)
    options["locked_joints"] = tuple(described["locked_joints"])
    if "name" in described:
        return load_robot(described["name"], **options)
    file = Path(described["file"])
    if not file.is_file():
        raise FileNotFoundError(f"the robot's file is not there: {file}")
    if _hash(file) != described["sha256"]:
        raise OsikValueError(f"{file} has changed since the controller was saved: save it again")
    return (Robot.from_mjcf if is_mjcf(str(file)) else Robot.from_urdf)(file, **options)


def _hash(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _structure(robot: Robot) -> tuple[Any, ...]:
    """Return what the numbers of tasks and limits refer to."""
    tree = robot.tree
    return tree.dof_owners, tree.frame_names, tree.geom_bodies, [np.shape(getattr(robot, n)) for n in _numbers(robot)]


def _numbers(robot: Robot) -> list[str]:
    return [f.name for f in dataclasses.fields(robot) if isinstance(getattr(robot, f.name), jax.Array | np.ndarray)]
