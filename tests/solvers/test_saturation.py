"""Saturation in the null space against linear programs (the scale), NNLS (the smallest answer) and the projection."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from core_checks import needs_core
from hierarchy_families import degenerate
from optimality import outside_cone
from saturation_families import FAMILIES, LANES, ROWS, N, as_levels, drawn, family, solve_full

import osik_jax as osik
from osik_jax.solvers import Level, Status, solve_nullspace
from osik_jax.solvers.null_space import NullSpaceSolution
from osik_jax.solvers.null_space._scaled_motion import ScaledMotion, solve_scaled_motion


class Answers(NamedTuple):
    """Of the first level alone, of the first two, of all, and of all with the secondary motion."""

    partial: list
    full: NullSpaceSolution


def first_levels(p, count):
    """The problem of the first levels alone: rows of the others are 0, so that all have one shape."""
    levels = [pair if k < count else tuple(np.zeros_like(a) for a in pair) for k, pair in enumerate(p.levels)]
    return p._replace(levels=levels, secondary=np.zeros_like(p.secondary))


@pytest.fixture(scope="module")
def solved():
    """Of each family, the problems and the answers, in one compiled program."""
    out = {}
    for k, name in enumerate(FAMILIES):
        p = family(name, np.random.default_rng(100 + k))
        partial = [solve_full(first_levels(p, count)) for count in range(1, len(ROWS) + 1)]
        out[name] = p, jax.tree.map(np.asarray, Answers(partial, solve_full(p)))
    return out


every_family = pytest.mark.parametrize("name", FAMILIES)


def stages(p, answers, i):
    """Level after level of a lane: rows of the levels above, own rows and targets, x before, x after, scale, space."""
    above, x = np.zeros((0, N)), np.clip(np.zeros(N), p.lower[i], p.upper[i])
    space = np.diag((p.lower[i] != p.upper[i]).astype(float))
    for k, (A, b) in enumerate(p.levels):
        after = answers.partial[k]
        yield above, A[i], b[i], x, after.x[i], after.scales[i, k], space
        above, x, space = np.vstack([above, A[i]]), after.x[i], after.projector[i]


def motion(A, b, x, space):
    """Eq. 7 with NumPy's pseudo-inverse."""
    restricted = A @ space
    share = 1e-10 * np.linalg.norm(A) / max(np.linalg.norm(restricted, 2), 1e-300)
    return np.linalg.pinv(restricted, rcond=min(share, 1.0)) @ (b - A @ x)


def size(x):
    """Of the numbers of an answer: near-dependent rows ask for motions of 1e4."""
    return max(1.0, np.abs(x).max())


def largest_scale(above, A, x, d, lower, upper, unit):
    """By a linear program over (y / unit, s): rows above stay, A y = A (x + s d), y in the box, s <= 1."""
    equal = np.vstack([np.hstack([above, np.zeros((len(above), 1))]), np.hstack([A, -(A @ d)[:, None] / unit])])
    answer = scipy.optimize.linprog(
        np.r_[np.zeros(N), -1.0],
        A_eq=equal,
        b_eq=np.r_[above @ x, A @ x] / unit,
        bounds=[*zip(lower / unit, upper / unit, strict=True), (0.0, 1.0)],
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )
    assert answer.status == 0
    return answer.x[-1]


