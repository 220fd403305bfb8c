"""Hundreds of hard QPs a family: known optimum, optimality recomputed in NumPy, daqp, quadprog and SciPy beside it."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from optimality import by_daqp, by_quadprog, kkt_residual, least_violation, least_violation_residual
from problem_families import (
    PLANTED,
    WHOLE_BODY_DAMPING,
    QPs,
    boxes,
    inconsistent_equalities,
    inconsistent_rows,
    mixed,
    nearly_dependent_rows,
    opposite_rows,
    redundant,
    whole_body,
)
from scipy.optimize import lsq_linear

from osik_jax import raise_if_failed
from osik_jax.solvers import Status, solve_least_squares_qp, solve_qp

COUNT = 1000
# with XLA's optimiser, for this runs longer than that takes
batched_qp = jax.jit(jax.vmap(solve_qp), compiler_options={"xla_backend_optimization_level": 2})
batched_least_squares = jax.jit(
    jax.vmap(lambda A, b, w, lo, hi: solve_least_squares_qp(A, b, w, lo, hi, damping=WHOLE_BODY_DAMPING))
)
SOLUTION_ERROR = {"nearly_singular": 1e-4}
"""Where H has condition 1e10, rounding the data in their last digit moves the solution by up to 1e-5."""
SOLVED_SHARE = {"nearly_singular": 0.995}
"""There the search starts 1e10 away and may end without an answer, but never claims a wrong one."""


def solved(p: QPs):
    s = batched_qp(*p.data)
    x = np.asarray(s.x)
    assert np.isfinite(x).all()
    assert ((p.lower <= x) & (x <= p.upper)).all()
    return s, x


@pytest.mark.variants(slow=["mixed-2"], release=["mixed-1"])
@pytest.mark.parametrize("seed", [1, 2, *(pytest.param(k, marks=pytest.mark.release) for k in (0, *range(3, 8)))])
@pytest.mark.parametrize("family", PLANTED)
def test_planted_solutions(family, seed):
    p = PLANTED[family](np.random.default_rng(seed), COUNT)
    s, x = solved(p)
    y = np.asarray(s.row_multipliers)
    claimed = np.asarray(s.status) == Status.SOLVED
    assert claimed.mean() >= SOLVED_SHARE.get(family, 1.0)
    assert np.abs((x - p.x) / p.unit)[claimed].max() < SOLUTION_ERROR.get(family, 1e-9)
    assert kkt_residual(p, x, y)[claimed].max() < 1e-9
    z = np.einsum("bij,bj->bi", p.H, x) + p.g - np.einsum("bpn,bp->bn", p.C, y)
    size = np.einsum("bij,bj->bi", np.abs(p.H), np.abs(x)) + np.abs(p.g) + np.abs(z)
    assert (np.abs(z - s.multipliers) / size)[claimed].max() < 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_nearly_dependent_rows_are_solved_or_said_not_to_be(seed):
    p = nearly_dependent_rows(np.random.default_rng(seed), COUNT)
    s, x = solved(p)
    claimed = np.asarray(s.status) == Status.SOLVED
    assert claimed.mean() > 0.9  # daqp: three quarters
    assert kkt_residual(p, x, np.asarray(s.row_multipliers))[claimed].max() < 1e-7


@pytest.mark.parametrize("family", [f for f in PLANTED if "scaled" not in f and f != "nearly_singular"])
def test_daqp_and_quadprog_agree(family, rng):
    p = PLANTED[family](rng, COUNT)
    _, x = solved(p)
    claims = 0
    for i in range(0, COUNT, 20):
        for expected in (by_daqp(p, i), by_quadprog(p, i)):
            if expected is not None:
                claims += 1
                np.testing.assert_allclose(x[i], expected, atol=1e-7)
    assert claims >= 40


@pytest.mark.parametrize("family", [inconsistent_equalities, inconsistent_rows, opposite_rows])
def test_contradictions_get_the_least_violating_answer(family, rng):
    """|distance of C x to its intervals| first, to nine digits; then the cost among all x as near as that, to five."""
    p = family(rng, COUNT)
    s, x = solved(p)
    assert (np.asarray(s.status) == Status.INFEASIBLE).all()
    with pytest.raises(RuntimeError, match=f"INFEASIBLE in {COUNT} of {COUNT} lanes"):
        raise_if_failed(s)
    values = np.einsum("bpn,bn->bp", p.C, x)
    distance = np.linalg.norm(values - np.clip(values, p.row_lower, p.row_upper), axis=1)
    for i in range(0, COUNT, 20):
        np.testing.assert_allclose(distance[i], least_violation(p, i), rtol=1e-9, atol=1e-8)
    assert max(least_violation_residual(p, i, x[i]) for i in range(COUNT)) < 1e-5


@pytest.mark.release
@pytest.mark.parametrize("family", [inconsistent_equalities, inconsistent_rows])
def test_rates_of_the_least_violating_answer_by_differences(family, rng):
    """``INFEASIBLE_COMPLIANCE``: ten times as much moves these rates by 3e-5, a tenth loses as much to rounding."""
    p = family(rng, 120)
    along = rng.normal(size=p.row_lower.shape), np.abs(p.g).max(1, keepdims=True) * rng.normal(size=p.g.shape)

    def moved(s):
        by, cost = along
        data = p._replace(g=p.g + s * cost, row_lower=p.row_lower + s * by, row_upper=p.row_upper + s * by).data
        return jax.vmap(solve_qp)(*data).x

    solve, step = jax.jit(moved), 3e-6
    near, far = ((np.asarray(solve(h)) - np.asarray(solve(-h))) / (2.0 * h) for h in (step, 3.0 * step))
    size = np.maximum(np.abs(near).max(1), 1e-3)  # where nearly all variables are at bounds, little moves
    smooth = np.abs(near - far).max(1) < 1e-6 * size  # no bound becomes active within the step
    assert smooth.sum() > 80

    _, rate = jax.jit(lambda s: jax.jvp(moved, (s,), (jnp.ones_like(s),)))(jnp.zeros(()))
    assert (np.abs(np.asarray(rate) - near).max(1) / size)[smooth].max() < 1e-5 and np.isfinite(rate).all()


def least_squares_residual(p, x):
    """Slope of the cost against the box, as a share of the terms that the slope is made of."""
    residual = np.einsum("bmn,bn->bm", p.A, x) - p.b
    slope = np.einsum("bmn,bm->bn", p.A, p.weight * residual) + WHOLE_BODY_DAMPING * x
    terms = np.abs(p.b) + np.einsum("bmn,bn->bm", np.abs(p.A), np.abs(x))
    size = np.einsum("bmn,bm->bn", np.abs(p.A), p.weight * terms) + WHOLE_BODY_DAMPING * np.abs(x)
    share = slope / np.where(size > 0.0, size, 1.0)
    gaps = np.minimum(share, x - p.lower), np.minimum(-share, p.upper - x)
    return np.maximum(*gaps).max(1)


def by_bounded_least_squares(p, i):
    root = np.sqrt(p.weight[i])
    n = p.A.shape[2]
    A = np.vstack([root[:, None] * p.A[i], np.sqrt(WHOLE_BODY_DAMPING) * np.eye(n)])
    b = np.concatenate([root * p.b[i], np.zeros(n)])
    free = p.lower[i] < p.upper[i]
    x = p.lower[i].copy()
    box = (p.lower[i][free], p.upper[i][free])
    x[free] = lsq_linear(A[:, free], b - A[:, ~free] @ x[~free], box, method="bvls", tol=1e-15, max_iter=1000).x
    return x


@pytest.mark.variants(release=["whole_body"])
@pytest.mark.parametrize("family", [whole_body, redundant])
def test_whole_body_least_squares(family, rng):
    p = family(rng, COUNT)
    s = batched_least_squares(p.A, p.b, p.weight, p.lower, p.upper)
    x = np.asarray(s.x)
    assert (np.asarray(s.status) == Status.SOLVED).all()
    assert ((p.lower <= x) & (x <= p.upper)).all()
    assert least_squares_residual(p, x).max() < 1e-14
    if family is whole_body:
        np.testing.assert_allclose(x, p.x, atol=1e-9)
    for i in range(0, COUNT, 20):
        np.testing.assert_allclose(x[i], by_bounded_least_squares(p, i), atol=1e-9)


@partial(jax.jit, static_argnames="backend")
def from_random_labels(p, rows, low, high, warm_start, *, backend):
    """Weak damping beside heavy tasks: the weakest curvature is 1e-12 of the strongest."""

    def one(A, b, w, lower, upper, *rest):
        *rows, warm_start = rest
        options = dict(damping=WHOLE_BODY_DAMPING, warm_start=warm_start, backend=backend)
        return solve_least_squares_qp(A, b, w, lower, upper, *rows, **options)

    return jax.vmap(one)(*p, rows, low, high, warm_start)


def wrong_multipliers(p, rows, s):
    """Largest multiplier of the wrong sign, in units of the gradient's terms that it is part of, and these terms."""
    x, y, active = (np.asarray(a) for a in (s.x, s.row_multipliers, s.active))
    slope = np.einsum("bmn,bm->bn", p.A, p.weight * (np.einsum("bmn,bn->bm", p.A, x) - p.b)) + WHOLE_BODY_DAMPING * x
    terms = np.abs(p.b) + np.einsum("bmn,bn->bm", np.abs(p.A), np.abs(x))
    terms = np.einsum("bmn,bm->bn", np.abs(p.A), p.weight * terms) + WHOLE_BODY_DAMPING * np.abs(x)
    terms += np.einsum("bpn,bp->bn", np.abs(rows), np.abs(y)) + np.finfo(float).tiny
    multiplier = (slope - np.einsum("bpn,bp->bn", rows, y)) / terms
    of_rows = y * np.max(np.abs(rows) / terms[:, None], 2)
    signed = active * np.concatenate([multiplier, of_rows], 1)  # -1 at a lower bound, where it is positive
    return np.max(np.where(np.abs(active) == 1, signed, 0.0), 1), terms.max(1, keepdims=True)


