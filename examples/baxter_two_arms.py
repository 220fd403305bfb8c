"""Baxter: two arms carry a box. The hands keep their places at it, whatever way it goes."""

import jax
import jax.numpy as jnp
import numpy as np

import osik_jax as osik
from osik_jax import viewer

jax.config.update("jax_enable_x64", True)

bent = {"s1": -0.4, "e1": 1.6, "w1": 0.4}
angles = {f"{side}_{joint}": angle for side in ("left", "right") for joint, angle in bent.items()}
robot = osik.load_robot("baxter", home=angles | {"left_s0": -0.6, "right_s0": 0.6})

# the right hand stays at its pose in the left hand's frame: a hard task, so a constraint in every step
grip = osik.RelativeFrameTask(robot, "right_gripper", "left_gripper", hard=True)
lead = osik.FrameTask(robot, "left_gripper", gain=8.0)
place, rotation = lead.target
tasks = {"grip": grip, "lead": lead, "posture": osik.PostureTask(robot)}


def moved(t):
    """The left hand goes up, to the left and forward, and back again."""
    wave = 1.0 - jnp.cos(t)
    way = wave * jnp.array([0.05, 0.06, 0.09])
    return {**tasks, "lead": lead.replace(target=(place + way, rotation))}


motion = osik.rollout(robot, robot.q0, moved, steps=620, dt=0.01)


def hands(q):
    """Positions of both hands [m]. (2, 3)."""
    kinematics = osik.forward_kinematics(robot, q)
    return jnp.stack([kinematics.frame_pose(robot, f"{side}_gripper")[0] for side in ("left", "right")])


at = jax.vmap(hands)(motion.q)
apart = np.linalg.norm(at[:, 0] - at[:, 1], axis=-1)
print(f"the left hand moved through a box of {np.round(100 * np.ptp(at[:, 0], axis=0), 1)} cm")
print(f"the hands are {1e3 * apart[0]:.1f} mm apart, and this changes by {1e3 * np.ptp(apart):.4f} mm at most")

box = osik.CollisionShape.box([0.1, 0.5 * apart[0] - 0.02, 0.1], at[310].mean(0))
viewer.hero_picture(
    "baxter_two_arms.png",
    robot,
    [motion.q[310]],
    shapes=[box],
    trails=[at[:, 0]],
    azimuth=35.0,
    size=(900, 600),
)
