"""Implicit derivatives of the solvers: a thousand random problems each, along random changes of all their data."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivative_checks import assert_exact, check, nearest_side

from osik_jax.solvers import Level, solve_hqp, solve_least_squares_qp, solve_nullspace, solve_qp

CASES = 1000
N = 8


def straight(case, t):
    """Along a line, for a case that is a pair (data, change)."""
    return jax.tree.map(lambda a, b: a + t * b, *case)


def changes(rng, data):
    """A random direction in all data; nothing where they are infinite."""
    return jax.tree.map(lambda a: np.where(np.isfinite(a), rng.normal(size=a.shape), 0.0), data)


def bounds_and_changes(rng, centre, odds=(0.15, 0.1, 0.1)):
    """Intervals that hold ``centre``: shares of equalities (they stay equal), of one-sided ones; else two-sided."""
    equal, below, above = np.cumsum(odds)
    kind = rng.random(centre.shape)
    widths = np.where(kind < equal, 0.0, rng.exponential(size=(2, *centre.shape)))
    lower = np.where((kind > equal) & (kind < below), -np.inf, centre - widths[0])
    upper = np.where((kind > below) & (kind < above), np.inf, centre + widths[1])
    d_lower, d_upper = changes(rng, (lower, upper))
    return (lower, upper), (d_lower, np.where(lower == upper, d_lower, d_upper))


def constraints(rng, rows, n=N):
    """Box and rows that a point satisfies, and a change of them: two lists (lower, upper, C, row lower, row upper)."""
    x, C = rng.normal(size=(CASES, n)), rng.normal(size=(CASES, rows, n))
    (box, d_box), (bounds, d_bounds) = (bounds_and_changes(rng, a) for a in (x, np.einsum("bij,bj->bi", C, x)))
    return (*box, C, *bounds), (*d_box, changes(rng, C), *d_bounds)


def quadratic_programs(rng, rows):
    B, S = rng.normal(size=(2, CASES, N, N))
    H, dH = B @ B.mT + 0.1 * np.eye(N), S + S.mT
    g, dg = 4.0 * rng.normal(size=(2, CASES, N))
    data, change = constraints(rng, rows)
    return (H, g, *data), (dH, dg, *change)


def least_squares(rng, rows):
    """A, b, weights over four decades, constraints, compliance of the rows, damping."""
    A, b = rng.normal(size=(CASES, 10, N)), 4.0 * rng.normal(size=(CASES, 10))
    weight, damping = 10.0 ** rng.uniform(-2, 2, (CASES, 10)), 10.0 ** rng.uniform(-4, 0, CASES)
    d_weight, d_damping = weight * rng.normal(size=weight.shape), damping * rng.normal(size=damping.shape)
    (*box, C, low, high), (*d_box, dC, d_low, d_high) = constraints(rng, rows)
    compliance = np.where(rng.random(low.shape) < 0.7, 10.0 ** rng.uniform(-2, 1, low.shape), 0.0)
    low, high = low + 2.0 * (shift := np.where(compliance > 0.0, rng.normal(size=low.shape), 0.0)), high + 2.0 * shift
    data = (A, b, weight, *box, C, low, high, compliance, damping)
    d_compliance = compliance * rng.normal(size=compliance.shape)
    return data, (*changes(rng, (A, b)), d_weight, *d_box, dC, d_low, d_high, d_compliance, d_damping)


def solve_factored(a):
    *data, compliance, damping = a
    return solve_least_squares_qp(*data, rows_compliance=compliance, damping=damping)


def hierarchies(rng, sizes, n, inequalities=0.4):
    """Levels (A, lower, upper, weight) that conflict, with weights inside them, and a box."""
    levels, d_levels = [], []
    for m in sizes:
        A, centre = rng.normal(size=(CASES, m, n)), 2.0 * rng.normal(size=(CASES, m))
        bounds, d_bounds = bounds_and_changes(rng, centre, (1.0 - inequalities, inequalities / 3, inequalities / 3))
        weight = rng.uniform(0.5, 2.0, (CASES, m))
        levels.append((A, *bounds, weight))
        d_levels.append((changes(rng, A), *d_bounds, changes(rng, weight)))
    box, d_box = bounds_and_changes(rng, rng.normal(size=(CASES, n)), (0.05, 0.1, 0.1))
    return (levels, *box), (d_levels, *d_box)


def as_levels(levels):
    return [Level(*level) for level in levels]


def qp_answer(s):
    return (s.x, s.slack, s.multipliers, s.row_multipliers), (s.status, s.active)


@pytest.mark.slow
class TestArrays:
    def test_quadratic_programs(self, rng):
        """With respect to H, g, box, rows and their bounds: minimiser, multipliers and slacks."""
        out = check(lambda a: qp_answer(solve_qp(*a)), straight, quadratic_programs(rng, rows=5))
        assert_exact(out, most=0.9)

    def test_least_squares_with_soft_rows(self, rng):
        """And with respect to A, b, weights, damping and the compliance of rows, hard and soft."""
        out = check(lambda a: qp_answer(solve_factored(a)), straight, least_squares(rng, rows=5))
        assert_exact(out, most=0.9)

    @pytest.mark.release
    @pytest.mark.parametrize("sizes, n", [((3, 4, 4), 10), ((2, 9), 6)], ids=["few-rows", "more-rows-than-variables"])
    def test_hierarchies(self, rng, sizes, n):
        """Levels of equalities and inequalities with weights, over a box: the answer and what levels lack."""

        def solve(a):
            s = solve_hqp(as_levels(a[0]), a[1], a[2])
            return (s.x, s.slacks), (s.status, s.active)

        assert_exact(check(solve, straight, hierarchies(rng, sizes, n)), most=0.9)

    @pytest.mark.release
    @pytest.mark.parametrize("method", ["damped", "undamped", "saturated"])
    def test_null_space(self, rng, method):
        """Levels, secondary motion, damping and bounds; undamped: the Moore-Penrose inverse at its rank."""
        data, change = hierarchies(rng, (3, 3, 2), 10)
        damping, secondary = 10.0 ** rng.uniform(-4, -1, CASES), rng.normal(size=(CASES, 10))
        d_damping, d_secondary = damping * rng.normal(size=CASES), rng.normal(size=(CASES, 10))
        cases = (*data, secondary, damping), (*change, d_secondary, d_damping)

        def solve(a):
            levels, lower, upper, secondary, damping = a
            options = {
                "damped": {"damping": damping},
                "undamped": {},
                "saturated": {"lower": lower, "upper": upper, "damping": damping},
            }
            s = solve_nullspace(as_levels(levels), secondary=secondary, **options[method])
            return (s.x, s.slacks, s.scales), (s.status, s.active)

        assert_exact(check(solve, straight, cases), most=0.9)


def touching(rng):
    """Square systems A x = b whose solution touches one bound of a wide box, and a change of all."""
    A, x = np.linalg.qr(rng.normal(size=(CASES, N, N)))[0], rng.normal(size=(CASES, N))
    lower, upper = x - rng.uniform(1.0, 2.0, x.shape), x + rng.uniform(1.0, 2.0, x.shape)
    lower[:, 0] = x[:, 0]
    data = A, np.einsum("bij,bj->bi", A, x), lower, upper
    return data, tuple(0.3 * a for a in changes(rng, data))


class TestSwitches:
    """Where an active set is about to change, or there is none."""

    @pytest.mark.variants(slow=["qp"], release=["hierarchy"])
    @pytest.mark.parametrize("solver", ["qp", "hierarchy"])
    def test_a_bound_exactly_touched_has_the_derivative_of_one_side(self, rng, solver):
        def solve(a):
            A, b, lower, upper = a
            if solver == "qp":
                return solve_least_squares_qp(A, b, jnp.ones(N), lower, upper, damping=1e-12).x
            return solve_hqp([Level(A, b, b)], lower, upper).x

        errors, settled = nearest_side(solve, straight, touching(rng))
        assert settled.mean() > 0.95
        errors = errors[settled]
        assert errors.min(1).max() < 1e-6
        assert (errors.max(1) > 1e-3).mean() > 0.9  # the other side has another

    @pytest.mark.slow
    @pytest.mark.variants(release=["3e-12"])
    @pytest.mark.parametrize("column", [3e-12, 9e-11, 1.2e-10, 4e-10, 1e-8])
    def test_a_column_at_the_rank_tolerance_stopped_by_its_bound(self, column):
        """The next level keeps x at that bound; the pseudo-inverse of the column alone would be 1e10."""

        def answer(column):
            levels = [Level(jnp.diag(jnp.array([1.0, column])), [5.0, 0.5]), Level([[0.0, 1.0]], [2.0])]
            return solve_hqp(levels, jnp.array([-1.0, -0.3]), jnp.array([1.0, 0.3])).x

        np.testing.assert_array_equal(answer(column), [1.0, 0.3])
        np.testing.assert_allclose(jax.jacfwd(answer)(column), 0.0, rtol=0, atol=1e-9)