@pytest.mark.variants(
    slow=["core-1e10"], release=["jax-1e10", "jax-inf", "jax-1e3", "jax-1e12", "core-inf", "core-1e3", "core-1e12"]
)
@pytest.mark.parametrize("far", ["inf", "1e3", "1e10", "1e12"])
@pytest.mark.parametrize("backend", ["jax", "core"])
def test_a_random_warm_start_does_not_change_the_answer(backend, far, rng):
    """Bounds that are far away are in many of the working sets that are tried first."""
    count, rows_count = 200, 6
    p = redundant(rng, count)
    n, far = p.A.shape[2], float(far)
    p = p._replace(lower=np.maximum(p.lower, -far), upper=np.minimum(p.upper, far))
    inside = np.asarray(batched_least_squares(*p[:5]).x)
    rows = rng.normal(size=(count, rows_count, n)) * (rng.random((count, rows_count, n)) < 0.4)
    low = np.einsum("bpn,bn->bp", rows, inside) - rng.uniform(-0.02, 0.3, (count, rows_count))
    high = np.where(rng.random(low.shape) < 0.5, far, low + rng.uniform(0.1, 0.5, low.shape))
    for bounds in ((low, high), (np.full_like(low, -far), np.full_like(low, far))):
        given = p[:5], rows, *bounds
        labels = rng.integers(-1, 2, (2, count, n + rows_count))
        cold, *warm = (from_random_labels(*given, w, backend=backend) for w in (0 * labels[0], *labels))
        values = np.einsum("bpn,bn->bp", rows, np.asarray(cold.x))
        for s in (cold, *warm):
            assert (np.asarray(s.status) == Status.SOLVED).all()
            wrong, terms = wrong_multipliers(p, rows, s)
            assert wrong.max() < 1e-15
            # what the rounding of the gradient leaves open, at the curvature of the damping
            off = np.abs(np.asarray(s.x) - cold.x) * WHOLE_BODY_DAMPING / terms
            assert off.max() < 1e-15
        assert (np.maximum(bounds[0] - values, values - bounds[1]) < 1e-9).all()
    for i in range(0, count, 40):  # rows that no bound is near to
        np.testing.assert_allclose(cold.x[i], by_bounded_least_squares(p, i), atol=1e-8)


