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
# # The schemes compared
#
# After this notebook you can
#
# - say which task gives way under each scheme, and by how much,
# - recognise the motion of a task that cannot be met, and calm it,
# - choose a scheme from a table of measured numbers.
#
# One arm, one set of tasks, four situations that a controller meets sooner or later: tasks that conflict, a target out
# of reach, an arm almost straight, a joint at its limit. Nothing was tuned to make a scheme look good.

# %%
import os
import tempfile
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Image, Markdown, display

import osik_jax as osik
from osik_jax.viewer import hero_picture

osik.runtime.configure_cpu()  # small problems, one after another
jax.config.update("jax_enable_x64", True)

FAST = "OSIK_FAST" in os.environ  # the tests run this notebook with smaller sizes
REPEATS = 1 if FAST else 15  # of each run, for the time of a step
SWEEP = 2 if FAST else 13  # points of each curve over a parameter
DT, STEPS = 0.01, 500  # one step [s], and how many: 5 s

plt.rcParams.update({"figure.dpi": 80, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True})
plt.rcParams.update({"grid.color": "#e3e7ec", "axes.axisbelow": True, "axes.titlelocation": "left"})
plt.rcParams.update({"legend.frameon": False})

# %% [markdown]
# ## Schemes, tasks, situations
#
# The arm has three wishes: **hand** at a place (priority 1), **elbow** at a place (priority 2), and the **posture** of
# the start (priority 3). The weighted scheme knows no priorities; there the hand weighs ten times what the elbow does.

# %%
arm = osik.load_robot("arm7")
tasks = {
    "hand": osik.FrameTask(arm, "hand", rows="position", gain=20.0, weight=1.0, priority=1),
    "elbow": osik.FrameTask(arm, "link4", rows="position", gain=20.0, weight=0.1, priority=2),
    "posture": osik.PostureTask(arm, gain=1.0, weight=1e-4, priority=3),
}
home, rotation = tasks["hand"].target

# %% [markdown]
# Each scheme runs twice: *bare*, without the curvature damping that all have by default (`curvature_damping=0.0`), so
# that what the schemes themselves do is seen; and *calmed*, by a constant damping in its place: directions in which the
# hand moves less than about 10 cm a radian are used gently (`damping=0.1**2`). What the default does is in section 2.

# %%
DAMPING = 0.1**2
SCHEMES = {
    "weighted": partial(osik.WeightedQP, curvature_damping=0.0),
    "null space": partial(osik.NullSpace, curvature_damping=0.0),
    "null space, saturated": partial(osik.NullSpace, method="saturated", curvature_damping=0.0),
    "hierarchical": partial(osik.HierarchicalQP, curvature_damping=0.0),
}
COLORS = dict(zip(SCHEMES, ("#d55e00", "#999999", "#009e73", "#0072b2"), strict=True))


def made(name, calm):
    """A scheme, bare or calmed."""
    return SCHEMES[name](damping=DAMPING) if calm else SCHEMES[name]()


# %% [markdown]
# In every situation the hand's target goes somewhere in 1.75 s, waits there for a second, and comes back the same way.
# The velocity of the target is fed forward, so that no scheme lags behind for want of it.


# %%
def there_and_back(goal):
    """Path (STEPS, 3) [m] and velocity (STEPS, 6) of a target: away by a vector [m], and back."""
    t = DT * np.arange(STEPS)
    s = [np.clip((t - start) / 1.75, 0.0, 1.0) for start in (0.25, 3.0)]
    part = [10 * x**3 - 15 * x**4 + 6 * x**5 for x in s]
    rate = [30 * x**2 * (1 - x) ** 2 / 1.75 for x in s]
    path = np.asarray(home) + np.outer(part[0] - part[1], goal)
    return path, np.pad(np.outer(rate[0] - rate[1], goal), ((0, 0), (0, 3)))


def limits(**tighter):
    """The arm's own limits, some joints' tightened to (lower, upper) [rad]."""
    lower, upper = ({joint: bound[i] for joint, bound in tighter.items()} for i in (0, 1))
    return osik.ConfigurationLimit(arm, lower=lower, upper=upper), osik.VelocityLimit(arm)


