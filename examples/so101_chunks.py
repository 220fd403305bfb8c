"""SO-101: a policy gives chunks of joint positions that overlap; they become one smooth motion within all limits."""

import jax
import matplotlib.pyplot as plt
import numpy as np

import osik_jax as osik
from osik_jax.motion import Stream

jax.config.update("jax_enable_x64", True)
arm, rng = osik.load_robot("so101"), np.random.default_rng(0)
limits = {"velocity": 3.0, "acceleration": 20.0, "jerk": 400.0}
period, horizon, dt = 0.4, np.arange(30) / 30.0, 0.01  # a new chunk every 0.4 s, 30 waypoints in 1 s


def policy(now):
    """Return 30 waypoints from now on: a wave, with noise and an offset that changes from chunk to chunk."""
    wave = 0.5 * np.sin(1.5 * (now + horizon[:, None]) + np.arange(arm.nv)) * np.linspace(1.0, 0.3, arm.nv)
    return np.asarray(arm.q0) + wave + 0.03 * rng.normal(size=arm.nv) + 0.005 * rng.normal(size=(30, arm.nv))


begins, stream = period * np.arange(9), Stream(arm, arm.q0, latency=0.05, waypoints=30, smoothing=0.1, **limits)
push, chunks, time, states = jax.jit(Stream.push), [], [], []
for now in begins:
    chunks.append(policy(now))
    stream = push(stream, chunks[-1], now + horizon, now)  # while it is planned, the last chunk goes on
    time.append(now + np.arange(round(period / dt)) * dt)
    states.append(stream.at(time[-1]))
time, states = np.concatenate(time), np.concatenate(states, axis=1)
used = [np.abs(own).max() / limit for own, limit in zip(states[1:], limits.values(), strict=True)]
print(f"{len(time)} samples; speed, acceleration and jerk by their limits: {used[0]:.2f}, {used[1]:.2f}, {used[2]:.2f}")
lag = np.sqrt(np.mean(stream.after.miss[5:] ** 2))
print(f"the last chunk is {lag:.4f} rad off its waypoints (root mean square), whose noise is 0.005 rad")
figure, axes = plt.subplots(2, 1, figsize=(9, 5), sharex=True, layout="constrained")
for now, waypoints in zip(begins, chunks, strict=True):
    axes[0].plot(now + horizon, waypoints[:, :3], ".", ms=2, color="gray")
    axes[1].axvline(now + stream.latency, color="gray", lw=0.5)
axes[0].plot(time, states[0, :, :3], label=arm.joint_names[:3])
axes[0].set(ylabel="[rad]", title="Waypoints of the chunks (dots), and the motion of three joints")
axes[0].legend(ncols=3)
axes[1].plot(time, states[2, :, :3])
axes[1].set(xlabel="time [s]", ylabel="[rad/s²]", title="Accelerations, without a step where chunks join (lines)")
figure.savefig("so101_chunks.png", dpi=110)
