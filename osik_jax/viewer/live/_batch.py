"""Page with several robots side by side: controllers with different numbers, run by one vmapped step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._errors import OsikValueError, unknown_name
from ...control._checks import check_setting, check_tasks, checked_limits
from ...limits import Limits
from ...robot import Robot
from ...robot._mujoco import mujoco_poses
from ...schemes import Scheme
from ...schemes._default import scheme_for
from ...tasks import Task
from .._outline import floor_height
from .._parts import robot_parts
from ._gizmos import Gizmos, Pose, gizmo_target
from ._loop import ControlLoop
from ._readout import error_text, state_text, timing_text
from ._robot_nodes import RobotNodes, add_label, side_by_side
from ._server import FRAME, WORDS, Driving, show_texts
from ._step import Controller, stacked
from ._surroundings import add_surroundings

if TYPE_CHECKING:
    from viser import ClientHandle, GuiEvent

_APART = 0.6
"""Least distance between robots, in sizes of a robot, so that they can move."""


class BatchView(Driving):
    """Page that runs a batch of robots; ``serve_batch`` says what it has."""

    def __init__(
        self,
        robot: Robot,
        controllers: Mapping[str, Controller],
        q0: Float[np.ndarray, "B nq"],
        *,
        dt: float,
        host: str,
        port: int,
    ) -> None:
        """Start the server and the loop."""
        self.names, self._robot = tuple(controllers), robot
        self.loop = ControlLoop(robot, stacked(tuple(controllers.values())), dt=dt, q0=jnp.asarray(q0))
        super().__init__(host, port, "osik-jax")
        shapes = robot_parts(robot)
        span = np.concatenate([shapes.corners(data) for data in mujoco_poses(robot, q0)])
        size = float(np.linalg.norm(np.ptp(span, axis=0)))
        offsets = side_by_side(span, len(q0), least=_APART * size)
        seen = np.concatenate([span + offset for offset in offsets])
        add_surroundings(self._server, seen, floor_height(robot, shapes, mujoco_poses(robot, q0)))
        self._nodes, self._gizmos = [], []
        for lane, (name, offset) in enumerate(zip(self.names, offsets, strict=True)):
            node = f"robot {name}"
            self._nodes.append(RobotNodes(self._server.scene, robot, name=node, offset=offset))
            add_label(self._server.scene, name, span + offset)
            drag = self._dragging(lane)
            self._gizmos.append(Gizmos(self._server.scene, size, drag, below=f"/{node}"))
        self._told: tuple[Any, list[dict[str, Task]]] = (None, [])
        self._add_panel()
        self._server.on_client_disconnect(self._gone)
        self.loop.start()
        self._thread.start()

    def aim(self, robot: str, task: str, target: Any) -> None:
        """Set the target of a task of one robot.

        Raises:
            KeyError: no such robot or task.
            TypeError, ValueError: no such target.
        """
        if robot not in self.names:
            raise unknown_name("robot", robot, self.names)
        lane = self.names.index(robot)
        if task not in self._tasks[lane]:
            raise unknown_name("task", task, tuple(self._tasks[lane]))
        self._retarget(task, lane, target, together=False, owner=None)

    @property
    def _tasks(self) -> list[dict[str, Task]]:
        """Return the current tasks of each robot."""
        controller = self.loop.controller
        if self._told[0] is not controller:
            plain = jax.tree.map(np.asarray, dict(controller.tasks))
            self._told = controller, [jax.tree.map(lambda a, k=k: a[k], plain) for k in range(len(self.names))]
        return self._told[1]

    def _add_panel(self) -> None:
        gui = self._server.gui
        self._state, self._timing = gui.add_markdown(""), gui.add_markdown("")
        buttons = gui.add_button_group("", ("Pause", "Reset"))
        self._together = gui.add_checkbox("A handle moves those of all robots", initial_value=True)
        self._errors = gui.add_markdown("")

        @buttons.on_click
        def _(event: GuiEvent[Any]) -> None:
            if event.target.value == "Reset":
                self.loop.reset()
            else:
                self.loop.resume() if self.loop.snapshot.paused else self.loop.pause()

    def _run(self) -> None:
        count = 0
        while not self._end.wait(FRAME):
            with self._server.atomic():
                for lane, data in enumerate(mujoco_poses(self._robot, self.loop.snapshot.q)):
                    self._nodes[lane].place(data)
                    self._gizmos[lane].show(self._tasks[lane])
            if count % WORDS == 0:
                self._tell()
            count += 1

    def _tell(self) -> None:
        snapshot = self.loop.snapshot
        texts = (state_text(snapshot), timing_text(snapshot, self.loop.timing), self._table())
        show_texts(zip((self._state, self._timing, self._errors), texts, strict=True))

    def _table(self) -> str:
        """Return a table of all tasks' errors for all robots."""
        errors = self.loop.snapshot.errors
        rows = [
            f"| {name} | "
            + " | ".join(error_text(t, errors[name][k] if name in errors else None) for k, t in tasks)
            + " |"
            for name in self._tasks[0]
            if (tasks := [(lane, own[name]) for lane, own in enumerate(self._tasks)])
        ]
        return "\n".join([f"| error | {' | '.join(self.names)} |", "|:--|" + "--:|" * len(self.names), *rows])

    def _dragging(self, lane: int) -> Any:
        """Return the callback for a drag of one of this robot's handles."""

        def drag(name: str, pose: Pose, visitor: int, phase: str) -> None:
            if phase != "end":
                target = gizmo_target(self._tasks[lane][name], pose)
                self._retarget(name, lane, target, together=self._together.value, owner=visitor)
            else:
                self._let_go(visitor)

        return drag

    def _retarget(self, name: str, lane: int, target: Any, *, together: bool, owner: int | None) -> None:
        """Set the target of the robot in a lane; if ``together``, move those of the others by the same displacement."""
        own: Any = self._tasks[lane][name]
        new = own.replace(target=target)
        others: list[Any] = [tasks[name] for tasks in self._tasks]
        each = [_displaced(task, own, new) if together else task.target for task in others]
        each[lane] = jax.tree.map(np.asarray, new.target)
        self.loop.aim(name, jax.tree.map(lambda *rows: np.stack(rows), *each), owner=owner)

    def _gone(self, client: ClientHandle) -> None:
        """Release the handles of a visitor who closed the page; the robots stop where they are."""
        for gizmos in self._gizmos:
            gizmos.drop(client.client_id)
        self.loop.release(client.client_id)


