"""The hierarchy and its answer, as pytrees."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike


class Level(eqx.Module):
    """One priority: rows that should lie in an interval, as nearly as the levels above allow.

    Attributes:
        matrix: A. (m, n); m may be 0.
        lower: of A x; equal to ``upper`` for an equality, -inf for none. (m,)
        upper: of A x; inf for none. (m,)
        weight: of the squared distances of the rows to their intervals, >= 0; None for ones. (m,)
    """

    matrix: Float[Array, "m n"]
    lower: Float[Array, " m"]
    upper: Float[Array, " m"]
    weight: Float[Array, " m"] | None = None

    def __init__(
        self,
        matrix: ArrayLike | Array,
        lower: ArrayLike | Array,
        upper: ArrayLike | Array,
        weight: ArrayLike | Array | None = None,
    ):
        self.matrix = jnp.asarray(matrix)
        self.lower = jnp.asarray(lower, self.matrix.dtype)
        self.upper = jnp.asarray(upper, self.matrix.dtype)
        self.weight = None if weight is None else jnp.asarray(weight, self.matrix.dtype)
        rows = self.matrix.shape[:-1]
        for name, array in (("lower", self.lower), ("upper", self.upper), ("weight", self.weight)):
            if array is not None and array.shape != rows:
                raise ValueError(f"{name} has shape {array.shape}; the matrix {self.matrix.shape} asks for {rows}")

    def scaled(self) -> Level:
        """The same level with the square roots of the weights multiplied in; a weight of 0 removes its row."""
        if self.weight is None:
            return self
        positive = self.weight > 0.0
        root = jnp.where(positive, jnp.sqrt(jnp.where(positive, self.weight, 1.0)), 0.0)
        return Level(
            root[:, None] * self.matrix,
            jnp.where(positive, self.lower * jnp.where(positive, root, 1.0), -jnp.inf),
            jnp.where(positive, self.upper * jnp.where(positive, root, 1.0), jnp.inf),
        )

    def distance(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """A x minus the nearest point of its interval: the slack, 0 where the row holds."""
        value = self.matrix @ x
        return value - jnp.clip(value, self.lower, self.upper)


class HQPSolution(eqx.Module):
    """Answer of a hierarchy.

    Attributes:
        x: the answer; inside its box exactly, whatever the status. (n,)
        slacks: of each level, A x minus the nearest point of its interval (unweighted). ((m,), ...)
        status: a ``Status`` code.
        iterations: of the active sets of all levels together.
        kkt_residual: the largest stationarity residual of a level.
        active: of the box, -1 at the lower bound, 1 at the upper, 2 equality, 0 free. (n,)
    """

    x: Float[Array, " n"]
    slacks: tuple[Float[Array, " m"], ...]
    status: Int[Array, ""]
    iterations: Int[Array, ""]
    kkt_residual: Float[Array, ""]
    active: Int[Array, " n"]