def spoiled(p: QPs, argument: int, bad: float) -> QPs:
    """One number of the argument replaced in lane 3 and one in lane 8."""
    data = [a.copy() for a in p.data]
    for lane in (3, 8):
        entry = np.unravel_index((7 * lane) % data[argument][lane].size, data[argument][lane].shape)
        data[argument][(lane, *entry)] = bad
    return QPs(*data, x=p.x, unit=p.unit)


@pytest.fixture(scope="module")
def healthy():
    p = mixed(np.random.default_rng(5), COUNT)
    return p, batched_qp(*p.data)


LEGAL = {("lower", -np.inf), ("row_lower", -np.inf), ("upper", np.inf), ("row_upper", np.inf)}
BAD = [(name, bad) for name in QPs._fields[:7] for bad in (np.nan, np.inf, -np.inf) if (name, bad) not in LEGAL]


@pytest.mark.parametrize(("name", "bad"), BAD)
def test_a_bad_number_harms_its_lane_alone(name, bad, healthy):
    p, good = healthy
    q = spoiled(p, QPs._fields.index(name), bad)
    s = batched_qp(*q.data)
    status = np.asarray(s.status)[[3, 8]]
    if np.isinf(bad) and name.endswith(("lower", "upper")):
        assert np.isin(status, (Status.INFEASIBLE, Status.NUMERICAL_ERROR)).all()
    else:
        assert (status == Status.NUMERICAL_ERROR).all()
    others = np.setdiff1d(np.arange(COUNT), [3, 8])
    for mine, before in zip(jax.tree.leaves(s), jax.tree.leaves(good), strict=True):
        np.testing.assert_array_equal(np.asarray(mine)[others], np.asarray(before)[others])
    x = np.asarray(s.x)[[3, 8]]
    assert np.isfinite(x).all()
    assert np.isfinite(s.multipliers).all() and np.isfinite(s.row_multipliers).all()
    low, high = q.lower[[3, 8]], q.upper[[3, 8]]
    possible = ~(low > high) & ~(low == np.inf) & ~(high == -np.inf)
    assert (~(x < low) & ~(x > high))[possible].all()  # nothing to say of a NaN bound


