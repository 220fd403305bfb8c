"""Acceleration limits: viable whatever is chosen inside the box, maximal, and back from anywhere."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivative_checks import assert_exact, check
from refusals import refuses

import osik_jax as osik
from osik_jax.solvers import Status

MJCF = """
<mujoco>
  <worldbody>
    <body><joint name="rail" type="slide" axis="1 0 0" range="-1 1" limited="true"/><geom size="0.1"/></body>
  </worldbody>
</mujoco>
"""
STEPS = 200


@pytest.fixture(scope="module")
def rail():
    return osik.Robot.from_mjcf(MJCF)


class State(NamedTuple):
    """One joint, and its limits."""

    q: Any
    velocity: Any  # of the last step
    dt: Any
    acceleration: Any
    fastest: Any
    lower: Any
    upper: Any


def limits_of(robot, s):
    ranges = dict(lower={"rail": s.lower}, upper={"rail": s.upper}, return_speed={"rail": s.fastest})
    return (
        osik.ConfigurationLimit(robot, **ranges),
        osik.VelocityLimit(robot, velocity={"rail": s.fastest}),
        osik.AccelerationLimit(robot, {"rail": s.acceleration}, velocity={"rail": s.velocity}, **ranges),
    )


def box(robot, s):
    lower, upper = osik.limit_box(robot, s.q[None], limits_of(robot, s), s.dt)
    return lower[0], upper[0]


def needed(speed, s):
    """Way that braking needs from a speed on, the step with that speed included: a sum, not the limit's formula."""
    change = s.acceleration * s.dt
    count = np.ceil(np.maximum(speed, 0.0) / change)
    return s.dt * (count * speed - change * count * (count - 1.0) / 2.0)


def viable_by(s):
    """By how much braking at once would go beyond the range, or the velocity is too fast; 0 or less where viable."""
    change = s.acceleration * s.dt
    over = needed(s.velocity - change, s) - (s.upper - s.q)
    under = needed(-s.velocity - change, s) - (s.q - s.lower)
    return np.max([over, under, np.abs(s.velocity) - s.fastest], 0)


def drawn(rng, count):
    """Ranges, limits and steps over decades; a braking takes from one step to about a hundred."""
    dt = 10.0 ** rng.uniform(-3.5, -1.0, count)
    fastest = 10.0 ** rng.uniform(-1.0, 1.0, count)
    acceleration = fastest / dt / 10.0 ** rng.uniform(-0.5, 2.0, count)
    width = fastest * dt * 10.0 ** rng.uniform(-1.0, 2.5, count)
    middle = rng.normal(size=count)
    lower, upper = middle - width / 2.0, middle + width / 2.0
    q = rng.uniform(lower, upper)
    return State(q, rng.uniform(-fastest, fastest), dt, acceleration, fastest, lower, upper)


def viable(rng, count):
    """Drawn until viable: what is not is slowed down until it is."""
    s = drawn(rng, count)
    for _ in range(16):
        s = s._replace(velocity=np.where(viable_by(s) <= 0.0, s.velocity, 0.5 * s.velocity))
    s = s._replace(velocity=np.where(viable_by(s) <= 0.0, s.velocity, 0.0))
    assert (viable_by(s) <= 0.0).all()
    return s


@partial(jax.jit, static_argnames="count")
def closed_loop(robot, state, seed, *, count):
    """What went wrong most, over all steps, of each state; lanes prefer one end of the box, or change their mind."""

    def one(s, number):
        likes = jnp.array([13, 128, 243], jnp.uint32)[number % 3]

        def step(carry, _):
            q, velocity, worst, number = carry
            number = number * jnp.uint32(1664525) + jnp.uint32(1013904223)
            now = s._replace(q=q, velocity=velocity)
            lower, upper = box(robot, now)
            v = jnp.where((number >> 24) < likes, upper, lower)
            moved = q + v * s.dt
            size = jnp.abs(s.lower) + jnp.abs(s.upper) + s.fastest * s.dt
            wrong = jnp.stack(
                [
                    jnp.where(lower <= upper, 0.0, jnp.inf),
                    (jnp.abs(v) - s.fastest) / s.fastest,
                    (jnp.abs(v - velocity) - s.acceleration * s.dt) / (s.acceleration * s.dt + s.fastest),
                    jnp.maximum(moved - s.upper, s.lower - moved) / size,
                ]
            )
            return (moved, v, jnp.maximum(worst, wrong), number), None

        start = s.q, s.velocity, jnp.full(4, -jnp.inf), number
        (q, velocity, worst, _), _ = jax.lax.scan(step, start, length=count)
        return q, velocity, worst

    return jax.vmap(one)(state, jnp.arange(len(state.q), dtype=jnp.uint32) + jnp.uint32(seed))


@jax.jit
def boxes(robot, states):
    return jax.vmap(partial(box, robot))(states)


