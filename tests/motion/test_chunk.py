"""Chunks of waypoints beside SciPy's splines and optimiser, NumPy's differences and central differences."""

import subprocess
import sys
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.optimize import LinearConstraint, minimize

import osik_jax as osik
from osik_jax.motion import chunk

ARM = osik.load_robot("arm7")
HOME = np.asarray(ARM.q0)
REST = np.zeros(7)
LIMITS: dict[str, Any] = {"velocity": 1.5, "acceleration": 4.0, "jerk": 40.0}
TIMES = np.linspace(0.0, 1.0, 12)


@partial(jax.jit, static_argnames="rest")
def planned(waypoints, start, begin, limits, rest=True):
    return chunk(ARM, waypoints, TIMES + begin - 0.1, start=start, begin=begin, **limits, rest=rest)


def walk(rng, size=0.15):
    return HOME + np.clip(np.cumsum(rng.normal(size=(12, 7)) * size, axis=0), -0.6, 0.6)


def spline(found) -> BSpline:
    """The same spline in SciPy."""
    knots = float(found.begin) + float(found.width) * np.arange(-3, len(found.coefficients) + 1)
    return BSpline(knots, np.asarray(found.coefficients), 3)


def test_chunks_join_without_a_step_and_keep_all_limits(rng) -> None:
    start, begin = (HOME, REST, REST), 0.0
    for _ in range(5):
        found = planned(walk(rng), start, begin, LIMITS)
        assert found.feasible.all()
        time = np.linspace(begin, float(found.end), 2000)
        states = np.asarray(found.at(time))
        for order in range(3):
            np.testing.assert_allclose(states[order], spline(found)(time, order), atol=1e-9)
            np.testing.assert_allclose(found.state(begin)[order], start[order], atol=1e-9)
        np.testing.assert_allclose(states[1:3, -1], 0.0, atol=1e-9)
        for own, limit in zip(states[1:], LIMITS.values(), strict=True):
            assert np.abs(own).max() <= (1.0 + 1e-9) * limit
        dt = time[1] - time[0]
        assert np.abs(np.diff(states[0], n=3, axis=0)).max() <= 1.001 * LIMITS["jerk"] * dt**3
        begin += 0.35
        start = found.state(begin)


def test_the_answer_is_the_optimum_of_another_solver(rng) -> None:
    """One joint, at rest first, by SciPy's SLSQP with the limits on differences of the coefficients."""
    points = HOME + np.cumsum(rng.normal(size=(12, 7)) * 0.05, axis=0)
    found = chunk(ARM, points, TIMES, rest=False, cells=8, velocity=0.5, acceleration=4.0, smoothing=1e-2)
    knots, width = spline(found).t, float(found.width)
    basis = BSpline.design_matrix(np.minimum(TIMES, 1.0 - 1e-12), knots, 3).toarray()
    third, first = (np.diff(np.eye(11), n=order, axis=0) for order in (3, 1))
    second = np.diff(np.eye(11), n=2, axis=0)

    def cost(c, of):
        return 500.0 * (((basis @ c - points[:, of]) ** 2).sum() + 1e-2 * ((third @ c) ** 2).sum())

    for joint in (0, 4):
        limits = [
            LinearConstraint(np.eye(3, 11), *[np.full(3, points[0, joint])] * 2),
            LinearConstraint(first, -0.5 * width, 0.5 * width),
            LinearConstraint(second, -4.0 * width**2, 4.0 * width**2),
        ]
        guess = np.full(11, points[0, joint])
        wanted = minimize(cost, guess, (joint,), "SLSQP", constraints=limits, options={"ftol": 1e-14, "maxiter": 500})
        own = np.asarray(found.coefficients)[:, joint]
        assert cost(own, joint) <= wanted.fun * (1.0 + 1e-6)
        np.testing.assert_allclose(own, wanted.x, atol=1e-4)


def test_a_time_that_rounding_puts_before_the_begin_is_in_motion(rng) -> None:
    fast = np.full(7, 0.5)
    found = planned(walk(rng, 0.05), (HOME, fast, REST), 0.1 + 0.2, LIMITS)
    for time in (0.3, np.nextafter(0.3, 0.0)):
        np.testing.assert_allclose(found.state(time)[1], fast, atol=1e-9)
    np.testing.assert_array_equal(found.state(0.299)[1], 0.0)


