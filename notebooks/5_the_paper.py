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
# # The paper, redone and corrected
#
# This library starts from O. Ramos, *A Kinematic Whole-body Control System for Highly Redundant Robots*.
# After this notebook you can
#
# - repeat its experiment on NAO: the waist moves, the feet stay, the robot keeps its balance;
# - run the same tasks in a physics simulation and say what changes;
# - use its formulas without stepping on the misprints, each shown here against the right version.

# %%
import os
import tempfile
from pathlib import Path
from types import SimpleNamespace

import jax
import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax.demo._nao import double_support, single_support  # the motions of `osik demo`
from osik_jax.demo._observed import observe
from osik_jax.demo._run import make_scheme, run_scheme
from osik_jax.physics import Servo, Simulation, build_world, simulate
from osik_jax.solvers import Level, Status, solve_nullspace, solve_qp
from osik_jax.viewer import hero_picture

osik.runtime.configure_cpu()  # small problems, one after another
jax.config.update("jax_enable_x64", True)  # double precision: controllers want it

FAST = "OSIK_FAST" in os.environ  # the tests run this notebook with smaller sizes
SCHEME = "null-space" if FAST else "hierarchical"  # what compiles fastest, what the text is about
SCENES = {"waist": double_support} if FAST else {"waist": double_support, "one foot": single_support}
DURATION, DT = (4.0, 0.01) if FAST else (8.0, 0.005)  # [s]
SAMPLES = 50 if FAST else 300

BLUE, RED, GREY, ORANGE = "#0072b2", "#d55e00", "#8a8f98", "#e69f00"
plt.rcParams |= {"figure.dpi": 80, "axes.grid": True, "grid.color": "#e3e7ec", "axes.axisbelow": True}
plt.rcParams |= {"axes.spines.top": False, "axes.spines.right": False, "axes.titlelocation": "left", "font.size": 9.5}

# %% [markdown]
# ## 1. NAO, on the screen and on the floor
#
# | priority | task |
# |---|---|
# | 1 | both feet keep their pose |
# | 2 | the centre of mass stays over the support polygon, anywhere in it: an inequality |
# | 3 | the waist (the frame `torso`) goes 5 cm to its left and back |
# | 4 | the posture takes what freedom is left |
#
# The scheme is the hierarchical QP (eq. 9); the fast mode of the tests takes the null space (eqs. 6 to 8). Each motion
# runs twice: **kinematic**, where the robot is wherever its joints were sent, and **dynamic**, in MuJoCo with a floor,
# friction, gravity and a position servo on every joint. There the tasks see the sensed robot, base included, 200 times
# a second.
#
# The second motion shifts the weight onto the left foot, lifts the right one and opens the arms; the fast mode leaves
# it out.

# %%
LEGS = dict.fromkeys(("*Hip*", "*Knee*", "*Ankle*"), Servo(stiffness=150.0, damping=5.0))


def run_both(motion):
    """The motion on the screen as ``plan``, and what is sensed of it in MuJoCo."""
    plan = run_scheme(motion, SCHEME, dt=DT)
    simulation = Simulation(build_world(motion.robot, servos=LEGS), motion.q0)

    def tasks(t):  # servos follow a gain of 5 / s without swinging; the kinematic loop takes 20
        every = motion.tasks(t).items()
        return {k: task if isinstance(task, osik.PostureTask) else task.replace(gain=5.0) for k, task in every}

    scheme = make_scheme(SCHEME).replace(curvature_damping=0.0)
    found = simulate(simulation, tasks, scheme=scheme, dt=DT, steps=len(plan.q) - 1)
    base = motion.robot.tree.qpos_address[motion.robot.tree.free_bases[0]]
    sensed, wanted = (q[: len(found.q), base : base + 7] for q in (found.q, plan.q))
    angle = 2.0 * np.arccos(np.clip(np.abs(np.sum(sensed[:, 3:] * wanted[:, 3:], axis=1)), 0.0, 1.0))
    off = dict(height_error=np.abs(sensed[:, 2] - wanted[:, 2]), tilt_error=angle)
    return SimpleNamespace(plan=plan, recording=found, q=found.q, seen=observe(motion, found.q, DT), **off)


motions = {name: scene(DURATION) for name, scene in SCENES.items()}
runs = {name: run_both(motion) for name, motion in motions.items()}
for name, run in runs.items():
    print(f"{name}: {len(run.plan.q) - 1} steps, fell: {run.recording.fell}")
    assert not run.recording.fell

# %% [markdown]
# ### Snapshots of the motion (the paper's Fig. 1)
#
# This notebook was written from the paper's equations and from a description of its experiment; its pictures were not
# at hand. So this is what stands in for Fig. 1, snapshots of a whole-body motion, and not a copy of it: instants and
# amplitudes are our own. Green: the support polygon. Orange: the centre of mass and where it meets the floor.


# %%
INSTANTS = (0.0, 0.5) if FAST else (0.0, 0.24, 0.34, 0.48, 0.64)  # parts of the duration


