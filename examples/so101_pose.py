"""SO-101: five joints and a gripper. Which part of a pose they reach, and what the library says where they do not."""

import jax
import numpy as np

import osik_jax as osik
from osik_jax import viewer

jax.config.update("jax_enable_x64", True)
osik.runtime.configure_cpu()  # settings for small problems, before the first robot

arm = osik.load_robot("so101")
tip = "gripper_frame_link"
position = np.array([0.22, 0.08, 0.04])  # [m]
down = np.array([0.0, 1.0, 0.0, 0.0])  # w x y z
print(f"joints that move the gripper: {arm.joint_names[:5]}")

# 1. a whole pose has six rows, and five joints cannot take most of them
sideways = np.array([0.5, 0.5, 0.5, 0.5])
whole = osik.inverse_kinematics(arm, {tip: (position, sideways)})
print("\nwhole pose:", whole.explain())

# 2. a position has three rows
place = osik.inverse_kinematics(arm, {tip: position})
print("\nposition alone:", place.explain())

# 3. a position, and the gripper's approach axis straight down: five rows
straight = {
    "position": osik.FrameTask(arm, tip, target=(position, down), rows="position"),
    "approach": osik.AxisAlignTask(arm, tip, axis=(0.0, 0.0, 1.0), target=(0.0, 0.0, -1.0)),
}
above = osik.inverse_kinematics(arm, straight)
print("\nposition and approach axis:", above.explain())

# 4. half a metre away: out of reach, with the proof
away = np.array([0.6, 0.0, 0.2])
far = osik.inverse_kinematics(arm, {tip: away})
print("\nfar away:", far.explain())

viewer.hero_picture(
    "so101_pose.png",
    arm,
    [whole.q, place.q, above.q, far.q],
    targets=[position[None]] * 3 + [away[None]],
    labels=["whole pose", "position", "position and axis", "out of reach"],
    azimuth=50.0,
    spacing=0.42,
    size=(1400, 400),
)
