"""UR5: the tool goes from one side of a post to the other, and no link comes nearer than 3 cm to it."""

import jax
import jax.numpy as jnp
import numpy as np

import osik_jax as osik
from osik_jax import viewer

jax.config.update("jax_enable_x64", True)

bent = {"shoulder_pan_joint": -0.5, "shoulder_lift_joint": -1.4, "elbow_joint": 1.9, "wrist_1_joint": -2.0}
arm = osik.load_robot("ur5", home=bent | {"wrist_2_joint": -1.57})
tasks = {
    "tool": osik.FrameTask(arm, "tool0", rows="position", gain=2.0),
    "posture": osik.PostureTask(arm, weight=1e-4),
}
start = tasks["tool"].target[0]
goal = jnp.array([start[0], -start[1] + 0.1, start[2]])
tasks["tool"] = tasks["tool"].replace(target=goal)

# the post in the world, and capsules and balls for the outer links of the arm, in their own frames
middle = 0.5 * (start + goal) + jnp.array([0.05, 0.0, 0.0])
foot, top = middle.at[2].set(0.0), middle.at[2].add(0.08)
shapes = {
    "post": osik.CollisionShape.capsule(0.04, foot, top),
    "forearm": osik.CollisionShape.capsule(0.06, [0.0, 0.0, 0.0], [0.0, 0.0, 0.39], frame="forearm_link"),
    "wrist": osik.CollisionShape.sphere(0.07, frame="wrist_2_link"),
    "tool": osik.CollisionShape.sphere(0.06, frame="tool0"),
}
apart = osik.CollisionAvoidanceLimit(
    arm, shapes=shapes, pairs=[(link, "post") for link in ("forearm", "wrist", "tool")], minimum_distance=0.03
)

for name, limits in (("without the limit", None), ("with the limit", (apart,))):  # it adds to the robot's own limits
    motion = osik.rollout(arm, arm.q0, tasks, limits=limits, steps=400, dt=0.01)
    gaps = jax.vmap(lambda q: apart.distances(arm, osik.forward_kinematics(arm, q)))(motion.q)
    left = np.linalg.norm(motion.solution.error["tool"][-1])
    print(f"{name}: nearest {100 * gaps.min():+.2f} cm, tool {1e3 * left:.1f} mm from its target at the end")

path = jax.vmap(lambda q: osik.forward_kinematics(arm, q).frame_pose(arm, "tool0")[0])(motion.q)
viewer.hero_picture(
    "ur5_keeps_off_a_post.png",
    arm,
    [motion.q[k] for k in (0, 60, 400)],
    shapes=[shapes["post"]],
    trails=[path] * 3,
    azimuth=40.0,
    size=(1400, 520),
)
