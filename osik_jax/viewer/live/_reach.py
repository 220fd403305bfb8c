"""Page with a robot and a slice of a frame's reachability map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from ..._errors import OsikTypeError, OsikValueError, unknown_name
from ...reachability._map import ReachabilityMap
from ...reachability._slices import NOTHING, cell_edges, nearest, share_colors, slice_colors
from ...robot import Robot
from ...robot._mujoco import home_poses, mujoco_poses
from .._parts import robot_parts
from ._robot_nodes import RobotNodes
from ._server import FRAME, Served
from ._surroundings import add_surroundings

if TYPE_CHECKING:
    from viser import GuiEvent, ImageHandle, SceneClickEvent

Axis = Literal["x", "y", "z"]
_AXES = ("x", "y", "z")
_PIXELS = 768
"""Pixels along the longer side of a slice; many pixels per cell keep cells sharp."""
_SOLID, _FAINT = 210, 90
"""Alpha of reached cells, and of cells without a solution, through which the robot is visible."""


class Slice(NamedTuple):
    """Slice as a picture in space; rows go along its second axis, columns along its first."""

    image: UInt8[np.ndarray, "h w 4"]  # red, green, blue, alpha
    center: Float[np.ndarray, "3"]  # of the picture, world axes [m]
    size: tuple[float, float]  # along the first axis and the second [m]. (2,)
    wxyz: Float[np.ndarray, "4"]  # from the picture's axes to world axes


class ReachView(Served):
    """Page that shows a slice of a map; ``serve_reach`` says what it has."""

    def __init__(self, robot: Robot, found: ReachabilityMap, *, host: str, port: int) -> None:
        """Start the server."""
        super().__init__(host, port, f"Reach of {found.frame}")
        self.map, self._robot = found, robot
        self._axes = found.axes
        corners = robot_parts(robot).corners(home_poses(robot))
        seen = np.concatenate([corners, found.positions[found.reached.any(-1)]])
        add_surroundings(self._server, seen, float(seen[:, 2].min()))
        self._nodes = RobotNodes(self._server.scene, robot)
        self._picture: ImageHandle | None = None
        self._drawn: tuple[int, int] | None = None
        self._cell: tuple[int, int, int] | None = None
        self._placed: tuple[int, int, int] | None = None
        self._add_panel()
        self._server.scene.on_click()(self._clicked)
        self._thread.start()

    def show(self, across: Axis, at: float) -> None:
        """Show the slice across an axis at the nearest coordinate [m].

        Raises:
            KeyError: no such axis.
            ValueError: no finite number.
        """
        if across not in _AXES:
            raise unknown_name("axis", across, _AXES)
        if not np.isfinite(at):
            raise OsikValueError(f"at is {at!r}; it is a coordinate [m]")
        axis = self._axes[_AXES.index(across)]
        slider = self._sliders[across]
        slider.value = min(max(float(axis[np.abs(axis - at).argmin()]), slider.min), slider.max)
        self._across.value = across

    def stand(self, position: Sequence[float] | None) -> bool:
        """Show the most manipulable configuration at the nearest grid position [m]; None: home.

        Returns:
            Whether the map has one; else the robot stays where it is.

        Raises:
            ValueError: no point.
        """
        cell = None if position is None else nearest(self._axes, position)
        if cell is not None and not self.map.reached[cell].any():
            return False
        self._cell = cell
        return True

    def _add_panel(self) -> None:
        gui, found = self._server.gui, self.map
        spot = nearest(self._axes, found.links[0])
        flat = next((name for name, axis in zip(_AXES, self._axes, strict=True) if len(axis) == 1), "y")
        self._across = gui.add_dropdown("Slice across", _AXES, initial_value=flat)
        self._sliders = {
            name: _slider(gui, name, axis, float(axis[at]), visible=name == flat)
            for name, axis, at in zip(_AXES, self._axes, spot, strict=True)
        }
        self._words = gui.add_markdown("")
        gui.add_markdown(f"Of {len(found.rotations)} orientations, {found.frame} reaches")
        gui.add_image(_legend(), format="png")
        gui.add_markdown("0 % (left) to 100 % (right). Grey: none found. Clear: proven out of reach.")
        self._told = gui.add_markdown("Click on the slice: the robot goes there.")
        home = gui.add_button("Robot at home")

        @home.on_click
        def _(_: GuiEvent[Any]) -> None:
            self.stand(None)

    def _run(self) -> None:
        """Run the drawing thread."""
        while not self._end.wait(FRAME):
            self._draw()

    def _draw(self) -> None:
        """Redraw what changed since the last drawing."""
        across = _AXES.index(self._across.value)
        index = int(np.abs(self._axes[across] - self._sliders[_AXES[across]].value).argmin())
        if (across, index) != self._drawn:
            with self._server.atomic():
                self._draw_slice(across, index)
            self._drawn = across, index
        if self._cell != self._placed:
            cell = self._cell
            with self._server.atomic():
                self._draw_robot(cell)
            self._placed = cell

    def _draw_slice(self, across: int, index: int) -> None:
        for name, slider in self._sliders.items():
            slider.visible = name == _AXES[across]
        made = slice_picture(self.map, across, index)
        if self._picture is None or self._drawn is None or self._drawn[0] != across:
            self._picture = self._server.scene.add_image(
                "/slice", made.image, *made.size, format="png", cast_shadow=False, receive_shadow=False
            )
            self._picture.wxyz = made.wxyz
        else:
            self._picture.image = made.image
        self._picture.position = made.center
        self._words.content = slice_words(self.map, across, index)

    def _draw_robot(self, cell: tuple[int, int, int] | None) -> None:
        q = np.asarray(self._robot.q0) if cell is None else self.map.q[cell]
        self._nodes.place(next(mujoco_poses(self._robot, q)))
        self._told.content = "The robot is at home." if cell is None else _cell_words(self.map, cell)

    def _clicked(self, event: SceneClickEvent) -> None:
        """Handle a visitor's click into the scene, on the slice or beside it."""
        if self._drawn is None:
            return
        across, index = self._drawn
        origin, way = np.asarray(event.ray_origin), np.asarray(event.ray_direction)
        ahead = (self._axes[across][index] - origin[across]) / way[across] if way[across] else -1.0
        point = origin + ahead * way
        low, high = np.array([edges[[0, -1]] for edges in cell_edges(self._axes)]).T
        if ahead <= 0.0 or not np.all((point >= low) & (point <= high)):
            return
        if not self.stand(point.tolist()):
            self._told.content = "Nothing is reached there."


