"""Allegro hand: four fingertips meet on a ball."""

import jax
import numpy as np

import osik_jax as osik
from osik_jax import viewer

jax.config.update("jax_enable_x64", True)

hand = osik.load_robot("allegro")
tips = {"index": "link_3.0_tip", "middle": "link_7.0_tip", "ring": "link_11.0_tip", "thumb": "link_15.0_tip"}
center, radius = np.array([0.065, 0.0, 0.035]), 0.034  # of the ball, in the hand's axes [m]
thick = 0.012  # radius of a fingertip [m]

# where each fingertip touches: directions from the ball's centre
directions = {"index": (5, 6, 6), "middle": (6, 0, 8), "ring": (5, -6, 6), "thumb": (2, 3, -9)}
outwards = {finger: np.array(d) / np.linalg.norm(d) for finger, d in directions.items()}
targets = {tips[finger]: center + (radius + thick) * out for finger, out in outwards.items()}

# four frames of one robot, solved together; positions alone, so the tips may turn
grasp = osik.inverse_kinematics(hand, targets, nearest=True)
print(grasp.explain())
kinematics = osik.forward_kinematics(hand, grasp.q)
for finger, tip in tips.items():
    gap = np.linalg.norm(kinematics.frame_pose(hand, tip)[0] - center) - radius - thick
    print(f"{finger:>6}: {1e6 * gap:+.2f} micrometres from the ball")

# close the hand: all joints arrive together
closing = osik.rollout(hand, hand.q0, {"grasp": osik.PostureTask(hand, target=grasp.q, gain=3.0)}, steps=200, dt=0.01)

viewer.hero_picture(
    "allegro_grasp.png",
    hand,
    [closing.q[0], closing.q[25], closing.q[-1]],
    shapes=[osik.CollisionShape.sphere(radius, center)],
    azimuth=40.0,
    elevation=15.0,
    size=(1400, 520),
)
