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
# # Quickstart
#
# After this notebook you can
#
# - load a robot, say what it should do (tasks) and what it must not do (limits),
# - compute one step of control and run the closed loop,
# - look at the robot: a picture, a film, and MuJoCo's interactive viewer,
# - do the same for hundreds of targets at once.

# %%
import os
import tempfile
from base64 import b64encode
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import mujoco
import numpy as np
from IPython.display import HTML, Image, display
from matplotlib.colors import LogNorm

import osik_jax as osik
from osik_jax.viewer import animate, hero_picture

osik.runtime.configure_cpu()  # small problems, one after another
jax.config.update("jax_enable_x64", True)  # double precision: controllers want it

FAST = "OSIK_FAST" in os.environ  # the tests run this notebook with smaller sizes
STEPS = 60 if FAST else 200  # steps of the closed loop
GRID = 3 if FAST else 21  # targets along each side of the map
FRAME_RATE = 2 if FAST else 10  # of the film [1/s]
DT = 0.01  # one step [s]

plt.rcParams.update({"figure.dpi": 80, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True})
plt.rcParams.update({"grid.color": "#e3e7ec", "axes.axisbelow": True, "axes.titlelocation": "left"})
BLUE, ORANGE, GREEN, RED = "#0072b2", "#e69f00", "#009e73", "#d55e00"  # safe for colour-blind readers
folder = Path(tempfile.mkdtemp())  # for pictures and films

# %% [markdown]
# ## Load a robot
#
# Two robots come with the package: the humanoid `nao` and the arm `arm7`. Your own is one call away:
# `osik.Robot.from_urdf("my.urdf")` or `osik.Robot.from_mjcf("my.xml")`.

# %%
robot = osik.load_robot("nao")
print(f"{robot.nq} numbers describe a configuration q (7 of them place the free base)")
print(f"{robot.nv} numbers describe a velocity v")
print("joints:", ", ".join(robot.joint_names[1:8]), "...")
print("frames:", ", ".join(robot.frame_names[-8:]))

# %% [markdown]
# The picture is drawn by casting rays on the CPU, so it needs neither a display nor OpenGL.

# %%
size = (640, 400)
display(Image(hero_picture(folder / "nao.png", robot, [robot.q0], size=size)))

# %% [markdown]
# ## Say what it should do
#
# A task is a wish: "this frame there". Its `gain` says how fast an error should shrink, its `priority` who goes first
# where wishes conflict (1 is the most important). Limits are no wishes: they are kept.

# %%
feet = ("l_sole", "r_sole")
standing = osik.support_polygon(robot, robot.q0, feet, margin=0.01)  # the area over which NAO does not fall

tasks = {
    "left_foot": osik.FrameTask(robot, "l_sole", priority=1, weight=1e4),  # no target: it stays where it is
    "right_foot": osik.FrameTask(robot, "r_sole", priority=1, weight=1e4),
    "balance": osik.ComTask(robot, polygon=standing, priority=2, weight=1e2),  # centre of mass over the feet, anywhere
    "hand": osik.FrameTask(robot, "l_gripper", rows="position", gain=3.0, priority=3),
    "posture": osik.PostureTask(robot, gain=1.0, weight=1e-3, priority=4),
}
position, rotation = tasks["hand"].target  # where the hand is now
target = position + jnp.array([0.13, -0.04, 0.12])
tasks["hand"] = tasks["hand"].replace(target=(target, rotation))  # tasks are immutable: this is a new one

limits = (osik.ConfigurationLimit(robot), osik.VelocityLimit(robot))

# %% [markdown]
# A name that does not exist is an error at once, and the message lists what there is:

# %%
try:
    osik.FrameTask(robot, "l_griper")
except KeyError as error:
    print(error.args[0])

# %% [markdown]
# ## One step
#
# `solve` gives the velocity that serves the tasks best at a configuration. The first call compiles; after that,
# changing any number (target, weight, gain, limit) compiles nothing.

# %%
step = osik.solve(robot, robot.q0, tasks, scheme=osik.HierarchicalQP(), limits=limits, dt=DT)
assert step.status == osik.Status.SOLVED
print("status:", osik.Status(int(step.status)).name)
for name, left in step.slack.items():
    print(f"{name:>10}: wanted minus got, at most {np.abs(left).max():.1e}")

# %%
moving = np.asarray(step.velocity[6:])  # the first 6 are the free base
names = np.array([name for name in robot.joint_names if robot.joint_dof_index(name) >= 6])
names = names[np.argsort([robot.joint_dof_index(name) for name in names])]
busy = np.argsort(-np.abs(moving))[:10][::-1]

fig, axes = plt.subplots(figsize=(7, 3.4))
fastest = np.asarray(robot.velocity_limit)[6:]
axes.barh(names[busy], 2 * fastest[busy], left=-fastest[busy], color="#e3e7ec", label="limit")
axes.barh(names[busy], moving[busy], color=BLUE, label="velocity")
axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
axes.set(xlabel="velocity [rad/s]", title="The first step: legs and arm reach together")
axes.axvline(0.0, color="black", lw=0.8)
plt.show()

# %% [markdown]
# ## The closed loop
#
# `rollout` repeats it: solve, move, solve again. All steps are one compiled program.

# %%
motion = osik.rollout(robot, robot.q0, tasks, scheme=osik.HierarchicalQP(), limits=limits, dt=DT, steps=STEPS)
assert (motion.solution.status == osik.Status.SOLVED).all()

