"""``osik view``."""

from __future__ import annotations

import dataclasses
import json
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from ._inputs import HasBase, InScene, read_robot
from ._messages import CommandError, refuse, told

if TYPE_CHECKING:
    from ..collision import Scene
    from ..limits import Limit
    from ..robot import Robot

_CLEARANCE = 0.01
"""Default distance from obstacles [m]."""


@dataclasses.dataclass(frozen=True)
class View(HasBase, InScene):
    """Shows a robot in the browser: drag its hands, feet and waist, and it follows. Needs the extra viewer.

    With a file: writes a page that plays the motion.npz of osik demo or osik retarget, or runs the controller that a
    page or osik.save_controller has written.
    """

    file: Annotated[Path | None, tyro.conf.Positional] = None
    """A motion.npz to play, or a controller.json to run. Default: drag the robot."""
    robot: str = "nao"
    """A URDF or MJCF file, or a robot by name: nao, ur5, g1 and others, or one of robot_descriptions."""
    support: tuple[str, ...] = ()
    """Frames that stand on the ground. Default: those that look like feet."""
    host: str = "127.0.0.1"
    """Address to listen at; the default is this machine alone."""
    port: int = 8080
    """Port to listen at; 0 for any that is free."""
    browser: bool = True
    """Open the page in a browser."""
    html: Path | None = None
    """With a motion.npz: the page to write, one file that plays without a server. Default: its name, .html."""

    def run(self) -> int:
        """Serve a page until Ctrl-C, which is how a view ends; or write one that plays a motion."""
        from ..robot._guesses import guess_feet
        from ..saving._controller import read_controller
        from ..viewer.live import _open, _server
        from ..viewer.live._page import serve

        with told():
            saved, moves = (self.file is not None and self.file.suffix == end for end in (".json", ".npz"))
            refuse(self, saved, ("robot", "base"), "a robot or a motion, not with a controller, which has its own")
            refuse(self, self.file is not None, ("support", "scene"), "a robot to drag, not with a file")
            refuse(self, not moves, ("html",), "a motion.npz")
            if self.file is not None and not (saved or moves):
                raise CommandError(f"{self.file} is no .npz of a motion, nor .json of a controller")
            obstacles = self.obstacles()
            _server.import_viser()
            if moves:
                return self._play()
            _server.check_port(self.host, self.port)
            options: Any = dict(host=self.host, port=self.port)
            if self.file is not None:
                content = self.file.read_bytes()
                controller, robot = read_controller(content, str(self.file)), json.loads(content)["robot"]
                view = serve(controller, source=robot.get("file", robot.get("name")), **options)
            else:
                robot = read_robot(self.robot, self.base)
                options["limits"] = _keeps_off(robot, **obstacles) if obstacles else ()
                view = _open.open_robot(robot, self.robot, self.support or guess_feet(robot), **options)
        print(f"osik view: {view.url} (Ctrl-C ends it)", flush=True)
        if self.browser:
            webbrowser.open(view.url)
        with suppress(KeyboardInterrupt):
            view.wait()
        view.stop()
        return 0

    def _play(self) -> int:
        """Write a page that plays a motion; return the exit code."""
        from ..viewer.live._playback import read_motion, write_page

        assert self.file is not None
        robot = read_robot(self.robot, self.base)
        page = self.html or self.file.with_suffix(".html")
        write_page(robot, read_motion(self.file, robot), page, title=self.file.stem)
        print(f"written: {page}")
        if self.browser and self.html is None:
            webbrowser.open(page.resolve().as_uri())
        return 0


def _keeps_off(robot: Robot, scene: Scene, srdf: Path | None, clearance: float) -> tuple[Limit, ...]:
    """Return the limit that keeps the robot off obstacles and off itself."""
    from ..limits import CollisionAvoidanceLimit

    return (CollisionAvoidanceLimit(robot, scene=scene, srdf=srdf, minimum_distance=clearance or _CLEARANCE),)
