"""Point to point: states at both ends, limits by NumPy's differences, durations by closed forms."""

import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import osik_jax as osik
from osik_jax.motion import chunk, move, retime

ruckig = pytest.importorskip("ruckig")

ARM = osik.load_robot("arm7")
HOME = np.asarray(ARM.q0)
REST = np.zeros(7)
LIMITS: dict[str, Any] = {"velocity": 1.5, "acceleration": 4.0, "jerk": 40.0}
LOWER, UPPER = np.asarray(ARM.position_lower), np.asarray(ARM.position_upper)


def random_state(rng) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    middle, half = 0.5 * (UPPER + LOWER), 0.5 * (UPPER - LOWER)
    return middle + 0.6 * half * rng.uniform(-1, 1, 7), rng.uniform(-0.7, 0.7, 7), rng.uniform(-2, 2, 7)


@pytest.mark.parametrize("jerk", [40.0, None])
def test_from_any_state_to_any_within_limits(rng, jerk) -> None:
    limits = LIMITS | {"jerk": jerk}
    for _ in range(20):
        start, goal = random_state(rng), random_state(rng)[:2]
        found = move(ARM, start, goal, **limits)
        time = np.linspace(0.0, float(found.duration), 4097)
        q, v, a, j = np.asarray(found.at(time))
        for own, wanted in zip((q[0], v[0], q[-1], v[-1]), (*start[:2], *goal), strict=True):
            np.testing.assert_allclose(own, wanted, atol=1e-7)
        dt = time[1]
        assert (np.abs(np.diff(q, axis=0)) <= 1.5 * dt + 1e-9).all()
        assert (np.abs(np.diff(q, n=2, axis=0)) <= 4.0 * dt**2 + 1e-9).all()
        np.testing.assert_allclose(np.diff(q, axis=0) / dt, 0.5 * (v[1:] + v[:-1]), atol=4.0 * dt)
        if jerk:
            np.testing.assert_allclose(a[[0, -1]], [start[2], REST], atol=1e-7)
            assert (np.abs(np.diff(a, axis=0)) <= 40.0 * dt + 1e-9).all() and np.abs(j).max() <= 40.0 + 1e-9


def test_the_duration_is_that_of_the_closed_form() -> None:
    """The joint with the longest way, at rest: it takes way / v + v / a + a / j."""
    goal = HOME + np.array([1.2, 0.3, 0.0, 0.2, 0.0, 0.0, 0.4])
    wanted = 1.2 / 1.5 + 1.5 / 4.0 + 4.0 / 40.0
    np.testing.assert_allclose(move(ARM, HOME, goal, **LIMITS).duration, wanted, rtol=1e-12)
    line = np.stack([HOME, goal])
    assert 1.0 <= retime(line, robot=ARM, **LIMITS).duration / wanted < 1.02


def test_it_goes_on_from_a_running_motion() -> None:
    times = np.linspace(0.0, 1.0, 16)
    running = chunk(ARM, HOME + np.sin(times)[:, None] * 0.4, times, **LIMITS)
    away = move(ARM, running.state(0.4), HOME, **LIMITS)
    for own, wanted in zip(away.state(0.0), running.state(0.4), strict=True):
        np.testing.assert_allclose(own, wanted, atol=1e-9)
    motion = away.sample(0.002)
    np.testing.assert_allclose(motion.position[-1], HOME, atol=1e-9)
    assert motion.joints == ARM.joint_names and motion.time[-1] >= away.duration > motion.time[-2]
    many = jax.jit(jax.vmap(lambda t: away.at(t[None])[0, 0]))(motion.time)  # a pytree of numbers
    np.testing.assert_allclose(many, motion.position, atol=1e-12)


SPINNER = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="spin" type="hinge" axis="0 0 1"/>
<geom size="0.1"/><body pos="0.1 0 0"><joint name="finger" type="slide" range="0 0.1"/><geom size="0.1"/></body>
<body pos="-0.1 0 0"><joint name="other" type="slide" range="0 0.1"/><geom size="0.1"/></body></body></worldbody>
<equality><joint joint1="other" joint2="finger" polycoef="0 0.5 0 0 0"/></equality></mujoco>"""


def test_a_joint_without_ends_turns_whole_turns_and_a_mimic_joint_follows() -> None:
    robot = osik.Robot.from_mjcf(SPINNER)
    assert robot.joint_names == ("spin", "finger")
    found = move(robot, np.array([0.1, 0.0]), np.array([0.1 + 4.0 * np.pi, 0.1]), velocity=2.0, acceleration=10.0)
    np.testing.assert_allclose(found.duration, 4.0 * np.pi / 2.0 + 2.0 / 10.0, rtol=1e-9)
    np.testing.assert_allclose(found.state(found.duration)[0], [0.1 + 4.0 * np.pi, 0.1], atol=1e-9)


FAST = np.array([1.4, 0, 0, 0, 0, 0, 0])
EDGE = np.array([UPPER[0] - 0.01, *HOME[1:]])


@pytest.mark.parametrize(
    "given, message",
    [
        ({"start": HOME + 9.0}, "start has the position .* of 'joint1', whose limit is -2.89"),
        ({"start": (HOME, REST)}, "start is .position, velocity, acceleration., of 7 joints each"),
        ({"goal": (HOME, REST - 2.0)}, "goal has the velocity -2"),
        ({"goal": HOME[:3]}, "goal is .position, velocity., of 7 joints each"),
        ({"goal": HOME * np.nan}, "goal"),
        ({"jerk": 0.0}, "limits of jerk are positive"),
        ({"acceleration": np.inf}, "no limit of acceleration"),
        ({"start": (EDGE, FAST, REST)}, "'joint1' passes the end of its range by 0.303"),
        ({"robot": osik.load_robot("nao")}, "hinges and slides alone"),
    ],
)
def test_what_cannot_be_is_refused(given, message) -> None:
    arguments = {"robot": ARM, "start": HOME, "goal": HOME} | LIMITS | given
    with pytest.raises(osik.OsikError, match=message):
        move(**arguments)


def test_in_jit_and_without_its_extra_it_says_so(monkeypatch) -> None:
    with pytest.raises(osik.OsikError, match="outside of jit"):
        jax.jit(lambda q: move(ARM, q, HOME, **LIMITS).duration)(jnp.asarray(HOME))
    monkeypatch.setitem(sys.modules, "ruckig", None)
    with pytest.raises(ModuleNotFoundError, match=r"a move needs ruckig: pip install \".\[planning\]\""):
        move(ARM, HOME, HOME + 0.1, **LIMITS)


@pytest.mark.parametrize("way", [0.1, 0.8])
def test_at_the_border_between_two_profiles(way) -> None:
    """A way of ``2 a^3 / j^2`` reaches the limit of acceleration for no time: Ruckig finds no profile by rounding."""
    limits = {"velocity": 2.61, "acceleration": 5.0 if way == 0.1 else 10.0, "jerk": 50.0}
    goal = HOME + way * np.eye(7)[5]
    assert move(ARM, HOME, goal, **limits).duration == pytest.approx(4.0 * limits["acceleration"] / 50.0, rel=1e-6)
