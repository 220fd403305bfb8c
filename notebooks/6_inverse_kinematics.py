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
# # Inverse kinematics
#
# After this notebook you can
#
# - go from a pose of the hand to a configuration of the robot, and to all of them that are found;
# - do it for thousands of poses in one call, and say which share is reached;
# - read why a target is not reached, and what is proven about it;
# - follow a path without jumps, and take derivatives through a solution;
# - place both hands of a humanoid that keeps its feet and its balance;
# - draw a map of what a hand can reach.

# %%
import os
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import mujoco
import numpy as np
from IPython.display import Image, display

import osik_jax as osik
from osik_jax import reachability
from osik_jax.viewer import hero_picture

osik.runtime.configure_cpu()  # small problems, and batches on all cores
jax.config.update("jax_enable_x64", True)  # double precision

FAST = "OSIK_FAST" in os.environ  # the tests run this notebook with smaller sizes
SEEDS = 16 if FAST else 64  # searches for all solutions of a pose
POSES = 64 if FAST else 5000
PATH = 8 if FAST else 60  # poses along it
CLIMB = 4 if FAST else 22  # steps along a gradient
GRID, TURNS = (5, 4) if FAST else (31, 24)  # positions along each side of the map, orientations

plt.rcParams |= {"figure.dpi": 80, "axes.grid": True, "grid.color": "#e3e7ec", "axes.axisbelow": True}
plt.rcParams |= {"axes.spines.top": False, "axes.spines.right": False, "axes.titlelocation": "left", "font.size": 9.5}
BLUE, ORANGE, GREEN, RED, GREY = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#8a8f98"  # safe for colour-blind readers
folder = Path(tempfile.mkdtemp())  # for pictures

# %% [markdown]
# ## One pose
#
# The arm that comes with the package has seven joints and the measures of a Panda. A pose is a position [m] and an
# orientation, here a quaternion w x y z: the gripper looks at the floor. The first call compiles; after that,
# another pose compiles nothing.

# %%
arm = osik.load_robot("arm7")
position, down = np.array([0.5, 0.1, 0.3]), np.array([0.0, 1.0, 0.0, 0.0])

found = osik.inverse_kinematics(arm, {"hand": (position, down)})
print(found.explain())
print("q [rad]:", np.round(np.asarray(found.q), 3))

start = time.perf_counter()
again = osik.inverse_kinematics(arm, {"hand": (position + 0.01, down)})
print(f"another pose: {1e3 * (time.perf_counter() - start):.1f} ms; converged: {again.converged}")
assert found.converged and again.converged

# %% [markdown]
# `converged` says that the errors are within the tolerances (1 mm and 0.01 rad unless you say otherwise), computed anew
# at the answer. Do not take our word for it: MuJoCo's kinematics of the same robot.


