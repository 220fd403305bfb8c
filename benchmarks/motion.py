"""Timed motion: ``retime`` beside toppra and Ruckig, streams by ``chunk`` and ``PoseFilter``.

python -m benchmarks.motion. Needs toppra and ruckig.
python -m benchmarks.motion --chunks
python -m benchmarks.motion --noise
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import osik_jax as osik
from benchmarks.raster import LIMITS
from osik_jax.motion import PoseFilter, Stream, retime

ROBOTS = {
    "Panda": (LIMITS["velocity"], LIMITS["acceleration"]),
    "UR5": (np.full(6, 3.15), np.full(6, 8.0)),
    "SO-101": (np.full(5, 4.0), np.full(5, 20.0)),
}
_CELLS = 200
_CLOCKS = time.process_time, time.perf_counter


def random_paths(count: int, joints: int) -> np.ndarray:
    """Return paths of six waypoints. (count, 6, joints)."""
    return np.cumsum(0.5 * np.random.default_rng(0).normal(size=(count, 6, joints)), axis=1)


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


def beside_ruckig(lines: int = 100) -> None:
    """Print durations of straight lines of a Panda's joints with limits of jerk, by those of Ruckig along the line."""
    import ruckig  # pyright: ignore[reportMissingImports]

    ends = 0.8 * np.random.default_rng(0).normal(size=(lines, 2, 7))
    durations = np.asarray(jax.jit(jax.vmap(lambda points: retime(points, **LIMITS).duration))(ends))
    wanted = []
    for way in np.abs(ends[:, 1] - ends[:, 0]):
        given, found = ruckig.InputParameter(1), ruckig.Trajectory(1)
        given.target_position = [1.0]
        most = [[float((limit / way).min())] for limit in LIMITS.values()]
        given.max_velocity, given.max_acceleration, given.max_jerk = most
        ruckig.Ruckig(1).calculate(given, found)
        wanted.append(found.duration)
    ratio = durations / np.array(wanted)
    print(f"straight lines with jerk: duration / Ruckig's median {np.median(ratio):.4f}, largest {ratio.max():.4f}")


def _seconds(call: Any, clock: Any = time.perf_counter) -> float:
    start = clock()
    call()
    return clock() - start


def chunk_stream(step: float, streams: int = 10) -> None:
    """Print how well chunks of 30 random waypoints in 1 s join and keep limits.

    Args:
        step: standard deviation of a waypoint's distance from the one before [rad].
        streams: number of streams, of four chunks each.
    """
    arm, latency = osik.load_robot("arm7"), 0.1
    limits: dict[str, Any] = {"velocity": 1.5, "acceleration": 4.0, "jerk": 40.0}
    push, rng = jax.jit(Stream.push), np.random.default_rng(0)
    used, joins, kept, took = np.zeros(4), 0.0, [], []
    for _ in range(streams):
        begin, stream = 0.0, Stream(arm, arm.q0, latency=latency, waypoints=30, **limits)
        for _ in range(4):
            start = np.asarray(stream.at(np.array([begin])))[0, 0]
            points = start + np.cumsum(step * rng.normal(size=(30, arm.nv)), axis=0)
            given = stream, points, begin - latency + np.linspace(0.0, 1.0, 30), begin - latency
            stream = push(*given)
            took.append([_seconds(lambda given=given: jax.block_until_ready(push(*given)), clock) for clock in _CLOCKS])
            kept.append(bool(stream.taken))
            q, *rates = np.asarray(stream.at(np.linspace(begin, float(stream.after.end), 1001)))
            past = np.maximum(q - arm.position_upper, arm.position_lower - q).max()
            used = np.maximum(used, [past, *(np.abs(a).max() / b for a, b in zip(rates, limits.values(), strict=True))])
            if kept[-1]:
                pairs = zip(stream.running.state(begin), stream.after.state(begin), strict=True)
                joins = max(joins, *(float(np.abs(a - b).max()) for a, b in pairs))
            begin += 0.4 + 0.3 * rng.random()
    medians = 1e3 * np.median(took, axis=0)
    print(
        f"steps of {step} rad: joins {joins:.1g}, past a range {max(used[0], 0.0):.2g} rad, speed, acceleration, jerk "
        f"by their limits {used[1]:.4f} {used[2]:.4f} {used[3]:.4f}; {kept.count(False)} of {len(kept)} chunks not "
        f"feasible; a push: processor time {medians[0]:.0f} ms in the median, wall time {medians[1]:.0f} ms, "
        f"95 % {1e3 * np.quantile(took, 0.95, axis=0)[1]:.0f} ms"
    )


