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
# # Many at once
#
# After this notebook you can
#
# - run a thousand robots in one call, and say what that does to speed and memory on your machine;
# - sweep weights, targets and the robot's own link lengths with `jax.vmap`, alone or nested;
# - keep memory bounded where a batch is too large;
# - say what a GPU adds, scheme by scheme, from a recorded run.

# %%
import json
import os
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import osik_jax as osik

osik.runtime.configure_cpu()  # small problems, one after another
jax.config.update("jax_enable_x64", True)  # double precision: controllers want it

FAST = "OSIK_FAST" in os.environ  # the tests run this notebook with smaller sizes
BATCHES = (1, 16) if FAST else (1, 64, 1024)
CALLS = 3 if FAST else 15  # that are timed
WEIGHTS = 16 if FAST else 200
GRID, LENGTHS = (4, 3) if FAST else (17, 9)  # targets along each side, robots
STEPS = 20 if FAST else 75  # steps of a rollout

plt.rcParams |= {"figure.dpi": 80, "axes.grid": True, "grid.color": "#e3e7ec", "axes.axisbelow": True}
plt.rcParams |= {"axes.spines.top": False, "axes.spines.right": False, "axes.titlelocation": "left", "font.size": 9.5}
BLUE, ORANGE, GREEN, RED, GREY = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#8a8f98"  # safe for colour-blind readers

# %% [markdown]
# ## One step, a batch of robots
#
# `solve` is a pure function of arrays, so a batch is one `jax.vmap`: name what differs (here the configuration q, the
# hand's target and the warm start, which tells the solver where to begin), and the rest is shared. `batch_axes` and
# `batched` go by name.

# %%
robot = osik.load_robot("arm7" if FAST else "nao")
feet, hand = ((), "hand") if FAST else (("l_sole", "r_sole"), "l_gripper")
tasks = {foot: osik.FrameTask(robot, foot, weight=100.0, orientation_weight=1.0) for foot in feet}
tasks |= {"com": osik.ComTask(robot, weight=10.0)} if feet else {}
tasks["hand"] = osik.FrameTask(robot, hand, rows="position")
tasks["posture"] = osik.PostureTask(robot, gain=1.0, weight=1e-3)
limits = (osik.ConfigurationLimit(robot), osik.VelocityLimit(robot))
DT = 0.005  # one step [s]


def step(tasks, state):
    """One step of the closed loop: solve, then move."""
    q, warm_start = state
    solution = osik.solve(robot, q, tasks, scheme=osik.WeightedQP(), limits=limits, dt=DT, warm_start=warm_start)
    moved = osik.integrate(robot, q, solution.velocity, DT)
    return (moved, solution.warm_start), solution.status == osik.Status.SOLVED


def first_state(batch):
    """All robots at home; a warm start of zeros is none."""
    shape = jax.eval_shape(lambda q: step(tasks, (q, None))[0][1], robot.q0)
    return jnp.tile(robot.q0, (batch, 1)), jnp.zeros((batch, *shape.shape), shape.dtype)


def measure(batch):
    """Milliseconds a call, bytes that the program holds, and the share of steps solved."""
    places = tasks["hand"].target[0] + 0.1 * jax.random.uniform(jax.random.key(0), (batch, 3), minval=-1.0)
    many, state = osik.batched(tasks, {"hand.target[0]": places}), first_state(batch)
    axes = osik.batch_axes(tasks, "hand.target[0]")
    program = jax.jit(jax.vmap(step, in_axes=(axes, 0))).lower(many, state).compile()
    seconds, solved = [], []
    for _ in range(CALLS + 2):  # the first two warm up
        start = time.perf_counter()
        state, fine = jax.block_until_ready(program(many, state))
        seconds.append(time.perf_counter() - start)
        solved.append(fine.mean())
    memory = program.memory_analysis()
    held = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes
    return 1e3 * np.median(seconds[2:]), held, float(np.mean(solved))


