"""Gains: numbers worked out by hand, and what a task makes of them."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from task_checks import (
    kinematics_at,
    rows_of_each,
)

import osik_jax as osik
from osik_jax.tasks._gain import safe_norm


@pytest.fixture(scope="module")
def arm():
    return osik.load_robot("arm7")


def test_norm():
    np.testing.assert_array_equal(jax.grad(safe_norm)(jnp.zeros(3)), np.zeros(3))
    np.testing.assert_allclose(safe_norm(jnp.array([3.0, 4.0])), 5.0, rtol=1e-15)


class TestGain:
    def test_equation_3_by_hand(self):
        gain = osik.AdaptiveGain(10.0, 2.0, 3.0)
        # ||(0.3, 0.4)|| = 0.5; 8 exp(-1.5) + 2 with exp(-1.5) = 0.22313016014842982
        np.testing.assert_allclose(gain(jnp.array([0.3, 0.4])), 3.7850412811874386, rtol=1e-15)
        np.testing.assert_allclose(gain(jnp.zeros(2)), 10.0, rtol=0)
        np.testing.assert_allclose(gain(jnp.full(2, 100.0)), 2.0, rtol=1e-15)
        np.testing.assert_array_equal(jax.grad(lambda e: gain(e))(jnp.zeros(2)), np.zeros(2))

    def test_in_a_task(self, arm):
        frame = "hand"
        p, R = kinematics_at(arm, arm.q0).frame_pose(arm, frame)
        target = (p - jnp.array([0.3, 0.4, 0.0]), R)
        gain = osik.AdaptiveGain(10.0, 2.0, 3.0)
        tasks = {
            "pose": osik.FrameTask(arm, frame, target=target, gain=gain),
            # rows of weight 0 do not count: the error that is left is (0.3, 0, 0), 8 exp(-0.9) + 2
            "x alone": osik.FrameTask(arm, frame, target=target, gain=gain, position_weight=[1, 0, 0]),
            # distance to the interval (0.3 - 0.25, 0.4 - 0.25), norm 0.15811388300841897
            "bounds": osik.FrameTask(arm, frame, target=target, gain=gain, rows="position", upper=0.25),
            "inside": osik.FrameTask(arm, frame, target=target, gain=gain, rows="position", upper=0.5),
        }
        rows = rows_of_each(arm, tasks, arm.q0)
        np.testing.assert_allclose(rows["pose"].lower[:3], [-1.1355123843562316, -1.5140165124749755, 0.0], atol=1e-13)
        np.testing.assert_allclose(rows["x alone"].lower[0], -0.3 * 5.252557277924793, atol=1e-13)
        np.testing.assert_array_equal(rows["bounds"].lower, np.full(3, -np.inf))
        rate = 8.0 * math.exp(-3.0 * 0.15811388300841897) + 2.0
        np.testing.assert_allclose(rows["bounds"].upper, rate * np.array([-0.05, -0.15, 0.25]), atol=1e-13)
        np.testing.assert_allclose(rows["inside"].upper, 10.0 * np.array([0.2, 0.1, 0.5]), atol=1e-13)

    def test_a_gain_of_zero_keeps_infinite_bounds(self, arm):
        task = osik.PostureTask(arm, lower=-0.1, gain=0.0)
        rows = rows_of_each(arm, {"a": task}, arm.q0)["a"]
        np.testing.assert_array_equal(rows.upper, np.full(arm.nv, np.inf))
        np.testing.assert_array_equal(rows.lower, np.zeros(arm.nv))


class TestMistakes:
    def test_gain(self):
        with pytest.raises(ValueError, match="maximum >= minimum"):
            osik.AdaptiveGain(1.0, 2.0, 1.0)
        with pytest.raises(ValueError, match="decay is"):
            osik.AdaptiveGain(2.0, 1.0, -1.0)
        with pytest.raises(ValueError, match="scalar"):
            osik.AdaptiveGain([2.0, 3.0], 1.0, 1.0)
