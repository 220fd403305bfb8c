"""Pictures of robots side by side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import ArrayLike, Float
from PIL import Image

from ..collision import CollisionShape
from ..collision._table import CoveringSpheres
from ..robot import Robot
from ..robot._mujoco import model_bodies, mujoco_poses, robot_com
from ._animate import paint_over
from ._overlay import BLUE, INK, ORANGE, Canvas, ComMark, polygon_layer
from ._parts import Part, RobotParts, fixed_parts, floor_height, robot_parts
from ._raycast import RayCaster
from ._stage import Camera, Stage, frame_camera

_LONG_LENS = 10.0
"""Camera distance in picture heights for a row of robots: large, so that they look alike."""


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
    spacing: float | None = None,
    size: tuple[int, int] = (1600, 720),
    azimuth: float = 20.0,
    elevation: float = 14.0,
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
        spacing: between neighbours' middles [m]; ``None``: a little more than the widest is wide; 0: all in one place.
        size: width and height [pixels].
        azimuth: of the camera about the vertical, 0 from +x [deg].
        elevation: of the camera above the horizon [deg].
    """
    shape = robot_parts(robot)
    sources = [next(mujoco_poses(robot, q)) for q in configurations]
    floor = floor_height(robot, shape, sources)
    corners = [shape.corners(source) for source in sources]
    shifts = _side_by_side(corners, azimuth, spacing)
    crosses, paths = (
        [np.asarray(points, float) + shift for points, shift in zip(own, shifts, strict=False)]
        for own in (targets, trails)
    )
    fixed = fixed_parts(robot, shapes)
    boxes = fixed.corners(sources[0])
    seen = [np.concatenate([points, boxes]) + shift for points, shift in zip(corners, shifts, strict=True)]
    window = (0.03, 0.97, 0.05, 0.90 if labels else 0.95)
    camera = frame_camera(np.concatenate([*seen, *crosses, *paths]), size, azimuth, elevation, window, lens=_LONG_LENS)
    stage = Stage([shape] * len(sources) + [fixed] * len(sources))
    data = stage.pose([*sources, *sources], np.concatenate([shifts, shifts]))
    moved = [corners + shift[:2] for corners, shift in zip(support or (), shifts, strict=False)]
    base = RayCaster(stage, camera, size, floor=floor).image(data, polygon_layer(moved, camera, size, floor=floor))
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


def sphere_picture(path: str | Path, robot: Robot, spheres: CoveringSpheres) -> Path:
    """Save a picture (.png) of a robot at home, and beside it the spheres that cover its collision shapes."""
    size, azimuth = (1600, 900), 30.0
    figures = [robot_parts(robot), _sphere_parts(robot, spheres)]
    source = next(mujoco_poses(robot, robot.q0))
    corners = [figure.corners(source) for figure in figures]
    shifts = _side_by_side(corners, azimuth, None)
    seen = np.concatenate([points + shift for points, shift in zip(corners, shifts, strict=True)])
    camera = frame_camera(seen, size, azimuth, 14.0, lens=_LONG_LENS)
    floor = float(seen[:, 2].min())
    stage = Stage(figures)
    picture = RayCaster(stage, camera, size, floor=floor).image(stage.pose([source, source], shifts))
    Image.fromarray((255.0 * np.clip(picture, 0.0, 1.0)).astype(np.uint8)).save(path, optimize=True)
    return Path(path)


def _sphere_parts(robot: Robot, spheres: CoveringSpheres) -> RobotParts:
    """Return the covering spheres as parts; neighbouring shapes have different colours."""
    colors = np.array([[0.16, 0.45, 0.75, 1.0], [0.93, 0.55, 0.19, 1.0], [0.35, 0.65, 0.35, 1.0]])
    parts = tuple(
        Part(mujoco.mjtGeom.mjGEOM_SPHERE, np.array([radius, 0.0, 0.0]), colors[shape % len(colors)])
        for radius, shape in zip(spheres.radius, spheres.shape, strict=True)
    )
    bodies = np.array(model_bodies(robot))[spheres.body]
    turns = np.broadcast_to(np.eye(3), (len(parts), 3, 3))
    return RobotParts(robot.mj_model, "geoms", parts, bodies, (spheres.center, turns))


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
