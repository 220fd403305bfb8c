"""Weights of joint angles follow the size of the robot, so that a posture does not outweigh a small arm's hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_files import mjcf

import osik_jax as osik
from osik_jax.robot._size import robot_size

Q = np.array([[1.1, -0.9, 1.7], [-0.8, 0.6, -1.5]])


@pytest.fixture(scope="module")
def arm():
    """Reach 1 m, on a stand of 2 m, which no joint moves."""
    return osik.Robot.from_mjcf(mjcf("arm_on_a_stand"), floating_base=False)


class TestSize:
    @pytest.mark.parametrize("k", [0.03, 1.0, 7.0])
    def test_of_an_arm_is_its_reach(self, arm, k):
        assert float(robot_size(arm.scaled(length=k))) == pytest.approx(k, rel=1e-12)

    def test_of_two_arms_on_a_trunk_that_moves_goes_from_tip_to_tip(self):
        side = (
            '<body pos="0 {0}.1 0"><joint axis="1 0 0"/><geom size=".01"/><site name="tip{1}" pos="0 0 .{1}"/></body>'
        )
        sides = side.format("", 2) + side.format("-", 4)
        moving = '<mujoco><worldbody><body><joint axis="0 0 1"/><geom size=".01"/>{}</body></worldbody></mujoco>'
        assert robot_size(osik.Robot.from_mjcf(moving.format(sides), floating_base=False)) == pytest.approx(0.8)

    def test_joints_away_from_the_origin_of_their_body_count_where_they_are(self):
        """The same arm, its bodies' frames all in the world's origin, as CAD programs write them."""
        text = """<mujoco><worldbody><body><joint axis="0 0 1"/><geom size=".01"/>
            <body><joint axis="0 1 0" pos="0 0 .3"/><geom size=".01"/>
            <body><joint axis="0 1 0" pos=".4 0 .3"/><geom size=".01"/><site name="tip" pos=".7 0 .3"/></body>
            </body></body></worldbody></mujoco>"""
        arm = osik.Robot.from_mjcf(text, floating_base=False)
        assert robot_size(arm) >= 1.0

    def test_traced_it_is_the_same_and_has_derivatives(self, arm):
        lengths = jnp.array([0.05, 0.4])
        size = jax.value_and_grad(lambda k: robot_size(arm.scaled(length=k)))
        sizes, slopes = jax.jit(jax.vmap(size))(lengths)
        np.testing.assert_allclose(sizes, lengths, rtol=1e-12)
        np.testing.assert_allclose(slopes, 1.0, rtol=1e-6)


class TestWeights:
    @pytest.mark.parametrize("kind", [osik.PostureTask, osik.DampingTask, osik.LowAccelerationTask])
    def test_the_default_falls_with_the_square_of_the_size(self, arm, kind):
        for k, expected in ((1.0, 1e-4), (0.5, 1e-4), (0.25, 0.25e-4), (0.05, 1e-6), (0.001, 1.024e-7)):
            np.testing.assert_allclose(kind(arm.scaled(length=k)).weight, expected, rtol=1e-6)
        np.testing.assert_allclose(kind(arm.scaled(length=0.05), weight=1e-3).weight, 1e-3)

    @pytest.mark.parametrize("name", ["arm7", "nao"])
    def test_the_embedded_robots_keep_theirs(self, name):
        assert float(osik.PostureTask(osik.load_robot(name)).weight) == 1e-4

    def test_named_joints_and_bounds_keep_a_weight_of_1(self, arm):
        small = arm.scaled(length=0.05)
        assert float(osik.PostureTask(small, joints=("a",)).weight) == 1.0
        assert float(osik.PostureTask(small, lower=-1.0).weight) == 1.0

    def test_in_a_batch_of_sizes(self, arm):
        weights = jax.vmap(lambda k: osik.PostureTask(arm.scaled(length=k)).weight)(jnp.array([0.05, 0.25, 2.0]))
        np.testing.assert_allclose(weights, [1e-6, 0.25e-4, 1e-4], rtol=1e-9)


@pytest.mark.variants(slow=["0.2"], release=["0.05"])
@pytest.mark.parametrize("k", [0.05, 0.2, 0.5])
def test_a_small_arm_rests_near_its_target(arm, k):
    """As near as one of half a metre, for its size: at a reach of 5 cm it was 13 mm off."""
    robot = arm.scaled(length=k)
    goal = osik.forward_kinematics(robot, jnp.asarray(Q[0])).frame_pose(robot, "tip")[0]
    hand = osik.FrameTask(robot, "tip", rows="position", target=goal)
    path = osik.rollout(robot, Q[1], {"tip": hand, "rest": osik.PostureTask(robot, gain=1.0)}, dt=0.02, steps=300)
    assert np.linalg.norm(path.solution.error["tip"][-1]) < 0.006 * k
