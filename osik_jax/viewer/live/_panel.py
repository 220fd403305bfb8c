"""Panel of a page: switches, sliders and readouts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ...limits import NoLimits
from ...saving._controller import read_controller
from ...solvers import Status
from ...tasks import AdaptiveGain, Task
from ._desk import SCHEMES, Desk
from ._loop import Snapshot, Timing
from ._obstacles import NearestPair

if TYPE_CHECKING:
    from viser import GuiEvent, ViserServer

_VISIBLE = 5e-4
"""Distance [m or rad] outside of bounds below which an error counts as inside: it would read as 0 mm outside."""
_WEIGHTS, _GAINS, _PRIORITIES = (-4.0, 6.0), (0.0, 60.0), (1, 6)


class Panel:
    """Controls and readouts of a page."""

    def __init__(self, server: ViserServer, desk: Desk) -> None:
        """Add the panel to a page."""
        self._server, self._desk = server, desk
        gui = server.gui
        self._state = gui.add_markdown("")
        self._timing = gui.add_markdown("")
        self._add_buttons()
        tabs = gui.add_tab_group()
        with tabs.add_tab("Tasks"):
            self._add_tasks()
        with tabs.add_tab("Limits"):
            self._near = gui.add_markdown("")
            self._limits = gui.add_folder("On and off")
        with tabs.add_tab("File"):
            self._add_file()
        self.refill()

    def tell(self, near: NearestPair | None) -> None:
        """Show the current state of the loop, and the nearest pair of shapes."""
        snapshot, session = self._desk.loop.snapshot, self._desk.session
        texts = (
            (self._state, state_text(snapshot)),
            (self._timing, timing_text(snapshot, self._desk.loop.timing)),
            (self._errors, error_table(session.tasks, session.off, snapshot.errors)),
            (self._near, f"{near.names[0]} and {near.names[1]}: {1e3 * near.distance:.0f} mm" if near else ""),
        )
        for handle, text in texts:
            if handle.content != text:  # what is shown already is not sent again
                handle.content = text

    def refill(self) -> None:
        """Show the session after tasks changed or another controller was loaded."""
        session = self._desk.session
        for box in self._boxes:
            box.remove()
        self._boxes.clear()
        with self._switches:
            for name in session.tasks:
                self._add_switch(name, name not in session.off, partial(self._desk.switch, name))
        with self._limits:
            for number, limit in enumerate(session.limits):
                if not isinstance(limit, NoLimits):
                    switch = partial(self._desk.switch_limit, number)
                    self._add_switch(type(limit).__name__, number not in session.limits_off, switch)
        self._chosen.options = tuple(session.tasks)
        title = next((t for t, make in SCHEMES.items() if type(make()) is type(session.scheme)), None)
        if title is not None:
            self._scheme.value = title
        self._show_chosen()

    def _add_buttons(self) -> None:
        gui, loop = self._server.gui, self._desk.loop
        buttons = gui.add_button_group("", ("Pause", "Reset"))

        @buttons.on_click
        def _(event: GuiEvent[Any]) -> None:
            if event.target.value == "Reset":
                loop.reset()
            else:
                loop.resume() if loop.snapshot.paused else loop.pause()

    def _add_tasks(self) -> None:
        gui = self._server.gui
        self._scheme = gui.add_dropdown("Scheme", tuple(SCHEMES), initial_value=next(iter(SCHEMES)))
        self._scheme.on_update(self._guarded(lambda event: self._desk.take_scheme(event.target.value)))
        self._switches = gui.add_folder("On and off")
        self._boxes: list[Any] = []
        with gui.add_folder("Settings"):
            names = tuple(self._desk.session.tasks)
            self._chosen = gui.add_dropdown("Task", names, initial_value=names[0])
            self._weight = gui.add_slider("Weight, 10^", *_WEIGHTS, step=0.1, initial_value=0.0)
            self._gain = gui.add_slider("Gain [1/s]", *_GAINS, step=0.5, initial_value=10.0)
            self._priority = gui.add_slider("Priority", *_PRIORITIES, step=1, initial_value=1)
        self._chosen.on_update(lambda _: self._show_chosen())
        self._weight.on_update(self._guarded(lambda event: self._weigh(event.target.value)))
        self._gain.on_update(self._guarded(lambda event: self._desk.renumber(self._name, gain=event.target.value)))
        self._priority.on_update(self._guarded(lambda event: self._desk.rank(self._name, int(event.target.value))))
        with gui.add_folder("Frames", expand_by_default=False):
            frames = self._desk.session.robot.frame_names
            frame = gui.add_dropdown("Frame", frames, initial_value=frames[0])
            add, remove = gui.add_button("Add a task for it"), gui.add_button("Remove the task chosen above")
        add.on_click(self._guarded(lambda _: (self._desk.add_frame(frame.value), self.refill())))
        remove.on_click(self._guarded(lambda _: (self._desk.remove(self._name), self.refill())))
        self._errors = gui.add_markdown("")

    def _add_file(self) -> None:
        gui = self._server.gui
        save = gui.add_button("Download controller.json")
        load = gui.add_upload_button("Load a controller", mime_type="application/json")
        save.on_click(self._guarded(self._send))
        load.on_upload(self._guarded(lambda event: self._load(event.target.value.content)))

    def _load(self, content: bytes) -> None:
        self._desk.load(read_controller(content, "the file"))
        self.refill()

    def _send(self, event: Any) -> None:
        """Send the controller of what is switched on to the visitor who asked for it."""
        content = self._desk.session.to_text().encode()
        event.client.send_file_download("controller.json", content, save_immediately=True)

    @property
    def _name(self) -> str:
        """Return the name of the chosen task."""
        return self._chosen.value

    def _add_switch(self, name: str, on: bool, switch: Callable[[bool], None]) -> None:
        box = self._server.gui.add_checkbox(name, initial_value=on)
        box.on_update(self._guarded(lambda event: switch(event.target.value)))
        self._boxes.append(box)

    def _weigh(self, exponent: float) -> None:
        """Scale a task's weights so that the largest is the given power of ten."""
        old = np.asarray(self._desk.task(self._name).weight)
        top = float(old.max())
        new = old * (10.0**exponent / top) if top > 0.0 else np.full(old.shape, 10.0**exponent)
        self._desk.renumber(self._name, weight=new)

    def _show_chosen(self) -> None:
        """Set the sliders to the numbers of the chosen task."""
        task = self._desk.task(self._name)
        top, gain = float(np.max(np.asarray(task.weight))), task.gain
        rate = float(np.max(np.asarray(gain.maximum if isinstance(gain, AdaptiveGain) else gain)))
        # the guard shows a weight of 0 at the lower end of the slider
        self._weight.value = float(np.clip(np.log10(max(top, 1e-12)), *_WEIGHTS))
        self._gain.value = float(np.clip(rate, *_GAINS))
        self._priority.value = int(np.clip(task.priority, *_PRIORITIES))

    def _guarded(self, act: Callable[[Any], Any]) -> Callable[[Any], None]:
        """Return a callback that shows errors to the visitor; changes by the panel itself have no client."""

        def answer(event: Any) -> None:
            if event.client is None:
                return
            try:
                act(event)
            except (KeyError, ValueError, TypeError, OSError, ImportError) as error:
                text = str(error.args[0]) if error.args else str(error)
                event.client.add_notification("That does not work", " ".join(text.split()), color="red")
                self.refill()

        return answer