def snapshots(robot, q, support, instants, size=(400, 200) if FAST else (1200, 420)):
    """A picture of some instants of a motion, given as parts of its duration."""
    steps = [round(part * (len(q) - 1)) for part in instants]
    with tempfile.TemporaryDirectory() as folder:
        labels = [f"{DT * k:.1f} s" for k in steps]
        settings = {"support": [support[k] for k in steps], "labels": labels, "size": size}
        return plt.imread(hero_picture(Path(folder) / "robots.png", robot, [q[k] for k in steps], **settings))


name, run = list(runs.items())[-1]
motion = motions[name]
figure, rows = plt.subplots(2, 1, figsize=(9, 6.8), layout="compressed")
for axes, title, part in ((rows[0], "kinematic", run.plan), (rows[1], "dynamic (MuJoCo, sensed)", run)):
    picture = snapshots(motion.robot, part.q, part.seen.support, INSTANTS)
    axes.imshow(picture)
    axes.set_axis_off()
    axes.set_title(f"{title}: {motion.title}")

# %% [markdown]
# ### Tasks over time (for the paper's Fig. 4)
#
# Again in place of the figure and not a copy: the waist against its reference, how far waist and feet are off, and the
# centre of mass in the polygon, from the configurations alone.


# %%
def draw_tasks(column, part, title):
    """One column: waist and reference, errors, margin of the centre of mass, and the view from above."""
    seen = part.seen
    waist, errors, balance, above = column
    waist.plot(seen.time, 1e3 * seen.wanted["waist"][:, 1], "--", color="k", lw=1.2, label="reference", zorder=3)
    waist.plot(seen.time, 1e3 * seen.moved["waist"][:, 1], color=BLUE, lw=2.5, label="waist")
    waist.set(title=f"{title}: the waist follows its path", ylabel="to the left [mm]")
    off = {"waist off its path": (seen.off_path("waist"), BLUE), "feet off their place": (seen.drift, ORANGE)}
    for label, (distance, color) in off.items():
        errors.semilogy(seen.time, 1e3 * np.maximum(distance, 1e-10), color=color, label=label)
    errors.set(title="what waist and feet are off by", ylabel="[mm]")
    balance.plot(seen.time, 1e3 * seen.com_inside, color=BLUE, label="distance to the nearest edge")
    balance.axhline(0.0, color=RED, ls="--", label="edge of the polygon")
    balance.set(title="the centre of mass stays over the feet", ylabel="[mm]", xlabel="time [s]")
    polygon = 1e3 * seen.support[0][[*range(len(seen.support[0])), 0]]
    above.fill(polygon[:, 1], polygon[:, 0], color="#009e73", alpha=0.15)
    above.plot(polygon[:, 1], polygon[:, 0], color="#009e73", label="support polygon")
    above.plot(1e3 * seen.com[:, 1], 1e3 * seen.com[:, 0], color=BLUE, lw=2.5, label="centre of mass")
    above.set(title="from above", xlabel="to the left [mm]", ylabel="forward [mm]", aspect="equal")
    above.invert_xaxis()


figure, grid = plt.subplots(4, 2, figsize=(10, 11), sharey="row", layout="constrained")
draw_tasks(grid[:, 0], runs["waist"].plan, "kinematic")
draw_tasks(grid[:, 1], runs["waist"], "dynamic")
for axes in grid[:, 1]:
    axes.legend(loc="best", fontsize=8.5)


# %%
def worst(part):
    """Greatest errors and least margin of a motion [mm]."""
    seen = part.seen
    return tuple(1e3 * float(x) for x in (seen.off_path("waist").max(), np.nanmax(seen.drift), seen.com_inside.min()))


print(f"{'worst, in mm':24}{'waist off path':>16}{'feet off place':>16}{'mass inside by':>16}")
for name, run in runs.items():
    for kind, part in (("kinematic", run.plan), ("dynamic", run)):
        print(f"{name + ', ' + kind:24}" + "".join(f"{value:16.3f}" for value in worst(part)))

for name, run in runs.items():
    waist, feet, margin = worst(run.plan)
    assert waist < 1.0 and feet < 0.1 and margin > 0.0  # on the screen
    assert worst(run)[1] < 5.0 and worst(run)[2] > 0.0  # on the floor: feet within 5 mm, balanced
    height, turn = 1e3 * run.height_error.max(), np.degrees(run.tilt_error.max())
    print(f"{name}, dynamic, at most: base {height:.2f} mm and {turn:.2f} deg off the kinematic motion")
    assert height < 10.0 and turn < 3.0

# %% [markdown]
# On the screen the errors are those of a step of Euler's rule. On the floor they are what servos, gravity and a soft
# contact leave: the feedback takes the droop of the servos away but may not be as quick as on the screen, or the robot
# swings; see [physics](../docs/physics.md). Feet off their place counts how far they sink in, too.
#
# ## 2. The misprints, one by one
#
# The formulas as printed against those that work, on a 7-joint arm. `look` is the only robot program that is compiled:
# the hand's pose and Jacobian, and what an orientation task sees. The rest is NumPy and two array-level solvers. Red is
# wrong, blue is right, in all figures.

