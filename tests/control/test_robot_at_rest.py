"""A robot at rest between tasks that pull on it: its velocity is roundoff, and each step is still solved."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import osik_jax as osik
from osik_jax import Status
from osik_jax.solvers import solve_least_squares_qp

STEPS, AT_REST = 400, 1e-12


@pytest.mark.variants(slow=["scheme0", "scheme1"])
@pytest.mark.parametrize("scheme", [osik.WeightedQP(), osik.HierarchicalQP(), osik.NullSpace(method="saturated")])
def test_steps_are_solved_at_rest(nao, scheme):
    """A hand near its target, and a posture that pulls back."""
    first, then = (1, 1) if isinstance(scheme, osik.WeightedQP) else (1, 2)
    tasks: dict[str, osik.Task] = {
        foot: osik.FrameTask(nao, foot, weight=100.0, priority=first) for foot in ("l_sole", "r_sole")
    }
    tasks["com"] = osik.ComTask(nao, weight=10.0, priority=first)
    place, turn = osik.forward_kinematics(nao, nao.q0).frame_pose(nao, "l_gripper")
    target = place + jnp.array([0.03, -0.02, 0.04]), turn
    tasks["hand"] = osik.FrameTask(nao, "l_gripper", rows="position", target=target, priority=then)
    tasks["posture"] = osik.PostureTask(nao, weight=1e-3, gain=10.0, priority=then)
    found = osik.rollout(nao, nao.q0, tasks, scheme=scheme, dt=0.02, steps=STEPS).solution
    assert (found.status == Status.SOLVED).all()
    assert jnp.abs(found.velocity[-20:]).max() < AT_REST


def test_no_search_follows_the_core_at_rest(rng):
    """Residuals that balance each other: the answer is 0 but for roundoff, and so is all that it is measured by."""
    A, weight = rng.normal(size=(20, 9, 6)), 10.0 ** rng.uniform(-3, 2, (20, 9))
    pulls = np.linalg.svd((weight[..., None] * A).transpose(0, 2, 1))[2][:, -1]  # A' W pulls = 0
    limit = np.tile([np.inf, np.inf, np.inf, 0.5, 0.5, 0.5], (20, 1))
    solve = jax.jit(jax.vmap(lambda *a: solve_least_squares_qp(*a, backend="core")))
    found = solve(A, pulls, weight, -limit, limit)
    assert (found.status == Status.SOLVED).all() and jnp.abs(found.x).max() < 1e-10
    np.testing.assert_array_equal(found.factorizations, 1)
