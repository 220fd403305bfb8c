"""NAO does what a person does: keypoints of a person who squats and waves become a motion of the robot."""

import jax
import numpy as np

import osik_jax as osik
from osik_jax import retargeting, viewer
from osik_jax.retargeting import report

jax.config.update("jax_enable_x64", True)


def person(frames=61, fps=30.0):
    """A made-up clip. For yours, retargeting.load_motion reads BVH files, and keypoints from .npz files."""
    phase = np.linspace(0.0, 2.0 * np.pi, frames)
    zero, bend = 0.0 * phase, 0.35 * (1.0 - np.cos(phase))
    points = {}
    for side, y, wave in (("left", 0.1, 0.9), ("right", -0.1, 0.25)):
        lift = 0.3 + wave * (1.0 - np.cos(phase))
        out = np.sign(y) * np.sin(lift)
        ankle = np.stack([zero, zero + y, zero + 0.08], 1)
        knee = ankle + 0.4 * np.stack([np.sin(bend), zero, np.cos(bend)], 1)
        hip = knee + 0.4 * np.stack([-np.sin(bend), zero, np.cos(bend)], 1)
        shoulder = hip + np.array([0.0, y, 0.5])
        elbow = shoulder + 0.28 * np.stack([zero, out, -np.cos(lift)], 1)
        wrist = elbow + 0.25 * np.stack([zero + 0.6, 0.8 * out, -0.8 * np.cos(lift)], 1)
        parts = dict(hip=hip, knee=knee, ankle=ankle, shoulder=shoulder, elbow=elbow, wrist=wrist)
        parts |= dict(heel=ankle - np.array([0.05, 0.0, 0.08]), toe=ankle + np.array([0.15, 0.0, -0.08]))
        points |= {f"{side}_{name}": track for name, track in parts.items()}
    return retargeting.HumanMotion("squat", fps, tuple(points), np.stack(list(points.values()), 1))


nao = osik.load_robot("nao")
result = retargeting.retarget(nao, person())
figures = report(result)  # recomputed by MuJoCo from the configurations alone
print(f"{len(result.q)} frames")
print(f"limbs are turned by {figures['tracking']['segment_angle_deg_mean']:.1f} degrees from the person's, on average")
print(f"feet slip by {figures['feet']['slip_mm_max']:.4f} mm at most")
print(f"joints beyond their range by {figures['joints']['beyond_range_max']:.1e} rad at most")

viewer.hero_picture(
    "retarget_a_person.png",
    nao,
    [result.q[k] for k in (0, 15, 30)],
    labels=["0 s", "0.5 s", "1 s"],
    size=(1200, 520),
    azimuth=30.0,
)
