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
from .._lanes import choose, with_the_rest
from .._pivots import AT_LOWER, AT_UPPER, EQUALITY, INACTIVE, NO_GAP, Noise
from ._descent import careful_step, descend
from ._factor import factorize, minimize_on
from ._problem import QP, scales_of
from ._tableau import find
from ._through_rows import has_few_rows, minimize_through_rows

_ROUNDS = 12
_NEARLY = {jnp.dtype("float64"): 1e3, jnp.dtype("float32"): 1e2}
"""Noises; an answer that the search does not change is accepted with violations up to this."""
_PATIENCE = 2
"""Searches that end at a contradiction before the pivots are given up; one that moves nothing is enough."""
_HOLDS = {jnp.dtype("float64"): 1e-9, jnp.dtype("float32"): 1e-6}
"""A hard row that is missed by less, of its scale, holds; by the precision of the data."""
_SOFT = 1e-12
"""Compliance of hard rows that contradict, of their reach: with it the least violation has a derivative."""
_EXACT = 1e-10
"""Share of its scale; where no constraint is off by more, the minimiser on the active set is the descent's."""
_FEW = 4
"""Lanes of a block that are searched together, where most of it needs no search."""


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
    infeasible: Bool[Array, ""]  # it is proven that rows contradict each other or the box; x is the least violation
    compliance: Float[Array, " p"]  # of the rows in the problem that ``x`` solves