@pytest.mark.parametrize(
    ("argument", "bad"),
    [*((k, np.nan) for k in range(5)), (0, np.inf)],
    ids=["A", "b", "weight", "lower", "upper", "inf"],
)
def test_a_bad_number_in_factored_form(argument, bad):
    p = whole_body(np.random.default_rng(6), COUNT)
    good = batched_least_squares(*p[:5])
    data = [a.copy() for a in p[:5]]
    data[argument][3].flat[11] = bad
    s = batched_least_squares(*data)
    assert s.status[3] == Status.NUMERICAL_ERROR
    x = np.asarray(s.x)
    assert np.isfinite(x[3]).all()
    assert (~(x[3] < data[3][3]) & ~(x[3] > data[4][3])).all()
    others = np.arange(COUNT) != 3
    for mine, before in zip(jax.tree.leaves(s), jax.tree.leaves(good), strict=True):
        np.testing.assert_array_equal(np.asarray(mine)[others], np.asarray(before)[others])


def test_unordered_bounds_are_infeasible_and_finite():
    p = boxes(np.random.default_rng(7), COUNT)
    lower, upper = p.lower.copy(), p.upper.copy()
    lower[::2, 4], upper[::2, 4] = 1.0, -1.0
    s = batched_qp(p.H, p.g, lower, upper, *p.data[4:])
    status = np.asarray(s.status)
    assert (status[::2] == Status.INFEASIBLE).all() and (status[1::2] == Status.SOLVED).all()
    assert np.isfinite(s.x).all()
    np.testing.assert_allclose(np.asarray(s.x)[1::2], p.x[1::2], atol=1e-9)
