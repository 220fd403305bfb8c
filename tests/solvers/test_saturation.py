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
from task_checks import kinematics_at

import osik_jax as osik
from osik_jax.solvers import Level, Status, solve_nullspace
from osik_jax.solvers.null_space import NullSpaceSolution
from osik_jax.solvers.null_space._scaled_motion import ScaledMotion, solve_scaled_motion

N, ROWS, LANES = 10, (3, 2, 3), 200
FAMILIES = ("easy", "tight", "small targets", "box beside zero", "pinned", "conflicting", "near-dependent", "ties")


class Problems(NamedTuple):
    """A batch: levels as (matrix, wanted) pairs, a box, and a secondary motion."""

    levels: list
    lower: np.ndarray
    upper: np.ndarray
    secondary: np.ndarray


class Answers(NamedTuple):
    """Of the first level alone, of the first two, of all, and of all with the secondary motion."""

    partial: list
    full: NullSpaceSolution


def drawn(rng, count=LANES, spread=1.5, box=1.0, infinite=0.15):
    levels = [(rng.normal(size=(count, m, N)), spread * rng.normal(size=(count, m))) for m in ROWS]
    shape = (count, N)
    lower = np.where(rng.random(shape) < infinite, -np.inf, -rng.exponential(box, shape))
    upper = np.where(rng.random(shape) < infinite, np.inf, rng.exponential(box, shape))
    return Problems(levels, lower, upper, rng.normal(size=shape))


def family(name, rng):
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
    return [Level(matrix, wanted, wanted) for matrix, wanted in pairs]


@jax.jit
@jax.vmap
def solve_all(p):
    partial = [solve_nullspace(as_levels(p.levels[: k + 1]), p.lower, p.upper) for k in range(len(p.levels))]
    return Answers(partial, solve_nullspace(as_levels(p.levels), p.lower, p.upper, secondary=p.secondary))


@partial(jax.jit, static_argnames="backend")
def solve_full(p, *, backend="auto"):
    """Everything, by one backend."""

    def one(p):
        return solve_nullspace(as_levels(p.levels), p.lower, p.upper, secondary=p.secondary, backend=backend)

    return jax.vmap(one)(p)


@pytest.fixture(scope="module")
def solved():
    """Of each family, the problems and the answers, in one compiled program."""
    out = {}
    for k, name in enumerate(FAMILIES):
        p = family(name, np.random.default_rng(100 + k))
        out[name] = p, jax.tree.map(np.asarray, solve_all(p))
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
        p, answers = solved[name]
        first = answers.partial[0]
        exact = 0
        for i in range(100):
            A, b = (leaf[i] for leaf in p.levels[0])
            bounds = [*zip(p.lower[i], p.upper[i], strict=True)]
            feasible = scipy.optimize.linprog(np.zeros(N), A_eq=A, b_eq=b, bounds=bounds).status == 0
            error = np.abs(A @ first.x[i] - b).max()
            assert (error < 1e-9 * size(first.x[i])) == feasible
            exact += feasible
        assert exact > (0 if name == "near-dependent" else 10)

    @pytest.mark.parametrize("name", ["easy", "tight", "small targets", "near-dependent"])
    def test_the_first_level_keeps_its_direction(self, solved, name):
        """The box holds 0: A x = s b."""
        p, answers = solved[name]
        A, b = p.levels[0]
        first = answers.partial[0]
        off = np.abs(np.einsum("imn,in->im", A, first.x) - first.scales * b).max(1)
        assert all(off[i] < 1e-9 * size(first.x[i]) for i in range(LANES))

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

    @needs_core
    @pytest.mark.variants(release=["easy", "tight"])
    @pytest.mark.parametrize("name", FAMILIES)
    def test_the_kernel_and_the_plain_method_decide_alike(self, solved, name):
        """The same answer in every lane. Joints that one of them holds at a bound are there in the other, held or not.

        Where a level asks for rounding alone, as it may where joints tie, it has any scale.
        """
        p = solved[name][0]
        found, expected = (jax.tree.map(np.asarray, solve_full(p, backend=backend)) for backend in ("auto", "jax"))
        np.testing.assert_array_equal(found.status, Status.SOLVED)
        np.testing.assert_array_equal(expected.status, Status.SOLVED)
        largest = 1.0 + np.abs(expected.x).max(1)
        assert (np.abs(found.x - expected.x).max(1) < 1e-8 * largest).all()
        near = np.abs(found.scales - expected.scales) < 1e-9
        assert near.all() or (name == "ties" and near.mean() > 0.99)
        np.testing.assert_allclose(found.projector, expected.projector, rtol=0, atol=1e-9)
        for mine, other in ((found, expected), (expected, found)):
            bound = np.where(mine.active > 0, p.upper, p.lower)
            assert (np.abs(other.x - bound) < 1e-8 * largest[:, None])[mine.active != 0].all()

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

    def test_permuting_the_joints_permutes_the_answer(self, solved, rng):
        p, answers = solved["tight"]
        order = rng.permutation(N)
        mixed = Problems(
            [(A[..., order], b) for A, b in p.levels], p.lower[:, order], p.upper[:, order], p.secondary[:, order]
        )
        np.testing.assert_allclose(solve_full(mixed).x, answers.full.x[:, order], rtol=0, atol=1e-9)