# where the hand goes [m], the elbow's weight, limits
SITUATIONS = {
    # the elbow shall stay, the hand go farther than the forearm is long; after this the elbow is free
    "conflict": ((0.25, 0.0, 0.0), 0.1, limits()),
    "out of reach": ((0.80, 0.0, 0.0), 0.0, limits()),
    "almost straight": ((0.51, 0.0, 0.0), 0.0, limits()),  # a little inside the reach
    "joint limit": ((0.0, 0.35, 0.0), 0.0, limits(joint1=(-0.3, 0.3))),  # sideways, with the first joint held back
}


# %% [markdown]
# All numbers are traced: one compiled program for each scheme serves all situations, weights and dampings.


# %%
@jax.jit
def run(scheme, tasks, limits, path, speed):
    def now(t):
        k = jnp.round(t / DT).astype(int)
        return {**tasks, "hand": tasks["hand"].replace(target=(path[k], rotation), target_velocity=speed[k])}

    return osik.rollout(arm, arm.q0, now, scheme=scheme, limits=limits, dt=DT, steps=STEPS)


def arguments(situation, name, calm):
    goal, elbow, box = SITUATIONS[situation]
    return made(name, calm), {**tasks, "elbow": tasks["elbow"].replace(weight=elbow)}, box, *there_and_back(goal)


def measured(motion, box):
    """What came of a motion, in numbers."""
    q, v = np.asarray(motion.q), np.asarray(motion.solution.velocity)
    acceleration = np.diff(v, axis=0) / DT
    return {
        "q": q,
        "v": v,
        "hand": 1e3 * np.linalg.norm(motion.solution.error["hand"], axis=1),  # [mm]
        "elbow": 1e3 * np.linalg.norm(motion.solution.error["elbow"], axis=1),
        "peak acceleration": np.abs(acceleration).max(),  # [rad/s^2]
        "rms acceleration": np.sqrt((acceleration**2).mean()),
        "beyond limit": max(np.max(q - box[0].upper), np.max(box[0].lower - q), 0.0),  # [rad]
        "speed": np.max(np.abs(v) / arm.velocity_limit),  # 1 is the limit
        "solved": np.mean(np.asarray(motion.solution.status) == osik.Status.SOLVED),
    }


results = {}
for name in SCHEMES:
    for situation in SITUATIONS:
        for calm in (False, True):
            given = arguments(situation, name, calm)
            results[situation, name, calm] = measured(jax.block_until_ready(run(*given)), given[2])
unsolved = {key: result["solved"] for key, result in results.items() if result["solved"] < 1.0}
assert all(key[:2] == ("out of reach", "null space, saturated") for key in unsolved)  # else every step is solved
assert min(unsolved.values(), default=1.0) > 0.95  # there some steps hold still: joints at limits depend on each other

# %% [markdown]
# The farthest point of each situation, with the calmed weighted scheme. The line is the path of the hand; crosses mark
# where the hand and the elbow should be.

# %%
WAITING = 275  # the step in the middle of the wait
paths = [results[situation, "weighted", True]["q"] for situation in SITUATIONS]
targets = [
    [np.asarray(home) + goal, *([tasks["elbow"].target[0]] if elbow else [])] for goal, elbow, _ in SITUATIONS.values()
]
hand_at = jax.vmap(lambda q: osik.forward_kinematics(arm, q).frame_pose(arm, "hand")[0])
trails = [np.asarray(hand_at(q[:WAITING:10])) for q in paths]
with tempfile.TemporaryDirectory() as folder:
    picture = hero_picture(
        Path(folder) / "arms.png",
        arm,
        [q[WAITING] for q in paths],
        labels=list(SITUATIONS),
        targets=targets,
        trails=trails,
        size=(1100, 420),
        azimuth=-62.0,
        elevation=18.0,
    )
    display(Image(picture.read_bytes()))

# %% [markdown]
# ## 1. Tasks that conflict
#
# The hand goes 25 cm forward, the elbow is told to stay. Both cannot be had. While the target waits, who is how far
# off?


# %%
def at_wait(situation, name, calm, key):
    """Mean of a curve over the last half second of the wait."""
    return results[situation, name, calm][key][225:300].mean()