# %%
arm = osik.load_robot("arm7")
q0, lower, upper, top_speed = map(np.asarray, (arm.q0, arm.position_lower, arm.position_upper, arm.velocity_limit))
turning = osik.FrameTask(arm, "hand", rows="orientation")
FREE, NO_ROWS, UPRIGHT = np.full(2, np.inf), np.zeros((2, 7)), np.eye(3)


@jax.jit
def program(q, aim):
    """Position, rotation and Jacobian of the hand; error and Jacobian of turning it to ``aim``."""
    kinematics = osik.forward_kinematics(arm, q)
    rows = turning.replace(target=(turning.target[0], aim)).rows(arm, kinematics, q)
    pose = kinematics.frame_pose(arm, "hand")
    return *pose, osik.frame_jacobian(arm, kinematics, "hand"), rows.error, rows.jacobian


def look(q, aim=UPRIGHT):
    """The same as NumPy arrays."""
    return [np.asarray(part) for part in program(q, aim)]


def qp(H, g, low, high, rows=NO_ROWS, rows_low=-FREE, rows_high=FREE):
    """A standard QP of the library: min 1/2 v'Hv + g'v in a box, two rows between bounds."""
    return solve_qp(H, g, low, high, rows, rows_low, rows_high)


def closed_loop(velocity, q, steps, dt):
    """Configurations that q' = velocity(step, q) leads through, the start first."""
    path = [q]
    for k in range(steps):
        path.append(path[-1] + dt * velocity(k, path[-1]))
    return np.array(path)


def hand_path(path):
    """Positions of the hand along a path [m]."""
    return np.array([look(q)[0] for q in path])


p0, R0, J0, *_ = look(q0)
summary = []  # what is wrong, what is measured, right, wrong


# %% [markdown]
# ### Eq. (4): the rate that the error *has* for the rate that it *should have*
#
# The cost is $\tfrac12\sum_i w_i\|J_i v-\dot e_i^*\|^2$ with the wanted rate $\dot e^*=-\lambda e$. Printed without the
# star, it compares $Jv$ with the error's own rate, which is $Jv$ again: every velocity has cost 0, and damping chooses
# none. If one reads it as the rate of the step before, the hand keeps the velocity that it has.

# %%
GAIN, TIME_STEP, STEPS = 4.0, 0.01, 150
goal = p0 + np.array([0.05, 0.10, -0.05])


def least_squares(J, rate, damping=1e-8):
    """min |J v - rate|^2 + damping |v|^2."""
    return np.linalg.solve(J.T @ J + damping * np.eye(7), J.T @ rate)


def wanted(k, q):
    """The right cost."""
    p, _, J, *_ = look(q)
    return least_squares(J[:3], -GAIN * (p - goal))


def own_rate(k, q):
    """As printed: J v - e' is J v - J v."""
    J = look(q)[2][:3]
    return least_squares(J - J, np.zeros(3))


def coasting(k, q, start=20):
    """As printed, e' from the step before; the right cost gives it a start."""
    if k < start:
        coasting.rate = -GAIN * (look(q)[0] - goal)
        return wanted(k, q)
    return least_squares(look(q)[2][:3], coasting.rate)


time = TIME_STEP * np.arange(STEPS + 1)
lengths = {wanted: STEPS, own_rate: STEPS, coasting: 90}
paths = {f: hand_path(closed_loop(f, q0, steps, TIME_STEP)) for f, steps in lengths.items()}
far = {f: 1e3 * np.linalg.norm(path - goal, axis=-1) for f, path in paths.items()}
figure, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot(time, far[wanted], color=BLUE, lw=2.5, label="wanted rate (right)")
axes.plot(time, far[own_rate], color=RED, label="own rate (printed): nothing moves")
axes.plot(time[:91], far[coasting], color=RED, ls="--", label="rate of the last step, from 0.2 s on: flies past")
axes.set(title="With the error's own rate the hand never arrives", xlabel="time [s]", ylabel="hand to goal [mm]")
axes.legend()
assert far[wanted][-1] < 0.5 and np.ptp(far[own_rate]) == 0.0 and far[coasting][-1] > far[coasting].min() + 10.0
summary.append(("eq. 4: own rate", "hand to goal at the end [mm]", far[wanted][-1], far[own_rate][-1]))

# %% [markdown]
# ### Limits: $q-q_{lower}$ where $q_{lower}-q$ is right
#
# One step may not lead beyond a limit: $(q_{lower}-q)/\Delta t\le v\le(q_{upper}-q)/\Delta t$. With the left side
# turned round it is *positive* inside the range: joints are made to move up, and above the middle of its range a joint
# has no velocity at all that fits. With speed limits on top (right), every joint runs up at its top speed until one is
# at its limit; then nothing fits.

