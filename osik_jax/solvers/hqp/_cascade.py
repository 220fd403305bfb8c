"""solve_hqp: level after level, each on the minimisers of those above (eq. 9)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._dense import apply, product
from .._status import Status
from ._level import Hard, LevelState, Tolerances, independent, rounding, row_space, solve_level
from ._problem import HQPSolution, Level
from ._replay import Decision, with_derivative

_DEFAULTS = {
    jnp.dtype("float64"): Tolerances(rank=1e-10, step=1e-13, multiplier=1e-10),
    jnp.dtype("float32"): Tolerances(rank=1e-5, step=1e-6, multiplier=1e-5),
}


@partial(jax.jit, static_argnames="max_iterations")
def solve_hqp(
    levels: Sequence[Level],
    lower: Float[ArrayLike, " n"],
    upper: Float[ArrayLike, " n"],
    *,
    max_iterations: int | None = None,
    tolerances: Tolerances | None = None,
) -> HQPSolution:
    """Lexicographic least squares: level k minimises |w_k|^2 among the minimisers of the levels before it.

    w_k is the (weighted) distance of the level's rows A_k x to their intervals [lower_k, upper_k]; the box
    ``lower <= x <= upper`` is hard at every level. What freedom is left after the last level goes into the smallest
    |x|, so that the answer is unique. Pure, compiled on first use, and batched by ``vmap``.

    A row violated at its optimum, and every hard row with a nonzero multiplier, is tight on the whole face of
    minimisers: it is frozen as an equality before the next level and eliminated by its null space.

    Args:
        levels: highest priority first; any number, each an equality or inequality level or a mixture.
        lower: box, -inf where unbounded. (n,)
        upper: box, inf where unbounded. (n,)
        max_iterations: cap on the active-set iterations of one level (static); default 10 (n + rows of the level).
        tolerances: what counts as zero; the default depends on the precision.

    Returns:
        The solution; never raises inside jit. x satisfies its box exactly, whatever the status.

    When not to use it: one level (``solve_least_squares_qp`` is several times faster).
    """
    lower, upper = jnp.asarray(lower), jnp.asarray(upper)
    dtype = jnp.result_type(lower, *(level.matrix for level in levels))
    tolerances = _DEFAULTS[dtype] if tolerances is None else tolerances
    sane = _finite(levels, lower, upper)
    safe_lower, safe_upper = jnp.where(sane, lower, -1.0), jnp.where(sane, upper, 1.0)
    scaled = [jax.tree.map(lambda leaf: jnp.where(sane, leaf, 0.0), level.scaled()) for level in levels]
    scaled.append(_smallest(lower.shape[0], dtype))
    cascade = _Cascade.start(*jax.lax.stop_gradient((safe_lower, safe_upper)), dtype)
    decisions = []
    for level in scaled:
        cap = 10 * (lower.shape[0] + level.matrix.shape[0]) if max_iterations is None else max_iterations
        cascade, decision = cascade.descend(jax.lax.stop_gradient(level), tolerances, cap)
        decisions.append(decision)
    x = with_derivative(cascade.x, decisions, scaled, safe_lower, safe_upper, tolerances.rank)
    return _answer(levels, cascade, x, sane, lower, upper)


def _smallest(n: int, dtype: jnp.dtype) -> Level:
    """The last level: what freedom is left goes into the smallest norm."""
    return Level(jnp.eye(n, dtype=dtype), jnp.zeros(n, dtype), jnp.zeros(n, dtype))


class _Cascade(eqx.Module):
    """What the levels so far have fixed."""

    x: Float[Array, " n"]
    matrix: Float[Array, "h n"]  # box, then rows of the levels so far
    lower: Float[Array, " h"]
    upper: Float[Array, " h"]
    frozen: Bool[Array, " h"]
    side: Int[Array, " h"]  # held and not frozen
    projector: Float[Array, "n n"]  # onto the null space of the frozen rows
    box: Int[Array, " n"]  # active bounds, frozen or held
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    done: Bool[Array, ""]

    @classmethod
    def start(cls, lower: Float[Array, " n"], upper: Float[Array, " n"], dtype: jnp.dtype) -> _Cascade:
        n = lower.shape[0]
        pinned = lower == upper
        return cls(
            x=jnp.clip(jnp.zeros(n, dtype), lower, upper),
            matrix=jnp.eye(n, dtype=dtype),
            lower=lower.astype(dtype),
            upper=upper.astype(dtype),
            frozen=pinned,
            side=jnp.zeros(n, jnp.int32),
            projector=jnp.diag(jnp.where(pinned, 0.0, 1.0).astype(dtype)),
            box=jnp.where(pinned, 2, 0),
            residual=jnp.zeros((), dtype),
            iterations=jnp.asarray(0),
            done=jnp.asarray(True),
        )

    def descend(self, level: Level, tolerances: Tolerances, cap: int) -> tuple[_Cascade, Decision]:
        """Solves one more level and freezes what it decides."""
        bounded = jnp.isfinite(self.lower) | jnp.isfinite(self.upper)
        hard = Hard(self.matrix, self.lower, self.upper, ~self.frozen & bounded)
        end = solve_level(
            level.matrix,
            level.lower,
            level.upper,
            hard,
            self.projector,
            LevelState(
                x=self.x,
                side=independent(hard, self.side, self.projector, tolerances.rank),
                multiplier=jnp.zeros_like(self.lower),
                residual=jnp.zeros_like(self.residual),
                stalled=jnp.asarray(0),
                iterations=jnp.asarray(0),
                done=jnp.asarray(False),
            ),
            tolerances,
            cap,
        )
        return self._freeze(level, hard, end, tolerances)

    def _freeze(self, level: Level, hard: Hard, end: LevelState, tolerances: Tolerances) -> tuple[_Cascade, Decision]:
        n = self.x.shape[0]
        value = apply(level.matrix, end.x)
        slack = value - jnp.clip(value, level.lower, level.upper)
        length = jnp.sqrt(jnp.sum(level.matrix**2, -1))
        noise = tolerances.multiplier * (length * jnp.max(jnp.abs(end.x)) + jnp.sqrt(jnp.sum(slack**2)))
        counts = (level.lower == level.upper) | (jnp.abs(slack) > noise)
        gradient = apply(level.matrix.T, jnp.where(counts, slack, 0.0))
        pressure = jnp.abs(end.multiplier) * jnp.sqrt(jnp.sum(hard.matrix**2, -1))
        scale = jnp.max(length, initial=0.0)
        floor = scale * rounding(scale, end.x, slack, tolerances)
        tight = (end.side != 0) & (pressure > tolerances.multiplier * jnp.sqrt(jnp.sum(gradient**2)) + floor)
        rows = jnp.argsort(~tight, stable=True)[:n]
        to_freeze = jnp.concatenate(
            [jnp.where(tight[rows][:, None], hard.matrix[rows], 0.0), jnp.where(counts[:, None], level.matrix, 0.0)]
        )
        basis = row_space(to_freeze, self.projector, tolerances.rank)
        side = jnp.concatenate([jnp.where(tight, 0, end.side), jnp.zeros(len(slack), jnp.int32)])
        decision = Decision(jnp.where(tight, end.side, 0), jnp.where(counts, jnp.where(slack > 0.0, 1, -1), 0))
        cascade = _Cascade(
            x=end.x,
            matrix=jnp.concatenate([self.matrix, level.matrix]),
            lower=jnp.concatenate([self.lower, jnp.minimum(level.lower, value)]),
            upper=jnp.concatenate([self.upper, jnp.maximum(level.upper, value)]),
            frozen=jnp.concatenate([self.frozen | tight, counts]),
            side=side,
            projector=self.projector - product(basis, basis.T),
            box=jnp.where(end.side[:n] != 0, end.side[:n], jnp.where(self.frozen[:n], self.box, 0)),
            residual=jnp.maximum(self.residual, end.residual),
            iterations=self.iterations + end.iterations,
            done=self.done & end.done,
        )
        return cascade, decision


def _finite(levels: Sequence[Level], lower: Array, upper: Array) -> Bool[Array, ""]:
    """Whether the numbers can be computed with: no NaN anywhere, no infinity but in bounds, and a box that exists."""
    checks = [jnp.isfinite(level.matrix).all() for level in levels]
    checks += [~jnp.isnan(b).any() for level in levels for b in (level.lower, level.upper)]
    checks += [jnp.isfinite(level.weight).all() for level in levels if level.weight is not None]
    return jnp.stack([*checks, (lower <= upper).all()]).all()


def _answer(
    levels: Sequence[Level], cascade: _Cascade, x: Array, sane: Array, lower: Array, upper: Array
) -> HQPSolution:
    at_bound = jnp.where(cascade.box < 0, lower, jnp.where(cascade.box > 0, upper, x))
    good = sane & jnp.isfinite(x).all()
    low, high = (jnp.where(jnp.isnan(b), fill, b) for b, fill in ((lower, -jnp.inf), (upper, jnp.inf)))
    x = jnp.clip(jnp.where(good, at_bound, 0.0), low, high)
    status = jnp.where(cascade.done, Status.SOLVED, Status.MAX_ITERATIONS)
    return HQPSolution(
        x=x,
        slacks=tuple(jnp.where(good, level.distance(x), 0.0) for level in levels),
        status=jnp.where(good, status, Status.NUMERICAL_ERROR),
        iterations=cascade.iterations,
        kkt_residual=jnp.where(good, cascade.residual, jnp.inf),
        active=cascade.box,
    )
