"""The array-level QP against recorded daqp answers, quadprog, daqp and KKT conditions recomputed in NumPy."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quadprog
from recorded import QP_DAMPING, recorded_qps

from osik_jax import raise_if_failed
from osik_jax.solvers import Status, solve_least_squares_qp, solve_qp
from osik_jax.solvers.qp._cost import LeastSquares
from osik_jax.solvers.qp._problem import QP
from osik_jax.solvers.qp._solve import _with_placeholder

batched_qp = jax.jit(jax.vmap(solve_qp))
batched_rows = jax.jit(jax.vmap(lambda *a: solve_qp(*a)))
batched_least_squares = jax.jit(
    jax.vmap(lambda A, b, w, lo, hi: solve_least_squares_qp(A, b, w, lo, hi, damping=QP_DAMPING))
)


def kkt(H, g, lower, upper, x, C=None, row_lower=None, row_upper=None, y: Any = None):
    """Largest violation of the optimality conditions, recomputed: feasibility, stationarity, signs."""
    normals = np.eye(len(x)) if C is None else np.vstack([np.eye(len(x)), C])
    low = lower if row_lower is None else np.r_[lower, row_lower]
    high = upper if row_upper is None else np.r_[upper, row_upper]
    z = H @ x + g if C is None else np.concatenate([H @ x + g - C.T @ y, y])
    s = normals @ x
    stationarity = np.abs(H @ x + g - normals.T @ z).max()
    pushed_up = np.where((z > 0) & (s > low + 1e-8), z, 0.0)  # a multiplier where the lower bound is not active
    pushed_down = np.where((z < 0) & (s < high - 1e-8), -z, 0.0)
    return max(stationarity, (low - s).max(), (s - high).max(), pushed_up.max(), pushed_down.max())


@pytest.mark.variants(release=["nao"])
@pytest.mark.parametrize("robot", ["g1", "nao"])
def test_recorded_qps_in_both_forms(robot):
    p = recorded_qps(robot)
    H = np.einsum("bmi,bmj->bij", p.A, p.A) + QP_DAMPING * np.eye(p.A.shape[2])
    g = -np.einsum("bmi,bm->bi", p.A, p.b)
    answers = (
        batched_qp(H, g, p.lower, p.upper),
        batched_least_squares(p.A, p.b, np.ones_like(p.b), p.lower, p.upper),
    )
    for s in answers:
        assert (s.status == Status.SOLVED).all()
        np.testing.assert_allclose(s.x, p.solution, atol=1e-9)
        assert ((p.lower <= s.x) & (s.x <= p.upper)).all()
        x = np.asarray(s.x)
        assert max(kkt(*args) for args in zip(H, g, p.lower, p.upper, x, strict=True)) < 1e-9
        assert (np.asarray(s.iterations)[p.regime == 0] == 0).all()  # no active bound: the first guess is the answer


@pytest.mark.variants(release=["jax"])
@pytest.mark.parametrize("backend", ["auto", "jax"])
def test_a_long_batch_in_a_program_of_single_precision(backend):
    """Lanes that are left are gathered inside of the search's double precision, in both forms and on every JAX."""
    p = recorded_qps("nao")
    at_bound = np.flatnonzero(p.regime != 0)[:20]  # more than a block, and none is solved without a search
    assert len(at_bound) == 20
    A, b, lower, upper = (a[at_bound] for a in (p.A, p.b, p.lower, p.upper))

    def solve(*data):
        return solve_least_squares_qp(*data, damping=QP_DAMPING, backend=backend)

    with jax.enable_x64(False):
        s = jax.device_get(
            jax.vmap(solve)(*(jnp.asarray(a, jnp.float32) for a in (A, b, np.ones_like(b), lower, upper)))
        )
    assert s.x.dtype == np.float32 and (s.status == Status.SOLVED).all()
    off = np.abs(np.einsum("bmn,bn->bm", A, s.x - p.solution[at_bound])).max(1)
    assert (off / np.abs(b).max(1)).max() < 1e-5


