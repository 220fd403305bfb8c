"""Retargeting clip by clip: speed, iterations and a judge's figures: python -m benchmarks.retargeting CLIP... [--help].

Clips are what ``load_motion`` reads. Frames a second are those of one process, whose programs are compiled already:
frames over the processor time of the fastest of some runs, reading the person and writing the result's arrays
included; pin the process to one core (``taskset``). Figures are ``Retargeted.report``'s, or with ``--judge`` those of
a judge of your own: a Python file with ``load_model(path, robot, False)``, ``read_limits(path)`` and
``judge(clip, model, robot, limits)``. With ``--peer``, its report of another program's motions stands behind each.

``--live`` takes clips frame by frame instead, as fast as they go, and says how long a frame takes: by the clock, and of
processor time where the machine does other work too. ``--smooth`` takes each clip with each of some smoothnesses.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import numpy as np

from osik_jax import Robot, load_robot
from osik_jax.execution._workers import cores
from osik_jax.retargeting import (
    HumanMotion,
    LiveRetargeter,
    Profile,
    Retargeted,
    Retargeter,
    guess_profile,
    load_motion,
    load_profile,
    report,
)
from osik_jax.retargeting._live import LiveFrame
from osik_jax.retargeting._retarget import as_lane, solve_lanes
from osik_jax.robot.loading import NAMES
from osik_jax.runtime import configure_cpu

from .machine import processor
from .replayed import replay

FIGURES = {
    "slip [mm]": ("slip", "move_mm_max"),
    "float [mm]": ("ground", "contact_float_mm_max"),
    "sole below [mm]": ("ground", "sole_below_mm_max"),
    "penetration [mm]": ("self_penetration", "max_mm"),
    "frames beyond ranges [%]": ("position_limits", "frames_share"),
    "jump frames": ("acceleration", "jump_frames"),
    "acceleration [rad/s²]": ("acceleration", "max_rad_s2"),
    "limb error [mm]": ("tracking", "limb_error_mm_mean"),
    "segments off [deg]": ("tracking", "segment_angle_deg_mean"),
}
"""Columns of the table, and where a judge's report has them."""
_DIGITS = {"slip [mm]": 2, "frames beyond ranges [%]": 0, "jump frames": 0, "acceleration [rad/s²]": 0}


def own_figures(result: Retargeted) -> dict[str, Any]:
    """``report``'s figures, under a judge's names."""
    own = report(result)
    joints, feet, tracking = own["joints"], own["feet"], own["tracking"]
    return {
        "slip": {"move_mm_max": feet["slip_mm_max"]},
        "ground": {"contact_float_mm_max": feet["float_mm_max"], "sole_below_mm_max": feet["below_floor_mm_max"]},
        "self_penetration": {"max_mm": own["shapes"]["penetration_mm_max"]},
        "position_limits": {"frames_share": float(joints["beyond_range_max"] > 1e-4)},
        "speed_limits": {"worst_ratio": joints["speed_over_limit_max"]},
        "acceleration": {"max_rad_s2": joints["acceleration_max"], "jump_frames": joints["jump_frames"]},
        "tracking": {key: tracking[key] for key in ("limb_error_mm_mean", "segment_angle_deg_mean")},
    }


class Judge:
    """A judge of one's own, in a file."""

    def __init__(self, path: str, robot: str, model: str):
        spec = importlib.util.spec_from_file_location("judge", path)
        if spec is None or spec.loader is None:
            raise SystemExit(f"{path} is no Python file")
        self._module: ModuleType = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(self._module)
        self._robot = json.loads(Path(robot).read_text(encoding="utf-8"))
        self._model = self._module.load_model(model, self._robot, False)
        self._limits = self._module.read_limits(model)

    def __call__(self, result: Retargeted) -> dict[str, Any]:
        """The judge's report."""
        clip = {
            "fps": result.motion.fps,
            "qpos": result.motion.qpos,
            "joint_names": result.motion.joint_names,
            "human": result.human,
            "human_names": result.human_names,
            "contact": result.contact,
            "ground": 0.0,
        }
        return self._module.judge(clip, self._model, self._robot, self._limits)


def row(name: str, figures: dict[str, Any], peer: dict[str, Any] | None, more: list[str]) -> str:
    """One line of the table."""
    cells = [name]
    for title, (part, key) in FIGURES.items():
        values = []
        for found in (figures, peer):
            value = ((found or {}).get(part) or {}).get(key)
            scale = 100.0 if title.endswith("[%]") else 1.0
            values.append("-" if value is None else f"{scale * value:.{_DIGITS.get(title, 1)}f}")
        cells.append(values[0] if peer is None else " / ".join(values))
    return "| " + " | ".join([*cells, *more]) + " |"


