"""Hundreds of hard hierarchies a family: optimality certificates, level norms by quadprog, and bad numbers."""

import jax
import numpy as np
import pytest
from hierarchy_families import (
    SMALL,
    Hierarchies,
    Rows,
    inequality_levels,
    many_levels,
    rescaled,
    scaled_between,
    scaled_within_reach,
    weighted,
)
from lexicographic import certificate, norms, reference
from recorded import recorded_hierarchies

from osik_jax.solvers import Level, Status, solve_hqp

COUNT = 300


def stretched(rng: np.random.Generator, count: int) -> Hierarchies:
    """The recorded robot's Jacobians near singularity, and targets far out of reach, other than the recorded ones."""
    r = recorded_hierarchies(unit_rows=False)
    lanes = rng.choice(np.flatnonzero(r.kind >= 2), count)
    levels = []
    for k, (A, low, high) in enumerate(r.levels):
        A, low, high = A[lanes], low[lanes], high[lanes]
        far = 10.0 ** rng.uniform(-4, 0, (count, 1)) * rng.normal(size=low.shape) * (k < 3)
        levels.append(Rows(A, low + far, high + far, np.ones_like(low)))
    return Hierarchies(levels, r.lower[lanes], r.upper[lanes])


UNREACHED = ("scaled_inside", "weighted", "scaled_within_reach")
"""Families whose rows differ so much in weight that quadprog with slacks loses the small ones."""
RESIDUAL = {"stretched": 1e-8}
"""Near singularity the certificate's own multipliers lose digits: quadprog's answer gets the same residual."""
FAMILIES = SMALL | {"many_levels": many_levels, "stretched": stretched}
COMPARED = [f for f in FAMILIES if f not in UNREACHED]

batched_hqp = jax.jit(jax.vmap(lambda levels, lower, upper: solve_hqp([Level(*a) for a in levels], lower, upper)))


def solved(p: Hierarchies):
    s = batched_hqp([tuple(r) for r in p.levels], p.lower, p.upper)
    return s, np.asarray(s.x)


@pytest.fixture(scope="module")
def answers():
    """Problem, solution and x of a family, drawn and solved once."""
    known = {}

    def answer(family: str):
        if family not in known:
            p = FAMILIES[family](np.random.default_rng(11), COUNT)
            known[family] = (p, *solved(p))
        return known[family]

    return answer


@pytest.mark.variants(slow=["inequality_levels"], release=["many_levels", "conflicting", "stretched"])
@pytest.mark.parametrize("family", FAMILIES)
def test_every_level_is_certified(family, answers):
    """Each level's gradient is held by multipliers of the levels above; so is x, the gradient of |x|^2 / 2."""
    p, s, x = answers(family)
    assert (np.asarray(s.status) == Status.SOLVED).all()
    assert ((p.lower <= x) & (x <= p.upper)).all()
    assert max(certificate(p, i, x[i]).max() for i in range(COUNT)) < RESIDUAL.get(family, 1e-10)
    for r, w in zip(p.levels, s.slacks, strict=True):
        value = np.einsum("bmn,bn->bm", r.A, x)
        expected = value - np.clip(value, r.lower, r.upper)
        size = np.einsum("bmn,bn->bm", np.abs(r.A), np.abs(x)) + np.abs(np.where(np.isfinite(r.lower), r.lower, 0.0))
        assert (np.abs(w - expected) <= 1e-13 * size).all()


@pytest.mark.variants(slow=["many_levels"])
@pytest.mark.parametrize("family", COMPARED)
def test_level_norms_and_answer_by_quadprog(family, answers):
    p, _, x = answers(family)
    compared = 0
    for i in range(0, COUNT, 5):
        try:
            expected, expected_norms = reference(p, i)
        except ValueError:  # quadprog finds no point: rows of rounding noise at degenerate corners
            continue
        compared += 1
        np.testing.assert_allclose(norms(p, i, x[i]), expected_norms, atol=1e-9)
        np.testing.assert_allclose(x[i], expected, atol=1e-7)
    assert compared >= COUNT / 5 * 0.9


