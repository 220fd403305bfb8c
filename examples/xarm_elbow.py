"""xArm 7: seven joints for a pose of six numbers. The hand stays where it is, and the elbow moves."""

import jax
import jax.numpy as jnp
import numpy as np

import osik_jax as osik
from osik_jax import viewer

jax.config.update("jax_enable_x64", True)
osik.runtime.configure_cpu()  # before a batch: settings for small problems

arm = osik.load_robot("xarm7", home={"joint2": -0.3, "joint4": 1.3, "joint6": 1.6})
elbow_at_home = osik.forward_kinematics(arm, arm.q0).frame_pose(arm, "link4")[0]

# priority 1 comes first: the elbow gets what the hand leaves over
tasks = {
    "hand": osik.FrameTask(arm, "link_eef", gain=50.0, priority=1),
    "elbow": osik.FrameTask(arm, "link4", rows="position", gain=2.0, priority=2),
    "posture": osik.PostureTask(arm, priority=3),
}


def swing(side):
    """The motion of two seconds with the elbow's target at a distance to the side [m]."""
    elbow = tasks["elbow"].replace(target=elbow_at_home + side * jnp.array([0.0, 1.0, 0.0]))
    return osik.rollout(arm, arm.q0, {**tasks, "elbow": elbow}, scheme=osik.HierarchicalQP(), steps=400, dt=0.005)


sides = jnp.array([-0.2, 0.0, 0.2])
motions = jax.vmap(swing)(sides)  # three motions at once
for side, q, error in zip(sides, motions.q, motions.solution.error["hand"], strict=True):
    elbow = osik.forward_kinematics(arm, q[-1]).frame_pose(arm, "link4")[0]
    print(
        f"elbow asked for {100 * side:+.0f} cm to the side, went {100 * (elbow - elbow_at_home)[1]:+.1f} cm; "
        f"the hand moved by {1e3 * np.linalg.norm(error[:, :3], axis=1).max():.2f} mm at most"
    )

hand = tasks["hand"].target[0]
viewer.hero_picture(
    "xarm_elbow.png",
    arm,
    list(motions.q[:, -1]),
    shapes=[osik.CollisionShape.sphere(0.03, hand)],
    labels=["elbow to the right", "in the middle", "elbow to the left"],
    azimuth=15.0,
    size=(1400, 560),
)
