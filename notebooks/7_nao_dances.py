# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # NAO dances
#
# A person's motion becomes a robot's: limbs point where the person's do, feet stay where they stand, and the joints
# keep their limits. After this notebook you can
#
# - write a motion as keypoints and read it back;
# - retarget it, and read from the report what holds: limits, contacts, slip;
# - see what becomes of a dance that is too fast for the robot;
# - retarget frame by frame while the person moves.

# %%
import os
import tempfile
from dataclasses import replace
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

import osik_jax as osik
from osik_jax import retargeting
from osik_jax.retargeting import report
from osik_jax.viewer import hero_picture

osik.runtime.configure_cpu()  # small problems, one after another
jax.config.update("jax_enable_x64", True)  # double precision: controllers want it

FAST = "OSIK_FAST" in os.environ  # the tests run this notebook with smaller sizes
SECONDS, FPS = (1.5, 20.0) if FAST else (6.0, 30.0)
PICTURES = 3 if FAST else 6
SIZE = (300, 120) if FAST else (1200, 330)

BLUE, RED, GREY, ORANGE = "#0072b2", "#d55e00", "#8a8f98", "#e69f00"
plt.rcParams |= {"figure.dpi": 80, "axes.grid": True, "grid.color": "#e3e7ec", "axes.axisbelow": True}
plt.rcParams |= {"axes.spines.top": False, "axes.spines.right": False, "axes.titlelocation": "left", "font.size": 9.5}

# %% [markdown]
# ## 1. A dance, by formula
#
# The person is 1.7 m tall. They sway, lower themselves on every beat and wave both arms; they tap with the left foot,
# then with the right one, and go a step to their left. Knees are where thigh and shank meet.


# %%
def bump(t, start, length):
    """0, but for a smooth hill of height 1 over a stretch of time."""
    return np.where((t > start) & (t < start + length), np.sin(np.pi * (t - start) / length) ** 2, 0.0)


def ramp(t, start, length):
    """From 0 to 1, smoothly."""
    s = np.clip((t - start) / length, 0.0, 1.0)
    return s**2 * (3.0 - 2.0 * s)


def dance(seconds, fps):
    """Keypoints of a person by name, (F, 3) each: x forward, y left, z up [m]."""
    t = np.arange(round(seconds * fps)) / fps
    still, points = np.zeros_like(t), {}
    side_step = {"left": 0.12 * ramp(t, 4.1, 0.6), "right": 0.12 * ramp(t, 5.1, 0.6)}
    lifted = {"left": bump(t, 1.2, 0.7) + bump(t, 4.1, 0.6), "right": bump(t, 2.7, 0.7) + bump(t, 5.1, 0.6)}
    over = bump(t, 2.1, 1.9) + bump(t, 4.7, 1.3) - bump(t, 0.6, 1.9) - bump(t, 3.8, 0.9)  # 1: over the left foot
    middle = 0.5 * (side_step["left"] + side_step["right"]) + 0.06 * over
    height = 0.86 - 0.03 * (1.0 - np.cos(2.0 * np.pi * t))
    lean = 0.12 * over
    for side, sign in (("left", 1.0), ("right", -1.0)):
        hip = np.stack([still, middle + sign * 0.09, height], 1)
        foot = np.stack([0.05 * lifted[side], sign * 0.1 + side_step[side], 0.08 + 0.1 * lifted[side]], 1)
        points |= {f"{side}_hip": hip, f"{side}_ankle": foot, f"{side}_knee": knee(hip, foot)}
        points |= {f"{side}_{end}": foot + np.array([x, 0.0, -0.08]) for end, x in (("heel", -0.05), ("toe", 0.16))}
        up = np.stack([still, np.sin(lean), np.cos(lean)], 1)
        across = np.stack([still, np.cos(lean), -np.sin(lean)], 1)
        shoulder = np.stack([still, middle, height], 1) + 0.48 * up + sign * 0.18 * across
        raised = 0.9 + 0.8 * np.sin(np.pi * t + (0.0 if side == "left" else np.pi))  # from hanging [rad]
        bend = 0.7 + 0.4 * np.sin(2.0 * np.pi * t)
        elbow = shoulder + 0.28 * np.stack([0.2 + still, sign * np.sin(raised), -np.cos(raised)], 1) / np.sqrt(1.04)
        swing = np.stack([still, sign * np.sin(raised), -np.cos(raised)], 1) * np.cos(bend)[:, None]
        wrist = elbow + 0.26 * (swing + np.stack([np.sin(bend), still, still], 1))
        points |= {f"{side}_shoulder": shoulder, f"{side}_elbow": elbow, f"{side}_wrist": wrist}
    return points


