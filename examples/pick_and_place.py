"""Panda takes a can out of a shelf and puts it on a table: free grips, ways around the shelf, and a timed motion."""

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax import viewer
from osik_jax.motion import connect

jax.config.update("jax_enable_x64", True)
robot = osik.load_robot("panda", locked_joints={"panda_finger_joint1": 0.04, "panda_finger_joint2": 0.04})
box, can, half = osik.CollisionShape.box, np.array([0.58, 0.1, 0.43]), np.array([0.0, 0.0, 0.06])
shapes = {
    "board": box([0.15, 0.4, 0.01], [0.6, 0.0, 0.35]),
    "top": box([0.15, 0.4, 0.01], [0.6, 0.0, 0.65]),
    "left": box([0.15, 0.01, 0.16], [0.6, 0.4, 0.5]),
    "right": box([0.15, 0.01, 0.16], [0.6, -0.4, 0.5]),
    "back": box([0.01, 0.4, 0.16], [0.76, 0.0, 0.5]),
    "table": box([0.3, 0.25, 0.02], [0.2, -0.6, 0.2]),
    "can": osik.CollisionShape.cylinder(0.03, can - half, can + half),
}
scene = osik.Scene(shapes)


def grips(center, count=16):
    """Return poses of the hand that grip a can from many sides: its fingertips are 105 mm before it."""
    sides = np.linspace(-np.pi, np.pi, count, endpoint=False)
    turns = Rotation.from_euler("z", sides[:, None]) * Rotation.from_euler("y", np.pi / 2)
    return center - turns.apply([0.0, 0.0, 0.105]), turns.as_matrix()


def free(center, scene):
    """Return configurations that grip a can, (n, 7)."""
    found = osik.inverse_kinematics(robot, {"panda_hand": grips(center)}, scene=scene, srdf=True)
    return np.asarray(found.q)[np.asarray(found.converged)]


ready = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
limits = {"acceleration": 5.0, "jerk": 100.0}
pick = connect(robot, ready, free(can, scene), scene, srdf=True)
held = scene.attach("can", robot, "panda_hand", q=pick.vertices[-1], touch=["panda_*finger"])
place = connect(robot, pick.vertices[-1], free(np.array([0.2, -0.6, 0.29]), held), held, srdf=True)
motions = [way.retime(**limits).sample(dt=0.01) for way in (pick, place)]
for way, motion in zip((pick, place), motions, strict=True):
    print(f"{len(way.vertices)} vertices, {float(motion.time[-1]):.2f} s, {way.states} configurations tried")

hand = jax.vmap(lambda q: osik.forward_kinematics(robot, q).frame_pose(robot, "panda_hand")[0])
put = osik.CollisionShape.cylinder(0.03, [0.2, -0.6, 0.23], [0.2, -0.6, 0.35])
viewer.hero_picture(
    "pick_and_place.png",
    robot,
    [motion.position[-1] for motion in motions],
    shapes=[*shapes.values(), put],
    trails=[np.asarray(hand(motion.position)) for motion in motions],
    spacing=0.0,
    azimuth=165.0,
    elevation=25.0,
    size=(1200, 640),
)
