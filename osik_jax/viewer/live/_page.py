"""Page of a session: scene, marks of balance and panel, updated by a thread that only reads."""

from __future__ import annotations

import os
import threading
import time
import webbrowser
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from jaxtyping import Array, Float

from ..._errors import OsikValueError
from ..._whole_file import write_text
from ...control import Controller
from ...control._checks import check_setting, check_tasks, checked_limits
from ...limits import Limits
from ...robot import Robot
from ...robot._mujoco import mujoco_poses, robot_com
from ...schemes import Scheme
from ...schemes._default import scheme_for
from ...tasks import ComTask, SupportPolygon, Task
from .._parts import floor_height, robot_parts
from ._desk import Desk, Session
from ._gizmos import Gizmos, ObstacleNodes, Pose
from ._loop import DRAWING, be_nice
from ._obstacles import NearestPair, nearest_pair
from ._panel import Panel
from ._robot_nodes import RobotNodes, add_surroundings
from ._server import close_server, open_server

if TYPE_CHECKING:
    from viser import ClientHandle, SceneApi
_FRAME = 1.0 / 30.0
"""Time between pictures [s]."""
_WORDS = 6
"""Number of pictures between updates of the panel's text."""
_IN, _OUT, _EDGE, _NEAR = (42, 157, 98), (215, 38, 61), (28, 111, 184), (231, 126, 34)
_CLOSE, _HELD = 0.05, 1e-3
"""Distance below which the nearest pair is close; distance beyond the one that is kept where it is held off [m]."""
_LIFT = 0.002
"""Height of flat marks above the floor [m]."""
_TOUCHING = 1e-3
"""Distance beyond a polygon's edge up to which a point counts as inside [m]."""
_MOVED = 1e-5
"""Motion of the centre of mass below which its marks stay where they are [m]."""


class LiveView:
    """Page that runs a session; ``serve`` says what it has."""

    def __init__(self, session: Session, *, host: str, port: int) -> None:
        """Start the server and the loop."""
        self._server = open_server(host, port, "osik-jax")
        self.url = f"http://{host}:{self._server.get_port()}"
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="osik-page", daemon=True)
        robot = session.robot
        shapes, data = robot_parts(robot), next(mujoco_poses(robot, session.q))
        self._desk = Desk(session)
        self.loop = self._desk.loop
        seen, floor = shapes.corners(data), floor_height(robot, shapes, [data])
        size = float(np.linalg.norm(np.ptp(seen, axis=0)))
        around = (one.part.corners @ one.rotation.T + one.position for one in self._desk.obstacles.values())
        add_surroundings(self._server, np.concatenate([seen, *around]), floor)
        self._robot = RobotNodes(self._server.scene, robot)
        self._marks = BalanceMarks(self._server.scene, floor, size) if robot.floating_base else None
        self._gizmos = Gizmos(self._server.scene, size, self._drag)
        self._obstacles = ObstacleNodes(self._server.scene, size, self._desk.move_obstacle)
        self._panel = Panel(self._server, self._desk)
        self._polygon: SupportPolygon | None = None
        self._drawn: Session | None = None
        self._server.on_client_disconnect(self._gone)
        self.loop.start()
        self._thread.start()

    @property
    def session(self) -> Session:
        """Return the current session."""
        return self._desk.session

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the controller of what is switched on, as ``save_controller`` does."""
        write_text(path, self.session.to_text())

    def wait(self) -> None:
        """Block until ``stop`` is called elsewhere, or Ctrl-C."""
        while not self._end.wait(0.5):
            pass

    def stop(self) -> None:
        """End all threads and the server."""
        self._end.set()
        if self._thread is not threading.current_thread():
            self._thread.join(timeout=2.0)
        self.loop.stop()
        close_server(self._server)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def aim(self, task: str, target: Any) -> None:
        """Set the target of a task; exceptions are those of ``loop.aim``."""
        self.loop.aim(task, target)

    def _run(self) -> None:
        """Run the drawing thread."""
        be_nice(DRAWING)
        count = 0
        while not self._end.is_set():
            begin = time.perf_counter()
            self._draw()
            if count % _WORDS == 0:
                near = nearest_pair(self._desk.session.active_limits, self.loop.snapshot.q)
                self._panel.tell(near)
                show_nearest(self._server.scene, near)
            count += 1
            # a pause even when drawing is late, so that the control loop gets the GIL
            self._end.wait(max(_FRAME - (time.perf_counter() - begin), 0.2 * _FRAME))

    def _draw(self) -> None:
        """Draw the current state of the robot."""
        session = self._desk.session
        data = next(mujoco_poses(session.robot, self.loop.snapshot.q))
        with self._server.atomic():
            self._robot.place(data)
            if session is not self._drawn or self._gizmos.held:
                self._draw_session(session)
            self._obstacles.show(self._desk.obstacles)
            if self._marks is not None:
                self._marks.place(robot_com(session.robot, data))

    def _draw_session(self, session: Session) -> None:
        """Redraw the parts of the page that depend on the session alone."""
        on, self._drawn = session.active_tasks, session
        self._gizmos.show(on)
        polygon = _polygon(on)
        if self._marks is not None and polygon is not self._polygon:
            self._marks.show_polygon(polygon)
            self._polygon = polygon

    def _drag(self, name: str, pose: Pose, visitor: int, phase: str) -> None:
        """Apply a visitor's drag of a handle; a visitor who left stops the robot."""
        if phase != "end":
            target = self._desk.session.tasks[name].gripped(pose[0], pose[1] / np.linalg.norm(pose[1]))
            self.loop.aim(name, target, owner=visitor)
        elif visitor in self._server.get_clients():
            self.loop.let_go(visitor)
        else:
            self.loop.release(visitor)

    def _gone(self, client: ClientHandle) -> None:
        """Release the handles and the dragged robots of a visitor who closed the page."""
        self._gizmos.drop(client.client_id)
        self._obstacles.drop(client.client_id)
        self.loop.release(client.client_id)


