"""A film: a G1 whose hand is sent out of reach, ours beside mink's, with the same target, tasks and weights."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import jax
import numpy as np

import osik_jax as osik
from osik_jax.robot._mujoco import mujoco_poses
from osik_jax.viewer._animate import paint_over, write_gif
from osik_jax.viewer._overlay import INK, ORANGE, Canvas
from osik_jax.viewer._parts import RobotParts, floor_height, robot_parts
from osik_jax.viewer._raycast import RayCaster
from osik_jax.viewer._stage import Camera, Stage, frame_camera

from ..peers.ours import places, standing
from ..robots import workload
from ..workload import DT, Workload
from ._cases import Case, cases, without_turning
from ._motion import Entrant, Motion, motions

FILM = Path(__file__).parents[2] / "docs" / "images" / "beyond_reach.gif"
GAIN = 200.0
STEPS = 100
"""That are filmed, each of them: an arm that turns round at each step is still in every second one."""
SLOWER = 8
"""How many times slower than it was the film shows it; DT times this is a whole number of hundredths, as GIFs count."""
SIZE = (600, 350)
NAMES = {"mink": "mink, as it comes", "weighted": "osik-jax, as it comes"}
APART = 0.62
"""How far each robot is from the middle [m]."""
AZIMUTH, ELEVATION, LENS = -48.0, 12.0, 10.0


def film(path: Path = FILM) -> Path:
    """Runs both, films them and writes a GIF."""
    jax.config.update("jax_enable_x64", True)
    work = without_turning(workload("g1"), posture=True)
    case = next(case for case in cases(work) if case.name == "beyond")
    found = {solver: _motion(solver, work, case) for solver in ("mink", "weighted")}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_gif(path, _pictures(found, work, case), SLOWER * DT)
    return path


def _motion(solver: str, work: Workload, case: Case) -> Motion:
    entrant = Entrant("g1", solver, "float64", True)
    return next(motion for motion in motions(entrant, work, [case]) if motion.gain == GAIN)


def _pictures(found: dict[str, Motion], work: Workload, case: Case) -> Iterator[np.ndarray]:
    """Each with both robots, their target, who they are and how fast their fastest joints turn."""
    robot = standing(work)
    shape = robot_parts(robot)
    order = places(robot, work)
    paths = [_own(motion.path, order)[: STEPS + 1] for motion in found.values()]
    across = Camera((0.0, 0.0, 0.0), 1.0, AZIMUTH, 0.0, 1.0).axes[0]
    shifts = np.array([-APART * across, APART * across])
    goals = case.hand[0] + shifts
    floor = floor_height(robot, shape, mujoco_poses(robot, paths[0][:1]))
    seen = [_corners(robot, shape, path, shift) for path, shift in zip(paths, shifts, strict=True)]
    window = (0.05, 0.95, 0.13, 0.86)
    camera = frame_camera(np.concatenate([*seen, goals]), SIZE, AZIMUTH, ELEVATION, window, lens=LENS)
    stage = Stage([shape, shape])
    drawer = RayCaster(stage, camera, SIZE, floor=floor)
    middles = [float(np.mean(camera.project(points, SIZE)[:, 0])) for points in seen]
    speeds = [_shares(motion.path, work.velocity) for motion in found.values()]
    for frame, sources in enumerate(zip(*(mujoco_poses(robot, path) for path in paths), strict=True)):
        canvas = Canvas(SIZE, scale=SIZE[1] / 450)
        _mark(canvas, camera.project(goals, SIZE))
        for x, solver, speed in zip(middles, found, speeds, strict=True):
            words = f"{NAMES[solver]}\nfastest joint: {speed[frame]:3.0f} % of its top speed"
            canvas.page.text(x, SIZE[1] - 14, words, ha="center", va="bottom", fontsize=9.5, color=INK)
        canvas.title(16, 28, "The target of the hand (ring) is 0.35 m out of reach", fontsize=11)
        clock = f"t = {frame * DT:4.2f} s, {SLOWER} times slower"
        canvas.page.text(SIZE[0] - 16, 28, clock, ha="right", fontsize=9, color=INK, family="monospace")
        yield paint_over(drawer.image(stage.pose(sources, shifts), None), canvas.picture())


def _corners(robot: osik.Robot, shape: RobotParts, path: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """What the camera has to see, (points, 3)."""
    return np.concatenate([shape.corners(source) for source in mujoco_poses(robot, path[::10])]) + shift


def _own(path: np.ndarray, order: list[int]) -> np.ndarray:
    """Our configurations of canonical ones."""
    found = np.zeros_like(path)
    found[:, order] = path
    return found


def _shares(path: np.ndarray, top: np.ndarray) -> np.ndarray:
    """The fastest joint's share of its top speed in the steps around each configuration [%]."""
    each = [np.abs((after - before)[7:] / DT / top).max() for before, after in pairwise(path)]
    window = 4
    return 1e2 * np.array([max(each[max(0, k - window) : k + window]) for k in range(len(path) - 1)])


def _mark(canvas: Canvas, goals: np.ndarray) -> None:
    for x, y in goals:
        canvas.page.plot([x], [y], "o", ms=13, mfc="none", mec=ORANGE, mew=2.4)
        canvas.page.plot([x], [y], "o", ms=3.5, color=ORANGE)