def fastest(retargeter: Retargeter, motion: HumanMotion, repeats: int) -> tuple[Retargeted, float]:
    """The result, and the least processor time that it took [s]."""
    result, spent = retargeter.retarget(motion), []
    for _ in range(repeats):
        begin = time.process_time()
        result = retargeter.retarget(motion)
        spent.append(time.process_time() - begin)
    return result, min(spent, default=np.inf)


def program_alone(retargeter: Retargeter, motion: HumanMotion, copies: int) -> None:
    """Prints what one program makes of copies of a clip, without reading and writing them."""
    clip = retargeter._prepared(motion, None, None)
    lanes = jax.tree.map(lambda leaf: np.stack([leaf] * copies), as_lane(clip, len(clip.start)))
    lanes = jax.device_put(lanes)
    weights, limits, most = retargeter.profile.weights, retargeter.limits, np.asarray(retargeter.max_iterations)
    spent, solved = [], None
    for _ in range(4):
        begin = time.perf_counter()
        solved = jax.block_until_ready(solve_lanes(lanes, retargeter._body, weights, limits, most))
        spent.append(time.perf_counter() - begin)
    assert solved is not None
    iterations = np.asarray(solved.iterations)
    print(
        f"{copies} copies of {motion.name} in one program: {copies * motion.frames / min(spent):.0f} frames a second, "
        f"{iterations.min()} to {iterations.max()} iterations ({spent[0]:.0f} s the first time)"
    )


def cut(motion: HumanMotion, first: int) -> HumanMotion:
    """A clip from some frame on."""
    frames = {name: getattr(motion, name) for name in ("positions", "rotations", "contact")}
    later = {name: None if track is None else track[first:] for name, track in frames.items()}
    return dataclasses.replace(motion, **later)


