"""Transport of a controller's messages over DDS, once a period."""

from __future__ import annotations

import gc
import os
import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from cyclonedds.core import DDSException, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from . import _messages as msg
from ._controller import Command, Controller, Output, Received
from ._settings import Settings, dds_name, topic_of_frame

if TYPE_CHECKING:
    from ...motion import Motion

_BEST_EFFORT = Policy.Reliability.BestEffort
_RELIABLE = Policy.Reliability.Reliable(max_blocking_time=duration(milliseconds=1))
_DIAGNOSTICS_PERIOD_NS = 500_000_000
_LOOPBACK = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""


class Endpoints:
    """Participant of a DDS domain, with readers and writers like those of ROS 2 nodes.

    Args:
        domain: number of the domain. Default: ``ROS_DOMAIN_ID``, or 0.
        loopback: whether to speak with this machine alone. Default: what ``ROS_LOCALHOST_ONLY=1`` or
            ``ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST`` says. Where ``CYCLONEDDS_URI`` is set, that file decides.
    """

    def __init__(self, domain: int | None = None, loopback: bool | None = None):
        number = int(os.environ.get("ROS_DOMAIN_ID") or 0) if domain is None else domain
        if loopback is None:
            loopback = (
                os.environ.get("ROS_LOCALHOST_ONLY") == "1"
                or os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "LOCALHOST"
            )
        only = loopback and not os.environ.get("CYCLONEDDS_URI")
        self._domain = Domain(number, _LOOPBACK) if only else None
        self._participant = DomainParticipant(number)

    def reader(self, topic: str, kind: Any, *, reliable: bool) -> DataReader:
        """Return a subscription; one that is not reliable accepts reliable and best-effort publishers."""
        return DataReader(self._participant, self._topic(topic, kind), qos=_qos(reliable))

    def writer(self, topic: str, kind: Any) -> DataWriter:
        """Return a reliable publisher that keeps 10 messages, as by default in ROS 2."""
        return DataWriter(self._participant, self._topic(topic, kind), qos=_qos(True))

    def _topic(self, topic: str, kind: Any) -> Topic:
        return Topic(self._participant, dds_name(topic), kind)


def _qos(reliable: bool) -> Qos:
    return Qos(
        _RELIABLE if reliable else _BEST_EFFORT,
        Policy.Durability.Volatile,
        Policy.History.KeepLast(10),
        Policy.DataRepresentation(use_cdrv0_representation=True),  # ROS 2 knows no other
    )