# %%
rng = np.random.default_rng(0)
samples = rng.uniform(lower, upper, (100_000, 7))
feasible = {
    "right": np.mean((lower - samples <= upper - samples).all(-1)),
    "printed": np.mean((samples - lower <= upper - samples).all(-1)),
}


def boxed(turned):
    """Follows the goal in a box of position and velocity limits; stops with None where nothing fits."""
    path = [q0]
    for _ in range(STEPS):
        q = path[-1]
        p, _, J, *_ = look(q)
        low, high = (q - lower if turned else lower - q) / TIME_STEP, (upper - q) / TIME_STEP
        box = np.clip(low, -top_speed, top_speed), np.clip(high, -top_speed, top_speed)
        answer = qp(J[:3].T @ J[:3] + 1e-6 * np.eye(7), J[:3].T @ (GAIN * (p - goal)), *box)
        if answer.status != Status.SOLVED:
            break
        path.append(q + TIME_STEP * np.asarray(answer.x))
    return np.array(path), Status(int(answer.status)).name


right, said = boxed(False)
printed, said_printed = boxed(True)
figure, (left, middle, other) = plt.subplots(1, 3, figsize=(10.5, 3.3), layout="constrained")
angle = np.linspace(lower[0], upper[0], 100)
left.fill_between(angle, (lower[0] - angle), upper[0] - angle, color=BLUE, alpha=0.15, label="allowed")
left.plot(angle, upper[0] - angle, color=BLUE, label="to the upper limit")
left.plot(angle, lower[0] - angle, color=BLUE, ls="--", label="to the lower limit (right)")
left.plot(angle, angle - lower[0], color=RED, ls="--", label="lower bound as printed")
left.set(title="bounds on one step of a joint", xlabel="joint 1 [rad]", ylabel="step [rad]", ylim=(-12.0, 6.5))
left.legend(fontsize=7.5, loc="lower center")
messages = (
    (middle, right, BLUE, "right: the hand arrives"),
    (other, printed, RED, f"printed: all go up, {said_printed}"),
)
for axes, path, color, title in messages:
    axes.plot(TIME_STEP * np.arange(len(path)), (path - lower) / (upper - lower), color=color)
    axes.set(title=title, xlabel="time [s]", xlim=(0.0, TIME_STEP * STEPS), ylim=(-0.03, 1.03))
    axes.set_ylabel("joint angles, part of their range")
print(f"configurations at which a velocity fits: right {feasible['right']:.2%}, printed {feasible['printed']:.2%}")
print(f"(seven joints, each in the lower half of its range: 1 / 2^7 = {1 / 2**7:.2%})")
print(f"with speed limits too, as printed: {said_printed} after {len(printed) - 1} steps")
assert feasible["right"] == 1.0 and abs(feasible["printed"] - 2**-7) < 2e-3
assert said == "SOLVED" and said_printed == "INFEASIBLE"
assert (right >= lower).all() and (right <= upper).all()
rise = np.diff(printed, axis=0) / TIME_STEP
assert np.allclose(rise[:-1], top_speed)  # every joint upwards, as fast as it can, whatever the task
summary.append(("limits turned round", "configurations with a solution [%]", 100.0, 100.0 * feasible["printed"]))

# %% [markdown]
# ### Eq. (5): a Hessian that is half of a standard QP's
#
# A QP solver minimises $\tfrac12v^\top Hv+g^\top v$. With $g=-\sum wJ^\top\dot e^*$ that wants $H=\sum wJ^\top J$.
# Half of it doubles every velocity, that is every gain: the loop $e\to(1-\lambda\Delta t)e$ becomes
# $e\to(1-2\lambda\Delta t)e$, and what was stable up to $\lambda\Delta t=2$ is up to 1.


# %%
def standard(scale, step):
    """Distance to a goal 1 mm away over 15 steps, with ``scale`` H; ``step`` is gain times time step."""
    near = p0 + np.array([0.0, 1e-3, 0.0])
    q, distances = q0, [1e-3]
    for _ in range(15):
        p, _, J, *_ = look(q)
        H, g = J[:3].T @ J[:3] + 1e-9 * np.eye(7), J[:3].T @ (step / TIME_STEP * (p - near))
        q = q + TIME_STEP * np.asarray(qp(scale * H, g, -1e3 * np.ones(7), 1e3 * np.ones(7)).x)
        distances.append(np.linalg.norm(look(q)[0] - near))
    return np.array(distances)


figure, columns = plt.subplots(1, 2, figsize=(9, 2.9), sharey=True, layout="constrained")
half = {}
for axes, step, outcome in zip(columns, (0.1, 1.2), ("twice as quick as asked", "unstable"), strict=True):
    half[step] = standard(1.0, step), standard(0.5, step)
    axes.semilogy(1e3 * half[step][0], "o-", color=BLUE, ms=4, label=f"H: times {abs(1 - step):.1f} a step")
    axes.semilogy(1e3 * half[step][1], "s-", color=RED, ms=4, label=f"H/2: times {abs(1 - 2 * step):.1f} a step")
    axes.set(
        title=f"gain times dt {step}: H/2 is {outcome}", xlabel="step", ylabel="hand to goal [mm]", ylim=(1e-5, 1e4)
    )
    axes.legend(fontsize=8)
