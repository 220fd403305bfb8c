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
# # Tuning by gradient
#
# After this notebook you can
#
# - turn "a good motion" into a number, and lower it over weights and gains by the gradient through the closed loop;
# - see the landscape that the optimiser walks in, and what a search without gradients makes of it;
# - tune under hierarchies and null spaces too, where weights mean something else;
# - carry what was tuned over to a physics simulation, and say which bounds make that work.
#
# It needs the extras `tuning` (optax) and `bench` (cma).

# %%
import os
import tempfile
from pathlib import Path

import cma
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from IPython.display import Image, display
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax import physics, tuning
from osik_jax.viewer import hero_picture

osik.runtime.configure_cpu()  # small problems, one after another
jax.config.update("jax_enable_x64", True)  # double precision: controllers want it
jax.config.update("jax_disable_most_optimizations", True)  # compiled in half the time; not for long runs

FAST = "OSIK_FAST" in os.environ  # the tests run this notebook with smaller sizes
ITERATIONS = 40  # gradients; the fast mode takes them from the file below
PRICE = 0.3 if FAST else 3.0  # rollouts of CMA-ES, as multiples of the gradient's
GRID = 3 if FAST else 12  # of the landscape, along each side
SECONDS = 2.0 if FAST else 8.0  # in physics
SIZE = (200, 105) if FAST else (800, 420)  # of the picture
SCHEMES = {} if FAST else {"null space": osik.NullSpace(damping=1e-2), "hierarchical": osik.HierarchicalQP()}

plt.rcParams |= {"figure.dpi": 80, "axes.grid": True, "grid.color": "#e3e7ec", "axes.axisbelow": True}
plt.rcParams |= {"axes.spines.top": False, "axes.spines.right": False, "axes.titlelocation": "left", "font.size": 9.5}
BLUE, ORANGE, GREEN, RED, GREY = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#8a8f98"  # safe for colour-blind readers
data = next(folder for folder in (Path("data"), Path("notebooks/data")) if folder.exists())
STATE = data / "tuned_nao.npz"  # what the tuning below went through

# %% [markdown]
# ## The problem: NAO reaches with both hands
#
# Seven tasks compete for 31 degrees of freedom: two feet, the centre of mass, an upright torso, two hands, the posture.
# Under `WeightedQP` they share by weight. All weights begin at 1: the posture pulls as hard as
# the hands, and the feet give way.

# %%
robot = osik.load_robot("nao")
feet, hands = {"left_foot": "l_sole", "right_foot": "r_sole"}, {"left_hand": "l_gripper", "right_hand": "r_gripper"}
soles = tuple(feet.values())
tasks = {name: osik.FrameTask(robot, sole, orientation_weight=1.0) for name, sole in feet.items()}
tasks["com"] = osik.ComTask(robot, polygon=osik.support_polygon(robot, robot.q0, soles, margin=0.02))
tasks["torso"] = osik.FrameTask(robot, "torso", rows="orientation", orientation_weight=1.0)
tasks |= {name: osik.FrameTask(robot, hand, rows="position") for name, hand in hands.items()}
tasks["posture"] = osik.PostureTask(robot, weight=1.0)
limits = (osik.ConfigurationLimit(robot), osik.VelocityLimit(robot))
DT, STEPS = 0.025, 60
loop = tuning.Loop(robot, tasks, scheme=osik.WeightedQP(damping=1e-6), limits=limits, dt=DT, steps=STEPS)

# %% [markdown]
# **Situations.** Points that the arms can reach: where the hands are at random angles of the arms. Eight to train on,
# eight held out, which the optimiser never sees.

# %%
random = np.random.default_rng(0)
arms = [name for name in robot.joint_names if "Shoulder" in name or "Elbow" in name]
dofs = [robot.joint_dof_index(name) for name in arms]
low, high = np.asarray(robot.position_lower)[dofs], np.asarray(robot.position_upper)[dofs]
angles = np.tile(robot.q0, (16, 1))
at = [robot.joint_qpos_index(name) for name in arms]
share = 0.25 * random.uniform(-1.0, 1.0, (16, len(arms)))  # of each range, off home
angles[:, at] = np.clip(angles[:, at] + share * (high - low), low, high)
hands_at = jax.jit(jax.vmap(lambda q: osik.forward_kinematics(robot, q).frame_poses(robot, tuple(hands.values()))[0]))
points = np.asarray(hands_at(angles))  # (situations, hands, 3)
situations = tuning.Scenarios(values={f"{name}.target[0]": points[:, i] for i, name in enumerate(hands)})
training, held_out = situations[:8], situations[8:]

