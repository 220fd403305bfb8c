"""Timed motion: durations and rates of ``retime`` beside toppra, a raster by ``follow``, streams by ``chunk``.

python -m benchmarks.motion [--speeds 0.1 0.3]. Needs toppra.
python -m benchmarks.motion --chunks
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import jax
import numpy as np

import osik_jax as osik
from osik_jax.motion import chunk, follow, retime

LIMITS: dict[str, Any] = {
    "velocity": np.array([2.175] * 4 + [2.61] * 3),
    "acceleration": np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]),
    "jerk": np.array([7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0]),
}
"""Published limits of Franka's Panda."""
ROBOTS = {
    "Panda": (LIMITS["velocity"], LIMITS["acceleration"]),
    "UR5": (np.full(6, 3.15), np.full(6, 8.0)),
    "SO-101": (np.full(5, 4.0), np.full(5, 20.0)),
}
_CELLS = 200


def random_paths(count: int, joints: int) -> np.ndarray:
    """Return paths of six waypoints. (count, 6, joints)."""
    return np.cumsum(0.5 * np.random.default_rng(0).normal(size=(count, 6, joints)), axis=1)


def raster(rows: int = 20, columns: int = 25) -> tuple[np.ndarray, np.ndarray]:
    """Return poses on a lying cylinder of radius 0.15 m: rows along its axis, tool axes into it."""
    position, rotation = [], []
    for row, angle in enumerate(np.linspace(-0.5, 0.5, rows)):
        outward, side = np.array([np.sin(angle), 0.0, np.cos(angle)]), np.array([0.0, -1.0, 0.0])
        for y in np.linspace(-0.12, 0.12, columns)[:: -1 if row % 2 else 1]:
            position.append(np.array([0.5, y, 0.25]) + 0.15 * outward)
            rotation.append(np.stack([np.cross(side, -outward), side, -outward], axis=1))
    return np.array(position), np.array(rotation)


def toppra_durations(paths: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> list[float]:
    """Return the durations by toppra along the same splines, on as many grid points."""
    import toppra  # pyright: ignore[reportMissingImports]

    toppra.setup_logging("ERROR")
    found = []
    for points in paths:
        along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        path = toppra.SplineInterpolator(along / along[-1], points)
        rows = [
            toppra.constraint.JointVelocityConstraint(np.stack([-velocity, velocity], axis=1)),
            toppra.constraint.JointAccelerationConstraint(np.stack([-acceleration, acceleration], axis=1)),
        ]
        grid = np.linspace(path.path_interval[0], path.path_interval[1], _CELLS + 1)
        solver = toppra.algorithm.TOPPRA(rows, path, gridpoints=grid, parametrizer="ParametrizeConstAccel")
        trajectory = solver.compute_trajectory(0.0, 0.0)
        assert trajectory is not None
        found.append(float(trajectory.duration))
    return found


def beside_toppra(name: str, velocity: np.ndarray, acceleration: np.ndarray) -> None:
    """Print durations of 100 paths, and the rates of 1,024 in one call and of 100 one by one."""
    timed = jax.jit(jax.vmap(lambda p: retime(p, velocity=velocity, acceleration=acceleration, cells=_CELLS).duration))
    paths = random_paths(1024, len(velocity))
    durations = np.asarray(timed(paths))
    took = min(_seconds(lambda: jax.block_until_ready(timed(paths))) for _ in range(5))
    start = time.perf_counter()
    peer = toppra_durations(paths[:100], velocity, acceleration)
    peer_took = (time.perf_counter() - start) / 100.0
    ratio = durations[:100] / np.array(peer)
    print(
        f"{name}: duration / toppra's median {np.median(ratio):.4f}, largest {ratio.max():.4f}; "
        f"{1024 / took:,.0f} paths/s beside {1 / peer_took:,.0f}, {peer_took * 1024 / took:.0f} times"
    )


def _seconds(call: Any) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def follow_raster(speed: float) -> None:
    """Print how well a Panda follows the raster at a wanted speed."""
    arm = osik.load_robot("arm7")
    motion = follow(arm, {"hand": raster()}, speed=speed, **LIMITS)
    times = np.arange(0.0, motion.duration, 1e-3)
    used = [float((np.abs(a) / limit).max()) for a, limit in zip(motion.at(times)[1:], LIMITS.values(), strict=True)]
    slow = sum(part.end - part.start for part in motion.slow_parts())
    print(
        f"{speed} m/s: {motion.duration:.2f} s, {1e3 * motion.position_error:.1g} mm and "
        f"{np.degrees(motion.orientation_error):.1g} deg off; speed, acceleration, jerk by their limits "
        f"{used[0]:.4f} {used[1]:.4f} {used[2]:.4f}; slower than wanted for {slow:.2f} s"
    )


def chunk_stream(step: float, streams: int = 10) -> None:
    """Print how well chunks of 30 random waypoints in 1 s join and keep limits.

    Args:
        step: standard deviation of a waypoint's distance from the one before [rad].
        streams: number of streams, of four chunks each.
    """
    arm = osik.load_robot("arm7")
    limits: dict[str, Any] = {"velocity": 1.5, "acceleration": 4.0, "jerk": 40.0}
    run = jax.jit(lambda points, times, start, begin: chunk(arm, points, times, start=start, begin=begin, **limits))
    rng, rest = np.random.default_rng(0), np.zeros(arm.nv)
    used, joins, kept, took = np.zeros(4), 0.0, [], []
    for _ in range(streams):
        begin, start, before = 0.0, (np.asarray(arm.q0), rest, rest), None
        for _ in range(4):
            points = np.asarray(start[0]) + np.cumsum(step * rng.normal(size=(30, arm.nv)), axis=0)
            given = points, begin - 0.1 + np.linspace(0.0, 1.0, 30), start, begin
            found = run(*given)
            start_time = time.process_time()
            jax.block_until_ready(run(*given))
            took.append(time.process_time() - start_time)
            q, *rates = np.asarray(found.at(np.linspace(begin, float(found.end), 1001)))
            past = np.maximum(q - arm.position_upper, arm.position_lower - q).max()
            used = np.maximum(used, [past, *(np.abs(a).max() / b for a, b in zip(rates, limits.values(), strict=True))])
            kept.append(bool(found.feasible.all()))
            if before is not None:
                pairs = zip(before.state(begin), found.state(begin), strict=True)
                joins = max(joins, *(float(np.abs(a - b).max()) for a, b in pairs))
            begin, before = begin + 0.4 + 0.3 * rng.random(), found
            start = found.state(begin)
    print(
        f"steps of {step} rad: joins {joins:.1g}, past a range {max(used[0], 0.0):.2g} rad, speed, acceleration, jerk "
        f"by their limits {used[1]:.4f} {used[2]:.4f} {used[3]:.4f}; {kept.count(False)} of {len(kept)} chunks not "
        f"feasible; processor time of a chunk {1e3 * min(took):.0f} ms at least, median {1e3 * np.median(took):.0f} ms"
    )


def main() -> None:
    """Run the measurements."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--speeds", type=float, nargs="*", default=[0.05, 0.1, 0.3, 1.0])
    parser.add_argument("--chunks", action="store_true", help="streams of chunks alone")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if arguments.chunks:
        for step in (0.02, 0.12):
            chunk_stream(step)
        return
    for name, limits in ROBOTS.items():
        beside_toppra(name, *limits)
    for speed in arguments.speeds:
        follow_raster(speed)


if __name__ == "__main__":
    main()
