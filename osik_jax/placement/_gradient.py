"""Derivatives of the scores of a base, and the climb of the smallest margin by linear programs of them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import linprog
from scipy.sparse import block_diag, csr_array, hstack, vstack

from ..collision import is_free
from ..inverse._chain_problem import ENOUGH
from ..inverse._chain_search import ChainSearch, Goal
from ..numerics._dense import full_precision
from ._bases import in_bases, scenes_in_bases
from ._score import Task, joint_margin, manipulability

_TURN = 0.2
"""Largest motion of a joint in the first step of the climb [rad or m]."""
_STEPS, _CORRECTIONS = 12, 6
"""Steps of the climb at most, and steps after each that bring the frames back to their poses."""
_LEAST, _KEPT = 0.1, 0.5
"""Share of the first step below which the climb ends, and share of the smallest manipulability that it keeps."""
_TOUCH = 1e-6
"""Configurations keep so much more than the clearance, as in ``core/freedom.hpp`` [m]."""


class BaseGradient(NamedTuple):
    """Derivatives by x [m], y [m], yaw [rad] and height [m] of the base, of the poses that it reaches; NaN for others.

    The frames stay at their poses in the world: of all motions of the joints that keep them there it is the shortest.

    Attributes:
        margin: of ``Placement.best_margin``. (poses, 4)
        manipulability: of ``Placement.best_manipulability``. (poses, 4)
        q: of ``Placement.q``. (poses, nq, 4)
    """

    margin: Float[np.ndarray, "poses 4"]
    manipulability: Float[np.ndarray, "poses 4"]
    q: Float[np.ndarray, "poses nq 4"]


def base_gradient(task: Task, base: Float[np.ndarray, "4"], q: Float[np.ndarray, "poses nq"]) -> BaseGradient:
    """Return the derivatives of the scores of configurations by the base's coordinates."""
    known, entries = np.asarray(np.isfinite(q).all(-1)), task.entries
    q = np.where(known[:, None], q, np.asarray(task.robot.q0))
    moved = _motions(task, base, q[:, entries])[0]
    by_margin = jax.vmap(jax.grad(partial(joint_margin, task.search)))(jnp.asarray(q[:, entries]))
    by_q = jax.grad(lambda q: manipulability(task.frames, q).sum())(jnp.asarray(q))
    whole = np.zeros((len(q), q.shape[1], 4))
    whole[:, entries] = moved
    slopes = (np.einsum("pn,pnb->pb", by, to) for by, to in ((by_margin, moved), (by_q, whole)))
    return BaseGradient(*(np.where(known.reshape(-1, *[1] * (a.ndim - 1)), a, np.nan) for a in (*slopes, whole)))