def dumbbell(axes, situation, value, label, scale="log"):
    """A number of each scheme: bare (open) and calmed (filled)."""
    for row, name in enumerate(SCHEMES):
        pair = [value(situation, name, calm) for calm in (False, True)]
        axes.plot(pair, [row, row], color=COLORS[name], lw=2)
        axes.plot(pair[0], row, "o", ms=9, mfc="white", mec=COLORS[name], mew=2)
        axes.plot(pair[1], row, "o", ms=9, color=COLORS[name])
    axes.set_yticks(range(len(SCHEMES)), SCHEMES)
    axes.invert_yaxis()
    axes.set(xscale=scale, xlabel=label)


def number(key):
    return lambda situation, name, calm: max(results[situation, name, calm][key], 1e-12)


fig, (who, how) = plt.subplots(1, 2, figsize=(11, 3.4), sharey=True)
rows = np.arange(len(SCHEMES))
for shift, key, color in ((-0.2, "hand", "#e69f00"), (0.2, "elbow", "#009e73")):
    who.barh(rows + shift, [at_wait("conflict", name, True, key) for name in SCHEMES], 0.36, color=color, label=key)
who.set(xlabel="off by, while the target waits [mm]", title="Who gives way (calmed)")
who.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
dumbbell(how, "conflict", number("rms acceleration"), "RMS joint acceleration [rad/s²]")
how.set_title("How smoothly (open: bare; filled: calmed)")
fig.tight_layout()
plt.show()

for name in SCHEMES:
    pairs = [[at_wait("conflict", name, calm, key) for key in ("hand", "elbow")] for calm in (False, True)]
    print(f"{name:>22}: hand {pairs[0][0]:6.2f} mm, elbow {pairs[0][1]:6.1f} mm bare;", end=" ")
    print(f"hand {pairs[1][0]:5.2f} mm, elbow {pairs[1][1]:5.1f} mm calmed")

strict = [at_wait("conflict", name, True, "hand") for name in ("null space", "null space, saturated", "hierarchical")]
assert max(strict) < 0.1 < at_wait("conflict", "weighted", True, "hand")  # [mm]
for name in SCHEMES:
    pair = [results["conflict", name, calm]["rms acceleration"] for calm in (False, True)]
    assert pair[1] < pair[0] / 10.0, name

# %% [markdown]
# **Who gives way.** With strict priorities the hand loses nothing. The weighted scheme shares, and the hand pays too.
#
# **How smoothly.** Bare, all schemes use every direction that has any effect, however little. Where a task
# cannot be met, that is a direction in which the joints race and the task gains nothing: the joints jump from one speed
# limit to the other at every step, and without limits (null space) they race off. The accuracy of the answer is not the
# problem: each of these steps is solved. Damping ends it, at once and in all schemes.

# %%
fig, grid = plt.subplots(1, 2, figsize=(11, 3.0), sharey=True)
clock = DT * np.arange(STEPS)
j = (
    np.abs(results["conflict", "hierarchical", False]["v"] / arm.velocity_limit).max(axis=0).argmax()
)  # the wildest joint
for axes, calm in zip(grid, (False, True), strict=True):
    for name in ("hierarchical", "weighted"):
        axes.plot(clock, results["conflict", name, calm]["v"][:, j], color=COLORS[name], lw=1, label=name)
    for side in (-1.0, 1.0):
        axes.axhline(side * arm.velocity_limit[j], color="black", ls="--", lw=1)
    axes.set(xlabel="time [s]", title="calmed" if calm else "bare: from limit to limit")
grid[0].set_ylabel(f"velocity of joint {j + 1} [rad/s]")
grid[1].legend(loc="upper right")
fig.tight_layout()
plt.show()

# %% [markdown]
# How much the weighted scheme shares is for you to choose. With a hand that weighs more and more it comes to what a
# strict priority gives:

# %%
ratios = np.logspace(-1, 4, SWEEP)
scheme, wished, box, path, speed = arguments("conflict", "weighted", True)
shares = []
for ratio in ratios:
    motion = run(scheme, {**wished, "hand": wished["hand"].replace(weight=0.1 * ratio)}, box, path, speed)
    got = measured(motion, box)
    shares.append([got[key][225:300].mean() for key in ("hand", "elbow")])
shares = np.array(shares)

