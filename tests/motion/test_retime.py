"""Least time along paths, beside dense samples in NumPy, closed forms and central differences."""

import subprocess
import sys
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from products import HIGHEST, products_of
from scipy.interpolate import CubicSpline

import osik_jax as osik
from osik_jax.motion import retime

VELOCITY = np.array([2.175, 2.0, 2.61])
ACCELERATION = np.array([15.0, 7.5, 20.0])
JERK = np.array([300.0, 100.0, 500.0])
LIMITS: dict[str, Any] = {"velocity": VELOCITY, "acceleration": ACCELERATION}
POINTS = np.cumsum(np.random.default_rng(0).normal(size=(6, 3)) * 0.5, axis=0)
CELLS = 120
KINDS = "velocity", "acceleration", "jerk"


@partial(jax.jit, static_argnames="smooth")
def timed(points, velocity, acceleration, jerk, smooth=False):
    more = {"jerk": jerk} if smooth else {}
    return retime(points, velocity=velocity, acceleration=acceleration, cells=CELLS, **more)


def run(
    points: Any = POINTS, velocity: Any = VELOCITY, acceleration: Any = ACCELERATION, jerk: Any = JERK, smooth=False
):
    return timed(points, velocity, acceleration, jerk, smooth=smooth)


@pytest.mark.parametrize("count", [777, 5000])
def test_limits_hold_at_the_last_of_many_samples(count) -> None:
    """The squared rate is 0 there by cancellation, which XLA may compute twice with different rounding."""
    timing = run()
    _, v, a, _ = np.asarray(timing.at(jnp.linspace(0.0, float(timing.duration), count)))
    assert (np.abs(a) <= 1.0001 * ACCELERATION).all()
    np.testing.assert_allclose(a[-1], a[-2], rtol=0.02, atol=0.02)
    np.testing.assert_array_equal(v[-1], 0.0)


@pytest.mark.parametrize("smooth", [False, True])
def test_limits_hold_between_samples_and_nothing_jumps(smooth) -> None:
    for seed in range(3):
        points = np.cumsum(np.random.default_rng(seed).normal(size=(6, 3)) * 0.5, axis=0)
        timing = run(points, smooth=smooth)
        time = np.linspace(0.0, float(timing.duration), 1 << 13)
        q, v, a, j = np.asarray(timing.at(jnp.asarray(time)))
        np.testing.assert_allclose(q[[0, -1]], points[[0, -1]], atol=1e-9)
        # of NumPy's differences: velocities and accelerations are those of the positions
        dt = time[1]
        seen_v, seen_a = np.diff(q, axis=0) / dt, np.diff(q, n=2, axis=0) / dt**2
        assert (np.abs(seen_v) <= 1.0001 * VELOCITY).all() and (np.abs(seen_a) <= 1.0001 * ACCELERATION).all()
        np.testing.assert_allclose(seen_v, 0.5 * (v[1:] + v[:-1]), atol=2e-3)
        assert np.abs(v[[0, -1]]).max() < 1e-6
        if smooth:
            assert (np.abs(j) <= 1.0001 * JERK).all() and (np.abs(np.diff(a, axis=0)) <= 1.01 * JERK * dt + 1e-6).all()
            assert np.abs(a[[0, -1]]).max() < 1e-3 * ACCELERATION.max()


def test_the_path_is_the_not_a_knot_spline() -> None:
    timing = run()
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(POINTS, axis=0), axis=1)))
    s = np.linspace(0.0, 1.0, 50)
    wanted = CubicSpline(along / along[-1], POINTS)(s)
    np.testing.assert_allclose(timing.path.derivatives(jnp.asarray(s))[0], wanted, atol=1e-9)


def test_a_straight_line_takes_the_time_of_the_closed_form() -> None:
    line = np.array([[0.0, 0.0, 0.0], [0.5, 1.0, 0.2]])
    v, a = 2.0, 7.5  # of the second joint, which limits the line
    np.testing.assert_allclose(retime(line, **LIMITS, cells=CELLS).duration, 1.0 / v + v / a, rtol=1e-3)
    smooth = retime(line, **LIMITS, jerk=JERK).duration
    assert 1.0 <= smooth / (1.0 / v + v / a + a / JERK[1]) < 1.02