# %% [markdown]
# **The loss.** Hands on their points in the second half of 1.5 s, feet where they were, the centre of mass inside, and
# no jerks. Each part is a number that can be read off a trajectory.
#
# **The parameters.** All weights, all gains and the damping: 15 numbers, steps being factors. Gains stay below 5 / s,
# which is what NAO's servos follow; the last section shows why.

# %%
support = osik.support_polygon(robot, robot.q0, soles)
loss = (
    tuning.Tracking(*hands, after=0.5 * STEPS * DT)
    + 10.0 * tuning.Tracking(*feet)
    + tuning.ComMargin(support, margin=0.01)
    + 1e-7 * tuning.Smoothness()
)
parameters = [
    *(tuning.Parameter(f"{name}.weight", lower=1e-4, upper=1e4) for name in tasks),
    *(tuning.Parameter(f"{name}.gain", lower=0.1, upper=5.0, initial=3.0) for name in tasks),
    tuning.Parameter("scheme.damping", lower=1e-10, upper=1.0),
]

# %% [markdown]
# ## From bad to good

# %%
options = dict(loop=loop, held_out=held_out, optimizer=optax.adam(0.2), iterations=ITERATIONS, progress=False)
files = dict(resume=STATE) if FAST else dict(save=STATE)
tuned = tuning.tune(loss, parameters, training, **options, **files)
history, start = tuned.history, tuned.space.apply(loop, tuned.space.initial)
assert len(history) == ITERATIONS and not history.dropped.any()
lower = history.held_out[0] / tuned.held_out
print(f"held-out loss {history.held_out[0]:.1e} -> {tuned.held_out:.1e}: {lower:.0f} times lower")
first, each = history.seconds[0], np.median(history.seconds[1:])
print(f"{first:.0f} s for the first iteration, which compiles; then {each:.2f} s each")
assert len(tuned.space.names) == 15 and lower > 5.0

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(10.5, 3.8), width_ratios=[1, 1.2])
left.semilogy(history.loss, color=BLUE, label="training")
left.semilogy(history.held_out, "--", color=ORANGE, label="held out")
left.set(xlabel="iteration", ylabel="loss", title=f"{lower:.0f} times lower in {ITERATIONS} gradients")
left.legend(frameon=False)
numbers = np.asarray(jax.vmap(tuned.space.numbers)(jnp.asarray(history.vectors)))
weights = [i for i, name in enumerate(tuned.space.names) if name.endswith("weight")]
colors = plt.get_cmap("tab10").colors
for i, color in zip(weights, colors, strict=False):
    right.semilogy(numbers[:, i], color=color, label=tuned.space.names[i].removesuffix(".weight"))
right.set(xlabel="iteration", ylabel="weight", title="The posture lets go, the hands and feet take over")
right.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
fig.tight_layout()
plt.show()
assert tuned.parameters["posture.weight"] < 0.1 * min(tuned.parameters[f"{name}.weight"] for name in hands)

# %% [markdown]
# The same motion before and after: four held-out points for each hand, two seconds each. The targets glide to the next
# point within the first second.

# %%
held_points = points[8:12]
steps = round(SECONDS / DT)
time = DT * np.arange(steps)
which = np.minimum((time / 2.0).astype(int), 3)
glide = np.clip(time - 2.0 * which, 0.0, 1.0)
glide = (glide**3 * (10.0 - 15.0 * glide + 6.0 * glide**2))[:, None]  # from 0 to 1, at rest at both ends
stops = np.concatenate([[[np.asarray(tasks[name].target[0]) for name in hands]], held_points])
places = stops[which] + glide[..., None] * (stops[which + 1] - stops[which])  # (steps, hands, 3)
paths = {name: (places[:, i], np.tile(tasks[name].target[1], (steps, 1, 1))) for i, name in enumerate(hands)}


def planned(own):
    """The kinematic motion of a loop."""
    limited = dict(scheme=own.scheme, limits=own.limits, dt=DT, steps=steps)
    return osik.rollout(robot, robot.q0, own.tasks, targets=paths, **limited)


before, after = planned(start), planned(tuned.loop)
picture = Path(tempfile.mkdtemp()) / "before_and_after.png"
moment = min(steps, round(2.0 / DT)) - 1  # before the targets change
poses = [np.asarray(path.q[moment]) for path in (before, after)]
vertices = [np.asarray(support.vertices)] * 2
display(Image(hero_picture(picture, robot, poses, support=vertices, labels=["before", "after"], size=SIZE)))


