"""The GPU's text of the null space, on a CPU, beside the CPU's own call. Shared memory holds NaN at first."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import one_warp
import pytest
import saturation_families
from core_checks import needs_core
from null_space_families import FAMILIES, random_problems
from recorded import recorded_saturated

from osik_jax.core import _cuda, _library
from osik_jax.solvers import Damping, Level
from osik_jax.solvers._damping import per_level
from osik_jax.solvers.null_space import _cuda as null_space
from osik_jax.solvers.null_space import _projection, _saturation
from osik_jax.solvers.null_space._padding import pad_levels, without_roundoff

pytestmark = needs_core
CASES = FAMILIES | {
    "more than 32 of each": random_problems(20, 40, (12, 45, 3), inequalities=True, damped=True, lanes=3),
    "more than 64 rows": random_problems(22, 6, (70, 3), damped=True, lanes=2),
    "more than 64 variables": random_problems(23, 70, (6, 3), damped=True, lanes=2),
    "no rows": random_problems(21, 5, (0, 0), lanes=1),
}


@pytest.fixture
def on_one_warp(tmp_path, monkeypatch):
    """GPU calls run here, three problems in each block."""
    monkeypatch.setattr(_cuda, "call", partial(one_warp.call_of_warps, tmp_path))
    monkeypatch.setattr(_cuda, "problems_of_a_block", lambda _: 3)


def assert_near(found, expected):
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-10 * (1.0 + np.abs(b).max()))


IN_THE_GATE = ("a humanoid's", "more than 64 rows", "more than 64 variables", "dependent and damped", "tiny", "zeros")


@pytest.mark.variants(ordinary=["more than 32 of each", "no rows", "repeated and damped"], slow=IN_THE_GATE)
@pytest.mark.parametrize("p", CASES.values(), ids=CASES)
def test_the_classical_projection(p, on_one_warp):
    levels = [jax.vmap(lambda *of: Level(*of).scaled())(*level) for level in p.levels]
    damping = Damping(*(jnp.stack(parts, 1) for parts in zip(*p.damping, strict=True)))
    given = levels, p.secondary, damping, jnp.full(len(p.secondary), 1e-10)
    assert_near(_projection._by_core(null_space.project, *given), _projection._by_core(_library.call, *given))


def in_a_box(p, bound=0.4):
    def padded(p):
        levels = [Level(*of).scaled() for of in p.levels]
        damping = per_level([Damping(*of) for of in p.damping], len(levels), len(p.secondary), float)
        box = -jnp.full_like(p.secondary, bound), jnp.full_like(p.secondary, bound)
        return without_roundoff(pad_levels(levels, *box, p.secondary, damping, 1e-10))

    return jax.vmap(padded)(p)


def of_family(name):
    p = saturation_families.family(name, np.random.default_rng(7))
    p = jax.tree.map(lambda a: a[:20], p)

    def padded(p):
        damping = per_level(0.0, len(p.levels), len(p.lower), float)
        levels = [level.scaled() for level in saturation_families.as_levels(p.levels)]
        return without_roundoff(pad_levels(levels, p.lower, p.upper, p.secondary, damping, 1e-10))

    return jax.vmap(padded)(p)


IN_BOXES = {name: partial(in_a_box, p) for name, p in CASES.items()}
IN_BOXES |= {name: partial(of_family, name) for name in saturation_families.FAMILIES}
IN_BOXES |= {"recorded": partial(recorded_saturated, 1)}


@pytest.mark.variants(ordinary=["ties", "recorded"], slow=["a humanoid's", "more than 32 of each", "no rows"])
@pytest.mark.parametrize("name", IN_BOXES)
def test_saturation(name, on_one_warp):
    p = IN_BOXES[name]()
    found, expected = (_saturation.by_core(call, p, 330) for call in (null_space.saturate, _library.call))
    assert_near(found[:3], expected[:3])
    np.testing.assert_array_equal(found.done, expected.done)
    if name != "ties":  # of which joints are at their bounds any may be said to be
        assert_near(found.active_joints, expected.active_joints)
        np.testing.assert_array_equal(found.active, expected.active)
