"""Search for the best pose of a robot's base."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Array
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..collision import CollisionShape, Scene
from ..collision._core import check_scene
from ..collision._robot_shapes import Given
from ..control._checks import check_setting
from ..inverse._free import checked_clearance
from ..inverse._poses import read_poses
from ..kinematics._pose_forms import PoseLike
from ..numerics._arguments import check_count
from ..reachability._frame import read_frame
from ..robot import Robot
from ._bases import AXES, base_clearances, checked_axis, grid_bases
from ._placement import Placement
from ._score import Scores, Task, score_bases, solve_bases

_BEST = 6
"""Number of bases of the grid that are improved."""


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

    All bases of a grid are tried in one batch of ``inverse_kinematics``, with the poses and the scene in the axes of
    each base. A base is allowed only if what stands with it keeps ``clearance`` to the scene: the robot's shapes that
    no joint moves, and ``footprint``. Bases are compared by the number of poses reached, then by the smallest margin
    of a joint to its limits. The best bases of the grid are then improved by a pattern search: steps of half the
    grid's spacing along each coordinate, halved ``refine`` times, with the configuration of the largest margin for each
    pose. The same arguments give the same answer.

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
        refine: number of halvings of the pattern search; 0: the best base of the grid, as it is.
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
    axes = _axes(x, y, yaw, height)
    settings = dict(q0=q0, seeds=seeds, key=key, restarts=0, closest=False)
    settings |= dict(position_tolerance=position_tolerance, orientation_tolerance=orientation_tolerance)
    if scene is not None:
        check_scene(scene)
        if scene.is_stack:
            raise OsikValueError("scene is a stack of scenes; give one scene, in world axes")
        settings |= dict(clearance=float(checked_clearance(clearance)[0]), srdf=srdf)
    task = _read_task(robot, poses, scene, settings, key)
    solid = [footprint] if isinstance(footprint, CollisionShape) else list(footprint)

    def gaps(bases: np.ndarray) -> np.ndarray:
        return np.full(len(bases), np.inf) if scene is None else base_clearances(robot, bases, scene, srdf, solid)

    grid = grid_bases(axes)
    gap = gaps(grid)
    allowed = gap >= clearance
    if not allowed.any():
        raise OsikValueError(
            f"no base of the grid stands free: the best one is {gap.max():.3g} m from the scene. Let the base touch "
            "what it stands on by scene.allow, or give other x, y or height"
        )
    reached, margin, index = _spread(allowed, score_bases(task, grid[allowed]).table)
    best = _order(reached, margin, index)[:_BEST]
    bases, scores = _improved(task, grid[best], axes, refine, lambda b: gaps(b) >= clearance)
    first = _order(*scores.table)[0]
    shape = tuple(map(len, axes))
    return Placement(
        robot=robot,
        scene=scene,
        clearance=float(clearance),
        poses=np.asarray(task.goal.position).reshape(-1, 3),
        **dict(zip(AXES, axes, strict=True)),
        base_clearance=gap.reshape(shape),
        reached=reached.reshape(shape),
        margin=margin.reshape(shape),
        manipulability=index.reshape(shape),
        best=bases[first],
        q=scores.q[first],
        best_margin=scores.margin[first],
        best_manipulability=scores.manipulability[first],
        solution=solve_bases(task, bases[first : first + 1]),
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
    return Task(robot, frames, rows, goal, scene, settings)


def _spread(allowed: np.ndarray, table: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the scores of the allowed bases as those of all bases: 0 and NaN for those that are not allowed."""
    whole = []
    for values in table:
        whole.append(np.full(len(allowed), 0 if values.dtype.kind == "i" else np.nan, values.dtype))
        whole[-1][allowed] = values
    return whole


def _order(reached: np.ndarray, margin: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return the numbers of bases, best first: by poses reached, then by margin, then by manipulability."""
    return np.lexsort((-np.nan_to_num(index), -np.nan_to_num(margin), -reached))


def _improved(
    task: Task, bases: np.ndarray, axes: Sequence[np.ndarray], refine: int, stands: Any
) -> tuple[np.ndarray, Scores]:
    """Return the bases after a pattern search, and their scores; ``stands``: whether bases are free of the scene."""
    scores = _scored(task, bases, stands)
    steps = np.array([0.5 * float(np.diff(axis).min()) if len(axis) > 1 else 0.0 for axis in axes])
    for _ in range(refine if steps.any() else 0):
        moves = np.concatenate([np.diag(steps), -np.diag(steps)])
        tried = bases[_order(*scores.table)[:1]] + moves[moves.any(1)]
        more = _scored(task, tried, stands)
        bases = np.concatenate([bases, tried])
        scores = Scores(*(np.concatenate(part) for part in zip(scores, more, strict=True)))
        steps *= 0.5
    return bases, scores


def _scored(task: Task, bases: np.ndarray, stands: Any) -> Scores:
    """Return the scores of bases; those that do not stand free reach no pose."""
    scores = score_bases(task, bases, every=True)
    return scores._replace(reached=scores.reached & stands(bases)[:, None])