# %%
def off(path, names):
    """The greatest distance of some frames to their targets [mm], over time."""
    return 1e3 * np.max([np.linalg.norm(path.solution.error[name][:, :3], axis=1) for name in names], axis=0)


fig, (left, right) = plt.subplots(1, 2, figsize=(10.5, 3.3))
for panel, names, title in ((left, hands, "Hands reach ..."), (right, feet, "... and feet stay")):
    panel.semilogy(time, off(before, names) + 1e-3, color=GREY, label="before")
    panel.semilogy(time, off(after, names) + 1e-3, color=BLUE, label="after")
    panel.set(xlabel="time [s]", ylabel="worst one off its target [mm]", title=title)
    panel.legend(frameon=False)
fig.tight_layout()
plt.show()
ends = np.arange(round(2.0 / DT) - 1, steps, round(2.0 / DT))
print("hands off at the end of each reach [mm], before:", off(before, hands)[ends].round(1))
print("                                          after:", off(after, hands)[ends].round(1))
assert off(after, hands)[ends].max() < 0.25 * off(before, hands)[ends].max()

# %% [markdown]
# ## The landscape
#
# A slice of the training loss: two of the 15 numbers vary, the other 13 stay where the tuning ended. One call of `vmap`
# gives twelve losses, each over all situations. The line is the optimiser's way, seen from above: it moved in the other
# 13 too, so the loss that it saw on the way was another.

# %%
POPULATION = 12


@jax.jit
def losses(vectors):
    """The training loss of several vectors of parameters."""
    return jax.vmap(lambda vector: tuning.evaluate(loss, tuned.space.apply(loop, vector), training).loss)(vectors)


def in_populations(vectors):
    """The same for any number of vectors."""
    short = -len(vectors) % POPULATION
    filled = np.concatenate([vectors, np.tile(vectors[:1], (short, 1))])
    return np.concatenate([losses(part) for part in filled.reshape(-1, POPULATION, filled.shape[1])])[: len(vectors)]


best = np.asarray(history.vectors[tuned.iteration])
ACROSS, UP = "posture.weight", "left_hand.weight"
across, up = tuned.space.names.index(ACROSS), tuned.space.names.index(UP)
way = history.vectors[: tuned.iteration + 1]
margin = 1.5
xs = np.linspace(way[:, across].min() - margin, way[:, across].max() + margin, GRID)
ys = np.linspace(way[:, up].min() - margin, way[:, up].max() + margin, GRID)
mesh = np.stack(np.meshgrid(xs, ys), -1).reshape(-1, 2)
vectors = np.tile(best, (len(mesh), 1))
vectors[:, across], vectors[:, up] = mesh.T
heights = in_populations(vectors).reshape(GRID, GRID)
number = jax.vmap(tuned.space.numbers)
X, Y = np.asarray(number(vectors))[:, [across, up]].T.reshape(2, GRID, GRID)

# %%
fig, axes = plt.subplots(figsize=(6.6, 4.4))
levels = np.linspace(np.log10(heights.min()), np.log10(heights.max()), 15)
filled = axes.contourf(X, Y, np.log10(heights), levels, cmap="cividis")
fig.colorbar(filled, label="training loss, power of ten", format="%.1f")
walked = np.asarray(number(jnp.asarray(way)))
axes.plot(walked[:, across], walked[:, up], "-", color="white", lw=1.5)
axes.plot(*walked[0, [across, up]], "o", color="white", label="defaults")
axes.plot(*walked[-1, [across, up]], "*", color=RED, ms=13, mec="white", label="tuned")
axes.set(xscale="log", yscale="log", xlabel=ACROSS, ylabel=UP, title="A slice of the loss, and the optimiser's way")
axes.legend(labelcolor="white", frameon=False, loc="upper right")
axes.grid(False)
plt.show()
assert heights.min() > 0.5 * tuned.loss  # no point of the slice is much better than what was found

# %% [markdown]
# ## Against a search without gradients
#
# CMA-ES is the usual choice where there are no gradients. Same start, same space, same situations. A rollout is the
# currency: an iteration of the gradient pays 8, one for each situation; and so does each candidate of CMA-ES. A
# gradient costs more time than a plain rollout, so CMA-ES may go on to several times as many.


