"""Priority level of a hierarchy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..numerics._arguments import as_floats
from ..numerics._dense import apply
from ..numerics._guarded import positive_root
from ._box import ordered_bounds


class Level(eqx.Module):
    """Rows of one priority that should lie in an interval, as nearly as higher levels allow.

    Attributes:
        matrix: A. (m, n); m may be 0.
        lower: of A x; equal to ``upper`` for an equality, -inf for none; above it, the middle stands for both and the
            answer is INFEASIBLE. (m,)
        upper: of A x; inf for none. Leave it out where all rows are equalities: it is then ``lower``, and the solver
            need not look for the rows that are not. (m,)
        weight: of the squared distances of the rows to their intervals, >= 0; None for ones. (m,)
        equalities: rows that are equalities whatever ``upper`` says, which is not looked at there: all where ``upper``
            was left out (static). Name them where bounds are computed under ``jit``: XLA may compute an expression
            twice and round it in two ways: what was one number is then two. (m,)
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
        self.matrix = as_floats(matrix, lower, upper, weight)
        self.lower = jnp.asarray(lower, self.matrix.dtype)
        count = self.matrix.shape[-2]
        self.equalities = (upper is None,) * count if equalities is None else tuple(map(bool, equalities))
        self.upper = self.lower if upper is None else jnp.asarray(upper, self.matrix.dtype)
        self.weight = None if weight is None else jnp.asarray(weight, self.matrix.dtype)
        rows = self.matrix.shape[:-1]
        for name, array in (("lower", self.lower), ("upper", self.upper), ("weight", self.weight)):
            if array is not None and array.shape != rows:
                raise OsikValueError(f"{name} has shape {array.shape}; the matrix {self.matrix.shape} asks for {rows}")
        if len(self.equalities) != count:
            raise OsikValueError(f"equalities has {len(self.equalities)} flags; the matrix has {count} rows")

    @property
    def equality(self) -> bool:
        """Return whether all rows are known to be equalities (static)."""
        return all(self.equalities)

    @property
    def equal(self) -> Bool[Array, " m"]:
        """Return which rows are equalities: the known ones, and those with lower >= upper, (m,)."""
        # a row of weight 0 has no bounds, so it is no equality
        has_weight = True if self.weight is None else self.weight > 0.0
        return jnp.array(self.equalities, bool) | ((self.lower >= self.upper) & has_weight)

    @property
    def length(self) -> Float[Array, " m"]:
        """Return the Euclidean norm of each row, (m,)."""
        return jnp.sqrt(jnp.sum(self.matrix**2, -1))

    def scaled(self) -> Level:
        """Return the level with the square roots of the weights multiplied in; a weight of 0 removes its row."""
        if self.weight is None:
            return self
        positive, root = self.weight > 0.0, positive_root(self.weight)
        # sqrt(w) lower <= sqrt(w) A x <= sqrt(w) upper; rows of weight 0 lose their bounds
        matrix = root[:, None] * self.matrix
        known = np.array(self.equalities, bool)
        goal = jnp.where(positive, jnp.where(known, self.lower, 0.0) * root, 0.0)
        lower, upper = (
            jnp.where(known, goal, _scaled_bound(bound, root, none))
            for bound, none in ((self.lower, -jnp.inf), (self.upper, jnp.inf))
        )
        return Level(matrix, lower, upper, equalities=self.equalities)

    def ordered(self) -> tuple[Level, Bool[Array, ""]]:
        """Return the level with each lower > upper replaced by an equality at the mean, and whether there were any."""
        known = np.array(self.equalities, bool)
        lower, upper, unordered = ordered_bounds(self.lower, jnp.where(known, self.lower, self.upper))
        return Level(self.matrix, lower, upper, self.weight, self.equalities), unordered

    def padded(self, rows: int, equal: Bool[Array, " m"]) -> PaddedLevel:
        """Return the rows of a level of weight 1, then rows of zeros without bounds, which are met everywhere."""
        more = rows - len(self.lower)
        return PaddedLevel(
            jnp.pad(self.matrix, ((0, more), (0, 0))),
            jnp.pad(self.lower, (0, more), constant_values=-jnp.inf),
            jnp.pad(self.upper, (0, more), constant_values=jnp.inf),
            jnp.pad(equal, (0, more)),
        )

    def distance(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """Return A x minus the nearest point of its interval: the slack, 0 where the row holds, (m,)."""
        value = apply(self.matrix, x)
        return value - jnp.clip(value, self.lower, self.upper)


class PaddedLevel(NamedTuple):
    """Rows of a level with weights multiplied in, padded to the number of rows of the longest level.

    Which rows are equalities is decided once and never read off the bounds again: XLA may compute one bound twice, and
    round it in two ways.
    """

    matrix: Float[Array, "m n"]
    lower: Float[Array, " m"]
    upper: Float[Array, " m"]
    equal: Bool[Array, " m"]

    @property
    def length(self) -> Float[Array, " m"]:
        """Return the Euclidean norm of each row, (m,)."""
        return jnp.sqrt(jnp.sum(self.matrix**2, -1))

    @property
    def size(self) -> Float[Array, ""]:
        """Return the Euclidean norm of the longest row."""
        return jnp.max(self.length, initial=0.0)

    def distance(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """Return A x minus the nearest point of its interval; a clip would halve the derivative at equalities."""
        value = apply(self.matrix, x)
        return value - jnp.where(self.equal, self.lower, jnp.clip(value, self.lower, self.upper))


def bounds_exist(lower: Array, upper: Array) -> Bool[Array, ""]:
    """Check that no bound is NaN, and none infinite on the wrong side."""
    return ((lower < jnp.inf) & (upper > -jnp.inf)).all()


def are_finite(levels: Sequence[Level]) -> list[Bool[Array, ""]]:
    """Check that there is no NaN in levels, and no infinity except in bounds that do not exist."""
    checks = [jnp.isfinite(level.matrix).all() for level in levels]
    checks += [bounds_exist(level.lower, level.upper) for level in levels]
    return checks + [jnp.isfinite(level.weight).all() for level in levels if level.weight is not None]


def _scaled_bound(bound: Float[Array, " m"], root: Float[Array, " m"], none: float) -> Float[Array, " m"]:
    """Return root times bound, or ``none`` if root is 0; an infinite bound has the derivative 0 by the root."""
    finite = jnp.where(jnp.isinf(bound), 0.0, bound)
    return jnp.where(root > 0.0, jnp.where(jnp.isinf(bound), bound, root * finite), none)