SINGLE = """
import numpy as np
import osik_jax as osik
from osik_jax.motion import chunk
arm, rng = osik.load_robot("arm7"), np.random.default_rng(0)
limits, times, rest = {"velocity": 0.6, "acceleration": 4.0, "jerk": 40.0}, np.linspace(0.0, 1.0, 30), np.zeros(7)
start, begin = (np.asarray(arm.q0), rest, rest), 0.0
for _ in range(20):
    points = np.asarray(start[0]) + np.cumsum(0.12 * rng.normal(size=(30, 7)), axis=0)
    found = chunk(arm, points, times + begin - 0.1, start=start, begin=begin, **limits)
    assert found.coefficients.dtype == np.float32 and found.feasible.all()
    rates = np.abs(np.asarray(found.at(np.linspace(begin, float(found.end), 1000)))[1:])
    assert (rates.max(axis=(1, 2)) <= 1.002 * np.array(list(limits.values()))).all()
    begin += 0.1 + 0.4 * rng.random()
    start = found.state(begin)
"""


@pytest.mark.slow
def test_a_stream_in_single_precision() -> None:
    """Each start is a state of the chunk before: its rates are at their limits but for rounding."""
    subprocess.run([sys.executable, "-c", SINGLE], check=True)


@pytest.mark.slow
def test_a_minimum_jerk_move_stays_calm() -> None:
    share = np.linspace(0.0, 1.0, 30)
    move = np.array([-0.1, 0.25, -0.295]) * 0.4 / np.hypot(np.hypot(0.1, 0.25), 0.295)

    def along(share):
        return (10.0 * share**3 - 15.0 * share**4 + 6.0 * share**5)[:, None] * move

    place, turn = osik.forward_kinematics(ARM, ARM.q0).frame_pose(ARM, "hand")
    poses = {"hand": (np.asarray(place) + along(share), np.tile(turn, (30, 1, 1)))}
    found = chunk(ARM, poses, 4.0 * share, acceleration=5.0, jerk=50.0)
    motion = found.sample(0.001)
    tool = jax.jit(jax.vmap(lambda q: osik.forward_kinematics(ARM, q).frame_pose(ARM, "hand")[0]))(motion.position)
    assert np.linalg.norm(np.diff(tool, n=2, axis=0), axis=1).max() / 0.001**2 <= 0.15  # 0.1443 of the move itself
    wanted = np.asarray(place) + along(np.clip(np.asarray(motion.time) / 4.0, 0.0, 1.0))
    assert np.linalg.norm(tool - wanted, axis=1).max() < 1e-4
    assert found.lag.max() < 1e-4
    poses["hand"][0][7] += 3.0
    with pytest.raises(osik.OsikError, match="pose 7 cannot be reached"):
        chunk(ARM, poses, 4.0 * share)


def test_limits_that_are_too_low_make_it_lag() -> None:
    line = HOME + TIMES[:, None] * np.array([1.0, 0, 0, 0, 0, 0, 0])
    found = planned(line, (HOME, REST, REST), 0.1, LIMITS | {"velocity": 0.3})
    assert found.feasible.all()
    assert 0.6 < found.lag[0] < 0.8 and found.lag[1:].max() < 1e-6
    np.testing.assert_allclose(np.abs(found.at(np.linspace(0.1, 1.0, 500))[1, :, 0]).max(), 0.3, rtol=1e-6)


