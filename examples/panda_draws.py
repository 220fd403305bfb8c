"""Panda: a pen draws a figure of eight on a table, upright, at 250 steps a second."""

import jax
import jax.numpy as jnp
import numpy as np

import osik_jax as osik
from osik_jax import viewer

jax.config.update("jax_enable_x64", True)

arm = osik.load_robot("panda", locked_joints=("panda_finger_joint1",))
home = {"panda_joint2": -0.5, "panda_joint4": -2.4, "panda_joint6": 1.9, "panda_joint7": 0.78}
arm = arm.with_home(home)
tip = "panda_hand_tcp"

# a frame task without a target keeps the frame where it is at home
hand = osik.FrameTask(arm, tip, gain=200.0)
tasks = {"hand": hand, "posture": osik.PostureTask(arm)}
start, rotation = hand.target

# where the pen should be at each step: positions (steps, 3) and rotations (steps, 3, 3)
dt, steps = 0.004, 1500
angle = 2.0 * jnp.pi * jnp.arange(steps) / steps
size = jnp.minimum(1.0, jnp.arange(steps) * dt)[:, None]  # grows in the first second: no jump at the start
eight = jnp.stack([0.10 * jnp.sin(2.0 * angle), 0.2 * jnp.sin(angle), 0.0 * angle], 1)
path = start + size * eight
targets = {"hand": (path, jnp.broadcast_to(rotation, (steps, 3, 3)))}

motion = osik.rollout(arm, arm.q0, tasks, targets=targets, steps=steps, dt=dt)
error = 1e3 * np.linalg.norm(motion.solution.error["hand"][:, :3], axis=1)  # [mm]
speed = np.abs(motion.solution.velocity).max()
print(f"{steps} steps, all solved: {bool((motion.solution.status == osik.Status.SOLVED).all())}")
print(f"pen off its path by at most {error.max():.2f} mm; fastest joint {speed:.2f} rad/s")

drawn = jax.vmap(lambda q: osik.forward_kinematics(arm, q).frame_pose(arm, tip)[0])(motion.q)
viewer.hero_picture(
    "panda_draws.png",
    arm,
    [motion.q[k] for k in (steps // 4, steps // 2, 3 * steps // 4)],
    shapes=[osik.CollisionShape.box([0.25, 0.35, 0.01], start - jnp.array([0.0, 0.0, 0.03]))],
    trails=[drawn] * 3,
    azimuth=35.0,
    elevation=25.0,
    size=(1400, 480),
)