class Node:
    """Controller with its subscriptions and publishers."""

    def __init__(self, controller: Controller, endpoints: Endpoints):
        self.controller = controller
        self._endpoints = endpoints  # readers and writers end with their participant
        settings, topics = controller.settings, controller.settings.topics
        self.periods = self.missed = self.unread = self.unsent = 0
        self._diagnostics_ns, self._told = 0, ("", -1)
        self._sources: list[tuple[Any, str, DataReader]] = []
        self._read("state", "", topics.joint_states, msg.JointState, reliable=False)
        for frame in controller.frames:
            name = topic_of_frame(topics.targets, frame)
            self._read("target", frame, name, msg.PoseStamped, reliable=settings.reliable_targets)
        is_trajectory = settings.commands == "trajectory"
        kind = msg.JointTrajectory if is_trajectory else msg.Float64MultiArray
        self._commands = endpoints.writer(topics.trajectory if is_trajectory else topics.positions, kind)
        self._diagnostics = endpoints.writer(topics.diagnostics, msg.DiagnosticArray)

    def _read(self, kind: Any, frame: str, topic: str, message: Any, *, reliable: bool) -> None:
        self._sources.append((kind, frame, self._endpoints.reader(topic, message, reliable=reliable)))

    def run(self, stop: threading.Event) -> None:
        """Run periods at the controller's rate until ``stop`` is set.

        A period whose work ends after the next one should have begun is missed: the next begins at once, and a command
        never makes up for time that was lost.
        """
        period_ns, memory = round(self.controller.dt * 1e9), self.controller.memory()
        gc.collect()
        gc.freeze()  # what is there stays; collecting it again would take longer than a period
        due = time.monotonic_ns()
        while not stop.is_set():
            received = self._take()
            now = max(time.time_ns(), received[-1].time_ns + 1 if received else 0)
            memory, output = self.controller.tick(memory, now, received)
            self._send(now, output)
            self.periods += 1
            due += period_ns
            late = time.monotonic_ns() - due
            if late > 0:
                self.missed += 1 + late // period_ns
                due += (late // period_ns) * period_ns
            else:
                time.sleep(-late * 1e-9)

    def _take(self) -> list[Received]:
        """Return the received messages in order, grouped by reader."""
        received = []
        for kind, frame, reader in self._sources:
            try:
                messages = reader.take(N=20)
            except Exception:  # bytes that are no such message: the others go on, and a robot without states is held
                self.unread += 1
                continue
            for message in messages:
                if type(message).__name__ != "InvalidSample":  # a publisher went away
                    received.append(Received(kind, frame, time.time_ns(), message))
        return received

    def _write(self, writer: DataWriter, message: Any) -> None:
        try:
            writer.write(message)
        except DDSException:  # a reliable subscriber that does not keep up: the next period has a newer command
            self.unsent += 1

    def _send(self, now_ns: int, output: Output) -> None:
        if output.command is not None:
            message = command_message(output.command, self.controller.settings, self.controller.dt)
            self._write(self._commands, message)
        told = (output.phase, output.level)
        if told != self._told or now_ns - self._diagnostics_ns >= _DIAGNOSTICS_PERIOD_NS:
            self._told, self._diagnostics_ns = told, now_ns
            counts = {"periods": self.periods, "missed periods": self.missed}
            counts |= {"unread messages": self.unread, "unsent messages": self.unsent}
            self._write(self._diagnostics, diagnostics_message(now_ns, output, counts))


def command_message(command: Command, settings: Settings, dt: float) -> Any:
    """Return a command as a message: a trajectory of one point due a period from now, or positions alone."""
    positions = command.positions.tolist()
    if settings.commands == "positions":
        axis = msg.MultiArrayDimension(",".join(command.names), len(positions), len(positions))
        return msg.Float64MultiArray(msg.MultiArrayLayout([axis]), positions)
    due = msg.Duration(*divmod(round(dt * 1e9), 1_000_000_000))
    point = msg.JointTrajectoryPoint(positions, command.velocities.tolist(), time_from_start=due)
    # a stamp of zero starts at once; with a stamp, a receiver drops points that come a moment late
    return msg.JointTrajectory(msg.Header(), list(command.names), [point])


def diagnostics_message(now_ns: int, output: Output, counts: dict[str, int]) -> Any:
    """Return the state of the controller as a message."""
    values = [msg.KeyValue(key, str(value)) for key, value in {**output.values, **counts}.items()]
    status = msg.DiagnosticStatus(output.level, "osik: controller", output.message, "osik", values)
    return msg.DiagnosticArray(msg.Header(msg.Time(*divmod(now_ns, 1_000_000_000))), [status])


def joint_trajectory(motion: Motion) -> Any:
    """Return a motion as a ``trajectory_msgs/JointTrajectory``, a point for each sample, times from the first on.

    Its joints have names.
    """
    rows = zip(*(np.asarray(a).tolist() for a in (motion.position, motion.velocity, motion.acceleration)), strict=True)
    nanoseconds = np.rint(1e9 * np.asarray(motion.time - motion.time[0])).astype(np.int64)
    points = []
    for row, due in zip(rows, nanoseconds.tolist(), strict=True):
        points.append(msg.JointTrajectoryPoint(*row, time_from_start=msg.Duration(*divmod(due, 1_000_000_000))))
    return msg.JointTrajectory(msg.Header(), list(motion.joints), points)
