"""Derivatives of a step with respect to every number: robot, q, tasks, scheme, limits, dt."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from arm_setting import SCHEMES, answer, arm_setting, solve, with_numbers
from derivative_checks import assert_exact, check
from jax.flatten_util import ravel_pytree

import osik_jax as osik

pytestmark = pytest.mark.slow

CASES = 1000
all_schemes = pytest.mark.parametrize("name", SCHEMES)


def scattered(rng, setting, spread, cases=CASES):
    """Cases around a setting and a change of each: all finite numbers, q along the tangent, rotations as rotations."""
    numbers, structure = eqx.partition(setting, eqx.is_inexact_array)

    def draw(a, scale):
        a = np.asarray(a)
        return np.where(np.isfinite(a), scale * rng.normal(size=(cases, *a.shape)) * np.where(a == 0.0, 0.1, a), 0.0)

    nv = setting[0].nv
    base = jax.tree.map(lambda a: np.asarray(a) + draw(a, 0.05), numbers)
    change = jax.tree.map(lambda a: draw(a, 0.3), numbers)
    moves = spread * rng.normal(size=(cases, nv)), rng.normal(size=(cases, nv))
    turns = 0.3 * rng.normal(size=(cases, 3)), rng.normal(size=(cases, 3))
    home = setting[1], setting[2]["hand"].target[1]

    def path(case, t):
        base, change, (move, v), (turn, w) = case
        now = eqx.combine(jax.tree.map(lambda a, b: a + t * b, base, change), structure)
        robot, _, tasks, *rest = now
        q = osik.integrate(robot, osik.integrate(robot, home[0], move), v, t)
        rotation = home[1] @ jaxlie.SO3.exp(turn).as_matrix() @ jaxlie.SO3.exp(t * w).as_matrix()
        hand = eqx.tree_at(lambda task: task.target[1], tasks["hand"], rotation)
        return (robot, q, {**tasks, "hand": hand}, *rest)

    return path, (base, change, moves, turns)


class TestStep:
    @pytest.mark.release
    @pytest.mark.variants(release=["hierarchical", "null-space"])
    @all_schemes
    def test_a_thousand_steps_of_the_arm(self, arm, rng, name):
        """Velocity, slacks and errors, along a change of everything at once."""
        path, cases = scattered(rng, arm_setting(arm, SCHEMES[name]), 0.4)
        assert_exact(check(answer, path, cases), most=0.9)


class TestFailedLanes:
    @pytest.mark.variants(release=["hierarchical", "null-space", "weighted"])
    @all_schemes
    def test_a_bad_lane_gives_shared_numbers_nothing(self, arm, rng, name):
        """The gradient with respect to what eight lanes share is that of the seven good ones, in both modes."""
        setting = arm_setting(arm, SCHEMES[name])
        numbers, structure = eqx.partition(setting, eqx.is_inexact_array)
        change = jax.tree.map(lambda a: jnp.where(jnp.isfinite(a), 0.1 * jnp.ones_like(a), 0.0), numbers)

        def total(shared, lanes, mask):
            def one(q, place, gain):
                s = solve(with_numbers(eqx.combine(shared, structure), q, place, gain))
                return jnp.sum(jnp.sin(s.velocity)), s.status

            values, status = jax.vmap(one)(*lanes)
            return jnp.sum(mask * values), status

        @jax.jit
        def run(lanes, mask):
            reverse, status = jax.grad(total, argnums=(0, 1), has_aux=True)(numbers, lanes, mask)
            return reverse, jax.jvp(lambda x: total(x, lanes, mask)[0], (numbers,), (change,))[1], status

        place = setting[2]["hand"].target[0]
        q, p, gain = arm.q0 + 0.3 * rng.normal(size=(8, 7)), place + 0.2 * rng.normal(size=(8, 3)), jnp.full(8, 2.0)
        (shared, own), forward, status = run((q, p, gain), jnp.ones(8).at[3].set(0.0))
        assert (status == osik.Status.SOLVED).all()
        assert abs(float(shared[2]["hand"].gain.maximum)) > 1e-3 and abs(float(forward)) > 1e-3
        spoiled = {
            "q": (q.at[3, 2].set(jnp.nan), p, gain),
            "target": (q, p.at[3].set(jnp.nan), gain),
            "gain": (q, p, gain.at[3].set(jnp.nan)),
            "infinite gain": (q, p, gain.at[3].set(jnp.inf)),
        }
        for what, lanes in spoiled.items():
            bad = run(lanes, jnp.ones(8))
            assert int(bad[2][3]) == osik.Status.NUMERICAL_ERROR, what
            assert (np.delete(bad[2], 3) == osik.Status.SOLVED).all(), what
            for a, b in zip(jax.tree.leaves(bad[:2]), jax.tree.leaves(((shared, own), forward)), strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12, err_msg=what)


class TestSingular:
    """Where a derivative may not exist, or be infinite or NaN if written carelessly: finite, the modes agree."""

    @pytest.mark.variants(release=["null-space", "weighted", "hierarchical"])
    @all_schemes
    def test_at_the_target_stretched_and_pinned(self, arm, name):
        """Errors of exactly 0, a stretched arm with a target out of reach, a joint at its bound, a pinned joint."""
        setting = arm_setting(arm, SCHEMES[name])
        pose = osik.forward_kinematics(arm, arm.q0).frame_pose(arm, "hand")
        stretched = jnp.zeros(7)
        reach = osik.forward_kinematics(arm, stretched).frame_pose(arm, "hand")
        far = reach[0] + jnp.array([0.0, 0.0, 1.0])
        touching = arm.q0.at[1].set(arm.position_upper[1])
        speeds = jnp.full(7, 0.8)
        corners = [
            (arm.q0, pose[0], pose[1], speeds),
            (stretched, reach[0], reach[1], speeds),
            (stretched, far, reach[1], speeds),
            (touching, far, pose[1], speeds),
            (arm.q0, far, pose[1], speeds.at[2].set(0.0)),
            (arm.q0, pose[0], pose[1], jnp.zeros(7)),
        ]
        numbers, structure = eqx.partition(setting, eqx.is_inexact_array)

        def values(x):
            numbers, q, place, turn, speeds = x
            robot, _, tasks, scheme, limits, dt = eqx.combine(numbers, structure)
            tasks = {**tasks, "hand": eqx.tree_at(lambda t: t.target, tasks["hand"], (place, turn))}
            limits = limits[0], eqx.tree_at(lambda limit: limit.velocity, limits[1], speeds)
            (floats, _) = answer((robot, q, tasks, scheme, limits, dt))
            return ravel_pytree(floats)[0]

        @jax.jit
        @jax.vmap
        def both(*corner):
            x = (numbers, *corner)
            change = jax.tree.map(
                lambda a: jnp.where(jnp.isfinite(a), jnp.cos(jnp.arange(a.size * 1.0)).reshape(a.shape), 0.0), x
            )
            value, forward = jax.jvp(values, (x,), (change,))
            cotangent = jnp.sin(jnp.arange(1.0, 1.0 + len(value)))
            (pulled,) = jax.vjp(values, x)[1](cotangent)
            backward = sum(
                jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(pulled), jax.tree.leaves(change), strict=True)
            )
            return forward, cotangent @ forward, backward, pulled

        forward, ahead, back, pulled = both(*(jnp.stack(a) for a in zip(*corners, strict=True)))
        assert all(np.isfinite(a).all() for a in jax.tree.leaves((forward, pulled)))
        np.testing.assert_allclose(back, ahead, rtol=1e-9, atol=1e-9 * np.abs(forward).max())