fig, axes = plt.subplots(figsize=(8.4, 3.2))
axes.plot(ratios, shares[:, 0], color="#e69f00", label="hand, weighted")
axes.plot(ratios, shares[:, 1], color="#009e73", label="elbow, weighted")
for key, color in (("hand", "#e69f00"), ("elbow", "#009e73")):
    axes.axhline(at_wait("conflict", "hierarchical", True, key), color=color, ls=":", label=f"{key}, hierarchical")
axes.set(xscale="log", xlabel="weight of the hand / weight of the elbow", ylabel="off by [mm]")
axes.set_title("A weight is a price, a priority is a rule")
axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
plt.show()
assert (
    shares[-1, 0] < 0.1 * shares[0, 0] and abs(shares[-1, 1] - at_wait("conflict", "hierarchical", True, "elbow")) < 5.0
)

# %% [markdown]
# ## 2. A target out of reach
#
# The target goes where no pose of the arm can bring the hand, waits, and comes back. The best that can be had is the
# arm stretched towards it.

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(12, 3.4))
for name in SCHEMES:
    left.plot(clock, results["out of reach", name, True]["hand"], color=COLORS[name], label=name)
left.set(xlabel="time [s]", ylabel="hand to target [mm]", title="Calmed: all stretch; not all come back")
left.legend(loc="upper left", fontsize=8)
dumbbell(right, "out of reach", number("rms acceleration"), "RMS joint acceleration [rad/s²]")
right.set_title("Damping calms all of them (open: bare; filled: calmed)")
fig.tight_layout()
plt.show()

for name in SCHEMES:
    for calm in (False, True):
        result, waiting = results["out of reach", name, calm], at_wait("out of reach", name, calm, "hand")
        print(
            f"{name:>22}, {'calmed' if calm else 'bare':>6}: hand off by {waiting:5.1f} mm while waiting,",
            end=" ",
        )
        print(f"{result['hand'][-1]:5.1f} mm at the end; joints {result['beyond limit']:.2f} rad beyond their limits")

calm_miss = [at_wait("out of reach", name, True, "hand") for name in SCHEMES]
assert max(calm_miss) < 1.02 * min(calm_miss)  # calmed, all are equally near

# %% [markdown]
# Calmed, all reach the same distance. A constant damping has to be chosen, and it damps everywhere. By default there is
# one that chooses itself: a step bends the path of the hand, the linear model leaves that out, and each task damps the
# velocity by as much as that can amount to. It grows with the error and is gone where the task is met. The same motions
# with it, and nothing else:

# %%
for name in SCHEMES:
    words = []
    for situation in ("out of reach", "almost straight"):
        _, wished, box, path, speed = arguments(situation, name, False)
        got = measured(run(SCHEMES[name](curvature_damping=1.0), wished, box, path, speed), box)
        bare, calmed = (results[situation, name, calm] for calm in (False, True))
        words.append([f"{each['rms acceleration']:6.1f}" for each in (bare, calmed, got)])
        words.append([f"{each['hand'].max():5.2f}" for each in (bare, calmed, got)])
    print(f"{name:>22}: out of reach {' -> '.join(words[0])} rad/s²; almost straight {' -> '.join(words[3])} mm off")

# %% [markdown]
# From bare by calmed to the default. Two things to know:
#
# - Targets within reach are better than any damping.
# - A stretched arm may bend back either way. Where it bends the wrong way, a scheme that keeps limits ends with a joint
#   at its limit and the hand away from its target (above: those that do not return to zero), a local minimum; one that
#   does not keep them bends the joint in a way that the real arm cannot. Which way it goes is chance: rounding decides.

# %% [markdown]
# ## 3. An arm almost straight
#
# Now the target stops just inside the reach. Near the straight arm a small motion of the hand needs a large one of the
# joints.

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(12, 3.4))
for name in SCHEMES:
    line = np.maximum(results["almost straight", name, True]["hand"], 1e-4)
    left.semilogy(clock, line, color=COLORS[name], label=f"{name}, calmed")
left.semilogy(clock, results["almost straight", "hierarchical", False]["hand"], "k:", label="hierarchical, bare")
left.set(xlabel="time [s]", ylabel="hand to target [mm]", title="Damping costs accuracy near the straight arm")
left.legend(loc="upper center", fontsize=7.5, ncols=2)
left.set_ylim(1e-2, 3e3)
dumbbell(right, "almost straight", number("speed"), "highest joint speed / its limit", scale="linear")
right.axvline(1.0, color="black", ls="--", lw=1)
right.set_title("Who falls behind has to hurry (filled: calmed)")
fig.tight_layout()
plt.show()

