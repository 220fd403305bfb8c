"""The core's hierarchy on a CPU: beside the search, in both precisions, and where its candidates fail."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_checks import needs_core
from hierarchy_families import SMALL, Hierarchies
from lexicographic import certificate
from recorded import recorded_hierarchies

from osik_jax import HierarchicalQP, OsikWarning
from osik_jax.core import _library
from osik_jax.execution import _backends
from osik_jax.solvers import Damping, Level, Status, solve_hqp
from osik_jax.solvers.hqp import _core, _dispatch

pytestmark = needs_core
COUNT = 24
DAMPED = [0.0, Damping(1e-3, 0.3, 2.0, 0.4), 1e-4, Damping(0.0, 0.5, 1.0)]


@pytest.fixture(scope="module")
def families() -> Hierarchies:
    """Of each family some, in one batch."""
    drawn = [draw(np.random.default_rng(k), COUNT) for k, draw in enumerate(SMALL.values())]
    return jax.tree.map(lambda *a: np.concatenate(a), *drawn)


@partial(jax.jit, static_argnames=("backend", "damped"))
def solved(levels, lower, upper, warm_start=None, *, backend="core", damped=False):
    def one(levels, lower, upper, warm_start):
        damping = DAMPED[: len(levels)] if damped else 0.0
        given = [Level(*level) for level in levels]
        return solve_hqp(given, lower, upper, warm_start=warm_start, backend=backend, damping=damping)

    return jax.vmap(one)(levels, lower, upper, warm_start)


def given(p):
    return [tuple(level) for level in p.levels], p.lower, p.upper


@pytest.fixture
def nothing_is_searched(monkeypatch):
    """What the kernel leaves over is lost: numbers that are NaN."""

    def spoiled(end, done, again, block):
        def lose(a):
            missing = jnp.nan if jnp.issubdtype(a.dtype, jnp.floating) else a
            return jnp.where(done.reshape(-1, *[1] * (a.ndim - 1)), a, missing)

        return jax.tree.map(lose, end)

    monkeypatch.setattr(_dispatch, "with_the_rest", spoiled)
    _dispatch.hierarchy_solver.cache_clear()
    jax.clear_caches()
    yield
    _dispatch.hierarchy_solver.cache_clear()
    jax.clear_caches()


def test_every_level_is_certified_and_nothing_is_left_to_the_search(families, nothing_is_searched):
    cold = solved(*given(families))
    for s in (cold, solved(*given(families), cold.warm_start)):
        np.testing.assert_array_equal(s.status, Status.SOLVED)
        x = np.asarray(s.x)
        assert ((families.lower <= x) & (x <= families.upper)).all()
        assert max(certificate(families, i, x[i]).max() for i in range(0, len(x), 3)) < 1e-10


@pytest.mark.variants(release=["False"])
@pytest.mark.parametrize("damped", [False, True])
def test_answers_are_those_of_the_search(families, damped):
    mine, search = (solved(*given(families), backend=b, damped=damped) for b in ("core", "jax"))
    np.testing.assert_array_equal(mine.status, search.status)
    agree = np.abs(mine.x - search.x).max(1) < 1e-6 * (1.0 + np.abs(search.x).max(1))
    assert agree.mean() > 0.99  # what is left: rows whose rank is at the tolerance


@pytest.mark.slow
@pytest.mark.variants(release=["False"])
@pytest.mark.parametrize("damped", [False, True])
def test_foreign_warm_starts_change_no_answer(families, damped, rng):
    """Working sets of other problems, and bounds of 1e10; ties that roundoff may break in two ways are among them."""
    huge = (rng.random(families.lower.shape) < 0.4) & (families.lower < families.upper)
    p = families._replace(
        lower=np.where(huge, -1e10, np.maximum(families.lower, -1e10)),
        upper=np.where(huge, 1e10, np.minimum(families.upper, 1e10)),
    )
    cold = solved(*given(p), damped=damped)
    for other in (1, 7, len(huge) // 2):
        guess = jax.tree.map(lambda a, other=other: jnp.roll(a, other, 0), cold.warm_start)
        warm = solved(*given(p), guess, damped=damped)
        both = (np.asarray(warm.status) == Status.SOLVED) & (np.asarray(cold.status) == Status.SOLVED)
        assert both.mean() > 0.99 and np.asarray(warm.kkt_residual)[both].max() < 1e-9
        scale = 1.0 + np.abs(cold.x).max(1, keepdims=True)
        np.testing.assert_allclose((warm.x / scale)[both], (cold.x / scale)[both], rtol=0, atol=1e-7)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_recorded_hierarchies(precision, nothing_is_searched):
    r = recorded_hierarchies(unit_rows=True)
    with jax.enable_x64(precision == "float64"):
        levels, lower, upper = jax.tree.map(lambda a: jnp.asarray(a, precision), (r.levels, r.lower, r.upper))
        cold = solved(levels, lower, upper)
        warm = solved(levels, lower, upper, cold.warm_start)
    for s in (cold, warm):
        assert s.x.dtype == precision and (np.asarray(s.status) == Status.SOLVED).all()
        for k, (A, low, high) in enumerate(r.levels):
            value = np.einsum("bmn,bn->bm", A, np.asarray(s.x, float))
            norm = np.linalg.norm(value - np.clip(value, low, high), axis=1)
            bound = 2e-7 if precision == "float32" else 1e-10
            np.testing.assert_allclose(norm, r.residual_norm[:, k], rtol=0, atol=bound)
    assert np.mean(warm.factorizations) < 0.3 * np.mean(cold.factorizations)


@pytest.mark.release
def test_vmap_is_a_loop_and_a_bad_lane_leaves_its_neighbours_alone(families):
    p = jax.tree.map(lambda a: a[:5].copy(), families)
    p.levels[1].A[3, 0, 0] = np.nan
    levels, lower, upper = given(p)
    s = solved(levels, lower, upper)
    assert s.status[3] == Status.NUMERICAL_ERROR and np.isfinite(s.x).all()
    nested = jax.tree.map(lambda a: a[None], (levels, lower, upper))
    np.testing.assert_array_equal(jax.vmap(solved)(*nested).x[0], s.x)
    for i in (0, 4):
        alone = solved(*jax.tree.map(lambda a, i=i: a[i : i + 1], (levels, lower, upper)))
        np.testing.assert_array_equal(alone.x[0], s.x[i])


@pytest.mark.release
def test_what_the_kernel_leaves_over_is_searched(families, monkeypatch):
    """A kernel that gives wrong answers in every third lane."""
    p = jax.tree.map(lambda a: a[:6], families)
    right, solve = solved(*given(p)), _core.solve

    def wrong(*args):
        end = solve(*args)
        return end._replace(x=jnp.where(jnp.arange(len(end.x))[:, None] % 3 == 0, jnp.nan, end.x))

    monkeypatch.setattr(_core, "solve", wrong)
    _dispatch.hierarchy_solver.cache_clear()
    jax.clear_caches()
    s = solved(*given(p))
    _dispatch.hierarchy_solver.cache_clear()
    jax.clear_caches()
    np.testing.assert_array_equal(s.status, Status.SOLVED)
    np.testing.assert_allclose(s.x, right.x, atol=1e-9)


@pytest.mark.release
def test_derivatives_are_those_of_differences():
    A = np.random.default_rng(3).normal(size=(7, 5))
    box = np.full(5, 0.4)

    def norm(t):
        levels = [Level(A[:2], jnp.array([0.3, -0.2]) + t), Level(A[2:], A[2:, 0] * t + 0.5)]
        return jnp.sum(jnp.sin(solve_hqp(levels, -box, box, backend="core").x))

    both, step = jax.jit(jax.value_and_grad(norm)), 1e-6
    by_differences = (both(0.2 + step)[0] - both(0.2 - step)[0]) / (2 * step)
    np.testing.assert_allclose(both(0.2)[1], by_differences, rtol=1e-6)
    forward = jax.jit(lambda t: jax.jvp(norm, (t,), (1.0,))[1])
    np.testing.assert_allclose(forward(0.2), by_differences, rtol=1e-6)
    ends = jax.jit(lambda t: jax.lax.scan(lambda t, _: (t + 0.01, norm(t)), t, length=3)[1])(0.2)
    np.testing.assert_allclose(ends, [both(t)[0] for t in (0.2, 0.21, 0.22)], atol=1e-12)


def test_a_backend_that_is_not_there(monkeypatch):
    with pytest.raises(ValueError, match="backend is 'cuda'; backends: auto, jax, core"):
        HierarchicalQP(backend="cuda")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="backend='warp' is gone: the compiled core has its kernels"):
        HierarchicalQP(backend="warp")  # pyright: ignore[reportArgumentType]
    monkeypatch.setattr(_library, "core", lambda: _library.Core(None, None, "no compiled core: install g++"))
    with pytest.raises(ModuleNotFoundError, match=r"backend='core': no compiled core: install g\+\+"):
        HierarchicalQP(backend="core")
    with pytest.warns(OsikWarning, match="install g"):
        _library._warn_once.cache_clear()
        assert not _backends.takes("auto", "core", fits=True)


def test_programs_for_other_machines():
    """Which platform a program is for is decided when it is lowered."""

    def solve(target):
        return solve_hqp([Level(np.ones((1, 3)), target)], -np.ones(3), np.ones(3), backend="core").x

    traced = jax.jit(solve).trace(np.ones(1))
    assert "osik_hierarchy" in traced.lower(lowering_platforms=("cpu",)).as_text()
    assert "osik_hierarchy" not in traced.lower(lowering_platforms=("cuda",)).as_text()
