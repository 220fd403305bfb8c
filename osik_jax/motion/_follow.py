"""From poses of frames to a timed motion of the joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from scipy.interpolate import CubicSpline

from .._errors import OsikTypeError, OsikValueError
from ..collision import Scene
from ..collision._robot_shapes import Given
from ..control._checks import checked_start
from ..inverse import inverse_kinematics
from ..inverse._inverse_kinematics import joint_box
from ..numerics._arguments import check_count
from ..robot import Robot
from ..robot._joint_selection import check_scalar_joints, dof_names
from ..tasks._pose import RADIAN
from ._joint_path import Free, PathSearch
from ._motion import Motion, one_axis, sample_times
from ._obstacles import Obstacles, spline_curves
from ._pose_path import Poses, corners, interpolated, lengths, read_poses
from ._retime import Limit, checked_limits, checked_speed, frame_speeds, resampled, retimed_pieces
from ._timing import SlowPart, Timing, sampled

_PARTS = 32, 1024
"""Fewest and most parts of each piece of the path, between two corners."""
_SHARE = 0.3  # of the tolerance that interpolation of the joints may use


class Followed(NamedTuple):
    """Motion along poses.

    Attributes:
        timings: of the pieces of the path, each from rest to rest; corners of the path are between them.
        starts: times at which they begin, and the end of the last one [s]. (pieces + 1,)
        position_error: largest distance of a frame from the smooth curve through its poses, between samples too [m].
        orientation_error: largest angle from it [rad].
        robot: the robot.
        frame: the first frame, whose speed is wanted.
    """

    timings: list[Timing]
    starts: Float[np.ndarray, " k"]
    position_error: float
    orientation_error: float
    robot: Robot
    frame: str

    @property
    def duration(self) -> float:
        """The whole time [s]."""
        return float(self.starts[-1])

    def at(self, time: Float[ArrayLike, " T"]) -> Float[np.ndarray, "4 T n"]:
        """Return positions, velocities, accelerations and jerks at times [s] (outside jit)."""
        time = np.clip(np.asarray(one_axis(time), float), 0.0, self.duration)
        piece = np.clip(np.searchsorted(self.starts, time, side="right") - 1, 0, len(self.timings) - 1)
        found = np.zeros((4, len(time), self.robot.nv))
        for i in np.unique(piece):
            found[:, piece == i] = sampled(self.timings[i], time[piece == i] - self.starts[i])
        return found

    def sample(self, dt: float) -> Motion:
        """Return the motion at times ``dt`` apart [s], the last of which is the end or just after it."""
        time = sample_times(self.duration, dt)
        q, v, a, _ = self.at(time)
        return Motion(*map(jnp.asarray, (time, q, v, a)), joints=tuple(dof_names(self.robot)))

    def slow_parts(self, dt: float = 0.005) -> list[SlowPart]:
        """Return where the first frame is slower than wanted by 1 %, and the joint and limit that are nearest there.

        Args:
            dt: time between the samples that are looked at [s].
        """
        found = []
        for start, timing in zip(self.starts, self.timings, strict=False):
            time = np.arange(0.0, float(timing.duration), dt)
            q, v = sampled(timing, time)[:2]
            parts = timing.slow_parts(frame_speeds(self.robot, self.frame, q, v), time)
            found += [part._replace(start=part.start + start, end=part.end + start) for part in parts]
        return found


def follow(
    robot: Robot,
    poses: Mapping[str, Any],
    *,
    free: Free | None = None,
    speed: float | None = None,
    velocity: Limit = None,
    acceleration: Limit = None,
    jerk: Limit = None,
    position_tolerance: float = 1e-4,
    orientation_tolerance: float = 1.7e-3,
    q0: Float[ArrayLike, " n"] | None = None,
    key: int | Array = 0,
    scene: Scene | None = None,
    clearance: float = 0.0,
    srdf: Given = None,
    cells: int | None = None,
) -> Followed:
    """Return a continuous, timed motion that leads frames along poses (outside jit).

    The frames move on smooth curves through their poses. At corners, where a path turns by more than 30 degrees, they
    stop. Branches of the inverse kinematics are chosen by dynamic programming over the whole path; the free motion of
    the joints is the smoothest near that choice. Each piece between corners is timed by ``retime``.

    Args:
        robot: the robot; hinges and slides alone (``locked_joints`` locks others).
        poses: by frame, two poses or more: positions (N, 3) alone, whose orientation is free; a pair of positions and
            quaternions w x y z (N, 4) or rotation matrices (N, 3, 3); or matrices (N, 4, 4).
        free: by frame, its own axis "x", "y" or "z" about which it may turn, such as ``{"tool": "z"}``.
        speed: wanted speed of the first frame [m/s], kept where joints allow it. Default: as fast as possible.
        velocity: limits of the joints' speeds, as in ``retime``.
        acceleration: limits of accelerations, likewise.
        jerk: limits of jerks, likewise.
        position_tolerance: largest distance of a frame from its curve [m].
        orientation_tolerance: largest angle [rad].
        q0: configuration to begin near. (n,)
        key: other searches for the branches.
        scene: obstacles, and what the robot holds. The whole path is proven free, not only samples.
        clearance: with a scene, the distance that all pairs of shapes keep [m].
        srdf: with a scene, pairs that may touch, as for ``inverse_kinematics``.
        cells: number of cells of the timing of each piece (static), as in ``retime``. With limits of jerk cells are
            equal times; a slow, long piece needs more to reach the wanted speed as soon as joints allow.

    Returns:
        The motion: ``at(time)``, ``sample(dt)``, ``slow_parts()``.

    Raises:
        KeyError: no such frame or joint.
        TypeError: ``free`` is no axis.
        ValueError: poses that are out of reach (the message says which, by how much and why), one pose, two equal
            poses in a row, or no continuous path through poses that are in reach one by one.
        OsikError: a scene without the compiled core, or not on a CPU.
    """
    check_scalar_joints(robot, "following poses")
    read, free = read_poses(robot, poses), _checked_free(poses, free)
    limits, wanted = checked_limits(robot, velocity, acceleration, jerk), checked_speed(speed)
    if cells is not None:
        check_count("cells", cells, least=8)
    along = lengths(read)
    start = None if q0 is None else checked_start(robot, q0)
    lower, upper = (np.asarray(end) for end in joint_box(robot, None))
    obstacles = None if scene is None else Obstacles.read(robot, scene, clearance, srdf, "follow with a scene")
    search = PathSearch(robot, free, lower, upper, start, key, obstacles)
    path, errors = _within_tolerance(search, read, along, (position_tolerance, orientation_tolerance))
    frame = next(iter(read))
    timings = retimed_pieces(path, limits, robot, wanted, frame, cells)
    if obstacles is not None:
        _check_clear(robot, obstacles, timings)
    starts = np.append(0.0, np.cumsum([float(one.duration) for one in timings]))
    return Followed(timings, starts, *errors, robot, frame)


def _check_clear(robot: Robot, obstacles: Obstacles, timings: list[Timing]) -> None:
    """Raise ValueError unless the splines of all pieces are proven free."""
    for piece, timing in enumerate(timings):
        curves = spline_curves(np.asarray(timing.path.knots), np.asarray(timing.path.coefficients))
        is_clear = obstacles.are_clear(robot, curves)
        if not is_clear.all():
            first = int(np.argmin(is_clear))
            pair = obstacles.nearest(robot, np.array([0.125, 0.375, 0.375, 0.125]) @ curves[first])
            raise OsikValueError(
                f"between two poses the path does not keep the clearance, {(first + 0.5) / len(curves):.0%} along "
                f"piece {piece} of {len(timings)}: {pair}. Give more poses there, or a smaller clearance"
            )


def _checked_free(poses: Mapping[str, Any], free: Free | None) -> Free:
    for name, axis in (free or {}).items():
        if name not in poses or axis not in ("x", "y", "z"):
            raise OsikTypeError(f'free has {name!r}: {axis!r}; it is, by frames with poses, the axis "x", "y" or "z"')
    return free or {}


def _within_tolerance(
    search: PathSearch, poses: Mapping[str, Poses], along: np.ndarray, tolerance: tuple[float, float]
) -> tuple[Float[np.ndarray, "k P n"], tuple[float, float]]:
    """Return the pieces of a joint path whose splines keep the frames on their curves, and the largest errors."""
    pieces = len(corners(poses)) - 1
    parts = max(_PARTS[0], 1 << int(np.ceil(np.log2(max(1, len(along) // pieces)))))
    path = None
    while True:
        at = interpolated(poses, along, parts)
        if path is None:
            path = search.path(at, np.linspace(0.0, 1.0, pieces * parts + 1))
            if path is None:
                raise OsikValueError(_why_not(search, poses))
        else:
            path = search.refined(_doubled(path), at)
        split = np.stack([path[i * parts : (i + 1) * parts + 1] for i in range(pieces)])
        errors = _errors_between(search, split, poses, along)
        if errors[0] <= _SHARE * tolerance[0] and errors[1] <= _SHARE * tolerance[1]:
            return split, errors
        if 2 * parts > _PARTS[1]:
            raise OsikValueError(
                f"between poses the path is {errors[0]:.3g} m and {errors[1]:.3g} rad off its curve, {parts} parts a "
                "piece: give larger tolerances, or poses that are farther from singularities"
            )
        parts *= 2


def _doubled(path: np.ndarray) -> np.ndarray:
    """Return a path with one point between each two, by cubic interpolation."""
    return CubicSpline(np.arange(len(path)), path)(np.arange(2 * len(path) - 1) / 2.0)


def _errors_between(
    search: PathSearch, pieces: np.ndarray, poses: Mapping[str, Poses], along: np.ndarray
) -> tuple[float, float]:
    """Return the largest distance [m] and angle [rad] from the curves, at four samples to each part."""
    fine = interpolated(poses, along, 4 * (pieces.shape[1] - 1))
    is_angle = np.concatenate([[False] if one.rotation is None else [False, True] for one in fine.values()])
    errors = search.errors(resampled(pieces, 4), fine)[0].reshape(-1, len(is_angle), 3)
    largest = np.linalg.norm(errors, axis=2).max(axis=0)
    return float(largest[~is_angle].max()), float(largest[is_angle].max(initial=0.0))


def _why_not(search: PathSearch, poses: Mapping[str, Poses]) -> str:
    """Return why there is no path: the poses that cannot be reached, or that none is continuous."""
    found = [
        inverse_kinematics(search.robot, targets, key=search.key, **search.around) for targets in search.targets(poses)
    ]
    missed = np.flatnonzero(~np.any([one.converged for one in found], axis=0))
    if len(missed) == 0:
        return "each pose can be reached, and no continuous path through all was found: try another key, free= or q0"
    shown = ", ".join(map(str, missed[:10])) + (", ..." if len(missed) > 10 else "")
    first = int(missed[0])
    nearest = min(found, key=lambda one: float(one.position_error[first] + RADIAN * one.orientation_error[first]))
    count = len(next(iter(poses.values())).position)
    return f"{len(missed)} of {count} poses cannot be reached: {shown}. Pose {first}: {nearest.explain(first)}"
