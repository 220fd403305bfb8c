"""The minimiser by descent, for problems in which the pivots of the search lose their way.

The tableau of the search is an inverse; where a weak damping stands beside heavy rows, what bounds and rows leave of
it is smaller than its rounding, and constraints seem to contradict that do not. Here nothing is inverted and nothing
is updated. A row that gives way makes the cost piecewise quadratic, so a problem whose rows all do has a box and
nothing else, and a projected Newton method goes downhill in it from any start (D. P. Bertsekas, "Projected Newton
methods for optimization problems with simple constraints", SIAM J. Control and Optimization 20, 1982). Its factor is
R of the rows themselves, whose condition is the root of the Hessian's.

Hard rows give way a little and are pulled back by their multipliers (the method of multipliers). Where they contradict
each other or the box, these grow along a vector that proves it, and x goes to the least violation.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._box import outside
from .._certificate import contradiction
from .._dense import apply
from .._double import first_smallest
from .._lanes import choose
from .._pivots import AT_LOWER, AT_UPPER, EQUALITY, INACTIVE
from ._problem import QP, forces, given_way, scales_of

_STIFF = 1e5
"""Curvature of a hard row, of the largest of the cost: what it gives way by is 1e-5 of its pull's due, each time."""
_SHORTEST, _LENGTHS = 1e-9, 31
_ROUNDINGS = 4e-15
"""Share of its forces; a variable that is left with less is at rest."""
_SMALL = 1e-13
"""Share of x; a Newton step that is shorter is the last on its face."""
_BOLD = 10
"""Iterations in which all bounds that the slope leads away from are left at once; then one at a time."""
_MOST_PULLS = 40
_STIFFER = 0.1
"""Compliance of hard rows that contradict, of that before, where a bound keeps x from the least violation."""
_FLAT = 1e-9
"""Share of its terms; a slope of the violation that is less is none."""
_SAME = 1e-9
"""Share of x; the least violation has been found where a pull moves it by less."""


class Point(NamedTuple):
    """Iterate of one problem."""

    x: Float[Array, " n"]
    pull: Float[Array, " p"]  # multipliers of the hard rows so far
    compliance: Float[Array, " p"]  # of the rows, hard ones too
    before: Float[Array, " n"]  # x at the last change of ``pull``
    pulls: Int[Array, ""]
    iterations: Int[Array, ""]
    missed: Float[Array, ""]  # violation of hard rows at the last change of ``pull``, of what counts as none
    searching: Bool[Array, ""]
    settled: Bool[Array, ""]
    infeasible: Bool[Array, ""]
    careful: Bool[Array, ""]  # one bound is left at a time
    arrived: Bool[Array, ""]  # at the minimiser of its face, so that a bound may be left
    rests: Bool[Array, ""]  # at the minimiser for these pulls
    since: Int[Array, ""]  # iterations since the last change of ``pull``


class View(NamedTuple):
    """What an iterate stands in."""

    values: Float[Array, " p"]  # of the rows, before their pulls
    multipliers: Float[Array, " p"]
    slope: Float[Array, " n"]
    free: Bool[Array, " n"]
    leaves: Bool[Array, ""]  # whether the slope leads away from a bound


class Descended(NamedTuple):
    """Where a descent ended."""

    x: Float[Array, " n"]
    row_multipliers: Float[Array, " p"]
    active: Int[Array, " m"]
    iterations: Int[Array, ""]
    settled: Bool[Array, ""]
    infeasible: Bool[Array, ""]


def descend(
    qp: QP,
    start: Float[Array, "B n"],
    iterations: Int[Array, " B"],
    *,
    holds: float,
    max_iterations: int,
) -> Descended:
    """The minimisers of a batch: every argument has a leading axis, the lanes.

    Args:
        qp: the problems.
        start: where the descent begins, once clipped into the box.
        iterations: changes of the active set so far.
        holds: violation of a hard row that counts as none, relative to its scale.
        max_iterations: cap on the changes of the active set.
    """
    first = jax.vmap(_begin)(qp, start, iterations)

    def go_on(s: Point) -> Bool[Array, ""]:
        return jnp.any(s.searching & (s.iterations < max_iterations))

    def body(s: Point) -> Point:
        return choose(s.searching & (s.iterations < max_iterations), jax.vmap(partial(_improve, holds))(qp, s), s)

    return jax.vmap(_end)(qp, jax.lax.while_loop(go_on, body, first))


def _begin(qp: QP, start: Float[Array, " n"], iterations: Int[Array, ""]) -> Point:
    n = len(start)
    x = jnp.clip(start, qp.lower[:n], qp.upper[:n])
    zero = jnp.zeros_like(iterations)
    no = jnp.zeros((), bool)
    return Point(
        x=x,
        pull=jnp.zeros_like(qp.compliance),
        compliance=given_way(qp, _STIFF),
        before=x,
        pulls=zero,
        iterations=iterations,
        missed=jnp.asarray(jnp.inf, x.dtype),
        searching=~no,
        settled=no,
        infeasible=no,
        careful=no,
        arrived=~no,
        rests=no,
        since=zero,
    )