def _displaced(task: Task, led: Task, new: Task) -> Any:
    """Return a task's target, moved and rotated as the target of a dragged task was from ``led`` to ``new``."""
    grips = [one.grip() for one in (task, led, new)]
    (position, rotation), (old, turned), (there, turn) = (grip for grip in grips if grip is not None)
    turn = np.eye(3) if rotation is None or turned is None or turn is None else turn @ turned.T @ rotation
    return task.gripped(np.asarray(position + there - old), np.asarray(turn))


def serve_batch(
    robot: Robot,
    tasks: Mapping[str, Mapping[str, Task]],
    *,
    scheme: Scheme | None = None,
    limits: Limits | None = None,
    dt: float = 0.005,
    q0: Float[Array, "B nq"] | Float[Array, " nq"] | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    open_browser: bool = False,
) -> BatchView:
    """Run several copies of a robot in one vmapped step and show them side by side.

    Each has its own numbers of one controller. Arguments that are not named here are those of ``serve``, and hold for
    all copies; so are exceptions.

    Args:
        tasks: of each copy by its name, such as ``{"gain 5": {"hand": ...}, "gain 50": {"hand": ...}}``. All have tasks
            of the same names and kinds, whose numbers (targets, weights, gains) differ.
        q0: configurations at the start [m, rad], of each or of all; default: ``robot.q0``. (B, nq) or (nq,)

    Returns:
        The view, with ``url``, ``wait()`` and ``stop()`` as in ``serve``.

        - ``names``: of the robots, in the order of the batch.
        - ``aim(robot, task, target)``: sets the target of a task of one robot.
        - ``loop``: runs the controller; its numbers, targets and configurations have a leading axis.

    Raises:
        TypeError, ValueError: no copies, or tasks that differ in more than numbers.
    """
    if not tasks:
        raise OsikValueError("there are no robots: tasks is empty")
    check_setting("serve_batch(robot, tasks)", robot, scheme, dt)
    given = checked_limits(robot, limits) or ()
    for own in tasks.values():
        check_tasks(own, robot)
    start = np.asarray(robot.q0 if q0 is None else q0)
    if start.shape not in ((robot.nq,), (len(tasks), robot.nq)):
        raise OsikValueError(f"q0 has shape {start.shape}, expected ({robot.nq},) or ({len(tasks)}, {robot.nq})")
    if scheme is None:
        scheme = scheme_for(next(iter(tasks.values())), robot.q0.dtype)
    controllers = {name: Controller(dict(own), scheme, given) for name, own in tasks.items()}
    q0s = np.broadcast_to(start, (len(tasks), robot.nq)).copy()
    view = BatchView(robot, controllers, q0s, dt=dt, host=host, port=port)
    return view.opened(open_browser)
