"""The hierarchy's kernel beside XLA, without a GPU: what it answers is taken only where it passes the check."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_checks import needs_core
from hierarchy_families import inequality_levels

from osik_jax.core import _cuda as core_cuda
from osik_jax.execution import _backends
from osik_jax.solvers import Level, Tolerances, solve_hqp
from osik_jax.solvers._damping import per_level
from osik_jax.solvers.hqp import _cascade, _core, _dispatch
from osik_jax.solvers.hqp._problem import Layout, PaddedHierarchy, pad_hierarchy

COUNT, CAP = 12, 200


class Batch(NamedTuple):
    layout: Layout
    hierarchy: PaddedHierarchy
    tolerances: Tolerances
    answers: _cascade.CascadeResult


@pytest.fixture(scope="module")
def batch() -> Batch:
    p = inequality_levels(np.random.default_rng(2), COUNT)
    layouts = []

    def padded(levels, lower, upper):
        given = [Level(*level) for level in levels]
        none = per_level(0.0, len(given), len(lower), lower.dtype)
        layout, hierarchy = pad_hierarchy(given, [level.equal for level in given], lower, upper, lower >= upper, none)
        layouts.append(layout)
        return hierarchy

    last = (np.broadcast_to(np.eye(10), (COUNT, 10, 10)), np.zeros((COUNT, 10)))
    hierarchy = jax.vmap(padded)([*map(tuple, p.levels), last], jnp.asarray(p.lower), jnp.asarray(p.upper))
    tolerances = jax.tree.map(lambda a: jnp.full(COUNT, a), Tolerances())
    layout = layouts[0]
    answers = jax.jit(lambda s, t: _cascade.solve_cascade(layout, CAP, s, t))(hierarchy, tolerances)
    assert answers.done.all() and (answers.active_bounds != 0).any(1).all()
    return Batch(layout, hierarchy, tolerances, answers)


def completed(batch, answer):
    """The end, and the lanes in which the kernel's answer was taken."""
    marked = answer._replace(factorizations=jnp.full_like(answer.factorizations, 1000))
    check = _dispatch.kernel_candidates(batch.layout, CAP, lambda *_: marked).answers
    end = jax.jit(lambda s, t: check(s, t, None))(*batch[1:3])
    return end, end.factorizations == 1000


def some(count=COUNT):
    return jnp.arange(count) % 3 == 0


def beside_its_box(batch):
    n = batch.answers.x.shape[1]
    room = jnp.where(
        jnp.isfinite(batch.hierarchy.hard_upper[:, :n]), batch.hierarchy.hard_upper[:, :n], batch.answers.x
    )
    return batch.answers._replace(x=jnp.where(some()[:, None], room + 1e-6, batch.answers.x))


def worse_above(batch):
    """Inside the box, and a level does not keep what it had reached."""
    return batch.answers._replace(
        slack_norms=jnp.where(some()[:, None], 0.9 * batch.answers.slack_norms - 1e-3, batch.answers.slack_norms)
    )


def changed(**how):
    def change(batch):
        right = batch.answers
        return right._replace(
            **{
                name: jnp.where(some().reshape(-1, *[1] * (getattr(right, name).ndim - 1)), value, getattr(right, name))
                for name, value in how.items()
            }
        )

    return change


WRONG = {
    "not done": changed(done=False),
    "NaN": changed(x=jnp.nan),
    "NaN multipliers": changed(multipliers=jnp.nan),
    "infinite residual": changed(residual=jnp.inf),
    "outside": beside_its_box,
    "a level lost": worse_above,
}


@pytest.mark.release
def test_right_answers_are_taken(batch):
    end, taken = completed(batch, batch.answers)
    assert taken.all()
    n, hierarchy = end.x.shape[1], batch.hierarchy
    inside = np.clip(batch.answers.x, hierarchy.hard_lower[:, :n], hierarchy.hard_upper[:, :n])
    np.testing.assert_array_equal(end.x, inside)


@pytest.mark.variants(slow=["outside", "a level lost"], release=["infinite residual", "NaN multipliers", "not done"])
@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_answers_are_not(batch, wrong, monkeypatch):
    """They are wrong in every third lane; blocks of 3, so that the last one is not full."""
    monkeypatch.setattr(_dispatch, "_BLOCK", 3)
    end, taken = completed(batch, WRONG[wrong](batch))
    np.testing.assert_array_equal(taken, ~some())
    assert end.done.all()
    np.testing.assert_allclose(end.x, batch.answers.x, rtol=0, atol=1e-12)


@pytest.mark.release
@needs_core
def test_when_the_kernel_is_asked(monkeypatch):
    asked = []

    def solve(layout, hierarchy, tolerances, warm_start, max_iterations):
        asked.append(layout.variables)
        return _cascade.solve_cascade(layout, max_iterations, hierarchy, tolerances)

    monkeypatch.setattr(_core, "solve_on_gpu", solve)
    monkeypatch.setattr(core_cuda, "nvrtc", lambda: "libnvrtc.so")

    def trace(n=3, backend="auto"):
        _dispatch.hierarchy_solver.cache_clear()
        jax.clear_caches()
        levels = [Level(np.ones((1, n)), [-1.0], [1.0]), Level(np.ones((2, n)), [1.0, 2.0])]
        jax.jit(lambda low: solve_hqp(levels, low, -low, backend=backend).x).lower(-np.ones(n))

    trace()
    assert asked == []  # no GPU
    monkeypatch.setattr(_backends, "cuda_is_default", lambda: True)
    trace()
    trace(backend="core")
    assert asked[-1] == 3
    count = len(asked)
    trace(170)  # too many variables for the memory of a block
    trace(backend="jax")
    trace(170, backend="core")
    assert len(asked) == count
    _dispatch.hierarchy_solver.cache_clear()
    jax.clear_caches()