def slice_picture(found: ReachabilityMap, across: int, index: int) -> Slice:
    """Return the slice across an axis at one coordinate, as a page draws it."""
    first, second = (i for i in range(3) if i != across)
    edges = cell_edges(found.axes)
    length = {i: float(edges[i][-1] - edges[i][0]) for i in (first, second)}
    cells = [_cell_of_pixels(edges[i], _PIXELS * length[i] / max(length.values())) for i in (second, first)]
    share, beyond = (np.take(field, index, across).T for field in (found.share, found.beyond_reach))
    colors = slice_colors(share, beyond)
    colors[..., 3] = np.where(colors[..., 3] > 0, np.where(share > 0.0, _SOLID, _FAINT), 0)
    center = np.array([0.5 * (edges[i][0] + edges[i][-1]) for i in range(3)])
    center[across] = found.axes[across][index]
    turn, wxyz = np.zeros((3, 3)), np.empty(4)
    turn[first, 0] = turn[second, 1] = 1.0
    turn[:, 2] = np.cross(turn[:, 0], turn[:, 1])
    mujoco.mju_mat2Quat(wxyz, turn.ravel())
    return Slice(colors[np.ix_(*cells)], center, (length[first], length[second]), wxyz)


def _cell_of_pixels(edges: Float[np.ndarray, " n_1"], number: float) -> np.ndarray:
    """Return the index of the cell that each pixel of a row belongs to."""
    count = max(round(number), 1)
    places = edges[0] + (np.arange(count) + 0.5) / count * (edges[-1] - edges[0])
    return np.clip(np.searchsorted(edges, places) - 1, 0, len(edges) - 2)


