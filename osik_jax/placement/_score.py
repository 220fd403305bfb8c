"""Scores of bases: how many poses each reaches, how far from its joints' limits, and how manipulable."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..collision import Scene
from ..inverse._chain_search import ChainSearch, Goal
from ..inverse._inverse_kinematics import inverse_kinematics
from ..inverse._reach import beyond
from ..inverse._solution import InverseKinematicsSolution
from ..kinematics._rigid import rotate
from ..numerics._host import module_of
from ..reachability._frame import Frame
from ..robot import Robot
from ._bases import base_poses, in_bases, scenes_in_bases

_PAIRS = 64, 1024
"""Pairs of a base and a pose in one call, if they are few or many: each number compiles anew."""
_NUMBERS = 8_000_000
"""Largest number of entries of all scenes of one call, so that they take about 100 MB."""


class Task(NamedTuple):
    """Poses, obstacles and settings by which bases are compared."""

    robot: Robot
    frames: tuple[Frame, ...]  # those that the poses are of, with their kinematics
    rows: tuple[tuple[bool, ...], ...]  # of each frame, which rows of its pose count
    goal: Goal  # the poses, in world axes; (poses, frames, ...)
    scene: Scene | None  # in world axes; None: collisions do not count
    settings: dict[str, Any]  # other arguments of ``inverse_kinematics``
    search: ChainSearch  # the coordinates that move the frames, with their limits

    @property
    def entries(self) -> np.ndarray:
        """Return the entries of q that the coordinates are."""
        return np.array(self.search.chain.layout.dofs, int)


class Scores(NamedTuple):
    """Scores of bases, the last axis of each array is that of the poses."""

    reached: Bool[np.ndarray, "n poses"]  # whether a configuration is found for each pose
    # distance of the nearest joint from its limit, over the joint's range; NaN if none is found
    margin: Float[np.ndarray, "n poses"]
    manipulability: Float[np.ndarray, "n poses"]  # Yoshikawa's index, the smallest of the frames; NaN if none is found
    q: Float[np.ndarray, "n poses nq"]  # the configurations; NaN if none is found

    @classmethod
    def empty(cls, task: Task, count: int) -> Scores:
        """Return the scores of bases that reach nothing."""
        shape = count, len(task.goal.position)
        sizes = shape, shape, (*shape, task.robot.nq)
        return cls(np.zeros(shape, bool), *(np.full(size, np.nan) for size in sizes))

    def put(self, pairs: Any, scores: Scores) -> None:
        """Write the scores of some pairs, given by numbers of bases and of poses, into these arrays."""
        for field, new in zip(self, scores, strict=True):
            field[tuple(pairs)] = new

    @property
    def table(self) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return for each base the number of poses reached, the smallest margin and the smallest index of them."""
        none = ~self.reached.any(1)
        fields = self.margin, self.manipulability
        margin, index = (np.where(none, np.nan, np.where(self.reached, part, np.inf).min(1)) for part in fields)
        return self.reached.sum(1), margin, index


