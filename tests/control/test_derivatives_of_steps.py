"""Derivatives of a step with respect to every number, second ones, and derivatives through a rollout."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from derivative_checks import assert_exact, assert_hessian, check
from jax.flatten_util import ravel_pytree

import osik_jax as osik

pytestmark = pytest.mark.release

CASES = 1000
DT = 0.01
SCHEMES = {
    "weighted": osik.WeightedQP(damping=1e-3),
    "null-space": osik.NullSpace(damping=1e-3),
    "hierarchical": osik.HierarchicalQP(damping=1e-3),
}
all_schemes = pytest.mark.parametrize("name", SCHEMES)


def arm_setting(arm, scheme):
    """A pose that conflicts with an inequality, an adaptive gain, speeds that bind: (robot, q, tasks, scheme, ...)."""
    gain = osik.AdaptiveGain(6.0, 2.0, 3.0)
    tasks = {
        "hand": osik.FrameTask(arm, "hand", target_velocity=0.1 * np.arange(6.0), gain=gain, position_weight=[2, 3, 4]),
        "elbow": osik.FrameTask(arm, "link4", rows="position", upper=[np.inf, -0.002, 0.1], gain=3.0, priority=2),
        "mass": osik.ComTask(arm, axes="xy", weight=2.0, gain=2.0, priority=2),
        "posture": osik.PostureTask(arm, weight=0.05, gain=1.0, priority=3),
    }
    limits = osik.ConfigurationLimit(arm), osik.VelocityLimit(arm, velocity={"*": 0.8})
    return arm, arm.q0, tasks, scheme, limits, jnp.asarray(DT)


def solve(setting):
    robot, q, tasks, scheme, limits, dt = setting
    return osik.solve(robot, q, tasks, scheme=scheme, limits=limits, dt=dt)


def answer(setting):
    s = solve(setting)
    return (s.velocity, s.slack, s.error), (s.status, s.warm_start)


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


@all_schemes
def test_a_thousand_steps_of_the_arm(arm, rng, name):
    """Velocity, slacks and errors, along a change of everything at once."""
    path, cases = scattered(rng, arm_setting(arm, SCHEMES[name]), 0.4)
    assert_exact(check(answer, path, cases), most=0.9)


@all_schemes
def test_a_bad_lane_gives_shared_numbers_nothing(arm, rng, name):
    """The gradient with respect to what eight lanes share is that of the seven good ones, in both modes."""
    setting = arm_setting(arm, SCHEMES[name])
    numbers, structure = eqx.partition(setting, eqx.is_inexact_array)
    change = jax.tree.map(lambda a: jnp.where(jnp.isfinite(a), 0.1 * jnp.ones_like(a), 0.0), numbers)

    def total(shared, lanes, mask):
        def one(q, place, gain):
            robot, _, tasks, *rest = eqx.combine(shared, structure)
            hand = tasks["hand"].replace(target=(place, tasks["hand"].target[1]))
            s = solve((robot, q, {**tasks, "hand": hand, "mass": tasks["mass"].replace(gain=gain)}, *rest))
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


@all_schemes
def test_finite_at_the_target_stretched_and_pinned(arm, name):
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
        backward = sum(jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(pulled), jax.tree.leaves(change), strict=True))
        return forward, cotangent @ forward, backward, pulled

    forward, ahead, back, pulled = both(*(jnp.stack(a) for a in zip(*corners, strict=True)))
    assert all(np.isfinite(a).all() for a in jax.tree.leaves((forward, pulled)))
    np.testing.assert_allclose(back, ahead, rtol=1e-9, atol=1e-9 * np.abs(forward).max())


@all_schemes
def test_hessian_of_a_step(arm, rng, name):
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
