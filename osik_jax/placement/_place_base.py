"""Search for the best pose of a robot's base."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..collision import CollisionShape, Scene
from ..collision._clearance import checked_clearance
from ..collision._robot_shapes import Given
from ..collision._scene import _convex_shapes, check_scene
from ..control._checks import check_setting, checked_start
from ..inverse._chain_problem import ChainRoute, search_of
from ..inverse._chain_search import Goal
from ..inverse._inverse_kinematics import checked_tolerances, joint_box
from ..inverse._poses import read_poses
from ..inverse._seeds import shift_of
from ..inverse._whole import carried_by
from ..kinematics._pose_forms import PoseLike
from ..numerics._arguments import check_count
from ..reachability._frame import read_frame
from ..reachability._grid import spread
from ..robot import Robot
from ._bases import AXES, base_clearances, checked_axis, grid_bases, stands_free
from ._gradient import Climber
from ._placement import Placement
from ._score import Task, is_too_far, joint_margin, manipulability, score_bases, score_grid, solve_pairs

_BEST = 6
"""Number of bases of the grid of which the best one is improved."""
_TURNS, _WHOLE = np.array([False, False, True, False]), 2.0 * np.pi - 1e-6
"""Which coordinates of a base turn it, and from which spread on they have no ends [rad]."""


def place_base(
    robot: Robot,
    poses: Mapping[str, PoseLike],
    *,
    x: ArrayLike,
    y: ArrayLike,
    yaw: ArrayLike | int = 8,
    height: ArrayLike = 0.0,
    scene: Scene | None = None,
    clearance: float = 0.0,
    footprint: CollisionShape | Sequence[CollisionShape] = (),
    q0: ArrayLike | Array | None = None,
    seeds: int = 32,
    refine: int = 3,
    key: int = 0,
    position_tolerance: float = 1e-3,
    orientation_tolerance: float = 1e-2,
    srdf: Given = None,
) -> Placement:
    """Return where to put a robot's base so that it reaches most of a set of poses, and how well each base does.

    All bases of a grid are tried in batches of ``inverse_kinematics``, with the poses and the scene in the axes of
    each base. A base is allowed only if what stands with it keeps ``clearance`` to the scene: the robot's shapes that
    no joint moves, and ``footprint``. Bases are compared by the number of poses reached, then by the smallest margin
    of a joint to its limits. Bases that cannot be the best get fewer searches (``Placement.reaches``).

    The best base is then moved off the grid, within its range; a yaw of a whole turn has no ends. While it misses
    poses, bases around it are tried, at half the grid's spacing and less. Base and configurations together climb the
    smallest margin of the poses reached: each step is a linear program of the exact derivatives, and is made only if
    the frames come back to their poses and nothing touches. The same arguments give the same answer.

    A pose that counts as reached has a configuration; one that does not was not found by ``seeds`` searches.

    Args:
        robot: the robot. The base is the origin of its model, so of a mobile robot the grid is of floor poses.
        poses: by the name of a frame, one or many poses in world axes, as for ``inverse_kinematics``.
        x: coordinates of the bases, increasing [m].
        y: likewise [m].
        yaw: rotations about the vertical, increasing [rad]; or how many to spread over a whole turn.
        height: heights of the base above the world's origin, increasing [m].
        scene: obstacles in world axes; then configurations are free of collisions. ``scene.allow(("stand", "link0"))``
            lets the base touch what it stands on. Default: none, and nothing collides.
        clearance: smallest distance of all pairs of shapes [m].
        footprint: more shapes that stand with the base, in its axes, such as a pedestal. Moving links may touch them.
        q0: where those joints stay that do not move the frames, such as open fingers. Default: ``robot.q0``. (nq,)
        seeds: number of searches for a pose at a base.
        refine: number of times that the best base is moved off the grid; 0: the best base of the grid, as it is.
        key: an integer: other starts of the searches.
        position_tolerance: largest distance from a pose [m].
        orientation_tolerance: largest angle to a pose [rad].
        srdf: pairs that may touch, as for ``inverse_kinematics``.

    Returns:
        A placement, as NumPy arrays. See ``Placement``.

    Raises:
        KeyError: no such frame; the message lists those that exist.
        TypeError: no robot, pose, scene or coordinates.
        ValueError: a frame that hinges and slides do not carry alone, coordinates that do not increase, a scene without
            the compiled core, or numbers out of range.
    """
    check_setting("place_base(robot, poses)", robot, None, 1.0)
    for name, value, least in (("seeds", seeds, 1), ("refine", refine, 0), ("key", key, 0)):
        check_count(name, value, least=least)
    axes, clearance = _axes(x, y, yaw, height), float(checked_clearance(clearance)[0])
    settings = dict(q0=q0, seeds=seeds, key=key, restarts=0, closest=False)
    settings |= dict(position_tolerance=position_tolerance, orientation_tolerance=orientation_tolerance)
    if scene is not None:
        check_scene(scene, single=True)
        settings |= dict(clearance=clearance, srdf=srdf)
    task = _read_task(robot, poses, scene, settings, key)
    solid = _convex_shapes("footprint", footprint)

    def gaps(bases: np.ndarray) -> tuple[np.ndarray, list[tuple[str, str]]]:
        if scene is None:
            return np.full(len(bases), np.inf), []
        return base_clearances(robot, bases, scene, srdf, solid)

    grid = grid_bases(axes)
    gap, pairs = gaps(grid)
    allowed = stands_free(gap, clearance)
    if not allowed.any():
        pair = pairs[int(gap.argmax())]
        raise OsikValueError(
            f"no base of the grid stands free: at the best one {pair[0]} and {pair[1]} are {gap.max():.3g} m apart. "
            f"Give other x, y or height; if the base stands on it, let them touch by scene=scene.allow({pair}), or "
            f"--allow {':'.join(pair)}"
        )
    scores, shape, count = score_grid(task, grid[allowed]), tuple(map(len, axes)), len(task.goal.position)
    best = grid[allowed][_order(*scores.table)[:_BEST]]
    margin, index = (spread(part, allowed, np.nan).reshape(shape) for part in scores.table[1:])
    base, q = _refined(task, best, axes, refine, lambda bases: stands_free(gaps(bases)[0], clearance))
    return Placement(
        robot=robot,
        scene=scene,
        clearance=clearance,
        poses=np.asarray(task.goal.position).reshape(-1, 3),
        **dict(zip(AXES, axes, strict=True)),
        base_clearance=gap.reshape(shape),
        blocked_by=dict(Counter(pair for pair, free in zip(pairs, allowed, strict=False) if not free).most_common()),
        reaches=spread(scores.reached, allowed, False).reshape(*shape, count),
        too_far=is_too_far(task, grid).sum(1).reshape(shape),
        margin=margin,
        manipulability=index,
        best=base,
        q=q,
        best_margin=joint_margin(task.search, q[:, task.entries]),
        best_manipulability=np.asarray(manipulability(task.frames, q)),
        solution=solve_pairs(task, base[None], np.zeros(count, int), np.arange(count)),
        task=task,
    )


def _axes(x: Any, y: Any, yaw: Any, height: Any) -> list[np.ndarray]:
    if isinstance(yaw, int | np.integer) and not isinstance(yaw, bool):
        check_count("yaw", yaw)
        yaw = np.arange(yaw) * (2.0 * np.pi / yaw)
    return [checked_axis(name, given) for name, given in zip(AXES, (x, y, yaw, height), strict=True)]


def _read_task(robot: Robot, poses: Any, scene: Scene | None, settings: dict[str, Any], key: int) -> Task:
    if not isinstance(poses, Mapping) or not poses:
        raise OsikValueError(f"poses is {type(poses).__name__}; it is a dictionary, name of a frame to its poses")
    frames = tuple(read_frame(robot, name, None, key) for name in poses)
    goal, rows, _ = read_poses(robot, poses)
    lower, upper = joint_box(robot, None)
    home = robot.q0 if settings["q0"] is None else checked_start(robot, settings["q0"])
    sizes = settings["position_tolerance"], settings["orientation_tolerance"]
    tolerance = jnp.asarray(checked_tolerances(*sizes, home.dtype))
    route, own = ChainRoute(tuple(poses), rows), carried_by(robot, lower, upper, frames=tuple(poses))
    shift = shift_of(key, len(own.lower))
    search = search_of(own, route, home, shift, tolerance, 1, warm=False, near=False)
    return Task(robot, frames, rows, goal, scene, settings, search)


def _refined(
    task: Task, bases: np.ndarray, axes: Sequence[np.ndarray], refine: int, stands: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the best of some bases, moved off the grid, and its configurations; ``stands``: which bases are free."""
    lower, upper = (np.array([axis[end] for axis in axes]) for end in (0, -1))
    steps = np.array([0.5 * float(np.diff(axis).min()) if len(axis) > 1 else 0.0 for axis in axes])
    spread = upper - lower + 2.0 * steps
    lower, upper = (np.where(_TURNS & (spread > _WHOLE), sign * np.inf, end) for sign, end in ((-1, lower), (1, upper)))
    base, q = _best_of(task, bases)
    for _ in range(refine if steps.any() else 0):
        if np.isnan(q).any():
            near = base + grid_bases([np.array([-1.0, 0.0, 1.0]) * step if step else np.zeros(1) for step in steps])
            near = near[stands(near) & ((near >= lower) & (near <= upper)).all(1)]
            base, q = _best_of(task, near[_order(*score_grid(task, near).table)[:1]])
        here = np.isfinite(q).all(-1)
        if here.any():
            part = task._replace(goal=Goal(*(field[here] for field in task.goal)))
            base, q[here] = Climber(part, lower, upper, steps, stands).climb(base, q[here])
            again = score_bases(task, base[None], every=True)
            worse = ~(joint_margin(task.search, q[:, task.entries]) >= again.margin[0])
            q[worse] = again.q[0][worse]
        steps = 0.5 * steps
    return base, q


def _best_of(task: Task, bases: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the best base, and for each pose its configuration with the largest margin."""
    scores = score_bases(task, bases, every=True)
    first = _order(*scores.table)[0]
    return bases[first], scores.q[first]


def _order(reached: np.ndarray, margin: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return the numbers of bases, best first: by poses reached, then by margin, then by manipulability."""
    return np.lexsort((-np.nan_to_num(index), -np.nan_to_num(margin), -reached))