class TestProperties:
    @pytest.mark.variants(release=["easy", "tight"])
    @every_family
    def test_every_answer_is_in_its_box_to_the_last_bit(self, solved, name):
        p, answers = solved[name]
        for answer in (*answers.partial, answers.full):
            assert (answer.x >= p.lower).all()
            assert (answer.x <= p.upper).all()
            np.testing.assert_array_equal(answer.status, Status.SOLVED)

    @pytest.mark.parametrize("name", [name for name in FAMILIES if name != "near-dependent"])
    def test_the_scale_is_the_largest_there_is(self, solved, name):
        """Of each level, given what the levels above fixed; where it is 1 nothing is lost to the bounds.

        Near-dependent rows ask for motions of 1e4, which HiGHS does not tell from infeasible ones.
        """
        p, answers = solved[name]
        scaled = 0
        for i in range(40):
            for above, A, b, x, after, scale, space in stages(p, answers, i):
                d = motion(A, b, x, space)
                unit = size(after)
                expected = largest_scale(above, A, x, d, p.lower[i], p.upper[i], unit)
                assert scale == pytest.approx(expected, abs=1e-7 * unit)
                np.testing.assert_allclose(A @ after, A @ (x + scale * d), rtol=0, atol=1e-9 * unit)
                scaled += scale < 1.0
        assert scaled > (0 if name == "small targets" else 10)

    @every_family
    def test_the_first_level_is_exact_where_a_linear_program_finds_it_feasible(self, solved, name):
        """Where the box holds 0, it keeps its direction too: A x = s b."""
        p, answers = solved[name]
        first = answers.partial[0]
        exact = 0
        for i in range(100):
            A, b = (leaf[i] for leaf in p.levels[0])
            bounds = [*zip(p.lower[i], p.upper[i], strict=True)]
            feasible = scipy.optimize.linprog(np.zeros(N), A_eq=A, b_eq=b, bounds=bounds).status == 0
            error = np.abs(A @ first.x[i] - b).max()
            assert (error < 1e-9 * size(first.x[i])) == feasible
            if name in ("easy", "tight", "small targets", "near-dependent"):
                off = A @ first.x[i] - first.scales[i, 0] * b
                assert np.abs(off).max() < 1e-9 * size(first.x[i])
            exact += feasible
        assert exact > (0 if name == "near-dependent" else 10)

    @every_family
    def test_lower_levels_do_not_disturb_higher_ones(self, solved, name):
        p, answers = solved[name]
        for k, (A, _) in enumerate(p.levels):
            kept = np.einsum("imn,in->im", A, answers.partial[k].x)
            for later in (*answers.partial[k + 1 :], answers.full):
                off = np.abs(np.einsum("imn,in->im", A, later.x) - kept).max(1)
                assert all(off[i] < 1e-9 * size(later.x[i]) for i in range(LANES))

    @every_family
    def test_of_all_such_answers_it_is_the_smallest_or_the_nearest_to_the_secondary_motion(self, solved, name):
        """The gradient is held by rows and by bounds with multipliers of the right sign."""
        p, answers = solved[name]
        eye = np.eye(N)
        for i in range(60):
            low, high = p.lower[i], p.upper[i]
            pinned = low == high
            ends = [(answer.x[i], 0.0) for answer in answers.partial] + [(answers.full.x[i], p.secondary[i])]
            rows = [A[i] for A, _ in p.levels]
            for k, (x, target) in enumerate(ends):
                equal = np.vstack([*rows[: k + 1], eye[pinned]])
                at_low, at_high = ~pinned & (x <= low + 1e-9), ~pinned & (x >= high - 1e-9)
                assert outside_cone(x - target, equal, eye[at_low], eye[at_high]) < 1e-8 * size(x)

    @every_family
    def test_joints_that_stop_a_level_can_move_no_more(self, solved, name):
        """What the projector leaves out beside the rows: linear programs find no way to move it."""
        p, answers = solved[name]
        first = answers.partial[0]
        lanes = [i for i in range(LANES) if first.scales[i, 0] < 1.0][:8]
        for i in lanes:
            x, low, high = first.x[i], p.lower[i], p.upper[i]
            equal = p.levels[0][0][i]
            stopped = (first.active[i] != 0) & (low != high) & (np.abs(first.projector[i]).max(1) == 0.0)
            assert stopped.any()
            for joint in np.flatnonzero(stopped):
                for sign in (-1.0, 1.0):
                    move = scipy.optimize.linprog(
                        sign * np.eye(N)[joint], A_eq=equal, b_eq=equal @ x, bounds=[*zip(low, high, strict=True)]
                    )
                    assert move.status == 0
                    assert move.x[joint] == pytest.approx(x[joint], abs=1e-6)

    def test_is_the_projection_where_nothing_saturates(self, solved):
        """With bounds that are far, and with bounds that are near but not reached."""
        p = solved["easy"][0]
        wide = p._replace(lower=np.full_like(p.lower, -np.inf), upper=np.full_like(p.upper, np.inf))
        free = jax.vmap(lambda q: solve_nullspace(as_levels(q.levels), secondary=q.secondary))(p)
        near = p._replace(
            lower=np.minimum(np.asarray(free.x) - 1e-3, -1e3), upper=np.maximum(np.asarray(free.x) + 1e-3, 1e3)
        )
        for bounds in (wide, near):
            answers = solve_full(bounds)
            np.testing.assert_allclose(answers.x, free.x, rtol=0, atol=1e-10)
            np.testing.assert_allclose(answers.projector, free.projector, rtol=0, atol=1e-10)
            np.testing.assert_array_equal(answers.scales, 1.0)
            np.testing.assert_array_equal(answers.active, 0)


