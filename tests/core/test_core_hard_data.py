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
LEVELS = ["hqp", "nullspace", "reverse", "saturated"]


def hard_rows(rng, m, n, dtype):
    """Rows of which one comes twice, one is 0 and one is the sum of two."""
    A = rng.normal(size=(LANES, m, n))
    if dtype == np.float32:
        A = np.round(1024.0 * A) / 1024.0  # sums of these are exact: rows depend on each other or do not
    if m > 2:
        A[:, 1], A[:, 2] = 2.0 * A[:, 0], 0.0
    if m > 4:
        A[:, 4] = A[:, 0] + A[:, 3]
    return A.astype(dtype)


def hard_box(rng, n, dtype):
    """A fifth of the bounds infinite, a fifth of the variables pinned."""
    low, high = -rng.exponential(size=(LANES, n)), rng.exponential(size=(LANES, n))
    pinned = rng.random((LANES, n)) < 0.2
    low = np.where(rng.random((LANES, n)) < 0.2, -np.inf, low)
    high = np.where(rng.random((LANES, n)) < 0.2, np.inf, high)
    at = rng.uniform(-0.5, 0.5, (LANES, n))
    return (np.where(pinned, at, bound).astype(dtype) for bound in (low, high))


def hard_qps(n, m, dtype):
    rng = np.random.default_rng(n + m)
    low, high = hard_box(rng, n, dtype)
    A, weight = hard_rows(rng, m, n, dtype), (10.0 ** rng.uniform(-6, 6, (LANES, m))).astype(dtype)
    # hard rows that the box can keep, one of them twice
    C = hard_rows(rng, 3, n, dtype)
    inside = np.einsum("bpn,bn->bp", C, np.clip(np.zeros((LANES, n), dtype), low, high))
    rows = C, (inside - 0.1).astype(dtype), (inside + 0.1).astype(dtype), np.zeros((LANES, 3), dtype)
    damping = (10.0 ** rng.uniform(-4, 0, (LANES, n))).astype(dtype)
    return Problems(A, rng.normal(size=(LANES, m)).astype(dtype), weight, low, high, *rows, damping)


def hard_levels(n, m, dtype):
    rng = np.random.default_rng(n + m)
    levels = []
    for _ in range(3):
        target = 1.5 * rng.normal(size=(LANES, m)).astype(dtype)
        above = np.where(rng.random(target.shape) < 0.3, np.inf, target).astype(dtype)
        weight = (10.0 ** rng.uniform(-2, 2, target.shape)).astype(dtype)
        if dtype == np.float32:
            weight = 4.0 ** np.round(np.log(weight) / np.log(dtype(4.0)))  # with exact roots
        levels.append(Rows(hard_rows(rng, m, n, dtype), target, above, weight))
    return Hierarchies(levels, *hard_box(rng, n, dtype))


def by_both(solve, p):
    run = jax.jit(lambda p, backend: jax.vmap(partial(solve, backend=backend))(p), static_argnums=1)
    return tuple(jax.tree.map(np.asarray, run(p, backend)) for backend in ("core", "jax"))


def in_double(p):
    return jax.tree.map(lambda a: np.asarray(a, float), p)


@pytest.mark.variants(release=SHAPES[1:])
@pytest.mark.parametrize("shape", SHAPES)
def test_weighted(shape):
    n, m = map(int, shape.split("-"))
    p = hard_qps(n, m, float)
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


IN_THE_GATE = ["60-40-hqp", "6-5-nullspace", "6-5-reverse", "60-40-saturated"]
AT_NIGHT = [name for shape in SHAPES for solver in LEVELS if (name := f"{shape}-{solver}") not in IN_THE_GATE][1:]


@pytest.mark.variants(slow=IN_THE_GATE, release=AT_NIGHT)
@pytest.mark.parametrize("solver", LEVELS)
@pytest.mark.parametrize("shape", SHAPES)
def test_levels(shape, solver):
    n, m = map(int, shape.split("-"))
    p = hard_levels(n, m, float)
    found, plain = by_both(partial(solve_levels, solver=solver), p)
    np.testing.assert_array_equal(found.status, plain.status)
    assert (found.status == Status.SOLVED).all()
    assert levels_difference(p, found, plain).max() < 1e-7
    for i in range(0, LANES, 4) if solver == "hqp" else ():
        assert certificate(p, i, found.x[i]).max() < 1e-8


@pytest.mark.variants(release=["qp", "hqp", "saturated"])
@pytest.mark.slow
@pytest.mark.parametrize("solver", ["qp", "hqp", "saturated"])
def test_single_precision(solver):
    """Both are in double precision inside, and rows here depend on each other exactly, weighted or not.

    Rows that do so but for the 1e-8 of a rounded sum or of a rounded weight are at the tolerances of single data: of 40
    such hierarchies 6 have other lower levels by the kernel, by plain JAX and by ``lexicographic.py``.
    """
    p = (hard_qps if solver == "qp" else hard_levels)(6, 5, np.float32)
    found, plain = by_both(solve_qp if solver == "qp" else partial(solve_levels, solver=solver), p)
    assert found.x.dtype == plain.x.dtype == np.float32
    np.testing.assert_array_equal(found.status, plain.status)
    found, plain = (jax.tree.map(lambda a: np.asarray(a, float), answer) for answer in (found, plain))
    difference = qp_difference if solver == "qp" else levels_difference
    assert difference(in_double(p), found, plain).max() < 1e-5
