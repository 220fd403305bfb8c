"""The GPU's text of the weighted QP, on a CPU: answers, certificates, and what bad numbers in one problem do to others.

Shared memory holds NaN before each problem.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import one_warp
import pytest
from core_checks import needs_core
from problem_families import WHOLE_BODY_DAMPING, whole_body
from recorded import QP_DAMPING, recorded_qps
from weighted_families import soft_problems

from osik_jax.core import _cuda as core_cuda
from osik_jax.numerics._constants import INACTIVE, SINGLE_DAMPING
from osik_jax.solvers import Status, solve_least_squares_qp
from osik_jax.solvers.qp._core import CERTIFIED, solve_on_gpu
from osik_jax.solvers.qp._problem import QP, LeastSquares

pytestmark = needs_core
TOLERANCE = {np.float32: 1e-7, np.float64: 1e-12}


@pytest.fixture
def solved(tmp_path, monkeypatch):
    """Return the function that solves a batch with the GPU's text."""
    monkeypatch.setattr(core_cuda, "call", partial(one_warp.call_of_warps, tmp_path))

    def solve(given, kind, guess=None):
        *cost, rows, compliance, lower, upper = (jnp.asarray(a, kind) for a in given)
        qp = QP(LeastSquares(*cost), rows, compliance, lower, upper)
        guess = jnp.zeros(lower.shape, jnp.int32) if guess is None else jnp.asarray(guess)
        found = solve_on_gpu(qp, guess, jnp.full(len(lower), TOLERANCE[kind], kind), 1000)
        return jax.tree.map(np.asarray, found)

    return solve


def answers(A, b, weight, lower, upper, rows, low, high, compliance, damping, center):
    def solve(A, b, weight, lower, upper, rows, low, high, compliance, damping, center):
        options = dict(rows_compliance=compliance, damping=damping, center=center, backend="jax")
        return solve_least_squares_qp(A, b, weight, lower, upper, rows, low, high, **options)

    return jax.jit(jax.vmap(solve))(A, b, weight, lower, upper, rows, low, high, compliance, damping, center)


SHAPES = {
    "-".join(map(str, s)): s for s in [(3, 0, 2), (12, 20, 5), (33, 40, 3), (48, 30, 32), (64, 50, 4), (70, 9, 1)]
}


@pytest.mark.variants(ordinary=["12-20-5-float32"], slow=["33-40-3-float64", "70-9-1-float32"])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_the_answers_are_those_of_the_search(shape, kind, solved, rng):
    data = soft_problems(rng, 4, *shape)
    A, b, weight, lower, upper, rows, low, high, compliance, damping, center = data
    bounds = np.concatenate([lower, low], 1), np.concatenate([upper, high], 1)
    given = A, b, weight, damping, center, rows, compliance, *bounds
    found = solved(given, kind)
    expected = answers(*data)
    assert (found.converged == CERTIFIED).all()
    near = 3e-6 if kind == np.float32 else 1e-10
    np.testing.assert_allclose(found.x, expected.x, rtol=0, atol=near)
    np.testing.assert_allclose(found.row_multipliers, expected.row_multipliers, rtol=0, atol=10 * near)
    np.testing.assert_array_equal(found.active, expected.active)
    again = solved(given, kind, found.active)
    assert (again.iterations == 0).all() and (again.factorizations == 1).all() and (again.converged == CERTIFIED).all()


def in_box(p, weight, damping):
    none = np.zeros((*p.lower.shape[:1], 0, p.lower.shape[1]))
    damping = np.full(p.lower.shape, damping)
    return p.A, p.b, weight, damping, 0 * damping, none, none[..., 0], p.lower, p.upper


def off(given, x, expected):
    """Rows of the cost, as a share of the largest that is asked for."""
    A, b, root = given[0], given[1], np.sqrt(given[2])
    rows = root * np.einsum("bmn,bn->bm", A, np.asarray(x, float) - expected)
    return np.abs(rows).max(1) / np.abs(root * b).max(1)


@pytest.mark.release
def test_a_hard_family_in_single_precision(solved, rng):
    """Weights of six decades, factors that lose most digits, so that corrections are slow and a bound pulls little."""
    p = whole_body(rng, 200)
    given = in_box(p, p.weight, WHOLE_BODY_DAMPING)
    found = solved(given, np.float32)
    none, free = np.zeros((200, 0, p.A.shape[2])), np.zeros((200, 0))
    expected = answers(*p[:5], none, free, free, free, given[3], given[4]).x
    certified = found.converged == CERTIFIED
    assert certified.mean() > 0.98
    assert off(given, found.x, expected)[certified].max() < 5e-5


