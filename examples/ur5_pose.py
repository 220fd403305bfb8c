"""UR5: all configurations that put the tool at one pose, and the one nearest to where the arm is."""

import jax
import numpy as np

import osik_jax as osik
from osik_jax import viewer

jax.config.update("jax_enable_x64", True)
osik.runtime.configure_cpu()  # before a batch: settings for small problems

arm = osik.load_robot("ur5")
position = np.array([0.4, 0.2, 0.3])  # of the flange, in the world [m]
down = np.array([0.0, 1.0, 0.0, 0.0])  # its rotation as a quaternion w x y z: the tool points at the floor
pose = {"tool0": (position, down)}

# one configuration
found = osik.inverse_kinematics(arm, pose)
print(found.explain())
print(f"off by {1e3 * found.position_error:.5f} mm; q = {np.round(found.q, 3)}")

# all of them: shoulder left or right, elbow up or down, wrist turned over or not
every = osik.inverse_kinematics(arm, pose, all=True)
ways = every.solutions[: int(every.branches)]
print(f"{len(ways)} ways:")
for way in ways:
    print("  ", np.round(way, 2))

# the one nearest to the present configuration, for an arm that moves there
now = arm.configuration({"shoulder_lift_joint": -1.5, "elbow_joint": 1.5, "wrist_1_joint": -1.5, "wrist_2_joint": -1.5})
nearest = osik.inverse_kinematics(arm, pose, q0=now, nearest=True)
print("nearest to the present configuration:", np.round(nearest.q, 2))

viewer.hero_picture(
    "ur5_pose.png",
    arm,
    ways,
    shapes=[osik.CollisionShape.sphere(0.025, position)],
    spacing=0.62,
    size=(1600, 320),
    azimuth=75.0,
)