def state_text(snapshot: Snapshot) -> str:
    """Return one line on whether the loop runs, and how well."""
    if snapshot.problem:
        return f"**refused:** {snapshot.problem}"
    if not snapshot.ready:
        return "**compiling the first step …**"
    doing = "**paused**" if snapshot.paused else "**running**"
    if snapshot.preparing:
        doing += " · compiling the change …"
    return doing


def timing_text(snapshot: Snapshot, timing: Timing) -> str:
    """Return status and time of the last step, and the rate of the loop, as text."""
    status = Status(snapshot.status).name.lower().replace("_", " ")
    if not timing.steps:
        return status
    rate = 1.0 / timing.period[0] if timing.period[0] > 0.0 else 0.0
    return f"{status} · step {1e3 * timing.step[0]:.2f} ms · {rate:.0f} Hz, period p99 {1e3 * timing.period[1]:.1f} ms"


def error_table(tasks: Mapping[str, Task], off: frozenset[str], errors: Mapping[str, np.ndarray]) -> str:
    """Return a table of the errors of the active tasks."""
    rows = [f"| {name} | {error_text(task, errors.get(name))} |" for name, task in tasks.items() if name not in off]
    return "\n".join(["| task | error |", "|:--|--:|", *rows])


def error_text(task: Task, error: Float[np.ndarray, " m"] | None) -> str:
    """Return an error with its unit; for an inequality, its violation."""
    if error is None:
        return "…"
    bounds = task.error_bounds()
    if bounds is None:
        return _length_text(task, error)
    lower, upper = (np.asarray(bound) for bound in bounds)
    outside = np.maximum(lower - error, error - upper)
    if outside.max() > _VISIBLE:
        return f"{_length_text(task, np.maximum(outside, 0.0))} outside"
    return f"{-1e3 * outside.max():.0f} mm inside" if task.unit_of("error") == "m" else "inside"


def _length_text(task: Task, error: Float[np.ndarray, " m"]) -> str:
    """Return the length of an error: of rows in metres in mm, of rows in radians in degrees, of others as a number."""
    unit = task.unit_of("error")
    if unit not in ("m", "rad", "m or rad"):
        return f"{np.linalg.norm(error):.3g}"
    lengths = task.are_lengths(len(error))
    parts = [f"{1e3 * np.linalg.norm(error[lengths]):.1f} mm"] if lengths.any() else []
    return ", ".join([*parts, *([] if lengths.all() else [f"{np.rad2deg(np.linalg.norm(error[~lengths])):.1f}°"])])
