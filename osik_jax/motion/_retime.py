"""Least time along a path under limits of speed, acceleration and jerk."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._errors import OsikTypeError, OsikValueError
from ..inverse._inverse_kinematics import joint_box
from ..kinematics import forward_kinematics
from ..numerics._arguments import as_floats, concrete
from ..numerics._dense import full_precision
from ..robot import Robot
from ..robot._joint_selection import check_scalar_joints, dof_names, dof_values
from ._cells import Cells
from ._jerk import PLACES, reference, rows_of, stretched
from ._least_time import largest_square, least_time
from ._spline import Spline, chord_lengths, cubic_derivatives, spline_through
from ._start import rounding
from ._timing import Timing, by_progress

Limit = ArrayLike | Mapping[str, float] | None
_CELLS, _FEWEST = 400, 4
_CHECKED = 5, 33
"""Places in each cell where limits are checked: the cells of the smooth motion may have knots inside."""


def retime(
    waypoints: Float[ArrayLike, "N n"] | Spline,
    *,
    velocity: Limit = None,
    acceleration: Limit = None,
    jerk: Limit = None,
    robot: Robot | None = None,
    frame: str | None = None,
    speed: Float[Array, ""] | float | None = None,
    cells: int | None = None,
) -> Timing:
    """Return the least-time motion from rest to rest along the cubic spline through waypoints.

    The spline has continuous second derivatives, and its parameter grows with the distance of waypoints. Without limits
    of jerk the answer is the optimum of the discretised problem, by reachability analysis. With them, a barrier method
    in the squared rate of progress follows, so accelerations are continuous. Then times are stretched by the factor
    ``stretch`` that keeps limits between the grid's points too.

    Works in ``jit`` and ``vmap``. ``duration`` has derivatives by waypoints and limits in both modes, which include how
    ``stretch`` and the grid change. With limits of jerk they follow from the implicit function theorem, and are of
    first order alone.

    Args:
        waypoints: positions of the joints [rad or m]; no two neighbours are equal. (N, n). Or a path, such as
            ``Way.path``.
        velocity: limits of the joints' speeds: an array (n,), one number for all joints, or with ``robot`` a mapping
            from joint names or globs. Default: those of ``robot``; none without one.
        acceleration: limits of accelerations, in the same way. They have to exist.
        jerk: limits of jerks, in the same way. Default: none; accelerations then jump.
        robot: the robot whose joints they are; hinges and slides alone.
        frame: frame of the robot whose origin is to have a certain speed.
        speed: wanted speed of the frame [m/s], kept where joints allow it, and lowered where not.
        cells: number of cells of the grid (static). Default: 400, or four for each segment of the path if that is more.

    Returns:
        The motion: ``at(time)`` and ``sample(dt)``.

    Raises:
        TypeError, ValueError: waypoints that are equal or not finite, fewer than two, limits that are not positive, or
            a robot with joints that are no hinges or slides; with ``robot``, waypoints outside of the joints' ranges.
        KeyError: no such joint or frame.
    """
    given = waypoints if isinstance(waypoints, Spline) else as_floats(waypoints)
    points = given.coefficients[:, 0] if isinstance(given, Spline) else given
    _check_points(points, robot)
    limits = checked_limits(robot, velocity, acceleration, jerk, points)
    if (frame is None) != (speed is None) or (frame is not None and robot is None):
        raise OsikTypeError("a wanted speed needs three arguments: robot=, frame= and speed=")
    wanted = checked_speed(speed)
    count = _count(points) if cells is None else cells
    smooth = jerk is not None
    path, progress, stretch, duration = _retimed(given, limits, robot, wanted, frame=frame, count=count, smooth=smooth)
    joints = () if robot is None else tuple(dof_names(robot))
    return Timing(duration, path, progress, limits, stretch, wanted, joints)


def _count(points: Array | np.ndarray) -> int:
    return max(_CELLS, _FEWEST * (len(points) - 1))


def retimed_pieces(
    pieces: Float[np.ndarray, "k P n"],
    limits: Array,
    robot: Robot,
    wanted: Array | None,
    frame: str,
    cells: int | None = None,
) -> list[Timing]:
    """Return the timings of pieces of a path, from rest to rest each, in one call."""
    own = {"frame": None if wanted is None else frame, "smooth": bool(np.isfinite(np.asarray(limits[2])).any())}
    own |= {"count": _count(pieces[0]) if cells is None else cells, "uniform": True}
    run = partial(_retimed, limits=limits, robot=robot, wanted=wanted, **own)
    path, progress, stretch, duration = jax.vmap(lambda points: run(points))(jnp.asarray(pieces))  # pyright: ignore
    found = jax.tree.map(np.asarray, (duration, path, progress, stretch))
    joints = tuple(dof_names(robot))
    timings = []
    for i in range(len(pieces)):
        duration, path, progress, stretch = jax.tree.map(lambda a, i=i: jnp.asarray(a[i]), found)
        timings.append(Timing(duration, path, progress, limits, stretch, wanted, joints))
    return timings


@partial(jax.jit, static_argnames="times")
@full_precision
def _resampled(pieces: Float[Array, "k P n"], *, times: int) -> Float[Array, "k R n"]:
    def one(points: Array) -> Array:
        path = _spline(points, True)
        return path.derivatives(_grid(path.knots, times))[0]

    return jax.vmap(one)(pieces)


def resampled(pieces: Float[np.ndarray, "k P n"], times: int) -> Float[np.ndarray, "S n"]:
    """Return points of the splines of pieces, ``times`` for each of their parts; shared ends come once."""
    found = np.asarray(_resampled(jnp.asarray(pieces), times=times))
    return np.concatenate([found[0], *(own[1:] for own in found[1:])])


def _spline(points: Float[Array, "N n"], uniform: bool) -> Spline:
    """Return the spline through points, by a parameter that grows evenly, or with the distance of points."""
    count = len(points)
    return spline_through(
        points, jnp.arange(count, dtype=points.dtype) / (count - 1.0) if uniform else chord_lengths(points)
    )


def checked_speed(speed: Any) -> Float[Array, ""] | None:
    """Return a wanted speed as an array, None without one."""
    if speed is None:
        return None
    wanted = as_floats(speed)
    if (seen := concrete(wanted)) is not None and not (seen.shape == () and seen > 0.0 and np.isfinite(seen)):
        raise OsikValueError(f"speed is {speed!r}; it is one positive number [m/s]")
    return wanted


def checked_limits(
    robot: Robot | None,
    velocity: Limit,
    acceleration: Limit,
    jerk: Limit,
    points: Array | None = None,
    *,
    least_time: bool = True,
) -> Float[Array, "3 n"]:
    """Return the limits of all kinds, infinite where there is none; ``points`` (N, n) without a robot.

    A least time needs a limit of acceleration.
    """
    like = robot.q0[None] if points is None and robot is not None else points
    given = {"velocity": velocity, "acceleration": acceleration, "jerk": jerk}
    limits = jnp.stack([_limit(robot, kind, value, like) for kind, value in given.items()])
    _check_limits(limits, robot, least_time)
    return limits


def _limit(robot: Robot | None, kind: str, value: Any, points: Any) -> Float[Array, " n"]:
    """Return one kind of limits for all joints, infinite where there is none."""
    none = jnp.full(points.shape[1], jnp.inf, points.dtype)
    if isinstance(value, Mapping):
        if robot is None:
            raise OsikTypeError(f"{kind} is a mapping, whose names need robot=")
        return dof_values(robot, value, getattr(robot, f"{kind}_limit", none), kind)
    own = none if robot is None else getattr(robot, f"{kind}_limit", none)
    given: Any = own if value is None else value
    try:
        return jnp.broadcast_to(jnp.asarray(given, points.dtype), none.shape)
    except ValueError as error:
        raise OsikValueError(
            f"{kind} has shape {np.shape(given)}; it is one number, or one for each of {len(none)} joints"
        ) from error


def _check_points(points: Array, robot: Robot | None) -> None:
    if points.ndim != 2 or len(points) < 2:
        raise OsikValueError(f"waypoints have shape {points.shape}; they are two or more configurations, (N, n)")
    if robot is not None:
        check_scalar_joints(robot, "a path")
        if robot.nq != points.shape[1]:
            raise OsikValueError(f"waypoints have {points.shape[1]} columns, and the robot {robot.nq} joints")
    seen = concrete(points)
    if seen is None:
        return
    if not np.isfinite(seen).all():
        raise OsikValueError(f"waypoint {int(np.argmin(np.isfinite(seen).all(axis=1)))} is not finite")
    if robot is not None:
        _check_ranges(robot, seen)
    equal = (seen[1:] == seen[:-1]).all(axis=1)
    if equal.any():
        first = int(equal.argmax())
        raise OsikValueError(f"waypoints {first} and {first + 1} are equal; a path has none twice in a row: remove one")


def _check_ranges(robot: Robot, points: np.ndarray) -> None:
    lower, upper = (np.asarray(end) for end in joint_box(robot, None))
    most = rounding(points)[0]
    outside = (points < lower - most) | (points > upper + most)
    if outside.any():
        row, joint = (int(i) for i in np.argwhere(outside)[0])
        raise OsikValueError(
            f"waypoint {row} has {points[row, joint]:g} of {dof_names(robot)[joint]!r}, whose range is "
            f"{lower[joint]:g} to {upper[joint]:g}: move it into the range"
        )


def _check_limits(limits: Array, robot: Robot | None, least_time: bool) -> None:
    seen = concrete(limits)
    if seen is None:
        return
    names = [str(i) for i in range(limits.shape[1])] if robot is None else dof_names(robot)
    for kind, row in zip(("velocity", "acceleration", "jerk"), seen, strict=True):
        if not (row > 0.0).all():
            which = [f"{name} {value:g}" for name, value in zip(names, row, strict=True) if not value > 0.0]
            raise OsikValueError(f"limits of {kind} are positive; these are not: {', '.join(which)}")
    if least_time and not np.isfinite(seen[1]).any():
        raise OsikValueError("there is no limit of acceleration, so no least time: give acceleration=")


@partial(jax.jit, static_argnames=("frame", "count", "smooth", "uniform"))
@full_precision
def _retimed(
    points: Float[Array, "N n"] | Spline,
    limits: Float[Array, "3 n"],
    robot: Robot | None,
    wanted: Array | None,
    *,
    frame: str | None,
    count: int,
    smooth: bool,
    uniform: bool = False,
) -> tuple[Spline, Cells, Array, Array]:
    """Return the spline, the progress, the factor that keeps limits between grid points, and the duration."""
    path = points if isinstance(points, Spline) else _spline(points, uniform)

    def cap(s: Array, first: Array) -> Array:
        """Return the largest squared path speed by the wanted speed of the frame."""
        if frame is None or robot is None or wanted is None:
            return jnp.full(len(s), jnp.inf, s.dtype)
        own, name = robot, frame
        rate = jax.vmap(lambda q, move: jax.jvp(lambda q: _origin(own, q, name), (q,), (move,))[1])
        return largest_square((rate(path.derivatives(s)[0], first) ** 2).sum(axis=1), wanted**2)

    grid = _grid(path.knots, -(-count // (len(path.knots) - 1)))
    _, first, second, _ = path.derivatives(grid)
    by_joints = largest_square((first / limits[0]) ** 2, jnp.ones((), grid.dtype)).min(axis=1)
    progress = least_time(grid, first, second, jnp.minimum(by_joints, cap(grid, first)), limits[1])
    if smooth:
        moving = jnp.isfinite(limits[2])
        ramp = jnp.max(jnp.where(moving, limits[1] / jnp.where(moving, limits[2], 1.0), 0.0))
        width, cubics = reference(progress, jnp.minimum(ramp, progress.start[-1]), count)
        at = jax.vmap(lambda x: cubic_derivatives(cubics, jnp.full(count, x)), out_axes=2)(
            width * jnp.asarray(PLACES, width.dtype)
        )
        thirds = jnp.stack([jnp.repeat(path.derivatives(at[0, :, end])[3], len(PLACES), axis=0) for end in (0, -1)])
        at = at.reshape(4, -1)
        states = path.derivatives(at[0])
        rows = rows_of(states, thirds, at, cap(at[0], states[1]), limits)
        progress = stretched(width, cubics, rows)
    ratio = _largest_ratio(path, progress, limits, cap, _CHECKED[smooth])
    progress = progress.slower(ratio)
    return path, progress, ratio, progress.start[-1]


def _origin(robot: Robot, q: Array, frame: str) -> Float[Array, "3"]:
    return forward_kinematics(robot, q).frame_pose(robot, frame)[0]


def _grid(knots: Float[Array, " N"], cells: int) -> Float[Array, " K1"]:
    """Return the knots with equal cells between them."""
    inner = knots[:-1, None] + jnp.diff(knots)[:, None] * jnp.arange(cells) / cells
    return jnp.append(inner.ravel(), knots[-1])


def _largest_ratio(
    path: Spline, progress: Cells, limits: Float[Array, "3 n"], cap: Any, places: int
) -> Float[Array, ""]:
    """Return by which factor times have to be multiplied so that limits hold inside the cells, at least 1."""
    powers = jnp.array([1.0, 0.5, 1.0 / 3.0], limits.dtype)
    ends = [path.derivatives(progress.inside(fraction)[0])[3] for fraction in (0.0, 1.0)]

    def ratio(moved: Array, thirds: Any) -> Array:
        """Return the ratio at some places, with the third derivatives on both sides of a knot."""
        states = path.derivatives(moved[0])
        largest = jnp.max(moved[1] / jnp.sqrt(cap(moved[0], states[1])))
        for third in thirds:
            used = jnp.abs(by_progress(states.at[3].set(third), moved)[1:]) / limits[:, None]
            largest = jnp.maximum(largest, jnp.max(jnp.maximum(jnp.max(used, axis=(1, 2)), 1.0) ** powers))
        return largest

    fractions = jnp.linspace(0.0, 1.0, places, dtype=limits.dtype)
    # the backward pass computes each place anew: kept, many paths would not fit into memory
    at = jax.checkpoint(lambda fraction: ratio(progress.inside(fraction), ends))
    inside = jnp.max(jax.lax.map(at, fractions))
    if len(path.knots) > 2:  # between two places of a cell
        sides = 6.0 * path.coefficients[:-1, 3], 6.0 * path.coefficients[1:, 3]
        inside = jnp.maximum(inside, ratio(progress.through(path.knots[1:-1]), sides))
    return jnp.maximum(inside, 1.0)


@partial(jax.jit, static_argnames="frame")
@full_precision
def _frame_speeds(robot: Robot, q: Float[Array, "T n"], v: Float[Array, "T n"], *, frame: str) -> Float[Array, " T"]:
    move = jax.vmap(lambda q, v: jax.jvp(lambda q: _origin(robot, q, frame), (q,), (v,))[1])(q, v)
    return jnp.linalg.norm(move, axis=1)


def frame_speeds(robot: Robot, frame: str, q: np.ndarray, v: np.ndarray) -> Float[np.ndarray, " T"]:
    """Return the speeds of a frame's origin [m/s]; few lengths are compiled."""
    count = len(q)
    more = ((0, (1 << (count - 1).bit_length()) - count), (0, 0))
    q, v = np.pad(q, more, mode="edge"), np.pad(v, more, mode="edge")
    return np.asarray(_frame_speeds(robot, jnp.asarray(q), jnp.asarray(v), frame=frame))[:count]
