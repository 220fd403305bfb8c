"""Convex quadratic costs, given by a Hessian or as least squares."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...numerics._constants import QUADRATIC_RIDGE
from ...numerics._dense import apply, product


class Quadratic(eqx.Module):
    """Cost 1/2 x'Hx + g'x."""

    matrix: Float[Array, "n n"]
    linear: Float[Array, " n"]

    def hessian(self) -> Float[Array, "n n"]:
        """Return H, (n, n)."""
        return self.matrix

    def diagonal(self) -> Float[Array, " n"]:
        """Return the diagonal of H, (n,)."""
        return jnp.diagonal(self.matrix)

    def gradient(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return H x + g, (n,)."""
        return apply(self.matrix, x) + self.linear

    def hessian_product(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return H x, (n,)."""
        return apply(self.matrix, x)

    def gradient_scale(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the sums of the gradient's absolute terms, which scale its roundoff, (n,)."""
        return apply(jnp.abs(self.matrix), jnp.abs(x)) + jnp.abs(self.linear)

    def square_root(self, free: Bool[Array, " n"]) -> Float[Array, "n n"]:
        """Return R with R'R = H over the free variables, identity rows for others (Cholesky with a small ridge)."""
        eps = QUADRATIC_RIDGE * float(jnp.finfo(self.matrix.dtype).eps)
        square = jnp.where(free[:, None] & free[None, :], self.matrix, 0.0)
        # relative to the largest diagonal element, so that a semidefinite H has a factor too
        ridge = jnp.where(free, eps * jnp.max(jnp.diagonal(square), initial=eps), 1.0)
        return jax.lax.linalg.cholesky(square + jnp.diag(ridge), symmetrize_input=False).T

    def curvature_bound(self) -> Float[Array, " n"]:
        """Return the diagonal of a matrix D >= H: row sums of |H| (Gershgorin), (n,)."""
        return jnp.sum(jnp.abs(self.matrix), 1)

    def in_units(self, unit: Float[Array, " n"]) -> Quadratic:
        """Return the cost of x / unit."""
        return Quadratic(self.matrix * unit[:, None] * unit, self.linear * unit)

    def has_valid_signs(self) -> Bool[Array, ""]:
        """Check that the diagonal of H is not negative."""
        return jnp.all(self.diagonal() >= 0.0)

    def placeholder(self) -> Quadratic:
        """Return a cost of the same shape that certainly has a minimiser."""
        return Quadratic(jnp.eye(len(self.linear), dtype=self.matrix.dtype), jnp.zeros_like(self.linear))


class LeastSquares(eqx.Module):
    """Cost 1/2 sum_i weight_i (A x - b)_i^2 + 1/2 sum_j damping_j (x_j - center_j)^2.

    Products go through A: what is lost to roundoff in H = A'WA (small weights beside large ones) is kept.
    """

    matrix: Float[Array, "m n"]
    target: Float[Array, " m"]
    weight: Float[Array, " m"]
    damping: Float[Array, " n"]
    center: Float[Array, " n"]

    def hessian(self) -> Float[Array, "n n"]:
        """Return A'WA + D, (n, n)."""
        return product(self.matrix.T * self.weight, self.matrix) + jnp.diag(self.damping)

    def diagonal(self) -> Float[Array, " n"]:
        """Return the diagonal of the Hessian, (n,)."""
        return apply(self.matrix.T**2, self.weight) + self.damping

    def gradient(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return A'W(A x - b) + D (x - c), (n,)."""
        residual = self.weight * (apply(self.matrix, x) - self.target)
        return apply(self.matrix.T, residual) + self.damping * (x - self.center)

    def hessian_product(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return (A'WA + D) x, (n,)."""
        return apply(self.matrix.T, self.weight * apply(self.matrix, x)) + self.damping * x

    def gradient_scale(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the sums of the gradient's absolute terms, which scale its roundoff, (n,)."""
        size = jnp.abs(self.matrix)
        # the terms that cancel in A x - b count one by one, and so do those of the damping
        residual_scale = self.weight * (apply(size, jnp.abs(x)) + jnp.abs(self.target))
        return apply(size.T, residual_scale) + self.damping * (jnp.abs(x) + jnp.abs(self.center))

    def square_root(self, free: Bool[Array, " n"]) -> Float[Array, "m_and_n n"]:
        """Return R with R'R = H over the free variables, identity rows for others: [sqrt(W) A; sqrt(D)]."""
        diagonal = jnp.where(free, jnp.sqrt(self.damping), 1.0)
        return jnp.concatenate([jnp.sqrt(self.weight)[:, None] * self.matrix * free, jnp.diag(diagonal)])

    def curvature_bound(self) -> Float[Array, " n"]:
        """Return the diagonal of a matrix that is no less than the Hessian: row sums of |A|'W|A| + D, (n,)."""
        # |x'A'WA x| <= sum_ij |x_i| (|A|'W|A|)_ij |x_j| <= sum_i (row sum)_i x_i^2
        size = jnp.abs(self.matrix)
        return apply(size.T, self.weight * jnp.sum(size, 1)) + self.damping

    def in_units(self, unit: Float[Array, " n"]) -> LeastSquares:
        """Return the cost of x / unit."""
        return LeastSquares(self.matrix * unit, self.target, self.weight, self.damping * unit**2, self.center / unit)

    def has_valid_signs(self) -> Bool[Array, ""]:
        """Check that weights and damping are not negative."""
        return jnp.all(self.weight >= 0.0) & jnp.all(self.damping >= 0.0)

    def placeholder(self) -> LeastSquares:
        """Return a cost of the same shape that certainly has a minimiser."""
        return LeastSquares(
            matrix=jnp.zeros_like(self.matrix),
            target=jnp.zeros_like(self.target),
            weight=jnp.zeros_like(self.weight),
            damping=jnp.ones_like(self.damping),
            center=jnp.zeros_like(self.center),
        )