# %%
here = {batch: measure(batch) for batch in BATCHES}
for batch, (milliseconds, held, solved) in here.items():
    speed = 1e3 * batch / milliseconds
    print(f"{batch:5} robots: {milliseconds:8.2f} ms a step, {speed:9,.0f} steps/s, {held / 2**20:7.2f} MiB")
    assert solved == 1.0
speeds = {batch: 1e3 * batch / milliseconds for batch, (milliseconds, _, _) in here.items()}
gain = speeds[BATCHES[-1]] / speeds[1]
print(f"{os.cpu_count()} cores; a batch of {BATCHES[-1]} makes {gain:.0f} times the steps of one")
assert gain > 1.0

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2))
left.loglog(list(speeds), list(speeds.values()), "o-", color=BLUE, label=f"measured here, {os.cpu_count()} cores")
left.loglog(BATCHES, 200.0 * np.array(BATCHES), ":", color="black", label="real time: 200 steps/s for each robot")
left.set(xlabel="robots in a batch", ylabel="steps a second", title="A batch is faster than its parts")
left.legend(frameon=False)
right.loglog(list(here), [held / 2**20 for _, held, _ in here.values()], "o-", color=ORANGE)
right.set(xlabel="robots in a batch", ylabel="memory of the program [MiB]", title="... and memory grows with it")
fig.tight_layout()
plt.show()

# %% [markdown]
# ## Weights: a trade-off in one call
#
# An arm should reach for a point, and would rather keep its posture. Which weight is right? Ask all of them. Each lane
# is a whole rollout under another weight of the posture.

# %%
arm = osik.load_robot("arm7")
arm_limits = (osik.ConfigurationLimit(arm), osik.VelocityLimit(arm))
wishes = {"hand": osik.FrameTask(arm, "hand", rows="position"), "posture": osik.PostureTask(arm, weight=1.0)}
home, rotation = wishes["hand"].target
wishes["hand"] = wishes["hand"].replace(target=(home + jnp.array([-0.2, 0.25, -0.2]), rotation))


def run(robot, tasks):
    """Where the hand ends off its target [m], and the joints off their posture [rad]."""
    path = osik.rollout(robot, robot.q0, tasks, scheme=osik.WeightedQP(), limits=arm_limits, dt=0.04, steps=STEPS)
    error = path.solution.error
    return jnp.linalg.norm(error["hand"][-1]), jnp.linalg.norm(error["posture"][-1])


weights = jnp.logspace(-4.0, 3.0, WEIGHTS)
sweep = jax.jit(jax.vmap(run, in_axes=(None, osik.batch_axes(wishes, "posture.weight"))))
miss, bend = (np.asarray(x) for x in sweep(arm, osik.batched(wishes, {"posture.weight": weights})))

fig, axes = plt.subplots(figsize=(6.4, 3.6))
axes.plot(1e3 * miss, np.degrees(bend), color=GREY, lw=1.0)
dots = axes.scatter(1e3 * miss, np.degrees(bend), c=np.log10(weights), cmap="cividis", s=18, zorder=3)
fig.colorbar(dots, label="weight of the posture, power of ten")
axes.set(xlabel="hand off its target [mm]", ylabel="joints off their posture [deg]")
axes.set_title(f"{WEIGHTS} weights, one call: what a better hand costs")
plt.show()
assert miss[0] < miss[-1] and bend[0] > bend[-1]

# %% [markdown]
# A sweep shows one or two numbers. For ten or more, follow the gradient: notebook `4_tuning_by_gradient`.
#
# ## Robots and targets: nested
#
# Link lengths and masses are arrays of the robot, so robots make a batch too. How long should its links be? Each of
# these arms tries each of these targets: one `vmap` over targets inside one over robots.

# %%
lengths = jnp.linspace(0.5, 1.5, LENGTHS)
robots = jax.vmap(lambda s: arm.scaled(length={"link[3456]": s}, mass={"link[3456]": s}))(lengths)