def planted(rng, n, p, equalities):
    """A strictly convex QP whose solution and multipliers are drawn first."""
    B = rng.normal(size=(n, n))
    H = B @ B.T + 0.1 * np.eye(n)
    x = rng.normal(size=n)
    C = rng.normal(size=(p, n))
    z = rng.normal(size=n) * (rng.random(n) < 0.3)
    y = rng.normal(size=p) * (rng.random(p) < 0.4)
    y[:equalities] = rng.normal(size=equalities)
    lower = np.where(z > 0, x, x - rng.exponential(size=n))
    upper = np.where(z < 0, x, x + rng.exponential(size=n))
    lower[rng.random(n) < 0.2] = -np.inf
    lower = np.where(z > 0, x, lower)
    s = C @ x
    row_lower = np.where(y > 0, s, s - rng.exponential(size=p))
    row_upper = np.where(y < 0, s, s + rng.exponential(size=p))
    row_lower[:equalities] = row_upper[:equalities] = s[:equalities]
    g = -(H @ x) + z + C.T @ y
    return H, g, lower, upper, C, row_lower, row_upper, x


@pytest.mark.slow
def test_planted_solutions_with_equalities_and_two_sided_rows(rng):
    n, p = 12, 8
    problems = [planted(rng, n, p, equalities=3) for _ in range(300)]
    *data, x = (np.stack(a) for a in zip(*problems, strict=True))
    s = batched_rows(*data)
    raise_if_failed(s)
    np.testing.assert_allclose(s.x, x, atol=1e-8)
    y = np.asarray(s.row_multipliers)
    for i, (H, g, lower, upper, C, row_lower, row_upper, _) in enumerate(problems):
        assert kkt(H, g, lower, upper, np.asarray(s.x)[i], C, row_lower, row_upper, y[i]) < 1e-8


def test_random_inequalities_against_quadprog(rng):
    n, p = 12, 8
    for _ in range(40):
        H, g, lower, upper, C, _, _, _ = planted(rng, n, p, equalities=0)
        lower, upper = np.full(n, -3.0), np.full(n, 3.0)
        G = np.vstack([np.eye(n), -np.eye(n), C])
        h = np.concatenate([lower, -upper, np.full(p, -0.5)])
        expected = quadprog.solve_qp(H, -g, G.T, h)[0]
        s = solve_qp(H, g, lower, upper, C, jnp.full(p, -0.5), jnp.full(p, jnp.inf))
        assert s.status == Status.SOLVED
        np.testing.assert_allclose(s.x, expected, atol=1e-8)


def test_pinned_variables_and_duplicated_rows(rng):
    H, g, *_ = planted(rng, 6, 0, 0)
    lower = np.full(6, -np.inf)
    lower[2] = 0.7
    upper = np.where(np.arange(6) == 2, 0.7, np.inf)
    C = np.vstack([np.ones(6), np.ones(6), 2 * np.ones(6)])
    s = solve_qp(H, g, lower, upper, C, jnp.array([1.0, 1.0, 2.0]), jnp.array([1.0, 1.0, 2.0]))
    assert s.status == Status.SOLVED
    K = np.zeros((8, 8))
    K[:6, :6], K[6, :6], K[:6, 6], K[7, 2], K[2, 7] = H, 1.0, 1.0, 1.0, 1.0
    expected = np.linalg.solve(K, np.concatenate([-g, [1.0, 0.7]]))[:6]
    np.testing.assert_allclose(s.x, expected, atol=1e-9)
    assert s.x[2] == 0.7


def test_rows_that_hold_the_answer_at_nought_hold():
    """The answer is 0, so its rounding is that of the cost's pull; the second row says what the first does."""
    for rows, strength in (([[0.0, 1.0]], 1.0), ([[0.0, 1.0], [0.0, 1.0]], 1.0), ([[0.0, 1.0], [0.0, 1.0]], 1e-9)):
        zero, free = jnp.zeros(len(rows)), jnp.full(2, jnp.inf)
        solution = solve_least_squares_qp(
            *(jnp.zeros((0, 2)), zero[:0], zero[:0], -free, free),
            rows=jnp.array(rows),
            rows_lower=zero,
            rows_upper=zero,
            damping=jnp.array([strength, 1.0]),
            center=jnp.array([0.0, 1.0]),
        )
        assert solution.status == Status.SOLVED
        np.testing.assert_allclose(solution.x, 0.0, atol=1e-15)