def serve(
    robot: Robot | Controller,
    tasks: Mapping[str, Task] | None = None,
    *,
    scheme: Scheme | None = None,
    limits: Limits | None = None,
    dt: float | None = None,
    q0: Float[Array, " nq"] | None = None,
    source: str | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    open_browser: bool = False,
) -> LiveView:
    """Run a controller at a fixed rate and show it in a page, where targets can be dragged.

    The view is returned at once; the first step is compiled while the page is up already. ``view.stop()`` ends it,
    ``view.wait()`` keeps a program going until Ctrl-C.

    Args:
        robot: the robot; or a controller, such as one of ``load_controller``, which has the next four.
        tasks: by name. Frame tasks and centres of mass that have a target get a handle to drag.
        scheme: as in ``osik_jax.solve``.
        limits: as in ``osik_jax.solve``.
        dt: time of a step, and period of the loop [s]. Default: 0.005.
        q0: configuration at the start [m, rad]; default: ``robot.q0``. (nq,)
        source: name or file of the robot, as in ``save_controller``.
        host: address to listen at; 127.0.0.1 is this machine alone.
        port: TCP port; 0 for any that is free.
        open_browser: whether to open the page in a browser.

    Returns:
        The view.

        - ``url``: address of the page.
        - ``aim(task, target)``: sets the target of a task, as ``replace(target=...)`` takes it.
        - ``save(path)``: writes the present controller for ``load_controller``.
        - ``loop``: the control loop. ``wait_until_ready()`` returns when the controller is compiled;
            ``snapshot`` has the last step's ``q`` and ``status``, ``timing`` the loop's times.
        - ``wait()`` keeps a program going until Ctrl-C; ``stop()`` ends page and loop, as the end of ``with`` does.

    Raises:
        ImportError: viser is not installed (the extra ``viewer``).
        OSError: the port is in use.
        TypeError, ValueError: as in ``osik_jax.solve``; parts of a controller beside one.
    """
    if isinstance(robot, Controller):
        if any(part is not None for part in (tasks, scheme, limits, dt)):
            raise OsikValueError("a controller has its own tasks, scheme, limits and dt: leave out what is beside it")
        robot, tasks, scheme, limits, dt = robot.robot, robot.tasks, robot.scheme, robot.limits, robot.dt
    tasks, period = {} if tasks is None else tasks, 0.005 if dt is None else dt
    check_setting("serve(robot, tasks)", robot, scheme, period)
    given = checked_limits(robot, limits) or ()
    check_tasks(tasks, robot)
    start = robot.q0 if q0 is None else q0
    robot.check_configuration(start, "q0")
    used = scheme_for(tasks, robot.q0.dtype) if scheme is None else scheme
    session = Session(robot, dict(tasks), used, given, period, np.asarray(start), source=source)
    view = LiveView(session, host=host, port=port)
    if open_browser:
        webbrowser.open(view.url)
    return view


