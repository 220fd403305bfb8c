"""G1: the right hand reaches down and forward; feet and balance come first, by priority."""

import jax
import jax.numpy as jnp
import numpy as np

import osik_jax as osik
from osik_jax import viewer

jax.config.update("jax_enable_x64", True)

bent = {"hip_pitch": -0.3, "knee": 0.6, "ankle_pitch": -0.3}
bent = {f"{side}_{joint}_joint": angle for side in ("left", "right") for joint, angle in bent.items()}
robot = osik.load_robot("g1", home=bent)
feet = ("left_ankle_roll_link", "right_ankle_roll_link")
sole = [[x, y, -0.03] for x in (-0.05, 0.12) for y in (-0.025, 0.025)]  # corners in the foot's frame [m]
# the polygon of both soles, drawn in by 2 cm
polygon = osik.support_polygon(robot, robot.q0, feet, margin=0.02, corners=dict.fromkeys(feet, sole))

tasks = {
    "left foot": osik.FrameTask(robot, feet[0], priority=1),  # stays where it is at home
    "right foot": osik.FrameTask(robot, feet[1], priority=1),
    "balance": osik.ComTask(robot, polygon=polygon, priority=2),  # centre of mass over the feet
    "hand": osik.FrameTask(robot, "right_rubber_hand", rows="position", gain=2.0, priority=3),
    "posture": osik.PostureTask(robot, priority=4),
}
hand = tasks["hand"].target[0]


def reach(distance):
    """The motion of three seconds towards a point ahead of and below the hand."""
    goal = hand + distance * jnp.array([1.0, 0.0, -0.6])
    aimed = {**tasks, "hand": tasks["hand"].replace(target=goal)}
    return goal, osik.rollout(robot, robot.q0, aimed, scheme=osik.HierarchicalQP(), steps=600, dt=0.005)


near, motion = reach(0.25)
far, bent_down = reach(0.45)
for name, path in (("near", motion), ("far", bent_down)):
    error = {task: np.linalg.norm(values[-1]) for task, values in path.solution.error.items() if task != "balance"}
    com = jax.vmap(lambda q: osik.center_of_mass(robot, osik.forward_kinematics(robot, q)))(path.q)
    margin = min(float(polygon.distance(c)) for c in com[::10, :2])
    foot = 1e3 * max(error["left foot"], error["right foot"])
    print(f"{name}: hand {1e3 * error['hand']:.1f} mm off, feet {foot:.3f} mm off, balance {1e3 * margin:.1f} mm")

viewer.hero_picture(
    "g1_reaches.png",
    robot,
    [robot.q0, motion.q[-1], bent_down.q[-1]],
    support=[polygon.vertices] * 3,
    shapes=[osik.CollisionShape.sphere(0.03, goal) for goal in (near, far)],
    labels=["home", "25 cm ahead, 15 cm down", "45 cm ahead, 27 cm down"],
    azimuth=-50.0,
    size=(1400, 600),
)