def test_contradictions_are_infeasible_and_leave_the_box_alone(rng):
    H, g, *_ = planted(rng, 6, 0, 0)
    C = np.ones((2, 6))
    s = solve_qp(H, g, -np.ones(6), np.ones(6), C, jnp.array([1.0, 2.0]), jnp.array([1.0, 2.0]))
    assert s.status == Status.INFEASIBLE
    assert np.isfinite(s.x).all() and (np.abs(s.x) <= 1.0).all()
    with pytest.raises(RuntimeError, match="INFEASIBLE in 1 of 1 lanes"):
        raise_if_failed(s)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bad_lane_leaves_its_neighbours_alone(bad):
    p = recorded_qps("nao")
    A, b = p.A[:64:9].copy(), p.b[:64:9]
    args = (b, np.ones_like(b), p.lower[:64:9], p.upper[:64:9])
    good = batched_least_squares(A, *args)
    A[3, 5, 2] = bad
    s = batched_least_squares(A, *args)
    assert s.status[3] == Status.NUMERICAL_ERROR
    assert np.isfinite(s.x[3]).all() and ((args[2][3] <= s.x[3]) & (s.x[3] <= args[3][3])).all()
    others = np.arange(len(A)) != 3
    np.testing.assert_array_equal(np.asarray(s.x)[others], np.asarray(good.x)[others])
    with pytest.raises(RuntimeError, match=r"NUMERICAL_ERROR in 1 of 8 lanes \(\(3,\)\)"):
        raise_if_failed(s)


def test_derivatives_are_those_of_the_solution_map(rng):
    H, g, lower, upper, C, row_lower, row_upper, _ = planted(rng, 8, 4, equalities=2)
    a = (H, g, lower, upper, C, row_lower, row_upper)
    weights = rng.normal(size=8)
    loss = jax.jit(lambda args: jnp.dot(weights, jnp.sin(solve_qp(*args).x)))
    reverse = jax.jit(jax.grad(loss))(a)
    for k in range(len(a)):
        direction = rng.normal(size=a[k].shape)
        if k == 0:
            direction = direction + direction.T
        if k in (3, 6):  # keep equalities equal: move both bounds together
            continue
        tangents = [np.zeros_like(x) for x in a]
        tangents[k] = np.where(np.isfinite(a[k]), direction, 0.0)
        if k == 5:
            tangents[6] = np.where(row_lower == row_upper, tangents[5], 0.0)
        moved = [tuple(x + sign * 1e-6 * t for x, t in zip(a, tangents, strict=True)) for sign in (1, -1)]
        expected = (loss(moved[0]) - loss(moved[1])) / 2e-6
        forward = jax.jvp(loss, (a,), (tuple(tangents),))[1]
        backward = sum(np.vdot(r, t) for r, t in zip(reverse, tangents, strict=True))
        np.testing.assert_allclose(forward, expected, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(backward, forward, rtol=1e-9, atol=1e-12)


def test_shapes_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match="rows_lower and rows_upper"):
        solve_qp(jnp.eye(2), jnp.zeros(2), -jnp.ones(2), jnp.ones(2), jnp.ones((1, 2)))
    with pytest.raises(ValueError, match=r"hessian has shape \(2, 2\)"):
        solve_qp(jnp.eye(2), jnp.zeros(3), -jnp.ones(3), jnp.ones(3))
    with pytest.raises(ValueError, match="bounds do not fit"):
        solve_qp(jnp.eye(2), jnp.zeros(2), -jnp.ones(3), jnp.ones(2))


