"""``limits=`` adds to the robot's own joint ranges and speed limits, wherever it is taken."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_files import mjcf

import osik_jax as osik
from osik_jax import physics, reachability, tuning
from osik_jax.viewer.live._desk import Session

SPEEDS = {"a": 1.0, "b": 2.0}
DT = 0.01


@pytest.fixture(scope="module")
def arm():
    return osik.Robot.from_mjcf(mjcf("planar_arm"), velocity_limits=SPEEDS, floating_base=False)


def added(arm) -> dict[str, osik.Limit]:
    """One limit of each class that is not among the robot's own, loose enough to bind nowhere by itself."""
    post = osik.CollisionShape.sphere(0.05, np.array([9.0, 0.0, 0.0]))
    palm = osik.CollisionShape.sphere(0.02, frame="tip")
    return {
        "acceleration": osik.AccelerationLimit(arm, {"*": 1e6}),
        "collision": osik.CollisionAvoidanceLimit(arm, shapes={"post": post, "palm": palm}, pairs=[("palm", "post")]),
        "barrier": osik.PositionBarrier(arm, "tip", upper=9.0),
        "linear": osik.LinearLimit(arm, np.ones((1, 2)), upper=1e3),
        "base": osik.FloatingBaseVelocityLimit(osik.load_robot("nao"), linear=1.0),
    }


def box(arm, limits: Any, q: Any = None):
    problem = osik.build_problem(arm, arm.q0 if q is None else q, {"p": osik.PostureTask(arm)}, limits=limits, dt=DT)
    return np.stack([problem.lower, problem.upper])


FAR = np.array([1.0, 0.7])
"""A configuration from which the range binds joint a, the speed joint b, at most."""


@pytest.mark.variants(release=["collision", "acceleration"])
@pytest.mark.parametrize("name", ["acceleration", "collision", "barrier", "linear"])
def test_the_own_box_holds_beside_any_other_limit(arm, name):
    expected = np.array([[-1.0, -2.0], [(np.pi / 3 - 1.0) / DT, (np.pi / 4 - 0.7) / DT]]).clip([-1.0, -2.0], [1.0, 2.0])
    np.testing.assert_allclose(box(arm, None, FAR), expected, atol=1e-12)
    np.testing.assert_allclose(box(arm, (added(arm)[name],), FAR), expected, atol=1e-12)


def test_none_and_an_empty_sequence_are_the_robots_own(arm):
    for limits in (None, (), []):
        np.testing.assert_allclose(box(arm, limits, FAR)[0], [-1.0, -2.0])


def test_a_limit_of_the_same_class_replaces_the_own_one(arm):
    faster = box(arm, (osik.VelocityLimit(arm, velocity={"*": 5.0}),), FAR)
    np.testing.assert_allclose(faster, [[-5.0, -5.0], [(np.pi / 3 - 1.0) / DT, 5.0]])
    wider = box(arm, [osik.ConfigurationLimit(arm, upper={"*": 2.0})], FAR)
    np.testing.assert_allclose(wider, [[-1.0, -2.0], [1.0, 2.0]])


def test_a_subclass_replaces_its_class(arm):
    class Slow(osik.VelocityLimit):
        """Half the speed."""

        def box(self, robot, q, dt):
            return -0.5 * self.velocity, 0.5 * self.velocity

    np.testing.assert_allclose(box(arm, (Slow(arm),)), [[-0.5, -1.0], [0.5, 1.0]])


def test_no_limits_are_asked_for_by_name(arm):
    free = np.array([[-np.inf] * 2, [np.inf] * 2])
    np.testing.assert_array_equal(box(arm, osik.no_limits, FAR), free)
    np.testing.assert_array_equal(box(arm, (osik.no_limits,), FAR), free)
    alone = box(arm, (osik.no_limits, osik.VelocityLimit(arm)), FAR)
    np.testing.assert_array_equal(alone, [[-1.0, -2.0], [1.0, 2.0]])
    assert repr(osik.no_limits) == "osik_jax.no_limits"


def test_a_limit_of_another_robot_is_refused_beside_no_limits(arm):
    with pytest.raises(ValueError, match=r"limits\[1\] is a FloatingBaseVelocityLimit that was made for another robot"):
        box(arm, (osik.no_limits, added(arm)["base"]))