for name in SCHEMES:
    pair = [results["almost straight", name, calm]["hand"].max() for calm in (False, True)]
    print(f"{name:>22}: hand off by at most {pair[0]:5.2f} mm bare, {pair[1]:5.2f} mm calmed")
for name in SCHEMES:
    assert results["almost straight", name, False]["hand"].max() < 1.0  # [mm]
    assert results["almost straight", name, False]["speed"] < 1.0

# %% [markdown]
# As long as the target can be reached, even barely, all schemes track it bare, and no joint reaches its speed
# limit. Here it is not the singularity that makes joints race, it is asking for what cannot be had. Damping has its
# price here: it slows down exactly the directions that are needed, the hand falls behind, and catching up is faster
# than keeping up. That is why the damping that is on by default leaves alone what can be met (section 2).
#
# How much damping, then? Too little leaves the conflict rough, too much loses the target:

# %%
dampings = np.logspace(-8, 0, SWEEP)
rough, loss = {}, {}
for name in SCHEMES:
    for situation, store, key in (("conflict", rough, "rms acceleration"), ("almost straight", loss, "hand")):
        _, wished, box, path, speed = arguments(situation, name, True)
        each = [measured(run(SCHEMES[name](damping=d), wished, box, path, speed), box)[key] for d in dampings]
        store[name] = [np.max(value) for value in each]

fig, (left, right) = plt.subplots(1, 2, figsize=(11, 3.2))
for name in SCHEMES:
    left.loglog(dampings, rough[name], color=COLORS[name], label=name)
    right.loglog(dampings, loss[name], color=COLORS[name])
for axes in (left, right):
    axes.axvline(DAMPING, color="black", ls="--", lw=1)
    axes.set_xlabel("damping (dashed: what this notebook calls calmed)")
left.set(ylabel="RMS acceleration [rad/s²]", title="Conflict: more damping, less violence")
right.set(ylabel="hand off by at most [mm]", title="Almost straight: more damping, less accuracy")
left.legend()
fig.tight_layout()
plt.show()

# %% [markdown]
# ## 4. A joint at its limit
#
# The hand goes 35 cm sideways, while the first joint, which would do most of it, may turn 0.3 rad only. The other
# joints can take over.

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(12, 3.4))
for width, name in zip((8, 6, 4, 2), SCHEMES, strict=True):
    left.plot(clock, results["joint limit", name, False]["q"][:-1, 0], color=COLORS[name], lw=width, label=name)
left.axhspan(0.3, 0.35, color="#d55e00", alpha=0.12, lw=0)
left.axhline(0.3, color="black", ls="--", lw=1)
left.set(xlabel="time [s]", ylabel="joint 1 [rad]", title="Bare: who stays inside", ylim=(0.2, 0.33))
left.legend(loc="lower center", fontsize=8)
dumbbell(right, "joint limit", number("peak acceleration"), "peak joint acceleration [rad/s²]", scale="linear")
right.set_title("Stopping at a limit is a jolt (open: bare)")
fig.tight_layout()
plt.show()

for name in SCHEMES:
    pair = [results["joint limit", name, calm] for calm in (False, True)]
    miss = [result["hand"].max() for result in pair]
    print(f"{name:>22}: bare {1e3 * pair[0]['beyond limit']:4.1f} mrad beyond the limit,", end=" ")
    print(f"calmed {1e3 * pair[1]['beyond limit']:4.1f}; hand off by {miss[0]:.2f} and {miss[1]:.2f} mm")
for name in ("weighted", "null space, saturated", "hierarchical"):
    assert max(results[s, name, c]["beyond limit"] for s in SITUATIONS for c in (False, True)) < 1e-9
    assert max(results[s, name, c]["speed"] for s in SITUATIONS for c in (False, True)) < 1.0 + 1e-9
assert results["joint limit", "null space", False]["beyond limit"] > 1e-3

# %% [markdown]
# Three schemes keep all limits, of position and speed, in all four situations, to the last digit. The plain null
# space is led away from limits by a potential, and leaves them when the tasks want it. For that it stops no joint dead.

