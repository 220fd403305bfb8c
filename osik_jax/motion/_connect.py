"""Ways around obstacles, by the core (``core/way_around.hpp``)."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float, Int

from .._errors import OsikTypeError, OsikValueError
from ..collision import Scene
from ..collision._clearance import shape_names
from ..collision._core import check_length, ways
from ..collision._robot_shapes import Given
from ..numerics._arguments import check_count
from ..numerics._host import is_traced
from ..robot import Robot
from ..robot._joint_selection import check_scalar_joints, dof_names, dofs_of, select_all
from ._jerk import CUBIC
from ._obstacles import Obstacles
from ._retime import Limit, retime
from ._spline import Spline
from ._timing import Timing

STATES = 400_000
"""Configurations that a search tries at most, by default: a few seconds."""
_LONGEST = 256
"""Vertices that a way has at most."""
_STEP = 0.1
"""A tree grows by this share of the distance between the corners of the ranges at a time, at most."""
_OUTSIDE = 1e-6
"""Tolerance of the ranges for a start and a goal, because of rounding [rad or m]."""
_FOUND, _BAD_START, _BAD_GOAL, _NOT_FOUND = range(4)
_REASONS = {
    _BAD_START: "the start does not keep the clearance",
    _BAD_GOAL: "no goal keeps the clearance",
    _NOT_FOUND: "no way was found: give states= more than {states}, or another key",
}


class Way(NamedTuple):
    """A way from a configuration to another one, in which all pairs of shapes keep the clearance.

    Attributes:
        vertices: corners of the straight lines, from the start to the goal; none if no way was found. (k, n)
        path: the lines with round corners, a spline with continuous second derivatives; None if there is no way, or the
            start is a goal. All of it is proven free, not only samples.
        goal: number of the goal that is reached.
        problem: why there is no way; empty if there is one.
        states: configurations that the search has tried.
        robot: the robot.
    """

    vertices: Float[np.ndarray, "k n"]
    path: Spline | None
    goal: int
    problem: str
    states: int
    robot: Robot

    @property
    def found(self) -> bool:
        """True if a way was found."""
        return not self.problem

    def retime(
        self,
        *,
        velocity: Limit = None,
        acceleration: Limit = None,
        jerk: Limit = None,
        frame: str | None = None,
        speed: float | None = None,
    ) -> Timing:
        """Return the least-time motion along the path; arguments and errors as of ``osik_jax.motion.retime``.

        Raises:
            ValueError: there is no path.
        """
        if self.path is None:
            raise OsikValueError(self.problem or "the start is a goal: there is nothing to time")
        by_frame: dict[str, Any] = {"robot": self.robot, "frame": frame, "speed": speed}
        return retime(self.path, velocity=velocity, acceleration=acceleration, jerk=jerk, **by_frame)


def connect(
    robot: Robot,
    q_from: Float[ArrayLike, "*b n"],
    q_to: Float[ArrayLike, "*b g n"],
    scene: Scene,
    *,
    clearance: float = 0.0,
    srdf: Given = None,
    joints: Iterable[str] | None = None,
    states: int = STATES,
    key: int = 0,
) -> Way | list[Way]:
    """Return a way around obstacles from a configuration to a goal (outside jit).

    The straight line is tried first, then two trees grow towards each other (RRT-Connect, Kuffner and LaValle, 2000),
    then shortcuts are taken and corners made round. Each curve is proven free by the distances of shapes and how far
    joints can move them (Schwarzer, Saha and Latombe, 2005). Another scene of the same capacity compiles nothing.

    Args:
        robot: the robot; hinges and slides alone (``locked_joints`` locks others).
        q_from: start. With an axis in front there are many, each with goals of its own. (n,) or (b, n)
        q_to: goal, or several of which the search takes the one it reaches, such as grasps. (n,), (g, n), (b, n) or
            (b, g, n)
        scene: the obstacles and what the robot holds: one scene, or a stack with one for each start.
        clearance: distance that all pairs of shapes keep [m].
        srdf: pairs that may touch, as for ``inverse_kinematics``.
        joints: names or globs of the joints that may move. Default: all.
        states: configurations that a search tries at most; the effort for one start.
        key: of the random numbers. The same key gives the same way.

    Returns:
        The way; a list of them if there are many starts.

    Raises:
        OsikError: no compiled core, or no CPU.
        TypeError: traced arguments, or a scene that is no ``Scene``.
        ValueError: arrays of wrong shapes, numbers that are not finite, or a joint that may not move and is elsewhere
            at a goal.
        KeyError: no such joint.
    """
    if is_traced((robot, q_from, q_to, scene, clearance)):
        raise OsikTypeError("connect makes paths of any length: call it outside jit, vmap and grad")
    obstacles = Obstacles.read(robot, scene, clearance, srdf, "connect")
    check_scalar_joints(robot, "a way")
    starts, goals, many = _read(robot, q_from, q_to)
    if scene.is_stack and not many:
        raise OsikValueError("a stack of scenes goes with as many starts: give q_from as (scenes, n)")
    moving = np.array(dofs_of(robot, select_all(robot, joints)), np.int32)
    _check_held(robot, starts, goals, moving)
    check_count("states", states)
    check_length(obstacles.around, len(starts), "starts")
    outside = [_outside(robot, start, own) for start, own in zip(starts, goals, strict=True)]
    goals, numbers = _usable(robot, starts, goals, np.array([bool(text) for text in outside]))
    ranges = [*_ranges(robot, starts, goals, moving), np.array([_STEP])]
    given = obstacles.for_core(robot, moving, ranges, states, key)
    vertices, radii, labels = map(np.asarray, _ways(starts, goals, *given, longest=_LONGEST))
    names = obstacles.shapes.names, scene.names
    found = []
    for lane, (status, goal, count, tried, *pair) in enumerate(labels.tolist()):
        problem = outside[lane]
        if status != _FOUND and not problem:
            pair = shape_names(*names, np.array(pair), lane)
            problem = _REASONS[status].format(states=states) + (
                f": {pair[0]} and {pair[1]}" if status < _NOT_FOUND else ""
            )
        corners = np.repeat(starts[lane][None], 0 if problem else count, axis=0)
        corners[:, moving] = vertices[lane, : len(corners)]
        path = _rounded(corners, radii[lane], robot) if len(corners) > 1 else None
        reached = goal if problem else int(numbers[lane, goal])
        found.append(Way(corners, path, reached, problem, tried, robot))
    return found if many else found[0]


_ways = partial(jax.jit, static_argnames="longest")(ways)


def _read(robot: Robot, q_from: ArrayLike, q_to: ArrayLike) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return starts (b, n), goals (b, g, n), and whether there are many starts."""
    starts, goals = np.asarray(q_from, float), np.asarray(q_to, float)
    many = starts.ndim == 2
    if many and goals.ndim == 2:
        goals = goals[:, None]
    if starts.ndim == 1:
        starts, goals = starts[None], np.atleast_2d(goals)[None]
    good = starts.ndim == 2 and goals.ndim == 3 and len(starts) == len(goals) and min(starts.size, goals.size) > 0
    if not good or {starts.shape[-1], goals.shape[-1]} != {robot.nq}:
        raise OsikValueError(
            f"q_from has shape {np.shape(q_from)} and q_to {np.shape(q_to)}; configurations have {robot.nq} entries, "
            "and several starts have as many goals, or groups of goals"
        )
    for what, values in (("q_from", starts), ("q_to", goals)):
        if not np.isfinite(values).all():
            raise OsikValueError(f"{what} is not finite")
    return starts, goals, many