def score_grid(task: Task, bases: Float[np.ndarray, "n 4"]) -> Scores:
    """Return the scores of bases, with all searches only where they can matter.

    Poses that are out of reach even with all links in one line have none. All others have an eighth of the searches at
    each base. Then the eighth of the bases with the most poses get all searches for the poses that they miss. The other
    bases get them for one pose after another, those first that fewest bases reach, until one is missed: such a base
    does not reach all poses.
    """
    scores, far = Scores.empty(task, len(bases)), is_too_far(task, bases)
    near = np.nonzero(~far)
    scores.put(near, _search_pairs(task, bases, *near, seeds=-(-task.settings["seeds"] // 8)))
    reached = scores.reached.sum(1)
    rank, rare = np.argsort(np.argsort(-reached, kind="stable")), np.argsort(scores.reached.sum(0), kind="stable")
    searched = scores.reached | far
    wanted = ~searched & (8 * rank < len(bases))[:, None]
    while True:
        pairs = np.nonzero(wanted)
        scores.put(pairs, _search_pairs(task, bases, *pairs))
        searched |= wanted
        may_reach_all = (searched == scores.reached).all(1)
        left = ~searched & may_reach_all[:, None]
        if not left.any():
            return scores
        wanted = np.zeros_like(left)
        some = np.flatnonzero(left.any(1))
        wanted[some, rare[left[some][:, rare].argmax(1)]] = True


def score_bases(task: Task, bases: Float[np.ndarray, "n 4"], *, every: bool = False) -> Scores:
    """Return the scores of bases after all searches for all poses.

    ``every``: take the configuration with the largest margin of all that are found, not the first one.
    """
    scores = Scores.empty(task, len(bases))
    pairs = np.indices(scores.reached.shape).reshape(2, -1)
    scores.put(pairs, _search_pairs(task, bases, *pairs, all=every))
    return scores


def is_too_far(task: Task, bases: Float[np.ndarray, "n 4"]) -> Bool[np.ndarray, "n poses"]:
    """Return whether each pose is out of reach of each base, even with all links in one line."""
    count, frames = task.goal.position.shape[:2]
    origin, turn = base_poses(bases)
    position = rotate(turn.swapaxes(-1, -2)[:, None], np.asarray(task.goal.position).reshape(-1, 3) - origin[:, None])
    away = np.asarray(_beyond(task.search, position.reshape(-1, frames, 3)))
    return away.reshape(-1, count) > task.settings["position_tolerance"]


@jax.jit
def _beyond(search: ChainSearch, position: Any) -> Array:
    return beyond(search.reaches, position, np.array(search.rows)[:, :3].all(-1))  # pyright: ignore[reportArgumentType]


def _search_pairs(task: Task, bases: np.ndarray, base: np.ndarray, pose: np.ndarray, **settings: Any) -> Scores:
    """Return the scores of pairs of a base and a pose, given by their numbers; the fields are (pairs,)."""
    count = len(base)
    if not count:
        return Scores(*(field[base, pose] for field in Scores.empty(task, len(bases))))
    few, many = _PAIRS
    each, scene = 1, task.scene  # entries of the scene of a pair
    if scene is not None:
        each = scene.capacity * (scene.capacity + 100) + 3 * len(scene.table.vertices)
    size = few if count <= 8 * few or each * many > _NUMBERS else many
    padded = np.arange(-(-count // size) * size) % count  # the last call has the first pairs again
    parts = []
    for k in range(0, len(padded), size):
        at = padded[k : k + size]
        found = solve_pairs(task, bases, base[at], pose[at], **settings)
        q = _roomiest(task, found) if settings.get("all") else np.asarray(found.q)
        margin = joint_margin(task.search, q[:, task.entries])
        parts.append((np.asarray(found.converged), margin, np.asarray(manipulability(task.frames, q)), q))
    reached, *fields = (np.concatenate(part)[:count] for part in zip(*parts, strict=True))
    return Scores(reached, *(np.where(reached.reshape(-1, *[1] * (a.ndim - 1)), a, np.nan) for a in fields))


def _roomiest(task: Task, found: InverseKinematicsSolution) -> np.ndarray:
    """Return the solution with the largest margin of each answer."""
    others = np.asarray(found.solutions)
    margin = np.nan_to_num(joint_margin(task.search, others[..., task.entries]), nan=-1.0)  # of rows without a solution
    return np.take_along_axis(others, margin.argmax(-1)[:, None, None], 1)[:, 0]


def solve_pairs(
    task: Task, bases: Float[np.ndarray, "n 4"], base: np.ndarray, pose: np.ndarray, **settings: Any
) -> InverseKinematicsSolution:
    """Return the answer for each pair of a base and a pose, given by their numbers, in the axes of the base."""
    own = bases[base]
    position, rotation = in_bases(own, *(np.asarray(part)[pose] for part in task.goal))
    poses = {
        frame.name: (position[:, k], rotation[:, k]) if all(rows) else position[:, k]
        for k, (frame, rows) in enumerate(zip(task.frames, task.rows, strict=True))
    }
    scene = None if task.scene is None else scenes_in_bases(task.scene, own)
    return inverse_kinematics(task.robot, poses, scene=scene, **{**task.settings, **settings})


def joint_margin(search: ChainSearch, x: Any) -> Any:
    """Return the smallest distance of a coordinate from its limits, over its range: 0.5 at the middle. (..., n)."""
    numbers = module_of(x)
    lower, upper = (numbers.asarray(end) for end in (search.lower, search.upper))
    limited = numbers.isfinite(upper - lower) & (upper > lower)
    share = numbers.minimum(x - lower, upper - x) / numbers.where(limited, upper - lower, 1.0)
    return numbers.min(numbers.where(limited, share, 0.5), -1, initial=0.5)


def manipulability(frames: Sequence[Frame], q: Any) -> Array:
    """Return Yoshikawa's index of configurations, the smallest of the frames. (n,)."""
    return jnp.min(jnp.stack([frame.manipulability(q) for frame in frames]), 0)