class TestClosedLoop:
    @pytest.mark.variants(release=["1000000"])
    @pytest.mark.parametrize("count", [5_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
    def test_never_breaks_a_limit(self, rail, count):
        """Extreme choices from viable states: box, speed, acceleration and range hold to rounding, at the end too."""
        start = viable(np.random.default_rng(11), count)
        q, velocity, worst = map(np.asarray, closed_loop(rail, jax.tree.map(jnp.asarray, start), 3, count=STEPS))
        np.testing.assert_array_less(worst.max(0), 1e-13)
        end = start._replace(q=q, velocity=velocity)
        assert (viable_by(end) / (np.abs(start.lower) + np.abs(start.upper) + start.fastest)).max() < 1e-13

    def test_the_next_state_is_viable_and_no_faster_one_is(self, rail):
        start = viable(np.random.default_rng(12), 20_000)
        lower, upper = map(np.asarray, boxes(rail, jax.tree.map(jnp.asarray, start)))
        assert (lower <= upper).all()
        size = np.abs(start.lower) + np.abs(start.upper) + start.fastest
        for v in (lower, upper):
            after = start._replace(q=start.q + v * start.dt, velocity=v)
            assert (viable_by(after) / size).max() < 1e-13
        ceiling = np.minimum(start.velocity + start.acceleration * start.dt, start.fastest)
        brakes = upper < ceiling - 1e-9 * np.abs(ceiling)
        assert brakes.sum() > 2_000
        exact = needed(upper, start) - (start.upper - start.q)
        assert np.abs(exact / size)[brakes].max() < 1e-13

    def test_from_anywhere(self, rail):
        """Outside the range and too fast: the acceleration holds, and the state is viable in the end."""
        rng = np.random.default_rng(13)
        start = drawn(rng, 3_000)
        width = start.upper - start.lower
        start = start._replace(
            q=start.q + width * rng.normal(size=len(width)), velocity=start.velocity * rng.uniform(0.0, 3.0, len(width))
        )
        assert (viable_by(start) > 0.0).mean() > 0.5
        states = jax.tree.map(jnp.asarray, start)
        lower, upper = map(np.asarray, boxes(rail, states))
        assert (lower <= upper).all()
        change = start.acceleration * start.dt
        for v in (lower, upper):
            assert (np.abs(v - start.velocity) <= change * (1.0 + 1e-12) + 1e-14 * np.abs(start.velocity)).all()
        beyond = (start.q > start.upper + start.fastest * start.dt) & (start.velocity > -start.fastest + change)
        back = needed(-(start.velocity - change), start) <= start.q - start.lower
        hardest = (start.velocity - change)[beyond & back]
        np.testing.assert_allclose(upper[beyond & back], hardest, rtol=1e-13, atol=1e-14)
        assert (beyond & back).sum() > 100
        q, velocity, _ = map(np.asarray, closed_loop(rail, states, 4, count=2_000))
        end = start._replace(q=q, velocity=velocity)
        assert (viable_by(end) / (np.abs(q) + np.abs(start.lower) + np.abs(start.upper) + start.fastest)).max() < 1e-13


class TestInTheLoop:
    @pytest.mark.slow
    def test_rollout_hands_the_velocity_on(self, arm):
        """The first step starts from the velocity that the limit was given; the loop by hand gives the same path."""
        tasks = {"posture": osik.PostureTask(arm, target=arm.q0 + 0.3, weight=1.0)}
        limit = osik.AccelerationLimit(arm, {"*": 5.0, "joint1": np.inf}, velocity=np.full(7, 0.2))
        limits, dt, scheme = (osik.ConfigurationLimit(arm), osik.VelocityLimit(arm)), 0.01, osik.WeightedQP()
        path = osik.rollout(arm, arm.q0, tasks, scheme=scheme, limits=(*limits, limit), dt=dt, steps=40)
        assert (path.solution.status == Status.SOLVED).all()
        speeds = np.concatenate([limit.velocity[None], path.solution.velocity])
        change = np.abs(np.diff(speeds, axis=0))
        assert change[:, 1:].max() <= 5.0 * dt * (1.0 + 1e-12)
        assert (change[:, 1:].max(0) > 5.0 * dt * (1.0 - 1e-9)).all()
        assert change[:, 0].max() > 5.0 * dt
        q = arm.q0
        for k in range(5):
            s = osik.solve(arm, q, tasks, scheme=scheme, limits=(*limits, limit), dt=dt)
            np.testing.assert_allclose(s.velocity, path.solution.velocity[k], rtol=0, atol=1e-12)
            q, limit = osik.integrate(arm, q, s.velocity, dt), limit.after(s.velocity)


class TestDerivatives:
    def test_against_differences(self, rail):
        """Of both ends of the box, with respect to the state, the step and every limit."""
        rng = np.random.default_rng(8)
        cases = viable(rng, 300)
        some = cases._replace(q=np.where(np.arange(300) % 3, cases.q, cases.upper + 0.1 * rng.uniform(size=300)))
        both = jax.tree.map(jnp.asarray, (some, State(*rng.normal(size=(7, 300)))))

        def path(both, t):
            return jax.tree.map(lambda leaf, rate: leaf * (1.0 + 1e-3 * t * rate), *both)

        assert_exact(check(lambda s: (jnp.stack(box(rail, s)), ()), path, both), most=0.8)

    def test_finite_on_a_bound(self, rail):
        """At rest on the ends of the range, beyond them, and nearly there."""
        q = jnp.array([1.0, 1.5, -1.0, 0.9999999])
        s = State(q, *(jnp.full(4, number) for number in (0.0, 0.01, 2.0, 1.0, -1.0, 1.0)))
        for mode in (jax.jacrev, jax.jacfwd):
            rates = jax.jit(jax.vmap(mode(lambda s: jnp.stack(box(rail, s)))))(s)
            for leaf in jax.tree.leaves(rates):
                assert np.isfinite(leaf).all()


class TestConstruction:
    def test_messages(self, arm):
        refuses(ValueError, r"acceleration has shape \(\)", osik.AccelerationLimit, arm, 1.0)
        with pytest.raises(ValueError, match="lower > upper"):
            osik.AccelerationLimit(arm, {"*": 1.0}, lower={"joint1": 5.0}, upper={"joint1": 4.0})
