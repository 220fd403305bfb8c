"""TIAGo: a target out of the arm's reach. The wheels turn, the base drives there, and the hand takes the pose."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np

import osik_jax as osik
from osik_jax import viewer

jax.config.update("jax_enable_x64", True)
warnings.simplefilter("ignore", osik.OsikWarning)  # the file has soft ranges too; print(robot.load_report) lists them

arm = {"arm_1_joint": 1.0, "arm_2_joint": 0.3, "arm_3_joint": -1.5, "arm_4_joint": 1.6, "torso_lift_joint": 0.15}
robot = osik.load_robot("tiago", floating_base=True, locked_joints=("hand_*",), home=arm)
wheels = [f"wheel_{side}_link" for side in ("left", "right")]

# the base may go where its wheels roll: no slip, no sideways motion, level on the floor. Hard tasks are constraints
rolling = {wheel: osik.WheelTask(robot, wheel, radius=0.0985, axis=(0.0, 0.0, 1.0), hard=True) for wheel in wheels}
level = osik.FrameTask(robot, "base_footprint", rows=(False, False, False, False, True, False), hard=True)
hand = osik.FrameTask(robot, "arm_tool_link", rows="position", gain=1.0)
goal = hand.target[0] + jnp.array([1.2, 0.7, 0.2])
posture = osik.PostureTask(robot, joints=("arm_*", "torso*"), weight=1e-4)
tasks = {**rolling, "level": level, "hand": hand.replace(target=goal), "posture": posture}
motion = osik.rollout(robot, robot.q0, tasks, steps=1000, dt=0.01)


def places(q):
    """Positions of the base, the hand and both wheels [m]. (4, 3)."""
    kinematics = osik.forward_kinematics(robot, q)
    return jnp.stack([kinematics.frame_pose(robot, name)[0] for name in ("base_footprint", "arm_tool_link", *wheels)])


path = jax.vmap(places)(motion.q)
turned = motion.q[-1, robot.joint_qpos_index("wheel_left_joint")] / (2.0 * np.pi)
rolled = np.linalg.norm(np.diff(path[:, 2], axis=0), axis=1).sum()
print(f"hand {1e3 * np.linalg.norm(path[-1, 1] - goal):.2f} mm off; the base drove {np.round(path[-1, 0, :2], 2)} m")
print(f"left wheel: {turned:.2f} turns for {rolled:.3f} m on the floor; radius {rolled / turned / (2.0 * np.pi):.4f} m")
print(f"base off the floor by {1e3 * np.abs(path[:, 0, 2]).max():.3f} mm at most")

viewer.hero_picture(
    "tiago_drives.png",
    robot,
    [motion.q[k] for k in (0, 120, 1000)],
    shapes=[osik.CollisionShape.sphere(0.05, goal)],
    trails=[path[:, 0], path[:, 1]],
    spacing=0.0,
    azimuth=60.0,
    elevation=25.0,
    size=(1200, 640),
)