def _view(qp: QP, s: Point) -> View:
    n = len(s.x)
    lower, upper = _box(qp)
    values = apply(qp.rows, s.x) - s.compliance * s.pull
    multipliers = -outside(values, qp.lower[n:], qp.upper[n:]) / s.compliance
    slope = qp.cost.gradient(s.x) - apply(qp.rows.T, multipliers)
    at_bound = (s.x <= lower) | (s.x >= upper)
    leaves = at_bound & (((s.x > lower) & (slope > 0.0)) | ((s.x < upper) & (slope < 0.0)))
    gain = jnp.where(leaves, slope**2 / qp.cost.diagonal(), 0.0)
    one = leaves & (jnp.arange(n) == first_smallest(-gain)) & s.arrived
    return View(values, multipliers, slope, ~at_bound | jnp.where(s.careful, one, leaves), leaves.any())


def _improve(holds: float, qp: QP, s: Point) -> Point:
    """A projected Newton step; after one that was as good as none, another pull at the hard rows, or the end."""
    seen = _view(qp, s)
    return jax.tree.map(partial(jnp.where, s.rests), _pulled(holds, qp, s, seen), _stepped(qp, s, seen))


def _stepped(qp: QP, s: Point, seen: View) -> Point:
    newton = _newton(qp, s, seen)
    root = jnp.sqrt(qp.cost.diagonal())
    small = jnp.max(jnp.abs(newton) * root) <= _SMALL * jnp.max(jnp.abs(s.x) * root)
    flat = jnp.all(~seen.free | (jnp.abs(seen.slope) <= _ROUNDINGS * forces(qp, s.x, seen.multipliers)))
    step, lowers, whole, fits = _best(qp, s, seen, newton)
    rests = small | flat | ~lowers
    last = rests & (s.arrived | ~seen.leaves) & (s.careful | small | flat)
    step = jnp.where(small | (fits & ~lowers), newton, jnp.where(lowers, step, 0.0))
    return s._replace(
        x=_moved(qp, s.x, step),
        iterations=s.iterations + 1,
        since=s.since + 1,
        careful=s.careful | (rests & ~last) | (s.since >= _BOLD),
        arrived=jnp.where(s.careful, rests | whole, small | flat),
        rests=last,
    )


def _moved(qp: QP, x: Float[Array, " n"], step: Float[Array, " n"]) -> Float[Array, " n"]:
    """x + step in the box; on the bound that it goes to where only rounding is between."""
    lower, upper = _box(qp)
    new = jnp.clip(x + step, lower, upper)
    bound = jnp.where(step > 0.0, upper, lower)
    near = (step != 0.0) & jnp.isfinite(bound) & (jnp.abs(new - bound) <= _ROUNDINGS * (jnp.abs(bound) + jnp.abs(x)))
    return jnp.where(near, bound, new)


def _box(qp: QP) -> tuple[Array, Array]:
    n = qp.rows.shape[1]
    return qp.lower[:n], qp.upper[:n]


def _newton(qp: QP, s: Point, seen: View) -> Float[Array, " n"]:
    """To the minimiser among the free variables, if no row changed sides."""
    held = jnp.where(seen.multipliers != 0.0, 1.0 / jnp.sqrt(s.compliance), 0.0)
    rows = jnp.concatenate([(held[:, None] * qp.rows) * seen.free, qp.cost.root(seen.free)])
    factor = jnp.linalg.qr(_longest_first(rows), mode="r")
    down = jnp.where(seen.free, -seen.slope, 0.0)
    half = jax.scipy.linalg.solve_triangular(factor, down, trans=1)
    return jnp.where(seen.free, jax.scipy.linalg.solve_triangular(factor, half), 0.0)


def _longest_first(rows: Float[Array, "m n"]) -> Float[Array, "m n"]:
    """So that reflections keep short rows as exact as long ones."""
    order = jax.lax.iota(jnp.int32, len(rows))
    return rows[jax.lax.sort((-jnp.sum(rows**2, 1), order), num_keys=1)[1]]


def _best(
    qp: QP, s: Point, seen: View, newton: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Bool[Array, ""], Bool[Array, ""], Bool[Array, ""]]:
    """The step along Newton's direction that lowers the cost most; whether it does, is the whole one, and could be.

    It is clipped into the box at many lengths, or stops at the first bound.
    """
    lower, upper = _box(qp)
    ahead = jnp.where(newton > 0.0, upper - s.x, lower - s.x)
    first = jnp.min(jnp.where(newton != 0.0, ahead / jnp.where(newton != 0.0, newton, 1.0), jnp.inf))
    share = _SHORTEST ** jnp.linspace(0.0, 1.0, _LENGTHS)
    share = jnp.concatenate(
        [jnp.where(s.careful, jnp.clip(first, 0.0, 1.0), 1.0) * share, jnp.clip(first, 0.0, 1.0)[None]]
    )
    steps = jnp.clip(s.x + share[:, None] * newton, lower, upper) - s.x
    changes = jax.vmap(partial(_change, qp, s, seen))(steps)
    rounding = apply(jnp.abs(steps), forces(qp, s.x, seen.multipliers)) * float(jnp.finfo(s.x.dtype).eps)
    fits = first >= 1.0
    whole = fits & (share == 1.0)
    best = first_smallest(changes - jnp.where(whole, 4.0 * rounding, 0.0))
    return steps[best], changes[best] < -rounding[best], whole[best], fits


