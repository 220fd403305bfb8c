"""Families of random levels for projections on null spaces: independent, dependent and repeated rows, dampings."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from osik_jax.execution._backends import Backend
from osik_jax.solvers import Damping, Level, solve_nullspace
from osik_jax.solvers.null_space import NullSpaceSolution

LANES = 12


class Problems(NamedTuple):
    """Levels as matrix, lower, upper, weight; a damping each, as its fields; a leading axis, the lanes."""

    levels: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]
    damping: list[tuple[np.ndarray, ...]]
    secondary: np.ndarray


def random_problems(seed, n, rows, *, scale=1.0, inequalities=False, damped=False, lanes=LANES) -> Problems:
    """With independent rows; dampings none, some, and for what cannot be met."""
    rng = np.random.default_rng(seed)
    levels, damping = [], []
    for m in rows:
        A, wanted = rng.normal(size=(lanes, m, n)), rng.normal(size=(lanes, m))
        above = wanted + np.where(rng.random((lanes, m)) < 0.5, 1.0, 0.0) if inequalities else wanted
        weight = rng.uniform(0.1, 2.0, (lanes, m))
        weight[rng.random((lanes, m)) < 0.05] = 0.0
        levels.append((scale * A, scale * wanted, scale * above, weight))
        constant = 10.0 ** rng.uniform(-8.0, 0.0, lanes) * (rng.random(lanes) < 0.7) * damped
        unmet = rng.uniform(0.0, 30.0, lanes) * (rng.random(lanes) < 0.7) * damped
        demand = rng.uniform(0.0, 3.0, lanes)
        damping.append(
            (scale**2 * constant, scale**2 * unmet, scale * demand, rng.uniform(0.0, 2.0 * scale, (lanes, n)))
        )
    return Problems(levels, damping, rng.normal(size=(lanes, n)))


def repeated(p: Problems) -> Problems:
    """The last level once more, after the first: in its null space there is less left of it, or nothing."""
    return p._replace(levels=[p.levels[0], p.levels[-1], *p.levels[1:]], damping=[p.damping[0], *p.damping])


def dependent(p: Problems) -> Problems:
    """The second half of every level's rows is the first, mixed."""

    def mixed(level):
        A, lower, upper, weight = level
        half = A.shape[1] // 2
        mix = np.random.default_rng(1).normal(size=(A.shape[1] - half, half))
        return np.concatenate([A[:, :half], mix @ A[:, :half]], 1), lower, upper, weight

    return p._replace(levels=[mixed(level) if level[0].shape[1] > 1 else level for level in p.levels])


def with_zero_rows(p: Problems) -> Problems:
    """The second level has nothing but zeros, and asks for something."""
    A, *rest = p.levels[1]
    return p._replace(levels=[p.levels[0], (0.0 * A, *rest), *p.levels[2:]])


# of as few shapes as can be: each is compiled for every backend and method
FAMILIES = {
    "independent": random_problems(0, 8, (3, 2, 2)),
    "damped": random_problems(1, 8, (3, 2, 2), damped=True),
    "inequalities": random_problems(2, 8, (3, 4, 5), inequalities=True),
    "damped inequalities": random_problems(3, 8, (3, 4, 5), inequalities=True, damped=True),
    "more rows than variables": random_problems(4, 4, (7, 3)),
    "damped, more rows": random_problems(5, 6, (2, 9, 7), damped=True),
    "nothing left": random_problems(6, 5, (3, 2, 4), damped=True),
    "a humanoid's": random_problems(7, 35, (12, 3, 3, 29), damped=True),
    "one variable": random_problems(8, 1, (1, 1)),
    "level without rows": random_problems(9, 6, (0, 2, 0), damped=True),
    "dependent": dependent(random_problems(10, 8, (3, 4, 5))),
    "dependent and damped": dependent(random_problems(11, 8, (3, 4, 5), damped=True)),
    "repeated": repeated(random_problems(12, 8, (3, 2, 2))),
    "repeated and damped": repeated(random_problems(13, 8, (3, 2, 2), damped=True)),
    "tiny": random_problems(14, 8, (3, 4, 5), scale=1e-9, inequalities=True, damped=True),
    "huge": random_problems(15, 8, (3, 4, 5), scale=1e9, inequalities=True, damped=True),
    "zeros": random_problems(16, 8, (3, 4, 5), scale=0.0),
    "as many zero rows as are left": with_zero_rows(random_problems(17, 6, (2, 5, 2))),
}


@partial(jax.jit, static_argnames="backend")
def saturated(p: Problems, *, backend: Backend = "auto") -> NullSpaceSolution:
    """Answers of a batch of a family, between -0.4 and 0.4."""
    return classical(p, 0.4, backend=backend)


def classical(p: Problems, bound: float | None = None, *, backend: Backend = "auto") -> NullSpaceSolution:
    """The same without bounds, or between others."""

    def one(p: Problems) -> NullSpaceSolution:
        box = () if bound is None else (jnp.full_like(p.secondary, -bound), jnp.full_like(p.secondary, bound))
        levels, damping = [Level(*level) for level in p.levels], [Damping(*d) for d in p.damping]
        return solve_nullspace(levels, *box, secondary=p.secondary, damping=damping, backend=backend)

    return jax.vmap(one)(p)


def check_active(found: NullSpaceSolution, expected: NullSpaceSolution) -> None:
    """They are the same; where joints on their bounds keep a level from beginning, any of them may be said to."""
    differs = np.asarray(found.active != expected.active)
    assert (expected.scales == 0.0).any(1)[differs.any(1)].all()
    for mine, other in ((found, expected), (expected, found)):
        on = differs & np.asarray(mine.active != 0)
        np.testing.assert_allclose(np.asarray(other.x)[on], 0.4 * np.asarray(mine.active)[on], rtol=1e-12)


def check_derivatives_of_saturation(rng: np.random.Generator, backend: Backend) -> None:
    """They are those of plain JAX, in both modes: of the answer along a motion of all numbers."""
    p = FAMILIES["damped inequalities"]
    way = jax.tree.map(lambda a: 0.1 * rng.normal(size=a.shape) * np.abs(a), p)
    weights = rng.normal(size=p.secondary.shape)

    def rates(backend: Backend):
        def at(t):
            return saturated(jax.tree.map(lambda a, d: a + t * d, p, way), backend=backend).x

        return jax.jvp(at, (0.0,), (1.0,))[1], jax.grad(lambda t: jnp.sum(weights * at(t)))(0.0)

    found, expected = rates(backend), rates("jax")
    size = 1.0 + np.abs(expected[0]).max()
    np.testing.assert_allclose(found[0], expected[0], rtol=0, atol=1e-6 * size)
    np.testing.assert_allclose(found[1], expected[1], rtol=0, atol=1e-6 * size * np.abs(weights).sum())
    assert np.abs(expected[0]).max() > 0.01
