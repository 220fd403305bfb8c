"""Batched QPs of few rows, whose right guesses are answered without the Hessian: planted optima, extended precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problem_families import WHOLE_BODY, WHOLE_BODY_DAMPING, whole_body

from osik_jax.solvers import Status, solve_least_squares_qp
from osik_jax.solvers.qp import _search
from osik_jax.solvers.qp._cost import LeastSquares
from osik_jax.solvers.qp._kkt_solve import factorize, solve_on_active_set
from osik_jax.solvers.qp._problem import QP
from osik_jax.solvers.qp._row_space import has_few_rows, solve_in_row_space

COUNT = 400
N, TASKS = WHOLE_BODY


@jax.jit
@jax.vmap
def solve(A, b, weight, lower, upper, damping, center, warm_start):
    more = dict(damping=damping, center=center, warm_start=warm_start)
    return solve_least_squares_qp(A, b, weight, lower, upper, **more, backend="jax")


@pytest.fixture(scope="module")
def planted():
    """A whole-body family whose posture is in the damping and its centre, and the data in the order of ``solve``."""
    p = whole_body(np.random.default_rng(0), COUNT)
    damping, center = np.full((COUNT, N), WHOLE_BODY_DAMPING), np.zeros((COUNT, N))
    damping[:, 6:] += p.weight[:, TASKS:]
    center[:, 6:] = p.weight[:, TASKS:] * p.b[:, TASKS:] / damping[:, 6:]
    return p, (p.A[:, :TASKS], p.b[:, :TASKS], p.weight[:, :TASKS], p.lower, p.upper, damping, center)


@pytest.fixture(scope="module")
def cold(planted):
    return solve(*planted[1], np.zeros((COUNT, N), int))


def problems(data, rows=None, compliance=None):
    """The QPs inside, with equality rows to the targets ``b`` of those that ``rows`` names, no longer in the cost."""
    A, b, weight, lower, upper, damping, center = map(jnp.asarray, data)
    rows = np.zeros(TASKS, bool) if rows is None else rows
    C, c = A[:, rows], b[:, rows]
    stiff = jnp.zeros_like(c) if compliance is None else compliance
    cost = LeastSquares(A[:, ~rows], b[:, ~rows], weight[:, ~rows], damping, center)
    return QP(cost, C, stiff, jnp.concatenate([lower, c], 1), jnp.concatenate([upper, c], 1))


def test_right_guesses_need_no_search(planted, cold):
    p, data = planted
    assert has_few_rows(problems(data))
    warm = solve(*data, cold.active)
    for s, factorizations in ((cold, 2), (warm, 1)):
        assert (s.status == Status.SOLVED).all() and (s.factorizations == factorizations).all()
        np.testing.assert_allclose(s.x, p.x, atol=1e-9)
        assert ((p.lower <= s.x) & (s.x <= p.upper)).all()
    assert (warm.iterations == 0).all()
    np.testing.assert_array_equal(warm.active, cold.active)


def test_the_search_is_for_the_other_lanes(planted, monkeypatch):
    data = list(planted[1])
    data[2] = 1e-2 * data[2]
    searched = solve(*data, np.zeros((COUNT, N), int))
    wrong = np.arange(COUNT) % 5 == 2
    guess = np.where(wrong[:, None], 0, searched.active)
    monkeypatch.setattr(_search, "_search_rounds", lambda given, start, **_: start)

    def lane(A, b, weight, lower, upper, damping, center, warm_start):  # a cap of its own, so compiled anew
        more = dict(damping=damping, center=center, warm_start=warm_start, max_iterations=777, backend="jax")
        return solve_least_squares_qp(A, b, weight, lower, upper, **more)

    s = jax.jit(jax.vmap(lane))(*data, guess)
    np.testing.assert_array_equal(s.status == Status.SOLVED, ~wrong)
    np.testing.assert_allclose(s.x[~wrong], searched.x[~wrong], atol=1e-9)


def test_batch_equals_one_by_one(planted, cold):
    """One lane alone goes through the Hessian."""
    _, data = planted
    many = solve(*data, cold.active)
    for i in range(0, COUNT, 40):
        one = solve(*(a[i : i + 1] for a in (*data, cold.active)))
        np.testing.assert_allclose(one.x[0], many.x[i], rtol=0, atol=1e-12)
        assert one.factorizations[0] == 1


@jax.jit
def through_the_hessian(qp, active):
    factor = jax.vmap(lambda qp, active: factorize(qp, qp.cost.hessian(), active))(qp, active)
    return solve_on_active_set(qp, factor, active)


def extended(data, active, i):
    """The minimiser on an active set of bounds, by Cholesky in extended precision."""
    A, b, weight, lower, upper, damping, center = (np.asarray(a[i], np.longdouble) for a in data)
    free = np.asarray(active[i]) == 0
    x = np.where(free, center, np.where(np.asarray(active[i]) == 1, upper, lower))
    H = ((A.T * weight) @ A + np.diag(damping))[np.ix_(free, free)]
    right = (A.T @ (weight * (b - A @ x)))[free]
    L = np.zeros_like(H)
    for j in range(len(H)):
        L[j:, j] = H[j:, j] - L[j:, :j] @ L[j, :j]
        L[j:, j] /= np.sqrt(L[j, j])
    for j in range(len(H)):
        right[j] = (right[j] - L[j, :j] @ right[:j]) / L[j, j]
    for j in reversed(range(len(H))):
        right[j] = (right[j] - L[j + 1 :, j] @ right[j + 1 :]) / L[j, j]
    x[free] += right
    return x


@pytest.mark.parametrize("heavier", [1e-12, 1e-6, 1e-2, 1.0, 1e2, 1e4])
def test_as_exact_as_through_the_hessian_or_said_not_to_be(planted, cold, heavier):
    data = list(planted[1])
    data[2] = heavier * data[2]
    qp = problems(data)
    x, _, sound = (np.asarray(a) for a in jax.jit(solve_in_row_space)(qp, cold.active))
    beside = np.asarray(through_the_hessian(qp, cold.active)[0])
    assert sound.all() if heavier <= 1e-2 else sound.mean() < (1.0 if heavier <= 1.0 else 0.5)
    for i in range(0, COUNT, 10):
        exact = extended(data, cold.active, i)
        error, other = (float(np.abs(a[i] - exact).max() / np.abs(exact).max()) for a in (x, beside))
        assert not sound[i] or error < 2.0 * other + 2e-13  # the next correction would be 1e-13, in other units
    weighed = solve(*data, cold.active)
    alone = [solve(*(a[i : i + 1] for a in (*data, cold.active))) for i in range(0, COUNT, 40)]
    np.testing.assert_array_equal(weighed.status[::40], [int(s.status[0]) for s in alone])


@pytest.mark.parametrize("hard", [False, True])
def test_active_rows(planted, cold, hard):
    """Equality rows that give way at their weight's price cost what rows of the cost do; hard ones hold."""
    data, rows = list(planted[1]), np.arange(TASKS) < 4
    data[2] = 1e-2 * data[2]
    soft = problems(data)
    qp = problems(data, rows, None if hard else 1.0 / data[2][:, rows])
    active = jnp.concatenate([cold.active, jnp.full((COUNT, 4), 2)], 1)
    x, y, sound = (np.asarray(a) for a in jax.jit(solve_in_row_space)(qp, active))
    assert sound.all()
    missed = (data[1] - np.einsum("bmn,bn->bm", data[0], x))[:, rows]
    if hard:
        assert np.abs(missed).max() < 1e-12
        for mine, other in zip((x, y), through_the_hessian(qp, active), strict=True):
            np.testing.assert_allclose(mine, other, atol=1e-11)
    else:
        np.testing.assert_allclose(x, through_the_hessian(soft, cold.active)[0], atol=1e-11)
        np.testing.assert_allclose(y, data[2][:, rows] * missed, atol=1e-11)


