"""Panda: a torch follows a curved seam at constant speed, free to turn about its own axis, within published limits."""

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax import viewer
from osik_jax.motion import follow

jax.config.update("jax_enable_x64", True)
tip, wanted = "panda_hand_tcp", 0.1
arm = osik.load_robot("panda", locked_joints=("panda_finger_joint1",))
arm = arm.with_home({"panda_joint2": -0.5, "panda_joint4": -2.4, "panda_joint6": 1.9, "panda_joint7": 0.78})

# a wavy seam on a table; the torch points down and leans forward along the seam by 15 degrees
y = np.linspace(-0.3, 0.3, 60)
seam = np.stack([0.5 + 0.06 * np.sin(2.0 * np.pi * y / 0.3), y, np.full(60, 0.12)], axis=1)
heading = np.arctan2(*np.gradient(seam, axis=0)[:, 1::-1].T)
turns = Rotation.from_euler("zyx", np.stack([heading, 0.0 * heading + np.deg2rad(15.0), 0.0 * heading + np.pi], axis=1))

acceleration = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])
limits = {"acceleration": acceleration, "jerk": 500.0 * acceleration}
motion = follow(arm, {tip: (seam, turns.as_matrix())}, free={tip: "z"}, speed=wanted, q0=arm.q0, **limits)
sampled = motion.sample(dt=0.001)  # sampled.save("motion.csv") writes it

place = jax.jit(jax.vmap(lambda q: osik.forward_kinematics(arm, q).frame_pose(arm, tip)[0]))
drawn = np.asarray(place(sampled.position))
speed = np.linalg.norm(np.diff(drawn, axis=0), axis=1) / 0.001
at_speed = np.mean(np.abs(speed - wanted) < 0.01 * wanted)
print(f"{motion.duration:.2f} s, {1e3 * motion.position_error:.4f} mm off its seam")
print(
    f"at {wanted} m/s for {100 * at_speed:.0f} % of the time; joints up to {np.abs(sampled.velocity).max():.2f} rad/s"
)
for part in motion.slow_parts():
    print(f"slower from {part.start:.2f} to {part.end:.2f} s: {part.limit} of {part.joint}")
viewer.hero_picture(
    "weld_line.png",
    arm,
    [sampled.position[k] for k in np.linspace(0, len(drawn) - 1, 3).astype(int)],
    shapes=[osik.CollisionShape.box([0.25, 0.4, 0.01], np.array([0.5, 0.0, 0.1]))],
    trails=[drawn] * 3,
    azimuth=35.0,
    elevation=25.0,
    size=(1400, 480),
)