def slice_words(found: ReachabilityMap, across: int, index: int) -> str:
    """Return a line of text that says how much of a slice is reached."""
    share, beyond = (np.take(field, index, across) for field in (found.share, found.beyond_reach > 0.0))
    at, some = found.axes[across][index], share > 0.0
    mean = f", on average in {share[some].mean():.0%} of the orientations" if some.any() else ""
    return (
        f"**{_AXES[across]} = {at:.3f} m**: {some.sum():,} of {some.size:,} positions reached{mean}; "
        f"{beyond.sum():,} proven out of reach"
    )


def _cell_words(found: ReachabilityMap, cell: tuple[int, int, int]) -> str:
    place = " ".join(f"{value:.3f}" for value in found.positions[cell])
    return (
        f"At **{place}** m: {found.reached[cell].sum()} of {len(found.rotations)} orientations reached; manipulability "
        f"{found.manipulability[cell]:.3g}, of the configuration shown"
    )


def _slider(gui: Any, name: str, axis: Float[np.ndarray, " n"], at: float, *, visible: bool) -> Any:
    """Return a slider over the coordinates of an axis; it is disabled if the axis has one coordinate."""
    spacing = float(np.diff(axis).min()) if len(axis) > 1 else 1.0
    digits = max(3, int(np.ceil(1.0 - np.log10(spacing))))
    step, (low, high, start) = 10.0**-digits, (round(float(value), digits) for value in (axis[0], axis[-1], at))
    return gui.add_slider(
        f"{name} [m]", low, max(high, low + step), step, start, disabled=len(axis) == 1, visible=visible
    )


def _legend() -> UInt8[np.ndarray, "h w 4"]:
    from matplotlib.colors import to_rgba

    strip = np.concatenate([np.tile(to_rgba(NOTHING), (24, 1)), share_colors()(np.linspace(0.0, 1.0, 300))])
    return np.round(255.0 * np.broadcast_to(strip, (14, *strip.shape))).astype(np.uint8)


def serve_reach(
    robot: Robot,
    found: ReachabilityMap,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    open_browser: bool = False,
) -> ReachView:
    """Show a reachability map: the robot, and a slice coloured by the share of orientations that are reached.

    The panel has the axis and the place of the slice. A click on the slice puts the robot into the configuration that
    the map has there. Arguments that are not named here, and exceptions, are those of ``serve``.

    Args:
        robot: the robot of the map.
        found: from ``reachability_map`` or ``load_map``.

    Returns:
        The view, with ``url``, ``wait()`` and ``stop()`` as in ``serve``.

        - ``show(across, at)``: shows the slice across an axis, ``"x"``, ``"y"`` or ``"z"``, at the nearest coordinate
            [m].
        - ``stand(position)``: shows the map's most manipulable configuration at the nearest grid position [m]; None:
            home. Returns whether the map has one.
        - ``map``: what is shown.

    Raises:
        TypeError: ``found`` is no map.
        ValueError: the map is of another robot.
    """
    check_map(robot, found)
    return ReachView(robot, found, host=host, port=port).opened(open_browser)


def check_map(robot: Robot, found: ReachabilityMap) -> None:
    """Raise TypeError unless the argument is a map, ValueError if it is of another robot."""
    if not isinstance(found, ReachabilityMap):
        raise OsikTypeError(f"found is {found!r}; it is a ReachabilityMap, of reachability_map or load_map")
    if found.q.shape[-1] != robot.nq or found.frame not in robot.frame_names:
        raise OsikValueError(
            f"the map is of another robot: of {found.frame!r}, with configurations of {found.q.shape[-1]} numbers; "
            f"this one's have {robot.nq}, and its frames are {', '.join(robot.frame_names)}"
        )