class TestByHand:
    def test_one_joint_saturates_and_another_takes_over(self):
        answer = solve_nullspace([Level([[1.0, 1.0]], [2.0])], jnp.array([-0.5, -3.0]), jnp.array([0.5, 3.0]))
        np.testing.assert_allclose(answer.x, [0.5, 1.5], rtol=0, atol=1e-15)
        assert answer.active.tolist() == [1, 0]
        assert answer.scales.tolist() == [1.0]

    def test_a_task_out_of_reach_is_scaled(self):
        """(3, 1) with three joints of one metre a second: two pull in x, one in y."""
        rows = jnp.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        answer = solve_nullspace([Level(rows, [3.0, 1.0])], -jnp.ones(3), jnp.ones(3))
        np.testing.assert_allclose(answer.x, [1.0, 1.0, 2.0 / 3.0], rtol=0, atol=1e-15)
        assert float(answer.scales[0]) == pytest.approx(2.0 / 3.0, abs=1e-15)
        np.testing.assert_allclose(answer.slacks[0], [-1.0, -1.0 / 3.0], rtol=0, atol=1e-15)

    @pytest.mark.variants(release=["3e-08-False"])
    @pytest.mark.parametrize("entry, moves", [(3e-8, False), (3e-6, True)])
    def test_a_joint_that_moves_the_task_by_rounding_alone_is_at_rest(self, entry, moves):
        """In single precision; the largest scale takes what any other joint can add, however little."""
        A, wanted = jnp.array([[1.0, 0.5, entry]], jnp.float32), jnp.array([10.0], jnp.float32)
        bound = jnp.ones(3, jnp.float32)
        answer = solve_nullspace([Level(A, wanted)], -bound, bound)
        np.testing.assert_array_equal(answer.x, [1.0, 1.0, float(moves)])

    @pytest.mark.slow
    def test_saturated_joints_are_released_for_a_larger_scale(self):
        """A search that only saturates, the most critical joint first, ends at a scale of 0.75 here."""
        rows, wanted = np.array([[0.0, 1.0, -2.0, -2.0], [-2.0, 1.0, 0.0, 1.0]]), np.array([4.0, 2.0])
        lower, upper = np.full(4, -0.5), np.array([0.5, 1.5, 0.5, 0.5])
        answer = solve_nullspace([Level(rows, wanted)], jnp.asarray(lower), jnp.asarray(upper))
        d = np.linalg.pinv(rows) @ wanted
        best = scipy.optimize.linprog(
            np.r_[np.zeros(4), -1.0],
            A_eq=np.hstack([rows, -(rows @ d)[:, None]]),
            b_eq=np.zeros(2),
            bounds=[*zip(lower, upper, strict=True), (0.0, 1.0)],
        )
        assert best.x[-1] == pytest.approx(0.875, abs=1e-12)
        assert float(answer.scales[0]) == pytest.approx(0.875, abs=1e-14)
        np.testing.assert_allclose(rows @ np.asarray(answer.x), 0.875 * wanted, rtol=0, atol=1e-14)

    def test_what_pins_a_joint_leaves_the_others_to_do_the_work(self):
        """A pinned joint moves as its bounds say, and does not scale the level that would need it elsewhere."""
        rows = jnp.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        low, high = jnp.array([0.3, -5.0, 0.0]), jnp.array([0.3, 5.0, 0.0])
        answer = solve_nullspace([Level(rows, [1.0, 1.0])], low, high)
        np.testing.assert_allclose(answer.x, [0.3, 0.7, 0.0], rtol=0, atol=1e-15)
        assert answer.active.tolist() == [2, 0, 2]
        assert answer.scales.tolist() == [1.0]

    def test_a_joint_outside_its_range_comes_back_and_the_task_goes_on(self):
        """Joint 0 has to move at 0.4 at least."""
        answer = solve_nullspace([Level([[1.0, 1.0]], [0.0])], jnp.array([0.4, -1.0]), jnp.array([1.0, 1.0]))
        np.testing.assert_allclose(answer.x, [0.4, -0.4], rtol=0, atol=1e-15)

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

    @pytest.mark.slow
    def test_the_secondary_motion_goes_as_far_as_bounds_and_levels_allow(self):
        answer = solve_nullspace(
            [Level([[1.0, 1.0, 1.0]], [0.0])], -jnp.ones(3), jnp.ones(3), secondary=jnp.array([3.0, 1.0, -1.0])
        )
        np.testing.assert_allclose(answer.x, [1.0, 0.0, -1.0], rtol=0, atol=1e-15)


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
    @pytest.mark.slow
    def test_vmap_equals_a_loop(self, solved):
        p, answers = solved["pinned"]
        one = jax.jit(lambda q: solve_nullspace(as_levels(q.levels), q.lower, q.upper, secondary=q.secondary))
        for i in range(10):
            alone = one(jax.tree.map(lambda a, i=i: jnp.asarray(a[i]), p))
            for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(answers.full), strict=True):
                np.testing.assert_allclose(a, b[i], rtol=0, atol=1e-12)

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
        level, wrong = [Level(np.ones((1, 3)), np.ones(1))], cast(Any, "backward")
        with pytest.raises(ValueError, match="order is 'backward'; orders: forward, reverse"):
            solve_nullspace(level, order=wrong)
        with pytest.raises(ValueError, match="bounds need order='forward'"):
            solve_nullspace(level, -np.ones(3), np.ones(3), order="reverse")
        with pytest.raises(ValueError, match=r"upper has shape \(2,\); the levels ask for \(3,\)"):
            solve_nullspace(level, -np.ones(3), np.ones(2))


