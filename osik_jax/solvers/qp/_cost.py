"""Convex quadratic costs, in the two forms that they come in."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._dense import apply, product


class Quadratic(eqx.Module):
    """1/2 x'Hx + g'x."""

    matrix: Float[Array, "n n"]
    linear: Float[Array, " n"]

    def hessian(self) -> Float[Array, "n n"]:
        """H."""
        return self.matrix

    def diagonal(self) -> Float[Array, " n"]:
        """Of H."""
        return jnp.diagonal(self.matrix)

    def gradient(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """H x + g."""
        return apply(self.matrix, x) + self.linear

    def curvature(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """H x."""
        return apply(self.matrix, x)

    def forces(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """The terms of the gradient, none against another."""
        return apply(jnp.abs(self.matrix), jnp.abs(x)) + jnp.abs(self.linear)

    def root(self, free: Bool[Array, " n"]) -> Float[Array, "n n"]:
        """R with R'R = H over the free variables, ones for the others; a ridge of roundings keeps it from breaking."""
        unit = 10.0 * float(jnp.finfo(self.matrix.dtype).eps)
        square = jnp.where(free[:, None] & free[None, :], self.matrix, 0.0)
        ridge = jnp.where(free, unit * jnp.max(jnp.diagonal(square), initial=unit), 1.0)
        return jax.lax.linalg.cholesky(square + jnp.diag(ridge), symmetrize_input=False).T

    def bend(self) -> Float[Array, " n"]:
        """A diagonal matrix that is no less than H: the sums of the absolute numbers in its rows."""
        return jnp.sum(jnp.abs(self.matrix), 1)

    def bends_down(self) -> Bool[Array, ""]:
        """Whether it is seen to have no minimum: a negative number on the diagonal of H."""
        return (self.diagonal() < 0.0).any()

    def harmless(self) -> Quadratic:
        """A cost of the same shape that can always be minimised."""
        return Quadratic(jnp.eye(len(self.linear), dtype=self.matrix.dtype), jnp.zeros_like(self.linear))


class LeastSquares(eqx.Module):
    """1/2 sum_i weight_i (A x - b)_i^2 + 1/2 sum_j damping_j (x_j - center_j)^2.

    Products go through A: what forming H = A'WA rounds away (small weights beside large ones) is kept.
    """

    matrix: Float[Array, "m n"]
    target: Float[Array, " m"]
    weight: Float[Array, " m"]
    damping: Float[Array, " n"]
    center: Float[Array, " n"]

    def hessian(self) -> Float[Array, "n n"]:
        """A'WA + D, rounded."""
        return product(self.matrix.T * self.weight, self.matrix) + jnp.diag(self.damping)

    def diagonal(self) -> Float[Array, " n"]:
        """Of the Hessian."""
        return jnp.sum(self.weight[:, None] * self.matrix**2, 0) + self.damping

    def gradient(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """A'W(A x - b) + D (x - c)."""
        residual = self.weight * (apply(self.matrix, x) - self.target)
        return apply(self.matrix.T, residual) + self.damping * (x - self.center)

    def curvature(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """A'WA x + D x."""
        return apply(self.matrix.T, self.weight * apply(self.matrix, x)) + self.damping * x

    def forces(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """The terms of the gradient, none against another."""
        size = jnp.abs(self.matrix)
        pulls = self.weight * (apply(size, jnp.abs(x)) + jnp.abs(self.target))
        return apply(size.T, pulls) + self.damping * (jnp.abs(x) + jnp.abs(self.center))

    def root(self, free: Bool[Array, " n"]) -> Float[Array, "m_and_n n"]:
        """R with R'R = H over the free variables, ones for the others; nothing is squared."""
        own = jnp.where(free, jnp.sqrt(self.damping), 1.0)
        return jnp.concatenate([jnp.sqrt(self.weight)[:, None] * self.matrix * free, jnp.diag(own)])

    def bend(self) -> Float[Array, " n"]:
        """A diagonal matrix that is no less than the Hessian."""
        size = jnp.abs(self.matrix)
        return apply(size.T, self.weight * jnp.sum(size, 1)) + self.damping

    def bends_down(self) -> Bool[Array, ""]:
        """Whether it is seen to have no minimum: a negative weight or damping."""
        return (self.weight < 0.0).any() | (self.damping < 0.0).any()

    def harmless(self) -> LeastSquares:
        """A cost of the same shape that can always be minimised."""
        return LeastSquares(
            matrix=jnp.zeros_like(self.matrix),
            target=jnp.zeros_like(self.target),
            weight=jnp.zeros_like(self.weight),
            damping=jnp.ones_like(self.damping),
            center=jnp.zeros_like(self.center),
        )
