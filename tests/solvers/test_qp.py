"""The array-level QP against recorded daqp answers, quadprog, daqp and KKT conditions recomputed in NumPy."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from recorded import QP_DAMPING, recorded_qps
from refusals import refuses

from osik_jax.solvers import Level, Status, solve_least_squares_qp, solve_qp
from osik_jax.solvers.qp._problem import QP, LeastSquares
from osik_jax.solvers.qp._solve import _with_placeholder

batched_qp = jax.jit(jax.vmap(solve_qp))
batched_least_squares = jax.jit(
    jax.vmap(lambda A, b, w, lo, hi: solve_least_squares_qp(A, b, w, lo, hi, damping=QP_DAMPING))
)


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
        assert (np.asarray(s.iterations)[p.regime == 0] == 0).all()  # no active bound: the first guess is the answer


@pytest.mark.slow
def test_a_long_batch_in_a_program_of_single_precision():
    """Lanes that are left are gathered inside of the search's double precision, on every JAX."""
    p = recorded_qps("nao")
    at_bound = np.flatnonzero(p.regime != 0)[:20]  # more than a block, and none is solved without a search
    assert len(at_bound) == 20
    A, b, lower, upper = (a[at_bound] for a in (p.A, p.b, p.lower, p.upper))

    def solve(*data):
        return solve_least_squares_qp(*data, damping=QP_DAMPING, backend="jax")

    with jax.enable_x64(False):
        s = jax.device_get(
            jax.vmap(solve)(*(jnp.asarray(a, jnp.float32) for a in (A, b, np.ones_like(b), lower, upper)))
        )
    assert s.x.dtype == np.float32 and (s.status == Status.SOLVED).all()
    off = np.abs(np.einsum("bmn,bn->bm", A, s.x - p.solution[at_bound])).max(1)
    assert (off / np.abs(b).max(1)).max() < 1e-5


@pytest.mark.slow
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
def test_numbers_that_cannot_be_computed_with_get_a_placeholder(name, value, fine):
    rng = np.random.default_rng(0)
    cost = LeastSquares(*(jnp.asarray(a) for a in (rng.normal(size=(3, 4)), *rng.random((2, 3)), *rng.random((2, 4)))))
    low = jnp.array([-jnp.inf, -1.0, 0.0, -2.0, -jnp.inf, 0.5])
    high = jnp.array([jnp.inf, 1.0, 0.0, jnp.inf, 2.0, 0.5])
    qp = QP(cost, jnp.ones((2, 4)), jnp.ones(2), low, high, known_equalities=(False,) * 5 + (True,))
    if hasattr(cost, name):
        qp = replace(qp, cost=replace(cost, **{name: getattr(cost, name).at[0].set(value)}))
    else:
        qp = replace(qp, **{name: getattr(qp, name).at[0].set(value)})
    safe, is_valid = _with_placeholder(qp)
    assert bool(is_valid) == fine
    if fine:
        jax.tree.map(np.testing.assert_array_equal, safe, qp)
    assert all(np.isfinite(a).all() for a in (*jax.tree.leaves(safe.cost), safe.rows, safe.compliance))


@pytest.mark.slow
def test_integers_are_floats():
    box = np.array([-1.0, -1.0]), np.array([1.0, 0.25])
    direct = solve_qp(np.eye(2, dtype=int), np.array([-1, -1]), *box)
    ones = np.ones(2, int)
    squares = solve_least_squares_qp(np.eye(2, dtype=int), ones, ones, *box)
    for solution in (direct, squares):
        np.testing.assert_allclose(solution.x, [1.0, 0.25], atol=1e-8)


def test_integers_beside_floats_have_their_precision_and_complex_numbers_are_refused():
    single, whole = np.array([-1.0, -1.0], np.float32), np.eye(2, dtype=int)
    assert jax.eval_shape(solve_qp, whole, single, single, -single).x.dtype == np.float32
    assert jax.eval_shape(solve_least_squares_qp, whole, single, -single, single, -single).x.dtype == np.float32
    assert Level([[1, 1]], single[:1]).matrix.dtype == np.float32
    refuses(TypeError, "numbers are real; got an array of complex", Level, np.array([[1j, 1.0]]), [0.5])
