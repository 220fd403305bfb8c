"""The core's weighted QP on a CPU: its candidates against the plain method, lane by lane, and against daqp."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_checks import needs_core
from problem_families import PLANTED
from recorded import QP_DAMPING, recorded_qps
from weighted_families import MANY, M, N, P, Problems, problems

from benchmarks.agreement import planted
from osik_jax.solvers import Status, solve_least_squares_qp
from osik_jax.solvers.qp import _core
from osik_jax.solvers.qp._problem import QP, LeastSquares

pytestmark = needs_core
COUNT = 200


def solved(p: Problems, backend="core", warm_start=None):
    none = np.zeros((len(p.target), N + P), np.int32)
    return solved_from(p, none if warm_start is None else warm_start, backend=backend)


@partial(jax.jit, static_argnames="backend")
def solved_from(p: Problems, warm_start, *, backend):
    def one(p: Problems, warm_start):
        *given, compliance, damping = p
        options = dict(rows_compliance=compliance, damping=damping, warm_start=warm_start)
        return solve_least_squares_qp(*given, **options, backend=backend)

    return jax.vmap(one)(p, warm_start)


def candidates(p: Problems):
    count = len(p.matrix)
    cost = LeastSquares(*map(jnp.asarray, (p.matrix, p.target, p.weight, p.damping, np.zeros((count, N)))))
    lower, upper = (jnp.concatenate(pair, 1) for pair in ((p.lower, p.rows_lower), (p.upper, p.rows_upper)))
    qp = QP(cost, jnp.asarray(p.rows), jnp.asarray(p.rows_compliance), lower, upper)
    return _core.solve(qp, jnp.zeros(lower.shape, int), jnp.full(count, 1e-12), 1000)


def assert_same(p: Problems, found, expected) -> None:
    """Statuses and working sets, and x in the metric of the Hessian's diagonal."""
    np.testing.assert_array_equal(found.status, expected.status)
    good = np.asarray(expected.status == Status.SOLVED)
    unit = np.sqrt(np.einsum("bm,bmn->bn", p.weight, p.matrix**2) + p.damping)
    off = np.max(np.abs(found.x - expected.x) * unit, 1) / np.max(np.abs(expected.x) * unit, 1)
    assert off[good].max() < 1e-8
    assert np.asarray(found.active == expected.active)[good].all(1).mean() > 0.99


@pytest.mark.variants(slow=["16"], release=["7"])
@pytest.mark.parametrize("m", [M, MANY])
def test_lane_by_lane_as_the_plain_method(m):
    p = problems(m=m)
    found = solved(p)
    assert_same(p, found, solved(p, "jax"))
    assert (found.status == Status.SOLVED).all()
    taken = candidates(p)
    assert (taken.converged != 0).mean() > 0.99
    np.testing.assert_array_equal(found.factorizations, taken.factorizations)  # no lane had to be searched
    assert found.factorizations.max() > 3 and found.iterations.max() > 5


@pytest.mark.slow
def test_no_candidate_is_left_to_the_search_where_dampings_are_weak():
    """Dampings from 1e-6, fewer rows than variables: the rows' system has a condition of 1e9."""
    p = problems(10_000, seed=1)
    taken = candidates(p)
    assert (taken.converged == _core.CERTIFIED).all()
    np.testing.assert_array_equal(solved(p).factorizations, taken.factorizations)


@pytest.mark.variants(release=["float64"])
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_recorded_problems(precision):
    """Double is as exact as the records, single to its own rounding of the rows."""
    r = recorded_qps("nao")
    given = (r.A, r.b, np.ones(r.b.shape), r.lower, r.upper)

    def one(*data):
        return solve_least_squares_qp(*data, damping=QP_DAMPING, backend="core")

    found = jax.jit(jax.vmap(one))(*(jnp.asarray(a, precision) for a in given))
    assert found.x.dtype == precision and (found.status == Status.SOLVED).all()
    off = np.einsum("bmn,bn->bm", r.A, np.asarray(found.x, float) - r.solution)
    assert np.abs(off).max() < (1e-12 if precision == "float64" else 1e-5)


def test_a_warm_start_costs_one_factorization():
    p = problems(seed=3)
    cold = solved(p)
    warm = solved(p, warm_start=cold.active)
    np.testing.assert_array_equal(warm.factorizations, 1)
    np.testing.assert_array_equal(warm.iterations, 0)
    np.testing.assert_allclose(warm.x, cold.x, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("family", "seed", "lanes"),
    [
        ("pinned", 0, [299, 332, 1135, 1313]),  # rows of pinned variables alone hold by themselves, but for rounding
        ("duplicated_equalities", 1, [1372, 1514]),
        ("duplicated_rows", 1, [2293, 3090]),
        ("nearly_singular", 0, [2600]),  # the end of the dual method, solved anew, is beyond another bound
    ],
)
def test_what_was_once_left_over_is_at_the_planted_optimum(family, seed, lanes):
    """Problems that went to the search after the kernel, which did not solve them."""
    qps = PLANTED[family](np.random.default_rng(seed), 4096)
    p = planted(np.random.default_rng(seed), 4096, draw=PLANTED[family])
    p, H, x = jax.tree.map(lambda a: a[np.asarray(lanes)], (p, qps.H, qps.x))
    taken = candidates(p)
    assert (taken.converged != 0).all()
    off = np.asarray(taken.x) - x
    cost, whole = (np.einsum("bi,bij,bj->b", v, H, v) for v in (off, x))
    assert np.sqrt(cost / whole).max() < 1e-9
    values = np.einsum("bpn,bn->bp", p.rows, taken.x)
    beyond = np.maximum(p.rows_lower - values, values - p.rows_upper).max(1)
    assert (beyond < 1e-9 * np.abs(values).max(1)).all()


def test_problems_before_say_nothing():
    """A problem has the same answer, to the bit, after any other; ``MANY`` rows are more than variables."""
    for m in (M, MANY):
        p = problems(60, m)
        bad = jax.tree.map(np.array, p)
        bad.target[::2] = np.nan
        bad.matrix[1::4] *= 1e200
        mixed = jax.tree.map(lambda a, b: np.stack([a, b], 1).reshape(-1, *a.shape[1:]), bad, p)
        first, after = candidates(p), jax.tree.map(lambda a: a[1::2], candidates(mixed))
        assert (first.converged != 0).mean() > 0.99 and np.isfinite(first.x).all()
        jax.tree.map(np.testing.assert_array_equal, first, after)