np.testing.assert_allclose([pair[1] / pair[0] for pair in half[0.1]], [0.9, 0.8], rtol=1e-2)
assert half[1.2][0][-1] < 1e-8 and half[1.2][1][-1] > 0.05
summary.append(("eq. 5: half of H", "hand to goal after 15 steps [mm]", 1e3 * half[1.2][0][-1], 1e3 * half[1.2][1][-1]))

# %% [markdown]
# ### Eqs. (6), (7): "any reflexive inverse" is not enough
#
# A reflexive inverse $G$ of $A$ has $AGA=A$ and $GAG=G$. There are infinitely many, and the Moore-Penrose inverse is
# one of them. With another one a lower level is not confined to the null space of the level above, and what it misses
# is not the least. Level 1: the hand does not move. Level 2: pose and elbow, more than the arm has.

# %%
elbow = np.eye(7)[[3]]
A1, A2 = J0[:3], np.vstack([J0, elbow])
ask = np.array([0.1, 0.0, 0.0, 0.0, 0.5, 0.0, 0.3])  # of level 2: [m/s], [rad/s]
P1 = np.eye(7) - np.linalg.pinv(A1) @ A1
A = A2 @ P1
moore_penrose = np.linalg.pinv(A, rcond=1e-9)


def reflexive():
    """Some reflexive inverse of A."""
    U, V = rng.normal(size=(2, 7, 7))
    inner = [moore_penrose + (np.eye(7) - moore_penrose @ A) @ U, moore_penrose + V @ (np.eye(7) - A @ moore_penrose)]
    G = inner[0] @ A @ inner[1]
    assert np.allclose(A @ G @ A, A) and np.allclose(G @ A @ G, G)
    return G


def damage(G):
    """How fast level 1 is moved [mm/s], and what level 2 misses."""
    v = G @ ask
    return 1e3 * np.linalg.norm(A1 @ v), np.linalg.norm(A2 @ v - ask)


others = np.array([damage(reflexive()) for _ in range(SAMPLES)])
best = damage(moore_penrose)
library = solve_nullspace((Level(A1, np.zeros(3)), Level(A2, ask)), rank_tolerance=1e-9)
np.testing.assert_allclose(library.x, moore_penrose @ ask, atol=1e-9)
figure, axes = plt.subplots(figsize=(6.5, 3.1), layout="constrained")
axes.loglog(*others.T, ".", color=RED, alpha=0.6, label=f"{SAMPLES} other reflexive inverses")
axes.loglog(max(best[0], 1e-3), best[1], "*", ms=16, color=BLUE, label=f"Moore-Penrose (level 1: {best[0]:.0e} mm/s)")
axes.set(title="Other inverses move the hand that level 1 holds", xlabel="level 1: hand moves at [mm/s]")
axes.set(ylabel="what level 2 misses", xlim=(5e-4, None))
axes.legend(loc="upper left", fontsize=8)
assert best[0] < 1e-9 and others[:, 0].min() > 1.0
summary.append(("eqs. 6, 7: any inverse", "level 1 moves at, median [mm/s]", best[0], np.median(others[:, 0])))

# %% [markdown]
# ### Eq. (7): damping belongs in the motion, not in the projector
#
# Near singularities one damps the inverse, $A^\top(AA^\top+\delta I)^{-1}$. Used in the *projector* it leaks:
# $P=I-A^{\ast}A$ is then no projection ($P^2\ne P$), and $J_1P\ne0$: lower levels move what level 1 holds. Here level 1
# holds the hand with a gain of 10 per second while the posture pulls.

# %%
DAMPINGS = np.logspace(-6, -1, 26)
POSTURE = np.array([0.8, -0.6, 0.5, 0.7, -0.6, 0.5, 0.3])  # what level 2 asks of the joints [rad/s]


def projector(J, damping):
    """Damped, or, with 0, the exact one."""
    inverse = np.linalg.pinv(J) if damping == 0 else J.T @ np.linalg.inv(J @ J.T + damping * np.eye(len(J)))
    return np.eye(7) - inverse @ J


def swaying(damping):
    """Level 1 holds the hand, level 2 sways the posture in its null space."""

    def velocity(k, q):
        p, _, J, *_ = look(q)
        hold = np.linalg.pinv(J[:3]) @ (-10.0 * (p - p0))
        return hold + projector(J[:3], damping) @ POSTURE * np.cos(np.pi * k * TIME_STEP)

    return 1e3 * np.linalg.norm(hand_path(closed_loop(velocity, q0, 200, TIME_STEP)) - p0, axis=-1)