@pytest.mark.release
def test_damping_towards_a_centre(rng):
    """The centre's pull written as rows of the matrix, one for each variable: the same answer and derivatives."""
    lanes, m, n = 20, 4, 9
    A, b, weight = rng.normal(size=(lanes, m, n)), rng.normal(size=(lanes, m)), rng.uniform(0.1, 2.0, (lanes, m))
    strength, center = rng.uniform(0.1, 2.0, (lanes, n)), rng.normal(size=(lanes, n))
    lower, upper = -rng.uniform(0.1, 1.0, (lanes, n)), rng.uniform(0.1, 1.0, (lanes, n))

    def pulled(strength, center, A, b, weight, lower, upper):
        return solve_least_squares_qp(A, b, weight, lower, upper, damping=strength, center=center).x

    def rows(strength, center, A, b, weight, lower, upper):
        taller = jnp.concatenate([A, jnp.eye(n)]), jnp.concatenate([b, center]), jnp.concatenate([weight, strength])
        return solve_least_squares_qp(*taller, lower, upper, damping=1e-14).x

    data = strength, center, A, b, weight, lower, upper

    def with_derivatives(f):
        """One program for both."""

        def twice(*data):
            x = f(*data)
            return x, x

        return jax.jit(jax.vmap(jax.jacrev(twice, argnums=(0, 1, 3), has_aux=True)))(*data)

    (ours, x), (expected, x_of_rows) = map(with_derivatives, (pulled, rows))
    assert 0.2 < np.mean((x_of_rows > lower) & (x_of_rows < upper)) < 0.8
    np.testing.assert_allclose(x, x_of_rows, rtol=0, atol=1e-10)
    for own, other in zip(ours, expected, strict=True):
        np.testing.assert_allclose(own, other, rtol=0, atol=1e-8)


BAD_NUMBERS = [
    *[("matrix", value, False) for value in (np.nan, np.inf, -np.inf)],
    *[("weight", value, False) for value in (np.nan, np.inf, -1e-300)],
    *[("weight", 0.0, True), ("damping", -1.0, False), ("center", np.inf, False), ("target", np.nan, False)],
    *[("rows", np.nan, False), ("compliance", np.inf, False), ("compliance", -1.0, True)],
    *[("lower", np.nan, False), ("lower", np.inf, False), ("lower", -np.inf, True)],
    *[("upper", -np.inf, False), ("upper", np.inf, True), ("matrix", 1e300, True)],
]


@pytest.mark.parametrize("name, value, fine", BAD_NUMBERS)
def test_numbers_are_looked_at_alike_together_and_apart(monkeypatch, name, value, fine):
    """As one array, as on CPUs, and each by itself: what cannot be computed with, and what stands in its place."""
    rng = np.random.default_rng(0)
    cost = LeastSquares(*(jnp.asarray(a) for a in (rng.normal(size=(3, 4)), *rng.random((2, 3)), *rng.random((2, 4)))))
    low = jnp.array([-jnp.inf, -1.0, 0.0, -2.0, -jnp.inf, 0.5])
    high = jnp.array([jnp.inf, 1.0, 0.0, jnp.inf, 2.0, 0.5])
    qp = QP(cost, jnp.ones((2, 4)), jnp.ones(2), low, high, known_equalities=(False,) * 5 + (True,))
    if hasattr(cost, name):
        qp = replace(qp, cost=replace(cost, **{name: getattr(cost, name).at[0].set(value)}))
    else:
        qp = replace(qp, **{name: getattr(qp, name).at[0].set(value)})
    together, is_valid = _with_placeholder(qp)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    apart, is_valid_apart = _with_placeholder(qp)
    assert bool(is_valid) == bool(is_valid_apart) == fine
    np.testing.assert_array_equal(together.packed, np.concatenate([np.ravel(a) for a in jax.tree.leaves(apart)[1:]]))
    jax.tree.map(np.testing.assert_array_equal, replace(together, packed=None), apart)
    assert apart.packed is None
    if fine:
        jax.tree.map(np.testing.assert_array_equal, apart, qp)
    assert all(np.isfinite(a).all() for a in (*jax.tree.leaves(apart.cost), apart.rows, apart.compliance))
