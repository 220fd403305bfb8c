"""The damping of a level: a constant part, and one in proportion to what the level's model cannot meet.

A linear model is wrong by ``1/2 dt^2 (grad^2 e)[v, v]``, and what that costs is its product with the residual that the
model leaves. Where a step meets the level's demand there is no residual, so nothing has to be damped; where the demand
is out of reach, all of it is left. So the second part is damping x share with ``share = |residual| / |demand|``, and
the residual is that of the damped step itself: a fixed point, found from share 1 downwards. In one dimension it is
``max(0, unmet - s^2)`` for a singular value s: a threshold on singular values, without an SVD.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Bool, Float

from .._errors import OsikValueError
from ._dense import apply, product
from ._level import positive_root

PASSES = 3
"""Steps towards the fixed point; each makes what is damped too much smaller by the factor unmet / s^2."""
RIDGE = 1e-13
"""Of the rows' squares, or ten roundings of them: keeps dependent rows from breaking the factorisation."""
LEAST = 1e-13
"""Of the square of the level's longest row: a damping under this has slopes under those that rounding has."""
SPENT = 0.1
"""Of what a level gains, the part that the levels below may cost it at second order."""
ROOM = 1e-6
"""What they may move at least: a box with a width is no equality."""
BENDS = 1e-6
"""Of the largest cost of a variable, what another has to cost to count: less may be rounding."""


@runtime_checkable
class Rows(Protocol):
    """Rows of a level, weights multiplied in."""

    @property
    def matrix(self) -> Float[Array, "m n"]:
        """A."""
        ...

    @property
    def equal(self) -> Bool[Array, " m"]:
        """Rows to be treated as equalities."""
        ...

    def distance(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """A x minus the nearest point of its interval."""
        ...


class Damping(NamedTuple):
    """Of one level: it minimises ``1/2 |w|^2 + 1/2 (constant + share unmet) |x|^2``.

    ``share`` is the size of the residual w that the level's step leaves, as a part of ``demand``, and 1 at most. The
    step is judged by itself, clipped into the box.

    ``bends`` is how much a motion of each variable alone bends the level's rows, along a unit residual: bounds on row
    sums of their second derivative, times dt. Where the level is out of reach, those below it get a narrower box
    (``room_below``).
    """

    constant: Any = 0.0  # Float[Array, ""], and so the following
    unmet: Any = 0.0
    demand: Any = 0.0
    bends: Any = 0.0  # Float[Array, " n"]


def one_each(damping: Any, count: int, n: int, dtype: jnp.dtype) -> Damping:
    """Of each of ``count`` levels of n variables, from one for all or one for each; fields have an axis of levels."""
    single = isinstance(damping, Damping) or not isinstance(damping, Sequence)
    given = [damping] * count if single else list(damping)
    if len(given) != count:
        raise OsikValueError(f"there are {len(given)} dampings and {count} levels")
    whole = [one if isinstance(one, Damping) else Damping(one) for one in given]
    constant, unmet, demand, bends = (
        jnp.array([jnp.asarray(part, dtype) for part in parts], dtype) for parts in _fields(whole)
    )
    return Damping(constant, unmet, demand, jnp.broadcast_to(bends if bends.ndim == 2 else bends[:, None], (count, n)))


def _fields(whole: Sequence[Damping]) -> list[list]:
    fields = [[getattr(one, name) for one in whole] for name in Damping._fields]
    return [*fields[:-1], jnp.broadcast_arrays(*fields[-1])]


def effective(
    damping: Damping,
    level: Rows,
    x: Float[Array, " n"],
    projector: Float[Array, "n n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
) -> Float[Array, ""]:
    """The damping of a level whose weights are multiplied in, below levels that leave it the projector's range.

    Args:
        damping: of the level.
        level: the level.
        x: where the levels above have ended.
        projector: onto what they leave free.
        lower: of the box, -inf where unbounded.
        upper: of the box, inf where unbounded.
    """
    base = x - apply(projector, x)
    goal = -level.distance(base)
    counts = level.equal | (goal != 0.0)
    rows = jnp.where(counts[:, None], product(level.matrix, projector), 0.0)
    gram = product(rows, rows.T)
    eye = jnp.eye(len(goal), dtype=gram.dtype)
    ridge = max(RIDGE, 10.0 * float(jnp.finfo(gram.dtype).eps)) * jnp.trace(gram)
    demand = jnp.where(damping.demand > 0.0, damping.demand, 1.0)
    share = jnp.ones_like(damping.unmet)
    for _ in range(PASSES):
        strength = damping.constant + damping.unmet * share + ridge
        factor = jnp.linalg.cholesky(gram + jnp.where(strength > 0.0, strength, 1.0) * eye)
        end = jnp.clip(base + apply(rows.T, cho_solve((factor, True), goal)), lower, upper)
        missed = positive_root(jnp.sum(level.distance(end) ** 2))
        share = jnp.minimum(missed / demand, 1.0)
    whole = damping.constant + damping.unmet * share
    longest = jnp.max(jnp.sum(level.matrix**2, -1), initial=0.0)
    return jnp.where(whole > LEAST * longest, whole, 0.0)


def room_below(
    damping: Damping,
    level: Rows,
    bent: Float[Array, " n"],
    x: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
    """The box of the levels below one that ended at x: what they may spend of its progress.

    What a level cannot meet pulls, through the rows of the levels above, at everything that holds it. A motion d of the
    levels below, which none of those rows sees, costs it at second order up to ``1/2 missed size sum_j bent_j d_j^2``,
    and its gain is ``1/2 (demand^2 - missed^2)``. The cost stays under the gain where each variable has an equal part
    of it. What a level can meet narrows nothing.

    Args:
        damping: of the level.
        level: the level.
        bent: how much each variable bends the levels above, in units of the size of their rows (Frobenius norm).
        x: where the level has ended.
        lower: of the box, -inf where unbounded.
        upper: of the box, inf where unbounded.

    Returns:
        Lower and upper of the new box, and ``bent`` with the level in it.
    """
    longest = jnp.max(jnp.sum(level.matrix**2, -1), initial=0.0)
    size = positive_root(jnp.sum(level.matrix**2))
    bent = jnp.maximum(bent, damping.bends / jnp.where(size > 0.0, size, 1.0))
    missed = jnp.minimum(positive_root(jnp.sum(level.distance(x) ** 2)), damping.demand)
    share = missed / jnp.where(damping.demand > 0.0, damping.demand, 1.0)
    cost = missed * size * bent
    counts = (cost > BENDS * jnp.max(cost)) & (damping.unmet * share > LEAST * longest)
    many = jnp.maximum(jnp.sum(counts), 1)
    gain = SPENT * (damping.demand - missed) * (damping.demand + missed)
    room = jnp.where(counts, positive_root(gain / (many * jnp.where(counts, cost, 1.0))) + ROOM, jnp.inf)
    return jnp.maximum(lower, x - room), jnp.minimum(upper, x + room), bent
