"""The hierarchy and its answer, as pytrees."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from .._box import uncrossed
from .._dense import apply


class Tolerances(NamedTuple):
    """What counts as zero, relative to the scale of the quantity at hand."""

    rank: Float[Array, ""] | float = 1e-10  # part of a row outside the span of others, relative to the row
    step: Float[Array, ""] | float = 1e-13  # change of the level's rows by a step, relative to their scale
    multiplier: Float[Array, ""] | float = 1e-10  # multiplier, relative to the level's gradient
    feasible: Float[Array, ""] | float = 1e-11  # violation of a row, relative to its scale


class Level(eqx.Module):
    """One priority: rows that should lie in an interval, as nearly as the levels above allow.

    Attributes:
        matrix: A. (m, n); m may be 0.
        lower: of A x; equal to ``upper`` for an equality, -inf for none; above it, the middle stands for both and the
            answer is INFEASIBLE. (m,)
        upper: of A x; inf for none. Leave it out where all rows are equalities: it is then ``lower``, and the solver
            need not look for the rows that are not. (m,)
        weight: of the squared distances of the rows to their intervals, >= 0; None for ones. (m,)
        equalities: rows that are equalities whatever ``upper`` says, which is not looked at there: all where ``upper``
            was left out (static). Name them where bounds are computed under ``jit``: XLA may compute an expression
            twice, in two roundings, and what was one number is then two. (m,)
    """

    matrix: Float[Array, "m n"]
    lower: Float[Array, " m"]
    upper: Float[Array, " m"]
    weight: Float[Array, " m"] | None
    equalities: tuple[bool, ...] = eqx.field(static=True)

    def __init__(
        self,
        matrix: ArrayLike | Array,
        lower: ArrayLike | Array,
        upper: ArrayLike | Array | None = None,
        weight: ArrayLike | Array | None = None,
        equalities: Sequence[bool] | None = None,
    ):
        self.matrix = jnp.asarray(matrix)
        self.lower = jnp.asarray(lower, self.matrix.dtype)
        count = self.matrix.shape[-2]
        self.equalities = (upper is None,) * count if equalities is None else tuple(map(bool, equalities))
        self.upper = self.lower if upper is None else jnp.asarray(upper, self.matrix.dtype)
        self.weight = None if weight is None else jnp.asarray(weight, self.matrix.dtype)
        rows = self.matrix.shape[:-1]
        for name, array in (("lower", self.lower), ("upper", self.upper), ("weight", self.weight)):
            if array is not None and array.shape != rows:
                raise ValueError(f"{name} has shape {array.shape}; the matrix {self.matrix.shape} asks for {rows}")
        if len(self.equalities) != count:
            raise ValueError(f"equalities has {len(self.equalities)} flags; the matrix has {count} rows")

    @property
    def equality(self) -> bool:
        """Whether all rows are known to be equalities."""
        return all(self.equalities)

    @property
    def equal(self) -> Bool[Array, " m"]:
        """Rows to be treated as equalities: those known to be, and those whose bounds are equal or crossed."""
        counts = True if self.weight is None else self.weight > 0.0
        return jnp.array(self.equalities, bool) | ((self.lower >= self.upper) & counts)

    @property
    def length(self) -> Float[Array, " m"]:
        """Euclidean norm of each row."""
        return jnp.sqrt(jnp.sum(self.matrix**2, -1))

    @property
    def size(self) -> Float[Array, ""]:
        """Of the longest row."""
        return jnp.max(self.length, initial=0.0)

    def scaled(self) -> Level:
        """The same level with the square roots of the weights multiplied in; a weight of 0 removes its row."""
        if self.weight is None:
            return self
        positive = self.weight > 0.0
        root = jnp.where(positive, jnp.sqrt(jnp.where(positive, self.weight, 1.0)), 0.0)
        matrix = root[:, None] * self.matrix
        known = np.array(self.equalities, bool)
        goal = jnp.where(positive, jnp.where(known, self.lower, 0.0) * root, 0.0)
        lower, upper = (
            jnp.where(known, goal, _scaled_bound(bound, root, none))
            for bound, none in ((self.lower, -jnp.inf), (self.upper, jnp.inf))
        )
        return Level(matrix, lower, upper, equalities=self.equalities)

    def uncrossed(self) -> tuple[Level, Bool[Array, ""]]:
        """The same level with crossed bounds as equalities halfway, and whether there were any."""
        known = np.array(self.equalities, bool)
        lower, upper, crossed = uncrossed(self.lower, jnp.where(known, self.lower, self.upper))
        return Level(self.matrix, lower, upper, self.weight, self.equalities), crossed

    def distance(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """A x minus the nearest point of its interval: the slack, 0 where the row holds."""
        value = apply(self.matrix, x)
        return value - jnp.clip(value, self.lower, self.upper)


class WorkingSet(NamedTuple):
    """What is taken for active in a level: 0 for no, -1 at the lower bound, 1 at the upper (2: an equality)."""

    hard: Int[Array, " h"]  # rows that the level leaves alone, held at a bound
    own: Int[Array, " m"]  # the level's own rows that miss their interval on that side: they count in its cost


def _scaled_bound(bound: Float[Array, " m"], root: Float[Array, " m"], none: float) -> Float[Array, " m"]:
    """root times bound, ``none`` where root is 0; the rate of an infinite bound with respect to its weight is 0."""
    finite = jnp.where(jnp.isinf(bound), 0.0, bound)
    return jnp.where(root > 0.0, jnp.where(jnp.isinf(bound), bound, root * finite), none)


class HQPSolution(eqx.Module):
    """Answer of a hierarchy.

    The hard rows are those of the box and then those of every level that may hold inequalities (not
    ``Level.equality``), h of them.

    Attributes:
        x: the answer; inside its box exactly, whatever the status. (n,)
        slacks: of each level, A x minus the nearest point of its interval (unweighted). ((m,), ...)
        status: a ``Status`` code.
        iterations: changes of the active sets of all levels together.
        factorizations: systems factored, all levels together.
        kkt_residual: the largest stationarity residual of a level, and what the levels below took from its optimum.
        active: of the box, -1 at the lower bound, 1 at the upper, 2 equality, 0 free. (n,)
        active_rows: of each level, its rows that miss their interval: -1 below it, 1 above, 2 equality; 0 for those
            that hold. ((m,), ...)
        multipliers: of each level, the forces of the hard rows, in the units of its weighted cost: the downhill
            direction of the cost, within what the levels above leave free, is their combination with these; positive
            at an upper bound, negative at a lower. (levels, h)
        warm_start: the working sets, for the next problem nearby. A pytree of integers.
    """

    x: Float[Array, " n"]
    slacks: tuple[Float[Array, " m"], ...]
    status: Int[Array, ""]
    iterations: Int[Array, ""]
    factorizations: Int[Array, ""]
    kkt_residual: Float[Array, ""]
    active: Int[Array, " n"]
    active_rows: tuple[Int[Array, " m"], ...]
    multipliers: Float[Array, "L h"]
    warm_start: WorkingSet
