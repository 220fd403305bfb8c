"""Controllers as JSON files: robot, tasks, scheme, limits and dt."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import warnings
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._errors import OsikError, OsikValueError, OsikWarning
from .._whole_file import write_text
from ..control import Controller
from ..control._checks import check_setting, check_tasks, checked_limits
from ..control._packed_step import packed_section
from ..control._step import build_problem
from ..kinematics import integrate
from ..limits import Limit, Limits
from ..robot import Robot, load_robot
from ..robot._load_robot import read_robot
from ..schemes import Scheme
from ..schemes._default import scheme_for
from ..tasks import Task
from ._parts import decode_parts, encode_parts

_FORMAT = "osik-jax controller 3"
_CHECKSUM = ',\n "checksum": '
_ACCURACY = {jnp.dtype("float64"): 1e-9, jnp.dtype("float32"): 1e-4}
"""Largest difference of a step's numbers, relative to the largest of each array, that is roundoff of an MJCF."""


class _Saved(NamedTuple):
    """What a file holds: the arguments of ``Controller``."""

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

    Joints, frames and bodies are in the file by name. Without ``source``, the robot is written as MJCF and read again
    before the file is written: what a step asks for must be the same for both.

    The file's last two entries are for programs without Python (``core/c``): the step of the controller that
    ``load_controller`` returns, as numbers for the compiled core, and a checksum of the text before them.
    To edit the file by hand, remove both: ``load_controller`` reads it, and those programs refuse it.

    Args:
        path: of the file.
        robot: the robot.
        tasks: by name, as ``solve`` takes them.
        scheme: as in ``solve``.
        limits: as in ``solve``.
        dt: time of a step [s].
        source: where the robot comes from: a name that ``load_robot`` takes, or the path of a URDF or MJCF file, which
            has to be there when the controller is loaded. All numbers of the robot are then in the file to the last
            bit, so a robot that was scaled or moved home comes back as it is. Default: the file has the robot as
            ``Robot.to_mjcf`` writes it, without meshes and locked joints.

    Raises:
        TypeError, ValueError: as in ``solve``; a task, limit or scheme of a class that is not in osik_jax; a robot that
            its source does not make again, or whose MJCF gives other numbers, for example the distances of its meshes.
        OSError: the file cannot be written. An older file of this name is unchanged.
    """
    write_text(path, controller_text(robot, tasks, scheme=scheme, limits=limits, dt=dt, source=source))


def controller_text(
    robot: Robot,
    tasks: Mapping[str, Task],
    *,
    scheme: Scheme | None,
    limits: Limits | Sequence[Limit] | None,
    dt: float,
    source: str | os.PathLike[str] | None,
) -> str:
    """Return the content of the file that ``save_controller`` writes."""
    check_setting("save_controller(path, robot, tasks)", robot, scheme, dt)
    check_tasks(tasks, robot)
    given = checked_limits(robot, limits) or ()
    used = scheme_for(tasks, robot.q0.dtype) if scheme is None else scheme
    content = {
        "format": _FORMAT,
        "robot": _source(robot, source),
        "dt": float(dt),
    } | encode_parts(robot, tasks, used, given)
    saved = _Saved(robot, dict(tasks), used, given, content["dt"])
    if source is None:
        saved = _check_written(saved, content)
    return _with_packed_step(json.dumps(content, indent=1), saved)


def _with_packed_step(text: str, saved: _Saved) -> str:
    """Return the file's text with its last two entries: the step for programs without Python, and a checksum."""
    step = packed_section(saved.robot, saved.tasks, saved.scheme, saved.limits, saved.dt)
    text = f'{text[:-2]},\n "core": {json.dumps(step, ensure_ascii=False)}'
    return text + _CHECKSUM + _checksum(text)


def _checksum(text: str) -> str:
    """Return the end of a file whose text before its checksum is this."""
    return f"{zlib.crc32(text.encode())}\n}}\n"