def _polygon(tasks: Mapping[str, Task]) -> SupportPolygon | None:
    """Return the polygon of the first task that keeps the centre of mass inside one; None if there is none."""
    found = (task.polygon for task in tasks.values() if isinstance(task, ComTask) and task.polygon is not None)
    return next(found, None)


def show_nearest(scene: SceneApi, near: NearestPair | None) -> None:
    """Draw a line between the points of the nearest pair: green, orange within 5 cm, red where it is held off."""
    if near is None:
        return scene.remove_by_name("/nearest")
    color = _OUT if near.distance < near.kept + _HELD else _NEAR if near.distance < _CLOSE else _IN
    scene.add_line_segments("/nearest", near.points[None], color, thickness=4.0, thickness_units="screen")
    return None


class BalanceMarks:
    """Support polygon, and the centre of mass as a ball with a disc on the floor; green inside, red outside."""

    def __init__(self, scene: SceneApi, floor: float, size: float) -> None:
        """Take the height of the floor and the size of the robot [m]."""
        self._scene, self._floor = scene, floor
        self._polygon: SupportPolygon | None = None
        self._color, self._at = _IN, np.full(3, np.inf)
        look: Any = dict(radius=0.016 * size, color=_IN, cast_shadow=False)
        self._ball = scene.add_icosphere("/balance/com", opacity=0.75, **look)
        self._disc = scene.add_cylinder("/balance/below", height=_LIFT, **look)

    def show_polygon(self, polygon: SupportPolygon | None) -> None:
        """Draw the polygon; None removes it."""
        self._polygon = polygon
        self._scene.remove_by_name("/balance/area")
        self._scene.remove_by_name("/balance/edge")
        if polygon is None:
            return
        corners = np.c_[np.asarray(polygon.vertices), np.full(len(polygon.vertices), self._floor + _LIFT)]
        fan = np.array([[0, k, k + 1] for k in range(1, len(corners) - 1)])
        self._scene.add_mesh_simple(
            "/balance/area", corners, fan, color=_EDGE, opacity=0.22, cast_shadow=False, side="double"
        )
        ring = np.stack([corners, np.roll(corners, -1, 0)], 1)
        self._scene.add_line_segments("/balance/edge", ring, _EDGE, thickness=2.5, thickness_units="screen")

    def place(self, com: Float[np.ndarray, "3"]) -> None:
        """Move the centre of mass [m]."""
        inside = self._polygon is None or float(self._polygon.distance(com[:2])) > -_TOUCHING
        color = _IN if inside else _OUT
        if color != self._color:
            self._color = self._ball.color = self._disc.color = color
        # smaller motions are invisible and need no message to the page
        if np.abs(com - self._at).max() > _MOVED:
            self._ball.position = self._at = np.array(com)
            self._disc.position = (com[0], com[1], self._floor + 2.0 * _LIFT)
