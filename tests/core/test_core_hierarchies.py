"""The core's hierarchy on a CPU: beside the search, in both precisions, and where its candidates fail."""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_checks import needs_core
from hierarchy_families import SMALL, Hierarchies, Rows
from lexicographic import certificate
from recorded import recorded_hierarchies
from refusals import refuses

from osik_jax import HierarchicalQP, NullSpace, OsikWarning
from osik_jax.core import _library
from osik_jax.execution import _backends
from osik_jax.solvers import Damping, Level, Status, solve_hqp, solve_nullspace
from osik_jax.solvers.hqp import _dispatch

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


@pytest.mark.variants(slow=["True"], release=["False"])
@pytest.mark.parametrize("damped", [False, True])
def test_answers_are_those_of_the_search(families, damped):
    mine, search = (solved(*given(families), backend=b, damped=damped) for b in ("core", "jax"))
    np.testing.assert_array_equal(mine.status, search.status)
    agree = np.abs(mine.x - search.x).max(1) < 1e-6 * (1.0 + np.abs(search.x).max(1))
    assert agree.mean() > 0.99  # what is left: rows whose rank is at the tolerance


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


def test_a_backend_that_is_not_there(monkeypatch):
    for scheme in (HierarchicalQP, NullSpace):
        refuses(ValueError, "backend is 'cuda'; backends: auto, jax, core", scheme, backend="cuda")
    monkeypatch.setattr(_library, "core", lambda: _library.Core(None, None, "no compiled core: install g++"))
    for scheme in (HierarchicalQP, NullSpace):
        refuses(ModuleNotFoundError, r"backend='core': no compiled core: install g\+\+", scheme, backend="core")
    with pytest.warns(OsikWarning, match="install g"):
        _library._warn_once.cache_clear()
        assert not _backends.takes("auto", "core", fits=True)


@pytest.mark.parametrize(
    ("solver", "call"), [(solve_hqp, "osik_hierarchy"), (solve_nullspace, "osik_projection")], ids=["hqp", "null space"]
)
def test_programs_for_other_machines(solver, call):
    """Which platform a program is for is decided when it is lowered; with "jax" there is no kernel at all."""
    box = (-np.ones(3), np.ones(3)) if solver is solve_hqp else ()

    def text(backend, platform):
        traced = jax.jit(lambda b: solver([Level(np.ones((1, 3)), b)], *box, backend=backend).x).trace(np.ones(1))
        return traced.lower(lowering_platforms=(platform,)).as_text()

    assert call in text("core", "cpu") and call not in text("core", "cuda") and call not in text("jax", "cpu")


@pytest.mark.slow
def test_a_short_row_that_is_met_leaves_the_levels_below_their_room():
    """Random problems of ``benchmarks.agreement``: roundoff of long rows is more than a short one seems to miss."""
    stored = np.load(Path(__file__).parents[1] / "data" / "hqp_short_rows.npz")
    leaves = [stored[str(at)] for at in range(len(stored))]
    rows = [Rows(*leaves[at : at + len(Rows._fields)]) for at in range(0, len(leaves) - 2, len(Rows._fields))]
    p = Hierarchies(rows, *leaves[-2:])
    for backend in ("core", "jax"):
        found = solved(*given(p), backend=backend)
        assert (found.status == Status.SOLVED).all()
        for lane, x in enumerate(np.asarray(found.x)):
            assert certificate(p, lane, x).max() < 1e-12
