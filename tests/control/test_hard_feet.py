"""Feet that are constraints, beside a hand that pulls with all its weight: NAO, in the three schemes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from task_checks import kinematics_at, moved_by

import osik_jax as osik
from osik_jax.solvers import Status

LANES = 4
SCHEMES = {
    "weighted": osik.WeightedQP(damping=1e-6),
    "null-space": osik.NullSpace(),
    "hierarchical": osik.HierarchicalQP(),
}


@pytest.fixture(scope="module")
def setting():
    """Bent knees, some way off; a hand a metre away, at a million times the weight of the rest."""
    robot = osik.load_robot("nao")
    rng = np.random.default_rng(1)
    moves = rng.uniform(-0.02, 0.02, (LANES, robot.nv))
    q = jax.vmap(moved_by, in_axes=(None, None, 0))(robot, robot.q0, jnp.asarray(moves))
    p, R = kinematics_at(robot, robot.q0).frame_pose(robot, "l_gripper")
    feet = {foot: osik.FrameTask(robot, foot, hard=True, gain=2.0) for foot in ("l_sole", "r_sole")}
    hand = osik.FrameTask(robot, "l_gripper", target=(p + np.array([1.0, 0.3, 0.2]), R), rows="position", weight=1e6)
    tasks = {**feet, "hand": hand, "posture": osik.PostureTask(robot, weight=1e-2, priority=2)}
    return robot, q, tasks, (osik.ConfigurationLimit(robot), osik.VelocityLimit(robot))


@jax.jit
def solve(robot, q, tasks, scheme, limits):
    return jax.vmap(lambda q: osik.solve(robot, q, tasks, scheme=scheme, limits=limits, dt=0.005))(q)


@pytest.mark.variants(slow=["hierarchical"], release=["null-space"])
@pytest.mark.parametrize("name", SCHEMES)
def test_stay_to_rounding(setting, name):
    robot, q, tasks, limits = setting
    s = solve(robot, q, tasks, SCHEMES[name], limits)
    np.testing.assert_array_equal(s.status, np.full(LANES, Status.SOLVED))
    for foot in ("l_sole", "r_sole"):
        assert np.abs(s.error[foot]).max() > 1e-3
        assert np.abs(s.slack[foot]).max() < 1e-12
    if name != "null-space":  # its box is not hard, and the hand's velocity a large one
        assert np.abs(s.slack["hand"]).max() > 1.0
        assert (s.box_violation == 0.0).all()
