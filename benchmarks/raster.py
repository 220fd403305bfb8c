"""A raster on a cylinder by ``follow`` at wanted speeds of the tool, beside the largest speeds that a bisection finds.

python -m benchmarks.raster [--speeds 0.05 0.1 0.3 1.0] [--cells 1600]

The judge is NumPy and MuJoCo's kinematics alone. By the length l of the tool's path, joints move with ``q' v``,
``q'' v^2 + q' a`` and ``q''' v^3 + 3 q'' v a + q' j`` for the tool's speed v, acceleration a and jerk j. From each
corner, both ways, the tool speeds up with the largest jerk and acceleration that joints allow, and then with the least
jerk until its acceleration is 0. When it begins to do so is found by trying ever finer values, so that it ends with the
wanted speed. If both ways do not fit between two corners, the largest speed for which they do is bisected.
"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import osik_jax as osik
from osik_jax.motion import Followed, follow

LIMITS: dict[str, Any] = {
    "velocity": np.array([2.175] * 4 + [2.61] * 3),
    "acceleration": np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]),
    "jerk": np.array([7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0]),
}
"""Published limits of Franka's Panda."""
_ALL = np.stack(list(LIMITS.values()))
_SLOW = 0.99
"""A speed below this share of the wanted one is too slow."""
_ROW = 0.1
"""Pieces of the path that are longer are rows [m]. The bound of those between rows is far above what joints allow."""
_PARTS, _POINTS, _TURNS, _ROUNDS = 16, 1000, 17, 4


def raster(rows: int = 20, columns: int = 25) -> tuple[np.ndarray, np.ndarray]:
    """Return poses on a lying cylinder of radius 0.15 m: rows along its axis, tool axes into it."""
    position, rotation = [], []
    for row, angle in enumerate(np.linspace(-0.5, 0.5, rows)):
        outward, side = np.array([np.sin(angle), 0.0, np.cos(angle)]), np.array([0.0, -1.0, 0.0])
        for y in np.linspace(-0.12, 0.12, columns)[:: -1 if row % 2 else 1]:
            position.append(np.array([0.5, y, 0.25]) + 0.15 * outward)
            rotation.append(np.stack([np.cross(side, -outward), side, -outward], axis=1))
    return np.array(position), np.array(rotation)


class Way(NamedTuple):
    """Derivatives of the joints by the length of the tool's path between two corners.

    Attributes:
        length: [m], increasing. (P,)
        by_length: first to third derivatives. (3, P, 7)
    """

    length: np.ndarray
    by_length: np.ndarray


def tool_way(robot: osik.Robot, knots: np.ndarray, coefficients: np.ndarray, site: int) -> Way:
    """Return the way of the tool along a cubic spline of the joints, (N - 1, 4, 7) coefficients of rising powers."""
    x = np.linspace(0.0, 1.0, _PARTS + 1) * np.diff(knots)[:, None]  # (N - 1, parts + 1): knots come twice
    a, b, c, d = (coefficients[:, power, None] for power in range(4))
    x = x[..., None]
    q, first, second, third = (
        a + x * (b + x * (c + x * d)),
        b + x * (2 * c + 3 * x * d),
        2 * c + 6 * x * d,
        6 * d + 0 * x,
    )
    speed = np.linalg.norm(tool_velocities(robot, q.reshape(-1, 7), first.reshape(-1, 7), site), axis=1)
    speed = speed.reshape(len(q), -1)
    fits = [np.polynomial.Polynomial.fit(s[:, 0], v, 8) for s, v in zip(x, speed, strict=True)]
    rate, bend = (
        np.stack([fit.deriv(order)(s[:, 0]) for fit, s in zip(fits, x, strict=True)])[..., None] for order in (1, 2)
    )
    length = np.stack([fit.integ()(s[:, 0]) - fit.integ()(0.0) for fit, s in zip(fits, x, strict=True)])
    length += np.append(0.0, np.cumsum(length[:, -1]))[:-1, None]
    speed = speed[..., None]
    s1, s2, s3 = 1.0 / speed, -rate / speed**3, (3.0 * rate**2 - speed * bend) / speed**5
    by_length = [first * s1, second * s1**2 + first * s2, third * s1**3 + 3.0 * second * s1 * s2 + first * s3]
    once = np.append(np.diff(length.ravel()) > 0.0, True)
    return Way(length.ravel()[once], np.stack([own.reshape(-1, 7)[once] for own in by_length]))


