"""Streams of chunks: joins, limits and latency by NumPy's differences, and pushes that are not taken."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refuses

import osik_jax as osik
from osik_jax.motion import Stream

ARM = osik.load_robot("arm7")
HOME = np.asarray(ARM.q0)
LIMITS: dict[str, Any] = {"velocity": 1.5, "acceleration": 4.0, "jerk": 40.0}
TIMES = np.linspace(0.0, 1.0, 12)
push = jax.jit(Stream.push)


def stream() -> Stream:
    return Stream(ARM, HOME, latency=0.05, waypoints=12, **LIMITS)


def walk(rng, size=0.05) -> np.ndarray:
    return HOME + np.clip(np.cumsum(rng.normal(size=(12, 7)) * size, axis=0), -0.6, 0.6)


def test_chunks_become_one_motion_within_limits_and_take_over_after_the_latency(rng) -> None:
    own, dt, played = stream(), 1e-3, []
    for k in range(5):
        now = 0.4 * k
        before, own = own, push(own, walk(rng), TIMES + now, now)
        assert own.taken and float(own.after.begin) == pytest.approx(now + 0.05)
        time = now + dt * np.arange(400)
        states = np.asarray(own.at(time))
        np.testing.assert_allclose(states[:, :50], np.asarray(before.at(time[:50])), atol=1e-9)
        assert np.abs(states[0, 60:] - np.asarray(before.at(time[60:]))[0]).max() > 1e-4
        played.append(states)
    states = np.concatenate(played, axis=1)
    assert np.abs(np.diff(states[2], axis=0)).max() <= 1.001 * LIMITS["jerk"] * dt  # joins included
    assert np.abs(np.diff(states[1], axis=0)).max() <= 1.001 * LIMITS["acceleration"] * dt
    assert np.abs(np.diff(states[0], axis=0)).max() <= 1.001 * LIMITS["velocity"] * dt
    end = np.asarray(own.at(now + np.array([3.0])))
    np.testing.assert_allclose(end[1:], 0.0, atol=1e-9)


def test_a_push_that_is_early_late_or_wrong_leaves_the_motion_as_it_is(rng) -> None:
    own = push(stream(), walk(rng), TIMES, 0.0)
    time = np.linspace(0.0, 2.0, 100)
    for points, times, now in (
        (walk(rng), TIMES, 0.03),  # the first one has not taken over
        (walk(rng), TIMES, 0.97),  # its last waypoint is before it takes over
        (walk(rng) * np.nan, TIMES, 0.3),
    ):
        for kept in (
            push(own, points, times, now),
            *([] if np.isnan(points).any() else [own.push(points, times, now)]),
        ):
            assert not kept.taken
            np.testing.assert_array_equal(kept.at(time), own.at(time))
    assert push(own, walk(rng), TIMES + 0.3, 0.3).taken


def test_a_chunk_that_cannot_be_kept_within_limits_is_not_taken(rng) -> None:
    """The limits fall while the joints are faster than that."""
    own = push(stream(), HOME + 0.6 * TIMES[:, None] * np.ones(7), TIMES, 0.0)
    slower = eqx.tree_at(lambda own: own.limits, own, 0.3 * own.limits)
    found, time = push(slower, walk(rng), TIMES + 0.5, 0.5), np.linspace(0.5, 3.0, 100)
    assert not found.taken
    np.testing.assert_array_equal(found.at(time), own.at(time))


@pytest.mark.slow
def test_many_streams_are_those_of_a_loop(rng) -> None:
    walks = np.stack([walk(rng) for _ in range(3)])
    nows = np.array([0.0, 0.0, 0.02])
    own = push(stream(), walk(rng), TIMES - 0.3, -0.3)
    time = jnp.linspace(0.1, 0.9, 9)
    found = jax.jit(jax.vmap(lambda points, now: own.push(points, TIMES, now).at(time)))(walks, nows)
    for points, now, states in zip(walks, nows, found, strict=True):
        np.testing.assert_allclose(states, push(own, points, TIMES, now).at(time), atol=1e-9)


def test_what_cannot_be_is_refused() -> None:
    refuses(ValueError, "latency is 0", Stream, ARM, HOME, latency=0.0, waypoints=12)
    refuses(ValueError, "waypoints is 1", Stream, ARM, HOME, latency=0.1, waypoints=1)
    refuses(ValueError, "q has shape", Stream, ARM, HOME[:3], latency=0.1, waypoints=12)
    refuses(ValueError, "jerk", Stream, ARM, HOME, latency=0.1, waypoints=12, jerk=-1.0)
    nao = osik.load_robot("nao")
    refuses(ValueError, "other joints: floating_base", Stream, nao, nao.q0, latency=0.1, waypoints=12)
    refuses(ValueError, "the stream takes 12", stream().push, np.tile(HOME, (9, 1)), TIMES[:9], 0.0)