# %% [markdown]
# ## How fast
#
# Time of one step inside the compiled loop: the median of repeated runs, after those above that compiled, on the
# machine that made this notebook. The schemes take turns, so that whatever else the machine does meets all of them; a
# busy one makes all slower. All are for one robot alone; for batches see `3_many_at_once`.

# %%
took = {(situation, name): [] for situation in SITUATIONS for name in SCHEMES}
for _ in range(REPEATS):
    for (situation, name), times in took.items():
        given = arguments(situation, name, False)
        start = time.perf_counter()
        jax.block_until_ready(run(*given))
        times.append((time.perf_counter() - start) / STEPS)
print(f"{os.cpu_count()} cores, JAX {jax.__version__}, {os.getloadavg()[0]:.1f} processes running on average")

step_times = {name: [1e6 * np.median(took[situation, name]) for situation in SITUATIONS] for name in SCHEMES}  # [us]

fig, axes = plt.subplots(figsize=(7.5, 3.0))
for row, (name, values) in enumerate(step_times.items()):
    axes.barh(row, np.median(values), color=COLORS[name], height=0.5)
    axes.plot(values, [row] * len(values), "|", color="black", ms=14)
axes.set_yticks(range(len(SCHEMES)), SCHEMES)
axes.invert_yaxis()
axes.set(
    xlabel="time of a step [µs] (bars: median; marks: each situation)",
    title="One robot with 7 joints, 13 rows of tasks, on a CPU",
)
fig.tight_layout()
plt.show()

# %% [markdown]
# ## When to use which
#
# Computed from the runs above.


# %%
def worst(name, key, calm=None):
    """The largest of a number over all situations."""
    return max(results[s, name, c][key] for s in SITUATIONS for c in ((False, True) if calm is None else (calm,)))


def take_it_when(name):
    """What the numbers of a scheme say it is good for."""
    strict = at_wait("conflict", name, True, "hand") < 0.1  # [mm]
    inside = worst(name, "beyond limit") < 1e-9 and worst(name, "speed") < 1.0 + 1e-9
    calm = results["out of reach", name, True]["rms acceleration"] < 20.0  # [rad/s^2]
    reasons = ["the first task must not give way" if strict else "a compromise is fine"]
    reasons += ["limits must hold" if inside else "limits are looked after elsewhere"]
    reasons += ["targets may be out of reach"] if calm else []
    reasons += ["microseconds count"] if name == min(step_times, key=lambda other: np.median(step_times[other])) else []
    return ", ".join(reasons)


table = [
    "| | conflict: hand off [mm] | conflict: elbow off [mm] | conflict: acceleration [rad/s²]"
    " | out of reach: acceleration [rad/s²] | almost straight: hand off [mm] | beyond a joint limit [rad]"
    " | speed / limit | a step [µs] | take it when |",
    "|" + "---|" * 10,
]
for name in SCHEMES:
    off = {key: [at_wait("conflict", name, calm, key) for calm in (False, True)] for key in ("hand", "elbow")}
    rough_pair, far_pair = (
        [results[situation, name, calm]["rms acceleration"] for calm in (False, True)]
        for situation in ("conflict", "out of reach")
    )
    straight = [results["almost straight", name, calm]["hand"].max() for calm in (False, True)]
    table.append(
        f"| **{name}** | {off['hand'][0]:.1f} → {off['hand'][1]:.1f} | {off['elbow'][0]:.0f} → {off['elbow'][1]:.0f}"
        f" | {rough_pair[0]:.0f} → {rough_pair[1]:.1f} | {far_pair[0]:.0f} → {far_pair[1]:.0f}"
        f" | {straight[0]:.1f} → {straight[1]:.1f} | {worst(name, 'beyond limit', True):.2g}"
        f" | {worst(name, 'speed', True):.2g} | {np.median(step_times[name]):.0f} | {take_it_when(name)} |"
    )
display(Markdown("\n".join(table)))

# %% [markdown]
# Single numbers are those of the calmed runs, the worst of all situations for the limits; arrows lead from bare to
# calmed. Accelerations are RMS values over all joints and the whole motion.
#
# Whichever you take: leave the curvature damping on, add a constant one where tasks conflict all the time, and keep
# targets within reach.
