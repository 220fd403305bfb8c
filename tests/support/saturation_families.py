"""Families of random levels in boxes, for saturation in the null space: seeded NumPy, batched, one shape for all."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from osik_jax.solvers import Level, solve_nullspace

N, ROWS, LANES = 10, (3, 2, 3), 200
FAMILIES = ("easy", "tight", "small targets", "box beside zero", "pinned", "conflicting", "near-dependent", "ties")


class Problems(NamedTuple):
    """A batch: levels as (matrix, wanted) pairs, a box, and a secondary motion."""

    levels: list
    lower: np.ndarray
    upper: np.ndarray
    secondary: np.ndarray


def drawn(rng, count=LANES, spread=1.5, infinite=0.15):
    """Targets often out of reach; a share ``infinite`` of the bounds."""
    levels = [(rng.normal(size=(count, m, N)), spread * rng.normal(size=(count, m))) for m in ROWS]
    shape = (count, N)
    lower = np.where(rng.random(shape) < infinite, -np.inf, -rng.exponential(1.0, shape))
    upper = np.where(rng.random(shape) < infinite, np.inf, rng.exponential(1.0, shape))
    return Problems(levels, lower, upper, rng.normal(size=shape))


def family(name, rng):
    """The problems of a family by name."""
    p = drawn(
        rng, spread={"tight": 5.0, "small targets": 0.3}.get(name, 1.5), infinite=0.0 if name == "tight" else 0.15
    )
    if name in ("box beside zero", "pinned"):
        move = 0.5 * rng.normal(size=p.lower.shape)
        p = p._replace(lower=p.lower + move, upper=p.upper + move)
    if name == "pinned":
        pin, place = rng.random(p.lower.shape) < 0.25, rng.normal(size=p.lower.shape)
        p = p._replace(lower=np.where(pin, place, p.lower), upper=np.where(pin, place, p.upper))
    if name == "conflicting":
        p.levels[1][0][:] = p.levels[0][0][:, :2]
        p.levels[2][0][:, 0] = p.levels[0][0].sum(1)
    if name == "near-dependent":
        p.levels[0][0][:, 2] = p.levels[0][0][:, 0] + 1e-5 * p.levels[0][0][:, 2]
    if name == "ties":
        levels = [
            (rng.integers(-1, 2, A.shape).astype(float), rng.integers(-3, 4, b.shape).astype(float))
            for A, b in p.levels
        ]
        p = Problems(levels, -np.ones_like(p.lower), np.ones_like(p.upper), np.round(p.secondary))
    return p


def as_levels(pairs):
    """Equality levels of (matrix, wanted) pairs."""
    return [Level(matrix, wanted, wanted) for matrix, wanted in pairs]


@partial(jax.jit, static_argnames="backend")
def solve_full(p, *, backend="auto"):
    """Everything, by one backend."""

    def one(p):
        return solve_nullspace(as_levels(p.levels), p.lower, p.upper, secondary=p.secondary, backend=backend)

    return jax.vmap(one)(p)