def load_controller(path: str | os.PathLike[str]) -> Controller:
    """Return the controller that ``save_controller`` wrote; it unpacks to the arguments of ``solve``.

    Raises:
        FileNotFoundError: no such file, or the robot's file is not where it was.
        ValueError: the file is no controller, or one of another version, is damaged, or was edited to something that
            ``solve`` does not take; the robot's file has changed.
    """
    return read_controller(Path(path).read_bytes(), str(path))


def read_controller(text: bytes, path: str) -> Controller:
    """Return the controller of a file's content; ``path`` names the file in messages."""
    content = _content(text, path)
    try:
        found = _made(content, _robot(content["robot"]))
        check_setting("load_controller(path)", found.robot, found.scheme, found.dt)
        with warnings.catch_warnings(action="ignore", category=OsikWarning):  # check_setting has given them
            jax.eval_shape(lambda q: build_problem(found.robot, q, found.tasks, limits=found.limits), found.robot.q0)
    except OSError:  # of the robot's file
        raise
    except KeyError as problem:
        said = problem if isinstance(problem, OsikError) else f"its entry {problem} is missing"
        raise OsikValueError(f"{path} cannot be loaded: {said}") from problem
    except Exception as problem:  # whatever an edited file leads the constructors to
        raise OsikValueError(f"{path} cannot be loaded: {problem}") from problem
    robot, tasks, scheme, limits, dt = found
    return Controller(robot, tasks, scheme=scheme, limits=limits, dt=dt)


def _content(data: bytes, path: str) -> dict[str, Any]:
    """Return the content of a file as data; raise ValueError if it is no controller, or not as it was written."""
    try:
        text = data.decode("utf-8")
        content = json.loads(text)
        known = isinstance(content, dict) and content.get("format") == _FORMAT
    except (RecursionError, ValueError):
        known = False
    if not known:
        raise OsikValueError(f"{path} is no controller that save_controller wrote ({_FORMAT}), or is damaged")
    before, _, end = text.rpartition(_CHECKSUM)
    if not content.keys().isdisjoint(("core", "checksum")) and end != _checksum(before):
        raise OsikValueError(
            f"{path} is not as save_controller wrote it: save it again, or, if you edited it, remove its last two "
            'entries, "core" and "checksum"'
        )
    return content


def _made(content: Mapping[str, Any], robot: Robot) -> _Saved:
    """Return the controller of a file's content, with its robot."""
    tasks, scheme, limits = decode_parts(content, robot)
    # a scheme's constructor takes no robot, so it does not know the robot's precision
    scheme = jax.tree.map(lambda number: number.astype(robot.q0.dtype), scheme)
    return _Saved(robot, tasks, scheme, limits, content["dt"])


def _source(robot: Robot, source: str | os.PathLike[str] | None) -> dict[str, Any]:
    """Return the robot as data: its model, or a name or file with its hash, and all its numbers."""
    options = {"floating_base": robot.floating_base, "locked_joints": list(robot.locked_joints)}
    if source is None:
        return {"mjcf": robot.to_mjcf(), "dtype": str(robot.q0.dtype)} | options
    file = Path(source)
    found = {"file": str(file.resolve()), "sha256": _hash(file)} if file.is_file() else {"name": str(source)}
    found |= options
    if _structure(_quietly_loaded(found)) != _structure(robot):
        raise OsikValueError(
            "the robot cannot be made again from its source: its joints, frames or shapes differ. Give source= as the "
            "name or file that it was loaded from, without options other than floating_base and locked_joints"
        )
    return found | {"numbers": {name: _array_data(np.asarray(getattr(robot, name))) for name in _numbers(robot)}}


def _array_data(array: np.ndarray) -> dict[str, Any]:
    """Return an array as data; a list does not tell the shape of an array without entries."""
    return {"array": array.tolist(), "shape": array.shape, "dtype": str(array.dtype)}


