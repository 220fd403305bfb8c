"""Second derivatives through a step, derivatives through a rollout, and what they keep in memory."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_setting import DT, SCHEMES, arm_setting, solve
from derivative_checks import assert_hessian
from jax.flatten_util import ravel_pytree

import osik_jax as osik

pytestmark = pytest.mark.slow

all_schemes = pytest.mark.parametrize("name", SCHEMES)


class TestHessian:
    @pytest.mark.variants(release=["null-space", "hierarchical", "weighted"])
    @all_schemes
    def test_of_a_step(self, arm, rng, name):
        """Forward over reverse, with speeds at their bounds, against central differences of the gradient; symmetric."""
        robot, _, tasks, scheme, limits, dt = arm_setting(arm, SCHEMES[name])
        hand, posture = tasks["hand"], tasks["posture"]
        place, rotation = hand.target

        def loss(x):
            aimed = {"hand": hand.replace(target=(x[7:10], rotation)), "posture": posture.replace(gain=x[10])}
            s = solve((robot, x[:7], aimed, scheme, limits, dt))
            return jnp.sum(jnp.sin(s.velocity)), (s.warm_start, jnp.abs(s.velocity) >= 0.8 - 1e-12)

        x = jnp.concatenate([arm.q0 + 0.3 * rng.normal(size=7), place + 0.2 * rng.normal(size=3), jnp.array([2.0])])
        assert_hessian(loss, x, lambda active: active[1].any() or name == "null-space")


def path_cost(setting, steps):
    """A cost of a path with respect to start, target, gain, speeds and dt."""
    robot, _, tasks, scheme, limits, _ = setting

    def cost(x):
        hand = tasks["hand"].replace(target=(x["target"], tasks["hand"].target[1]))
        now = {**tasks, "hand": hand, "mass": tasks["mass"].replace(gain=x["gain"])}
        bounds = limits[0], eqx.tree_at(lambda limit: limit.velocity, limits[1], x["speed"])
        path = osik.rollout(robot, x["q"], now, scheme=scheme, limits=bounds, dt=x["dt"], steps=steps)
        return jnp.mean(path.solution.error["hand"] ** 2) + 1e-2 * jnp.mean(jnp.cos(path.q)), path.solution.warm_start

    x = {
        "q": robot.q0,
        "target": tasks["hand"].target[0] + jnp.array([0.1, 0.2, -0.1]),
        "gain": jnp.asarray(2.0),
        "speed": limits[1].velocity,
        "dt": jnp.asarray(DT),
    }
    return cost, x


class TestRollout:
    @pytest.mark.variants(release=["hierarchical", "null-space", "weighted"])
    @all_schemes
    def test_over_two_hundred_steps(self, arm, rng, name):
        """Both modes against central differences, through changes of the active set along the way."""
        cost, x = path_cost(arm_setting(arm, SCHEMES[name]), 200)
        flat, restore = ravel_pytree(x)
        run = jax.jit(lambda flat: jax.value_and_grad(cost, has_aux=True)(restore(flat)))
        push = jax.jit(lambda d: jax.jvp(lambda f: cost(restore(f))[0], (flat,), (d,))[1])
        (_, active), gradient = run(flat)
        reverse = ravel_pytree(gradient)[0]
        if name != "null-space":
            sets = np.concatenate([np.asarray(a).reshape(200, -1) for a in jax.tree.leaves(active)], 1)
            assert len(np.unique(sets, axis=0)) > 1
        for _ in range(3):
            d = rng.normal(size=len(flat)) * np.where(flat == 0.0, 0.1, np.abs(flat))
            (a, _), _ = run(flat + 1e-6 * d)
            (b, _), _ = run(flat - 1e-6 * d)
            expected = float(a - b) / 2e-6
            assert float(reverse @ d) == pytest.approx(expected, rel=1e-5)
            assert float(push(d)) == pytest.approx(float(reverse @ d), rel=1e-9)

    @pytest.mark.variants(release=["hierarchical", "weighted"])
    @pytest.mark.parametrize("name", ["weighted", "hierarchical"])
    def test_memory_of_the_gradient(self, arm, name):
        """A step more keeps the state of a step, not what its solver went through."""

        def temporary(steps):
            cost, x = path_cost(arm_setting(arm, SCHEMES[name]), steps)
            compiled = jax.jit(jax.grad(cost, has_aux=True)).lower(x).compile()
            analysis = compiled.memory_analysis()
            assert analysis is not None
            return analysis.temp_size_in_bytes

        a_step = (temporary(300) - temporary(100)) / 200
        assert a_step < 1000, f"{a_step} bytes a step"
