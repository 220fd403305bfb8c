"""Numbers that are probably in other units: one warning each, outside jit, and the numbers are taken as they are."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import osik_jax as osik

POINT = [0.4, 0.1, 0.5]


@pytest.fixture(scope="module")
def tasks(arm):
    return {"hand": osik.FrameTask(arm, "hand", rows="position", target=POINT)}


def told(call) -> list[str]:
    """The warnings of a call."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        call()
    return [str(w.message) for w in seen if issubclass(w.category, osik.OsikWarning)]


DEGREES = [0.0, 30.0, 0.0, -90.0, 0.0, 90.0, 45.0]


def test_degrees_of_a_configuration(arm, tasks):
    calls = {
        "configuration": lambda: arm.configuration({"joint2": 45.0, "joint4": -90.0}),
        "solve": lambda: osik.solve(arm, DEGREES, tasks),
        "rollout": lambda: osik.rollout(arm, DEGREES, tasks, steps=2),
        "inverse": lambda: osik.inverse_kinematics(arm, {"hand": POINT}, q0=jnp.array(DEGREES), seeds=2, restarts=0),
    }
    for name, call in calls.items():
        (message,) = told(call)
        assert "far outside the joints' ranges; it is in radians and metres" in message, name
        assert "joint4 is -90, its range is [" in message
    assert arm.configuration({"joint2": 0.3})[1] == pytest.approx(0.3)


def test_warnings_point_at_the_caller(arm):
    """Also through Equinox's wrappers of methods and constructors."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        arm.configuration({"joint2": 45.0})
        osik.VelocityLimit(arm, velocity={"*": 180.0})
    assert [w.filename for w in seen] == [__file__] * 2


def test_an_encoder_a_little_outside_is_silent(arm, tasks):
    q = np.asarray(arm.position_upper) + 0.01
    assert told(lambda: osik.solve(arm, q, tasks)) == []
    assert told(lambda: osik.rollout(arm, q, tasks, steps=2)) == []
    assert told(lambda: arm.configuration(dict(zip(arm.joint_names, q.tolist(), strict=True)))) == []


def test_millimetres_of_a_slide_and_far_bases_are_told_apart():
    robot = osik.Robot.from_mjcf("""<mujoco><worldbody><body><freejoint/><geom size=".1"/><body>
      <joint name="rail" type="slide" range="0 0.4"/><geom size=".1"/></body></body></worldbody></mujoco>""")
    (message,) = told(lambda: robot.configuration({"rail": 300.0}))
    assert "rail is 300, its range is [0, 0.4]" in message
    away = np.array([500.0, -80.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.2])
    assert told(lambda: osik.solve(robot, away, {"p": osik.PostureTask(robot)})) == []


def test_speeds_above_ten_times_the_files(arm):
    own = np.asarray(arm.velocity_limit)
    (message,) = told(lambda: osik.VelocityLimit(arm, velocity={"*": 180.0}))
    assert "velocity is more than ten times the file's; it is in rad/s and m/s" in message and "joint1: 180" in message
    (message,) = told(lambda: osik.load_robot("arm7", velocity_limits={"joint[12]": 180.0}))
    assert "velocity_limits is more than ten times" in message and "joint3" not in message
    for fine in (None, {"*": 20.0}, 9.9 * own, {"*": np.inf}):
        assert told(lambda fine=fine: osik.VelocityLimit(arm, velocity=fine)) == []


@pytest.mark.slow
def test_gains_that_diverge(arm, tasks):
    both = tasks | {"rest": osik.PostureTask(arm, gain=0.1)}
    for call in (lambda: osik.rollout(arm, arm.q0, both, dt=5, steps=2), lambda: osik.solve(arm, arm.q0, both, dt=5.0)):
        for _ in range(2):
            (message,) = told(call)
            assert "gain times dt is above 2; a gain counts as 1 / dt at most in a step of 5 s: hand (gain " in message
            assert "rest" not in message
    adaptive = {"hand": osik.FrameTask(arm, "hand", gain=osik.tasks.AdaptiveGain(300.0, 50.0, 10.0))}
    assert len(told(lambda: osik.solve(arm, arm.q0, adaptive, dt=0.01))) == 1
    assert told(lambda: osik.solve(arm, arm.q0, adaptive, dt=0.005)) == []
    exact = {"hand": osik.FrameTask(arm, "hand", gain=200.0)}
    assert told(lambda: osik.solve(arm, arm.q0, exact, dt=0.01)) == []


def test_nothing_is_said_inside_jit(arm, tasks):
    def run(q, dt, speed):
        limits = (osik.VelocityLimit(arm, velocity=speed),)
        return osik.solve(arm, q, tasks, dt=dt, limits=limits).velocity

    assert told(lambda: jax.jit(run)(jnp.array(DEGREES), 5.0, jnp.full(7, 500.0))) == []