@pytest.mark.slow
class TestDerivatives:
    """300 random cases, most of them saturated and scaled: two levels and a secondary motion."""

    MIX = np.random.default_rng(8).normal(size=N)

    @classmethod
    def cost(cls, data):
        p, weights, damping = data
        levels = [Level(A, b, b, w) for (A, b), w in zip(p.levels, weights, strict=True)]
        answer = solve_nullspace(levels, p.lower, p.upper, secondary=p.secondary, damping=damping)
        value = jnp.sum(jnp.sin(cls.MIX * answer.x)) + jnp.sum(answer.scales)
        return value, (answer.active, answer.scales < 1.0)

    @pytest.fixture(scope="class")
    @staticmethod
    def data():
        rng = np.random.default_rng(7)
        p = drawn(rng, 300)
        move = 0.3 * rng.normal(size=p.lower.shape)
        pin = rng.random(p.lower.shape) < 0.1
        low, high = p.lower + move, p.upper + move
        p = p._replace(levels=p.levels[1:], lower=np.where(pin, move, low), upper=np.where(pin, move, high))
        damping = np.where(rng.random(300) < 0.5, 0.0, 1e-2)
        data = p, [rng.uniform(0.5, 2.0, (300, m)) for m in ROWS[1:]], damping
        along = jax.tree.map(lambda a: np.where(np.isfinite(a), rng.normal(size=a.shape), 0.0), data)
        along = along[0]._replace(upper=np.where(pin, along[0].lower, along[0].upper)), along[1], damping * along[2]
        return data, along

    @pytest.fixture(scope="class")
    @classmethod
    def gradient(cls):
        return jax.jit(jax.vmap(jax.grad(cls.cost, has_aux=True)))

    @pytest.mark.release
    def test_in_both_modes_they_are_central_differences(self, data, gradient):
        """In matrices, targets, weights, bounds, secondary motion and damping; to fourth order."""
        data, along = data

        @jax.jit
        @jax.vmap
        def forward(data, along):
            return jax.jvp(self.cost, (data,), (along,), has_aux=True)

        def at(t):
            moved = jax.tree.map(lambda a, b: np.where(np.isfinite(a), a + t * b, a), data, along)
            return jax.tree.map(np.asarray, forward(moved, along))

        h = 1e-5
        points = {k: at(k * h) for k in (-2, -1, 0, 1, 2)}
        _, ahead, (active, scaled) = points[0]
        smooth = np.ones(300, bool)
        for _, _, (its_active, its_scaled) in points.values():
            smooth &= (its_active == active).all(1) & (its_scaled == scaled).all(1)
        expected = sum(c * points[k][0] for k, c in ((-2, 1.0), (-1, -8.0), (1, 8.0), (2, -1.0))) / (12.0 * h)
        rates = jax.tree.map(np.asarray, gradient(data)[0])
        back = sum(
            np.sum((g * v).reshape(300, -1), 1)
            for g, v in zip(jax.tree.leaves(rates), jax.tree.leaves(along), strict=True)
        )
        assert smooth.sum() > 290
        assert scaled.any(1).sum() > 100
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(rates))
        size = 1.0 + np.abs(expected)
        assert np.max((np.abs(ahead - expected) / size)[smooth]) < 1e-6
        assert np.max(np.abs(ahead - back) / size) < 1e-8

    @pytest.mark.release
    def test_they_are_finite_where_there_is_none(self, data, gradient):
        """Zero targets, rows of zeros, everything pinned, weights of 0, dependent levels, edges, failed lanes."""
        p, weights, damping = jax.tree.map(np.copy, data[0])
        p.levels[0][1][0] = 0.0
        p.levels[0][0][1] = 0.0
        p.lower[2] = p.upper[2] = 0.0
        weights[0][3] = 0.0
        p.levels[1][0][4, :2] = p.levels[0][0][4]
        p.lower[5] = 0.0
        p.lower[6], p.upper[6] = 1.0, -1.0
        p.levels[1][0][7, 0, 0] = np.nan
        rates = gradient((p, weights, damping))[0]
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(rates))
        but_the_box = rates[0]._replace(lower=(), upper=()), *rates[1:]  # the answer of a failed lane is 0, clipped
        assert all((np.asarray(leaf)[7] == 0.0).all() for leaf in jax.tree.leaves(but_the_box))


