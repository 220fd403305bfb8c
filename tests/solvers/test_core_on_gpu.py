"""The core on a GPU, where there is one, against float64 answers and the XLA route.

Recorded and random QPs, and saturation in the null space.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from null_space_families import FAMILIES, check_derivatives_of_saturation, classical, saturated
from problem_families import WHOLE_BODY_DAMPING, whole_body
from recorded import QP_DAMPING, check_recorded_saturated, recorded_qps, recorded_saturated
from saturation_families import FAMILIES as SATURATED
from saturation_families import N, as_levels, drawn, family, solve_full
from weighted_families import contradicting, soft_problems

from osik_jax.core import _cuda as core_cuda
from osik_jax.execution import _backends
from osik_jax.solvers import Level, Status, solve_least_squares_qp, solve_nullspace
from osik_jax.solvers._damping import per_level
from osik_jax.solvers.null_space import _cuda as null_space
from osik_jax.solvers.null_space import _saturation
from osik_jax.solvers.null_space._padding import pad_levels
from osik_jax.solvers.qp import _core
from osik_jax.solvers.qp._problem import QP, LeastSquares

usable = _backends.cuda_is_default() and core_cuda.installed()
pytestmark = pytest.mark.skipif(not usable, reason="needs JAX_PLATFORMS=cuda,cpu, a CUDA device and the compiled core")


@pytest.fixture(params=["core", "jax"])
def backend(request):
    """Both have to pass."""
    return request.param


def single(*arrays: Any) -> list[jax.Array]:
    return [jnp.asarray(a, jnp.float32) for a in arrays]


def off(A, x, expected, b):
    """Rows of the cost, as a share of the largest that is asked for: what the precision contract is about."""
    return np.abs(np.einsum("bmn,bn->bm", A, np.asarray(x, float) - expected)).max(1) / np.abs(b).max(1)


@pytest.mark.parametrize("robot", ["g1", "nao"])
def test_recorded_qps_cold_and_warm(robot, backend):
    p = recorded_qps(robot)
    weight, lower, upper = np.ones_like(p.b), *single(p.lower, p.upper)
    solve = jax.jit(
        jax.vmap(lambda *a: solve_least_squares_qp(*a[:5], damping=QP_DAMPING, warm_start=a[5], backend=backend))
    )
    start = jnp.zeros(lower.shape, jnp.int32)
    for warm in (False, True):
        s = solve(*single(p.A, p.b, weight), lower, upper, start)
        assert (s.status == Status.SOLVED).all()
        assert ((lower <= s.x) & (s.x <= upper)).all()
        assert off(p.A, s.x, p.solution, p.b).max() < 1e-5
        assert not warm or (np.asarray(s.factorizations) == 1).mean() > 0.99
        start = s.active


def test_whole_body_family(backend, rng):
    p = whole_body(rng, 2000)

    def solve(backend):
        options = dict(damping=WHOLE_BODY_DAMPING, backend=backend)
        return jax.jit(jax.vmap(lambda *a: solve_least_squares_qp(*a, **options)))

    s = solve(backend)(*single(*p[:5]))
    with jax.default_device(jax.devices("cpu")[0]):
        expected = np.asarray(solve("jax")(*p[:5]).x)
    assert (np.asarray(s.status) == Status.SOLVED).mean() > 0.85  # in single precision
    fine = np.asarray(s.status) == Status.SOLVED
    error = off(np.sqrt(p.weight)[..., None] * p.A, s.x, expected, np.sqrt(p.weight) * p.b)
    assert error[fine].max() < 5e-5


@pytest.mark.parametrize("shape", [(3, 0, 2), (12, 20, 5), (31, 60, 1), (33, 40, 3), (48, 30, 32), (64, 50, 4)])
def test_any_size_with_soft_rows(shape, backend, rng):
    data = soft_problems(rng, 500, *shape)

    def solve(backend, A, b, weight, lower, upper, C, low, high, compliance, damping, center):
        rows = dict(rows=C, rows_lower=low, rows_upper=high, rows_compliance=compliance) if shape[2] else {}
        pulls = dict(damping=damping, center=center)
        return solve_least_squares_qp(A, b, weight, lower, upper, **rows, **pulls, backend=backend)

    s = jax.jit(jax.vmap(partial(solve, backend)))(*single(*data))
    with jax.default_device(jax.devices("cpu")[0]):
        expected = jax.jit(jax.vmap(partial(solve, "jax")))(*data)
    assert (s.status == Status.SOLVED).all()
    np.testing.assert_allclose(s.x, expected.x, atol=2e-4)
    np.testing.assert_allclose(s.row_multipliers, expected.row_multipliers, atol=5e-3)


def test_hard_rows_go_the_other_way(rng):
    """In the same batch: lanes whose rows do not give way are solved by the search."""
    data = soft_problems(rng, 64, 8, 12, 2)
    data[6][...], data[7][...] = -0.05, 0.05
    data[3][...], data[4][...] = -1.0, 1.0
    data[8][::3] = 0.0
    solve = jax.vmap(
        lambda A, b, w, lower, upper, C, low, high, c, d, m: solve_least_squares_qp(
            A, b, w, lower, upper, C, low, high, rows_compliance=c, damping=d, center=m
        )
    )
    s = jax.jit(solve)(*single(*data))
    with jax.default_device(jax.devices("cpu")[0]):
        expected = jax.jit(solve)(*data)
    assert (s.status == Status.SOLVED).all()
    np.testing.assert_allclose(s.x, expected.x, atol=1e-4)


def test_contradicting_rows_are_missed_as_little_as_possible(rng):
    """In a third of the lanes; the kernel proves it, in double precision if need be."""
    given = single(*contradicting(rng, 600, every=3))
    solve = jax.jit(jax.vmap(lambda *a: solve_least_squares_qp(*a, damping=1e-3)))
    s = solve(*given)
    with jax.default_device(jax.devices("cpu")[0]):
        expected = solve(*(np.asarray(a, float) for a in given))
    np.testing.assert_array_equal(s.status, expected.status)
    assert (s.status == Status.INFEASIBLE).sum() == 200
    np.testing.assert_allclose(s.x, expected.x, atol=2e-3)


def test_a_bad_lane_disturbs_no_other(rng):
    p = whole_body(rng, 100)
    given = single(*p[:5])
    solve = jax.jit(jax.vmap(lambda *a: solve_least_squares_qp(*a, damping=WHOLE_BODY_DAMPING)))
    good = solve(*given)
    bad = solve(given[0].at[3, 2, 1].set(jnp.nan), *given[1:])
    assert bad.status[3] == Status.NUMERICAL_ERROR and np.isfinite(bad.x[3]).all()
    others = np.arange(100) != 3
    np.testing.assert_array_equal(np.asarray(bad.x)[others], np.asarray(good.x)[others])


def test_derivatives_are_those_of_the_search():
    p = recorded_qps("nao")
    A, b, lower, upper = single(p.A[:50], p.b[:50], p.lower[:50], p.upper[:50])

    def cost(b, backend):
        solve = jax.vmap(lambda *a: solve_least_squares_qp(*a, damping=QP_DAMPING, backend=backend).x)
        return jnp.sum(jnp.einsum("bmn,bn->bm", A, solve(A, b, jnp.ones_like(b), lower, upper)) ** 2)

    slopes = [np.asarray(jax.jit(partial(jax.grad(cost), backend=backend))(b)) for backend in ("core", "jax")]
    np.testing.assert_allclose(slopes[0], slopes[1], atol=1e-4 * np.abs(slopes[1]).max())


def test_the_kernel_settles_alone(rng):
    """From the active set of the answer with one factorisation, from nothing with more; XLA is left nothing."""
    p = recorded_qps("g1")
    count, m, n = p.A.shape
    at = np.where(p.solution <= p.lower + 1e-12, -1, np.where(p.solution >= p.upper - 1e-12, 1, 0))
    A, b, weight, damping = single(p.A, p.b, np.ones((count, m)), np.full((count, n), QP_DAMPING))
    lower, upper = single(p.lower, p.upper)
    qp = QP(
        LeastSquares(A, b, weight, damping, 0 * damping),
        jnp.zeros((count, 0, n), jnp.float32),
        jnp.zeros((count, 0), jnp.float32),
        lower,
        upper,
    )
    guess, tolerance = jnp.asarray(at, jnp.int32), jnp.full(count, 1e-7, jnp.float32)
    kernel = jax.jit(lambda *a: _core.solve_on_gpu(a[0], a[1], a[2], 1000))
    found = kernel(qp, guess, tolerance)
    assert found.converged.all() and (found.factorizations == 1).all() and (found.iterations == 0).all()
    np.testing.assert_array_equal(found.active, guess)
    assert off(p.A, found.x, p.solution, p.b).max() < 1e-5
    cold = kernel(qp, jnp.zeros_like(guess), tolerance)
    assert cold.converged.all()
    assert off(p.A, cold.x, p.solution, p.b).max() < 1e-5


@pytest.mark.parametrize("name", FAMILIES)
def test_classical_projection_lane_by_lane_as_the_plain_method(name):
    p = FAMILIES[name]
    found, expected = (classical(p, backend=backend) for backend in ("core", "jax"))
    assert (found.status == Status.SOLVED).all() and (expected.status == Status.SOLVED).all()
    np.testing.assert_allclose(found.x, expected.x, rtol=0, atol=1e-9 * (1.0 + np.abs(expected.x).max()))
    np.testing.assert_allclose(found.projector, expected.projector, rtol=0, atol=1e-11)


def check_a_bad_lane(solve, p):
    p = jax.tree.map(np.array, p)
    good = solve(p, backend="core")
    p.levels[1][0][3, 0, 0] = np.nan
    bad = solve(p, backend="core")
    others = np.arange(len(bad.x)) != 3
    assert bad.status[3] == Status.NUMERICAL_ERROR and np.isfinite(bad.x[3]).all()
    np.testing.assert_array_equal(np.asarray(bad.x)[others], np.asarray(good.x)[others])


def test_a_bad_lane_of_the_classical_projection_disturbs_no_other():
    check_a_bad_lane(classical, FAMILIES["a humanoid's"])


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("name", ["damped inequalities", "dependent", "nothing left", "a humanoid's"])
def test_saturation_lane_by_lane_as_the_plain_method(name, precision):
    p = jax.tree.map(lambda a: jnp.asarray(a, precision), FAMILIES[name])
    found, expected = (saturated(p, backend=backend) for backend in ("core", "jax"))
    assert (found.status == Status.SOLVED).all() and (expected.status == Status.SOLVED).all()
    atol = 1e-8 if precision == "float64" else 1e-6
    np.testing.assert_allclose(found.x, expected.x, rtol=0, atol=atol)
    np.testing.assert_allclose(found.scales, expected.scales, rtol=0, atol=atol)
    np.testing.assert_allclose(found.projector, expected.projector, rtol=0, atol=atol)
    np.testing.assert_array_equal(found.active, expected.active)


@pytest.mark.parametrize("number", range(len(SATURATED)), ids=SATURATED)
def test_saturation_decides_as_the_plain_method(number):
    """And as a loop over the problems."""
    p = family(SATURATED[number], np.random.default_rng(100 + number))
    found, expected = (solve_full(p, backend=backend) for backend in ("core", "jax"))
    assert (found.status == Status.SOLVED).all()
    assert ((found.x >= p.lower) & (found.x <= p.upper)).all()
    size = 1.0 + np.abs(expected.x).max(1)
    assert (np.abs(found.x - expected.x).max(1) < 1e-8 * size).all()
    np.testing.assert_allclose(found.projector, expected.projector, rtol=0, atol=1e-9)
    for lane in (0, 99, 199):
        alone = solve_full(jax.tree.map(lambda a, i=lane: a[i : i + 1], p), backend="core")
        np.testing.assert_allclose(alone.x[0], found.x[lane], rtol=0, atol=1e-12 * size[lane])


def test_saturation_leaves_nothing_to_the_search(rng):
    """Of random problems the kernel answers all."""
    p = drawn(rng, 5000)

    def padded(p):
        damping = per_level(0.0, len(p.levels), N, float)
        levels = [level.scaled() for level in as_levels(p.levels)]
        return pad_levels(levels, p.lower, p.upper, p.secondary, damping, 1e-10)

    found = jax.jit(lambda p: _saturation.by_core(null_space.saturate, jax.vmap(padded)(p), 120))(p)
    assert found.done.all()
    assert (jnp.abs(found.x - solve_full(p, backend="jax").x) < 1e-8).all()


def test_recorded_saturated_problems_whatever_rounding_does():
    copies = 256
    p = recorded_saturated(copies)
    check_recorded_saturated(jax.jit(lambda p: _saturation.by_core(null_space.saturate, p, 330))(p), p, copies)


def test_derivatives_of_saturation(rng):
    check_derivatives_of_saturation(rng, "core")


def test_a_bad_lane_of_saturation_disturbs_no_other():
    check_a_bad_lane(solve_full, family("tight", np.random.default_rng(1)))


def test_problems_that_do_not_fit_are_searched():
    level = [Level(np.ones((1, 130)), np.ones(1))]
    found = solve_nullspace(level, -np.ones(130), np.ones(130), backend="core")
    assert found.status == Status.SOLVED
    np.testing.assert_allclose(found.x, 1.0 / 130.0, rtol=0, atol=1e-12)
