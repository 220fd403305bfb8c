"""What the numbers on the page on porting rest on: one robot in two libraries, and steps that are the same in both."""

import numpy as np
import pinocchio as pin
import pytest

import osik_jax as osik
from benchmarks.porting import mobile, step
from benchmarks.porting.g1 import FEET, G1


@pytest.fixture(scope="module")
def g1():
    return G1()


def test_configurations_come_back(g1, rng):
    q = pin.integrate(g1.model, g1.standing(0.7, 0.2), rng.uniform(-0.3, 0.3, g1.model.nv))
    np.testing.assert_array_equal(g1.pinocchio_configuration(g1.configuration(q)), q)
    assert g1.robot.nq == g1.model.nq


def test_velocities_move_the_robot_alike(g1, rng):
    """To second order in the step: the base goes along a screw there, straight here."""
    q, v = g1.standing(0.7, 0.2), rng.uniform(-1.0, 1.0, g1.model.nv)
    q = pin.integrate(g1.model, q, 0.3 * v)
    for h in (1e-3, 1e-4):
        theirs = g1.configuration(pin.integrate(g1.model, q, h * v))
        ours = osik.integrate(g1.robot, g1.configuration(q), g1.velocity(v, q), h)
        np.testing.assert_allclose(ours, theirs, atol=5.0 * h**2)


def test_standing_with_bent_legs_keeps_the_feet_flat(g1):
    straight, bent = (g1.poses(g1.standing(0.72, bend), FEET) for bend in (0.0, 0.3))
    for foot in FEET:
        np.testing.assert_allclose(bent[foot].rotation, straight[foot].rotation, atol=1e-12)
        assert bent[foot].translation[2] > straight[foot].translation[2] + 0.01


def test_the_arm_on_wheels():
    robot = osik.Robot.from_mjcf(mobile.model_text())
    assert robot.joint_names == ("x", "y", "turn", *(f"joint{k}" for k in range(1, 8)))
    np.testing.assert_array_equal(np.isfinite(robot.position_upper), [False] * 4 + [True, False] * 3)


@pytest.mark.release
@pytest.mark.parametrize("turned", [True, False])
def test_a_step_of_a_g1_is_pinks_in_its_form_alone(g1, rng, turned):
    decoupled, _, coupled, both = step._apart(g1, rng, (0.05, 0.3), turned, 0.1)
    assert max(coupled, both) < 1e-9
    assert decoupled > 0.02
