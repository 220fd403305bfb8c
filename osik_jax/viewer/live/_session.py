"""Session: a robot by its source, its controller and its switched-off parts, as a file."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..._errors import OsikValueError
from ..._whole_file import write_text
from ...limits import Limit, no_limits, with_own_limits
from ...robot import Robot
from ...robot._load_robot import read_robot
from ...saving._parts import decode_parts, encode_parts
from ...schemes import Scheme
from ...tasks import Task
from ._step import Controller

_FORMAT = "osik-jax session 1"


@dataclasses.dataclass(frozen=True)
class Session:
    """Tasks and limits of a live view, each of which can be switched off, with their robot and scheme.

    ``osik_jax.solve(session.robot, q, session.active_tasks, scheme=session.scheme, limits=session.active_limits,
    dt=session.dt)`` is a step of it.

    Attributes:
        robot: the robot.
        tasks: all tasks by name, switched off or not.
        scheme: how the tasks are combined: by weights or by priorities.
        limits: all limits, switched off or not: those given, then the robot's own that they do not replace.
        dt: time of a step [s].
        q: where the robot starts. (nq,)
        off: names of the tasks that are switched off.
        limits_off: numbers of the limits that are switched off, in the order of ``limits``.
        source: where the robot comes from, a ``RobotSource``, or its name or file alone; None: not known, so that the
            session cannot be saved.
    """

    robot: Robot
    tasks: Mapping[str, Task]
    scheme: Scheme
    limits: tuple[Limit, ...]
    dt: float
    q: Float[np.ndarray, " nq"]
    off: frozenset[str] = frozenset()
    limits_off: frozenset[int] = frozenset()
    source: RobotSource | None = None

    def __post_init__(self) -> None:
        """Add the robot's own limits, so that they can be switched off too; convert a name to a ``RobotSource``."""
        object.__setattr__(self, "limits", with_own_limits(self.robot, self.limits))
        if isinstance(self.source, str):
            object.__setattr__(self, "source", RobotSource(self.source))

    @property
    def active_tasks(self) -> dict[str, Task]:
        """Return the tasks that are switched on."""
        return {name: task for name, task in self.tasks.items() if name not in self.off}

    @property
    def active_limits(self) -> tuple[Limit, ...]:
        """Return the limits that are switched on, in the form that ``solve`` takes."""
        on = tuple(limit for number, limit in enumerate(self.limits) if number not in self.limits_off)
        return (no_limits, *on) if self.limits_off else on

    def controller(self) -> Controller:
        """Return the controller of what is switched on."""
        return Controller(self.active_tasks, self.scheme, self.active_limits)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the session to a file for ``load_session``.

        Raises:
            ValueError: it holds what a file cannot, such as a task of a class of one's own.
        """
        write_text(path, self.to_json())

    def to_json(self) -> str:
        """Return the session as JSON, the content of the file that ``save`` writes.

        Raises:
            ValueError: as in ``save``.
        """
        if self.source is None:
            raise OsikValueError(
                "where the robot comes from is not known, so the session cannot be saved: give source="
            )
        content = {
            "format": _FORMAT,
            "robot": dataclasses.asdict(self.source),
            "dt": self.dt,
            "q": np.asarray(self.q).tolist(),
            "limits_off": sorted(self.limits_off),
            "off": sorted(self.off),
        } | encode_parts(self.robot, self.tasks, self.scheme, self.limits)
        return json.dumps(content, indent=1) + "\n"


def load_session(path: str | os.PathLike[str]) -> Session:
    """Read a session written by a live view or ``Session.save``.

    Args:
        path: of the file.

    Raises:
        FileNotFoundError: no such file, or the robot's file is no longer where it was.
        ValueError: the file is no session, or one that this version cannot read.
    """
    return session_from_json(Path(path).read_text(encoding="utf-8"), str(path))


def session_from_json(text: str, where: str = "this") -> Session:
    """Return the session of a ``Session.to_json`` text; ``where`` names its source in messages."""
    try:
        content = json.loads(text)
        known = isinstance(content, dict) and content.get("format") == _FORMAT
    except ValueError:
        known = False
    if not known:
        raise OsikValueError(f"{where} is no session of osik view ({_FORMAT})")
    try:
        return _session(content)
    except (KeyError, TypeError, ValueError) as error:
        raise OsikValueError(f"{where}: {error.args[0] if error.args else error}") from error


def _session(content: Mapping[str, Any]) -> Session:
    source = RobotSource(**content["robot"])
    robot = source.load()
    q = np.asarray(content["q"], float)
    robot.check_configuration(jnp.asarray(q))
    off = {name: frozenset(content.get(name, ())) for name in ("off", "limits_off")}
    return Session(robot, *decode_parts(content, robot), float(content["dt"]), q, **off, source=source)


@dataclasses.dataclass(frozen=True)
class RobotSource:
    """Robot given by name or file."""

    robot: str  # a name that ``load_robot`` takes, or the path of a URDF or MJCF file
    floating_base: bool | None = None  # as in ``Robot.from_urdf``; None: as the file says

    def load(self) -> Robot:
        """Return the robot."""
        return read_robot(self.robot, floating_base=self.floating_base)
