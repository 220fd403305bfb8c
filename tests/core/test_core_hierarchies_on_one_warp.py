"""The GPU's text of the hierarchy, on a CPU, beside the CPU's own call. Shared memory holds NaN at first."""

from functools import partial

import jax
import numpy as np
import one_warp
import pytest
from core_checks import needs_core
from hierarchy_families import (
    Hierarchies,
    Rows,
    conflicting,
    dependent,
    empty_levels,
    inequality_levels,
    many_levels,
    pinned,
)

from osik_jax.core import _cuda
from osik_jax.solvers import Damping, Level, Status, solve_hqp
from osik_jax.solvers.hqp import _core as hierarchy
from osik_jax.solvers.hqp import _dispatch

pytestmark = needs_core
DAMPED = Damping(1e-4, 0.3, 9.0, 0.4)  # a demand that no level misses whole


def more_rows_than_variables(rng: np.random.Generator, count: int) -> Hierarchies:
    """More than 32 variables; a last level of more rows, as a posture has, and with a short interval each."""
    levels = []
    for m in (6, 3, 40):
        centre, A = rng.normal(size=(count, m)), rng.normal(size=(count, m, 35))
        levels.append(Rows(A, centre - 0.1 * (m == 40), centre, np.ones((count, m))))
    return Hierarchies(levels, np.full((count, 35), -1.0), np.full((count, 35), 1.0))


FAMILIES = (conflicting, inequality_levels, dependent, pinned, empty_levels, many_levels, more_rows_than_variables)


def solved(p: Hierarchies, damping, warm_start=None):
    """A batch by the core's CPU call, or what is in its place."""

    @jax.jit
    @jax.vmap
    def solve(levels, lower, upper, warm_start):
        given = [Level(*level) for level in levels]
        return solve_hqp(given, lower, upper, warm_start=warm_start, backend="core", damping=damping)

    return solve([tuple(level) for level in p.levels], p.lower, p.upper, warm_start)


@pytest.fixture
def on_one_warp(monkeypatch, tmp_path):
    """Calls of the core take the GPU's text, thread by thread."""

    def call(source, outputs, *inputs, problems, shared):
        shapes = [jax.ShapeDtypeStruct(*output) for output in outputs]
        run = partial(one_warp.call_of_warps, tmp_path, source, outputs, problems=problems, shared=shared)
        return jax.pure_callback(run, shapes, *inputs)

    _dispatch.hierarchy_solver.cache_clear()
    monkeypatch.setattr(_dispatch._core, "solve", hierarchy.solve_on_gpu)
    monkeypatch.setattr(_cuda, "call", call)
    yield
    _dispatch.hierarchy_solver.cache_clear()


@pytest.mark.variants(ordinary=[], slow=["inequality_levels-damped", "conflicting-exact"])
@pytest.mark.parametrize("damping", [0.0, DAMPED], ids=["exact", "damped"])
@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.__name__)
def test_the_answers_are_those_of_the_cpu(family, damping, rng, request):
    p = family(rng, 6)
    expected = solved(p, damping)
    request.getfixturevalue("on_one_warp")
    cold = solved(p, damping)
    for found in (cold, solved(p, damping, cold.warm_start)):
        np.testing.assert_array_equal(found.status, Status.SOLVED)
        np.testing.assert_allclose(found.x, expected.x, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(cold.iterations, expected.iterations)
