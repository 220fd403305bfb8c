"""A stage for robots on matplotlib's 3-D axes: camera, ground, light, and the things drawn on it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from mpl_toolkits.mplot3d import Axes3D, proj3d
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from ..robot import Robot
from ._mujoco import mujoco_poses, robot_com
from ._parts import Style, robot_parts
from ._shapes import Quads, robot_surface

GREEN, ORANGE, BLUE, INK = "#2a9d62", "#e8590c", "#1c6fb8", "#2b2f36"
_BACKGROUND = np.array([1.0, 1.0, 1.0])
_TILES = np.array([[0.925, 0.937, 0.952], [0.965, 0.972, 0.982]])
_SHADOW = np.array([0.80, 0.82, 0.85])
_TO_LIGHT = np.array([0.35, -0.45, 0.82]) / np.linalg.norm([0.35, -0.45, 0.82])
_FOCAL_LENGTH, _FULL_VIEW = 2.2, 1.5  # at this zoom a ball that fills the axes' limits fills the axes
_GROUND_LAYER, _SHADOW_LAYER, _MARK_LAYER, _ROBOT_LAYER, _FRONT_LAYER = 0.0, 1.0, 2.0, 3.0, 4.0


def normals(quads: Quads) -> Float[np.ndarray, "faces 3"]:
    """Outward unit normals of quads that run counter-clockwise seen from outside."""
    out = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
    return out / np.maximum(np.linalg.norm(out, axis=-1, keepdims=True), 1e-12)


def shade(quads: Quads, colors: Float[np.ndarray, "faces 4"]) -> Float[np.ndarray, "faces 4"]:
    """Colours under a bright sky, one lamp with a soft highlight, and light thrown back by the ground."""
    n = normals(quads)
    lamp = np.clip(n @ _TO_LIGHT, 0.0, 1.0)
    light = 0.50 + 0.14 * n[:, 2] + 0.42 * lamp
    lit = colors.copy()
    lit[:, :3] = np.clip(colors[:, :3] * light[:, None] + 0.10 * lamp[:, None] ** 8, 0.0, 1.0)
    return lit


class Surface(Poly3DCollection):
    """Closed surfaces: faces that look away from the camera are left out, the rest is drawn far to near.

    Attributes:
        quads: all faces [m]. (faces, 4, 3)
    """

    def __init__(self, quads: Quads, colors: Float[np.ndarray, "faces 4"], *, zorder: float = _ROBOT_LAYER) -> None:
        """Takes the faces and their unlit colours."""
        super().__init__(quads, closed=False, linewidths=0.35, zorder=zorder)
        self.place(quads, colors)

    def place(self, quads: Quads, colors: Float[np.ndarray, "faces 4"]) -> None:
        """Moves the faces and lights them anew."""
        self.quads, self._lit = quads, shade(quads, colors)

    def do_3d_projection(self) -> float:
        """Keeps the faces turned to the camera; matplotlib calls this as it draws."""
        if isinstance(self.axes, Axes3D):
            self._show(_faces_camera(self.quads, self.axes.get_proj()))
        return super().do_3d_projection()

    def _show(self, seen: np.ndarray) -> None:
        self.set_verts(list(self.quads[seen]), closed=False)
        self.set_facecolor(self._lit[seen])
        self.set_edgecolor(self._lit[seen])


def _faces_camera(quads: Quads, projection: Float[np.ndarray, "4 4"]) -> np.ndarray:
    """Faces whose corners still run counter-clockwise on the screen."""
    x, y, _ = proj3d.proj_transform(quads[..., 0].ravel(), quads[..., 1].ravel(), quads[..., 2].ravel(), projection)
    x, y = np.reshape(x, quads.shape[:2]), np.reshape(y, quads.shape[:2])
    turn = (x[:, 2] - x[:, 0]) * (y[:, 3] - y[:, 1]) - (y[:, 2] - y[:, 0]) * (x[:, 3] - x[:, 1])
    return turn > 0.0


def scene_axes(
    figure: Figure,
    *,
    center: Sequence[float],
    radius: float,
    azimuth: float = 30.0,
    elevation: float = 14.0,
    ground: float | None = 0.0,
) -> Axes3D:
    """3-D axes that fill the figure, without frame or ticks, looking at a ball of the given centre and radius [m].

    Args:
        figure: the figure to draw in; pyplot is not involved.
        center: what the camera looks at [m].
        radius: of what has to be seen [m].
        azimuth: of the camera about the vertical, 0 from +x [deg].
        elevation: of the camera above the horizon [deg].
        ground: height of the floor [m]; ``None`` draws none.
    """
    width, height = figure.get_size_inches()
    side = max(width, height)
    square = (0.5 - 0.5 * side / width, 0.5 - 0.5 * side / height, side / width, side / height)
    axes = Axes3D(figure, rect=square, computed_zorder=False)
    figure.add_axes(axes)
    axes.set_axis_off()
    axes.patch.set_alpha(0.0)
    axes.set_proj_type("persp", focal_length=_FOCAL_LENGTH)
    for set_limits, middle in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), center, strict=True):
        set_limits(middle - radius, middle + radius)
    axes.set_box_aspect((1.0, 1.0, 1.0), zoom=_FULL_VIEW * min(width, height) / side)
    axes.view_init(elev=elevation, azim=azimuth)
    if ground is not None:
        draw_ground(axes, center=center, height=ground, radius=5.0 * radius, spacing=radius / 2.5)
    return axes


def draw_ground(
    axes: Axes3D, *, center: Sequence[float], height: float = 0.0, radius: float = 2.0, spacing: float = 0.1
) -> Poly3DCollection:
    """A chequered floor [m] that fades out towards ``radius``."""
    count = int(np.ceil(radius / spacing))
    i, j = (a.ravel() for a in np.meshgrid(np.arange(-count, count), np.arange(-count, count), indexing="ij"))
    origin = np.round(np.asarray(center[:2]) / spacing) * spacing
    offsets = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    xy = origin + (np.stack([i, j], -1)[:, None, :] + offsets) * spacing
    tiles = np.concatenate([xy, np.full((*xy.shape[:2], 1), height)], -1)
    distance = np.linalg.norm(xy.mean(1) - np.asarray(center[:2]), axis=-1) / radius
    fade = np.clip(1.15 * distance, 0.0, 1.0)[:, None] ** 1.5
    colors = (1.0 - fade) * _TILES[(i + j) % 2] + fade * _BACKGROUND
    seen = distance < 1.0
    floor = Poly3DCollection(
        tiles[seen], facecolors=colors[seen], edgecolors=colors[seen], linewidths=0.3, zorder=_GROUND_LAYER
    )
    axes.add_collection3d(floor, autolim=False)
    return floor


def draw_robot(
    axes: Axes3D,
    robot: Robot,
    q: Float[np.ndarray, " nq"],
    *,
    color: str | None = None,
    alpha: float = 1.0,
    style: Style = "auto",
    detail: int = 5,
    shadow: float | None = None,
) -> Surface:
    """Draws a robot: its sphere, capsule, cylinder, box, ellipsoid and mesh geoms, or sticks where it has none.

    Args:
        axes: 3-D axes, best from ``scene_axes``.
        robot: the robot.
        q: configuration. (nq,)
        color: one colour for all of it, in place of the model's own.
        alpha: opacity, 0 to 1.
        style: ``"geoms"``, ``"sticks"``, or ``"auto"``.
        detail: fineness of round shapes; a sphere has 4 * detail meridians.
        shadow: height of the ground [m] that it throws a shadow on; ``None`` draws no shadow.

    Raises:
        ValueError: ``style="geoms"`` of a model that has none to draw.
    """
    quads, colors = robot_surface(robot_parts(robot, style=style), next(mujoco_poses(robot, q)), detail)
    colors = colors * [1.0, 1.0, 1.0, alpha]
    if color is not None:
        colors = np.broadcast_to(to_rgba(color, alpha), colors.shape)
    if shadow is not None:
        axes.add_collection3d(shadow_surface(quads, shadow), autolim=False)
    surface = Surface(quads, colors, zorder=_ROBOT_LAYER)
    axes.add_collection3d(surface, autolim=False)
    return surface


def cast_shadow(quads: Quads, height: float) -> Quads:
    """The faces turned to the lamp, thrown onto the ground [m]."""
    lit = quads[normals(quads) @ _TO_LIGHT > 0.0]
    drop = (lit[..., 2:] - height) / _TO_LIGHT[2]
    flat = lit - drop * _TO_LIGHT
    flat[..., 2] = height
    return flat


def shadow_surface(quads: Quads, height: float) -> Poly3DCollection:
    """The shadow of closed surfaces on the ground."""
    return Poly3DCollection(
        cast_shadow(quads, height), facecolors=_SHADOW, edgecolors=_SHADOW, linewidths=0.6, zorder=_SHADOW_LAYER
    )


def draw_polygon(
    axes: Axes3D, vertices: Float[np.ndarray, "m 2"], *, height: float = 0.0, color: str = GREEN
) -> Poly3DCollection:
    """Draws a support polygon on the ground.

    Args:
        axes: 3-D axes, best from ``scene_axes``.
        vertices: its corners in order, in world axes [m]. (m, 2)
        height: of the ground [m].
        color: of the edge; the face is nearly transparent.

    Returns:
        The polygon.
    """
    corners = np.column_stack([vertices, np.full(len(vertices), height)])
    polygon = Poly3DCollection(
        [corners],
        facecolors=[to_rgba(color, 0.22)],
        edgecolors=[to_rgba(color, 0.95)],
        linewidths=1.6,
        zorder=_MARK_LAYER,
    )
    axes.add_collection3d(polygon, autolim=False)
    return polygon


def draw_com(
    axes: Axes3D, com: Float[np.ndarray, "3"], *, height: float = 0.0, color: str = ORANGE
) -> tuple[Line2D, Line2D, Line2D]:
    """Draws the centre of mass, the plumb line below it, and where that meets the ground.

    Args:
        axes: 3-D axes, best from ``scene_axes``.
        com: the centre of mass in world axes [m]. (3,)
        height: of the ground [m].
        color: of all three.

    Returns:
        The ball, the line and the mark on the ground.
    """
    x, y, z = (float(value) for value in com)
    (line,) = axes.plot([x, x], [y, y], [z, height], color=color, lw=1.3, ls=(0, (4, 3)), zorder=_FRONT_LAYER)
    (ball,) = axes.plot(
        [x], [y], [z], marker="o", ms=9, mfc=color, mec="white", mew=1.4, ls="", zorder=_FRONT_LAYER + 1
    )
    (foot,) = axes.plot(
        [x], [y], [height], marker="o", ms=6.5, mfc="white", mec=color, mew=2.0, ls="", zorder=_FRONT_LAYER + 1
    )
    return ball, line, foot


def draw_target(axes: Axes3D, position: Float[np.ndarray, "3"], *, color: str = BLUE) -> Line2D:
    """Draws a cross where something should be.

    Args:
        axes: 3-D axes, best from ``scene_axes``.
        position: in world axes [m]. (3,)
        color: of the cross.
    """
    x, y, z = (float(value) for value in position)
    (mark,) = axes.plot(
        [x], [y], [z], marker="P", ms=10, mfc=color, mec="white", mew=1.2, ls="", zorder=_FRONT_LAYER + 2
    )
    return mark


def draw_trail(axes: Axes3D, points: Float[np.ndarray, "k 3"], *, color: str = BLUE, width: float = 1.8) -> Line2D:
    """A path [m]."""
    (trail,) = axes.plot(*np.asarray(points).T, color=color, lw=width, alpha=0.9, zorder=_FRONT_LAYER)
    return trail


def draw_robot_with_com(
    axes: Axes3D, robot: Robot, q: Float[np.ndarray, " nq"], *, ground: float = 0.0, detail: int = 5
) -> Surface:
    """A robot with its shadow, its centre of mass and the plumb line below it."""
    surface = draw_robot(axes, robot, q, detail=detail, shadow=ground)
    draw_com(axes, robot_com(robot, next(mujoco_poses(robot, q))), height=ground)
    return surface
