"""Levels with damping: against quadprog, against projections in NumPy, and the damping that vanishes with the miss."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quadprog

from osik_jax.solvers import Damping, Level, Status, solve_hqp, solve_nullspace

COUNT, N = 40, 7
ROWS = (3, 2, 4)
DAMPINGS = (0.3, 0.0, 0.05)


@pytest.fixture(scope="module")
def levels():
    rng = np.random.default_rng(3)
    return [(rng.normal(size=(COUNT, m, N)), rng.normal(size=(COUNT, m))) for m in ROWS]


@jax.jit
def solved(levels, lower, upper, damping):
    return jax.vmap(
        lambda levels, lower, upper: solve_hqp([Level(*one) for one in levels], lower, upper, damping=damping)
    )(levels, lower, upper)


def projected(levels, damping):
    """The cascade without bounds, by normal equations in bases of null spaces."""
    free, x = np.eye(N), np.zeros(N)
    for (A, b), strength in zip(levels, damping, strict=True):
        if not free.shape[1]:
            break
        B = A @ free
        whole = np.linalg.pinv(np.r_[B, np.sqrt(strength) * np.eye(B.shape[1])])
        x = x + free @ (whole[:, : len(b)] @ (b - A @ x))
        _, s, vt = np.linalg.svd(B)
        free = free @ vt[np.sum(s > 1e-9 * np.linalg.norm(A)) :].T
    return x


@pytest.mark.slow
def test_free_levels_reach_what_projections_do(levels):
    @jax.jit
    @jax.vmap
    def solve(levels):
        return solve_nullspace([Level(*one) for one in levels], damping=list(DAMPINGS)).x

    unbounded = np.full((COUNT, N), np.inf)
    found = solved(levels, -unbounded, unbounded, DAMPINGS)
    assert (found.status == Status.SOLVED).all()
    expected = [projected([(A[i], b[i]) for A, b in levels], DAMPINGS) for i in range(COUNT)]
    for x in (found.x, solve(levels)):
        np.testing.assert_allclose(x, expected, rtol=0, atol=1e-9)


def test_a_bounded_level_is_the_damped_least_squares(levels):
    """The first level's optimum is quadprog's; the second keeps what its rows have reached."""
    upper = np.full((COUNT, N), 0.25)
    found = solved(levels[:2], -upper, upper, (0.3, 0.1))
    assert (found.status == Status.SOLVED).all()
    assert (np.abs(found.active) == 1).sum(1).max() > 2
    for i in range(COUNT):
        A, b = (a[i] for a in levels[0])
        x, near = np.asarray(found.x[i]), np.r_[np.eye(N), -np.eye(N)].T
        best = quadprog.solve_qp(A.T @ A + 0.3 * np.eye(N), A.T @ b, near, -np.full(2 * N, 0.25))[0]
        np.testing.assert_allclose(A @ x, A @ best, rtol=0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.variants(release=["jax"])
@pytest.mark.parametrize("backend", ["auto", "jax"])
def test_a_level_that_rows_above_stop_is_damped_as_out_of_reach(backend):
    """The first level stops x_0, so x_1 has to do the second level's motion, of which it does 0.05 for each unit.

    With the damping d the answer is x_1 = 0.05 / (0.05^2 + d). The damping is between 0.02 times the fixed point of
    the ratio, which is 1 - 0.05^2 / 0.02, and 0.02. Without it x_1 is 20.
    """
    above = Level(np.array([[1.0, 0.0, 0.0]]), np.array([-np.inf]), np.array([0.0]))
    level = Level(np.array([[1.0, 0.05, 0.0]]), np.array([1.0]))
    far = np.full(3, 100.0)
    dampings = [Damping(), Damping(unmet=0.02, demand=1.0)]
    found = solve_hqp([above, level], -far, far, damping=dampings, backend=backend)
    assert found.status == Status.SOLVED
    fixed_point = 1.0 - 0.05**2 / 0.02
    assert found.x[1] * (1.0 + 1e-6) >= 0.05 / (0.05**2 + 0.02)
    assert found.x[1] < 0.05 / (0.05**2 + 0.02 * fixed_point)
    np.testing.assert_allclose(found.x[0], 0.0, atol=1e-9)

    def change(t):  # of the row and its bound
        moved = Level(jnp.array([[1.0, 0.1 * t, 0.0]]), above.lower, jnp.array([0.3 * t]))
        return solve_hqp([moved, level], -far, far, damping=dampings, backend=backend).x[1]

    expected = (change(1e-5) - change(-1e-5)) / 2e-5
    assert abs(expected) > 0.1
    np.testing.assert_allclose(jax.jvp(change, (0.0,), (1.0,))[1], expected, rtol=1e-5)


@pytest.mark.slow
def test_what_a_level_can_meet_is_not_damped():
    """In one dimension: max(0, unmet - s^2) at a demand of the size of the goal."""
    unbounded = jnp.full(1, jnp.inf)

    @jax.jit
    @jax.vmap
    def found(s):
        return solve_hqp([Level(s[None, None], jnp.ones(1))], -unbounded, unbounded, damping=Damping(0.0, 1.0, 1.0)).x[
            0
        ]

    s = jnp.array([1e-3, 0.03, 0.1, 3.0, 10.0, 100.0])
    x = found(s)
    assert (x[:3] < 1.01 * s[:3]).all()  # as good as s / (s^2 + 1)
    np.testing.assert_allclose(s[3:] * x[3:], 1.0, rtol=0, atol=2e-3)


def test_a_damping_that_is_none_is_refused(levels):
    with pytest.raises(ValueError, match="3 levels"):
        solve_hqp([Level(A[0], b[0]) for A, b in levels], jnp.zeros(N), jnp.ones(N), damping=[0.1])
    bound = np.ones((COUNT, N))
    assert (solved(levels, -bound, bound, (-1.0, *DAMPINGS[1:])).status == Status.NUMERICAL_ERROR).all()
