"""Searches for poses of frames whose chains have hinges and slides, with joint limits alone."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from ..core import _library
from ..execution._computed import by_kernel
from ..numerics._guarded import greatest, safe_norm
from ._chain import Chain, ChainKinematics, chain_kinematics, curvature, jacobian
from ._chain_kernel import advanced
from ._error import rotation_error
from ._linear import ISOLATED, positive_pivot, solve_positive
from ._minimum import inverse_hessian, minimum
from ._pool import Errors, stepped
from ._reach import Reach
from ._seeds import unit_points
from ._turns import unwound

DAMPING = 0.03
"""Damping, as a fraction of the squared error: less overshoots from afar, more makes steps short."""
LEAST_DAMPING = 1e-5
"""Least damping, as a fraction of the squared length of a radian: bounds the steps of a singular arm near its target.
"""
_GAIN = 1e-4
"""A step towards a local optimum that promises less, relative to the position tolerance, is the last one."""


class Goal(NamedTuple):
    """Wanted poses of the frames."""

    position: Float[Array, "*lanes frames 3"]  # [m]
    rotation: Float[Array, "*lanes frames 3 3"]


def lanes_last(goal: Goal) -> Goal:
    """Return goals with the axis of lanes moved from the front to the end."""
    return Goal(jnp.moveaxis(goal.position, 0, -1), jnp.moveaxis(goal.rotation, 0, -1))


class ChainSearch(eqx.Module):
    """Levenberg-Marquardt steps with a damping proportional to the squared error, projected into the box.

    Such a damping needs no line search, and vanishes fast enough for quadratic convergence (T. Sugihara, "Solvability-
    unconcerned inverse kinematics by the Levenberg-Marquardt method", IEEE Transactions on Robotics 27(5), 2011). A
    joint at a limit beyond which the negative gradient points is left out of the step.
    """

    # of each frame, the rows that count: x, y, z, rotation about x, y, z
    rows: tuple[tuple[bool, ...], ...] = eqx.field(static=True)
    by_core: bool = eqx.field(static=True)  # whether the compiled core takes the steps where it is installed
    turns: tuple[bool, ...] = eqx.field(static=True)  # of each coordinate, whether a whole turn of it changes no pose
    chain: Chain  # geometry
    lower: Float[Array, " n"]  # of the chain's coordinates, -inf where free
    upper: Float[Array, " n"]
    reaches: list[Reach]  # bounds on where each frame gets
    low: Float[Array, " n"]  # of where searches start, finite
    high: Float[Array, " n"]
    first: Float[Array, " n"]  # where search 0 starts, used where ``warm``
    home: Float[Array, " nq"]  # the whole configuration that the coordinates are part of
    warm: bool = eqx.field(static=True)  # whether search 0 starts at ``first``
    # whether the nearest solution to ``first`` is wanted: searches start around it, and what the frames leave free goes
    # towards it
    near: bool = eqx.field(static=True)
    seeds: Float[Array, ""]  # number of searches that ``near`` spreads out
    shift: UInt[Array, " n"]  # of the sequence of starts
    length: Float[Array, ""]  # what a radian counts as [m]
    tolerance: Float[Array, "2"]  # of position [m] and orientation [rad], less what rounding may hide
    enough: Float[Array, ""]  # score at which a search stays where it is

    def begin(self, seed: Int[Array, " lanes"], goal: Goal) -> Float[Array, "lanes n"]:
        """Return the starts of the searches with these indices."""
        points = self.low + (self.high - self.low) * unit_points(self.shift, seed, self.low.dtype)
        if self.near:
            ratio = jnp.minimum(seed.astype(points.dtype) / self.seeds, 1.0)[:, None]
            points = self.first + ratio * (points - self.first)
        elif self.warm:
            points = jnp.where((seed == 0)[:, None], self.first, points)
        return jnp.clip(points, self.lower, self.upper)

    def advance(self, x: Float[Array, "lanes n"], goal: Goal, steps: Any) -> tuple[Array, Array, Errors]:
        """Return the state after some steps: start and end of the last one, and the errors at its start."""
        if self.by_core and _library.installed():
            return jax.vmap(partial(_by_kernel, steps=steps), (None, 0, 0))(self, x, goal)
        return self.advance_plain(x, goal, steps)

    def advance_plain(self, x: Float[Array, "lanes n"], goal: Goal, steps: Any) -> tuple[Array, Array, Errors]:
        """Return what ``advance`` does, by plain JAX."""
        turned = lanes_last(goal)
        here, there, errors = stepped(lambda x: self.step(x, turned), x.T, len(x), steps)
        return here.T, there.T, errors

    def step(self, x: Float[Array, "n lanes"], goal: Goal) -> tuple[Float[Array, "n lanes"], Errors]:
        """Return the next point, and the errors at the present one; lanes last. A finished search does not move."""
        error, matrix, errors = self.linearised(x, goal)
        gradient = _transposed_times(matrix, error)
        lower, upper = self.lower[:, None], self.upper[:, None]
        # a joint at a limit that the descent direction points beyond would be clipped there anyway
        free = ~(((x <= lower) & (gradient > 0.0)) | ((x >= upper) & (gradient < 0.0)))
        matrix = jnp.where(free, matrix, 0.0)
        damping = DAMPING * errors.cost + LEAST_DAMPING * self.length**2
        done, home = errors.score <= self.enough, jnp.zeros_like(x)
        if self.near:
            done, home = jnp.zeros_like(done), jnp.where(free, self.first[:, None] - x, 0.0)
            error = error + _times(matrix, home)
        move = home - _transposed_times(matrix, solve_positive(_gram(matrix, damping), error))
        return jnp.where(done, x, jnp.clip(x + move, lower, upper)), errors

    def newton_step(self, x: Float[Array, " n"], goal: Goal) -> Float[Array, " n"]:
        """Return the shortest step to the goal by the linear model at x; joints at a limit move with it."""
        aim = Goal(goal.position[..., None], goal.rotation[..., None])
        error, matrix, _ = self.linearised(x[:, None], aim)
        low, high = x <= self.lower, x >= self.upper
        forced = jnp.where(low, self.lower, jnp.where(high, self.upper, x)) - x
        error = error + _times(matrix, forced[:, None])
        matrix = jnp.where((low | high)[:, None], 0.0, matrix)
        # just above roundoff: at a regular solution it does not change the derivative, at a singular one it is finite
        ridge = 100.0 * jnp.finfo(x.dtype).eps * jnp.maximum(jnp.sum(matrix**2, (0, 1)), self.length**2)
        step = _transposed_times(matrix, solve_positive(_gram(matrix, ridge), error))
        return forced - step[:, 0]

    def moved(self, x: Float[Array, " n"], goal: Goal, rates: Any) -> Float[Array, " n"]:
        """Return the derivative of a solution x, or of a least error, for the rates of the search and the goal."""
        aim = Goal(goal.position[..., None], goal.rotation[..., None])
        error, matrix, curved = (part[..., 0] for part in self._measuring().model(x[:, None], aim))
        gradient = jnp.sum(matrix * error[:, None], 0)
        low, high = (x <= self.lower) & (gradient >= 0.0), (x >= self.upper) & (gradient <= 0.0)
        inverse = inverse_hessian(matrix, curved, ~(low | high))

        def slope(search: ChainSearch, goal: Goal) -> tuple[Array, Array]:
            placed = jnp.where(low, search.lower, jnp.where(high, search.upper, x))
            error, matrix = search._measuring().rows_at(placed, goal)
            return placed, jnp.sum(matrix * error[:, None], 0)

        _, along = jax.jvp(lambda search, goal: search.newton_step(x, goal), (self, goal), rates)
        _, (placed, turned) = jax.jvp(slope, (self, goal), rates)
        reached = self.linearised(x[:, None], aim)[2].score[0] <= self.enough
        return jnp.where(reached, along, placed - jnp.matmul(inverse, turned, precision="highest"))

    def rows_at(self, x: Float[Array, " n"], goal: Goal) -> tuple[Float[Array, " m"], Float[Array, "m n"]]:
        """Return the error of each used row [m] at x, and its derivative."""
        aim = Goal(goal.position[..., None], goal.rotation[..., None])
        # JAX 0.10 cannot transpose a scan where a cotangent is a symbolic 0
        error, matrix, _ = self._rows(x[:, None], aim, unrolled=True)
        return error[:, 0], matrix[..., 0]

    def sizes(self, error: Float[Array, " m"]) -> Float[Array, "2"]:
        """Return the largest position error [m] and orientation error [rad] of the used rows."""
        return greatest(jax.vmap(jax.vmap(safe_norm))(self.by_frame(error[:, None]).reshape(-1, 2, 3)).T)

    def by_frame(self, error: Float[Array, "m lanes"]) -> Float[Array, "frames 6 lanes"]:
        """Return the errors of the used rows [m] as those of all rows [m, rad]; 0 in rows that are not used."""
        used = np.nonzero(np.array(self.rows))
        scale = jnp.where(used[1] < 3, 1.0, self.length)[:, None]
        return jnp.zeros((len(self.rows), 6, error.shape[1]), error.dtype).at[used].set(error / scale)

    def polished(self, x: Float[Array, "lanes n"], goal: Goal) -> Float[Array, "lanes n"]:
        """Return solutions after one more step where that lowers the error; other configurations stay."""
        exact = self.finishing(exact=True)
        before, (after, _, errors) = exact.advance(x, goal, 1)[2], exact.advance(x, goal, 2)
        better = (before.score <= 1.0) & (errors.score < before.score)
        return jnp.where(better[:, None], after, x)

    def unwound(self, x: Float[Array, "*lanes n"]) -> Float[Array, "*lanes n"]:
        """Return the same poses, each joint turned as near to the first configuration as its limits allow."""
        return unwound(x, self.first, self.lower, self.upper, self.turns)

    def distance(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        """Return the distance from the start of search 0."""
        return jnp.sqrt(jnp.sum((x - self.first) ** 2))

    def finishing(self, exact: bool) -> ChainSearch:
        """Return the search for the last steps, without the term that pulls towards the first configuration.

        ``exact``: the search continues beyond the tolerances.
        """
        enough = jnp.zeros_like(self.enough) if exact else self.enough
        return dataclasses.replace(self, near=False, enough=enough)

    def isolated(self, x: Float[Array, "lanes n"], goal: Goal) -> Bool[Array, " lanes"]:
        """Return whether a solution is isolated: every motion of the joints moves a frame off its target."""
        matrix = self.linearised(x.T, lanes_last(goal))[1]
        if len(matrix) < x.shape[1]:
            # with fewer rows than joints there is always a motion that keeps the frames
            return jnp.zeros(len(x), bool)
        return positive_pivot(matrix) > (ISOLATED * self.length) ** 2

    def costs(self, x: Float[Array, "lanes n"], goal: Goal) -> Float[Array, " lanes"]:
        """Return the costs that ``local_optima`` minimises."""
        return 0.5 * self._measuring().linearised(x.T, lanes_last(goal))[2].cost

    def local_optima(
        self, x: Float[Array, "lanes n"], goal: Goal, open_: Bool[Array, " lanes"]
    ) -> tuple[Float[Array, "lanes n"], Float[Array, " lanes"], Int[Array, " lanes"]]:
        """Return local optima from some starts, their errors [m], and the steps taken; lanes that are not open stay."""
        own, turned, gain = self._measuring(), lanes_last(goal), _GAIN * self.tolerance[0]
        found = minimum(lambda x: own.model(x, turned), x.T, self.lower[:, None], self.upper[:, None], open_, gain)
        return found.x.T, jnp.sqrt(2.0 * found.cost), found.steps

    def _measuring(self) -> ChainSearch:
        """Return the search with errors in which a radian counts as the tolerances' ratio in metres."""
        return dataclasses.replace(self, length=self.tolerance[0] / self.tolerance[1])

    def model(self, x: Float[Array, "n lanes"], goal: Goal) -> tuple[Array, Array, Array]:
        """Return the error of each row that counts [m], and its derivatives.

        The second ones are multiplied by the error. (n, n, lanes).
        """
        error, matrix, (kinematics, linear, angular) = self._rows(x, goal)
        kept = np.array(self.rows)[..., None]
        linear, angular = jnp.where(kept[:, :3], linear, 0.0), jnp.where(kept[:, 3:], angular, 0.0)
        return error, matrix, curvature(self.chain, kinematics, linear, angular, self.length)

    def linearised(self, x: Float[Array, "n lanes"], goal: Goal) -> tuple[Array, Array, Errors]:
        """Return the error of each used row [m], its derivative (rows, n, lanes), and the frames' errors."""
        error, matrix, (_, linear, angular) = self._rows(x, goal)
        return error, matrix, self._errors(linear, angular, jnp.sum(error**2, 0))

    def _rows(
        self, x: Float[Array, "n lanes"], goal: Goal, *, unrolled: bool = False
    ) -> tuple[Array, Array, tuple[ChainKinematics, Array, Array]]:
        """Return the error of each used row, its derivative, and the kinematics and errors of the frames."""
        kinematics = chain_kinematics(self.chain, x, unrolled=unrolled)
        linear = kinematics.position - goal.position
        angular = rotation_error(kinematics.rotation, goal.rotation)
        scale = jnp.where(np.arange(6) < 3, 1.0, self.length).astype(x.dtype)
        kept = np.flatnonzero(np.array(self.rows).ravel())
        rows = jnp.concatenate([linear, angular], 1) * scale[:, None]
        matrix = jacobian(self.chain, kinematics) * scale[:, None, None]
        lanes = x.shape[-1]
        error = rows.reshape(-1, lanes)[kept]
        matrix = matrix.reshape(-1, len(x), lanes)[kept]
        return error, matrix, (kinematics, linear, angular)

    def _errors(self, linear: Array, angular: Array, cost: Array) -> Errors:
        kept = np.array(self.rows)
        sizes = [
            jnp.max(jnp.sqrt(jnp.sum(jnp.where(mask[:, :, None], part, 0.0) ** 2, 1)), 0)
            for part, mask in ((linear, kept[:, :3]), (angular, kept[:, 3:]))
        ]
        score = jnp.maximum(sizes[0] / self.tolerance[0], sizes[1] / self.tolerance[1])
        return Errors(sizes[0], sizes[1], score, cost)


def _one_lane(search: ChainSearch, x: Float[Array, " n"], goal: Goal, *, steps: int) -> tuple[Array, Array, Errors]:
    found = search.advance_plain(x[None], jax.tree.map(lambda a: a[None], goal), steps)
    return jax.tree.map(lambda a: a[0], found)


_by_kernel = by_kernel(_one_lane, partial(advanced, damping=(DAMPING, LEAST_DAMPING)))


def _times(matrix: Float[Array, "m n lanes"], vector: Float[Array, "n lanes"]) -> Float[Array, "m lanes"]:
    return jnp.sum(matrix * vector, 1)


def _transposed_times(matrix: Float[Array, "m n lanes"], vector: Float[Array, "m lanes"]) -> Float[Array, "n lanes"]:
    return sum((matrix[i] * vector[i] for i in range(1, len(matrix))), matrix[0] * vector[0])


def _gram(matrix: Float[Array, "m n lanes"], damping: Float[Array, " lanes"]) -> Float[Array, "m m lanes"]:
    """Return matrix matrix' + damping I."""
    parts = [matrix[:, None, k] * matrix[None, :, k] for k in range(matrix.shape[1])]
    return sum(parts[1:], parts[0]) + jnp.eye(len(matrix), dtype=matrix.dtype)[..., None] * damping