def _change(qp: QP, s: Point, seen: View, step: Float[Array, " n"]) -> Float[Array, ""]:
    """Of the cost, from its slope and what bends it: nothing large cancels."""
    lower, upper = qp.lower[len(step) :], qp.upper[len(step) :]
    along, old = apply(qp.rows, step), outside(seen.values, lower, upper)
    new = outside(seen.values + along, lower, upper)
    more = jnp.where(old * new > 0.0, along, new - old)  # exactly, where the row stays on its side
    bend = jnp.sum((more**2 + 2.0 * old * (more - along)) / (2.0 * s.compliance))
    return jnp.dot(seen.slope, step) + 0.5 * jnp.dot(step, qp.cost.curvature(step)) + bend


def _pulled(holds: float, qp: QP, s: Point, seen: View) -> Point:
    """At a minimiser: the end if its hard rows hold; else their multipliers are taken over, and on."""
    n = len(s.x)
    hard = qp.compliance == 0.0
    values = apply(qp.rows, s.x)
    gap = jnp.where(hard, outside(values, qp.lower[n:], qp.upper[n:]), 0.0)
    off = jnp.where(hard, values - jnp.clip(seen.values, qp.lower[n:], qp.upper[n:]), 0.0)
    nothing = holds * scales_of(qp, qp.cost.diagonal(), s.x, seen.multipliers).value[n:]
    missed = jnp.max(jnp.abs(off) / jnp.where(off == 0.0, 1.0, nothing), initial=0.0)
    proven = contradiction(qp.rows, gap / s.compliance, gap, s.x, *_box(qp)) & (missed > 1.0)
    hold = (missed <= 1e-3) | ((missed <= 1.0) & (missed > 0.1 * s.missed))
    turns = proven & ~s.infeasible
    root = jnp.sqrt(qp.cost.diagonal())
    still = jnp.max(jnp.abs(s.x - s.before) * root) <= _SAME * jnp.max(jnp.abs(s.x) * root)
    least = _least(qp, s.x, gap)
    last = s.pulls + 1 >= _MOST_PULLS
    settled = jnp.where(s.infeasible, proven & ((still & least) | last), hold & ~turns)
    even = jnp.max(jnp.where(hard, s.compliance, 0.0), initial=0.0)
    stiffer = jnp.where(s.infeasible & still & ~least, _STIFFER, 1.0) * s.compliance
    return s._replace(
        pull=jnp.where(hard & ~turns & ~settled, seen.multipliers, jnp.where(settled, s.pull, 0.0)),
        compliance=jnp.where(hard, jnp.where(turns, even, stiffer), s.compliance),
        before=s.x,
        pulls=s.pulls + 1,
        since=jnp.zeros_like(s.since),
        rests=jnp.zeros_like(s.rests),
        careful=jnp.zeros_like(s.careful),
        arrived=jnp.ones_like(s.arrived),
        missed=missed,
        searching=~settled & ~last,
        settled=settled,
        infeasible=s.infeasible | turns,
    )


def _least(qp: QP, x: Float[Array, " n"], gap: Float[Array, " p"]) -> Bool[Array, ""]:
    """Whether no way in the box makes the gaps smaller, in the Euclidean norm."""
    lower, upper = _box(qp)
    slope = apply(qp.rows.T, gap)
    inward = jnp.where(x <= lower, -slope, jnp.where(x >= upper, slope, jnp.abs(slope)))
    inward = jnp.where(lower == upper, 0.0, inward)
    return jnp.all(inward <= _FLAT * apply(jnp.abs(qp.rows).T, jnp.abs(gap)))


def _end(qp: QP, s: Point) -> Descended:
    seen = _view(qp, s)
    n = len(s.x)
    low, _ = _box(qp)
    sides = jnp.concatenate(
        [
            jnp.where(seen.free, INACTIVE, jnp.where(s.x <= low, AT_LOWER, AT_UPPER)),
            jnp.sign(-seen.multipliers).astype(jnp.int32),
        ]
    )
    hard = jnp.concatenate([jnp.ones(n, bool), qp.compliance == 0.0])
    active = jnp.where(qp.equality & (hard | (sides != INACTIVE)), EQUALITY, sides).astype(jnp.int32)
    return Descended(s.x, seen.multipliers, active, s.iterations, s.settled, s.infeasible)
