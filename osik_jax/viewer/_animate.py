"""Motions as GIF or MP4 films."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float
from PIL import Image

from .._errors import OsikValueError
from ..robot import Robot
from ..robot._mujoco import mujoco_frame_pose, mujoco_poses, robot_com
from ._outline import floor_height
from ._overlay import BLUE, INK, Canvas, ComMark, CurvePanel, PlanPanel, polygon_layer
from ._parts import RobotParts, Style, robot_parts
from ._raycast import RayCaster
from ._stage import Stage, frame_camera

Values = Mapping[str, Float[np.ndarray, " T"]]
Polygons = Sequence[Float[np.ndarray, "m 2"]]


def animate(
    path: str | Path,
    robot: Robot,
    q: Float[np.ndarray, "T nq"],
    *,
    dt: float,
    frames_per_second: float = 12.5,
    size: tuple[int, int] = (720, 405),
    style: Style = "auto",
    support: Polygons | Float[np.ndarray, "m 2"] | None = None,
    trails: Sequence[str] = (),
    curves: Values | None = None,
    wanted: Values | None = None,
    curves_title: str = "",
    caption: str = "",
    azimuth: float = 28.0,
    elevation: float = 13.0,
) -> Path:
    """Write a film of a motion as GIF or MP4, by ray casting, without a display.

    Args:
        path: a ``.gif``, or an ``.mp4`` if the program ffmpeg is installed.
        robot: the robot.
        q: configurations, ``dt`` apart. (T, nq)
        dt: time between two configurations [s].
        frames_per_second: at most so many pictures a second are taken from ``q``.
        size: width and height [pixels].
        style: ``"geoms"``, ``"sticks"``, or ``"auto"``: what its URDF shows, else geoms, else sticks.
        support: vertices of the support polygon [m], one (m, 2) for all times or one a configuration. With it, the
            centre of mass is drawn too, and a panel shows both from above.
        trails: frames whose paths are drawn.
        curves: values over time for a second panel, by name; one value a configuration. Each (T,)
        wanted: the same for what the controller was asked for, drawn dashed.
        curves_title: title of that panel, with the unit.
        caption: a line at the top.
        azimuth: of the camera about the vertical, 0 from +x [deg].
        elevation: of the camera above the horizon [deg].

    Returns:
        The path written.

    Raises:
        ValueError: the suffix is neither .gif nor .mp4, or ffmpeg is missing for .mp4.
        OSError: the file cannot be written.
    """
    path = Path(path)
    _check_path(path)
    stride = max(1, round(1.0 / (frames_per_second * dt)))
    frames = np.arange(0, len(q), stride)
    film = _Film(
        robot,
        np.asarray(q),
        frames,
        frames * dt,
        size,
        robot_parts(robot, style=style),
        _each(support, frames),
        trails,
        curves,
        wanted or {},
        curves_title,
        caption,
        azimuth,
        elevation,
    )
    pictures = film.pictures()
    if path.suffix == ".gif":
        write_gif(path, pictures, stride * dt)
    else:
        _write_mp4(path, pictures, size, 1.0 / (stride * dt))
    return path


def _check_path(path: Path) -> None:
    if path.suffix not in (".gif", ".mp4"):
        raise OsikValueError(f"cannot write {path.name!r}: the suffix has to be .gif or .mp4")
    if path.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise OsikValueError(f"cannot write {path.name!r}: the program ffmpeg is not installed; write a .gif")


def _each(support: Polygons | Float[np.ndarray, "m 2"] | None, frames: np.ndarray) -> Polygons | None:
    """Return one polygon per picture, from one polygon or a sequence."""
    if support is None:
        return None
    if isinstance(support, np.ndarray) and support.ndim == 2:
        return [support] * len(frames)
    return [np.asarray(support[min(k, len(support) - 1)]) for k in frames]


class _Film:
    """Data of an animation that is the same in all pictures."""

    def __init__(
        self,
        robot: Robot,
        q: np.ndarray,
        frames: np.ndarray,
        time: np.ndarray,
        size: tuple[int, int],
        shape: RobotParts,
        support: Polygons | None,
        trails: Sequence[str],
        curves: Values | None,
        wanted: Values,
        curves_title: str,
        caption: str,
        azimuth: float,
        elevation: float,
    ) -> None:
        self._robot, self._q, self._size, self._time = robot, q[frames], size, time
        self._shape = shape
        self._support = support
        points, com, paths = self._survey(trails)
        self._com, self._paths = com, paths
        panels = (support is not None) + bool(curves)
        self._floor = floor_height(robot, shape, mujoco_poses(robot, self._q))
        window = (0.04, 0.54 if panels else 0.96, 0.10 if caption else 0.04, 0.92)
        self._camera = frame_camera(np.concatenate([points, self._on_floor()]), size, azimuth, elevation, window)
        self._stage = Stage([self._shape])
        self._renderer = RayCaster(self._stage, self._camera, size, floor=self._floor)
        self._canvas = Canvas(size)
        self._add_text(caption)
        self._add_marks()
        self._add_panels(curves, wanted, curves_title, frames)
        self._under: tuple[Float[np.ndarray, "m 2"], np.ndarray] | None = None

    def _survey(self, trails: Sequence[str]) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        """Return the points [m] that the camera must see, the centres of mass and the points of each trail."""
        points, com, paths = [], [], []
        for data in mujoco_poses(self._robot, self._q):
            points.append(self._shape.corners(data))
            com.append(robot_com(self._robot, data))
            paths.append([mujoco_frame_pose(self._robot, data, name)[0] for name in trails])
        seen = np.concatenate([*points, *(place for place in paths if len(place))])
        return seen, np.array(com), list(np.swapaxes(np.array(paths), 0, 1)) if trails else []

    def _on_floor(self) -> Float[np.ndarray, "points 3"]:
        """Return the corners of the support polygons on the floor [m]."""
        corners = np.concatenate([np.zeros((0, 2)), *(self._support or ())])
        return np.column_stack([corners, np.full(len(corners), self._floor)])

    def _add_text(self, caption: str) -> None:
        scale = self._size[1] / 450
        self._canvas.title(16, 26 * scale, caption, fontsize=11 * scale)
        self._clock = self._canvas.page.text(
            16, self._size[1] - 14 * scale, "", fontsize=9 * scale, color=INK, family="monospace"
        )
        self._canvas.moving(self._clock)

    def _add_marks(self) -> None:
        self._trail_lines = []
        for path in self._paths:
            (line,) = self._canvas.page.plot([], [], color=BLUE, lw=2.0, alpha=0.85)
            self._canvas.moving(line)
            self._trail_lines.append((line, self._camera.project(path, self._size)))
        self._mark = None if self._support is None else ComMark(self._canvas, self._camera, floor=self._floor)

    def _add_panels(self, curves: Values | None, wanted: Values, title: str, frames: np.ndarray) -> None:
        self._panels: list[PlanPanel | CurvePanel] = []
        if self._support is not None:
            self._panels.append(PlanPanel(self._canvas, (0.60, 0.53, 0.38, 0.36), self._support, self._com))
        if curves:
            values, dashed = ({name: v[frames] for name, v in group.items()} for group in (curves, wanted))
            bottom = 0.115 if self._support is not None else 0.32
            place = (0.60, bottom, 0.38, 0.29)
            self._panels.append(CurvePanel(self._canvas, place, title, self._time, values, dashed))

    def pictures(self) -> Iterator[np.ndarray]:
        """Yield the pictures, (height, width, 3) uint8; the stage is drawn ahead, one picture per core."""
        stages = (self._stage.pose([source]) for source in mujoco_poses(self._robot, self._q))
        layers = (self._floor_layer(frame) for frame in range(len(self._q)))
        for frame, base in enumerate(self._draw(zip(stages, layers, strict=True))):
            self._move(frame)
            yield paint_over(base, self._canvas.picture())

    def _draw(self, jobs: Iterable[tuple[mujoco.MjData, np.ndarray | None]]) -> Iterator[np.ndarray]:
        """Yield pictures of the stage in order."""
        cores = os.cpu_count() or 1
        with ThreadPoolExecutor(cores) as pool:
            ahead: deque[Future[np.ndarray]] = deque()
            for job in jobs:
                ahead.append(pool.submit(self._renderer.image, *job))
                if len(ahead) > cores:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()

    def _floor_layer(self, frame: int) -> np.ndarray | None:
        """Return the support polygon painted on the floor, redrawn only when it changes."""
        if self._support is None:
            return None
        vertices = self._support[frame]
        if self._under is None or not np.array_equal(self._under[0], vertices):
            self._under = vertices, polygon_layer([vertices], self._camera, self._size, floor=self._floor)
        return self._under[1]

    def _move(self, frame: int) -> None:
        self._clock.set_text(f"t = {self._time[frame]:5.2f} s")
        for line, path in self._trail_lines:
            line.set_data(path[: frame + 1, 0], path[: frame + 1, 1])
        if self._mark is not None:
            self._mark.place(self._com[frame])
        for panel in self._panels:
            panel.place(frame)


def paint_over(base: Float[np.ndarray, "height width 3"], layer: np.ndarray) -> np.ndarray:
    """Return an RGBA uint8 picture painted over an RGB picture with values 0 to 1, as uint8."""
    below = Image.fromarray((255.0 * base + 0.5).astype(np.uint8)).convert("RGBA")
    return np.asarray(Image.alpha_composite(below, Image.fromarray(layer)).convert("RGB"))


def write_gif(path: Path, pictures: Iterable[np.ndarray], period: float) -> None:
    """Write pictures that are ``period`` [s] apart as a GIF with one palette."""
    images = [Image.fromarray(picture) for picture in pictures]
    picks = [np.asarray(images[i]) for i in np.linspace(0, len(images) - 1, min(4, len(images))).astype(int)]
    palette = Image.fromarray(np.concatenate(picks)).quantize(256, method=Image.Quantize.MEDIANCUT)
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=round(1e3 * period), loop=0, optimize=False)


def _write_mp4(path: Path, pictures: Iterable[np.ndarray], size: tuple[int, int], rate: float) -> None:
    command = ["ffmpeg", "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]
    command += ["-s", f"{size[0]}x{size[1]}", "-r", f"{rate:g}", "-i", "-", "-pix_fmt", "yuv420p", str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stderr is not None
        with contextlib.suppress(BrokenPipeError):  # where it has ended early, it says why
            for picture in pictures:
                process.stdin.write(picture.tobytes())
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        said = process.stderr.read().decode(errors="replace").split("\n")
    if process.returncode:
        raise OSError(f"ffmpeg could not write {path}: {' '.join(filter(None, said)) or process.returncode}")
