"""Bags: MCAP files of messages, recorded and replayed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from ..._errors import OsikValueError
from . import _messages as msg
from ._controller import Controller, Received
from ._node import command_message, command_topic, command_type
from ._settings import topic_of_frame


class Replay(NamedTuple):
    """Commands of a bag, and the commands of its replay.

    Attributes:
        names: joints, in the order of the columns. (n,)
        recorded: positions in the bag [rad or m]. (periods, n)
        computed: positions that the controller gives. (periods, n)
    """

    names: tuple[str, ...]
    recorded: np.ndarray
    computed: np.ndarray

    @property
    def difference(self) -> float:
        """Return the largest difference of a joint [rad or m]."""
        return float(np.abs(self.recorded - self.computed).max(initial=0.0))


class BagWriter:
    """Writer of a bag; its ``add`` is the argument ``record`` of a ``Node``."""

    def __init__(self, path: str | os.PathLike[str]):
        self._file = open(path, "wb")  # noqa: SIM115 - closed in __exit__
        self._writer = Writer(self._file, compression=CompressionType.NONE)
        self._writer.start(profile="ros2", library="osik-jax")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._writer.finish()
        self._file.close()

    def add(self, topic: str, time_ns: int, message: Any) -> None:
        """Append a message."""
        if topic not in self._channels:
            name = msg.ros_name(type(message))
            if name not in self._schemas:
                text = msg.definition(type(message)).encode()
                self._schemas[name] = self._writer.register_schema(name=name, encoding="ros2msg", data=text)
            made = self._writer.register_channel(topic=topic, message_encoding="cdr", schema_id=self._schemas[name])
            self._channels[topic] = made
        data = message.serialize()
        self._writer.add_message(self._channels[topic], log_time=time_ns, publish_time=time_ns, data=data)


def replay(controller: Controller, path: str | os.PathLike[str]) -> Replay:
    """Replay a bag with a controller, one period for each recorded command; return both commands.

    A bag of ``osik ros2 --record`` has the times that the controller saw, so its commands are reproduced exactly. A
    bag of another recorder has its own times: a message near a period's end may count in the next one.

    Raises:
        FileNotFoundError: no such file.
        KeyError: the bag's commands are for other joints.
        ValueError: no MCAP file, messages of other types, or no command in it.
    """
    settings = controller.settings
    sources: dict[str, tuple[Any, str, Any]] = {settings.topics.joint_states: ("state", "", msg.JointState)}
    for frame in controller.frames:
        sources[topic_of_frame(settings.topics.targets, frame)] = ("target", frame, msg.PoseStamped)
        if settings.clutch:
            sources[topic_of_frame(settings.topics.clutch, frame)] = ("clutch", frame, msg.Bool)
    commands = command_topic(settings)
    types = {topic: kind for topic, (_, _, kind) in sources.items()} | {commands: command_type(settings)}
    memory, received, recorded, computed = controller.memory(), [], [], []
    for topic, time_ns, message in _messages(path, types):
        if topic != commands:
            kind, frame, _ = sources[topic]
            received.append(Received(kind, frame, time_ns, message))
            continue
        memory, output = controller.tick(memory, time_ns, received)
        received = []
        if output.command is not None:
            again = command_message(output.command, settings, controller.dt)
            computed.append(_positions(again, controller))
            recorded.append(_positions(message, controller))
    if not recorded:
        raise OsikValueError(f"{path} has no command on {commands} after states of all joints")
    names = tuple(controller.joints.names[place] for place in controller.order)
    return Replay(names, np.array(recorded), np.array(computed))


def _positions(message: Any, controller: Controller) -> list[float]:
    """Return the positions of a command in the controller's order."""
    names = [controller.joints.names[place] for place in controller.order]
    if isinstance(message, msg.Float64MultiArray):
        return list(message.data)
    found = dict(zip(message.joint_names, message.points[0].positions, strict=True))
    return [found[name] for name in names]


def _messages(path: str | os.PathLike[str], types: dict[str, Any]) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, time and message, ordered by time."""
    with Path(path).open("rb") as file:
        try:
            for schema, channel, record in make_reader(file).iter_messages(topics=list(types)):
                kind = types[channel.topic]
                if schema is None or schema.name != msg.ros_name(kind) or channel.message_encoding != "cdr":
                    found = schema.name if schema is not None else "no type"
                    raise OsikValueError(f"{channel.topic} of {path} has {found}; it is {msg.ros_name(kind)} as CDR")
                yield channel.topic, record.log_time, kind.deserialize(record.data)
        except McapError as error:
            raise OsikValueError(f"{path} is no MCAP file: {error}") from error