def waving_hand(steps: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return how a hand moves there and back, from the start: 0.4 m (steps, 3) and 0.6 rad about z (steps, 3, 3)."""
    share, way = np.modf(dt * np.arange(steps) / 4.0)
    share = 10.0 * share**3 - 15.0 * share**4 + 6.0 * share**5
    share = np.where(way % 2 == 0, share, 1.0 - share)[:, None]
    move = np.array([-0.1, 0.25, -0.295])
    return 0.4 * share * move / np.linalg.norm(move), Rotation.from_rotvec(share * [0.0, 0.0, 0.6]).as_matrix()


class _Noise:
    """A Panda that follows a hand seen with 1 mm and 0.5 degrees of white noise, 50 times a second for 12 s."""

    dt, steps = 0.02, 600

    def __init__(self) -> None:
        self.arm, rng = osik.load_robot("arm7"), np.random.default_rng(0)
        place, turn = (np.asarray(a) for a in osik.FrameTask(self.arm, "hand").target)
        move, rotation = waving_hand(self.steps, self.dt)
        self.true = place + move, rotation @ turn
        noise = Rotation.from_rotvec(np.deg2rad(0.5) * rng.normal(size=(self.steps, 3))).as_matrix()
        self.seen = (
            jnp.asarray(self.true[0] + 1e-3 * rng.normal(size=(self.steps, 3))),
            jnp.asarray(noise @ self.true[1]),
        )

    def row(self, gain: float, time_constant: float | None = None, damping: float = 0.0, inertia: float = 0.0) -> str:
        """Return the errors of the tool, root mean square [mm, deg], and those of joints' accelerations [rad/s^2]."""
        arm, dt = self.arm, self.dt
        hand, posture = osik.FrameTask(arm, "hand", gain=gain), osik.PostureTask(arm, weight=1e-5, target=arm.q0)
        extra: dict[str, Any] = {"calm": osik.DampingTask(arm, weight=damping)} if damping else {}

        def step(state: Any, seen: Any) -> Any:
            q, smooth, v = state
            target, velocity = seen, jnp.zeros(6)
            if time_constant is not None:
                smooth, target, velocity = smooth.update(seen, dt)
            tasks = {"hand": hand.replace(target=target, target_velocity=velocity), "posture": posture, **extra}
            if inertia:
                tasks["inertia"] = osik.LowAccelerationTask(arm, weight=inertia).after(v)
            v = osik.solve(arm, q, tasks, dt=dt).velocity
            q = osik.integrate(arm, q, v, dt)
            return (q, smooth, v), (v, *osik.forward_kinematics(arm, q).frame_pose(arm, "hand"))

        smooth = PoseFilter(hand.target, time_constant=time_constant or 0.1)
        start = arm.q0, smooth, jnp.zeros(arm.nv)
        v, *poses = map(np.asarray, jax.jit(lambda: jax.lax.scan(step, start, self.seen)[1])())
        # a step ends when the next pose is seen
        off = np.linalg.norm(poses[0][:-1] - self.true[0][1:], axis=1)
        angle = Rotation.from_matrix(poses[1][:-1] @ self.true[1][1:].swapaxes(1, 2)).magnitude()
        pull = (np.diff(v, axis=0) / dt)[50:] ** 2
        rms = 1e3 * np.sqrt((off[50:] ** 2).mean()), np.degrees(np.sqrt((angle[50:] ** 2).mean()))
        return f"{rms[0]:.1f} | {rms[1]:.2f} | {np.sqrt(pull.mean()):.2f} | {np.sqrt(pull.mean(0)).max():.2f}"


def noise_rows() -> None:
    """Print gain, filter, damping and inertia beside each other."""
    run = _Noise()
    cases: dict[str, dict[str, float]] = {f"gain {gain:g}": {"gain": gain} for gain in (5.0, 10.0, 20.0, 30.0)}
    cases |= {f"gain 30, `DampingTask`, weight {w:g}": {"gain": 30.0, "damping": w} for w in (0.01, 0.1)}
    cases |= {f"gain 30, `LowAccelerationTask`, weight {w:g}": {"gain": 30.0, "inertia": w} for w in (0.1, 0.3)}
    for gain, time_constant in ((10.0, 0.05), (10.0, 0.08), (10.0, 0.15), (20.0, 0.08)):
        cases[f"`PoseFilter`, {time_constant:g} s, gain {gain:g}"] = {"gain": gain, "time_constant": time_constant}
    both = {"gain": 20.0, "time_constant": 0.05}
    for weight in (0.1, 0.2):
        cases[f"`PoseFilter`, 0.05 s, gain 20, `LowAccelerationTask`, weight {weight:g}"] = both | {"inertia": weight}
    print("| | tool error [mm] | [deg] | joint acceleration [rad/s²] | of the fastest joint |\n|---|---|---|---|---|")
    for name, case in cases.items():
        print(f"| {name} | {run.row(**case)} |", flush=True)


def main() -> None:
    """Run the measurements."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--chunks", action="store_true", help="streams of chunks alone")
    parser.add_argument("--noise", action="store_true", help="a hand seen with noise alone")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if arguments.noise:
        noise_rows()
        return
    if arguments.chunks:
        for step in (0.02, 0.12):
            chunk_stream(step)
        return
    for name, limits in ROBOTS.items():
        beside_toppra(name, *limits)
    beside_ruckig()


if __name__ == "__main__":
    main()