# %%
def search(seed, evaluations):
    """CMA-ES: the best loss after each evaluation."""
    settings = {"seed": seed, "verbose": -9, "popsize": POPULATION}
    strategy = cma.CMAEvolutionStrategy(np.asarray(tuned.space.initial), 0.5, settings)
    found = []
    while len(found) < evaluations:
        asked = strategy.ask()
        told = np.nan_to_num(losses(np.array(asked)), nan=1e9)
        strategy.tell(asked, told.tolist())
        found.extend(told)
    return np.minimum.accumulate(found[:evaluations])


evaluations = round(PRICE * ITERATIONS)
searched = search(1, evaluations)
gradient = np.minimum.accumulate(history.loss)

fig, axes = plt.subplots(figsize=(6.6, 3.6))
axes.semilogy(8 * np.arange(1, ITERATIONS + 1), gradient, color=BLUE, lw=2, label="gradient (Adam)")
axes.semilogy(8 * np.arange(1, evaluations + 1), searched, color=ORANGE, label="CMA-ES")
axes.axvline(8 * ITERATIONS, color=GREY, ls=":", lw=1.2, label="equal number of rollouts")
axes.set(xlabel="rollouts", ylabel="best training loss", title="15 parameters: the gradient knows where to go")
axes.legend(frameon=False)
plt.show()
shared = min(ITERATIONS, evaluations)
reached, equal = gradient[shared - 1], searched[shared - 1]
print(f"after {8 * shared} rollouts: gradient {reached:.1e}, CMA-ES {equal:.1e}")
print(f"after {8 * evaluations}: CMA-ES {searched[-1]:.1e}; gradient after {8 * ITERATIONS}: {gradient[-1]:.1e}")
assert reached < equal

# %% [markdown]
# One seed is one seed; CMA-ES needs no derivative, and with few parameters or a loss with steps, take it. The longer
# comparison, with three seeds and 32 situations, is `python -m benchmarks.tuning`.
#
# ## Hierarchies and null spaces
#
# `tune` does not care which scheme runs. What can be tuned differs: with strict priorities, weights count inside their
# level only, so a task that is alone on its level has a weight without effect. Gains, adaptive gains and damping are
# what is left. (`NullSpace` is damped here: a weight counts against the damping.) An arm reaches; orientation comes
# second, posture last.

# %%
arm = osik.load_robot("arm7")
ranked = {
    "hand": osik.FrameTask(arm, "hand", rows="position", gain=osik.AdaptiveGain(3.0, 1.0, 1.0), priority=1),
    "wrist": osik.FrameTask(arm, "hand", rows="orientation", gain=1.0, priority=2),
    "posture": osik.PostureTask(arm, gain=1.0, priority=3, weight=1.0),
}
arm_limits = (osik.ConfigurationLimit(arm), osik.VelocityLimit(arm))
shifts = 0.06 * np.random.default_rng(1).normal(size=(16, 3))
aims = tuning.Scenarios(values={"hand.target[0]": np.asarray(ranked["hand"].target[0]) + shifts})
wanted = tuning.Tracking("hand", "wrist", after=0.5) + 1e-6 * tuning.Smoothness()
chosen = [tuning.Parameter("*.gain", lower=0.1, upper=10.0), "hand.weight"]

fig, axes = plt.subplots(figsize=(6.6, 3.4))
for (name, scheme), color in zip(SCHEMES.items(), (ORANGE, GREEN), strict=False):
    strict = tuning.Loop(arm, ranked, scheme=scheme, limits=arm_limits, dt=0.05, steps=30)
    how = dict(loop=strict, held_out=aims[8:], iterations=15, progress=False)
    result = tuning.tune(wanted, chosen, aims[:8], **how)
    axes.semilogy(result.history.loss, color=color, label=f"{name}, training")
    axes.semilogy(result.history.held_out, "--", color=color, label=f"{name}, held out")
    print(f"{name}: held-out loss {result.history.held_out[0]:.1e} -> {result.held_out:.1e}")
    print(f"    weight of the hand, alone on its level: {result.parameters['hand.weight']:.3f}")
    assert result.held_out < 0.7 * result.history.held_out[0]
if SCHEMES:
    assert abs(result.parameters["hand.weight"] - 1.0) < 1e-3  # the hierarchy's: it never moved
    axes.legend(frameon=False)
axes.set(xlabel="iteration", ylabel="loss", title="Strict priorities: gains are what is tuned")
plt.show()

