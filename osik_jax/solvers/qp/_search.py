"""Active set found and certified: guess, factor, check; where the check fails, pivot on from there, and again.

The guess is the warm start, or no active bound at all; where it is right, one factorisation is all there is. In a batch
on a CPU a problem of few rows tries it through a system of their size first. The answer always comes from a fresh
factorisation at the final active set, never from the tableau that found it.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._dense import apply
from .._double import in_double
from .._lanes import choose, with_a_few
from .._pivots import AT_LOWER, AT_UPPER, EQUALITY, INACTIVE, NO_GAP, Noise
from ._careful import careful_step
from ._descent import descend
from ._factor import factorize, minimize_on
from ._problem import CERTIFIED, QP, kkt_residual, scales_of
from ._tableau import find
from ._through_rows import has_few_rows, minimize_through_rows

_ROUNDS = 12
_NEARLY = {jnp.dtype("float64"): 1e3, jnp.dtype("float32"): 1e2}
"""Noises; an answer that the search does not change is accepted with violations up to this."""
_PATIENCE = 2
"""Searches that end at a contradiction before the pivots are given up; one that moves nothing is enough."""
_SOFT = 1e-12
"""Compliance of hard rows that contradict, of their reach: with it the least violation has a derivative."""
_FEW, _MANY = 4, 256
"""Lanes that are worked on together where most need no more work; many, where there is no CPU."""


class Found(NamedTuple):
    """The end of a search. As an iterate it has a leading axis, the lanes."""

    x: Float[Array, " n"]
    row_multipliers: Float[Array, " p"]
    active: Int[Array, " m"]
    implied: Bool[Array, " m"]  # equalities that the active constraints imply
    iterations: Int[Array, ""]
    factorizations: Int[Array, ""]
    done: Bool[Array, ""]
    optimal: Bool[Array, ""]
    contradictions: Int[Array, ""]  # searches that ended at one
    descended: Bool[Array, ""]  # the pivots were given up
    infeasible: Bool[Array, ""]  # it is proven that rows contradict each other or the box; x is the least violation
    compliance: Float[Array, " p"]  # of the rows in the problem that ``x`` solves
    residual: Float[Array, ""]  # of the optimality conditions


def unsearched(qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"]) -> Found:
    """Where a search begins: nothing found, at the bounds of the guess that exist."""
    lanes, n, dtype = guess.shape[0], qp.lower.shape[1] - qp.rows.shape[1], qp.lower.dtype
    nothing, no = jnp.zeros(lanes, jnp.int32), jnp.zeros(lanes, bool)
    return Found(
        x=jnp.zeros((lanes, n), dtype),
        row_multipliers=jnp.zeros(qp.rows.shape[:2], dtype),
        active=jax.vmap(possible)(qp, guess),
        implied=jnp.zeros(guess.shape, bool),
        iterations=nothing,
        factorizations=nothing,
        done=no,
        optimal=no,
        contradictions=nothing,
        descended=no,
        infeasible=no,
        compliance=qp.compliance,
        residual=jnp.zeros_like(tolerance),
    )


def search(qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"], *, max_iterations: int) -> Found:
    """The search for a batch: every argument has a leading axis, the lanes. A cap on the changes of the active set.

    It is in double precision whatever the data: which bounds are active is yes or no, and a weak damping beside heavy
    rows is below the rounding of single precision.
    """
    whole = partial(_found, cap=max_iterations, holds=CERTIFIED[qp.lower.dtype])
    return in_double(whole)(qp, guess, tolerance)


def _found(qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"], *, cap: int, holds: float) -> Found:
    """The answers, and where there is none, a careful step."""
    lanes, start = len(guess), unsearched(qp, guess, tolerance)
    search_one = partial(_search, cap=cap, holds=holds)
    if lanes == 1 or jax.default_backend() != "cpu" or not has_few_rows(qp):
        found = search_one((qp, tolerance), start)
    else:
        looked = _first_look(qp, start, tolerance)
        found = with_a_few((qp, tolerance), looked, looked.done, search_one, _block())
    residual = jax.vmap(kkt_residual)(qp, found.x, found.row_multipliers, found.active)
    found = found._replace(residual=residual, optimal=found.optimal & (residual <= holds))
    return with_a_few(qp, found, found.optimal | found.infeasible, _carefully, _block())


def _block() -> int:
    return _FEW if jax.default_backend() == "cpu" else _MANY


def _carefully(qp: QP, found: Found) -> Found:
    cold = jax.vmap(possible)(qp, jnp.zeros_like(found.active))
    x, y = jax.vmap(careful_step)(qp), jnp.zeros_like(found.row_multipliers)
    residual = jax.vmap(kkt_residual)(qp, x, y, cold)
    return found._replace(x=x, row_multipliers=y, active=cold, residual=residual)


def _first_look(qp: QP, start: Found, tolerance: Float[Array, " B"]) -> Found:
    """Where the guess is right, the answer, for less than a round of the search."""
    x, y, sound = minimize_through_rows(qp, start.active)
    scales = jax.vmap(scales_of)(qp, jax.vmap(lambda one: one.cost.diagonal())(qp), x, y)
    noise = Noise(*(tolerance[:, None] * a for a in scales))
    optimal = sound & jax.vmap(optimal_on)(qp, start, x, y, noise)
    end = start._replace(x=x, row_multipliers=y, factorizations=start.factorizations + 1, done=optimal, optimal=optimal)
    return choose(optimal, end, start)


def _search(given: tuple[QP, Float[Array, " B"]], start: Found, *, cap: int, holds: float) -> Found:
    """Rounds of factoring, checking and pivoting, until every lane is done; what is lost on the way goes downhill.

    Where the descent ends there is one more round, so that its answer is the exact minimiser on its active set, if
    there are digits enough for that.
    """
    qp, tolerance = given
    hessian = jax.vmap(lambda one: one.cost.hessian())(qp)
    down = partial(_descended, holds=holds, cap=cap)

    def go_on(state: tuple[Found, Array]) -> Bool[Array, ""]:
        found, rounds = state
        return (rounds <= _ROUNDS) & ~jnp.all(found.done)

    def body(state: tuple[Found, Array]) -> tuple[Found, Array]:
        found, rounds = state
        found = choose(~found.done, _round(qp, hessian, found, tolerance, cap), found)
        lost = ~(found.done | found.descended) & ((found.contradictions >= _PATIENCE) | (rounds + 1 >= _ROUNDS))
        return with_a_few(qp, found, ~lost, down, _block()), rounds + 1

    return jax.lax.while_loop(go_on, body, (start, jnp.asarray(0)))[0]


def _descended(qp: QP, found: Found, *, holds: float, cap: int) -> Found:
    start = jnp.where(jnp.isfinite(found.x), found.x, 0.0)
    end = descend(qp, start, found.iterations, holds=holds, max_iterations=cap)
    reach = jax.vmap(lambda one: jnp.max(apply(one.rows**2, 1.0 / one.cost.diagonal()), initial=0.0))(qp)
    contradicts = end.settled & end.infeasible
    optimal = end.settled & ~end.infeasible
    return found._replace(
        x=end.x,
        row_multipliers=end.row_multipliers,
        active=end.active,
        iterations=end.iterations,
        factorizations=found.factorizations + end.iterations - found.iterations,
        done=~optimal,
        optimal=optimal,
        descended=jnp.ones_like(optimal),
        infeasible=contradicts,
        compliance=jnp.where(contradicts[:, None], jnp.maximum(_SOFT * reach[:, None], qp.compliance), qp.compliance),
    )


def _round(qp: QP, hessian: Float[Array, "B n n"], found: Found, tolerance: Float[Array, " B"], cap: int) -> Found:
    factor = jax.vmap(factorize)(qp, hessian, found.active)
    x, y = minimize_on(qp, factor, found.active)
    scales = jax.vmap(scales_of)(qp, jnp.diagonal(hessian, axis1=1, axis2=2), x, y)
    noise = Noise(*(tolerance[:, None] * a for a in scales))
    optimal = jax.vmap(optimal_on)(qp, found, x, y, noise)
    more = Noise(*(_NEARLY[hessian.dtype] * a for a in noise))
    nearly = jax.vmap(optimal_on)(qp, found, x, y, more)
    exhausted = found.iterations >= cap
    searching = ~(found.done | optimal | exhausted | found.descended)

    def look() -> Found:
        end = find(
            *(qp, hessian, factor, found.active, noise, x, y),
            searching=searching,
            iterations=found.iterations,
            max_iterations=cap,
        )
        rests = jnp.all(end.active == found.active, 1)
        return found._replace(
            active=end.active,
            implied=end.implied,
            iterations=end.iterations,
            contradictions=found.contradictions
            + jnp.where(rests & (end.contradicted | ~nearly), _PATIENCE, end.contradicted.astype(jnp.int32)),
        )

    after = jax.lax.cond(jnp.any(searching), lambda: choose(searching, look(), found), lambda: found)
    same = jnp.all(after.active == found.active, 1)
    good = nearly & same & jax.vmap(lambda x, y: jnp.isfinite(x).all() & jnp.isfinite(y).all())(x, y)
    lost = after.contradictions >= _PATIENCE
    x, y = choose(good | ~found.descended, (x, y), (found.x, found.row_multipliers))
    return after._replace(
        x=x,
        row_multipliers=y,
        factorizations=found.factorizations + 1,
        done=exhausted | found.descended | (good & ((after.contradictions == found.contradictions) | lost)),
        optimal=good | found.descended,
    )


def possible(qp: QP, guess: Int[Array, " m"]) -> Int[Array, " m"]:
    """The guess, where the bounds that it names exist; equal bounds of the box are active from the start."""
    n = qp.lower.shape[0] - qp.rows.shape[0]
    named = jnp.where(guess == AT_UPPER, qp.upper, qp.lower)
    one_sided = jnp.where(guess == AT_UPPER, AT_UPPER, AT_LOWER)
    label = jnp.where((guess != INACTIVE) & jnp.isfinite(named), one_sided, INACTIVE)
    in_box = jnp.arange(len(guess)) < n
    pinned = qp.equality & (in_box | (guess != INACTIVE))
    return jnp.where(pinned, EQUALITY, label).astype(jnp.int32)


def optimal_on(qp: QP, found: Found, x: Float[Array, " n"], y: Float[Array, " p"], noise: Noise) -> Bool[Array, ""]:
    """Whether the minimiser on the active set is the minimiser: others hold, multipliers have their signs."""
    active = found.active
    slope = qp.cost.gradient(x) - apply(qp.rows.T, y)
    multipliers = jnp.concatenate([slope, y])
    gap = _gaps(qp, x, y)
    open_equality = qp.equality & (active == INACTIVE) & ~found.implied
    violated = gap > jnp.where(found.implied, NO_GAP[x.dtype], 1.0) * noise.value
    wrong = jnp.where(active == AT_LOWER, -multipliers, jnp.where(active == AT_UPPER, multipliers, -jnp.inf))
    return ~jnp.any(violated | open_equality | (wrong > noise.multiplier))


def _gaps(qp: QP, x: Float[Array, " n"], y: Float[Array, " p"]) -> Float[Array, " m"]:
    """How far each constraint is outside its interval; negative inside."""
    values = jnp.concatenate([x, apply(qp.rows, x) + qp.compliance * y])
    return jnp.maximum(qp.lower - values, values - qp.upper)