not_idempotent = [np.linalg.norm(P @ P - P) for P in (projector(A1, d) for d in DAMPINGS)]
leak = [1e3 * np.linalg.norm(A1 @ projector(A1, d) @ POSTURE) for d in DAMPINGS]
drift = {d: swaying(d) for d in (0.0, 1e-2, 1e-1)}
figure, (left, other) = plt.subplots(1, 2, figsize=(9.5, 3), layout="constrained")
left.loglog(DAMPINGS, leak, color=RED, label="hand moves at [mm/s]")
left.loglog(DAMPINGS, not_idempotent, color=RED, ls="--", label="size of $P^2-P$")
exact = projector(A1, 0.0)
exact_leak = 1e3 * np.linalg.norm(A1 @ exact @ POSTURE)
print(f"undamped: size of P^2 - P {np.linalg.norm(exact @ exact - exact):.0e}, hand moves at {exact_leak:.0e} mm/s")
left.set(title="a damped projector leaks", xlabel=r"damping $\delta$")
left.legend(fontsize=8)
for (damping, values), color, style in zip(drift.items(), (BLUE, RED, RED), ("-", "-", "--"), strict=True):
    label = f"damping {damping:g} in it" if damping else "projector undamped (right)"
    other.plot(TIME_STEP * np.arange(201), values, color=color, ls=style, label=label)
other.set(title="so the hand is not held", xlabel="time [s]", ylabel="hand off its place [mm]")
other.legend(fontsize=8)
assert np.linalg.norm(exact @ exact - exact) < 1e-12 and not_idempotent[-1] > 0.1
assert drift[0.0].max() < 2.0 and drift[0.1].max() > 5.0 * drift[0.0].max()
summary.append(("damped projector", "hand off its place [mm]", drift[0.0].max(), drift[0.1].max()))

# %% [markdown]
# ### Eq. (8): the potential's sign
#
# $f=\frac1{2n}\sum_i r_i/((u_i-q_i)(q_i-l_i))$ grows towards both limits, so the last null space should *descend* it:
# $v=v_K-\alpha P_K\,\partial f/\partial q$. With the printed plus the joints climb into their limits. The hand stays
# where it is; four freedoms are left to the joints.


# %%
def slope(q):
    """Gradient of the potential; q is kept 2 % of the range inside the limits."""
    r = upper - lower
    q = np.clip(q, lower + 0.02 * r, upper - 0.02 * r)
    return r * (2 * q - upper - lower) / (2 * 7 * (upper - q) ** 2 * (q - lower) ** 2)


def potential(q):
    """f itself."""
    return np.mean((upper - lower) / ((upper - q) * (q - lower))) / 2


h = 1e-6 * np.eye(7)
np.testing.assert_allclose(slope(q0), [(potential(q0 + e) - potential(q0 - e)) / 2e-6 for e in h], rtol=1e-6, atol=1e-8)


def along_potential(sign):
    """Holds the hand and follows the potential; the least distance to a limit, 1 mid-range, 0 at the limit."""

    def velocity(k, q):
        p, _, J, *_ = look(q)
        inverse = np.linalg.pinv(J[:3])
        free = (np.eye(7) - inverse @ J[:3]) @ (sign * 5.0 * slope(q))
        free *= min(1.0, 1.0 / np.abs(free / top_speed).max())  # never faster than the joints can
        return inverse @ (-10.0 * (p - p0)) + free

    path = closed_loop(velocity, q0, 400, TIME_STEP)
    return np.min(2 * np.minimum(path - lower, upper - path) / (upper - lower), -1)


room = {sign: along_potential(sign) for sign in (-1.0, 1.0)}
figure, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot(TIME_STEP * np.arange(401), room[-1.0], color=BLUE, lw=2.5, label=r"$-\alpha\,\partial f/\partial q$ (right)")
axes.plot(TIME_STEP * np.arange(401), room[1.0], color=RED, label=r"$+\alpha\,\partial f/\partial q$ (printed)")
axes.axhline(0.0, color="k", ls="--", lw=1)
axes.annotate("limit", (4.0, 0.0), xytext=(-4, 3), textcoords="offset points", ha="right")
axes.set(title="With the printed sign a joint leaves its range", xlabel="time [s]", ylim=(-0.5, None))
axes.set_ylabel("joint nearest to its limit\n(1 mid-range, 0 at it)")
axes.legend(loc="lower left")
assert room[-1.0][-1] >= room[-1.0][0] and room[1.0].min() < 0.0
summary.append(("eq. 8: plus sign", "room to the nearest limit, 1 to 0", room[-1.0][-1], room[1.0].min()))

# %% [markdown]
# ### Eq. (9): $l$ and $u$ swapped
#
# Level $k$ wants $l_k\le J_kv+w_k\le u_k$, with $w_k$ as small as possible. Printed with $l$ and $u$ in each other's
# place it asks a number to be above the greater and below the smaller of two: no $v$ and no $w$ will do.
# Here the hand's speed is bounded in two directions, and the hand should go as nearly as that allows at (0.3, 0.2) m/s.

