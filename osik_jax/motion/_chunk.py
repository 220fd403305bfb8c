"""Chunks of a policy: a few timed waypoints to a smooth motion of the joints, which joins the motion that runs.

Each joint is a uniform cubic B-spline in time. Its velocity, acceleration and jerk are B-splines too, whose
coefficients are the differences of its own. A B-spline lies between its coefficients, so limits on these hold at all
times. The spline nearest to the waypoints is the answer of a small quadratic program for each joint.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from .._errors import OsikValueError, warn
from ..inverse import inverse_kinematics
from ..inverse._inverse_kinematics import joint_box
from ..numerics._arguments import as_floats, as_scalar, check_count, check_positive, concrete
from ..numerics._dense import full_precision
from ..numerics._guarded import positive_root
from ..robot import Robot
from ..robot._joint_selection import check_scalar_joints, dof_names
from ..solvers import Status, solve_least_squares_qp
from ._jerk import CUBIC
from ._motion import Motion, at_rest_outside, one_axis, sample_times
from ._pose_path import read_poses
from ._retime import Limit, checked_limits
from ._spline import cubic_derivatives
from ._start import State, checked_state, rounding

FEWEST = 16
_HELD = 4
"""Times after the last waypoint, while the motion comes to rest, at which it is to be there."""
_ROOM = 1.5
"""Time to come to rest, by the shortest one."""
_DAMPING = 1e-12
"""Weight of the coefficients beside the waypoints: where these are few, smoothing alone determines the rest."""
_JUMP = 0.5
"""Joint positions [rad or m] of two neighbouring poses that are farther apart are on different branches."""


class Chunk(eqx.Module):
    """Motion of the joints through the waypoints of a chunk: uniform cubic B-splines in time.

    Attributes:
        begin: time at which the motion begins [s].
        width: time between two knots [s].
        coefficients: of the splines [rad or m]. (cells + 3, n)
        miss: position minus waypoint, 0 for waypoints before ``begin`` [rad or m]. (N, n)
        feasible: whether the motion of each joint keeps all its limits. Where it is false, no spline of this width
            stops the start within them: let the running chunk go on. (n,)
        joints: names of the joints (static).
    """

    begin: Float[Array, ""]
    width: Float[Array, ""]
    coefficients: Float[Array, "K3 n"]
    miss: Float[Array, "N n"]
    feasible: Bool[Array, " n"]
    joints: tuple[str, ...] = eqx.field(default=(), static=True)

    @property
    def end(self) -> Float[Array, ""]:
        """Time at which the motion ends [s]: that of the last waypoint, and later if it then comes to rest."""
        return self.begin + self.width * (len(self.coefficients) - 3)

    @property
    def lag(self) -> Float[Array, " n"]:
        """Largest distance of each joint from its waypoints [rad or m]: what limits and smoothing cost."""
        return jnp.abs(self.miss).max(axis=0)

    def at(self, time: Float[ArrayLike, " T"]) -> Float[Array, "4 T n"]:
        """Return positions, velocities, accelerations and jerks at times [s]; at rest outside of the motion."""
        return _at(self, as_floats(one_axis(time)))

    def state(self, time: Float[ArrayLike, ""]) -> tuple[Array, Array, Array]:
        """Return position, velocity and acceleration at one time: the ``start`` of the chunk that goes on there."""
        q, v, a, _ = self.at(jnp.asarray(time)[None])[:, 0]
        return q, v, a

    def sample(self, dt: float) -> Motion:
        """Return the motion at times ``dt`` apart [s], the last of which is the end or just after it (outside jit)."""
        time = float(self.begin) + sample_times(float(self.end - self.begin), dt)
        q, v, a, _ = self.at(time)
        return Motion(jnp.asarray(time), q, v, a, joints=self.joints)


@jax.jit
@full_precision
def _at(chunk: Chunk, time: Float[Array, " T"]) -> Float[Array, "4 T n"]:
    cells = len(chunk.coefficients) - 3
    place = jnp.clip((time - chunk.begin) / chunk.width, 0.0, cells)
    cell = jnp.minimum(place.astype(int), cells - 1)
    four = chunk.coefficients[cell[:, None] + jnp.arange(4)]
    cubics = jnp.einsum("ck,tkn->tcn", CUBIC.astype(time.dtype), four)
    states = cubic_derivatives(cubics, (place - cell)[:, None]) / chunk.width ** jnp.arange(4)[:, None, None]
    return at_rest_outside(states, time, chunk.begin, chunk.end)


def chunk(
    robot: Robot,
    waypoints: Float[ArrayLike, "N n"] | Mapping[str, Any],
    times: Float[ArrayLike, " N"],
    *,
    start: State | None = None,
    begin: Float[ArrayLike, ""] | None = None,
    rest: bool = True,
    velocity: Limit = None,
    acceleration: Limit = None,
    jerk: Limit = None,
    smoothing: Float[ArrayLike, ""] = 1e-3,
    cells: int | None = None,
) -> Chunk:
    """Return the smooth motion nearest to timed waypoints, within limits of position, speed, acceleration and jerk.

    The motion begins with the state ``start``, so chunks that overlap join without a step in position, velocity or
    acceleration: ``start=running.state(now), begin=now``. Each joint minimises the sum of its squared distances from
    the waypoints. Where limits do not let it reach them in time, it stays behind: ``miss`` and ``lag`` say by how much.
    Works in ``jit``, ``vmap`` and ``grad`` with waypoints of the joints.

    Args:
        robot: the robot; hinges and slides alone.
        waypoints: positions of the joints (N, n) [rad or m]; or poses by frame as in ``follow`` (outside jit), which
            become the configurations nearest to that of the start.
        times: increasing times of the waypoints [s]. (N,)
        start: positions, velocities and accelerations at ``begin``, (n,) each. Default: at rest in the first waypoint;
            with poses, in the configuration nearest to ``robot.q0``.
        begin: time of the start [s], before the last waypoint; earlier waypoints do not count. Default: ``times[0]``.
        rest: whether the motion comes to rest after the last waypoint (static). False: it ends there, in motion.
        velocity: limits of the joints' speeds, as in ``retime``. Default: the robot's.
        acceleration: limits of accelerations, likewise. Default: the robot's.
        jerk: limits of jerks, likewise. Default: none.
        smoothing: weight of the squared third differences of the spline's coefficients, > 0; noisy waypoints need more.
        cells: number of the spline's cells (static), 8 or more. Default: one for each waypoint, 16 at least.

    Returns:
        The motion: ``at(time)``, ``state(time)``, ``sample(dt)``.

    Raises:
        KeyError: no such frame or joint.
        ValueError: one waypoint; times that do not increase; a start outside its limits; limits or a smoothing that
            are not positive; poses that cannot be reached, or that lie on different branches.

    Warns:
        OsikWarning: the start cannot be stopped within the limits.
    """
    check_scalar_joints(robot, "a chunk")
    limits = checked_limits(robot, velocity, acceleration, jerk, least_time=False)
    begin = None if begin is None else as_floats(begin)
    time = _checked_times(as_floats(times), begin)
    state = None if start is None else checked_state(robot, start, limits)
    points = _points(robot, waypoints, None if state is None else state[0])
    if points.shape != (len(time), robot.nv):
        raise OsikValueError(f"waypoints have shape {points.shape}; {len(time)} times need ({len(time)}, {robot.nv})")
    seen = concrete(points)
    if seen is not None and not np.isfinite(seen).all():
        raise OsikValueError(f"waypoint {int(np.argmin(np.isfinite(seen).all(axis=1)))} is not finite")
    if state is None:
        state = jnp.stack([points[0], *jnp.zeros((2, robot.nv), points.dtype)])
    count = max(FEWEST, len(time)) if cells is None else cells
    check_count("cells", count, least=8)
    bounds = jnp.stack([jnp.asarray(end, points.dtype) for end in joint_box(robot, None)])
    given = (
        points,
        time,
        state,
        time[0] if begin is None else begin,
        bounds,
        limits,
        as_smoothing(smoothing, points.dtype),
    )
    found = Chunk(*_fitted(*given, cells=count, rest=rest), joints=tuple(dof_names(robot)))
    _warn_unless(found)
    return found


def _warn_unless(found: Chunk) -> None:
    seen = concrete(found.feasible)
    if seen is not None and not seen.all():
        names = ", ".join(name for name, ok in zip(found.joints, seen, strict=True) if not ok)
        warn(f"the start cannot be stopped within the limits of {names}: let the running chunk go on, or widen them")


def _checked_times(time: Array, begin: Array | None) -> Float[Array, " N"]:
    if time.ndim != 1 or len(time) < 2:
        raise OsikValueError(f"times have shape {time.shape}; a chunk has two waypoints or more, with a time each")
    seen, first = concrete(time), None if begin is None else concrete(begin)
    if seen is not None and not (np.isfinite(seen).all() and (np.diff(seen) > 0.0).all()):
        back = int(np.argmax(~(np.diff(seen) > 0.0))) + 1
        raise OsikValueError(f"times have to increase; time {back} is {seen[back]:g} after {seen[back - 1]:g}")
    if seen is not None and first is not None and not first < seen[-1]:
        raise OsikValueError(f"begin is {first:g}; it is before the last waypoint, which is at {seen[-1]:g}")
    return time


def as_smoothing(weight: Float[ArrayLike, ""], dtype: Any = None) -> Float[Array, ""]:
    """Return the weight of the third differences; raise ValueError unless it is positive."""
    found = as_scalar(weight, "smoothing", dtype)
    check_positive("weights of smoothing", found[None])
    return found


def _points(robot: Robot, waypoints: Any, near: Array | None) -> Float[Array, "N n"]:
    """Return waypoints of the joints; of poses the configurations nearest to that of the start."""
    if not isinstance(waypoints, Mapping):
        return as_floats(waypoints)
    poses = read_poses(robot, waypoints)
    targets = {name: one.position if one.rotation is None else tuple(one) for name, one in poses.items()}
    found = inverse_kinematics(robot, targets, q0=near, nearest=True)
    missed = np.flatnonzero(~np.asarray(found.converged))
    if len(missed):
        raise OsikValueError(f"pose {missed[0]} cannot be reached: {found.explain(int(missed[0]))}")
    jump = np.abs(np.diff(np.asarray(found.q), axis=0)).max(axis=1)
    if jump.max() > _JUMP:
        first = int(jump.argmax())
        raise OsikValueError(
            f"the joints jump by {jump[first]:.3g} between poses {first} and {first + 1}: give poses that are closer "
            "together, start nearer to them, or take follow, which looks for a continuous path"
        )
    return jnp.asarray(found.q)


def _differences(cells: int, free: int) -> list[Float[np.ndarray, "D K3"]]:
    """Return maps from coefficients to their three differences, as far as these depend on the ``free`` ones.

    Those are the coefficients from the fourth to ``3 + free``.
    """
    every = [np.diff(np.eye(cells + 3), n=order, axis=0) for order in (1, 2, 3)]
    return [rows[3 - order :][: free + order - 1] for order, rows in enumerate(every, 1)]


@partial(jax.jit, static_argnames=("cells", "rest"))
@full_precision
def _fitted(
    points: Float[Array, "N n"],
    time: Float[Array, " N"],
    state: Float[Array, "3 n"],
    begin: Float[Array, ""],
    bounds: Float[Array, "2 n"],
    limits: Float[Array, "3 n"],
    smoothing: Float[Array, ""],
    *,
    cells: int,
    rest: bool,
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the fields of a chunk; joints with numbers that are not finite stay where they are."""
    is_finite = jnp.isfinite(points).all(axis=0) & jnp.isfinite(state).all(axis=0)
    state = jnp.where(jnp.isfinite(state), state, 0.0)
    points = jnp.where(is_finite, points, state[0])
    pause = _time_to_rest(points, time, state, limits) if rest else jnp.zeros((), time.dtype)
    width = (time[-1] + pause - begin) / cells
    weights, is_ahead = _basis(time, begin, width, cells)
    held, _ = _basis(time[-1] + pause * jnp.arange(1, _HELD + 1) / _HELD, begin, width, cells)
    fit = jnp.concatenate([jnp.where(is_ahead[:, None], weights, 0.0), held if rest else held[:0]])
    wanted = jnp.concatenate([points, jnp.repeat(points[-1:], _HELD if rest else 0, axis=0)])

    free = cells - 2 if rest else cells
    spread = np.eye(cells + 3, free, -3)
    spread[3 + free :, -1] = 1.0  # equal coefficients at the end: rest
    parts = _differences(cells, free)
    rows, kind = np.concatenate(parts), np.repeat([0, 1, 2], [len(part) for part in parts])
    place = np.concatenate([np.arange(len(part)) for part in parts])
    third = np.diff(np.eye(cells + 3), n=3, axis=0)
    cost = jnp.concatenate([fit, jnp.asarray(third, fit.dtype)])
    weight = jnp.concatenate([jnp.ones(len(fit), fit.dtype), jnp.full(len(third), smoothing)])
    moved = rows @ spread

    def solved(joint: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        """Return the coefficients of one joint, and whether limits hold."""
        wanted, state, bounds, limits = joint
        home, state = state[0], state.at[0].set(0.0)  # from the start on: smaller numbers have less rounding
        wanted, bounds = wanted - home, bounds - home
        first = _first_coefficients(state, width)
        fixed = jnp.zeros(cells + 3, first.dtype).at[:3].set(first)
        box, spans = _spans(first, width, bounds, limits, cells)
        lower, upper = spans[kind, :, place].T
        shift = rows @ fixed
        target = jnp.concatenate([wanted, jnp.zeros(len(third), first.dtype)]) - cost @ fixed
        answer = solve_least_squares_qp(
            cost @ spread, target, weight, *box[:, :free], moved, lower - shift, upper - shift, damping=_DAMPING
        )
        return home + fixed + spread @ answer.x, answer.status == Status.SOLVED

    # one by one: joints need different numbers of iterations
    found, feasible = jax.lax.map(solved, (wanted.T, state.T, bounds.T, limits.T))
    miss = jnp.where(is_ahead[:, None], weights @ found.T - points, 0.0)
    is_inside = _is_inside(jax.lax.stop_gradient(found.T), width, bounds, limits)
    return begin, width, found.T, miss, feasible & is_inside & is_finite


def _basis(time: Array, begin: Array, width: Array, cells: int) -> tuple[Float[Array, "T K3"], Bool[Array, " T"]]:
    """Return the weights of the coefficients in the spline at times, and whether these are not before the begin."""
    place = (time - begin) / width
    cell = jnp.clip(place.astype(int), 0, cells - 1)
    four = ((place - cell)[:, None] ** jnp.arange(4)) @ CUBIC.astype(time.dtype)
    chosen = (cell[:, None] + jnp.arange(4))[..., None] == jnp.arange(cells + 3)
    return jnp.einsum("tk,tkc->tc", four, chosen.astype(time.dtype)), place >= 0.0


def _time_to_rest(points: Array, time: Array, state: Array, limits: Array) -> Float[Array, ""]:
    """Return a time in which all joints can come to rest [s], from the start's speed or that of the last waypoints."""
    speed = jnp.maximum(jnp.abs(state[1]), jnp.abs(points[-1] - points[-2]) / (time[-1] - time[-2]))
    speed = jnp.minimum(speed, limits[0])
    ramp = jnp.minimum(2.0 * positive_root(speed / limits[2]), limits[1] / limits[2])
    ramp = jnp.where(jnp.isfinite(limits[2]), ramp, 0.0)
    return _ROOM * (speed / limits[1] + ramp + jnp.abs(state[2]) / limits[2]).max()


def _first_coefficients(state: Float[Array, "3"], width: Array) -> Float[Array, "3"]:
    """Return the three coefficients that give a spline its state at the start."""
    q, v, a = state * width ** jnp.arange(3)
    return jnp.stack([q - v + a / 3.0, q - a / 6.0, q + v + a / 3.0])


def _spans(
    first: Float[Array, "3"], width: Array, bounds: Float[Array, "2"], limits: Float[Array, "3"], cells: int
) -> tuple[Float[Array, "2 K"], Float[Array, "3 2 K"]]:
    """Return lower and upper bounds of the coefficients to come, and of their differences.

    Where even the hardest braking exceeds a limit, as right after a start near it, that braking is the bound. It is a
    little softer than the limits allow: with rounding, bounds that leave one answer would leave none.
    """
    hard = 1.0 - 0.1 * rounding(width)[1]
    speed, pull, jerk = limits * width ** jnp.arange(1, 4)
    steps = jnp.arange(1, cells + 1)

    def least(sign: float) -> tuple[Array, Array, Array]:
        """Return the upper bounds (sign 1), or the lower ones (-1), of coefficients and two differences."""
        before, slope = jnp.diff(sign * first)
        seconds = jnp.maximum(slope - before - steps * hard * jerk, -hard * pull)
        slopes = slope + jnp.cumsum(seconds)
        places = sign * first[2] + jnp.cumsum(slopes)
        fastest = jnp.minimum(speed, _below_peak(jnp.concatenate([jnp.stack([before, slope]), slopes[:-1]]), speed))
        ends = jnp.where(sign > 0.0, bounds[1], -bounds[0]), fastest, pull
        return tuple(sign * jnp.maximum(*pair) for pair in zip(ends, (places, slopes, seconds), strict=True))  # pyright: ignore

    spans = [jnp.stack(pair) for pair in zip(least(-1.0), least(1.0), strict=True)]
    jerks = jnp.stack([jnp.full(cells, -jerk), jnp.full(cells, jerk)])
    return spans[0], jnp.stack([*spans[1:], jerks])


def _below_peak(slopes: Float[Array, " K1"], speed: Array) -> Float[Array, " K"]:
    """Return the largest slope after each two for which the speed between the knots stays below its limit.

    Where a coefficient of the speed is above the limit, the speed is a parabola with the peak ``v + a^2 / (2 b)`` in
    the next cell, b being the braking. In units of the cell's width.
    """
    here, pull = slopes[1:], jnp.diff(slopes)
    room = speed - 0.5 * (slopes[1:] + slopes[:-1])
    is_above = (here > speed) & (pull > 0.0)
    braking = jnp.where(is_above, pull**2 / (2.0 * jnp.where(is_above & (room > 0.0), room, 1e-12)), 0.0)
    return jnp.where(is_above, here + pull - braking, jnp.inf)


def _is_inside(
    coefficients: Float[Array, "K3 n"], width: Array, bounds: Float[Array, "2 n"], limits: Float[Array, "3 n"]
) -> Bool[Array, " n"]:
    """Return whether each joint is within limits: positions and speeds at knots and where their slopes are 0 too."""
    four = jnp.stack([coefficients[i : len(coefficients) - 3 + i] for i in range(4)])
    cubics = jnp.einsum("ck,ktn->tcn", CUBIC.astype(width.dtype), four)
    _, b, c, d = (cubics[:, power] for power in range(4))
    root, tiny = positive_root(c**2 - 3.0 * b * d), jnp.finfo(width.dtype).tiny

    def share(above: Array, below: Array) -> Array:
        """Return a quotient inside the cell, 0 where it is outside."""
        quotient = above / jnp.where(jnp.abs(below) > tiny, below, 1.0)
        return jnp.where((quotient > 0.0) & (quotient < 1.0), quotient, 0.0)

    zero = jnp.zeros_like(b)
    places = [zero, zero + 1.0, share(-c, 3.0 * d), share(-b, c + root), share(-b, c - root)]
    states = jnp.stack([cubic_derivatives(cubics, x)[:2] for x in places])
    q, v = states[:, 0], jnp.abs(states[:, 1]) / width
    place, rate = rounding(width)
    past = jnp.maximum(q - bounds[1], bounds[0] - q)
    pull, jerk = (jnp.abs(jnp.diff(coefficients, n=order, axis=0)).max(axis=0) / width**order for order in (2, 3))
    slow = jnp.stack([v.max(axis=(0, 1)), pull, jerk]) <= (1.0 + 2.0 * rate) * limits
    return (past <= 2.0 * place).all(axis=(0, 1)) & slow.all(axis=0)
