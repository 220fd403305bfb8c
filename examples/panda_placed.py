"""Panda: where its base has to stand to reach 50 poses above a table and in a shelf, free of both."""

import jax
import numpy as np

import osik_jax as osik
from osik_jax.placement import place_base

jax.config.update("jax_enable_x64", True)
panda, box = osik.load_robot("panda"), osik.CollisionShape.box
scene = osik.Scene(
    {
        "table": box([0.3, 0.6, 0.2], [0.5, 0.0, 0.2]),  # half its edges, its centre
        "back": box([0.02, 0.4, 0.6], [1.1, 0.0, 0.6]),
        "low": box([0.15, 0.4, 0.01], [0.95, 0.0, 0.6]),
        "high": box([0.15, 0.4, 0.01], [0.95, 0.0, 0.95]),
        "left": box([0.15, 0.01, 0.6], [0.95, 0.4, 0.6]),
        "right": box([0.15, 0.01, 0.6], [0.95, -0.4, 0.6]),
    }
)
rng = np.random.default_rng(0)
down, forward = np.diag([1.0, -1.0, -1.0]), np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
above = rng.uniform([0.3, -0.4, 0.55], [0.7, 0.4, 0.65], (25, 3))
inside = rng.uniform([0.78, -0.25, 0.7], [0.85, 0.25, 0.85], (25, 3))
poses = np.concatenate([above, inside]), np.repeat([down, forward], 25, 0)

found = place_base(
    panda,
    {"panda_hand": poses},
    x=np.linspace(-0.6, 1.2, 16),
    y=np.linspace(-1.1, 1.1, 14),
    yaw=4,
    height=0.3,  # of a pedestal
    scene=scene,
    q0=panda.configuration({"panda_finger_joint1": 0.04}),
)
print(found.explain())

# which way would the worst pose have the base go?
worst = int(found.best_margin.argmin())
slope = found.gradient.margin[worst]
print(f"pose {worst}: its margin changes by {slope[0]:+.2f} a metre along x, {slope[1]:+.2f} along y")
found.figure().savefig("panda_placed.png")