# %%
low, high, wish = np.array([-0.1, -0.2]), np.array([0.2, 0.1]), np.array([0.3, 0.2])
plane = J0[:2]
H, g = plane.T @ plane + 1e-9 * np.eye(7), -plane.T @ wish
kept = qp(H, g, -top_speed, top_speed, plane, low, high)
swapped = qp(H, g, -top_speed, top_speed, plane, high, low)
print(f"right: {Status(int(kept.status)).name}, hand at {np.round(plane @ kept.x, 4)} m/s")
print(f"swapped: {Status(int(swapped.status)).name}")
figure, (left, other) = plt.subplots(1, 2, figsize=(9, 3.3), sharey=True, layout="constrained")
left.fill_between([low[0], high[0]], low[1], high[1], color=BLUE, alpha=0.2, label="l <= J v <= u")
left.plot(*wish, "k*", ms=12, label="wanted")
left.plot(*(plane @ kept.x), "o", color=BLUE, ms=9, label="answer")
left.set(title="right: the nearest that is allowed", ylabel="hand to the left [m/s]")
other.axvspan(high[0], 0.5, color=RED, alpha=0.2, label="J v >= u, forward")
other.axvspan(-0.5, low[0], color=ORANGE, alpha=0.3, label="J v <= l, forward")
other.plot(*wish, "k*", ms=12, label="wanted")
other.set(title="printed: both at once, nowhere")
for axes in (left, other):
    axes.set(xlim=(-0.5, 0.5), ylim=(-0.4, 0.4), xlabel="hand forward [m/s]")
    axes.legend(loc="lower right", fontsize=8)
assert kept.status == Status.SOLVED and swapped.status == Status.INFEASIBLE
np.testing.assert_allclose(plane @ kept.x, high, atol=1e-6)
summary.append(("eq. 9: l, u swapped", "solved (1) or infeasible (0)", 1.0, 0.0))

# %% [markdown]
# ### What is missing: feed-forward
#
# The wanted rate is $-\lambda e+\dot x^*$. The paper leaves the target's own velocity $\dot x^*$ out. On a circle of
# radius $r$ at $\omega$ the hand then runs behind by $r\omega/\sqrt{\lambda^2+\omega^2}$, and inside the circle.

# %%
RADIUS, OMEGA = 0.05, 2 * np.pi / 3.0
moments = TIME_STEP * np.arange(301)
circle = p0 + RADIUS * np.stack([0 * moments, np.sin(OMEGA * moments), np.cos(OMEGA * moments) - 1.0], -1)
rate = np.diff(circle, axis=0) / TIME_STEP


def tracking(forward):
    """Hand positions along the circle."""

    def velocity(k, q):
        p, _, J, *_ = look(q)
        return least_squares(J[:3], -GAIN * (p - circle[k]) + forward * rate[k])

    return hand_path(closed_loop(velocity, q0, 300, TIME_STEP))


with_it, without = tracking(1.0), tracking(0.0)
lag = {"right": np.linalg.norm(with_it - circle, axis=-1), "printed": np.linalg.norm(without - circle, axis=-1)}
predicted = RADIUS * OMEGA / np.hypot(GAIN, OMEGA)
figure, (left, other) = plt.subplots(1, 2, figsize=(9.5, 3.2), width_ratios=(1, 1.5), layout="constrained")
left.plot(*(1e3 * (circle - p0)[:, 1:].T), "k--", lw=1, label="wanted")
left.plot(*(1e3 * (with_it - p0)[:, 1:].T), color=BLUE, lw=2.5, alpha=0.7, label="with")
left.plot(*(1e3 * (without - p0)[:, 1:].T), color=RED, label="without")
left.set(title="path of the hand", xlabel="to the left [mm]", ylabel="up [mm]", aspect="equal")
left.legend(fontsize=8, loc="center")
other.plot(moments, 1e3 * lag["right"], color=BLUE, label="with feed-forward")
other.plot(moments, 1e3 * lag["printed"], color=RED, label="without (as printed)")
other.axhline(1e3 * predicted, color="k", ls=":", label="predicted")
other.set(title="without, it stays behind", xlabel="time [s]", ylabel="[mm]")
other.legend(fontsize=8)
assert abs(lag["printed"][-1] / predicted - 1.0) < 0.05 and lag["right"].max() < 2e-3
summary.append(("no feed-forward", "hand off its target [mm]", 1e3 * lag["right"][-1], 1e3 * lag["printed"][-1]))

# %% [markdown]
# ### E is the inverse *left* Jacobian
#
# With the orientation error $e=\log(RR^{*\top})$ in world axes, $\dot e=E\omega$ needs the inverse left Jacobian of the
# rotations at $e$. Its transpose (the right one) or none at all ($E=I$) gets the rate wrong. When all three rows
# can be met it does not show, because $Ee=e$ for all of them. It shows when only some rows count: here the hand
# should lose its error about two axes and may turn as it likes about the third.