BY_HAND = {
    "one joint saturates and another takes over": ([2, 0], [-0.5, -3, -1], [0.5, 3, 1], [0.5, 1.5, 0], [1, 0, 0], 1),
    "two joints pull at what is out of reach": ([3, 1], [-1, -1, -1], [1, 1, 1], [1, 1, 2 / 3], [1, 1, 0], 2 / 3),
    "pinned joints leave the others to do the work": ([1, 1], [0.3, -5, 0], [0.3, 5, 0], [0.3, 0.7, 0], [2, 0, 2], 1),
    "a joint outside its range comes back": ([0, 0], [0.4, -1, -1], [1, 1, 1], [0.4, -0.4, 0], [-1, 0, 0], 1),
}


@jax.jit
def two_rows(wanted, lower, upper):
    return solve_nullspace([Level([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]], wanted)], lower, upper)


class TestByHand:
    @pytest.mark.parametrize("name", BY_HAND)
    def test_two_rows_of_three_joints(self, name):
        wanted, lower, upper, x, active, scale = (np.asarray(a, float) for a in BY_HAND[name])
        answer = two_rows(wanted, lower, upper)
        np.testing.assert_allclose(answer.x, x, rtol=0, atol=1e-15)
        np.testing.assert_array_equal(answer.active, active)
        assert float(answer.scales[0]) == pytest.approx(scale, abs=1e-15)
        np.testing.assert_allclose(answer.slacks[0], [x[0] + x[1] - wanted[0], x[2] - wanted[1]], rtol=0, atol=1e-15)

    @pytest.mark.variants(release=["3e-08-False"])
    @pytest.mark.parametrize("entry, moves", [(3e-8, False), (3e-6, True)])
    def test_a_joint_that_moves_the_task_by_rounding_alone_is_at_rest(self, entry, moves):
        """In single precision; the largest scale takes what any other joint can add, however little."""
        A, wanted = jnp.array([[1.0, 0.5, entry]], jnp.float32), jnp.array([10.0], jnp.float32)
        bound = jnp.ones(3, jnp.float32)
        answer = jax.jit(lambda A: solve_nullspace([Level(A, wanted)], -bound, bound))(A)
        np.testing.assert_array_equal(answer.x, [1.0, 1.0, float(moves)])

    @pytest.mark.variants(slow=["auto"], release=["jax"])
    @pytest.mark.parametrize("backend", ["jax", "auto"])
    def test_joints_at_their_bounds_in_zero_stop_a_level_at_the_scale_0(self, backend):
        """x is 0 and nothing moves: the numbers that x is made of have no size that roundoff is small beside."""
        p = degenerate(np.random.default_rng(0), 64)

        def one(p):
            return solve_nullspace([Level(*level) for level in p.levels], p.lower, p.upper, backend=backend)

        answer = jax.jit(jax.vmap(one))(p)
        np.testing.assert_array_equal(answer.status, Status.SOLVED)
        assert ((np.abs(answer.x).max(1) == 0.0) & (np.asarray(answer.scales)[:, 0] == 0.0)).any()

    @pytest.mark.variants(slow=["auto"], release=["jax"])
    @pytest.mark.parametrize("backend", ["jax", "auto"])
    def test_levels_without_a_null_space_keep_those_above_to_rounding(self, backend):
        """Ten rows in ten variables; joints at their bounds then stop the second level, and nothing is left to move."""
        rng, lanes = np.random.default_rng(3), 300
        A, b = rng.normal(size=(2, lanes, 5, N)), 1.5 * rng.normal(size=(2, lanes, 5))
        lower, upper = -rng.exponential(1.0, (lanes, N)), rng.exponential(1.0, (lanes, N))

        def one(A, b, lower, upper):
            levels = [Level(A[0], b[0]), Level(A[1], b[1])]
            return (solve_nullspace(levels[:k], lower, upper, backend=backend) for k in (1, 2))

        first, second = jax.jit(jax.vmap(lambda *p: tuple(one(*p)), (1, 1, 0, 0)))(A, b, lower, upper)
        np.testing.assert_array_equal(second.status, Status.SOLVED)
        stopped = np.asarray(second.scales[:, 1]) < 1e-6
        assert stopped.sum() > 50
        off = np.abs(np.einsum("bmn,bn->bm", A[0], np.asarray(second.x - first.x))).max(1)
        assert off[stopped].max() < 1e-12

    @pytest.mark.slow
    def test_one_sided_bounds(self):
        level = [Level([[1.0, 1.0]], [-4.0])]
        for bound in (dict(lower=np.array([-1.0, -9.0])), dict(upper=np.array([1.0, -3.0]))):
            np.testing.assert_allclose(solve_nullspace(level, **bound).x, [-1.0, -3.0], rtol=0, atol=1e-14)


