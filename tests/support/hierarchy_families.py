"""Families of hierarchies, drawn by the hundred: seeded NumPy, batched, one shape a group of families."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

VARIABLES = 10
FOUR_LEVELS = (5, 5, 5, 5)
NINE_LEVELS = (2, 3, 0, 1, 2, 2, 3, 2, 2)


class Rows(NamedTuple):
    """One level: rows, their intervals and weights, batched."""

    A: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    weight: np.ndarray


class Hierarchies(NamedTuple):
    """Levels, highest priority first, and the hard box."""

    levels: list[Rows]
    lower: np.ndarray
    upper: np.ndarray


def intervals(rng: np.random.Generator, centre: np.ndarray, inequalities: float) -> tuple[np.ndarray, np.ndarray]:
    """Equalities at the centre, and a share of one-sided and two-sided intervals beside it."""
    lower, upper = centre.copy(), centre.copy()
    kind = rng.random(centre.shape)
    lower = np.where(kind < inequalities / 3.0, -np.inf, lower)
    upper = np.where((kind >= inequalities / 3.0) & (kind < 2.0 * inequalities / 3.0), np.inf, upper)
    two_sided = (kind >= 2.0 * inequalities / 3.0) & (kind < inequalities)
    return lower, np.where(two_sided, upper + rng.exponential(size=centre.shape), upper)


def drawn(
    rng: np.random.Generator,
    count: int,
    sizes: Sequence[int] = FOUR_LEVELS,
    *,
    inequalities: float = 0.0,
    spread: float = 1.5,
    box: float = 1.0,
) -> Hierarchies:
    """Random rows, targets often out of reach, a box of which a part is infinite."""
    levels = []
    for m in sizes:
        A = rng.normal(size=(count, m, VARIABLES))
        low, high = intervals(rng, spread * rng.normal(size=(count, m)), inequalities)
        levels.append(Rows(A, low, high, np.ones((count, m))))
    lower = np.where(rng.random((count, VARIABLES)) < 0.2, -np.inf, -rng.exponential(box, (count, VARIABLES)))
    upper = np.where(rng.random((count, VARIABLES)) < 0.2, np.inf, rng.exponential(box, (count, VARIABLES)))
    return Hierarchies(levels, lower, upper)


def conflicting(rng: np.random.Generator, count: int) -> Hierarchies:
    """Twenty equalities in ten variables: the lower levels cannot all hold."""
    return drawn(rng, count)


def inequality_levels(rng: np.random.Generator, count: int) -> Hierarchies:
    """Equalities and intervals mixed at every level."""
    return drawn(rng, count, inequalities=0.6)


def many_inequalities(rng: np.random.Generator, count: int) -> Hierarchies:
    """Intervals alone: levels hold with room to spare, or fail by one row."""
    return drawn(rng, count, inequalities=1.0)


def dependent(rng: np.random.Generator, count: int) -> Hierarchies:
    """Rows repeated and combined inside levels and across them, with targets that agree or not."""
    p = drawn(rng, count, inequalities=0.3)
    agree = rng.random(count) < 0.5
    above = np.zeros((count, 0, VARIABLES))
    levels = []
    for level in p.levels:
        A = level.A.copy()
        A[:, 1] = rng.choice([-2.0, -1.0, 1.0, 3.0], (count, 1)) * A[:, 0]
        A[:, 2] = A[:, 0] + A[:, 1] - A[:, 3]
        if above.shape[1]:
            A[:, 3] = above[np.arange(count), rng.integers(above.shape[1], size=count)]
            A[:, 4] = np.einsum("bh,bhn->bn", rng.normal(size=above.shape[:2]) / 3.0, above)
        above = np.concatenate([above, A], 1)
        levels.append(level._replace(A=A))
    x = 0.3 * rng.normal(size=(count, VARIABLES))
    for k, level in enumerate(levels[:2]):
        fitting = np.einsum("bmn,bn->bm", level.A, x)
        equal = (level.lower == level.upper) & agree[:, None]
        low, high = np.where(equal, fitting, level.lower), np.where(equal, fitting, level.upper)
        levels[k] = level._replace(lower=low, upper=high)
    return p._replace(levels=levels)


def rescaled(p: Hierarchies, scales: Sequence[np.ndarray]) -> Hierarchies:
    """Rows and their intervals multiplied: (count, 1) a level or (count, m) a row."""
    levels = [
        Rows(s[..., None] * r.A, s * r.lower, s * r.upper, r.weight) for r, s in zip(p.levels, scales, strict=True)
    ]
    return p._replace(levels=levels)


def scaled_between(rng: np.random.Generator, count: int, decades: float = 6.0) -> Hierarchies:
    """Each level in a unit of its own, 1e-6 to 1e6: the answer does not depend on ``decades``."""
    p = drawn(rng, count, inequalities=0.4)
    return rescaled(p, [10.0 ** (decades * rng.uniform(-1, 1, (count, 1))) for _ in p.levels])


def scaled_inside(rng: np.random.Generator, count: int) -> Hierarchies:
    """Rows of one level 1e-2 to 1e2 long, in conflict: like weights 1e-4 to 1e4."""
    p = drawn(rng, count, inequalities=0.4)
    return rescaled(p, [10.0 ** rng.uniform(-2, 2, r.lower.shape) for r in p.levels])


def scaled_within_reach(rng: np.random.Generator, count: int, decades: float = 2.0) -> Hierarchies:
    """Rows 1e-2 to 1e2 long in one level, but all of the first two levels can hold: their lengths do not matter."""
    p = drawn(rng, count, inequalities=0.4, box=3.0)
    x = np.clip(0.3 * rng.normal(size=(count, VARIABLES)), p.lower, p.upper)
    levels = []
    for k, r in enumerate(p.levels):
        if k < 2:
            value = np.einsum("bmn,bn->bm", r.A, x)
            equal = r.lower == r.upper
            low = np.where(equal, value, np.minimum(r.lower, value))
            r = r._replace(lower=low, upper=np.where(equal, value, np.maximum(r.upper, value)))
        levels.append(r)
    scales = [10.0 ** (decades * rng.uniform(-1, 1, (count, 5))) if k < 2 else np.ones((count, 5)) for k in range(4)]
    return rescaled(p._replace(levels=levels), scales)


def weighted(rng: np.random.Generator, count: int) -> Hierarchies:
    """Weights 1e-4 to 1e4 inside levels that conflict; a weight of 0 takes its row out."""
    p = drawn(rng, count, inequalities=0.3)
    levels = []
    for r in p.levels:
        weight = 10.0 ** rng.uniform(-4, 4, r.lower.shape)
        levels.append(r._replace(weight=np.where(rng.random(weight.shape) < 0.1, 0.0, weight)))
    return p._replace(levels=levels)


def pinned(rng: np.random.Generator, count: int) -> Hierarchies:
    """A third of the variables pinned, all of them in every tenth problem."""
    p = drawn(rng, count, inequalities=0.3)
    pins = rng.random(p.lower.shape) < 0.35
    pins[::10] = True
    at = rng.normal(size=pins.shape)
    return p._replace(lower=np.where(pins, at, p.lower), upper=np.where(pins, at, p.upper))


def degenerate(rng: np.random.Generator, count: int) -> Hierarchies:
    """Small whole numbers everywhere: ties, parallel rows, corners where more bounds meet than there are variables."""
    p = drawn(rng, count, inequalities=0.5)
    levels = []
    for r in p.levels:
        A = np.round(rng.normal(scale=0.8, size=r.A.shape))
        width = rng.integers(3, size=r.lower.shape)
        low = np.round(np.where(np.isfinite(r.lower), r.lower, 0.0))
        low = np.where(np.isfinite(r.lower), low, -np.inf)
        high = np.where(r.lower == r.upper, low, np.where(np.isfinite(low), low + width, np.round(r.upper)))
        levels.append(r._replace(A=A, lower=low, upper=np.where(np.isfinite(r.upper), high, np.inf)))
    lower = -np.round(rng.exponential(size=p.lower.shape))
    upper = np.round(rng.exponential(size=p.upper.shape))
    return Hierarchies(levels, lower, upper)


def at_the_corner(rng: np.random.Generator, count: int) -> Hierarchies:
    """Targets that a corner of the box meets exactly: active bounds without multipliers."""
    p = drawn(rng, count, inequalities=0.4)
    lower, upper = -np.ones_like(p.lower), np.ones_like(p.upper)
    corner = rng.choice([-1.0, 1.0], lower.shape) * (rng.random(lower.shape) < 0.8)
    levels = []
    for r in p.levels:
        value = np.einsum("bmn,bn->bm", r.A, corner)
        width = rng.exponential(size=value.shape)
        low = np.where(np.isfinite(r.lower), value, -np.inf)
        high = np.where(r.lower == r.upper, value, np.where(np.isfinite(low), value + width, value))
        levels.append(r._replace(lower=low, upper=np.where(np.isfinite(r.upper), high, np.inf)))
    return Hierarchies(levels, lower, upper)


def empty_levels(rng: np.random.Generator, count: int) -> Hierarchies:
    """The second level has only zero rows, and the last only rows without bounds."""
    p = drawn(rng, count, inequalities=0.3)
    levels = list(p.levels)
    levels[1] = levels[1]._replace(A=np.zeros_like(levels[1].A))
    no_bounds = np.full_like(levels[3].lower, np.inf)
    levels[3] = levels[3]._replace(lower=-no_bounds, upper=no_bounds)
    return p._replace(levels=levels)


SMALL = {
    f.__name__: f
    for f in (
        conflicting,
        inequality_levels,
        many_inequalities,
        dependent,
        scaled_between,
        scaled_inside,
        scaled_within_reach,
        weighted,
        pinned,
        degenerate,
        at_the_corner,
        empty_levels,
    )
}


def many_levels(rng: np.random.Generator, count: int) -> Hierarchies:
    """Nine levels, one of them without rows, equalities and inequalities mixed; whole numbers in a third."""
    p = drawn(rng, count, NINE_LEVELS, inequalities=0.5)
    levels = list(p.levels)
    whole = np.arange(count) % 3 == 0
    for k, r in enumerate(levels):
        A = np.where(whole[:, None, None], np.round(r.A), r.A)
        low, high = (np.where(whole[:, None], np.round(b), b) for b in (r.lower, r.upper))
        levels[k] = r._replace(A=A, lower=low, upper=high)
    return p._replace(levels=levels)