side = np.linspace(-0.8, 0.8, GRID)
X, Z = np.meshgrid(side, side)
points = home + np.stack([X.ravel(), np.full(X.size, 0.1), Z.ravel()], 1)
eager = {**wishes, "posture": wishes["posture"].replace(weight=1e-4, gain=1.0)}
targets = osik.batched(eager, {"hand.target[0]": points})

each_target = jax.vmap(run, in_axes=(None, osik.batch_axes(eager, "hand.target[0]")))
each_robot = jax.vmap(each_target, in_axes=(0, None))
start = time.perf_counter()
program = jax.jit(each_robot).lower(robots, targets).compile()
compiled = time.perf_counter()
left_over, _ = jax.block_until_ready(program(robots, targets))
seconds = time.perf_counter() - compiled
reached = np.asarray(left_over) < 5e-3  # (robots, targets)
print(f"{LENGTHS} robots x {len(points)} targets x {STEPS} steps: {left_over.size * STEPS:,} steps in {seconds:.1f} s")
print(f"({compiled - start:.0f} s to compile, once)")

# %%
fig, axes = plt.subplots(1, 4, figsize=(11, 3.2), width_ratios=[1, 1, 1, 1.35])
for place, panel in zip((0, LENGTHS // 2, LENGTHS - 1), axes, strict=False):
    panel.pcolormesh(
        100 * X, 100 * Z, reached[place].reshape(X.shape), cmap="cividis", shading="nearest", vmin=0, vmax=1
    )
    panel.plot(0, 0, "o", color=RED, label="hand at the start")
    panel.set(xlabel="forward [cm]", aspect="equal", title=f"links x {lengths[place]:.1f}")
    panel.grid(False)
axes[0].set_ylabel("up [cm]")
axes[0].legend(frameon=True, loc="lower right", fontsize=8)
axes[3].plot(lengths, 100 * reached.mean(1), "o-", color=BLUE)
axes[3].set(
    xlabel="length of the links, times its own", ylabel="targets reached [%]", title="Yellow: reached within 5 mm"
)
fig.tight_layout()
plt.show()

# %% [markdown]
# The same axes give derivatives: `jax.grad` of a rollout with respect to a link's length is the next step from here.
#
# ## Memory: batches that are too large
#
# `vmap` holds all lanes at once. `jax.lax.map(..., batch_size=...)` runs some lanes at a time: the same numbers, and
# memory that no longer grows with the batch.

# %%
chunk = max(2, GRID**2 // 16)


def reach(p):
    """A rollout towards the target p."""
    return run(arm, {**eager, "hand": eager["hand"].replace(target=(p, rotation))})[0]


compiled = {
    f"all {len(points)} at once": jax.jit(jax.vmap(reach)).lower(points).compile(),
    f"{chunk} at a time": jax.jit(lambda p: jax.lax.map(reach, p, batch_size=chunk)).lower(points).compile(),
}
answers, held = [], []
for name, program in compiled.items():
    answers.append(np.asarray(program(points)))
    held.append(program.memory_analysis().temp_size_in_bytes)
    print(f"{name:>20}: {held[-1] / 2**20:6.2f} MiB")
np.testing.assert_allclose(answers[1], answers[0], atol=1e-9)
assert held[1] < held[0]

# %% [markdown]
# For gradients through rollouts see the page on tuning: `rollout` keeps its states alone, and `tune` has `chunk`.
#
# ## On a GPU
#
# Not measured here: read from a file that was recorded on an NVIDIA H200 by
# `python -m benchmarks.throughput`, NAO with both feet, centre of mass, one hand and posture. The same command
# runs on your machine. Weighted problems in float32, and hierarchies in both precisions, are searched by kernels of
# their own there (extra `cuda`); the rest is XLA's.

# %%
data = next(folder for folder in (Path("data"), Path("notebooks/data")) if folder.exists())
record = json.loads((data / "throughput_h200.json").read_text())
print(f"{record['device']}, jax {record['jax']}")
rows = {(r["scheme"], r["precision"], r["batch"]): r for r in record["rows"]}
for (scheme, precision, batch), r in rows.items():
    per_second, gib = r["steps_per_second"], r["program_bytes"] / 2**30
    case = f"{scheme:>13} {precision} {batch:7,}"
    print(f"{case}: {1e3 * r['seconds']:7.2f} ms, {per_second:10,.0f} steps/s, {gib:6.3f} GiB, {r['error']:.0e} off")
allowed = {"float64": 1e-13, "float32": 2e-5}  # [m, rad], against float64 on a CPU
assert all(r["solved"] == 1.0 and r["error"] < allowed[precision] for (_, precision, _), r in rows.items())

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(10.5, 3.8))
SCHEMES = {"weighted": BLUE, "null-space": ORANGE, "hierarchical": GREEN}
for scheme, color in SCHEMES.items():
    for precision, style in (("float64", "o-"), ("float32", "s:")):
        found = sorted(batch for s, p, batch in rows if (s, p) == (scheme, precision))
        per_second = [rows[scheme, precision, batch]["steps_per_second"] for batch in found]
        left.loglog(found, per_second, style, color=color, ms=4, label=f"{scheme}, {precision}")
        memory = [rows[scheme, precision, batch]["program_bytes"] / 2**20 for batch in found]
        right.loglog(found, memory, style, color=color, ms=4)
if not FAST:
    left.loglog(list(speeds), list(speeds.values()), "^--", color=GREY, ms=5, label="weighted, float64, this CPU")
left.set(xlabel="robots in a batch", ylabel="steps a second", title="NVIDIA H200: NAO's steps a second")
right.set(xlabel="robots in a batch", ylabel="memory of the program [MiB]", title="... and memory")
fig.legend(
    *left.get_legend_handles_labels(), frameon=False, loc="center right", fontsize=8.5, bbox_to_anchor=(0.985, 0.5)
)
fig.tight_layout(rect=(0.0, 0.0, 0.78, 1.0))
plt.show()


# %% [markdown]
# What the record says, checked below:
#
# - **A thousand robots take hardly longer than one**: what takes the time is to start some hundred kernels, one after
#   another. Sixteen thousand and more make millions of steps a second.
# - **Weighted**: the fastest, in single precision about three times as fast as in double.
# - **Hierarchical**: one warp of the GPU takes one robot through all its levels and stops by itself, so that no robot
#   waits for the slowest.
# - **Null space**: no kernel of its own. Single precision about doubles the speed.
# - **One robot** gains nothing: a CPU answers sooner than a GPU starts its kernels.


# %%
def seconds_of(scheme, precision, batch):
    """A call in the record."""
    return rows[scheme, precision, batch]["seconds"]


def best(scheme, precision="float64"):
    """The most steps a second in the record, and the batch that had it."""
    return max((r["steps_per_second"], b) for (s, p, b), r in rows.items() if (s, p) == (scheme, precision))


stretch = {name: seconds_of(name, "float64", 1024) / seconds_of(name, "float64", 1) for name in SCHEMES}
print("1,024 robots take so many times as long as one:", {name: round(times, 2) for name, times in stretch.items()})
for name in SCHEMES:
    (speed, batch), (single, lanes) = best(name), best(name, "float32")
    print(f"{name}: at best {speed:,.0f} steps/s in float64 ({batch:,} robots), {single:,.0f} in float32 ({lanes:,})")
print(f"one robot, weighted: {1e3 * seconds_of('weighted', 'float64', 1):.2f} ms there, {here[1][0]:.2f} ms here")
assert max(stretch.values()) < 1.5
assert min(best(name, "float32")[0] for name in SCHEMES) > 1e6
assert 2.5 < best("weighted", "float32")[0] / best("weighted")[0] < 3.5
assert 1.8 < best("null-space", "float32")[0] / best("null-space")[0] < 3.0

# %% [markdown]
# ## Next
#
# - `4_tuning_by_gradient`: batches of situations, and the gradient through them.
# - The page on batches in `docs`: all names, whole task sets, what refuses to stack.