class TestSearch:
    """Hard problems: scale, answer and the joints at their bounds against a linear program and NNLS."""

    @staticmethod
    def problems(rng, count=60, n=9, free=5, small=1e-3):
        """Null spaces in which some joints hardly move, alone or but for others; motions far beyond the box."""
        axes = rng.normal(size=(count, n, free))
        axes[:, :2] *= small
        axes[:, 2] = axes[:, 3] + small * axes[:, 2]
        basis = np.linalg.qr(axes)[0]
        projector = basis @ np.swapaxes(basis, 1, 2)
        motion = 30.0 * rng.normal(size=(count, n))
        motion -= np.einsum("imn,in->im", projector, motion)
        lower, upper = -rng.exponential(1.0, (count, n)), rng.exponential(1.0, (count, n))
        start = np.where(rng.random((count, n)) < 0.3, lower, 0.0)  # on bounds of its box
        return ScaledMotion(*map(jnp.asarray, (start, motion, np.zeros((count, n)), projector, lower, upper)))

    @pytest.mark.parametrize("small", [1.0, 1e-2])
    def test_the_scale_is_a_linear_programs(self, rng, small):
        problem = self.problems(rng, small=small)
        found = jax.tree.map(np.asarray, jax.jit(partial(solve_scaled_motion, max_iterations=200))(problem))
        assert found.done.all()
        assert ((found.x >= problem.lower) & (found.x <= problem.upper)).all()
        for i in range(len(found.x)):
            start, motion, _, projector, lower, upper = (np.asarray(part[i]) for part in problem)
            n, eye = len(start), np.eye(len(start))
            left = eye - projector  # of x, what the null space does not change
            best = scipy.optimize.linprog(
                np.r_[np.zeros(n), -1.0],
                A_eq=np.hstack([left, -(left @ motion)[:, None]]),
                b_eq=left @ start,
                bounds=[*zip(lower, upper, strict=True), (0.0, 1.0)],
                options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
            )
            assert best.status == 0
            assert found.scale[i] == pytest.approx(best.x[-1], abs=1e-7)
            np.testing.assert_allclose(left @ (found.x[i] - start - found.scale[i] * motion), 0.0, atol=1e-9)
            at_low, at_high = found.x[i] <= lower + 1e-9, found.x[i] >= upper - 1e-9
            assert outside_cone(found.x[i], left, eye[at_low], eye[at_high]) < 1e-6 * size(found.x[i])