@pytest.mark.slow
def test_derivatives_are_those_of_central_differences(rng) -> None:
    points, weights = walk(rng, 0.2), rng.normal(size=(4, 7))
    time = np.array([0.2, 0.5, 0.77, 0.9])

    @jax.jit
    @partial(jax.value_and_grad, argnums=(0, 1, 2))
    def value(points, velocity, acceleration):
        found = planned(points, (HOME, velocity, REST), 0.0, LIMITS | {"acceleration": acceleration}, rest=False)
        return jnp.sum(weights * found.at(time)[0])

    given = jnp.asarray(points), jnp.full(7, 0.1), jnp.asarray(4.0)
    for place, gradient in enumerate(value(*given)[1]):
        change = jnp.asarray(rng.normal(size=gradient.shape))
        ends = [value(*(a + h * change if i == place else a for i, a in enumerate(given)))[0] for h in (1e-6, -1e-6)]
        np.testing.assert_allclose(jnp.sum(gradient * change), (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_many_chunks_in_one_call(rng) -> None:
    points = np.stack([walk(rng) for _ in range(3)])
    run = partial(planned, start=(HOME, REST, REST), begin=0.0, limits=LIMITS)
    alone = [run(one).coefficients for one in points]
    points[1, 3] = np.nan
    many = jax.vmap(lambda points: run(points))(points)
    np.testing.assert_allclose(many.coefficients[::2], np.stack(alone)[::2], atol=1e-9)
    assert np.isfinite(many.coefficients).all() and np.isfinite(many.miss).all()
    np.testing.assert_array_equal(many.feasible.all(axis=1), [True, False, True])


def test_a_start_just_below_the_limit_of_speed_stays_below_it() -> None:
    """At 0.995 of the limit and still faster: the coefficients of the speed are above it, the speed is not."""
    for speed, pull in ((1.4927, 0.569), (1.35, 3.29), (1.4999, 0.08)):
        start = HOME, np.full(7, -speed) * np.eye(7)[0], np.full(7, -pull) * np.eye(7)[0]
        found = planned(HOME - 2.0 * TIMES[:, None] * np.eye(7)[0], start, 0.0, LIMITS)
        assert found.feasible.all()
        states = np.asarray(found.at(np.linspace(0.0, 0.3, 4000)))
        assert np.abs(states[1]).max() <= 1.5 * (1.0 + 1e-6)
        assert np.abs(states[1]).max() > 1.499  # and as fast as it may be


@pytest.mark.slow
def test_a_chunk_is_feasible_where_it_keeps_its_limits_and_only_there(rng) -> None:
    """Streams into the ends of ranges: where a chunk is not feasible, the running one goes on."""
    lower, upper = np.asarray(ARM.position_lower), np.asarray(ARM.position_upper)
    kept = []
    for _ in range(15):
        start, begin, running = (HOME, REST, REST), 0.0, None
        for _ in range(4):
            points = np.asarray(start[0]) + np.cumsum(0.25 * rng.normal(size=(12, 7)), axis=0)
            found = planned(points, start, begin, LIMITS)
            q, *rates = np.asarray(found.at(np.linspace(begin, float(found.end), 4000)))
            past = np.maximum(q - upper, lower - q).max(axis=0) <= 1e-6
            used = [np.abs(a).max(axis=0) <= (1.0 + 1e-6) * b for a, b in zip(rates, LIMITS.values(), strict=True)]
            assert (np.all([past, *used], axis=0) | ~np.asarray(found.feasible)).all()
            kept.append(bool(found.feasible.all()))
            running = found if kept[-1] or running is None else running
            begin += 0.4
            start = running.state(begin)
    assert np.mean(kept) > 0.9


def test_a_start_that_cannot_be_stopped_is_named() -> None:
    fast = np.array([1.4, 0, 0, 0, 0, 0, 0])
    edge = HOME + np.array([2.8 - HOME[0], 0, 0, 0, 0, 0, 0])
    with pytest.warns(osik.OsikWarning, match="cannot be stopped within the limits of joint1:"):
        found = chunk(ARM, np.tile(edge, (12, 1)), TIMES, start=(edge, fast, REST), **LIMITS)
    np.testing.assert_array_equal(found.feasible, np.arange(7) != 0)


@pytest.mark.parametrize(
    "more, message",
    [
        ({"waypoints": HOME[None], "times": TIMES[:1]}, "two waypoints or more"),
        ({"times": TIMES[:5]}, r"5 times need \(5, 7\)"),
        ({"waypoints": np.full((12, 7), np.nan)}, "waypoint 0 is not finite"),
        ({"start": (HOME, REST)}, "start is .position, velocity, acceleration., of 7 joints each"),
        ({"start": (HOME, REST, REST - 5.0)}, "start has the acceleration -5 of 'joint1', whose limit is at most 4"),
        ({"jerk": 0.0}, "limits of jerk are positive"),
        ({"cells": 4}, "cells is 4; it is an integer, at least 8"),
        ({"waypoints": {"hnd": np.zeros((12, 3))}}, "hnd"),
    ],
)
def test_what_cannot_be_is_refused(more, message) -> None:
    given = {"waypoints": np.tile(HOME, (12, 1)), "times": TIMES} | LIMITS | more
    with pytest.raises(osik.OsikError, match=message):
        chunk(ARM, **given)
