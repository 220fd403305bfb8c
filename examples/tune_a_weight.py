"""Panda: the weight of a posture, found by gradient: the derivative goes through the whole motion."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import osik_jax as osik

jax.config.update("jax_enable_x64", True)

home = {"panda_joint2": -0.5, "panda_joint4": -2.4, "panda_joint6": 1.9}
arm = osik.load_robot("panda", locked_joints=("panda_finger_joint1",), home=home)
hand = osik.FrameTask(arm, "panda_hand_tcp", rows="position", gain=5.0)
hand = hand.replace(target=hand.target[0] + jnp.array([0.1, 0.3, 0.1]))
posture = osik.PostureTask(arm)


def loss(log_weight):
    """Return the distance of the hand from its target [cm] plus that of the joints from home [rad], after 1 s."""
    tasks = {"hand": hand, "posture": posture.replace(weight=jnp.exp(log_weight))}
    motion = osik.rollout(arm, arm.q0, tasks, steps=100, dt=0.01)
    missed = 100.0 * jnp.linalg.norm(motion.solution.error["hand"][-1])
    return missed + jnp.linalg.norm(motion.q[-1] - arm.q0), (missed, motion.q[-1])


value_and_slope = jax.jit(jax.value_and_grad(loss, has_aux=True))
log_weight, history = jnp.log(1.0), []
for _ in range(25):
    (value, (missed, _)), slope = value_and_slope(log_weight)
    history.append((float(jnp.exp(log_weight)), float(value), float(missed)))
    log_weight -= 0.6 * slope / (abs(slope) + 0.3)  # steps of bounded length, shorter where it is flat

step = 1e-4
difference = (loss(step)[0] - loss(-step)[0]) / (2.0 * step)
slope = value_and_slope(0.0)[1]
print(f"slope at weight 1: {slope:.9f} by gradient, {difference:.9f} by central differences")
print("weight -> loss:", ", ".join(f"{w:.2e} -> {v:.3f}" for w, v, _ in history[::6]))
print(f"the hand misses by {history[0][2]:.2f} cm at first, by {history[-1][2]:.2f} cm at the end")

figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
weights, values, misses = zip(*history, strict=True)
axes[0].plot(values, "o-", color="#1565c0")
axes[0].set(xlabel="step of gradient descent", ylabel="loss", title="Loss")
axes[1].loglog(weights, misses, "o-", color="#f08c3a")
axes[1].set(xlabel="weight of the posture", ylabel="hand misses by [cm]", title="Weight and error")
figure.savefig("tune_a_weight.png", dpi=110)