class TestBatchesAndFailures:
    def test_a_bad_lane_stays_in_its_lane(self, solved):
        """NaN and infinity in matrix, target and secondary motion; a NaN bound; bounds that cross."""
        p, answers = solved["tight"]
        p = jax.tree.map(np.copy, p)
        p.levels[1][0][1, 0, 0] = np.nan
        p.levels[0][1][2, 1] = np.inf
        p.secondary[3, 0] = np.nan
        p.lower[4, 0], p.lower[4, 1] = np.nan, 0.25
        p.lower[5, 2], p.upper[5, 2] = 1.0, 0.5
        p.upper[6, 3] = -np.inf
        got = jax.tree.map(np.asarray, solve_full(p))
        bad = np.arange(1, 7)
        assert (got.status[bad] == np.where(bad == 5, Status.INFEASIBLE, Status.NUMERICAL_ERROR)).all()
        low, high = p.lower[bad[:3]], p.upper[bad[:3]]
        np.testing.assert_array_equal(got.x[bad[:3]], np.clip(0.0, low, high))
        assert got.x[4, 1] == 0.25
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(got))
        others = np.setdiff1d(np.arange(LANES), bad)
        np.testing.assert_array_equal(got.status[others], Status.SOLVED)
        np.testing.assert_array_equal(got.x[others], answers.full.x[others])

    @pytest.mark.slow
    def test_a_search_that_is_cut_short_says_so_and_keeps_box_and_levels_above(self, solved):
        """Levels that were not finished do nothing; those before them stay."""
        p, answers = solved["tight"]
        cut = jax.jit(jax.vmap(lambda q: solve_nullspace(as_levels(q.levels[:2]), q.lower, q.upper, max_iterations=6)))(
            p
        )
        unfinished = np.asarray(cut.status) == Status.MAX_ITERATIONS
        assert 20 < unfinished.sum() < LANES
        assert ((cut.x >= p.lower) & (cut.x <= p.upper)).all()
        second = unfinished & (np.asarray(cut.scales)[:, 0] > 0.0)
        assert second.any()
        np.testing.assert_allclose(cut.x[second], answers.partial[0].x[second], rtol=0, atol=1e-12)

    @pytest.mark.slow
    def test_single_precision(self, solved):
        """In its box to the last bit there too; the first level's rows within 1e-3 of the largest (median 1e-6)."""
        for name in ("easy", "tight", "small targets", "pinned"):
            p, answers = solved[name]
            with jax.enable_x64(False):
                narrow = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), p)
                got = jax.tree.map(np.asarray, solve_full(narrow))
            assert got.x.dtype == np.float32
            assert (got.x >= narrow.lower).all()
            assert (got.x <= narrow.upper).all()
            good = got.status == Status.SOLVED
            assert good.mean() > 0.98
            np.testing.assert_allclose(got.scales[good, 0], answers.full.scales[good, 0], rtol=0, atol=1e-4)
            off = np.abs(np.einsum("imn,in->im", p.levels[0][0], got.x - answers.full.x)).max(1)
            off = (off / np.abs(p.levels[0][1]).max(1))[good]
            assert np.median(off) < 1e-6
            assert off.max() < 1e-3

    def test_mistakes(self):
        level = [Level(np.ones((1, 3)), np.ones(1))]
        with pytest.raises(ValueError, match="method is 'sideways'; methods: classical, saturated"):
            osik.NullSpace(method=cast(Any, "sideways"))
        with pytest.raises(ValueError, match=r"upper has shape \(2,\); the levels ask for \(3,\)"):
            solve_nullspace(level, -np.ones(3), np.ones(2))