def knee(hip, ankle, thigh=0.42, shank=0.41):
    """Where thigh and shank meet, in front of the line from hip to ankle."""
    way = ankle - hip
    far = np.linalg.norm(way, axis=1, keepdims=True)
    along = (thigh**2 - shank**2 + far**2) / (2.0 * far)
    off = np.sqrt(np.maximum(thigh**2 - along**2, 0.0))
    forward = np.cross([0.0, 1.0, 0.0], -way / far)
    return hip + along * way / far + off * forward


folder = Path(tempfile.mkdtemp())
keypoints = dance(SECONDS, FPS)
np.savez(folder / "dance.npz", fps=FPS, positions=np.stack(list(keypoints.values()), 1), joint_names=list(keypoints))
motion = retargeting.load_motion(folder / "dance.npz")
print(f"{motion.name}: {motion.frames} frames, {len(motion.joint_names)} joints")

# %% [markdown]
# ## 2. NAO does it
#
# Which of NAO's frames is which joint of the person, and where its soles are, is in a profile that comes with the
# package.

# %%
nao = osik.load_robot("nao")
result = retargeting.retarget(nao, motion)
figures = report(result)  # recomputed by MuJoCo
joints, feet, tracking = figures["joints"], figures["feet"], figures["tracking"]
print(f"limbs are {tracking['segment_angle_deg_mean']:.1f} degrees off the person's on average")
print(f"standing feet move {feet['slip_mm_max']:.3f} mm at most")
print(f"soles are {feet['below_floor_mm_max']:.3f} mm below the floor at most")
print(f"joints leave their ranges by {joints['beyond_range_max']:.1g} rad")
print(f"the fastest joint has {joints['speed_over_limit_max']:.2f} of its speed limit")
assert feet["slip_mm_max"] < 0.1 and feet["below_floor_mm_max"] < 0.1
assert joints["beyond_range_max"] == 0.0 and joints["speed_over_limit_max"] <= 1.0 + 1e-9

# %% [markdown]
# The person above, as sticks; NAO below, at the same instants.

# %%
LIMBS = [("hip", "knee"), ("knee", "ankle"), ("heel", "toe"), ("hip", "shoulder")]
LIMBS += [("shoulder", "elbow"), ("elbow", "wrist")]


def sticks(axes, frame, shift):
    """The person in one frame, seen from the front."""
    pairs = [(f"{side}_{a}", f"{side}_{b}") for side in ("left", "right") for a, b in LIMBS]
    pairs += [("left_hip", "right_hip"), ("left_shoulder", "right_shoulder")]
    for a, b in pairs:
        ends = np.stack([keypoints[a][frame], keypoints[b][frame]])
        color = BLUE if a.startswith("left") else RED
        axes.plot(ends[:, 1] + shift, ends[:, 2], color=color, lw=2.5, solid_capstyle="round")


instants = np.linspace(0.1, 0.97, PICTURES) * (motion.frames - 1)
instants = instants.astype(int)
figure, (above, below) = plt.subplots(2, 1, figsize=(12, 6.4), layout="constrained")
for k, frame in enumerate(instants):
    sticks(above, frame, 1.7 * k)
above.set(aspect="equal", title="the person from the front: left limbs blue, right limbs red")
above.axis("off")
picture = hero_picture(
    folder / "strip.png", nao, [result.q[f] for f in instants], size=SIZE, azimuth=0.0,
    labels=[f"{f / FPS:.1f} s" for f in instants],
)  # fmt: skip
below.imshow(plt.imread(picture))
below.set_title("NAO")
below.axis("off")
plt.show()

# %% [markdown]
# ## 3. Limits and contacts
#
# Joints keep position, speed and acceleration. What stands is found from heights and speeds of heels and toes; there
# the soles are at height 0 and do not move.

# %%
time = np.arange(motion.frames) / FPS
q = result.motion.qpos[:, 7:]
speed, acceleration = np.diff(q, axis=0) * FPS, np.diff(q, 2, axis=0) * FPS**2
dofs = [nao.joint_dof_index(name) for name in result.motion.joint_names if name in nao.joint_names]
own = [k for k, name in enumerate(result.motion.joint_names) if name in nao.joint_names]
low, high, fast = (np.asarray(x)[dofs] for x in (nao.position_lower, nao.position_upper, nao.velocity_limit))
figure, axes = plt.subplots(3, 1, figsize=(9, 6.5), sharex=True, layout="constrained")
axes[0].plot(time, 2.0 * (q[:, own] - low) / (high - low) - 1.0, lw=0.8)
axes[0].set(title="joints in their ranges", ylabel="share", ylim=(-1.1, 1.1))
axes[1].plot(time[1:], speed[:, own] / fast, lw=0.8)
axes[1].set(title="speeds, shares of their limits", ylabel="share", ylim=(-1.1, 1.1))
axes[2].plot(time[1:-1], acceleration[:, own], lw=0.8)
axes[2].set(title="accelerations", ylabel="rad/s²", xlabel="time [s]")
for ax in axes[:2]:
    for bound in (-1.0, 1.0):
        ax.axhline(bound, color=RED, lw=1.0, ls="--")