moments = [0, STEPS // 8, STEPS // 3, STEPS]
labels = [f"{moment * DT:.2f} s" for moment in moments]
polygons = [np.asarray(standing.vertices)] * len(moments)
strip = hero_picture(
    folder / "strip.png", robot, np.asarray(motion.q)[moments], support=polygons, labels=labels, size=(1100, 400)
)
display(Image(strip))

# %% [markdown]
# Green: the area over which the robot does not fall. Orange: the centre of mass and its plumb line.
#
# Did it do what was asked? The positions below come from MuJoCo's own kinematics, not from this library.

# %%
hand, left, right, com = [], [], [], []
data = mujoco.MjData(robot.mj_model)
for q in motion.q:
    data.qpos[:] = robot.mujoco_qpos(q)
    mujoco.mj_kinematics(robot.mj_model, data)
    mujoco.mj_comPos(robot.mj_model, data)
    hand.append(data.body("l_gripper").xpos.copy())
    left.append(data.site("l_sole").xpos.copy())
    right.append(data.site("r_sole").xpos.copy())
    com.append(data.subtree_com[0].copy())
distance = np.linalg.norm(np.array(hand) - np.asarray(target), axis=1)
slip = max(np.abs(np.array(foot) - foot[0]).max() for foot in (left, right))
room = np.array([float(standing.distance(point[:2])) for point in com[:: 1 + STEPS // 30]])
time = DT * np.arange(STEPS + 1)

fig, (one, two) = plt.subplots(1, 2, figsize=(10, 3.2))
one.plot(time, 1e3 * distance, color=BLUE, label="hand")
one.plot(time, 1e3 * distance[0] * np.exp(-3.0 * time), ":", color="black", label="exp(-gain t)")
one.set(xlabel="time [s]", ylabel="distance to its target [mm]", title="The error shrinks as the gain says")
one.legend(frameon=False)
two.plot(time[:: 1 + STEPS // 30], 1e3 * room, color=ORANGE, label="centre of mass")
two.axhline(0.0, color=RED, ls="--", label="edge of the area, less 10 mm")
two.set(xlabel="time [s]", ylabel="distance to the edge [mm]", title="... and NAO stays balanced")
two.legend(frameon=False)
fig.tight_layout()
plt.show()

print(f"the hand ends {1e3 * distance[-1]:.2f} mm from its target; the feet moved {1e3 * slip:.1e} mm")
assert slip < 1e-4 and room.min() > -1e-4  # a tenth of a millimetre: what a step of 10 ms rounds off

# %% [markdown]
# ## A film
#
# `animate` writes a GIF, or an MP4 where the program ffmpeg is installed. As a part of the page it is kept when the
# notebook is made into one by `jupyter nbconvert --to html`, which passes over outputs that are GIFs themselves.

# %%
film = animate(
    folder / "reach.gif",
    robot,
    np.asarray(motion.q),
    dt=DT,
    frames_per_second=FRAME_RATE,
    size=(320, 220),
    trails=["l_gripper"],
    caption="NAO reaches forward",
)
encoded = b64encode(film.read_bytes()).decode()
display(HTML(f'<img alt="NAO reaches forward" src="data:image/gif;base64,{encoded}">'))


# %% [markdown]
# ## The interactive viewer
#
# With a display, MuJoCo's own window shows the motion; turn it with the mouse. (On macOS, run this as a script with
# `mjpython`.) The cell below opens it only where there is a display.


# %%
def play(robot, path, dt):
    """Shows a path in MuJoCo's viewer, again and again until its window is closed."""
    import time

    import mujoco.viewer

    data = mujoco.MjData(robot.mj_model)
    poses = np.asarray(jax.vmap(robot.mujoco_qpos)(jnp.asarray(path)))
    with mujoco.viewer.launch_passive(robot.mj_model, data) as window:
        while window.is_running():
            for pose in poses:
                data.qpos[:] = pose
                mujoco.mj_forward(robot.mj_model, data)
                window.sync()
                time.sleep(dt)


if os.environ.get("DISPLAY"):
    play(robot, motion.q, DT)
else:
    print("no display here: nothing opened")


# %% [markdown]
# ## Many at once
#
# A batch is `jax.vmap` over whatever differs. Here: where can NAO put its hand, in the plane that lies 5 cm inwards of
# it, if the feet may not move and it may not fall? One rollout for each target, all in one call.


# %%
def reach(p):
    """Where the hand ends, from its target p."""
    aimed = {**tasks, "hand": tasks["hand"].replace(target=(p, rotation))}
    path = osik.rollout(robot, robot.q0, aimed, limits=limits, dt=0.02, steps=STEPS // 2)
    return jnp.linalg.norm(path.solution.error["hand"][-1]), path.solution.status.max()


forward = np.linspace(-0.15, 0.25, GRID)
up = np.linspace(-0.25, 0.25, GRID)
X, Z = np.meshgrid(forward, up)
targets = position + np.stack([X.ravel(), np.full(X.size, -0.05), Z.ravel()], 1)
miss, status = jax.jit(jax.vmap(reach))(targets)
assert (status == osik.Status.SOLVED).all()

fig, axes = plt.subplots(figsize=(6.4, 4.6))
left = 1e3 * np.asarray(miss).reshape(X.shape)
colors = axes.pcolormesh(100 * X, 100 * Z, left, norm=LogNorm(1.0, 300.0), cmap="cividis", shading="nearest")
axes.plot(0, 0, "o", color="white", label="the hand at the start")
fig.colorbar(colors, label="left to the target [mm]")
axes.set(xlabel="target: forward [cm]", ylabel="target: up [cm]", title=f"{len(targets)} targets in one call")
axes.legend(frameon=False, labelcolor="white")
plt.show()
print(f"{(np.asarray(miss) < 5e-3).mean():.0%} of {len(targets)} targets are reached within 5 mm")

# %% [markdown]
# ## Next
#
# - `2_schemes_compared`: which scheme for which problem, in numbers.
# - The pages in `docs`: conventions (units, frames, signs), tasks and limits, the loop.