def _check_written(saved: _Saved, content: Mapping[str, Any]) -> _Saved:
    """Return the controller read from the content; raise ValueError if its step differs.

    Locked joints and fused bodies are written as one body, so masses, shapes and numbers of bodies may differ. What
    counts is what a step sees: it is compared at home and beside it.
    """
    try:
        robot, again = saved.robot, _made(content, _quietly_loaded(content["robot"]))
        same = again.robot.tree.dof_owners == robot.tree.dof_owners
        aside = 0.1 * np.sin(1.0 + np.arange(robot.nv))
        for q in (robot.q0, integrate(robot, robot.q0, aside)) if same else ():
            problems = (build_problem(c.robot, q, c.tasks, limits=c.limits, dt=c.dt) for c in (saved, again))
            same &= _are_close(*problems)
    except (IndexError, KeyError, TypeError, ValueError) as problem:
        raise OsikValueError(f"the robot's MJCF does not make it again: {problem}. {_REMEDY}") from problem
    if not same:
        raise OsikValueError(f"the robot's MJCF gives another step: masses, shapes or joints differ. {_REMEDY}")
    return again


_REMEDY = "Give source= as the name or file that the robot was loaded from"


def _are_close(one: Any, other: Any) -> bool:
    """Return whether two trees have the same structure, and arrays that differ by roundoff."""
    same = jax.tree.structure(one) == jax.tree.structure(other)
    return same and all(map(_arrays_are_close, jax.tree.leaves(one), jax.tree.leaves(other)))


def _arrays_are_close(one: Any, other: Any) -> bool:
    x, y = np.asarray(one), np.asarray(other)
    if x.shape != y.shape or not np.issubdtype(x.dtype, np.floating):
        return np.array_equal(x, y)
    largest = np.abs(x[np.isfinite(x)]).max(initial=1e-3)
    return np.allclose(x, y, rtol=0.0, atol=_ACCURACY[jnp.dtype(x.dtype)] * largest, equal_nan=True)


def _quietly_loaded(described: Mapping[str, Any]) -> Robot:
    # what the robot does not keep was said when it was loaded
    with warnings.catch_warnings(action="ignore", category=OsikWarning):
        return _loaded(described)


def _robot(described: Mapping[str, Any]) -> Robot:
    robot = _loaded(described)
    numbers = {
        name: np.asarray(one["array"], one["dtype"]).reshape(one["shape"])
        for name, one in described.get("numbers", {}).items()
    }
    as_own = [jnp.asarray(n) if isinstance(getattr(robot, name), jax.Array) else n for name, n in numbers.items()]
    return eqx.tree_at(lambda own: [getattr(own, name) for name in numbers], robot, as_own)


def _loaded(described: Mapping[str, Any]) -> Robot:
    options: Any = {"floating_base": described["floating_base"]}
    if "mjcf" in described:
        kind = jax.dtypes.canonicalize_dtype(described.get("dtype", float))  # double precision only where JAX has it
        return Robot.from_mjcf(described["mjcf"], **options).astype(kind)
    options["locked_joints"] = tuple(described["locked_joints"])
    if "name" in described:
        return load_robot(described["name"], **options)
    file = Path(described["file"])
    if not file.is_file():
        raise FileNotFoundError(f"the robot's file is not there: {file}")
    if _hash(file) != described["sha256"]:
        raise OsikValueError(f"{file} has changed since the controller was saved: save it again")
    return read_robot(str(file), **options)


def _hash(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _structure(robot: Robot) -> tuple[Any, ...]:
    """Return the robot's structure to which the numbers of tasks and limits refer."""
    tree = robot.tree
    return tree.dof_owners, tree.frame_names, tree.geom_bodies, [np.shape(getattr(robot, n)) for n in _numbers(robot)]


def _numbers(robot: Robot) -> list[str]:
    return [f.name for f in dataclasses.fields(robot) if isinstance(getattr(robot, f.name), jax.Array | np.ndarray)]
