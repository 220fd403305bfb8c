"""Train a policy that reaches with arm7 in MJX, by task-space actions and by joint actions (minutes on two CPU cores).

python examples/learning/reach_by_policy.py [figure.png]
"""

import sys
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import optax
from mujoco import mjx

import osik_jax as osik
from osik_jax.interop.action import TaskSpaceAction

osik.runtime.configure_cpu()
ENVS, STEPS, UPDATES, SUBSTEPS, DT, DISCOUNT = 64, 25, 60, 8, 0.04, 0.95
arm = osik.load_robot("arm7")
model = arm.mj_model
model.opt.timestep = DT / SUBSTEPS
physics, start = mjx.put_model(model), mjx.put_data(model, mujoco.MjData(model))
tasks = {"hand": osik.FrameTask(arm, "hand", rows="position", gain=1.0 / DT), "posture": osik.PostureTask(arm)}
hand_action = TaskSpaceAction(arm, tasks, position_scale=0.05, scheme=osik.WeightedQP(), dt=DT)
home = tasks["hand"].target[0]
by_hand = (hand_action.size, lambda q, action: hand_action(q, action).position)
by_joints = (7, lambda q, action: jnp.clip(q + 0.08 * jnp.clip(action, -1, 1), arm.position_lower, arm.position_upper))


def known(**options):
    """Return the compiler options, or none where this XLA does not know them."""
    try:
        jax.jit(lambda: 0.0, compiler_options=options)()
    except jax.errors.JaxRuntimeError:
        return {}
    return options


def hand(data):
    return osik.forward_kinematics(arm, data.qpos).frame_pose(arm, "hand")[0]


def reset(key):
    goal = home + jax.random.uniform(key, (3,), minval=-0.25, maxval=0.25)
    return start.replace(qpos=arm.q0, ctrl=arm.q0), goal


def observe(data, goal):
    return jnp.concatenate([data.qpos, 0.2 * data.qvel, data.ctrl - data.qpos, 4.0 * (goal - hand(data)), goal])


def env_step(space, state, action):
    data, goal = state
    data = data.replace(ctrl=space[1](data.ctrl, action))
    data = jax.lax.fori_loop(0, SUBSTEPS, lambda _, d: mjx.step(physics, d), data)
    return (data, goal), -jnp.linalg.norm(goal - hand(data))


def network(key, sizes):
    keys = jax.random.split(key, len(sizes))
    pairs = list(zip(keys, sizes[:-1], sizes[1:], strict=False))
    return [
        (jax.random.normal(k, (m, n)) / jnp.sqrt(m) * (0.1 if n == sizes[-1] else 1), jnp.zeros(n)) for k, m, n in pairs
    ]


def run(layers, x):
    for matrix, offset in layers[:-1]:
        x = jnp.tanh(x @ matrix + offset)
    return x @ layers[-1][0] + layers[-1][1]


def log_probability(parameters, x, action):
    scaled = (action - run(parameters["policy"], x)) / jnp.exp(parameters["spread"])
    return -0.5 * (scaled**2).sum(-1) - parameters["spread"].sum()


def collect(space, parameters, key):
    """Episodes of all environments: observations, actions, rewards. Each (STEPS, ENVS, ...)."""

    def one(state, key):
        x = jax.vmap(observe)(*state)
        noise = jax.random.normal(key, (ENVS, space[0])) * jnp.exp(parameters["spread"])
        action = run(parameters["policy"], x) + noise
        state, reward = jax.vmap(partial(env_step, space))(state, action)
        return state, (x, action, reward)

    first, *others = jax.random.split(key, STEPS + 1)
    return jax.lax.scan(one, jax.vmap(reset)(jax.random.split(first, ENVS)), jnp.stack(others))[1]


def loss(parameters, x, action, wanted, advantage, before):
    ratio = jnp.exp(log_probability(parameters, x, action) - before)
    clipped = jnp.minimum(ratio * advantage, jnp.clip(ratio, 0.8, 1.2) * advantage)
    return ((run(parameters["value"], x)[..., 0] - wanted) ** 2).mean() - clipped.mean()


def train(space, seed=0):
    """Return the mean return of each update (proximal policy optimisation)."""
    keys = jax.random.split(jax.random.key(seed), 3)
    parameters = {"policy": network(keys[0], (27, 64, 64, space[0])), "value": network(keys[1], (27, 64, 64, 1))}
    parameters["spread"] = jnp.full(space[0], -1.0)
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(2e-3))

    # on a CPU, XLA before JAX 0.12 fuses MJX's kinematics into loops that take hundreds of times as long
    @partial(jax.jit, compiler_options=known(xla_cpu_use_fusion_emitters=False))
    def update(parameters, moments, key):
        x, action, reward = collect(space, parameters, key)
        back = lambda ahead, r: (r + DISCOUNT * ahead,) * 2  # noqa: E731
        wanted = jax.lax.scan(back, reward[-1] / (1 - DISCOUNT), reward, reverse=True)[1]
        advantage = wanted - run(parameters["value"], x)[..., 0]
        advantage = (advantage - advantage.mean()) / advantage.std()
        before = log_probability(parameters, x, action)

        def descend(carry, _):
            slope = jax.grad(loss)(carry[0], x, action, wanted, advantage, before)
            change, moments = optimizer.update(slope, carry[1])
            return (optax.apply_updates(carry[0], change), moments), None

        (parameters, moments), _ = jax.lax.scan(descend, (parameters, moments), length=10)
        return parameters, moments, reward.sum(0).mean(), -reward[-1].mean()

    moments, returns, left = optimizer.init(parameters), [], 0.0
    for key in jax.random.split(keys[2], UPDATES):
        parameters, moments, total, left = update(parameters, moments, key)
        returns.append(float(total))
    return returns, float(left)


if __name__ == "__main__":
    import matplotlib.pyplot as plt

    for name, space in (("task-space action", by_hand), ("joint action", by_joints)):
        returns, left = train(space)
        print(
            f"{name}: return {returns[0]:.2f} at first, {returns[-1]:.2f} at last; {1000 * left:.0f} mm from the goal"
        )
        plt.plot([ENVS * STEPS * (k + 1) / 1000 for k in range(UPDATES)], returns, label=name)
    plt.xlabel("environment steps [thousands]"), plt.ylabel("return: - sum of distances [m]"), plt.legend(), plt.grid()
    plt.savefig(sys.argv[1] if len(sys.argv) > 1 else "reaching.png", dpi=110, bbox_inches="tight")
