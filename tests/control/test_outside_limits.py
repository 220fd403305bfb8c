"""A configuration outside the joint ranges, as an encoder may measure it: the joints return at a bounded speed."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_files import mjcf

import osik_jax as osik

ARM = mjcf("two_hinges_and_a_slide")
UPPER = np.array([np.pi / 3, np.pi / 4, 0.2])
OUT = UPPER + np.array([0.049, 0.099, 0.019])
SCHEMES = {
    "weighted": osik.WeightedQP(),
    "hierarchy": osik.HierarchicalQP(),
    "saturated": osik.NullSpace(method="saturated"),
}


@pytest.fixture(scope="module")
def arm():
    """An arm whose file has no speed limits, as no MJCF has."""
    return osik.Robot.from_mjcf(ARM, floating_base=False)


def held(arm, q: Any) -> dict[str, osik.Task]:
    """Tasks that are met where the robot is."""
    pose = osik.forward_kinematics(arm, jnp.asarray(q)).frame_pose(arm, "tip")
    return {"tip": osik.FrameTask(arm, "tip", rows="position", target=pose), "rest": osik.PostureTask(arm, target=q)}


@pytest.mark.variants(slow=["hierarchy", "saturated"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_joints_without_speed_limits_return_at_the_default_speed(arm, scheme):
    """In one step the second joint would have 20 rad/s at 200 Hz."""
    for dt in (0.005, 1.0 / 30.0):
        answer = osik.solve(arm, OUT, held(arm, OUT), scheme=SCHEMES[scheme], dt=dt)
        assert answer.status == osik.Status.SOLVED
        np.testing.assert_allclose(answer.velocity, [-0.5, -0.5, -0.25], atol=1e-9)


def test_the_way_back_ends_inside_and_takes_as_long_as_it_has_to(arm):
    path = osik.rollout(arm, OUT, held(arm, OUT), dt=0.005, steps=60)
    assert (np.asarray(path.q[-1]) <= UPPER).all()
    outside = np.asarray(path.q) > UPPER
    assert outside.sum(0).tolist() == [20, 40, 16]  # 0.049, 0.099 and 0.019 at 0.5, 0.5 and 0.25 a second
    np.testing.assert_allclose(np.diff(np.asarray(path.q), axis=0)[:15], 0.005 * np.array([[-0.5, -0.5, -0.25]] * 15))


def test_below_the_range_it_is_the_same_with_the_other_sign(arm):
    lower, _ = osik.limit_box(arm, jnp.asarray(-OUT - 1.0), (osik.ConfigurationLimit(arm),), 0.005)
    np.testing.assert_allclose(lower, [0.5, 0.5, 0.25])


def test_a_speed_limit_of_the_file_is_the_return_speed():
    arm = osik.Robot.from_mjcf(ARM, floating_base=False, velocity_limits={"a": 3.0, "b": 0.1})
    np.testing.assert_allclose(osik.ConfigurationLimit(arm).return_speed, [3.0, 0.1, 0.25])
    answer = osik.solve(arm, OUT, held(arm, OUT), dt=0.005)
    np.testing.assert_allclose(answer.velocity, [-3.0, -0.1, -0.25], atol=1e-9)


def test_it_can_be_given_by_joint_replaced_swept_and_switched_off(arm):
    limit = osik.ConfigurationLimit(arm, return_speed={"a": 2.0, "c": np.inf})

    def upper(limit):
        return osik.limit_box(arm, jnp.asarray(OUT), (limit,), 0.005)[1]

    np.testing.assert_allclose(upper(limit), [-2.0, -0.5, -0.019 / 0.005], atol=1e-12)
    speeds = jnp.array([[0.1] * 3, [0.2] * 3])
    swept = jax.vmap(lambda speed: upper(limit.replace(return_speed=speed)))(speeds)
    np.testing.assert_allclose(swept, -speeds)
    np.testing.assert_allclose(jax.jacobian(lambda s: upper(limit.replace(return_speed=s)))(speeds[0]), -np.eye(3))
    for wrong in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match=r"return speeds have to be positive: b"):
            osik.ConfigurationLimit(arm, return_speed={"b": wrong})


def test_the_last_part_of_the_way_back_is_a_share_of_it(arm):
    """Where less is left than a step at the return speed, the gain decides."""
    limit = osik.ConfigurationLimit(arm, gain=0.5)
    _, upper = osik.limit_box(arm, jnp.asarray(UPPER + 1e-4), (limit,), 0.005)
    np.testing.assert_allclose(upper, [-0.01] * 3, rtol=1e-6)


def test_an_acceleration_limit_of_some_joints_lets_none_return_faster(arm):
    """It has bounds of its own for joints outside their ranges, which once led back in one step."""
    for limit in (osik.AccelerationLimit(arm, {"a": 1e3}), osik.AccelerationLimit(arm, {"*": 1e3})):
        answer = osik.solve(arm, OUT, held(arm, OUT), limits=(limit,), dt=0.005)
        np.testing.assert_allclose(answer.velocity, [-0.5, -0.5, -0.25], atol=1e-9)
    slow = osik.AccelerationLimit(arm, {"*": 10.0})
    answer = osik.solve(arm, OUT, held(arm, OUT), limits=(slow,), dt=0.005)
    np.testing.assert_allclose(answer.velocity, [-0.05] * 3, atol=1e-9)
    faster = osik.AccelerationLimit(arm, {"*": 1e3}, return_speed={"*": 2.0})
    np.testing.assert_allclose(osik.limit_box(arm, jnp.asarray(OUT), (faster,), 0.005)[1], [-2.0] * 3)


def test_a_soft_limit_is_bounded_too(arm):
    task = osik.LimitTask(arm, osik.ConfigurationLimit(arm), priority=1)
    answer = osik.solve(arm, OUT, {"limit": task}, limits=osik.no_limits, dt=0.005)
    np.testing.assert_allclose(answer.velocity, [-0.5, -0.5, -0.25], atol=1e-4)


@pytest.mark.parametrize("home", [OUT, {"b": 1.0}], ids=["array", "mapping"])
def test_a_home_outside_is_kept_with_a_warning(arm, home):
    with pytest.warns(osik.OsikWarning, match=r"b is (1|0\.884398), its range is \[-1\.5708, 0\.785398\]"):
        moved = arm.with_home(home)
    np.testing.assert_allclose(moved.q0, OUT if isinstance(home, np.ndarray) else [0.0, 1.0, 0.0])
    with pytest.warns(osik.OsikWarning, match="kept as given"):
        np.testing.assert_allclose(osik.Robot.from_mjcf(ARM, home=home, floating_base=False).q0, moved.q0)


@pytest.mark.parametrize("home", ["outside", 1], ids=["keyframe", "its number"])
def test_a_keyframe_outside_is_brought_inside_with_a_warning(arm, home):
    with pytest.warns(osik.OsikWarning, match=r"b is 1, its range is .*0\.785398"):
        moved = arm.with_home(home)
    np.testing.assert_allclose(moved.q0, [0.0, np.pi / 4, 0.0])
    with pytest.warns(osik.OsikWarning, match="b is 1, its"):
        np.testing.assert_allclose(osik.Robot.from_mjcf(ARM, home=home, floating_base=False).q0, moved.q0)


def test_a_home_that_is_out_by_a_rounding_is_brought_inside_without_a_word(arm, recwarn):
    moved = arm.with_home(UPPER + 1e-8)
    assert (np.asarray(moved.q0) <= np.asarray(arm.position_upper)).all() and not recwarn.list


def test_inverse_kinematics_starts_from_a_configuration_outside(arm):
    goal = osik.forward_kinematics(arm, jnp.array([0.3, -0.4, 0.1])).frame_pose(arm, "tip")[0]
    found = osik.inverse_kinematics(arm, {"tip": goal}, q0=jnp.asarray(OUT), seeds=4)
    assert found.converged and (np.asarray(found.q) <= UPPER).all()
