"""Symmetric block-banded linear systems of a whole clip: each frame is coupled to the two frames before it.

A GPU solves them in single precision by ``core/banded.cu``, one warp of 32 threads for each system.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..core import _build, _cuda
from ..execution._backends import on_platforms, takes
from ..execution._lanes import in_lanes
from ..numerics._dense import apply, product


class BandedSystem(NamedTuple):
    """A symmetric positive definite matrix of F x F blocks, with a band of two blocks below the diagonal.

    Block (t, t) is ``square[t] + diag(alone[t])``, block (t, t - 1) is
    ``diag(first[t]) - rows[t]^T diag(weight[t]) rows[t - 1]``, and block (t, t - 2) is ``diag(second[t])``.
    """

    square: Float[Array, "F n n"]
    alone: Float[Array, "F n"]
    rows: Float[Array, "F m n"]  # rows of the coupling between a frame and the next
    weight: Float[Array, "F m"]  # entry 0 is not used
    first: Float[Array, "F n"]  # entry 0 is not used
    second: Float[Array, "F n"]  # entries 0 and 1 are not used


def solve_banded(system: BandedSystem, right: Float[Array, "F n"]) -> Float[Array, "F n"]:
    """Return the solution x of ``system x = right``.

    Runs the CUDA kernel in single precision on a GPU where the core is installed, else plain JAX. The result is not
    finite if the matrix is not positive definite to rounding.
    """
    weight, first = (a.at[0].set(0.0) for a in (system.weight, system.first))
    system = system._replace(weight=weight, first=first, second=system.second.at[:2].set(0.0))
    if takes("auto", "core-cuda", fits=has_kernel(system)):
        return _anywhere()(system, right)
    return solve_banded_plain(system, right)


@cache
def _anywhere() -> Callable[[BandedSystem, Array], Array]:
    return in_lanes(partial(on_platforms, {"core-cuda": _solve_on_gpu}, jax.vmap(solve_banded_plain)))


def has_kernel(system: BandedSystem) -> bool:
    """Return whether there is a GPU kernel for systems of this shape and precision."""
    m, n = system.rows.shape[-2:]
    is_small = 4 * (4 * n * (n | 1) + 2 * m * n + 6 * n) <= _cuda.DEFAULT_SHARED_BYTES
    return system.rows.dtype == jnp.float32 and is_small and _cuda.installed()


def _solve_on_gpu(system: BandedSystem, right: Float[Array, "B F n"]) -> Float[Array, "B F n"]:
    """Return the solutions of a batch, on the GPU that the program runs on."""
    lanes, frames, n = right.shape
    single, blocks = jnp.float32, (lanes, frames, n, n)
    x, *_ = _cuda.call(
        kernel_source(n, system.rows.shape[-2]),
        [(right.shape, single), (blocks, single), (blocks, single)],
        *(*system, right, jnp.full(1, frames, jnp.int32)),
        problems=lanes,
        shared=0,
    )
    return x


@cache
def kernel_source(n: int, m: int) -> str:
    """Return the CUDA source of the kernel: diagonal blocks are n x n, those beside them have m rows that are not 0."""
    return _cuda.constants(N=n, M=m) + (_build.FOLDER / "banded.cu").read_text()


def solve_banded_plain(system: BandedSystem, right: Float[Array, "F n"]) -> Float[Array, "F n"]:
    """Return the solution of a banded system by a block Cholesky factorisation in plain JAX; unused entries are 0.

    With L the factor, row t of blocks is ``L2 = S L[t-2]^-T`` (two frames back), ``L1 = (B - L2 L1[t-1]^T) L[t-1]^-T``
    and ``L L^T = A - L1 L1^T - L2 L2^T``. The blocks on the diagonal are kept as inverses: of blocks this small,
    products take a third of the time of substitutions.
    """
    n = right.shape[-1]
    identity, zero = jnp.eye(n, dtype=right.dtype), jnp.zeros((n, n), right.dtype)
    none = jnp.zeros(n, right.dtype)
    # of each frame the one-back block but for its diagonal: a batch of products is quicker than one in each step
    weighted, before = system.rows * -system.weight[..., None], jnp.roll(system.rows, 1, 0)
    coupled = product(jnp.swapaxes(weighted, 1, 2), before)

    def down(carry, row):
        inverse1, inverse2, below1, y1, y2 = carry
        square, alone, coupled, one_back, two_back, b = row
        far = two_back[:, None] * inverse2.T
        near = product(coupled + one_back[:, None] * identity - product(far, below1.T), inverse1.T)
        both = jnp.concatenate([near, far], 1)
        factor = lax.linalg.cholesky(square + alone[:, None] * identity - product(both, both.T), symmetrize_input=False)
        inverse = lax.linalg.triangular_solve(factor, identity, left_side=True, lower=True)
        y = apply(inverse, b - apply(near, y1) - apply(far, y2))
        return (inverse, inverse1, near, y, y1), (inverse, near, y)

    rows = (system.square, system.alone, coupled, system.first, system.second, right)
    _, (inverse, near, y) = lax.scan(down, (identity, identity, zero, none, none), rows)

    def up(carry, row):
        x1, x2, near1 = carry
        inverse, near, y, two_on = row
        # row t + 2 couples to t by L2 = S L[t]^-T, so that L2^T x = L[t]^-1 S x
        x = apply(inverse.T, y - apply(near1.T, x1) - apply(inverse, two_on * x2))
        return (x, x1, near), x

    two_on = jnp.roll(system.second, -2, 0)
    _, x = lax.scan(up, (none, none, zero), (inverse, near, y, two_on), reverse=True)
    return x