def _motions(task: Task, base: np.ndarray, x: Float[np.ndarray, "p n"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivative of coordinates by the base (p, n, 4), and directions that move no frame (p, n, k).

    By the implicit function theorem on the frames' errors; of all motions the shortest.
    """
    matrix, aside = map(np.asarray, _linearised(task.search, task.goal, base, x))
    moved = -np.linalg.pinv(matrix) @ aside
    return moved, np.linalg.svd(matrix)[2][:, matrix.shape[1] :].swapaxes(1, 2)


@jax.jit
@full_precision
def _linearised(search: ChainSearch, goal: Goal, base: Any, x: Any) -> tuple[Array, Array]:
    """Return the derivative of the frames' errors by the coordinates (p, m, n), and by the base (p, m, 4)."""
    rows = jax.vmap(search.rows_at)
    aside = jax.jacfwd(lambda base: rows(x, goal_in_base(base, goal))[0])(base)
    return rows(x, goal_in_base(base, goal))[1], aside


def goal_in_base(base: Any, goal: Goal) -> Goal:
    """Return the poses in the axes of one base."""
    position, rotation = in_bases(base[None], *goal)
    return Goal(jnp.asarray(position), jnp.asarray(rotation))


class Climber(NamedTuple):
    """Climb of the smallest margin of the poses that a base reaches."""

    task: Task  # poses and scene
    lower: Float[np.ndarray, "4"]  # bounds of the base's coordinates
    upper: Float[np.ndarray, "4"]
    steps: Float[np.ndarray, "4"]  # largest first step of each
    stands: Callable[[np.ndarray], np.ndarray]  # whether bases stand free

    def climb(self, base: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a base and configurations with larger margins, from ones of poses that are reached.

        Each step is the linear program of the largest smallest margin, over motions of the base and of the joints that
        keep the frames at their poses. A step that does not hold is halved: one after which a frame is off its pose,
        something touches, or the smallest manipulability is below half of what it was.
        """
        radius, (margin, start) = 1.0, self._smallest(q)
        for _ in range(_STEPS):
            tried = self._corrected(*self._step(base, q, radius))
            more, index = (0.0, 0.0) if tried is None else self._smallest(tried[1])
            if tried is not None and more > margin and index >= _KEPT * start:
                (base, q), margin, radius = tried, more, min(2.0 * radius, 1.0)
            elif radius < _LEAST:
                break
            else:
                radius *= 0.5
        return base, q

    def _smallest(self, q: np.ndarray) -> tuple[float, float]:
        """Return the smallest margin and the smallest manipulability of some configurations."""
        margin = joint_margin(self.task.search, q[:, self.task.entries])
        return float(margin.min()), float(manipulability(self.task.frames, q).min())

    def _step(self, base: np.ndarray, q: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return base and configurations after a step by the linear program; the frames move a little.

        Its unknowns are the motion of the base, the smallest margin, the margin of each pose, and the motions of the
        joints that move no frame. Its inequalities are the joints' limits less their shares of the margins.
        """
        task, x = self.task, q[:, self.task.entries]
        moved, directions = _motions(task, base, x)
        (count, n), k = x.shape, directions.shape[-1]
        still = block_diag(list(directions)) if k else csr_array((count * n, 0))
        motion = hstack([csr_array(moved.reshape(-1, 4)), csr_array((count * n, 1 + count)), still]).tocsr()

        lower, upper = (np.tile(np.asarray(end), count) for end in (task.search.lower, task.search.upper))
        limited = np.flatnonzero(np.isfinite(upper - lower) & (upper > lower))
        lower, upper, at, motion_of = lower[limited], upper[limited], x.ravel()[limited], motion[limited]
        pose, number = limited // n, np.arange(count)
        share = csr_array((upper - lower, (np.arange(len(pose)), 5 + pose)), motion_of.shape)
        entries = np.tile([1.0, -1.0], count), (number.repeat(2), np.stack([0 * number + 4, 5 + number], 1).ravel())
        rows = vstack([share - motion_of, share + motion_of, csr_array(entries, (count, motion.shape[1]))])
        most = np.concatenate([at - lower, upper - at, np.zeros(count)])

        step = radius * self.steps
        low, high = np.maximum(-step, self.lower - base), np.minimum(step, self.upper - base)
        bounds = [*zip(np.minimum(low, 0.0), np.maximum(high, 0.0), strict=True), *[(None, None)] * (1 + count)]
        bounds += [(-radius * _TURN, radius * _TURN)] * (count * k)
        # the margin of each pose counts a little, or poses with more of it would lose what they have
        cost = np.concatenate([np.zeros(4), [-1.0], np.full(count, -0.1 / count), np.zeros(count * k)])
        found = linprog(cost, rows, most, bounds=bounds).x
        if found is None:
            return base, q
        q = q.copy()
        q[:, task.entries] += (motion @ found).reshape(x.shape)
        return base + found[:4], q

    def _corrected(self, base: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the configurations with the frames at their poses again; None if that fails, or something touches."""
        task, q = self.task, q.copy()
        q[:, task.entries], solved = _solved(task.search, task.goal, base, q[:, task.entries])
        if not (np.all(solved) and self.stands(base[None])[0]):
            return None
        if task.scene is None:
            return base, q
        scenes, srdf = scenes_in_bases(task.scene, np.tile(base, (len(q), 1))), task.settings["srdf"]
        free = is_free(task.robot, q, scenes, task.settings["clearance"] + _TOUCH, srdf=srdf)
        return (base, q) if np.all(free) else None


@jax.jit
@full_precision
def _solved(search: ChainSearch, goal: Goal, base: Any, x: Any) -> tuple[Array, Array]:
    """Return configurations after steps towards the poses, and whether they are there."""
    x, _, errors = search.finishing(exact=True).advance(x, goal_in_base(base, goal), _CORRECTIONS)
    return x, errors.score <= ENOUGH  # of a stretched arm the last millimetre of a tolerance is worth much margin