class TestScheme:
    """Through ``osik_jax.solve``: both options of ``NullSpace``."""

    @pytest.fixture(scope="class")
    @staticmethod
    def arm():
        return osik.load_robot("arm7")

    @pytest.fixture(scope="class")
    @staticmethod
    def tasks(arm):
        p, R = kinematics_at(arm, arm.q0).frame_pose(arm, "hand")
        height = osik.FrameTask(arm, "hand", rows=(False, False, True, False, False, False), priority=1)
        far = p + jnp.array([0.3, 0.0, 0.0]), R
        return {"height": height, "hand": osik.FrameTask(arm, "hand", rows="position", target=far, priority=2)}

    def answer(self, arm, tasks, scheme, speed):
        limits = osik.ConfigurationLimit(arm), osik.VelocityLimit(arm, velocity={"*": speed})
        return osik.solve(arm, arm.q0, tasks, scheme=scheme, limits=limits)

    @pytest.mark.release
    def test_saturation_keeps_limits_and_priorities(self, arm, tasks):
        plain, hard = (osik.NullSpace(method=method, curvature_damping=0.0) for method in ("classical", "saturated"))
        loose, tight, far = (self.answer(arm, tasks, s, v) for s, v in ((plain, 0.1), (hard, 0.1), (hard, 1e6)))
        assert float(loose.box_violation) > 0.05
        assert float(tight.box_violation) == 0.0
        assert int(tight.status) == Status.SOLVED
        assert float(tight.kkt_residual) < 1e-6
        np.testing.assert_allclose(tight.slack["height"], 0.0, rtol=0, atol=1e-6)
        np.testing.assert_allclose(loose.slack["hand"], 0.0, rtol=0, atol=1e-6)
        assert abs(tight.slack["hand"][0]) > 0.1  # along x, where the target is; but straight on
        np.testing.assert_allclose(tight.slack["hand"][1:], 0.0, rtol=0, atol=1e-6)
        np.testing.assert_allclose(far.velocity, loose.velocity, rtol=0, atol=1e-8)

    def test_the_reverse_order_is_the_forward_one_where_all_can_be_had(self, arm, tasks):
        forward, reverse = (
            self.answer(arm, tasks, osik.NullSpace(damping=0.0, curvature_damping=0.0, method=method), 0.1)
            for method in ("classical", "reverse")
        )
        assert float(jnp.abs(forward.velocity).max()) > 0.1
        np.testing.assert_allclose(forward.velocity, reverse.velocity, rtol=0, atol=1e-9)

    def test_mistakes(self):
        with pytest.raises(ValueError, match="method is 'sideways'; methods: classical, reverse, saturated"):
            osik.NullSpace(method=cast(Any, "sideways"))


@partial(jax.jit, static_argnames="backend")
def one_row_with_its_derivative(wanted, lower, upper, *, backend):
    """The answer of a level that asks for 8 x - y, and the derivative of (x, y) with respect to what it asks for."""

    def solved(wanted):
        level = Level(jnp.array([[8.0, -1.0]]), wanted, wanted)
        answer = solve_nullspace([level], lower, upper, backend=backend)
        return answer.x, answer

    derivative, answer = jax.jacfwd(solved, has_aux=True)(wanted)
    return answer, derivative


@pytest.mark.variants(slow=["jax-1e-07"], release=["core-0.1", "jax-0.1"])
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
