"""Still figures: schemes compared over time, and robots side by side."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import ArrayLike, Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from ..collision import CollisionShape
from ..robot import Robot
from ._animate import paint_over
from ._fixed import fixed_parts
from ._look import Look
from ._mujoco import mujoco_poses, robot_com
from ._opengl import RendererName, make_renderer
from ._outline import floor_height
from ._overlay import BLUE, INK, ORANGE, Canvas, ComMark, polygon_layer
from ._parts import robot_parts
from ._stage import Camera, Stage, frame_camera

SCHEME_COLORS = ("#f08c3a", "#8a8f98", "#1565c0", "#2a9d62", "#7b3fa0")
_BAD = "#d7263d"
_LONG_LENS = 10.0
"""Camera distance in picture heights for a row of robots: large, so that they look alike."""


@dataclasses.dataclass(frozen=True)
class Panel:
    """One plot of ``compare_figure``.

    Attributes:
        title: what is shown, with its unit.
        curves: name of a scheme to values over time. Each (T,)
        floor: lower end of a logarithmic axis; ``None``: a linear axis.
        bound: value of a line that should not be crossed; ``None``: no line.
        above: whether the allowed side is above the line.
        bound_label: label of the line.
        span: least range of a linear axis, so that rounding errors of a constant do not look like curves.
    """

    title: str
    curves: Mapping[str, Float[np.ndarray, " T"]]
    floor: float | None = None
    bound: float | None = None
    above: bool = False
    bound_label: str = ""
    span: float = 1e-3


def compare_figure(
    time: Float[np.ndarray, " T"],
    panels: Sequence[Panel],
    *,
    title: str = "",
    note: str = "",
    colors: Mapping[str, str] | None = None,
) -> Figure:
    """Save a figure that compares schemes over time, with one plot per panel and a common legend.

    Args:
        time: [s]. (T,)
        panels: what to plot.
        title: over all plots.
        note: a line below them.
        colors: of the schemes.
    """
    names = list(dict.fromkeys(name for panel in panels for name in panel.curves))
    palette = dict(zip(names, SCHEME_COLORS, strict=False)) | dict(colors or {})
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.3 * columns, 2.75 * rows + 1.1), dpi=130, facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, panel in zip(grid, panels, strict=False):
        _draw_panel(axes, time, panel, palette)
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    _add_legend(figure, grid, palette, len(panels))
    figure.suptitle(title, x=0.012, y=0.985, ha="left", fontsize=14, weight="bold", color=INK)
    figure.text(0.012, 0.012, note, fontsize=8, color="#5b636d")
    figure.tight_layout(rect=(0.0, 0.03, 1.0, 0.985 if title else 1.0), h_pad=1.6, w_pad=1.6)
    return figure


def _draw_panel(axes: Axes, time: np.ndarray, panel: Panel, palette: Mapping[str, str]) -> None:
    axes.set_title(panel.title, loc="left", fontsize=10.5, color=INK)
    for order, (name, values) in enumerate(panel.curves.items()):
        shown = values if panel.floor is None else np.maximum(np.abs(values), panel.floor)
        width = max(3.8 - 1.2 * order, 1.3)  # curves that coincide stay visible
        axes.plot(time[: len(shown)], shown, color=palette[name], lw=width, zorder=3 + order, label=name)
    if panel.floor is not None:
        axes.set_yscale("log")
        axes.set_ylim(panel.floor, max(axes.get_ylim()[1], 100.0 * panel.floor))
    else:
        _widen(axes, panel.span)
    if panel.bound is not None:
        _draw_bound(axes, panel)
    axes.set_xlim(time[0], time[-1])
    axes.set_xlabel("time [s]", fontsize=9, color=INK)
    _tidy(axes)


def _widen(axes: Axes, span: float) -> None:
    """Widen an axis about its middle to a least range."""
    low, high = axes.get_ylim()
    more = max(span - (high - low), 0.0)
    axes.set_ylim(low - 0.5 * more, high + 0.5 * more)


def _draw_bound(axes: Axes, panel: Panel) -> None:
    """Draw the line of a bound, with its forbidden side tinted."""
    assert panel.bound is not None
    low, high = axes.get_ylim()
    if panel.floor is None:
        # space beyond the bound, so that its line and tint are visible
        room = 0.08 * (max(high, panel.bound) - min(low, panel.bound))
        low, high = min(low, panel.bound - room), max(high, panel.bound) + room
    else:
        high = max(high, 3.0 * panel.bound)
    axes.set_ylim(low, high)
    axes.axhline(panel.bound, color=_BAD, lw=1.1, ls=(0, (5, 3)), zorder=2)
    axes.axhspan(*((low, panel.bound) if panel.above else (panel.bound, high)), color=_BAD, alpha=0.07, lw=0, zorder=1)
    axes.annotate(
        panel.bound_label,
        (1.0, panel.bound),
        xycoords=("axes fraction", "data"),
        xytext=(-4, 3),
        textcoords="offset points",
        ha="right",
        va="bottom",
        fontsize=8,
        color=_BAD,
        zorder=9,
    )


def _tidy(axes: Axes) -> None:
    axes.grid(color="#e3e7ec", lw=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8.5, colors=INK, length=3)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color("#9aa3ad")


def _add_legend(figure: Figure, grid: np.ndarray, palette: Mapping[str, str], used: int) -> None:
    """Add a legend in the empty cell of the grid if there is one, else at the top right."""
    handles, labels = {}, []
    for axes in grid[:used]:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    labels = [name for name in palette if name in handles]
    lines = [handles[name] for name in labels]
    if used < len(grid):
        grid[used].legend(
            lines, labels, loc="center left", fontsize=12, frameon=False, labelcolor=INK, handlelength=2.6
        )
    else:
        figure.legend(
            lines,
            labels,
            loc="upper right",
            bbox_to_anchor=(0.995, 0.995),
            ncols=len(lines),
            fontsize=10,
            frameon=False,
            labelcolor=INK,
        )


def hero_picture(
    path: str | Path,
    robot: Robot,
    configurations: Sequence[Float[ArrayLike, " nq"]],
    *,
    support: Sequence[Float[np.ndarray, "m 2"]] | None = None,
    shapes: Iterable[CollisionShape] = (),
    labels: Sequence[str] = (),
    targets: Sequence[Float[np.ndarray, "k 3"]] = (),
    trails: Sequence[Float[np.ndarray, "n 3"]] = (),
    look: Look | None = None,
    spacing: float | None = None,
    size: tuple[int, int] = (1600, 720),
    azimuth: float = 20.0,
    elevation: float = 14.0,
    renderer: RendererName = "raycast",
) -> Path:
    """Save a picture of one robot at several instants, side by side on one floor.

    Args:
        path: of the picture (.png).
        robot: the robot.
        configurations: one a figure, left to right. Each (nq,)
        support: of each, the vertices of its support polygon [m]; with it the centre of mass is drawn.
        shapes: of the world, drawn with each figure: spheres, capsules, boxes and cylinders.
        labels: a line below each.
        targets: points of each that are marked with a cross, world axes [m]. Each (k, 3)
        trails: path of a point of each, drawn as a line, world axes [m]. Each (n, 3)
        look: what the robot's URDF shows, from ``read_look``.
        spacing: between neighbours' middles [m]; ``None``: a little more than the widest is wide; 0: all in one place.
        size: width and height [pixels].
        azimuth: of the camera about the vertical, 0 from +x [deg].
        elevation: of the camera above the horizon [deg].
        renderer: as in ``animate``.
    """
    shape = robot_parts(robot, look=look)
    sources = [next(mujoco_poses(robot, q)) for q in configurations]
    floor = floor_height(robot, shape, sources)
    corners = [shape.corners(source) for source in sources]
    shifts = _side_by_side(corners, azimuth, spacing)
    crosses, paths = (
        [np.asarray(points, float) + shift for points, shift in zip(own, shifts, strict=False)]
        for own in (targets, trails)
    )
    fixed = fixed_parts(shapes)
    seen = [np.concatenate([points, fixed.corners()]) + shift for points, shift in zip(corners, shifts, strict=True)]
    window = (0.03, 0.97, 0.05, 0.90 if labels else 0.95)
    camera = frame_camera(np.concatenate([*seen, *crosses, *paths]), size, azimuth, elevation, window, lens=_LONG_LENS)
    stage = Stage([shape] * len(sources) + [fixed] * len(sources), camera, floor=floor)
    data = stage.pose([*sources, *sources], np.concatenate([shifts, shifts]))
    drawer = make_renderer(renderer, stage, camera, size, floor=floor)
    moved = [corners + shift[:2] for corners, shift in zip(support or (), shifts, strict=False)]
    base = drawer.image(data, polygon_layer(moved, camera, size, floor=floor))
    canvas = Canvas(size, scale=size[1] / 450)
    for source, shift in zip(sources if support else (), shifts, strict=False):
        ComMark(canvas, camera, floor=floor, moving=False).place(robot_com(robot, source) + shift)
    for path_of_point in paths:
        canvas.page.plot(*camera.project(path_of_point, size).T, color=BLUE, lw=1.6)
    for points in crosses:
        canvas.page.plot(*camera.project(points, size).T, "x", color=ORANGE, ms=9, mew=2.4)
    for label, points in zip(labels, seen, strict=False):
        across = camera.project(points, size)[:, 0]
        x = 0.5 * (across.min() + across.max())
        canvas.page.text(x, size[1] - 0.035 * size[1], label, ha="center", fontsize=10, color=INK)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(paint_over(base, canvas.picture())).save(path, optimize=True)
    return Path(path)


def _side_by_side(
    instants: Sequence[Float[np.ndarray, "n 3"]], azimuth: float, spacing: float | None
) -> Float[np.ndarray, "k 3"]:
    """Return floor offsets [m] that put robots in a row across the camera's view, evenly spaced."""
    right = Camera((0.0, 0.0, 0.0), 1.0, azimuth, 0.0, 1.0).axes[0]
    low = np.array([(points @ right).min() for points in instants])
    high = np.array([(points @ right).max() for points in instants])
    # 8 % more than the widest robot, so that neighbours do not touch
    gap = 1.08 * float((high - low).max()) if spacing is None else spacing
    if gap == 0.0:
        return np.zeros((len(instants), 3))
    places = gap * (np.arange(len(instants)) - 0.5 * (len(instants) - 1))
    return (places - 0.5 * (low + high))[:, None] * right
