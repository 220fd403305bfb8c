"""The projection of eqs. 6 and 7 against NumPy's pseudo-inverse, and the joint-limit potential of eq. 8."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from osik_jax.schemes._null_space import limit_potential_gradient
from osik_jax.solvers import Level, solve_nullspace

N = 8
ROWS = (3, 2, 2)
TIGHT = 1e-10


@jax.jit
def solve(levels, secondary, damping):
    return solve_nullspace(levels, secondary=secondary, damping=damping)


def equality(matrix, wanted, weight=None):
    return Level(matrix, wanted, wanted, weight)


def random_levels(rng, rows=ROWS):
    return [(rng.normal(size=(m, N)), rng.normal(size=m), rng.uniform(0.5, 2.0, m)) for m in rows]


def as_levels(data):
    return [equality(*level) for level in data]


class TestEquationSeven:
    def test_the_projector_leaves_what_no_level_takes(self, rng):
        data = random_levels(rng)
        for damping in (0.0, 0.1):
            P = np.asarray(solve(as_levels(data), np.zeros(N), damping).projector)
            assert np.trace(P) == pytest.approx(N - sum(ROWS), abs=1e-12)
            for matrix, _, _ in data:
                np.testing.assert_allclose(matrix @ P, 0.0, rtol=0, atol=1e-13)

    def test_lower_levels_and_the_secondary_motion_do_not_disturb_higher_ones(self, rng):
        """In rows that cannot all be met, too, and with damping."""
        data = random_levels(rng, (3, 4, 3, 2))
        for damping in (0.0, 0.1):
            for count in range(1, len(data)):
                few = np.asarray(solve(as_levels(data[:count]), np.zeros(N), damping).x)
                all_of_them = np.asarray(solve(as_levels(data), rng.normal(size=N), damping).x)
                for matrix, _, _ in data[:count]:
                    np.testing.assert_allclose(matrix @ all_of_them, matrix @ few, rtol=0, atol=TIGHT)

    def test_weights_matter_only_where_rows_of_a_level_conflict(self, rng):
        matrix, wanted, weight = random_levels(rng, (3,))[0]
        plain, weighted = (solve([equality(matrix, wanted, w)], np.zeros(N), 0.0).x for w in (None, weight))
        np.testing.assert_allclose(plain, weighted, rtol=0, atol=TIGHT)
        row = rng.normal(size=N)
        x = solve([equality(np.stack([row, row]), np.array([1.0, 4.0]), np.array([1.0, 2.0]))], np.zeros(N), 0.0).x
        assert row @ x == pytest.approx(3.0, abs=1e-12)

    def test_a_weight_of_zero_removes_a_row(self, rng):
        matrix, wanted, _ = random_levels(rng, (3,))[0]
        x = solve([equality(matrix, wanted, np.array([1.0, 0.0, 1.0]))], np.zeros(N), 0.0).x
        np.testing.assert_allclose(x, np.linalg.pinv(matrix[[0, 2]]) @ wanted[[0, 2]], rtol=0, atol=TIGHT)


class TestDeficientRank:
    @pytest.mark.parametrize("size", [1e-2, 1e-4, 1e-6, 0.0])
    def test_damping_bounds_the_motion_near_a_singularity(self, rng, size):
        """s / (s^2 + d) <= 1 / (2 sqrt d) for every singular value s."""
        u, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        v, _ = np.linalg.qr(rng.normal(size=(N, 3)))
        matrix, wanted = u * [1.0, 0.5, size] @ v.T, rng.normal(size=3)
        damping = 1e-4
        damped, plain = (solve([equality(matrix, wanted)], np.zeros(N), d).x for d in (damping, 0.0))
        bound = np.linalg.norm(wanted) / (2.0 * np.sqrt(damping))
        assert np.linalg.norm(damped) <= bound
        exact = np.linalg.solve(matrix.T @ matrix + damping * np.eye(N), matrix.T @ wanted)
        np.testing.assert_allclose(damped, exact, rtol=1e-9, atol=1e-9)
        if 0.0 < size < 1e-3:
            assert np.linalg.norm(plain) > 10.0 * bound

    def test_rank_tolerance_is_a_share_of_the_level(self, rng):
        v, _ = np.linalg.qr(rng.normal(size=(N, 2)))
        for scale in (1e-6, 1.0, 1e6):
            level = equality(scale * np.array([[1.0, 0.0], [0.0, 1e-4]]) @ v.T, scale * np.ones(2))
            kept, cut = (solve_nullspace([level], rank_tolerance=t).x for t in (1e-5, 1e-3))
            np.testing.assert_allclose(kept, v @ [1.0, 1e4], rtol=1e-9)
            np.testing.assert_allclose(cut, v @ [1.0, 0.0], rtol=0, atol=1e-9)


class TestInequalities:
    def test_a_row_takes_part_only_where_it_is_violated(self, rng):
        (first, wanted, _), (second, _, _) = random_levels(rng, (2, 3))
        x = np.linalg.pinv(first) @ wanted
        value = second @ x
        held = Level(second, value - 1.0, value + 1.0)
        np.testing.assert_allclose(solve([equality(first, wanted), held], np.zeros(N), 0.0).x, x, rtol=0, atol=TIGHT)
        low, high = value - 1.0, value + np.array([1.0, -0.5, 1.0])
        ours = solve([equality(first, wanted), Level(second, low, high)], np.zeros(N), 0.0)
        only = np.linalg.pinv(np.concatenate([first, second[1:2]])) @ np.append(wanted, high[1])
        np.testing.assert_allclose(ours.x, only, rtol=0, atol=TIGHT)
        assert second[1] @ np.asarray(ours.x) == pytest.approx(high[1], abs=TIGHT)

    def test_an_infinite_side_never_counts(self, rng):
        matrix = random_levels(rng, (3,))[0][0]
        free = Level(matrix, np.full(3, -np.inf), np.full(3, np.inf))
        np.testing.assert_array_equal(solve([free], np.zeros(N), 0.0).x, np.zeros(N))
        ours = solve([Level(matrix, np.array([1.0, -np.inf, -1.0]), np.full(3, np.inf))], np.zeros(N), 0.0).x
        np.testing.assert_allclose(ours, np.linalg.pinv(matrix[:1])[:, 0], rtol=0, atol=TIGHT)

    def test_slacks_say_what_a_level_did_not_get(self, rng):
        data = random_levels(rng, (5, 6))
        ours = solve(as_levels(data), np.zeros(N), 0.0)
        for (matrix, wanted, _), slack in zip(data, ours.slacks, strict=True):
            np.testing.assert_allclose(slack, matrix @ np.asarray(ours.x) - wanted, rtol=0, atol=TIGHT)
        assert np.abs(ours.slacks[0]).max() < TIGHT < np.abs(ours.slacks[1]).max()


def cost(t, data, direction, secondary, damping):
    moved = jax.tree.map(lambda a, b: a + t * b, data, direction)
    return jnp.sum(jnp.sin(solve_nullspace(as_levels(moved), secondary=secondary, damping=damping).x))


cost_and_slope = jax.jit(jax.value_and_grad(cost))
cost_along = jax.jit(lambda t, *given: jax.jvp(lambda t: cost(t, *given), (t,), (1.0,))[1])


@pytest.mark.slow
@pytest.mark.variants(release=["0.0"])
@pytest.mark.parametrize("damping", [0.0, 0.05])
def test_gradients_are_central_differences_in_both_modes(rng, damping):
    """In matrices, targets and weights, with a level whose rank is not full and one that is overdetermined."""
    data = random_levels(rng, (3, 2, 5))
    data[1] = (rng.normal(size=2)[:, None] * rng.normal(size=N), data[1][1], data[1][2])
    direction, secondary = random_levels(rng, (3, 2, 5)), rng.normal(size=N)
    along = rng.normal(size=2)[:, None] * data[1][0]  # keeps the rank
    direction[1] = (along, direction[1][1], direction[1][2])

    given, h = (data, direction, secondary, damping), 1e-5
    (ahead, _), (behind, _) = cost_and_slope(h, *given), cost_and_slope(-h, *given)
    expected = (ahead - behind) / (2.0 * h)
    forward, reverse = cost_along(0.0, *given), cost_and_slope(0.0, *given)[1]
    assert float(forward) == pytest.approx(float(expected), rel=1e-6)
    assert float(reverse) == pytest.approx(float(forward), rel=1e-10)


class TestPotential:
    LOWER, UPPER = np.array([-1.0, 0.0, -np.inf, -2.0]), np.array([2.0, 0.5, np.inf, np.inf])

    @staticmethod
    def potential(q, lower, upper):
        """Eq. 8 over the joints with two limits."""
        r = upper - lower
        return np.sum(r / ((upper - q) * (q - lower))) / (2.0 * len(q))

    def test_against_finite_differences(self, rng):
        both = np.isfinite(self.LOWER) & np.isfinite(self.UPPER)
        low, high = self.LOWER[both], self.UPPER[both]
        for _ in range(10):
            q = np.zeros(4)
            q[both] = low + rng.uniform(0.05, 0.95, 2) * (high - low)
            gradient = limit_potential_gradient(jnp.asarray(q), jnp.asarray(self.LOWER), jnp.asarray(self.UPPER))
            for k, joint in enumerate(np.flatnonzero(both)):
                h = 1e-6 * np.eye(2)[k]
                ends = (self.potential(q[both] + s * h, low, high) for s in (1.0, -1.0))
                ahead, behind = ends
                assert float(gradient[joint]) == pytest.approx((ahead - behind) / 2e-6, rel=1e-6, abs=1e-7)
            np.testing.assert_array_equal(np.asarray(gradient)[~both], 0.0)

    def test_descending_it_leads_away_from_both_limits_from_wherever_one_is(self):
        """Outside the range too, where eq. 8 as printed has the other sign."""
        low, high = jnp.array([-1.0]), jnp.array([2.0])
        for q, sign in ((-3.0, -1), (-1.0, -1), (-0.9, -1), (0.4, -1), (0.6, 1), (1.9, 1), (2.0, 1), (7.0, 1)):
            gradient = float(limit_potential_gradient(jnp.array([q]), low, high)[0])
            assert np.isfinite(gradient)
            assert np.sign(gradient) == sign
        assert float(limit_potential_gradient(jnp.array([0.5]), low, high)[0]) == 0.0

    def test_the_margin_caps_it(self):
        low, high, margin = jnp.array([-1.0]), jnp.array([2.0]), 0.05
        edge = -1.0 + margin * 3.0
        h = 1e-6
        slope = (self.potential(np.array([edge + h]), -1.0, 2.0) - self.potential(np.array([edge - h]), -1.0, 2.0)) / (
            2 * h
        )
        for q in (edge, -1.0, -5.0):
            gradient = float(limit_potential_gradient(jnp.array([q]), low, high, margin)[0])
            assert gradient == pytest.approx(slope, rel=1e-6)

    @pytest.mark.parametrize("kind, at, count", [(np.float64, 0.3, 1), (np.float64, -1e3, 1), (np.float32, 0.25, 2)])
    def test_a_range_of_one_value_has_no_force(self, kind, at, count):
        """In single precision the next value is a range, and counts as in the core, which computes in double."""
        low = jnp.array([at, 0.0, -1.0], kind)
        high = jnp.array([np.nextafter(kind(at), kind(np.inf)), 0.0, 1.0], kind)
        q = jnp.array([at, 0.0, 0.5], kind)
        every, alone = (limit_potential_gradient(*(a[k:] for a in (q, low, high))) for k in (0, 2))
        np.testing.assert_allclose(every, [0.0, 0.0, float(alone[0]) / count], rtol=1e-6)
        rates = jax.jacfwd(limit_potential_gradient, (0, 1, 2))(q, low, high)
        assert all(jnp.isfinite(rate).all() for rate in rates)

    def test_no_limits_or_empty_ranges_give_zero_and_finite_derivatives(self):
        low, high = jnp.array([-jnp.inf, 1.0, 0.0]), jnp.array([jnp.inf, 1.0, jnp.inf])
        gradient, rates = jax.jvp(
            lambda *args: limit_potential_gradient(*args), (jnp.ones(3), low, high), (jnp.ones(3),) * 3
        )
        np.testing.assert_array_equal(gradient, np.zeros(3))
        assert np.isfinite(np.asarray(rates)).all()