def test_rows_that_depend_on_each_other_are_left_to_the_hessian(planted, cold):
    _, data = planted
    qp = problems(data, np.arange(TASKS) < 4)
    lower, upper = (jnp.concatenate([b, b[:, N : N + 1]], 1) for b in (qp.lower, qp.upper))
    rows, compliance = (jnp.concatenate([a, a[:, :1]], 1) for a in (qp.rows, qp.compliance))
    twice = QP(qp.cost, rows, compliance, lower, upper)
    active = jnp.concatenate([cold.active, jnp.full((COUNT, 5), 2)], 1)
    assert not np.asarray(jax.jit(solve_in_row_space)(twice, active)[2]).any()


@pytest.mark.parametrize("argument", range(7), ids=["A", "b", "weight", "lower", "upper", "damping", "center"])
def test_a_bad_number_harms_its_lane_alone(planted, cold, argument):
    data = [np.array(a) for a in (*planted[1], cold.active)]
    good = solve(*data)
    data[argument][3].flat[11] = np.nan
    s = solve(*data)
    assert s.status[3] == Status.NUMERICAL_ERROR and np.isfinite(s.x[3]).all()
    others = np.arange(COUNT) != 3
    for mine, before in zip(jax.tree.leaves(s), jax.tree.leaves(good), strict=True):
        np.testing.assert_array_equal(np.asarray(mine)[others], np.asarray(before)[others])
