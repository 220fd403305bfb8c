"""TIAGo: the floor pose from which it reaches 40 points on a table and in a shelf beside it, free of both."""

import warnings

import jax
import numpy as np

import osik_jax as osik
from osik_jax import viewer
from osik_jax.placement import place_base

jax.config.update("jax_enable_x64", True)
warnings.simplefilter("ignore", osik.OsikWarning)  # the file has soft ranges too; print(robot.load_report) lists them
robot = osik.load_robot("tiago", floating_base=False, locked_joints=("hand_*", "wheel_*", "head_*"))

legs = {f"leg {x}{y}": ([0.02, 0.02, 0.34], [0.9 + 0.27 * x, 0.57 * y, 0.34]) for x in (-1, 1) for y in (-1, 1)}
furniture = legs | {
    "top": ([0.3, 0.6, 0.02], [0.9, 0.0, 0.7]),  # half its edges, its centre
    "back": ([0.4, 0.02, 0.6], [0.3, 1.35, 0.6]),
    "low": ([0.4, 0.15, 0.01], [0.3, 1.2, 0.8]),
    "high": ([0.4, 0.15, 0.01], [0.3, 1.2, 1.2]),
    "left": ([0.01, 0.15, 0.6], [-0.1, 1.2, 0.6]),
    "right": ([0.01, 0.15, 0.6], [0.7, 1.2, 0.6]),
}
shapes = {name: osik.CollisionShape.box(*given) for name, given in furniture.items()}
rng = np.random.default_rng(0)
table = rng.uniform([0.65, -0.4, 0.82], [1.0, 0.4, 0.92], (20, 3))
shelf = rng.uniform([0.0, 1.0, 0.9], [0.6, 1.15, 1.1], (20, 3))
points = np.concatenate([table, shelf])

grid = dict(x=np.linspace(-0.4, 0.8, 11), y=np.linspace(-0.5, 0.8, 12), yaw=8)
found = place_base(robot, {"hand_grasping_frame": points}, **grid, scene=osik.Scene(shapes))
print(found.explain())

# the picture has the base at its origin
position, turn = found.best_pose
moved = [osik.CollisionShape.box(half, turn.T @ (at - position), turn.T) for half, at in furniture.values()]
shown = [int(np.nanargmax(found.best_margin[:20])), 20 + int(np.nanargmax(found.best_margin[20:]))]
viewer.hero_picture(
    "tiago_parks.png",
    robot,
    [found.q[k] for k in shown],
    shapes=moved,
    targets=[(points - position) @ turn] * 2,
    labels=["above the table", "in the shelf"],
    azimuth=200.0,
    elevation=30.0,
    size=(1400, 640),
)
