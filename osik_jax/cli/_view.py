"""``osik view``."""

from __future__ import annotations

import dataclasses
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from ._messages import CommandError, refuse, told
from ._robots import FLOATING, read_robot
from ._scene import InScene

if TYPE_CHECKING:
    from ..collision import Scene
    from ..limits import Limit
    from ..robot import Robot

_CLEARANCE = 0.01
"""Default distance from obstacles [m]."""


@dataclasses.dataclass(frozen=True)
class View(InScene):
    """Shows a robot in the browser: drag its hands, feet and waist, and it follows. Needs the extra viewer.

    With a file: plays the motion.npz that osik demo wrote, opens a session that a view has saved, or shows slices of
    the map.npz that osik reach wrote.
    """

    file: Annotated[Path | None, tyro.conf.Positional] = None
    """A motion.npz to play, a session.json to open, or a map.npz. Default: drag the robot."""
    robot: str = "nao"
    """A URDF or MJCF file, or a robot by name: nao, ur5, g1 and others, or one of robot_descriptions."""
    base: Literal["auto", "floating", "fixed"] = "auto"
    """Whether its root moves freely. auto: as the file says; a URDF that does not say floats if it has feet."""
    support: tuple[str, ...] = ()
    """Frames that stand on the ground. Default: those that look like feet."""
    host: str = "127.0.0.1"
    """Address to listen at; the default is this machine alone."""
    port: int = 8080
    """Port to listen at; 0 for any that is free."""
    browser: bool = True
    """Open the page in a browser."""
    html: Path | None = None
    """Write a page that plays a motion.npz without a server, instead of serving one."""

    def run(self) -> int:
        """Serve a page until Ctrl-C, which is how a view ends."""
        from ..viewer.live import _open, _playback, _server, load_session, serve
        from ..viewer.live._export import write_page
        from ..viewer.live._session import RobotSource

        with told():
            if self.html is not None and (self.file is None or self.file.suffix == ".json" or _open.is_map(self.file)):
                raise CommandError("--html goes with a motion.npz")
            saved = self.file is not None and self.file.suffix == ".json"
            refuse(self, saved, ("robot", "base"), "a robot or a motion, not with a session, which has its own")
            refuse(self, self.file is not None, ("support", "scene"), "a robot to drag, not with a file")
            obstacles = self.obstacles()
            _server.import_viser()
            _server.check_port(self.host, 0 if self.html is not None else self.port)
            options: Any = dict(host=self.host, port=self.port)
            if self.file is not None and saved:
                view = serve(load_session(self.file), **options)
            elif self.file is None:
                robot = read_robot(self.robot, self.base)
                source = RobotSource(self.robot, FLOATING[self.base])
                keeps_off = _keeps_off(robot, **obstacles) if obstacles else ()
                view = _open.open_robot(robot, source, self.support or _feet(robot), limits=keeps_off, **options)
            elif _open.is_map(self.file):
                view = _open.open_map(self.file, read_robot(self.robot, self.base), **options)
            else:
                robot = read_robot(self.robot, self.base)
                motion = _playback.read_motion(self.file, robot)
                if self.html is not None:
                    write_page(robot, motion, self.html, title=self.file.stem)
                    print(f"written: {self.html}")
                    return 0
                view = _playback.Player(robot, motion, title=self.file.name, **options)
        print(f"osik view: {view.url} (Ctrl-C ends it)", flush=True)
        if self.browser:
            webbrowser.open(view.url)
        with suppress(KeyboardInterrupt):
            view.wait()
        view.stop()
        return 0


def _keeps_off(robot: Robot, scene: Scene, srdf: Path | None, clearance: float) -> tuple[Limit, ...]:
    """Return the limit that keeps the robot off obstacles and off itself."""
    from ..limits import CollisionAvoidanceLimit

    return (CollisionAvoidanceLimit(robot, scene=scene, srdf=srdf, minimum_distance=clearance or _CLEARANCE),)


def _feet(robot: Robot) -> tuple[str, ...]:
    """Return frames on the ground, of a robot that moves freely."""
    from ..robot._guesses import guess_feet

    return guess_feet(robot) if robot.floating_base else ()
