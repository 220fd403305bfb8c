"""``osik ros2``."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import threading
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from ._inputs import HasBase, read_robot
from ._messages import CommandError, refuse, told

if TYPE_CHECKING:
    from ..interop.ros2 import Controller


@dataclasses.dataclass(frozen=True)
class Ros2(HasBase):
    """Leads a robot over ROS 2 topics, without ROS on this machine: joint states and targets in, commands out.

    Needs the extra ros2. It starts at the measured configuration, stays there until a target comes, and holds where
    states stop.
    """

    robot: str | None = None
    """A URDF or MJCF file, or a robot by name: nao, arm7, g1, talos, or one of robot_descriptions. Default: the robot
    of the controller that the settings name."""
    config: Path | None = None
    """A TOML file with settings: topics, frames, limits, names of joints."""
    domain: int | None = None
    """Number of the DDS domain. Default: ROS_DOMAIN_ID, or 0."""
    loopback: bool = False
    """Speak with this machine alone, as with ROS_LOCALHOST_ONLY=1 or ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST."""
    duration: float | None = None
    """Seconds after which it ends. Default: Ctrl-C ends it."""

    def run(self) -> int:
        """Run the command; return the exit code: 130 after Ctrl-C."""
        with told():
            from ..interop.ros2 import Controller, Settings, dds
            from ..interop.ros2._settings import read_settings

            settings = Settings() if self.config is None else read_settings(self.config)
            if (self.robot is None) == (settings.controller is None):
                raise CommandError("give --robot, or a controller in the settings of --config")
            refuse(self, self.robot is None, ("base",), "--robot, not with a controller, which has its own")
            robot = None if self.robot is None else read_robot(self.robot, self.base)
            return self._lead(dds, Controller(robot, settings))

    def _lead(self, dds: ModuleType, controller: Controller) -> int:
        stop, received = threading.Event(), set[int]()

        def end(number: int, _: object) -> None:
            received.add(number)
            stop.set()

        with contextlib.ExitStack() as stack:
            node = dds.Node(controller, dds.Endpoints(self.domain, self.loopback or None))
            for number in (signal.SIGINT, signal.SIGTERM):
                stack.callback(signal.signal, number, signal.signal(number, end))
            if self.duration is not None:
                timer = threading.Timer(self.duration, stop.set)
                stack.callback(timer.cancel)
                timer.start()
            print(f"osik ros2: {1.0 / controller.dt:g} Hz, targets of {', '.join(controller.frames)}", flush=True)
            node.run(stop)
        print(f"osik ros2: {node.periods} periods, {node.missed} missed")
        return 130 if signal.SIGINT in received else 0