def search(qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"], *, max_iterations: int) -> Found:
    """The search for a batch: every argument has a leading axis, the lanes. A cap on the changes of the active set.

    It is in double precision whatever the data: which bounds are active is yes or no, and a weak damping beside heavy
    rows is below the rounding of single precision.
    """
    whole = partial(_in_turn, cap=max_iterations, holds=_HOLDS[qp.lower.dtype])
    return in_double(whole)(qp, guess, tolerance)


def _in_turn(qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"], *, cap: int, holds: float) -> Found:
    """By pivots; what they leave by descent; where there is no answer then, a careful step."""
    found = _by_pivots(qp, guess, tolerance, cap)
    few = min(len(guess), _FEW)

    def down(at: Array, found: Found) -> Found:
        part, own = jax.tree.map(lambda a: a[at], (qp, found))
        return _descended(part, own, holds=holds, cap=cap)

    def carefully(at: Array, found: Found) -> Found:
        part, own = jax.tree.map(lambda a: a[at], (qp, found))
        x, active = jax.vmap(careful_step)(part)
        return own._replace(x=x, row_multipliers=jnp.zeros_like(own.row_multipliers), active=active)

    found = with_the_rest(found, found.optimal | (found.iterations >= cap), down, few)
    return with_the_rest(found, found.optimal | found.infeasible, carefully, few)


def _descended(qp: QP, found: Found, *, holds: float, cap: int) -> Found:
    start = jnp.where(jnp.isfinite(found.x), found.x, 0.0)
    end = descend(qp, start, found.iterations, holds=holds, max_iterations=cap)
    reach = jax.vmap(lambda one: jnp.max(apply(one.rows**2, 1.0 / one.cost.diagonal()), initial=0.0))(qp)
    soft = jnp.maximum(_SOFT * reach[:, None], qp.compliance)
    hessian = jax.vmap(lambda one: one.cost.hessian())(qp)
    x, y = minimize_on(qp, jax.vmap(factorize)(qp, hessian, end.active), end.active)
    noise = Noise(*(_EXACT * a for a in jax.vmap(scales_of)(qp, jnp.diagonal(hessian, axis1=1, axis2=2), x, y)))
    better = end.settled & ~end.infeasible & jax.vmap(optimal_on)(qp, found._replace(active=end.active), x, y, noise)
    x, y = choose(better, (x, y), (end.x, end.row_multipliers))
    return found._replace(
        x=x,
        row_multipliers=y,
        active=end.active,
        iterations=end.iterations,
        factorizations=found.factorizations + end.iterations - found.iterations,
        optimal=end.settled & ~end.infeasible,
        infeasible=end.settled & end.infeasible,
        compliance=jnp.where((end.settled & end.infeasible)[:, None], soft, qp.compliance),
    )


def _by_pivots(qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"], cap: int) -> Found:
    lanes, n, dtype = guess.shape[0], qp.lower.shape[1] - qp.rows.shape[1], qp.lower.dtype
    nothing = jnp.zeros(lanes, jnp.int32)
    start = Found(
        x=jnp.zeros((lanes, n), dtype),
        row_multipliers=jnp.zeros(qp.rows.shape[:2], dtype),
        active=jax.vmap(possible)(qp, guess),
        implied=jnp.zeros(guess.shape, bool),
        iterations=nothing,
        factorizations=nothing,
        done=jnp.zeros(lanes, bool),
        optimal=jnp.zeros(lanes, bool),
        contradictions=nothing,
        infeasible=jnp.zeros(lanes, bool),
        compliance=qp.compliance,
    )

    if lanes == 1 or jax.default_backend() != "cpu" or not has_few_rows(qp):
        return _search(qp, start, tolerance, cap=cap)
    looked = _first_look(qp, start, tolerance)

    def again(at: Array, found: Found) -> Found:
        return _search(*jax.tree.map(lambda a: a[at], (qp, found, tolerance)), cap=cap)

    return with_the_rest(looked, looked.done, again, min(lanes, _FEW))


def _first_look(qp: QP, start: Found, tolerance: Float[Array, " B"]) -> Found:
    """Where the guess is right, the answer, for less than a round of the search."""
    x, y, sound = minimize_through_rows(qp, start.active)
    scales = jax.vmap(scales_of)(qp, jax.vmap(lambda one: one.cost.diagonal())(qp), x, y)
    noise = Noise(*(tolerance[:, None] * a for a in scales))
    optimal = sound & jax.vmap(optimal_on)(qp, start, x, y, noise)
    end = start._replace(x=x, row_multipliers=y, factorizations=start.factorizations + 1, done=optimal, optimal=optimal)
    return choose(optimal, end, start)


def _search(qp: QP, start: Found, tolerance: Float[Array, " B"], *, cap: int) -> Found:
    """Rounds of factoring, checking and pivoting, until every lane is done."""
    hessian = jax.vmap(lambda one: one.cost.hessian())(qp)

    def go_on(state: tuple[Found, Array]) -> Bool[Array, ""]:
        found, rounds = state
        return (rounds < _ROUNDS) & ~jnp.all(found.done)

    def body(state: tuple[Found, Array]) -> tuple[Found, Array]:
        found, rounds = state
        return choose(~found.done, _round(qp, hessian, found, tolerance, cap), found), rounds + 1

    return jax.lax.while_loop(go_on, body, (start, jnp.asarray(0)))[0]


def _round(qp: QP, hessian: Float[Array, "B n n"], found: Found, tolerance: Float[Array, " B"], cap: int) -> Found:
    factor = jax.vmap(factorize)(qp, hessian, found.active)
    x, y = minimize_on(qp, factor, found.active)
    scales = jax.vmap(scales_of)(qp, jnp.diagonal(hessian, axis1=1, axis2=2), x, y)
    noise = Noise(*(tolerance[:, None] * a for a in scales))
    optimal = jax.vmap(optimal_on)(qp, found, x, y, noise)
    more = Noise(*(_NEARLY[hessian.dtype] * a for a in noise))
    nearly = jax.vmap(optimal_on)(qp, found, x, y, more)
    exhausted = found.iterations >= cap
    searching = ~(found.done | optimal | exhausted)

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
    return after._replace(
        x=x,
        row_multipliers=y,
        factorizations=found.factorizations + 1,
        done=exhausted | lost | (good & (after.contradictions == found.contradictions)),
        optimal=good,
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
