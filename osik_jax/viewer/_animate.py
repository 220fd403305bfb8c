"""Motions as GIF or MP4 films."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float
from PIL import Image

from .._errors import OsikValueError
from ..robot import Robot
from ..robot._mujoco import mujoco_frame_pose, mujoco_poses, robot_com
from ._overlay import BLUE, INK, Canvas, ComMark, CurvePanel, polygon_layer
from ._parts import RobotParts, floor_height, robot_parts
from ._raycast import RayCaster
from ._stage import Camera, Stage, frame_camera

Values = Mapping[str, Float[np.ndarray, " T"]]
Polygons = Sequence[Float[np.ndarray, "m 2"]]
Mark = Callable[[int], object]
"""Function that moves what is drawn over the stage to a picture, by its number."""


def animate(
    path: str | Path,
    robot: Robot,
    q: Float[np.ndarray, "T nq"],
    *,
    dt: float,
    frames_per_second: float = 12.5,
    size: tuple[int, int] = (720, 405),
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
        support: vertices of the support polygon [m], one (m, 2) for all times or one a configuration. With it, the
            centre of mass is drawn too.
        trails: frames whose paths are drawn.
        curves: values over time for a panel, by name; one value a configuration. Each (T,)
        wanted: the same for what the controller was asked for, drawn dashed.
        curves_title: title of that panel, with the unit.
        caption: a line at the top.
        azimuth: of the camera about the vertical, 0 from +x [deg].
        elevation: of the camera above the horizon [deg].

    Returns:
        The path written.

    Raises:
        ValueError: the suffix is neither .gif nor .mp4, ffmpeg is missing for .mp4, or q is not (T, nq).
        OSError: the file cannot be written.
    """
    path = Path(path)
    _check_path(path)
    if np.ndim(q) != 2 or len(q) == 0 or np.shape(q)[1] != robot.nq:
        raise OsikValueError(f"q has shape {np.shape(q)}; it is configurations (T, {robot.nq}), one at least")
    stride = max(1, round(1.0 / (frames_per_second * dt)))
    frames = np.arange(0, len(q), stride)
    q, time = np.asarray(q)[frames], frames * dt
    shape, polygons = robot_parts(robot), _each(support, frames)
    seen, com, paths = _survey(robot, q, shape, trails)
    floor = floor_height(robot, shape, mujoco_poses(robot, q))
    corners = np.concatenate([np.zeros((0, 2)), *(polygons or ())])
    seen = np.concatenate([seen, np.column_stack([corners, np.full(len(corners), floor)])])
    window = (0.04, 0.54 if curves else 0.96, 0.10 if caption else 0.04, 0.92)
    camera, canvas = frame_camera(seen, size, azimuth, elevation, window), Canvas(size)
    scale = size[1] / 450
    canvas.title(16, 26 * scale, caption, fontsize=11 * scale)
    marks = [_clock(canvas, time, scale), *(_trail(canvas, camera.project(path, size)) for path in paths)]
    if polygons is not None:
        mark = ComMark(canvas, camera, floor=floor)
        marks.append(lambda frame: mark.place(com[frame]))
    if curves:
        values, dashed = ({name: v[frames] for name, v in group.items()} for group in (curves, wanted or {}))
        marks.append(CurvePanel(canvas, (0.60, 0.32, 0.38, 0.29), curves_title, time, values, dashed).place)
    stage = Stage([shape])
    jobs = zip(
        (stage.pose([source]) for source in mujoco_poses(robot, q)),
        _floor_layers(polygons, camera, size, floor) if polygons is not None else [None] * len(q),
        strict=True,
    )
    pictures = _pictures(RayCaster(stage, camera, size, floor=floor), jobs, canvas, marks)
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


def _survey(
    robot: Robot, q: Float[np.ndarray, "T nq"], shape: RobotParts, trails: Sequence[str]
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Return the points [m] that the camera must see, the centres of mass and the points of each trail."""
    points, com, paths = [], [], []
    for data in mujoco_poses(robot, q):
        points.append(shape.corners(data))
        com.append(robot_com(robot, data))
        paths.append([mujoco_frame_pose(robot, data, name)[0] for name in trails])
    seen = np.concatenate([*points, *(place for place in paths if len(place))])
    return seen, np.array(com), list(np.swapaxes(np.array(paths), 0, 1)) if trails else []


def _clock(canvas: Canvas, time: Float[np.ndarray, " T"], scale: float) -> Mark:
    """Add the time of the picture."""
    clock = canvas.page.text(16, canvas.size[1] - 14 * scale, "", fontsize=9 * scale, color=INK, family="monospace")
    canvas.moving(clock)
    return lambda frame: clock.set_text(f"t = {time[frame]:5.2f} s")


def _trail(canvas: Canvas, path: Float[np.ndarray, "T 2"]) -> Mark:
    """Add the path of a frame up to the present picture [pixels]."""
    (line,) = canvas.page.plot([], [], color=BLUE, lw=2.0, alpha=0.85)
    canvas.moving(line)
    return lambda frame: line.set_data(path[: frame + 1, 0], path[: frame + 1, 1])


def _floor_layers(
    polygons: Polygons, camera: Camera, size: tuple[int, int], floor: float
) -> Iterator[Float[np.ndarray, "height width 4"]]:
    """Yield the support polygon painted on the floor for each picture; it is drawn anew only when it changes."""
    drawn, layer = None, np.zeros((0, 0, 4))
    for vertices in polygons:
        if drawn is None or not np.array_equal(drawn, vertices):
            drawn, layer = vertices, polygon_layer([vertices], camera, size, floor=floor)
        yield layer


def _pictures(
    renderer: RayCaster,
    jobs: Iterable[tuple[mujoco.MjData, np.ndarray | None]],
    canvas: Canvas,
    marks: Sequence[Mark],
) -> Iterator[np.ndarray]:
    """Yield the pictures, (height, width, 3) uint8; the stage is drawn ahead, one picture per core."""
    for frame, base in enumerate(_drawn_ahead(renderer, jobs)):
        for place in marks:
            place(frame)
        yield paint_over(base, canvas.picture())


def _drawn_ahead(renderer: RayCaster, jobs: Iterable[tuple[mujoco.MjData, np.ndarray | None]]) -> Iterator[np.ndarray]:
    cores = os.cpu_count() or 1
    with ThreadPoolExecutor(cores) as pool:
        ahead: deque[Future[np.ndarray]] = deque()
        for job in jobs:
            ahead.append(pool.submit(renderer.image, *job))
            if len(ahead) > cores:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()


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