# %%
def mujoco_data(robot, q):
    """MuJoCo's data at a configuration."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = robot.mujoco_qpos(q)
    mujoco.mj_kinematics(robot.mj_model, data)
    mujoco.mj_comPos(robot.mj_model, data)
    return data


def hands(q):
    """By MuJoCo, positions (n, 3) and orientations (n, 3, 3) of the hand at configurations (n, 7)."""
    poses = [mujoco_data(arm, one).site("hand") for one in np.atleast_2d(q)]
    return np.array([pose.xpos for pose in poses]), np.array([pose.xmat.reshape(3, 3) for pose in poses])


looks_down = np.diag([1.0, -1.0, -1.0])  # the quaternion above as a matrix
place, rotation = hands(found.q)
print(f"MuJoCo: {np.linalg.norm(place[0] - position):.1e} m and {np.abs(rotation[0] - looks_down).max():.1e} off")
assert np.linalg.norm(place[0] - position) < 1e-3


# %%
def show(configurations, targets, **settings):
    """Show the arm at configurations, side by side, with crosses at their targets."""
    given = {"size": (900, 380), "azimuth": -60.0, "elevation": 16.0, **settings}
    display(Image(hero_picture(folder / "arm.png", arm, configurations, targets=targets, **given)))


show([found.q], [[position]], size=(480, 380))

# %% [markdown]
# ## All solutions
#
# Seven joints for six numbers: this pose has infinitely many solutions. `all=True` takes every search to its end and
# keeps those that differ by more than 0.1 rad in some joint.

# %%
every = osik.inverse_kinematics(arm, {"hand": (position, down)}, all=True, seeds=SEEDS)
solutions = np.asarray(every.solutions[: int(every.count)])
lower, upper = np.asarray(arm.position_lower), np.asarray(arm.position_upper)
away = np.linalg.norm(hands(solutions)[0] - position, axis=1)
print(f"{len(solutions)} solutions that differ; the hand is at most {away.max():.1e} m off in any of them")
assert len(solutions) > 4 and away.max() < 1e-3
assert ((solutions >= lower) & (solutions <= upper)).all()

# %%
shown = solutions[:6]
show(shown, [[position]] * len(shown))

# %%
fig, panel = plt.subplots(figsize=(7.0, 3.0))
joints = np.arange(1, 8)
panel.bar(joints, upper - lower, bottom=lower, width=0.55, color="#e3e7ec", label="limits")
panel.plot(joints, solutions.T, "-o", color=BLUE, alpha=0.35, lw=0.8, ms=3)
panel.plot(joints, solutions[0], "-o", color=ORANGE, lw=1.8, ms=4, label="the first")
panel.set(xlabel="joint", ylabel="angle [rad]", title=f"{len(solutions)} ways to be at one pose")
panel.legend(frameon=False, loc="upper right", bbox_to_anchor=(1.0, 1.16), ncols=2)
plt.show()

# %% [markdown]
# ## Thousands of poses
#
# Arrays with one more axis in front are many targets, and so is every field of the answer. These are the poses of
# random configurations, so each has a solution: how many are found?

# %%
rng = np.random.default_rng(0)
places, rotations = hands(lower + (upper - lower) * rng.random((POSES, 7)))
osik.inverse_kinematics(arm, {"hand": (places, rotations)})  # compiles

start = time.perf_counter()
many = osik.inverse_kinematics(arm, {"hand": (places, rotations)})
q = np.asarray(many.q)
seconds = time.perf_counter() - start

away = np.linalg.norm(hands(q)[0] - places, axis=1)
print(f"{POSES:,} poses in {seconds:.2f} s: {POSES / seconds:,.0f} a second on {os.cpu_count()} cores")
print(f"found: {many.converged.mean():.2%}; by MuJoCo within 1 mm: {(away < 1e-3).mean():.2%}")
print(f"outside a limit: {((q < lower) | (q > upper)).any(1).sum()} of {POSES:,} configurations")
assert many.converged.mean() > 0.99 and (away[many.converged] < 1e-3).all()
assert ((q >= lower) & (q <= upper)).all()

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(10, 3.0))
left.hist(np.asarray(many.steps), bins=np.geomspace(4, max(int(many.steps.max()), 8) + 1, 30), color=BLUE)
left.set(xscale="log", xlabel="steps, all searches of a pose together", ylabel="poses", title="Most need few steps")
right.hist(np.log10(np.maximum(away, 1e-17)), bins=30, color=GREEN)
right.axvline(-3.0, color=RED, lw=1.2, ls="--")
right.text(-3.15, right.get_ylim()[1] * 0.92, "asked for", color=RED, ha="right", va="top")
right.set(xlabel="distance from the target, power of ten [m]", title="Found is exact")
fig.tight_layout()
plt.show()

# %% [markdown]
# ## A target that cannot be reached
#
# The answer is the best configuration that was found, and the reasons. `beyond_reach` is a proof: the position is
# that much further away than the links are long, whatever the joints do. Where it is 0 nothing is proven, and the
# joints that stop the robot at their limits are named.

# %%
targets = {
    "too far": (np.array([1.3, 0.1, 0.3]), down),
    "too near": (np.array([0.1, 0.0, 0.3]), down),
}
answers = {}
for name, pose in targets.items():
    answers[name] = osik.inverse_kinematics(arm, {"hand": pose}, seeds=32, restarts=0)
    print(f"{name}: {answers[name].explain()}")
    assert not answers[name].converged
assert answers["too far"].beyond_reach > 0.0 and answers["too near"].beyond_reach == 0.0

# %%
errors = {name: f"{a.position_error:.2f} m, {a.orientation_error:.2f} rad off" for name, a in answers.items()}
show(
    [answers[name].q for name in targets],
    [[goal] for goal, _ in targets.values()],
    trails=[[hands(answers[name].q)[0][0], goal] for name, (goal, _) in targets.items()],
    labels=[f"{name}: {errors[name]}" for name in targets],
)

# %% [markdown]
# ## Along a path
#
# Each pose of a circle by itself gives solutions that have nothing to do with their neighbours. `nearest=True`
# returns, of the solutions that are found around `q0`, the one nearest to it: from pose to pose the robot hardly
# moves.

# %%
angle = np.linspace(0.0, 2.0 * np.pi, PATH)
circle = np.array([0.5, 0.0, 0.4]) + 0.2 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], 1)

alone = osik.inverse_kinematics(arm, {"hand": (circle, np.tile(down, (PATH, 1)))})

followed, q = [], arm.q0
for place in circle:
    step = osik.inverse_kinematics(arm, {"hand": (place, down)}, q0=q, nearest=True, seeds=16)
    assert step.converged
    q = step.q
    followed.append(np.asarray(q))
followed = np.array(followed)

for name, path in (("each by itself", np.asarray(alone.q)), ("nearest=True", followed)):
    print(f"{name:>15}: a joint turns by at most {np.abs(np.diff(path, axis=0)).max():.2f} rad from pose to pose")
assert np.abs(hands(followed)[0] - circle).max() < 1e-3
if not FAST:
    assert np.abs(np.diff(followed, axis=0)).max() < 0.3

# %%
fig, both = plt.subplots(1, 2, figsize=(10, 3.0), sharey=True)
for panel, path, title in zip(both, (np.asarray(alone.q), followed), ("Each by itself", "nearest=True"), strict=True):
    panel.plot(np.degrees(angle), path, lw=1.3)
    panel.set(xlabel="along the circle [deg]", title=title)
both[0].set_ylabel("joints [rad]")
both[1].legend([f"joint {k}" for k in joints], frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
fig.tight_layout()
plt.show()

# %% [markdown]
# ## A gradient through the solution
#
# Inside `jit` the call is a pure function, and its answer has a derivative: of all motions that keep the hand on its
# target, the shortest. Where should the work piece be so that the hand moves well in every direction? Follow the
# gradient of Yoshikawa's manipulability with respect to the target.


# %%
def manipulability(target, q0):
    """Of the solution for a target [m] that is found from q0, and the solution."""
    exact = dict(position_tolerance=1e-6, orientation_tolerance=1e-5)
    q = osik.inverse_kinematics(arm, {"hand": (target, down)}, q0=q0, seeds=2, steps=16, **exact).q
    jacobian = osik.frame_jacobian(arm, osik.forward_kinematics(arm, q), "hand")
    return jnp.sqrt(jnp.linalg.det(jacobian @ jacobian.T)), q


better = jax.jit(jax.value_and_grad(manipulability, has_aux=True))
target, q = jnp.asarray(position), found.q
(value, _), slope = better(target, q)
step = 1e-4
ends = [[better(target + side * step * axis, q)[0][0] for side in (1, -1)] for axis in np.eye(3)]
differences = np.array([(ahead - behind) / (2.0 * step) for ahead, behind in ends])
print("gradient [1/m]:     ", np.round(np.asarray(slope), 5))
print("central differences:", np.round(differences, 5))
np.testing.assert_allclose(slope, differences, atol=1e-4)

# %%
way = [(target, value)]
for _ in range(CLIMB):
    (value, q), slope = better(target, q)
    target = target + 0.01 * slope / jnp.linalg.norm(slope)  # 1 cm uphill
    way.append((target, better(target, q)[0][0]))
positions, values = (np.array(part) for part in zip(*way, strict=True))
print(
    f"manipulability {values[0]:.3f} -> {values[-1]:.3f}; the hand went from {positions[0]} to {positions[-1].round(3)}"
)
assert values[-1] > values[0]

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(10, 3.0), width_ratios=[1.2, 1.0])
left.plot(values, color=BLUE)
left.set(xlabel="steps of 1 cm", ylabel="manipulability", title="Uphill")
right.plot(positions[:, 0], positions[:, 2], "-", color=BLUE)
right.plot(*positions[0, [0, 2]], "o", color=ORANGE, label="start")
right.plot(*positions[-1, [0, 2]], "P", color=GREEN, label="end")
right.set(xlabel="x [m]", ylabel="z [m]", title="Where the work piece goes", aspect="equal")
right.locator_params(nbins=5)
right.legend(frameon=False)
fig.tight_layout()
plt.show()

# %% [markdown]
# ## A humanoid: feet held, both hands placed
#
# With tasks in place of poses, a step is that of a scheme. What says where things have to be (feet, hands, centre of
# mass) has to be met; the posture is a preference, which decides between solutions.

# %%
nao = osik.load_robot("nao")
feet = ("l_sole", "r_sole")
standing = osik.support_polygon(nao, nao.q0, feet, margin=0.01)
tasks = {foot: osik.FrameTask(nao, foot, weight=10.0) for foot in feet}  # no target: they stay where they are
tasks["balance"] = osik.ComTask(nao, polygon=standing, weight=10.0)  # anywhere over the feet
tasks |= {hand: osik.FrameTask(nao, hand, rows="position") for hand in ("l_gripper", "r_gripper")}
tasks["posture"] = osik.PostureTask(nao, weight=1e-3)

home = {hand: np.asarray(tasks[hand].target[0]) for hand in ("l_gripper", "r_gripper")}
wanted = {
    "one low, one high": {"l_gripper": [0.04, 0.0, -0.10], "r_gripper": [-0.02, 0.0, 0.16]},
    "both forward": {"l_gripper": [0.05, -0.06, 0.02], "r_gripper": [0.05, 0.06, 0.02]},
    "to the left": {"l_gripper": [0.0, 0.10, 0.08], "r_gripper": [0.02, 0.12, 0.04]},
}
targets = {hand: np.array([home[hand] + np.array(shift[hand]) for shift in wanted.values()]) for hand in home}
stood = osik.inverse_kinematics(nao, tasks, targets=targets, seeds=8, restarts=1)
for k, name in enumerate(wanted):
    print(f"{name:>18}: {stood.explain(k)}")
assert stood.converged.all()

# %%
before = mujoco_data(nao, nao.q0)
for q, own in zip(stood.q, range(len(wanted)), strict=True):
    data = mujoco_data(nao, q)
    slip = max(np.linalg.norm(data.site(foot).xpos - before.site(foot).xpos) for foot in feet)
    miss = max(np.linalg.norm(data.body(hand).xpos - targets[hand][own]) for hand in home)
    inside = float(standing.distance(data.subtree_com[0][:2]))
    print(f"MuJoCo: feet moved {slip:.1e} m, hands {miss:.1e} m off, centre of mass {inside:+.3f} m inside")
    assert slip < 1e-3 and miss < 1e-3 and inside > -1e-3

# %%
picture = folder / "nao.png"
poses, outline = list(np.asarray(stood.q)), [np.asarray(standing.vertices)] * len(wanted)
display(Image(hero_picture(picture, nao, poses, support=outline, labels=list(wanted), size=(900, 420))))

# %% [markdown]
# ## What the hand reaches
#
# A map asks for many poses at once: at each position of a grid, which share of orientations is reached. A number of
# orientations is spread evenly over all there are; for a gripper that comes from above, give those. The grid is a
# slice through the middle of the arm here.

# %%
grid = np.linspace(-0.95, 0.95, GRID), np.array([0.0]), np.linspace(-0.55, 1.35, GRID)
around = reachability.reachability_map(arm, "hand", grid=grid, orientations=TURNS, seeds=16, progress=False)
some = around.reached.any(-1)
print(f"{some.size:,} positions; proven out of reach: {(around.beyond_reach > 0.0).sum():,}; reached: {some.sum():,}")
print(f"in more than half of the orientations: {(around.share > 0.5).sum():,}; in all: {(around.share == 1.0).sum():,}")
best = np.unravel_index(np.nanargmax(around.manipulability), some.shape)
print(f"most manipulable at {around.positions[best].round(2)} m: {around.manipulability[best]:.3f}")
assert not some[around.beyond_reach > 0.0].any()

# %%
around.figure().savefig(folder / "slices.png")
display(Image(folder / "slices.png"))

# %% [markdown]
# `around.q` has a configuration for each position that is reached, `around.save("map.npz")` keeps it all, and
# `osik view map.npz` opens the map in a page with the robot in it.
#
# ## Next
#
# - The page on inverse kinematics in `docs`: every option, obstacles, how it searches, and numbers.
# - `1_quickstart`: from a configuration to motion, step by step.
