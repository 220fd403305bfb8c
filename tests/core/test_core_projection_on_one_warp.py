"""The GPU's text of the classical projection, on a CPU, beside the CPU's own call. Shared memory holds NaN at first."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import one_warp
import pytest
from core_checks import needs_core
from null_space_families import FAMILIES, random_problems

from osik_jax.core import _cuda, _library
from osik_jax.solvers import Damping, Level
from osik_jax.solvers.null_space import _dispatch, _projection_cuda

pytestmark = needs_core
CASES = FAMILIES | {
    "more than 32 of each": random_problems(20, 40, (12, 45, 3), inequalities=True, damped=True, lanes=3),
    "more than 64 rows": random_problems(22, 6, (70, 3), damped=True, lanes=2),
    "more than 64 variables": random_problems(23, 70, (6, 3), damped=True, lanes=2),
    "no rows": random_problems(21, 5, (0, 0), lanes=1),
}


@pytest.mark.variants(
    slow=["independent", "damped", "one variable", "tiny", "huge", "zeros", "repeated", "dependent and damped"],
    release=["inequalities", "damped inequalities", "dependent", "as many zero rows as are left"],
)
@pytest.mark.parametrize("p", CASES.values(), ids=CASES)
def test_the_answers_are_those_of_the_cpu(p, tmp_path, monkeypatch):
    levels = [jax.vmap(lambda *of: Level(*of).scaled())(*level) for level in p.levels]
    damping = Damping(*(jnp.stack(parts, 1) for parts in zip(*p.damping, strict=True)))
    given = levels, p.secondary, damping, jnp.full(len(p.secondary), 1e-10)
    expected = _dispatch._by_core(_library.call, *given)
    monkeypatch.setattr(_cuda, "call", partial(one_warp.call_of_warps, tmp_path))
    monkeypatch.setattr(_cuda, "problems_of_a_block", lambda _: 3)
    for found, other in zip(_dispatch._by_core(_projection_cuda.call, *given), expected, strict=True):
        np.testing.assert_allclose(found, other, rtol=0, atol=1e-10 * (1.0 + np.abs(other).max()))