def test_the_time_is_least() -> None:
    """Some limit is reached nearly everywhere: of speed or of acceleration."""
    timing = retime(POINTS, **LIMITS, cells=1000)
    time = jnp.linspace(0.0, float(timing.duration), 1000)
    _, v, a, _ = np.abs(np.asarray(timing.at(time)))
    used = np.maximum((v / VELOCITY).max(axis=1), (a / ACCELERATION).max(axis=1))
    assert used.max() <= 1.0001
    assert (used > 0.97).mean() > 0.95


ARGUMENTS = jnp.asarray(POINTS), jnp.asarray(VELOCITY), jnp.asarray(ACCELERATION), jnp.asarray(JERK)


@partial(jax.jit, static_argnames="smooth")
def gradient(smooth: bool, *given):
    """By all arguments at once: a program for each would take as long to compile."""
    return jax.grad(lambda *given: run(*given, smooth=smooth).duration, argnums=(0, 1, 2, 3))(*given)


def check_slope(kind: int, smooth: bool, seed: int = 0) -> None:
    """Compare the duration's derivative along a random change of one argument with its central difference."""
    points = np.cumsum(np.random.default_rng(seed).normal(size=(6, 3)) * 0.5, axis=0)
    arguments = jnp.asarray(points), *ARGUMENTS[1:]
    change = jnp.asarray(np.random.default_rng(kind).normal(size=ARGUMENTS[kind].shape)) * ARGUMENTS[kind].std()
    step, ends = 1e-6 if smooth else 1e-5, []
    for sign in (step, -step):
        given = [a + sign * change if i == kind else a for i, a in enumerate(arguments)]
        ends.append(float(run(*given, smooth=smooth).duration))
    wanted = (ends[0] - ends[1]) / (2.0 * step)
    np.testing.assert_allclose((gradient(smooth, *arguments)[kind] * change).sum(), wanted, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_duration_has_the_derivatives_of_central_differences(kind) -> None:
    check_slope(kind, smooth=False)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", [0, 1, 2, 3])
def test_with_jerk_too_stretch_and_grid_count(kind, seed) -> None:
    check_slope(kind, True, seed)


@pytest.mark.slow
def test_both_modes_give_the_same_derivative_with_jerk() -> None:
    moved = jax.jvp(lambda points: run(points, smooth=True).duration, (ARGUMENTS[0],), (ARGUMENTS[0] ** 2,))[1]
    np.testing.assert_allclose(moved, (gradient(True, *ARGUMENTS)[0] * ARGUMENTS[0] ** 2).sum(), rtol=1e-9)


@pytest.mark.slow
def test_without_a_limit_of_speed_gradients_are_finite() -> None:
    def duration(points, acceleration):
        return retime(points, acceleration=acceleration, cells=40).duration

    for found in jax.jit(jax.grad(duration, argnums=(0, 1)))(ARGUMENTS[0], ARGUMENTS[2]):
        assert np.isfinite(found).all() and np.abs(found).max() > 0.01


SINGLE = """
import numpy as np
from osik_jax.motion import retime
points = np.cumsum(np.random.default_rng(0).normal(size=(6, 3)) * 0.5, axis=0)
found = retime(points, velocity=[2.175, 2.0, 2.61], acceleration=[15.0, 7.5, 20.0], jerk=[300.0, 100.0, 500.0],
    cells=120)
assert found.duration.dtype == np.float32
print(found.duration)
"""


@pytest.mark.slow
def test_in_single_precision_the_time_is_nearly_the_same() -> None:
    found = subprocess.run([sys.executable, "-c", SINGLE], capture_output=True, text=True, check=True)
    np.testing.assert_allclose(float(found.stdout), run(smooth=True).duration, rtol=2e-3)


def test_many_paths_in_one_call() -> None:
    paths = np.cumsum(np.random.default_rng(1).normal(size=(4, 6, 3)) * 0.5, axis=1)
    many = jax.vmap(lambda points: run(points).duration)(paths)
    np.testing.assert_allclose(many, [run(points).duration for points in paths], rtol=1e-9)
    paths[1] = np.nan
    np.testing.assert_allclose(jax.vmap(lambda points: run(points).duration)(paths)[2:], many[2:], rtol=1e-9)


@pytest.mark.slow
def test_a_wanted_speed_is_kept_where_joints_allow() -> None:
    arm = osik.load_robot("arm7")
    points = np.asarray(arm.q0) + np.linspace(0.0, 1.0, 5)[:, None] * np.array([0.8, 0.3, 0.2, 0.4, 0.0, 0.2, 0.0])
    given: dict[str, Any] = {"robot": arm, "frame": "hand", "acceleration": 5.0, "cells": CELLS}
    timing = retime(points, speed=0.2, **given)
    time = np.linspace(0.0, float(timing.duration), 512)
    q = np.asarray(timing.at(jnp.asarray(time)))[0]
    place = jax.vmap(lambda q: osik.forward_kinematics(arm, q).frame_pose(arm, "hand")[0])(jnp.asarray(q))
    speed = np.linalg.norm(np.diff(np.asarray(place), axis=0), axis=1) / time[1]
    assert speed.max() <= 0.2001 and (speed > 0.199).mean() > 0.8
    parts = timing.slow_parts(speed, time[:-1])
    assert len(parts) == 2 and {part.limit for part in parts} == {"acceleration"}  # at both ends
    assert parts[0].joint in timing.joints and parts[0].slowest < 0.05


@pytest.mark.parametrize(
    "points, more, message",
    [
        (np.full((3, 3), np.nan), {}, "waypoint 0 is not finite"),
        (POINTS, {"velocity": -1.0}, "limits of velocity are positive"),
        (POINTS, {"velocity": [1.0, 2.0]}, "velocity has shape"),
        (POINTS, {"velocity": {"a": 1.0}}, "names need robot="),
    ],
)
def test_what_cannot_be_is_refused(points, more, message) -> None:
    with pytest.raises(osik.OsikError, match=message):
        retime(points, **(LIMITS | more))


SPOILT = [14, 42, 54, 67, 72, 85, 90, 126]
SPOILT_IN_DOUBLE = [3.952204, 3.651776, 2.889975, 3.593925, 4.035552, 2.963671, 4.068738, 3.431544]
"""Durations in double precision [s], which the variant of all paths computes."""


@pytest.mark.variants(release=["all"])
@pytest.mark.parametrize("some", [SPOILT, slice(None)], ids=["spoilt", "all"])
def test_single_precision_is_finite_and_hardly_slower(some):
    """128 paths with limits of jerk; rounding spoils the exact matrix of eight."""
    paths = np.cumsum(np.random.default_rng(0).normal(0.0, 0.5, (128, 6, 7)), axis=1)[some]

    @partial(jax.jit, static_argnames="kind")
    def durations(kind):
        limits: dict[str, Any] = {
            name: jnp.full(7, most, kind) for name, most in zip(KINDS, (2.0, 5.0, 500.0), strict=True)
        }
        return jax.vmap(lambda p: retime(p, **limits).duration)(jnp.asarray(paths, kind))

    single, double = np.asarray(durations(np.float32)), np.asarray(SPOILT_IN_DOUBLE)
    if some != SPOILT:
        double = np.asarray(durations(np.float64))
        np.testing.assert_allclose(double[SPOILT], SPOILT_IN_DOUBLE, rtol=1e-6)
    assert single.dtype == np.float32 and np.isfinite(single).all()
    assert (single / double).max() < 1.03 and (single / double).min() > 0.999


def test_products_are_in_full_precision():
    """A GPU takes TF32 otherwise, and the barrier method doubles the duration."""
    call = jax.value_and_grad(lambda p: run(p, smooth=True).duration)
    products = list(products_of(jax.make_jaxpr(call)(POINTS).jaxpr))
    assert len(products) > 5 and all(precision == (HIGHEST, HIGHEST) for precision in products)
