"""G1 lifts a box with both hands: its wrists keep their place on the box, whose pose is in the person's clip."""

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax import retargeting, viewer
from osik_jax.retargeting import report

jax.config.update("jax_enable_x64", True)
HALF = np.array([0.15, 0.17, 0.12])  # of the box [m]
# a path along all edges of a box, for the picture
EDGES = np.array([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, -1], [-1, -1, 1], [1, -1, 1],
                  [1, -1, -1], [1, -1, 1], [1, 1, 1], [1, 1, -1], [1, 1, 1], [-1, 1, 1], [-1, 1, -1], [-1, 1, 1],
                  [-1, -1, 1]])  # fmt: skip


def lifting(frames=75, fps=30.0):
    """A made-up clip: a person bends the knees and lifts a box with both hands."""
    time = np.arange(frames) / (frames - 1)

    def smooth(a, b):
        return 0.5 - 0.5 * np.cos(np.pi * np.clip((time - a) / (b - a), 0.0, 1.0))

    zero, bend, lifted = 0.0 * time, 0.8 * (smooth(0.0, 0.3) - smooth(0.4, 0.8)), smooth(0.4, 0.8)
    box, held = np.stack([0.42 - 0.06 * lifted, zero, 0.62 + 0.5 * lifted], 1), (time > 0.32) & (time < 0.95)
    turn, points = Rotation.from_euler("z", 0.25 * lifted[:, None]), {}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        ankle = np.stack([zero, zero + 0.1 * sign, zero + 0.08], 1)
        knee = ankle + 0.42 * np.stack([np.sin(bend), zero, np.cos(bend)], 1)
        hip = knee + 0.42 * np.stack([-np.sin(bend), zero, np.cos(bend)], 1)
        shoulder = hip + 0.52 * np.stack([np.sin(0.5 * bend), zero + 0.16 * sign, np.cos(0.5 * bend)], 1)
        grip = HALF[1] + 0.03 + 0.15 * (1.0 - smooth(0.2, 0.3) + smooth(0.95, 1.0))
        wrist = box + turn.apply(np.stack([zero - 0.08, sign * grip, zero], 1))
        elbow = 0.5 * (shoulder + wrist) + np.array([-0.05, 0.12 * sign, -0.12])
        parts = dict(hip=hip, knee=knee, ankle=ankle, shoulder=shoulder, elbow=elbow, wrist=wrist)
        parts |= dict(heel=ankle + np.array([-0.05, 0.0, -0.08]), toe=ankle + np.array([0.15, 0.0, -0.08]))
        points |= {f"{side}_{name}": track for name, track in parts.items()}
    poses, places = np.concatenate([box, turn.as_quat(scalar_first=True)], 1), np.stack(list(points.values()), 1)
    touches = tuple((f"{side}_wrist", "box", held) for side in ("left", "right"))
    return retargeting.HumanMotion("lift", fps, tuple(points), places, objects={"box": poses}, touches=touches)


robot, motion = osik.load_robot("g1"), lifting()
result = retargeting.retarget(robot, motion)
figures, box = report(result), result.objects["box"]  # figures are recomputed by MuJoCo
print(f"wrists are {figures['touches']['off_mm_max']:.2f} mm at most off their place on the box")
print(f"feet slip by {figures['feet']['slip_mm_max']:.3f} mm at most; notes: {figures['notes'] or 'none'}")

scale, shown = box[0, 2] / motion.objects["box"][0, 2], (0, 27, 45, 65)
turns = Rotation.from_quat(box[:, 3:], scalar_first=True)
viewer.hero_picture(
    "carry_a_box.png", robot, [result.q[k] for k in shown], labels=[f"{k / motion.fps:.1f} s" for k in shown],
    trails=[box[k, :3] + turns[k].apply(scale * HALF * EDGES) for k in shown],
    azimuth=35.0, size=(1400, 520),
)  # fmt: skip
