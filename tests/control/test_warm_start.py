"""A warm start saves time and changes no answer, however wrong it is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_checks import needs_core
from problem_families import PLANTED
from recorded import QP_DAMPING, recorded_qps
from task_checks import kinematics_at

import osik_jax as osik
from osik_jax.solvers import Level, Status, solve_hqp, solve_least_squares_qp, solve_qp
from osik_jax.solvers.hqp import WorkingSet

DT = 0.005


@jax.jit
@jax.vmap
def warm_least_squares(A, b, lower, upper, active):
    more = dict(damping=QP_DAMPING, warm_start=active, backend="jax")  # a kernel counts otherwise
    return solve_least_squares_qp(A, b, jnp.ones_like(b), lower, upper, **more)


@pytest.fixture(scope="module")
def qps():
    p = recorded_qps("nao")
    cold = warm_least_squares(p.A, p.b, p.lower, p.upper, np.zeros(p.lower.shape, np.int32))
    return p, cold


def test_the_right_active_set_takes_one_factorisation(qps):
    p, cold = qps
    warm = warm_least_squares(p.A, p.b, p.lower, p.upper, cold.active)
    assert (np.asarray(warm.factorizations) == 1).all() and (np.asarray(warm.iterations) == 0).all()
    assert np.asarray(cold.factorizations).max() > 3  # plain JAX factors in each iteration of a search
    np.testing.assert_allclose(warm.x, cold.x, rtol=0, atol=1e-13)


@pytest.mark.variants(slow=["pinned", "scaled_altogether"], release=["mixed", "duplicated_rows"])
@pytest.mark.parametrize("family", ["mixed", "duplicated_rows", "pinned", "scaled_altogether"])
def test_random_active_sets_with_rows(family, rng):
    p = PLANTED[family](rng, 500)
    guess = rng.integers(-1, 3, (500, p.x.shape[1] + p.row_lower.shape[1]))
    warm = jax.jit(jax.vmap(lambda *data: solve_qp(*data[:-1], warm_start=data[-1])))(*p.data, guess)
    assert (np.asarray(warm.status) == Status.SOLVED).all()
    np.testing.assert_allclose((warm.x - p.x) / p.unit, 0.0, atol=1e-9)


@pytest.mark.slow
def test_bounds_that_levels_were_at_and_left_are_part_of_the_scale(rng):
    """A robot at rest: the answer is of the size of rounding, the bounds that a warm start leads through are not."""
    n, lanes = 8, 20
    A, B = 20.0 * rng.normal(size=(lanes, 3, n)), rng.normal(size=(lanes, 2, n))
    a, b = 1e-14 * rng.normal(size=(lanes, 3)), 1e-13 * rng.normal(size=(lanes, 2))
    lower, upper = -5.0 * np.ones(n), np.linspace(0.3, 2.0, n)

    @jax.jit
    @jax.vmap
    def solve(A, a, B, b, warm):
        return solve_hqp([Level(A, a), Level(B, b)], lower, upper, warm_start=warm)

    none = WorkingSet(jnp.zeros((lanes, 3, n), jnp.int32), jnp.zeros((lanes, 3, 3), jnp.int32))
    cold = solve(A, a, B, b, none)
    far = cold.warm_start._replace(hard=cold.warm_start.hard.at[:, 0, 2].set(1).at[:, 1, 4].set(1))
    warm = solve(A, a, B, b, far)
    for s in (cold, warm):
        np.testing.assert_array_equal(s.status, Status.SOLVED)
    np.testing.assert_allclose(warm.x, cold.x, atol=1e-14)


@pytest.mark.variants(slow=["auto"], release=["jax"])
@pytest.mark.parametrize("backend", ["auto", "jax"])
def test_working_sets_of_other_problems_beside_bounds_of_1e10(backend, rng):
    """A guess at a bound of 1e10 has tolerances and roundoff of that size; nothing of them may be in the answer."""
    n, lanes = 12, 256
    A, B = rng.normal(size=(lanes, 3, n)), rng.normal(size=(lanes, 6, n))
    a, b = rng.normal(size=(lanes, 3)), rng.normal(size=(lanes, 6))
    widths = np.where(rng.random((lanes, 6)) < 0.3, rng.exponential(size=(lanes, 6)), 0.0)
    bound = np.where(rng.random((lanes, n)) < 0.4, 0.05, 1e10)

    @jax.jit
    def solve(warm, damping):
        def one(A, a, B, b, width, bound, warm):
            levels = [Level(A, a), Level(B, b, b + width)]
            return solve_hqp(levels, -bound, bound, warm_start=warm, damping=damping, backend=backend)

        return jax.vmap(one)(A, a, B, b, widths, bound, warm)

    none = WorkingSet(jnp.zeros((lanes, 3, n + 6), jnp.int32), jnp.zeros((lanes, 3, 6), jnp.int32))
    random = WorkingSet(*(jnp.asarray(rng.integers(-1, 3, x.shape), jnp.int32) for x in none))
    for damping in (0.0, 1e-3):
        cold = solve(none, damping)
        for guess in (jax.tree.map(lambda x: jnp.roll(x, 1, 0), cold.warm_start), random, cold.warm_start):
            warm = solve(guess, damping)
            solved = np.asarray(cold.status) == Status.SOLVED
            assert solved.mean() > 0.98
            np.testing.assert_array_equal(np.asarray(warm.status)[solved], Status.SOLVED)
            assert np.asarray(warm.kkt_residual)[solved].max() < 1e-9
            np.testing.assert_allclose(warm.x[solved], cold.x[solved], rtol=0, atol=1e-9 * np.abs(cold.x).max())


@pytest.fixture(scope="module")
def reaching():
    """A hand that is told to go faster than its joints can."""
    arm = osik.load_robot("arm7")
    kinematics = kinematics_at(arm, arm.q0)
    frame = arm.frame_names[-1]
    p, R = kinematics.frame_pose(arm, frame)
    hand = osik.FrameTask(arm, frame, target=(p + jnp.array([-0.3, 0.3, 0.2]), R), gain=20.0, priority=1)
    tasks = {"hand": hand, "posture": osik.PostureTask(arm, weight=1e-3, priority=2)}
    limits = (osik.ConfigurationLimit(arm), osik.VelocityLimit(arm, velocity={"*": 0.5}))
    return arm, tasks, limits


@pytest.mark.variants(release=["weighted"])
@pytest.mark.parametrize(
    "scheme",
    [osik.WeightedQP(), pytest.param(osik.HierarchicalQP(), marks=[pytest.mark.slow, needs_core])],
    ids=["weighted", "hierarchical"],
)
def test_the_closed_loop(scheme, reaching):
    """Each step starts from the one before: the same motion as from cold starts, in one or two factorisations."""
    arm, tasks, limits = reaching
    steps = 150
    warm = osik.rollout(arm, arm.q0, tasks, scheme=scheme, limits=limits, dt=DT, steps=steps)
    cold = jax.jit(jax.vmap(lambda q: osik.solve(arm, q, tasks, scheme=scheme, limits=limits, dt=DT)))(warm.q[:-1])
    np.testing.assert_allclose(warm.solution.velocity, cold.velocity, rtol=0, atol=1e-9)
    assert (np.asarray(cold.warm_start if isinstance(scheme, osik.WeightedQP) else cold.warm_start.hard) != 0).any()
    assert np.mean(warm.solution.iterations) < 0.2 * np.mean(cold.iterations)
    if isinstance(scheme, osik.WeightedQP):
        assert np.median(warm.solution.factorizations) <= 2