# %% [markdown]
# ## Transfer to physics
#
# Now with contact, motors and gravity: NAO stands on a floor in MuJoCo, each joint has a position servo, and the tasks
# see the sensed robot 200 times a second. Nothing is tuned again. The third run has the same weights, and
# gains that only the kinematic loop can take.

# %%
legs = dict.fromkeys(("*Hip*", "*Knee*", "*Ankle*"), physics.Servo(stiffness=150.0, damping=5.0))
world = physics.build_world(robot, servos=legs)
FINER = 5  # steps of 5 ms in one of the plan
fine_paths = jax.tree.map(lambda path: np.repeat(path, FINER, axis=0), paths)


def in_physics(own):
    """The loop in MuJoCo, until it ends or falls."""
    settings = dict(scheme=own.scheme, limits=own.limits, dt=DT / FINER, steps=FINER * steps, targets=fine_paths)
    return physics.simulate(physics.Simulation(world), own.tasks, **settings)


def judged(recording, plan):
    """Height [mm] and tilt [deg] of the base off the plan, and how far the soles slipped [mm], over time."""
    q = recording.q[::FINER]
    reference = np.asarray(plan.q)[: len(q)]
    turns = [Rotation.from_quat(part[:, [4, 5, 6, 3]]) for part in (q, reference)]
    slip = np.linalg.norm((recording.contact_points - recording.contact_points[0])[..., :2], axis=-1).max(1)
    tilt = np.degrees((turns[0] * turns[1].inv()).magnitude())
    return 1e3 * np.abs(q[:, 2] - reference[:, 2]), tilt, 1e3 * slip[::FINER]


hasty = tuned.loop.replace({f"{name}.gain": 40.0 for name in tasks})
runs = {"before": (start, before, GREY), "tuned": (tuned.loop, after, BLUE)}
runs |= {"gains of 40 / s": (hasty, planned(hasty), RED)}
recordings = {name: in_physics(own) for name, (own, _, _) in runs.items()}
judgements = {name: judged(recordings[name], plan) for name, (_, plan, _) in runs.items()}

# %%
fig, axes = plt.subplots(1, 4, figsize=(12, 3.2))
for name, (_, _, color) in runs.items():
    recording = recordings[name]
    misses = [np.linalg.norm(recording.solution.error[hand][:, :3], axis=1) for hand in hands]
    axes[0].plot(recording.time[1:], 1e3 * np.max(misses, axis=0), color=color, label=name)
    for panel, values in zip(axes[1:], judgements[name], strict=True):
        panel.semilogy(DT * np.arange(len(values)), values + 1e-3, color=color)
axes[0].set(title="Hands off their targets", ylabel="[mm]", ylim=(0, 250))
for panel, title, unit, limit in zip(
    axes[1:], ("Base off its height", "Base tilted", "Feet slipped"), ("mm", "deg", "mm"), (10.0, 3.0, 5.0), strict=True
):
    panel.axhline(limit, color="black", ls="--", lw=1.0)
    panel.set(title=title, ylabel=f"[{unit}]; dashed: limit")
for panel in axes:
    panel.set(xlabel="time [s]")
fig.legend(*axes[0].get_legend_handles_labels(), frameon=False, loc="upper center", ncols=3)
fig.tight_layout(rect=(0.0, 0.0, 1.0, 0.93))
plt.show()

# %%
for name, recording in recordings.items():
    height, tilt, slip = (values.max() for values in judgements[name])
    ended = f"fell at {recording.time[-1]:.1f} s" if recording.fell else "stands"
    print(f"{name:>15}: {ended}; base off by {height:.1f} mm and {tilt:.2f} deg, slip {slip:.2f} mm")
height, tilt, slip = (values.max() for values in judgements["tuned"])
assert not recordings["tuned"].fell and height < 10.0 and tilt < 3.0 and slip < 5.0
height, tilt, slip = (values.max() for values in judgements["gains of 40 / s"])
assert recordings["gains of 40 / s"].fell or height > 10.0 or tilt > 3.0 or slip > 5.0

# %% [markdown]
# The kinematic loop cannot know what servos and floor will bear, so say it in the bounds: `Parameter("*.gain",
# upper=5.0)`. What is tuned inside them carries over as it is.
#
# ## Next
#
# - The page on tuning in `docs`: names, scenarios, losses, memory, saving and resuming.
# - The page on physics: how a velocity becomes a servo target, and which gains it takes.