def many_at_once(retargeter: Retargeter, motions: list[HumanMotion], count: int, chunk: int) -> None:
    """Prints what a batch of clips takes: those given in turn, each round of them three frames shorter than the last.

    After ten rounds they are whole again.
    """
    many = [
        cut(motion, min(3 * (k % 10), motion.frames // 3))
        for k in range(-(-count // len(motions)))
        for motion in motions
    ][:count]
    frames, wall, processor = sum(motion.frames for motion in many), [], []
    for _ in range(3):
        begin = time.perf_counter(), time.process_time()
        retargeter.retarget_all(many, chunk=chunk, progress=False)
        wall.append(time.perf_counter() - begin[0])
        processor.append(time.process_time() - begin[1])
    print(
        f"{count} clips of {min(m.frames for m in many)} to {max(m.frames for m in many)} frames at once, {frames} in "
        f"all: {frames / min(wall):.0f} a second on {cores()} cores, {frames / min(processor):.0f} a second of "
        f"processor time ({wall[0]:.0f} s the first time)"
    )


class TimedLive(LiveRetargeter):
    """Notes what processor time each frame takes [s]."""

    def reset(self) -> None:
        """Forgets the times too."""
        super().reset()
        self.processor: list[float] = []

    def step(self, positions: np.ndarray | None, contact: np.ndarray | None = None) -> LiveFrame | None:
        """A frame, timed where one comes out."""
        began = time.process_time()
        frame = super().step(positions, contact)
        if frame is not None:
            self.processor.append(time.process_time() - began)
        return frame


def frame_by_frame(
    robot: Robot,
    profile: Profile | None,
    motions: list[HumanMotion],
    judge: Callable[[Retargeted], dict[str, Any]],
    look_ahead: float,
) -> None:
    """Prints the table of ``--live``."""
    titles = ["p50 [ms]", "p99 [ms]", "processor p50 [ms]", "processor p99 [ms]"]
    print_head([*FIGURES, "frames", *titles])
    made: list[TimedLive] = []

    def make(standing: HumanMotion) -> TimedLive:
        made.append(TimedLive(robot, standing, profile=profile, look_ahead=look_ahead))
        return made[-1]

    clock, processor = [], []
    for motion in motions:
        result, frames = replay(make, motion)
        clock.append([1e3 * frame.seconds for frame in frames])
        processor.append([1e3 * seconds for seconds in made[-1].processor])
        times = [f"{np.percentile(own[-1], p):.1f}" for own in (clock, processor) for p in (50, 99)]
        print(row(motion.name, judge(result), None, [str(len(frames)), *times]), flush=True)
    p50, p99, own50, own99 = (np.percentile(np.concatenate(x), p) for x in (clock, processor) for p in (50, 99))
    print(
        f"\n{sum(map(len, clock))} frames with a look-ahead of {look_ahead} s: half below {p50:.1f} ms and 99 % below "
        f"{p99:.1f} ms by the clock, {own50:.1f} and {own99:.1f} ms of processor time"
    )


def smoothed(
    robot: Robot,
    profile: Profile | None,
    motions: list[HumanMotion],
    judge: Callable[[Retargeted], dict[str, Any]],
    smoothnesses: list[float],
) -> None:
    """Prints the table of ``--smooth``."""
    print_head([*FIGURES, "acceleration, rms [rad/s²]", "jerk, rms [rad/s³]", "iterations"])
    for motion in motions:
        for smoothness in smoothnesses:
            result = Retargeter(robot, profile=profile, smoothness=smoothness).retarget(motion)
            joints = report(result)["joints"]
            more = [f"{joints['acceleration_rms']:.1f}", f"{joints['jerk_rms']:.0f}", str(result.iterations)]
            print(row(f"{motion.name}, {smoothness:g} s", judge(result), None, more), flush=True)


def print_head(titles: list[str]) -> None:
    """Prints a table's first two lines."""
    print("| " + " | ".join(["clip", *titles]) + " |\n|" + "---|" * (1 + len(titles)))


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="+", help="motion files")
    parser.add_argument("--robot", default="g1", help="nao, g1, talos or a URDF")
    parser.add_argument(
        "--profile",
        default="bundled",
        help="guess, bundled (that of the package, or a guess where it has none), or a TOML",
    )
    parser.add_argument("--repeats", type=int, default=5, help="runs of each clip that are timed")
    parser.add_argument("--single", action="store_true", help="in single precision")
    parser.add_argument(
        "--batch", type=int, default=0, help="also this many clips at once, those given in turn and cut"
    )
    parser.add_argument("--copies", type=int, default=0, help="also so many of the first clip in one program alone")
    parser.add_argument("--chunk", type=int, default=32, help="of the batch on a GPU, how many are in one program")
    parser.add_argument("--judge", nargs=3, metavar=("FILE", "ROBOT", "MODEL"), help="a judge, its JSON, its model")
    parser.add_argument("--peer", help="the judge's report of another program's motions")
    parser.add_argument("--live", action="store_true", help="frame by frame")
    parser.add_argument("--look-ahead", type=float, default=0.27, help="with --live: time that the robot is behind [s]")
    parser.add_argument("--smooth", type=float, nargs="+", default=[], help="each clip with each smoothness [s]")
    options = parser.parse_args()
    configure_cpu()
    jax.config.update("jax_enable_x64", not options.single)
    by_name = options.robot in NAMES
    robot = load_robot(options.robot) if by_name else Robot.from_urdf(Path(options.robot), floating_base=True)
    made = {"guess": guess_profile, "bundled": lambda _: None}
    profile = made.get(options.profile, lambda _: load_profile(options.profile))(robot)
    judge = Judge(*options.judge) if options.judge else own_figures
    peers = json.loads(Path(options.peer).read_text(encoding="utf-8")) if options.peer else {}
    motions = [load_motion(path) for path in options.clips]
    print(f"{processor()}, {'single' if options.single else 'double'} precision\n")
    if options.live:
        return frame_by_frame(robot, profile, motions, judge, options.look_ahead)
    if options.smooth:
        return smoothed(robot, profile, motions, judge, options.smooth)
    retargeter = Retargeter(robot, profile=profile)
    print_head([*FIGURES, "frames", "iterations", "frames/s"])
    taken, rates, iterations = [], [], []
    for motion in motions:
        result, seconds = fastest(retargeter, motion, options.repeats)
        taken.append(seconds)
        rates.append(motion.frames / seconds)
        iterations.append(result.iterations)
        more = [str(motion.frames), str(result.iterations), f"{rates[-1]:.0f}"]
        peer = peers.get(motion.name, {}) if options.peer else None
        print(row(motion.name, judge(result), peer, more), flush=True)
    frames = sum(motion.frames for motion in motions)
    print(
        f"\n{frames} frames, {frames / sum(taken):.0f} a second of processor time "
        f"({min(rates):.0f} to {max(rates):.0f} by clip), {min(iterations)} to {max(iterations)} iterations, "
        f"median {statistics.median(iterations):g}"
    )
    if options.copies:
        program_alone(retargeter, motions[0], options.copies)
    if options.batch:
        many_at_once(retargeter, motions, options.batch, options.chunk)


if __name__ == "__main__":
    main()