def test_the_certificate_notices_answers_that_are_off(answers, rng):
    p, _, x = answers("conflicting")
    off = np.clip(x + 1e-4 * rng.normal(size=x.shape), p.lower, p.upper)
    assert np.mean([certificate(p, i, off[i]).max() > 1e-6 for i in range(COUNT)]) > 0.95


@pytest.mark.parametrize("family", [scaled_between, scaled_within_reach])
def test_units_of_rows_do_not_matter(family):
    """Where levels are apart or rows can all hold, lengths give the answer of lengths near 1."""
    s, x = solved(family(np.random.default_rng(12), COUNT))
    _, expected = solved(family(np.random.default_rng(12), COUNT, decades=0.0))
    assert (np.asarray(s.status) == Status.SOLVED).all()
    np.testing.assert_allclose(x, expected, atol=1e-9)


def test_weights_are_squared_lengths(answers):
    p, _, x = answers("weighted")
    roots = rescaled(p, [np.where(r.weight > 0.0, np.sqrt(r.weight), 1.0) for r in p.levels])
    levels = []
    for r in roots.levels:
        out = r.weight == 0.0
        low, high = np.where(out, -np.inf, r.lower), np.where(out, np.inf, r.upper)
        levels.append(r._replace(lower=low, upper=high, weight=np.ones_like(r.weight)))
    np.testing.assert_allclose(solved(roots._replace(levels=levels))[1], x, atol=1e-9)


ARGUMENTS = ("A", "lower", "upper", "weight", "box lower", "box upper")
LEGAL = {("lower", -np.inf), ("box lower", -np.inf), ("upper", np.inf), ("box upper", np.inf)}
BAD = [(name, bad) for name in ARGUMENTS for bad in (np.nan, np.inf, -np.inf) if (name, bad) not in LEGAL]


def spoiled(p: Hierarchies, argument: str, bad: float) -> Hierarchies:
    """One number replaced in the second level, or in the box, of lanes 3 and 8."""
    lower, upper = p.lower.copy(), p.upper.copy()
    level = {name: a.copy() for name, a in p.levels[1]._asdict().items()}
    where = {"box lower": lower, "box upper": upper} | level
    for lane in (3, 8):
        where[argument][lane].flat[lane % where[argument][lane].size] = bad
    return Hierarchies([p.levels[0], type(p.levels[1])(**level), *p.levels[2:]], lower, upper)


@pytest.mark.parametrize(("argument", "bad"), BAD)
def test_a_bad_number_harms_its_lane_alone(argument, bad, answers):
    p, good, _ = answers("inequality_levels")
    q = spoiled(p, argument, bad)
    s, x = solved(q)
    lanes = [3, 8]
    assert (np.asarray(s.status)[lanes] == Status.NUMERICAL_ERROR).all()
    others = np.setdiff1d(np.arange(COUNT), lanes)
    for mine, before in zip(jax.tree.leaves(s), jax.tree.leaves(good), strict=True):
        np.testing.assert_array_equal(np.asarray(mine)[others], np.asarray(before)[others])
    assert np.isfinite(x).all()
    assert all(np.isfinite(w).all() for w in s.slacks)
    low, high = q.lower[lanes], q.upper[lanes]
    possible = ~(low > high) & ~(low == np.inf) & ~(high == -np.inf)
    assert (~(x[lanes] < low) & ~(x[lanes] > high))[possible].all()  # nothing to say of a NaN bound


def test_a_lane_alone_is_the_lane_of_the_batch():
    p = inequality_levels(np.random.default_rng(13), COUNT)
    _, x = solved(p)
    one = Hierarchies([type(r)(*(a[:1].repeat(COUNT, 0) for a in r)) for r in p.levels], p.lower[:1], p.upper[:1])
    one = one._replace(lower=one.lower.repeat(COUNT, 0), upper=one.upper.repeat(COUNT, 0))
    np.testing.assert_array_equal(solved(one)[1], x[:1].repeat(COUNT, 0))


def test_weighted_levels_without_a_positive_weight_decide_nothing():
    p = weighted(np.random.default_rng(14), COUNT)
    silent = [r._replace(weight=np.zeros_like(r.weight)) for r in p.levels]
    s, x = solved(p._replace(levels=silent))
    assert (np.asarray(s.status) == Status.SOLVED).all()
    np.testing.assert_array_equal(x, np.clip(0.0, p.lower, p.upper))
