"""Active set found and certified: guess, factor, check; where the check fails, pivot on from there, and again.

The guess is the warm start, or no active bound at all; where it is right, one factorisation is all there is. In a batch
on a CPU a problem of few rows tries it through a system of their size first. The answer always comes from a fresh
factorisation at the final active set, never from the tableau that found it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._dense import apply
from .._lanes import choose, with_the_rest
from .._pivots import AT_LOWER, AT_UPPER, EQUALITY, INACTIVE, NO_GAP, Noise
from ._factor import factorize, minimize_on
from ._problem import QP
from ._tableau import find
from ._through_rows import has_few_rows, minimize_through_rows

_ROUNDS = 30
_NEARLY = {jnp.dtype("float64"): 1e3, jnp.dtype("float32"): 1e2}
"""Noises; an answer that the search does not change is accepted with violations up to this."""
_PATIENCE = 5
"""Searches that end at a contradiction before it is believed; one that does not move from fresh factors is enough.

A search that neither moves nor ends at an answer is taken for one too: more constraints are active there than can be
independent. Where the rows do not contradict each other after all, they hold once they are soft, and are made hard
again.
"""
_HOLDS = {jnp.dtype("float64"): 1e-8, jnp.dtype("float32"): 1e-4}
_SOFT = {jnp.dtype("float64"): (1e-6, 1e-12), jnp.dtype("float32"): (1e-3, 1e-4)}
"""Compliance of rows that contradict, first and last, as a share of their own; each stage starts where one ended."""
_FEW = 4
"""Lanes of a block that are searched together, where most of it needs no search."""
_NOUGHT = 100.0
"""Roundings of what the cost pulls at it; an answer that is no larger is 0."""


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
    infeasible: Bool[Array, ""]  # some rows contradict each other or the box: all of them have been made to give way
    compliance: Float[Array, " p"]  # of the rows in the problem that ``x`` solves


class Scales(NamedTuple):
    """Rounding in the values and multipliers of the constraints is this large, times a tolerance."""

    value: Float[Array, " m"]
    multiplier: Float[Array, " m"]


def search(qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"], *, max_iterations: int) -> Found:
    """The search for a batch: every argument has a leading axis, the lanes. A cap on the changes of the active set."""
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
        return _search(qp, start, tolerance, cap=max_iterations)
    looked = _first_look(qp, start, tolerance)

    def again(at: Array, found: Found) -> Found:
        return _search(*jax.tree.map(lambda a: a[at], (qp, found, tolerance)), cap=max_iterations)

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
    stiff, qp = qp, replace(qp, compliance=found.compliance)
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
    end = after._replace(
        x=x,
        row_multipliers=y,
        factorizations=found.factorizations + 1,
        done=exhausted | (nearly & same & (after.contradictions == found.contradictions)),
        optimal=nearly & same,
    )
    return jax.vmap(_give_way)(stiff, hessian, end, scales) if qp.rows.shape[1] else end


def _give_way(stiff: QP, hessian: Float[Array, "n n"], found: Found, scales: Scales) -> Found:
    """Where rows contradict, begins anew with all of them soft, and stiffens them; where they then hold, for good."""
    softens = (found.contradictions >= _PATIENCE) & ~found.infeasible
    gap = _gaps(stiff, found.x, jnp.zeros_like(found.row_multipliers))
    hardens = found.infeasible & found.done & jnp.all(gap <= _HOLDS[hessian.dtype] * scales.value)
    in_box = jnp.arange(len(found.active)) < len(found.x)
    pinned = jnp.where(stiff.equality & in_box, EQUALITY, INACTIVE)
    reach = apply(stiff.rows**2, 1.0 / jnp.where(jnp.diagonal(hessian) > 0.0, jnp.diagonal(hessian), 1.0))
    first, last = (jnp.maximum(share * jnp.max(reach), stiff.compliance) for share in _SOFT[hessian.dtype])
    stiffer = jnp.maximum(1e-3 * found.compliance, last)
    stiffens = found.infeasible & found.done & ~hardens & jnp.any(stiffer < found.compliance)
    return found._replace(
        active=jnp.where(softens, pinned, found.active).astype(jnp.int32),
        implied=found.implied & ~(softens | hardens | stiffens),
        done=found.done & ~hardens & ~stiffens,
        contradictions=jnp.where(hardens, -_ROUNDS * _PATIENCE, found.contradictions),
        infeasible=(found.infeasible | softens) & ~hardens,
        compliance=jnp.select([softens, hardens, stiffens], [first, stiff.compliance, stiffer], found.compliance),
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


def scales_of(qp: QP, diagonal: Float[Array, " n"], x: Float[Array, " n"], y: Float[Array, " p"]) -> Scales:
    """Invariant to the units of the variables: each is measured by the root of its curvature, from H's diagonal.

    Where the constraints hold all of x at 0, its rounding is that of what the cost pulls at it.
    """
    root = jnp.sqrt(jnp.where(diagonal > 0.0, diagonal, 1.0))
    pulled = jnp.abs(qp.cost.gradient(x)) / root**2
    nought = jnp.max(jnp.abs(x) * root) <= _NOUGHT * jnp.finfo(x.dtype).eps * jnp.max(pulled * root)
    size = jnp.where(nought, pulled, jnp.abs(x))
    reach = jnp.concatenate([1.0 / root, apply(jnp.abs(qp.rows), 1.0 / root)])
    span = jnp.concatenate([jnp.ones_like(x), jnp.sum(jnp.abs(qp.rows), 1)])
    floor = jnp.minimum(jnp.max(size * root) * reach, jnp.max(size) * span)
    values = jnp.concatenate([x, apply(qp.rows, x)])
    bounds = [jnp.where(jnp.isfinite(b), jnp.abs(b), jnp.inf) for b in (qp.lower, qp.upper)]
    nearest = jnp.minimum(*bounds)
    value = floor + jnp.abs(values) + jnp.where(jnp.isfinite(nearest), nearest, 0.0)
    pull = jnp.concatenate([1e-3 * apply(jnp.abs(qp.rows).T, jnp.abs(y)), jnp.zeros_like(y)])
    return Scales(value, value / jnp.maximum(reach, jnp.finfo(x.dtype).tiny) ** 2 + pull)


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