# %%
def left_inverse(e):
    """E: I - [e]/2 + c [e]^2 with c = (1 - a/2 cot(a/2)) / a^2."""
    angle, cross = np.linalg.norm(e), np.cross(np.eye(3), e).T
    return np.eye(3) - 0.5 * cross.T + (1 - 0.5 * angle / np.tan(0.5 * angle)) / angle**2 * cross @ cross


VARIANTS = {"inverse left Jacobian (right)": left_inverse, "its transpose": lambda e: left_inverse(e).T}
VARIANTS["none (E = I)"] = lambda e: np.eye(3)
axis, spin = np.array([0.6, 0.64, 0.48]), np.array([0.3, -0.5, 0.8])
angles = np.radians(np.linspace(5, 170, 34))


def rate_error(E, angle, h=1e-6):
    """Part of the true rate of e that E omega misses, by central differences."""
    turned = [Rotation.from_rotvec(s * h * spin) * Rotation.from_rotvec(angle * axis) for s in (-1, 1)]
    true = (turned[1].as_rotvec() - turned[0].as_rotvec()) / (2 * h)
    return np.linalg.norm(E(angle * axis) @ spin - true) / np.linalg.norm(true)


aim = (Rotation.from_rotvec(-2.0 * axis) * Rotation.from_matrix(R0)).as_matrix()
*_, error, rows = look(q0, aim)
np.testing.assert_allclose(left_inverse(error) @ J0[3:], rows, atol=1e-9)  # the library's task has the same E
np.testing.assert_allclose(left_inverse(error) @ error, error, atol=1e-9)


def turning_two_rows(E):
    """The error about x and y over time, asked to decay at the gain [rad]."""

    def velocity(k, q):
        *_, J, e, _ = look(q, aim)
        return least_squares((E(e) @ J[3:])[:2], -GAIN * e[:2])

    return np.array([np.linalg.norm(look(q, aim)[3][:2]) for q in closed_loop(velocity, q0, 100, TIME_STEP)])


figure, (left, other) = plt.subplots(1, 2, figsize=(9.5, 3.2), layout="constrained")
decay = {}
for (label, E), color, style in zip(VARIANTS.items(), (BLUE, RED, GREY), ("-", "-", "--"), strict=True):
    missed = [rate_error(E, angle) for angle in angles]
    decay[label] = turning_two_rows(E)
    left.semilogy(np.degrees(angles), np.maximum(missed, 1e-10), color=color, ls=style, label=label)
    other.semilogy(TIME_STEP * np.arange(101), np.degrees(decay[label]), color=color, ls=style, lw=2, label=label)
    assert (max(missed) < 1e-6) == (E is left_inverse)
asked = decay["its transpose"][0] * (1 - GAIN * TIME_STEP) ** np.arange(101)
other.semilogy(TIME_STEP * np.arange(101), np.degrees(asked), "k:", label="as asked")
left.set(title="rate of the error: part that is missed", xlabel="angle of the error [deg]", ylabel="relative")
left.legend(fontsize=8)
other.set(title="two rows of three: too slow without E", xlabel="time [s]", ylabel="error about x and y [deg]")
other.legend(fontsize=8)
off = {label: 100.0 * np.abs(values / asked - 1.0).max() for label, values in decay.items()}
print({label: f"{value:.1f} % off the decay asked for" for label, value in off.items()})
assert off["inverse left Jacobian (right)"] < 0.2 * min(list(off.values())[1:])
summary.append(("E transposed", "off the decay asked for [%]", *list(off.values())[:2]))

# %% [markdown]
# ### All of them

# %%
print(f"{'misprint or gap':26}{'measured':38}{'right':>10}{'wrong':>10}")
for misprint, measured, good, bad in summary:
    print(f"{misprint:26}{measured:38}{good:10.3g}{bad:10.3g}")
assert len(summary) == 9

# %% [markdown]
# ## 3. Where the library goes beyond the paper
#
# - **Rank is decided, not hoped for**: singular values below a stated share of a level's size count as zero
#   ([solvers](../docs/solvers.md)).
# - **Limits are hard**: a box that always exists and is kept exactly by `WeightedQP`, `HierarchicalQP` and
#   `NullSpace(method="saturated")` ([choosing a scheme](../docs/choosing_a_scheme.md)).
# - **Inequalities at any priority**, with slack and status reported for each step
#   ([tasks and limits](../docs/tasks_and_limits.md)).
# - **Derivatives**: of a step and of a whole motion, with respect to every number, so that weights and gains are tuned
#   by gradient ([tuning](../docs/tuning.md)).
# - **Many at once**: a `vmap` over targets, weights or robots ([batches](../docs/batches.md)).
# - **No recompilation** when a number changes ([traced versus static](../docs/traced_vs_static.md)).
# - **The dynamics**, with feedback from the sensed robot ([physics](../docs/physics.md)).
#
# The corrected formulas are in [the mathematics](../docs/paper.md).
