"""Kernels of CPUs on hard data: beside plain JAX, quadprog and daqp, and the optimality of each level.

Rows come twice or are 0, variables are pinned or have no bounds, weights are 1e-6 to 1e6, and there may be one variable
or no row.
"""

from __future__ import annotations

from functools import partial

import jax
import numpy as np
import pytest
from core_checks import needs_core
from hierarchy_families import Hierarchies, Rows
from lexicographic import certificate
from optimality import by_daqp, by_quadprog
from problem_families import QPs
from weighted_families import Problems

from benchmarks.agreement import levels_difference, qp_difference, solve_levels, solve_qp
from osik_jax.solvers import Status

pytestmark = needs_core

LANES = 40
SHAPES = ["6-5", "1-0", "1-3", "6-0", "24-30", "60-40"]
LEVELS = ["hqp", "nullspace", "saturated"]


def hard_rows(rng, m, n):
    """Rows of which one comes twice, one is 0 and one is the sum of two."""
    A = rng.normal(size=(LANES, m, n))
    if m > 2:
        A[:, 1], A[:, 2] = 2.0 * A[:, 0], 0.0
    if m > 4:
        A[:, 4] = A[:, 0] + A[:, 3]
    return A


def hard_box(rng, n):
    """A fifth of the bounds infinite, a fifth of the variables pinned."""
    low, high = -rng.exponential(size=(LANES, n)), rng.exponential(size=(LANES, n))
    pinned = rng.random((LANES, n)) < 0.2
    low = np.where(rng.random((LANES, n)) < 0.2, -np.inf, low)
    high = np.where(rng.random((LANES, n)) < 0.2, np.inf, high)
    at = rng.uniform(-0.5, 0.5, (LANES, n))
    return (np.where(pinned, at, bound) for bound in (low, high))


def hard_qps(n, m):
    rng = np.random.default_rng(n + m)
    low, high = hard_box(rng, n)
    A, weight = hard_rows(rng, m, n), 10.0 ** rng.uniform(-6, 6, (LANES, m))
    # hard rows that the box can keep, one of them twice
    C = hard_rows(rng, 3, n)
    inside = np.einsum("bpn,bn->bp", C, np.clip(np.zeros((LANES, n)), low, high))
    rows = C, inside - 0.1, inside + 0.1, np.zeros((LANES, 3))
    damping = 10.0 ** rng.uniform(-4, 0, (LANES, n))
    return Problems(A, rng.normal(size=(LANES, m)), weight, low, high, *rows, damping)


def hard_levels(n, m):
    rng = np.random.default_rng(n + m)
    levels = []
    for _ in range(3):
        target = 1.5 * rng.normal(size=(LANES, m))
        above = np.where(rng.random(target.shape) < 0.3, np.inf, target)
        weight = 10.0 ** rng.uniform(-2, 2, target.shape)
        levels.append(Rows(hard_rows(rng, m, n), target, above, weight))
    return Hierarchies(levels, *hard_box(rng, n))


def by_both(solve, p):
    run = jax.jit(lambda p, backend: jax.vmap(partial(solve, backend=backend))(p), static_argnums=1)
    return tuple(jax.tree.map(np.asarray, run(p, backend)) for backend in ("core", "jax"))


@pytest.mark.variants(ordinary=[], slow=["6-5", "24-30"])
@pytest.mark.parametrize("shape", SHAPES)
def test_weighted(shape):
    n, m = map(int, shape.split("-"))
    p = hard_qps(n, m)
    found, plain = by_both(solve_qp, p)
    np.testing.assert_array_equal(found.status, plain.status)
    assert (found.status == Status.SOLVED).all()
    assert qp_difference(p, found, plain).max() < 1e-9
    H = np.einsum("bmi,bm,bmj->bij", p.matrix, p.weight, p.matrix) + np.einsum("bi,ij->bij", p.damping, np.eye(n))
    g = -np.einsum("bmi,bm->bi", p.matrix, p.weight * p.target)
    given = QPs(H, g, p.lower, p.upper, p.rows, p.rows_lower, p.rows_upper, found.x, np.ones_like(g))
    size = 0.5 * (p.weight * p.target**2).sum(1)
    judged = 0
    for i in range(LANES):
        mine, *others = (
            None if x is None else 0.5 * x @ H[i] @ x + g[i] @ x
            for x in (found.x[i], by_quadprog(given, i), by_daqp(given, i))
        )
        for cost in others:
            if mine is not None and cost is not None:
                assert mine <= cost + 1e-8 * max(size[i], abs(cost))
                judged += 1
    assert judged > LANES / 2


@pytest.mark.variants(ordinary=[], slow=["6-5-hqp", "6-5-saturated"])
@pytest.mark.parametrize("solver", LEVELS)
@pytest.mark.parametrize("shape", SHAPES)
def test_levels(shape, solver):
    n, m = map(int, shape.split("-"))
    p = hard_levels(n, m)
    found, plain = by_both(partial(solve_levels, solver=solver), p)
    np.testing.assert_array_equal(found.status, plain.status)
    assert (found.status == Status.SOLVED).all()
    assert levels_difference(p, found, plain).max() < 1e-7
    for i in range(0, LANES, 4) if solver == "hqp" else ():
        assert certificate(p, i, found.x[i]).max() < 1e-8