def tool_velocities(robot: osik.Robot, q: np.ndarray, move: np.ndarray, site: int) -> np.ndarray:
    """Return the tool's velocities [m/s] by MuJoCo's Jacobian."""
    data, jacobian, found = mujoco.MjData(robot.mj_model), np.zeros((3, robot.nv)), []
    for row, own in zip(q, move, strict=True):
        data.qpos[:] = row
        mujoco.mj_kinematics(robot.mj_model, data)
        mujoco.mj_comPos(robot.mj_model, data)
        mujoco.mj_jacSite(robot.mj_model, data, jacobian, None, site)
        found.append(jacobian @ own)
    return np.array(found)


def at_even_lengths(ways: list[Way]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lengths of all ways, there and back (2 k,), and derivatives (2 k, points, 3, 7) at equal steps."""
    table = [
        [[np.interp(np.linspace(0.0, way.length[-1], _POINTS), way.length, row) for row in own.T] for own in rows]
        for way in ways
        for rows in [way.by_length]
    ]
    there = np.array(table).transpose(0, 3, 1, 2)
    back = there[:, ::-1] * np.array([-1.0, 1.0, -1.0])[:, None]
    return np.tile([way.length[-1] for way in ways], 2), np.concatenate([there, back])


def span(slope: np.ndarray, rest: np.ndarray, limit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and largest x of each lane with ``|slope x + rest| <= limit``, for joints (L, 7)."""
    size = np.maximum(np.abs(slope), 1e-12)
    middle = -rest * np.sign(slope) / size
    return (middle - limit / size).max(axis=1), (middle + limit / size).min(axis=1)


def speed_up(length: np.ndarray, table: np.ndarray, turn: np.ndarray, dt: float = 1e-4) -> np.ndarray:
    """Return lengths, speeds and accelerations of the tool from rest until its acceleration is 0.

    Args:
        length: of the way of each lane [m]. (L,)
        table: derivatives of the joints at equal steps of each. (L, points, 3, 7)
        turn: speed from which on the acceleration falls as fast as joints allow [m/s]. (L,)
        dt: time of a step [s].

    Returns:
        The states at all steps. (T, 3, L)
    """
    lanes, (s, v, a) = np.arange(len(turn)), np.zeros((3, len(turn)))
    states, falls, stands = [np.stack([s, v, a])], turn <= 0.0, turn <= 0.0
    while not stands.all():
        place = np.clip(s / length, 0.0, 1.0) * (_POINTS - 1)
        k = np.minimum(place.astype(int), _POINTS - 2)
        share = (place - k)[:, None, None]
        q1, q2, q3 = ((1.0 - share) * table[lanes, k] + share * table[lanes, k + 1]).swapaxes(0, 1)
        speed, pull = v[:, None], a[:, None]
        jerks = span(q1, q3 * speed**3 + 3.0 * q2 * speed * pull, _ALL[2])
        pulls = span(q1, q2 * (speed + dt * pull) ** 2, _ALL[1])
        more = np.where(falls, np.maximum(a + dt * jerks[0], pulls[0]), np.minimum(a + dt * jerks[1], pulls[1]))
        step = np.where((a > 0.0) & (more < 0.0), dt * a / np.where(more < a, a - more, 1.0), dt)
        step, more = np.where(stands, 0.0, step), np.maximum(more, 0.0)
        more = np.where(stands, a, more)
        s, v, a = s + step * (v + step * (2.0 * a + more) / 6.0), v + step * (a + more) / 2.0, more
        stands = stands | (falls & (a <= 0.0)) | (s >= length) | (pulls[0] > pulls[1])
        falls = falls | (v >= turn)
        states.append(np.stack([s, v, a]))
    return np.stack(states)


def meeting_speeds(length: np.ndarray, speed: np.ndarray, used: np.ndarray, wanted: float) -> np.ndarray:
    """Return the largest speed, at most the wanted one, for which the ways to it from both corners fit.

    Args:
        length: of the ways [m]. (k,)
        speed, used: at the end of each lane, and the length it took. (2 k, turns)
    """
    count, (low, high) = len(length), (np.zeros(len(length)), np.full(len(length), wanted))
    for step in range(40):
        middle = 0.5 * (low + high) if step else high
        took = [np.interp(middle[i % count], speed[i], used[i], right=np.inf) for i in range(2 * count)]
        fits = np.array(took).reshape(2, count).sum(axis=0) <= length
        low, high = np.where(fits, middle, low), np.where(fits, high, middle)
    return low


def largest_speeds(ways: list[Way], wanted: float) -> tuple[np.ndarray, np.ndarray]:
    """Return lengths (k, points) along each way, and the largest speeds there, at most the wanted one.

    Near a corner they are those of the way up from rest and down to it, elsewhere the largest constant speeds for which
    a point by itself keeps all limits. Changes between constant speeds are not looked at, so they are upper bounds.
    """
    length, table = at_even_lengths(ways)
    count, target = len(ways), np.full(2 * len(ways), wanted)
    turns = np.tile(np.linspace(0.0, wanted, _TURNS), (2 * count, 1))
    for round in range(_ROUNDS):
        lanes = np.repeat(length, _TURNS), np.repeat(table, _TURNS, axis=0), turns.ravel()
        used, speed, _ = speed_up(*lanes)[-1].reshape(3, 2 * count, _TURNS)
        if round == 0:
            target = np.tile(meeting_speeds(length[:count], speed, used, wanted), 2)
        first = np.clip((speed <= target[:, None]).sum(axis=1) - 1, 0, _TURNS - 2)[:, None]
        low, high = (np.take_along_axis(turns, first + i, axis=1)[:, 0] for i in (0, 1))
        turns = np.linspace(low, high, _TURNS, axis=1)
    states = speed_up(length, table, turns[:, 0])
    even = np.linspace(0.0, length[:count], _POINTS, axis=1)
    ramps = np.stack([np.interp(even[i % count], *states[:, :2, i].T, right=target[i]) for i in range(2 * count)])
    with np.errstate(divide="ignore"):
        each = [(limit / np.abs(table[:count, :, i])) ** (1.0 / (i + 1)) for i, limit in enumerate(_ALL)]
    constant = np.minimum(np.min(each, axis=(0, 3)), wanted)
    return even, np.minimum(np.minimum(ramps[:count], ramps[count:, ::-1]), constant)


def own_speeds(robot: osik.Robot, motion: Followed, piece: int, site: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the lengths and speeds of the tool in a piece of the motion, by MuJoCo and differences."""
    data, duration = mujoco.MjData(robot.mj_model), float(motion.timings[piece].duration)
    time, places = np.linspace(0.0, duration, max(100, round(duration / 4e-4))), []
    for row in np.asarray(motion.timings[piece].at(jnp.asarray(time))[0]):
        data.qpos[:] = row
        mujoco.mj_kinematics(robot.mj_model, data)
        places.append(data.site_xpos[site].copy())
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1)))
    return length, np.gradient(length, time)


def judge(robot: osik.Robot, motion: Followed, wanted: float) -> str:
    """Return the shares of the path with the wanted speed, beside the shares that the limits allow."""
    site = mujoco.mj_name2id(robot.mj_model, mujoco.mjtObj.mjOBJ_SITE, motion.frame)
    splines = [(np.asarray(one.path.knots), np.asarray(one.path.coefficients)) for one in motion.timings]
    even, largest = largest_speeds([tool_way(robot, *spline, site) for spline in splines], wanted)
    own = np.array([np.interp(x, *own_speeds(robot, motion, i, site)) for i, x in enumerate(even)])
    length = even[:, -1]
    kept, allowed = (((speed >= _SLOW * wanted).mean(axis=1) * length).sum() / length.sum() for speed in (own, largest))
    short = (largest - own)[length > _ROW] / wanted
    return (
        f"wanted speed on {kept:.2%} of the length, {allowed:.2%} by the bound; on rows the largest shortfall is "
        f"{short.max():.1%} of the wanted speed, and {(short > 0.02).mean():.2%} of the length are 2 % or more short"
    )


def follow_raster(speed: float, cells: int | None) -> None:
    """Print how well a Panda follows the raster at a wanted speed."""
    arm = osik.load_robot("arm7")
    motion = follow(arm, {"hand": raster()}, speed=speed, cells=cells, **LIMITS)
    times = np.arange(0.0, motion.duration, 1e-3)
    used = [float((np.abs(a) / limit).max()) for a, limit in zip(motion.at(times)[1:], LIMITS.values(), strict=True)]
    slow = sum(part.end - part.start for part in motion.slow_parts())
    print(
        f"{speed} m/s: {motion.duration:.2f} s, {1e3 * motion.position_error:.1g} mm and "
        f"{np.degrees(motion.orientation_error):.1g} deg off; speed, acceleration, jerk by their limits "
        f"{used[0]:.4f} {used[1]:.4f} {used[2]:.4f}; slower than wanted for {slow:.2f} s; {judge(arm, motion, speed)}"
    )


def main() -> None:
    """Follow the raster at each wanted speed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--speeds", type=float, nargs="*", default=[0.05, 0.1, 0.3, 1.0])
    parser.add_argument("--cells", type=int)
    jax.config.update("jax_enable_x64", True)
    given = parser.parse_args()
    for speed in given.speeds:
        follow_raster(speed, given.cells)


if __name__ == "__main__":
    main()
