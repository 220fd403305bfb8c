"""Settings of ``osik ros2``, and the TOML file that holds them."""

from __future__ import annotations

import dataclasses
import math
import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from ..._errors import OsikTypeError, OsikValueError, unknown_name


@dataclasses.dataclass(frozen=True)
class Topics:
    """Names of ROS 2 topics; ``targets`` is followed by ``/`` and the frame's name."""

    joint_states: str = "/joint_states"
    targets: str = "/osik/targets"
    trajectory: str = "/joint_trajectory_controller/joint_trajectory"
    positions: str = "/forward_position_controller/commands"
    diagnostics: str = "/diagnostics"


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of ``osik ros2``, with their bounds.

    Attributes:
        rate: control steps a second [Hz]. Default: 200, or that of the controller, beside which none is given.
        frames: frames that get a topic for targets. Default: the hands, or the frames of the controller's tasks.
        support: frames that stand on the ground, for a floating-base robot. Default: frames named like feet.
        controller: a file of ``osik.save_controller``; its tasks, scheme and limits take the place of the default ones.
        commands: ``"trajectory"`` (JointTrajectory) or ``"positions"`` (Float64MultiArray).
        joints: joints of a Float64MultiArray in the order of its receiver, which has no names; ROS names.
        speed: largest joint speed [rad/s or m/s]; a joint's own limit holds where it is lower.
        acceleration: largest acceleration of joints that have no limit of their own [rad/s^2 or m/s^2].
        following_error: largest distance of a measured joint from its command [rad or m]; the command waits beyond it.
        state_timeout: time without a new state of a joint after which the robot holds [s].
        max_age: largest difference between a stamp and this machine's clock [s].
        check_stamps: whether stamps are looked at. False: for publishers that do not stamp, and simulated time.
        reliable_targets: whether target topics ask for reliable publishers, which those of ROS 2 are by default.
        world_frame: ``frame_id`` of targets in the robot's world frame.
        names: from ROS names of joints to the model's, where they differ.
        topics: names of topics.
    """

    rate: float | None = None
    frames: tuple[str, ...] = ()
    support: tuple[str, ...] = ()
    controller: str | None = None
    commands: Literal["trajectory", "positions"] = "trajectory"
    joints: tuple[str, ...] = ()
    speed: float = 1.0
    acceleration: float = 10.0
    following_error: float = 0.2
    state_timeout: float = 0.05
    max_age: float = 0.1
    check_stamps: bool = True
    reliable_targets: bool = True
    world_frame: str = "world"
    names: Mapping[str, str] = dataclasses.field(default_factory=dict)
    topics: Topics = dataclasses.field(default_factory=Topics)

    def __post_init__(self) -> None:
        for name in ("rate", "speed", "acceleration", "following_error", "state_timeout", "max_age"):
            value = getattr(self, name)
            if name == "rate" and value is None:
                continue
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < math.inf:
                raise OsikValueError(f"{name} is {value!r}; it is a positive number")
        if self.commands not in ("trajectory", "positions"):
            raise OsikValueError(f"commands is {self.commands!r}; it is 'trajectory' or 'positions'")
        if self.commands == "positions" and not self.joints:
            raise OsikValueError(
                "commands = 'positions' needs joints: a Float64MultiArray has no names, so give the joints in the "
                "order in which its receiver has them"
            )

    @property
    def dt(self) -> float:
        """Return the length of a control step [s]."""
        return 1.0 / (200.0 if self.rate is None else self.rate)


def read_settings(path: str | os.PathLike[str]) -> Settings:
    """Return the settings of a TOML file, whose keys are the attributes of ``Settings``.

    Raises:
        FileNotFoundError: no such file.
        KeyError: an unknown key; the message lists the known ones.
        TypeError, ValueError: no TOML, or a wrong value.
    """
    try:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise OsikValueError(f"{path} is no TOML: {error}") from error
    if "topics" in table:
        table["topics"] = _made(Topics, table["topics"], "topic")
    if isinstance(table.get("controller"), str):  # beside the file that names it
        table["controller"] = str(Path(path).parent / table["controller"])
    return _made(Settings, table, "setting")


_CHECKS: dict[str, tuple[str, Any]] = {
    "tuple[str, ...]": ("a list of names", lambda v: isinstance(v, list) and all(isinstance(n, str) for n in v)),
    "str": ("text", lambda v: isinstance(v, str)),
    "str | None": ("text", lambda v: isinstance(v, str)),
    "bool": ("true or false", lambda v: isinstance(v, bool)),
    "Mapping[str, str]": (
        "a table of names",
        lambda v: isinstance(v, dict) and all(isinstance(n, str) for n in v.values()),
    ),
}


def _made(kind: Any, table: Any, what: str) -> Any:
    """Return an object from a TOML table, with lists as tuples."""
    if not isinstance(table, dict):
        raise OsikTypeError(f"{what}s is {table!r}; it is a table")
    fields = {field.name: field.type for field in dataclasses.fields(kind)}
    for name, value in table.items():
        if name not in fields:
            raise unknown_name(what, name, tuple(fields))
        expected, fits = _CHECKS.get(str(fields[name]), ("", lambda _: True))
        if not fits(value):
            raise OsikTypeError(f"{name} is {value!r}; it is {expected}")
    return kind(**{name: tuple(value) if isinstance(value, list) else value for name, value in table.items()})


def topic_of_frame(prefix: str, frame: str) -> str:
    """Return the topic of a frame; characters that ROS 2 does not allow in a topic become ``_``."""
    name = re.sub(r"\W", "_", frame, flags=re.ASCII)
    return f"{prefix}/{'_' if name[:1].isdigit() else ''}{name}"


def dds_name(topic: str) -> str:
    """Return the DDS name of a topic of ROS 2: ``/joint_states`` is ``rt/joint_states``."""
    if not re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", topic):
        raise OsikValueError(
            f"topic {topic!r} is no absolute name of ROS 2: a slash before each part, and letters, digits and "
            "underscores in it"
        )
    return f"rt{topic}"
