"""Panda: configurations for 1,000 poses in one call, and 1,000 arms that move at once."""

import time

import jax
import numpy as np

import osik_jax as osik
from osik_jax import viewer

jax.config.update("jax_enable_x64", True)
osik.runtime.configure_cpu()  # before a batch: settings for small problems

arm = osik.load_robot("panda", locked_joints=("panda_finger_joint1",))
rng = np.random.default_rng(0)
positions = np.array([0.45, 0.0, 0.4]) + rng.uniform(-1.0, 1.0, (1000, 3)) * [0.25, 0.5, 0.35]
down = np.tile([0.0, 1.0, 0.0, 0.0], (1000, 1))  # quaternions w x y z
poses = {"panda_hand_tcp": (positions, down)}

# one call; a second one compiles nothing. Without restarts and closest it gives up sooner where it finds none
osik.inverse_kinematics(arm, poses, restarts=0, closest=False)
began = time.perf_counter()
found = osik.inverse_kinematics(arm, poses, restarts=0, closest=False)
seconds = time.perf_counter() - began
print(f"{int(found.converged.sum())} of {len(positions)} poses found in {1e3 * seconds:.0f} ms")
print(f"largest error of those: {1e3 * found.position_error[found.converged].max():.4f} mm")


# any function of one robot becomes one of many by jax.vmap
def move(q, position):
    """The last configuration of a motion of one second towards a position."""
    hand = osik.FrameTask(arm, "panda_hand_tcp", rows="position", gain=5.0).replace(target=position)
    tasks = {"hand": hand, "posture": osik.PostureTask(arm)}
    return osik.rollout(arm, q, tasks, steps=100, dt=0.01).q[-1]


home = found.q[found.converged][0]
ends = jax.jit(jax.vmap(move, in_axes=(None, 0)))(home, positions)
print(f"1,000 motions of 100 steps each end at configurations of shape {ends.shape}")

shown = found.q[found.converged][np.array([3, 8, 21, 34, 55, 89])]
viewer.hero_picture(
    "panda_thousand_targets.png",
    arm,
    shown,
    spacing=0.0,
    azimuth=40.0,
    size=(1000, 640),
)