@pytest.mark.release
def test_derivatives_are_finite_where_there_is_none(rng):
    """Zero targets, rows of zeros, everything pinned, weights of 0, dependent levels, edges, failed lanes."""
    p = drawn(rng, 8)
    p = p._replace(levels=p.levels[1:])
    weights = [rng.uniform(0.5, 2.0, (8, m)) for m in ROWS[1:]]
    p.levels[0][1][0] = 0.0
    p.levels[0][0][1] = 0.0
    p.lower[2] = p.upper[2] = 0.0
    weights[0][3] = 0.0
    p.levels[1][0][4, :2] = p.levels[0][0][4]
    p.lower[5] = 0.0
    p.lower[6], p.upper[6] = 1.0, -1.0
    p.levels[1][0][7, 0, 0] = np.nan

    def cost(p, weights, damping):
        levels = [Level(A, b, b, w) for (A, b), w in zip(p.levels, weights, strict=True)]
        answer = solve_nullspace(levels, p.lower, p.upper, secondary=p.secondary, damping=damping)
        return jnp.sum(jnp.sin(answer.x)) + jnp.sum(answer.scales)

    rates = jax.jit(jax.vmap(jax.grad(cost, (0, 1, 2))))(p, weights, np.repeat([0.0, 1e-2], 4))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(rates))
    but_the_box = rates[0]._replace(lower=(), upper=()), *rates[1:]  # the answer of a failed lane is 0, clipped
    assert all((np.asarray(leaf)[7] == 0.0).all() for leaf in jax.tree.leaves(but_the_box))


@partial(jax.jit, static_argnames="backend")
def one_row_with_its_derivative(wanted, lower, upper, *, backend):
    """The answer of a level that asks for 8 x - y, and the derivative of (x, y) with respect to what it asks for."""

    def solved(wanted):
        level = Level(jnp.array([[8.0, -1.0]]), wanted, wanted)
        answer = solve_nullspace([level], lower, upper, backend=backend)
        return answer.x, answer

    derivative, answer = jax.jacfwd(solved, has_aux=True)(wanted)
    return answer, derivative


@pytest.mark.variants(slow=["core-1e-07"], release=["jax-1e-07", "core-0.1", "jax-0.1"])
@pytest.mark.parametrize("excess", [0.1, 1e-7])
@pytest.mark.parametrize("backend", ["jax", pytest.param("core", marks=needs_core)])
def test_joints_at_bounds_where_the_whole_motion_ends_do_not_stop_it(backend, excess):
    """In closed form: the level asks 8 x - y = 65, x ends at its bound, and y = 8 x - 65 but for roundoff at its own.

    What y is beyond its bound is more than roundoff of the numbers, and less than that of the scale, which falls by a
    65th of it. So nothing is blocked, and y follows what is asked. Without bounds x is 8, beyond its bound by
    ``excess``: a larger and a smaller multiplier of that bound.
    """
    x = 8.0 - excess
    y = 8.0 * x - 65.0
    lower, upper = jnp.array([-jnp.inf, y + 1.2e-10]), jnp.array([x, jnp.inf])
    answer, derivative = one_row_with_its_derivative(jnp.array([65.0]), lower, upper, backend=backend)
    assert answer.status == Status.SOLVED
    np.testing.assert_allclose(answer.x, [x, y], atol=1e-9)
    np.testing.assert_allclose(answer.scales, 1.0, atol=1e-11)
    np.testing.assert_allclose(derivative[:, 0], [0.0, -1.0], atol=1e-9)
