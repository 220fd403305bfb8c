"""Panda at a shelf: for which of 48 grips of a can nothing touches, and what is in the way of the others."""

from collections import Counter

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax import viewer

jax.config.update("jax_enable_x64", True)

fingers = {"panda_finger_joint1": 0.04, "panda_finger_joint2": 0.04}
robot = osik.load_robot("panda", locked_joints=fingers)

box = osik.CollisionShape.box
shapes = {
    "board": box([0.15, 0.4, 0.01], [0.6, 0.0, 0.35]),
    "top": box([0.15, 0.4, 0.01], [0.6, 0.0, 0.65]),
    "left": box([0.15, 0.01, 0.16], [0.6, 0.4, 0.5]),
    "right": box([0.15, 0.01, 0.16], [0.6, -0.4, 0.5]),
    "back": box([0.01, 0.4, 0.16], [0.76, 0.0, 0.5]),
    "jar": osik.CollisionShape.cylinder(0.05, [0.55, -0.1, 0.361], [0.55, -0.1, 0.5]),
    "can": osik.CollisionShape.cylinder(0.03, [0.58, 0.1, 0.361], [0.58, 0.1, 0.48]),
}
scene = osik.Scene(shapes)

# the hand points into the shelf (rotated about y by 90 degrees), from 12 sides, at 4 heights
sides = np.repeat(np.linspace(-np.pi / 2, np.pi / 2, 12), 4)
heights = np.tile([0.39, 0.42, 0.44, 0.46], 12)
grips = Rotation.from_euler("z", sides[:, None]) * Rotation.from_euler("y", np.pi / 2)
centers = np.stack([np.full(48, 0.58), np.full(48, 0.1), heights], 1)
places = centers - grips.apply([0.0, 0.0, 0.105])  # of the hand: its fingertips are 105 mm before it

found = osik.inverse_kinematics(robot, {"panda_hand": (places, grips.as_matrix())}, scene=scene, srdf=True)
free = np.asarray(found.converged)
reasons = Counter(found.explain(int(k)).splitlines()[-1].strip() for k in np.flatnonzero(~free))
print(f"{free.sum()} of {len(free)} grips are free, by {1e3 * found.clearance[free].min():.1f} mm and more")
for reason, count in reasons.most_common(5):
    print(f"{count} times: {reason}")

chosen = np.flatnonzero(free)[:: max(1, free.sum() // 3)][:3]
viewer.hero_picture(
    "collision_free.png",
    robot,
    [found.q[k] for k in chosen],
    shapes=list(shapes.values()),
    azimuth=140.0,
    size=(1400, 520),
)