def _check_held(robot: Robot, starts: np.ndarray, goals: np.ndarray, moving: np.ndarray) -> None:
    held = np.setdiff1d(np.arange(robot.nq), moving)
    apart = np.abs(goals - starts[:, None])[..., held].max(axis=(0, 1), initial=0.0) > _OUTSIDE
    if apart.any():
        names = [dof_names(robot)[k] for k in held[apart]]
        raise OsikValueError(f"these joints may not move, and are elsewhere at a goal: {', '.join(names)}")


def _ranges(robot: Robot, starts: np.ndarray, goals: np.ndarray, moving: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ranges in which trees grow: those of the joints, half a turn around the ends where there is none."""
    ends = np.concatenate([starts, goals.reshape(-1, robot.nq)])
    lower, upper = np.asarray(robot.position_lower, float), np.asarray(robot.position_upper, float)
    lower = np.where(np.isfinite(lower), lower, ends.min(axis=0) - np.pi)
    return lower[moving], np.where(np.isfinite(upper), upper, ends.max(axis=0) + np.pi)[moving]


def _beyond(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return by how much each joint (..., n) is outside of its range [rad or m], 0 or less inside."""
    return np.maximum(np.asarray(robot.position_lower, float) - q, q - np.asarray(robot.position_upper, float))


def _usable(
    robot: Robot, starts: np.ndarray, goals: np.ndarray, is_refused: np.ndarray
) -> tuple[Float[np.ndarray, "b g n"], Int[np.ndarray, "b g"]]:
    """Return goals to search for, and the number of each: the first usable goal in place of ones out of range.

    In lanes that are refused the goal is the start, so the search ends at once.
    """
    inside = (_beyond(robot, goals) <= _OUTSIDE).all(axis=-1)
    numbers = np.where(inside, np.arange(goals.shape[1]), inside.argmax(axis=1)[:, None])
    usable = np.take_along_axis(goals, numbers[..., None], axis=1)
    return np.where(is_refused[:, None, None], starts[:, None], usable), numbers


def _outside(robot: Robot, start: np.ndarray, goals: np.ndarray) -> str:
    """Return which joint of the start, or of all goals, is outside of its range; empty if none is."""

    def text(q: np.ndarray, what: str) -> str:
        beyond = _beyond(robot, q)
        worst = int(beyond.argmax())
        if beyond[worst] <= _OUTSIDE:
            return ""
        return f"{what}: joint {dof_names(robot)[worst]} is {beyond[worst]:.3g} outside of its range"

    wrong = [text(goal, "q_to") for goal in goals]
    return text(start, "q_from") or ("" if "" in wrong else wrong[0])


def _rounded(vertices: Float[np.ndarray, "k n"], radii: Float[np.ndarray, " k"], robot: Robot) -> Spline:
    """Return the lines between vertices with round corners, two cubics each; the parameter is the length by the sum.

    A corner is the uniform cubic B-spline with five points: the vertex, and points ``radius`` and twice that before and
    after it.
    """
    pieces: list[tuple[float, np.ndarray]] = []
    legs = np.diff(vertices, axis=0)
    lengths = np.linalg.norm(legs, axis=1)
    ways = legs / lengths[:, None]
    for k, (here, way, length) in enumerate(zip(vertices, ways, lengths, strict=False)):
        last = radii[k + 1] if k + 2 < len(vertices) else 0.0
        first = radii[k] if k else 0.0
        if length - first - last > 1e-9 * length:
            line = np.stack([here + first * way, way, 0.0 * way, 0.0 * way])
            pieces.append((length - first - last, line))
        if k + 2 < len(vertices):
            corner, after = vertices[k + 1], ways[k + 1]
            points = np.stack([corner - 2 * last * way, corner - last * way, corner, corner + last * after])
            points = np.concatenate([points, [corner + 2 * last * after]])
            pieces += [(last, _cubic(points[j : j + 4], last)) for j in range(2)]
    while len(pieces) < max(8, 1 << (len(pieces) - 1).bit_length()):  # few numbers of pieces are compiled
        widest = max(range(len(pieces)), key=lambda k: pieces[k][0])
        pieces[widest : widest + 1] = _halves(*pieces[widest])
    knots = np.append(0.0, np.cumsum([width for width, _ in pieces]))
    powers = knots[-1] ** np.arange(4)[:, None]
    coefficients = np.stack([powers * own for _, own in pieces])
    return Spline(*(jnp.asarray(a, robot.q0.dtype) for a in (knots / knots[-1], coefficients)))


def _cubic(points: Float[np.ndarray, "4 n"], width: float) -> Float[np.ndarray, "4 n"]:
    """Return the coefficients of a piece of the uniform cubic B-spline."""
    return CUBIC @ points / width ** np.arange(4)[:, None]


def _halves(width: float, own: Float[np.ndarray, "4 n"]) -> list[tuple[float, np.ndarray]]:
    (a, b, c, d), half = own, width / 2
    later = np.stack([a + half * (b + half * (c + half * d)), b + half * (2 * c + 3 * half * d), c + 3 * half * d, d])
    return [(half, own), (half, later)]