@pytest.mark.variants(release=["collision"])
@pytest.mark.parametrize("name", ["acceleration", "collision"])
def test_a_rollout_stays_in_the_ranges_and_speeds(arm, name):
    """The reported case: with a collision limit alone, joints ran 3.9 rad out of their ranges."""
    posture = {"p": osik.PostureTask(arm, target=arm.q0 + 6.0)}
    path = osik.rollout(arm, arm.q0, posture, limits=(added(arm)[name],), dt=DT, steps=200)
    assert (np.asarray(path.q) <= np.asarray(arm.position_upper)).all()
    np.testing.assert_allclose(path.q[-1], arm.position_upper, atol=1e-3)
    assert (np.abs(path.solution.velocity) <= np.asarray(arm.velocity_limit)).all()


def test_no_limits_in_a_rollout_go_where_the_task_says(arm):
    posture = {"p": osik.PostureTask(arm, target=arm.q0 + 6.0)}
    path = osik.rollout(arm, arm.q0, posture, limits=osik.no_limits, dt=DT, steps=200)
    np.testing.assert_allclose(path.q[-1], arm.q0 + 6.0, atol=1e-3)


def test_the_robots_numbers_stay_leaves(arm):
    """Own limits are made from the robot inside the step, so they follow a robot that is swept."""

    def upper(speed):
        faster = eqx.tree_at(lambda robot: robot.velocity_limit, arm, speed)
        return osik.build_problem(
            faster, arm.q0, {"p": osik.PostureTask(arm)}, limits=(added(arm)["linear"],), dt=DT
        ).upper

    np.testing.assert_allclose(jax.jacobian(upper)(jnp.array([0.3, 0.4])), np.eye(2))


def test_a_tuning_loop_names_the_given_limits_first(arm):
    loop = tuning.Loop(arm, {"p": osik.PostureTask(arm)}, limits=(added(arm)["linear"],), dt=DT, steps=1)
    assert [type(limit).__name__ for limit in loop.limits] == ["LinearLimit", "ConfigurationLimit", "VelocityLimit"]
    free = tuning.Loop(arm, {"p": osik.PostureTask(arm)}, limits=osik.no_limits, dt=DT, steps=1)
    assert not any(name.startswith("limits") for name in free.names)
    np.testing.assert_array_equal(box(arm, free.limits), box(arm, osik.no_limits))


BEYOND = np.array([1.5, -0.5])
"""Joint a is 0.45 rad beyond its range; no other configuration brings the tip to this pose."""


@pytest.mark.variants(slow=["speed"], release=["barrier"])
@pytest.mark.parametrize("name", ["speed", "barrier"])
def test_inverse_kinematics_keeps_the_ranges_beside_other_limits(arm, name):
    limits = {"speed": osik.VelocityLimit(arm), "barrier": added(arm)["barrier"]}
    pose = osik.forward_kinematics(arm, jnp.asarray(BEYOND)).frame_pose(arm, "tip")
    search: Any = dict(seeds=4, restarts=0)
    found = osik.inverse_kinematics(arm, {"tip": pose}, limits=(limits[name],), **search)
    assert not found.converged and (found.q <= arm.position_upper).all()
    free = osik.inverse_kinematics(arm, {"tip": pose}, limits=(osik.no_limits, limits[name]), **search)
    np.testing.assert_allclose(np.exp(1j * np.asarray(free.q)), np.exp(1j * BEYOND), atol=0.02)  # whole turns are free


def test_a_reachability_map_keeps_the_ranges_beside_other_limits(arm):
    position, rotation = osik.forward_kinematics(arm, jnp.asarray(BEYOND)).frame_pose(arm, "tip")
    settings: Any = dict(
        grid=tuple(np.asarray(position)[:, None]), orientations=rotation[None], seeds=4, progress=False
    )
    for limits, is_reached in (((osik.VelocityLimit(arm),), False), (osik.no_limits, True)):
        found = reachability.reachability_map(arm, "tip", limits=limits, **settings)
        assert found.reached.item() == is_reached


def test_a_session_has_the_own_limits_to_switch_off(arm):
    session = Session(
        arm, {"p": osik.PostureTask(arm)}, osik.WeightedQP(), (added(arm)["linear"],), DT, np.asarray(arm.q0)
    )
    assert [type(limit).__name__ for limit in session.limits] == ["LinearLimit", "ConfigurationLimit", "VelocityLimit"]
    np.testing.assert_array_equal(box(arm, session.active_limits), box(arm, None))


def test_a_simulation_keeps_the_speeds_beside_other_limits(arm):
    simulation = physics.Simulation(physics.build_world(arm, servos={"*": physics.Servo(100.0, 10.0)}))
    posture = {"p": osik.PostureTask(arm, target=arm.q0 + 6.0)}
    recording = physics.simulate(simulation, posture, limits=(added(arm)["linear"],), dt=DT, steps=2)
    np.testing.assert_allclose(recording.solution.velocity, [[1.0, 2.0]] * 2)