@pytest.mark.variants(slow=["nao"], release=["g1"])
@pytest.mark.parametrize("robot", ["g1", "nao"])
def test_recorded_problems_in_single_precision(robot, solved):
    """All, from nothing and from the active set of the answer: that with one factorisation."""
    p = recorded_qps(robot)
    given = in_box(p, np.ones(p.b.shape), QP_DAMPING)
    answer = np.where(p.solution <= p.lower + 1e-12, -1, np.where(p.solution >= p.upper - 1e-12, 1, 0))
    for guess in (np.zeros(answer.shape, int), answer):
        found = solved(given, np.float32, guess)
        assert (found.converged == CERTIFIED).all()
        assert off(given, found.x, p.solution).max() < 1e-5
    np.testing.assert_array_equal(found.active, answer)
    assert (found.iterations == 0).all() and (found.factorizations == 1).all()


@pytest.mark.release
@pytest.mark.parametrize("robot", ["g1", "nao"])
def test_weights_far_apart_stay_in_the_kernel(robot, solved, rng):
    """Recorded tasks with weights from 1e-4 to 1e5, three rows each, and speed limits that stop some joints."""
    p = recorded_qps(robot)
    count, n = p.lower.shape
    m = p.A.shape[1] - (n - 6)
    A, b = p.A[:, :m], p.b[:, :m]
    weight = np.repeat(10.0 ** rng.uniform(-4, 5, (count, -(-m // 3))), 3, axis=1)[:, :m]
    damping = np.full((count, n), QP_DAMPING)
    damping[:, 6:] = 10.0 ** rng.uniform(-4, 5, (count, 1))
    damping = np.maximum(damping, least_damping(A, weight))
    center = np.pad(p.b[:, m:] / 0.05, ((0, 0), (6, 0)))
    bound = np.pad(10.0 ** rng.uniform(-2, 1, (count, n - 6)), ((0, 0), (6, 0)), constant_values=np.inf)
    none, free = np.zeros((count, 0, n)), np.zeros((count, 0))
    given = A, b, weight, damping, center, none, free, -bound, bound
    found = solved(given, np.float32)
    expected = answers(A, b, weight, -bound, bound, none, free, free, free, damping, center)
    assert (expected.status == Status.SOLVED).all() and (np.asarray(expected.active) != INACTIVE).any(1).mean() > 0.5
    assert (found.converged == CERTIFIED).mean() >= 0.99
    certified = found.converged == CERTIFIED
    costs = [
        cost_of(given, x)[certified] for x in (found.x.astype(float), np.asarray(expected.x), np.zeros((count, n)))
    ]
    # not the answers: a bound whose multiplier is rounding in single precision may be active in one of them alone
    assert np.abs((costs[0] - costs[1]) / costs[2]).max() < 1e-6


def cost_of(given, x):
    """The cost of a batch of answers, in double precision."""
    A, b, weight, damping, center = given[:5]
    missed = np.einsum("bmn,bn->bm", A, x) - b
    return (weight * missed**2).sum(1) + (damping * (x - center) ** 2).sum(1)


def least_damping(A, weight):
    """The least damping that a WeightedQP leaves to a kernel in single precision."""
    largest = (weight * (A**2).sum(2)).max(1, keepdims=True)
    return SINGLE_DAMPING * np.finfo(np.float32).eps * largest


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_an_answer_that_is_roundoff_is_certified(kind, solved, rng):
    """Residuals that balance each other, as those of a robot at rest do."""
    A, weight = rng.normal(size=(20, 9, 6)), 10.0 ** rng.uniform(-3, 2, (20, 9))
    pulls = np.linalg.svd((weight[..., None] * A).transpose(0, 2, 1))[2][:, -1]  # A' W pulls = 0
    limit = np.tile([np.inf, np.inf, np.inf, 0.5, 0.5, 0.5], (20, 1))
    zero, rows, none = np.zeros((20, 6)), np.zeros((20, 0, 6)), np.zeros((20, 0))
    given = A, pulls, weight, zero + 1e-9, zero, rows, none, -limit, limit
    found = solved(given, kind)
    assert (found.converged == CERTIFIED).all() and np.abs(found.x).max() < 1e6 * np.finfo(kind).eps


def test_a_bad_problem_is_not_certified_and_disturbs_no_other(solved, rng):
    p = whole_body(rng, 12)
    given = in_box(p, p.weight, WHOLE_BODY_DAMPING)
    good = solved(given, np.float32)
    A, b, weight, damping, center, rows, compliance, lower, upper = (a.copy() for a in given)
    A[0, 2, 1], b[1, 2], weight[2, 1], damping[3, 0], A[4, 0, 0] = np.nan, np.nan, -1.0, np.nan, np.inf
    bad = solved((A, b, weight, damping, center, rows, compliance, lower, upper), np.float32)
    assert (bad.converged[:5] != CERTIFIED).all()
    for one, other in zip(good, bad, strict=True):
        np.testing.assert_array_equal(one[5:], other[5:])