plt.show()


# %%
def soles(q):
    """Heights and places of left heel, left toe, right heel and right toe: middles of two corners. (F, 4, 3)"""
    corners = result.profile.corners

    def of_one(x):
        kinematics = osik.forward_kinematics(nao, x)
        poses = [kinematics.frame_pose(nao, frame) for frame, _ in corners]
        points = [p + R @ np.array(point) for (p, R), (_, point) in zip(poses, corners, strict=True)]
        return jax.numpy.stack(points).reshape(4, 2, 3).mean(1)

    return np.asarray(jax.jit(jax.vmap(of_one))(q))


tracks = soles(result.q)
names = ("left heel", "left toe", "right heel", "right toe")
figure, axes = plt.subplots(2, 1, figsize=(9, 4.6), sharex=True, layout="constrained")
for k, (name, color) in enumerate(zip(names, (BLUE, "#56b4e9", RED, ORANGE), strict=True)):
    stands = result.contact[:, k]
    axes[0].plot(time, 1e3 * tracks[:, k, 2], color=color, lw=1.2, label=name)
    axes[0].plot(time, np.where(stands, -4.0 - 3.0 * k, np.nan), color=color, lw=4.0)
    both = stands[1:] & stands[:-1]
    moved = 1e6 * np.linalg.norm(np.diff(tracks[:, k, :2], axis=0), axis=-1)
    axes[1].plot(time[1:], np.where(both, moved, np.nan), color=color, lw=1.2)
axes[0].set(title="height of heels and toes; bars: they stand", ylabel="mm")
axes[0].legend(ncols=4, fontsize=8)
axes[1].set(title="what standing heels and toes move from one frame to the next", ylabel="µm", xlabel="time [s]")
plt.show()

# %% [markdown]
# ## 4. Faster than NAO can
#
# The same dance in a third of the time. The plan knows what comes, so that joints lead instead of lagging: the limbs
# follow less well, and the limits hold all the same.

# %%
quick = replace(motion, name="quick", fps=3.0 * FPS).resampled(FPS)
hurried = retargeting.retarget(nao, quick)
hasty = report(hurried)
print(f"{'':24}{'as danced':>12}{'3 x faster':>12}")
for name, part, key in (
    ("limbs off [deg]", "tracking", "segment_angle_deg_mean"),
    ("speed / limit", "joints", "speed_over_limit_max"),
    ("acceleration [rad/s²]", "joints", "acceleration_max"),
    ("slip [mm]", "feet", "slip_mm_max"),
):
    print(f"{name:24}{figures[part][key]:12.3f}{hasty[part][key]:12.3f}")
assert hasty["joints"]["beyond_range_max"] == 0.0
assert hasty["joints"]["speed_over_limit_max"] <= 1.0 + 1e-9

# %% [markdown]
# ## 5. While the person dances
#
# A stream has no future. `LiveRetargeter` waits for some frames, so that it has a little of one, and gives a frame of
# the robot for each of the person. Here about every tenth frame is lost.

# %%
live = retargeting.LiveRetargeter(nao, motion, look_ahead=0.13 if FAST else 0.27)
rng = np.random.default_rng(0)
frames = [live.step(None if f > 0 and rng.random() < 0.1 else p) for f, p in enumerate(motion.positions)]
frames = [frame for frame in frames if frame is not None] + live.finish()
streamed = np.array([frame.q for frame in frames])
filled = sum(frame.status.name == "FILLED" for frame in frames)
places = [nao.joint_qpos_index(name) for name in nao.joint_names]
apart = np.degrees(np.abs(streamed - result.q)[:, places])
print(f"{live.latency:.2f} s behind the person; {filled} frames were filled in")
print(f"joints are {apart.mean():.1f} degrees from those of the whole clip on average")
rates = np.diff(streamed[:, places], axis=0) * FPS
own_fast = np.asarray(nao.velocity_limit)[[nao.joint_dof_index(name) for name in nao.joint_names]]
assert (np.abs(rates) <= own_fast * (1.0 + 1e-9)).all()

figure, ax = plt.subplots(figsize=(9, 2.6), layout="constrained")
for name, color in (("LShoulderPitch", BLUE), ("LKneePitch", RED)):
    at = nao.joint_qpos_index(name)
    ax.plot(time, np.degrees(result.q[:, at]), color=color, lw=1.0, ls="--", label=f"{name}, whole clip")
    ax.plot(time, np.degrees(streamed[:, at]), color=color, lw=1.6, label=f"{name}, frame by frame")
ax.set(title="with the whole clip, and frame by frame", ylabel="degrees", xlabel="time [s]")
ax.legend(ncols=2, fontsize=8)
plt.show()
