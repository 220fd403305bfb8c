"""Control loop without transport: one period as a function of the received messages."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from ..._errors import OsikValueError, unknown_name
from ...robot import Robot
from ...solvers import Status
from ._joints import JointNames, Refused, joint_names, pose_of, stamp_of
from ._settings import Settings, topic_of_frame
from ._steps import Steps

Phase = Literal["waiting", "moving", "holding"]
OK, WARN, ERROR = 0, 1, 2
_NEVER = np.iinfo(np.int64).min // 2
_SHOWN_NS = 1_000_000_000
"""Time for which a refused message, or a name that no joint has, is told [ns]."""


class Received(NamedTuple):
    """Received message; ``Controller.tick`` says what the fields are."""

    kind: str
    frame: str
    time_ns: int
    message: Any


class Command(NamedTuple):
    """Command: positions and velocities of joints.

    Attributes:
        names: ROS names. (n,)
        positions: [rad or m]. (n,)
        velocities: [rad/s or m/s]. (n,)
    """

    names: tuple[str, ...]
    positions: np.ndarray
    velocities: np.ndarray


class Output(NamedTuple):
    """Output of a period: a command, and the state of the controller.

    Attributes:
        command: None until every joint was measured.
        phase: whether it waits for the first states, moves, or holds because states stopped.
        level: 0 OK, 1 WARN, 2 ERROR, as in a DiagnosticStatus.
        message: one sentence.
        values: numbers and texts for diagnostics, by name.
    """

    command: Command | None
    phase: Phase
    level: int
    message: str
    values: dict[str, str]


@dataclasses.dataclass(frozen=True)
class Memory:
    """State passed from period to period."""

    measured: np.ndarray  # position of each joint [rad or m], NaN until it is measured. (n,)
    measured_ns: np.ndarray  # when that was received. (n,)
    stamps_ns: Mapping[str, Any]  # last stamps, by joint (an array (n,)) under "", and by frame
    targets: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # of each frame, world axes
    unknown: Mapping[str, int] = dataclasses.field(default_factory=dict)  # names that no joint has; when last told [ns]
    refused: tuple[int, int, str] = (0, _NEVER, "")  # number of refused messages; time and reason of the last one
    phase: Phase = "waiting"
    q: Any = None  # the commanded configuration; None before the start. (nq,)
    velocity: Any = None  # the last one. (nv,)
    warm_start: Any = None  # this one, tasks and poses: see ``Steps``
    tasks: Any = None
    poses: Any = None


class Controller:
    """Control loop of a robot as a function of received messages, for ``osik ros2``.

        memory = controller.memory()
        memory, output = controller.tick(memory, now_ns, received)

    Every state is of a joint by its name. It begins at the measured configuration once all joints were measured, and
    again after each time that it held: targets from before then are forgotten, and frames stay until new ones come.
    Between, it integrates its own velocities, within all limits, and waits where the robot does not follow.

    Args:
        robot: the robot; None where the settings name a controller's file.
        settings: the settings.

    Raises:
        FileNotFoundError, KeyError, TypeError, ValueError: the controller's file cannot be read, or something is given
            that it has; a frame does not exist, or shares its topic with another; there is nothing to lead or to stand
            on; a joint has no place in a JointState; joints of a Float64MultiArray are not the robot's, each once.
    """

    def __init__(self, robot: Robot | None, settings: Settings):
        self.settings, self.steps = settings, Steps(robot, settings)
        self.robot, self.dt = self.steps.robot, self.steps.dt
        self.joints: JointNames = joint_names(self.robot, settings)
        self.frames = tuple(self.steps.task_names)
        self.order = self._order()
        topics = [topic_of_frame("", frame) for frame in self.frames]
        shared = [frame for frame, topic in zip(self.frames, topics, strict=True) if topics.count(topic) > 1]
        if shared:
            raise OsikValueError(f"these frames have one topic name; lead one of them: {', '.join(shared)}")
        self._rehearse()

    def _rehearse(self) -> None:
        """Run a start and a step, so that nothing compiles while a robot moves."""
        memory = dataclasses.replace(self.memory(), measured=np.asarray(self.robot.q0)[self.joints.index])
        self._moved(self._begun(memory))

    def _order(self) -> np.ndarray:
        """Return the index of each commanded joint."""
        names, wanted = self.joints.names, self.settings.joints
        for name in wanted:
            if name not in names:
                raise unknown_name("joint", name, names)
        if wanted and sorted(wanted) != sorted(set(wanted)):
            raise OsikValueError("the setting joints names a joint twice")
        return np.array([names.index(name) for name in wanted or names], int)

    def memory(self) -> Memory:
        """Return the initial memory."""
        count = len(self.joints.names)
        return Memory(np.full(count, np.nan), np.full(count, _NEVER), {"": np.full(count, _NEVER)})

    def tick(self, memory: Memory, now_ns: int, received: Sequence[tuple[str, str, int, Any]]) -> tuple[Memory, Output]:
        """Return the memory and the output after one period.

        Args:
            memory: that of the last period.
            now_ns: time now, by the clock of stamps [ns].
            received: the messages since the last period, in the order in which they came. Each is a tuple of

                - its kind: ``"state"`` or ``"target"``;
                - the frame of a target, empty for joint states;
                - when it was received, by the clock of stamps [ns];
                - the JointState or PoseStamped, of any library: its attributes are read.
        """
        for item in map(Received._make, received):
            try:
                memory = self._take(memory, item)
            except Refused as reason:
                count = memory.refused[0] + 1
                memory = dataclasses.replace(memory, refused=(count, item.time_ns, str(reason)))
        late = now_ns - memory.measured_ns > self.settings.state_timeout * 1e9
        if late.any():
            return self._without_states(memory, now_ns, late)
        if memory.phase != "moving":
            memory = self._begun(memory)
        behind = np.abs(np.asarray(memory.q)[self.joints.index] - memory.measured)
        if behind.max() > self.settings.following_error:
            memory = dataclasses.replace(memory, velocity=np.zeros(self.robot.nv))
            name = self.joints.names[int(behind.argmax())]
            return memory, self._output(memory, now_ns, WARN, f"joint {name} does not follow: the command waits")
        memory, status = self._moved(memory)
        level, text = (OK, "moving") if status == Status.SOLVED else (WARN, f"the step is {Status(status).name}")
        return memory, self._output(memory, now_ns, level, text)

    def _take(self, memory: Memory, item: Received) -> Memory:
        stamp = stamp_of(item.message, item.time_ns, self.settings)
        if item.kind == "state":
            return self._take_state(memory, item, stamp)
        if stamp <= memory.stamps_ns.get(item.frame, _NEVER):
            raise Refused(f"a target of {item.frame} is not newer than the last one")
        pose = pose_of(item.message)
        memory = dataclasses.replace(memory, stamps_ns={**memory.stamps_ns, item.frame: stamp})
        if memory.phase != "moving":
            raise Refused(f"a target of {item.frame} came while the robot was not moving")
        target = self._in_world(memory, item.message.header.frame_id, pose)
        return dataclasses.replace(memory, targets={**memory.targets, item.frame: target})

    def _take_state(self, memory: Memory, item: Received, stamp: int) -> Memory:
        places, positions, unknown = self.joints.read(item.message)
        told = {name: at for name, at in memory.unknown.items() if item.time_ns - at <= _SHOWN_NS}
        memory = dataclasses.replace(memory, unknown=told | dict.fromkeys(unknown, item.time_ns))
        if (stamp <= memory.stamps_ns[""][places]).any():
            raise Refused("a joint state is not newer than the last one")
        measured, times, stamps = memory.measured.copy(), memory.measured_ns.copy(), memory.stamps_ns[""].copy()
        measured[places], times[places], stamps[places] = positions, item.time_ns, stamp
        stamps_ns = {**memory.stamps_ns, "": stamps}
        return dataclasses.replace(memory, measured=measured, measured_ns=times, stamps_ns=stamps_ns)

    def _in_world(self, memory: Memory, frame_id: str, pose: Any) -> Any:
        """Return a pose given in a frame, in the world."""
        if frame_id == self.settings.world_frame:
            return pose
        if frame_id not in self.steps.references:
            known = ", ".join(dict.fromkeys((self.settings.world_frame, *self.steps.references)))
            raise Refused(f"a target's frame_id is {frame_id!r}; it is one of {known}")
        position, rotation = (np.asarray(part) for part in memory.poses[frame_id])
        return position + rotation @ pose[0], rotation @ pose[1]

    def _without_states(self, memory: Memory, now_ns: int, late: np.ndarray) -> tuple[Memory, Output]:
        names = ", ".join(name for name, is_late in zip(self.joints.names, late, strict=True) if is_late)
        if memory.phase == "waiting":
            return memory, self._output(memory, now_ns, WARN, f"waiting for states of {names}")
        memory = dataclasses.replace(memory, phase="holding", velocity=np.zeros(self.robot.nv))
        return memory, self._output(memory, now_ns, ERROR, f"holding: no new state of {names}")

    def _begun(self, memory: Memory) -> Memory:
        """Return the memory at rest at the measured configuration, with targets at the present poses."""
        q = np.array(self.robot.q0)
        q[self.joints.index] = memory.measured
        q, tasks, poses = self.steps.begin(q)
        targets = {frame: poses[frame] for frame in self.frames}
        return dataclasses.replace(
            memory,
            phase="moving",
            q=q,
            velocity=np.zeros(self.robot.nv),
            warm_start=self.steps.no_warm_start,
            tasks=tasks,
            poses=poses,
            targets=targets,
        )

    def _moved(self, memory: Memory) -> tuple[Memory, int]:
        """Return the memory after one control step, and its status."""
        step = self.steps.advance(memory.q, memory.velocity, memory.warm_start, memory.tasks, dict(memory.targets))
        new = dict(q=step.q, velocity=step.velocity, warm_start=step.warm_start, poses=step.poses)
        return dataclasses.replace(memory, **new), int(step.status)

    def _output(self, memory: Memory, now_ns: int, level: int, message: str) -> Output:
        count, refused_ns, reason = memory.refused
        if now_ns - refused_ns <= _SHOWN_NS:
            level, message = max(level, WARN), f"{message}; refused: {reason}"
        unknown = sorted(name for name, at in memory.unknown.items() if now_ns - at <= _SHOWN_NS)
        if unknown:
            level, message = max(level, WARN), f"{message}; unknown joints: {', '.join(unknown)}"
        values = {"phase": memory.phase, "refused messages": str(count), "last refusal": reason}
        command = None
        if memory.q is not None:
            positions = np.asarray(memory.q)[self.joints.index]
            values["largest following error"] = f"{np.abs(positions - memory.measured).max():.4g}"
            names = tuple(self.joints.names[place] for place in self.order)
            velocities = np.asarray(memory.velocity)[self.joints.dofs]
            command = Command(names, positions[self.order], velocities[self.order])
        return Output(command, memory.phase, level, message, values)
