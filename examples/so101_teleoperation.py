"""SO-101: a held device moves a five-joint arm through a clutch, at half scale, from outside the arm's limits."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import osik_jax as osik

jax.config.update("jax_enable_x64", True)
dt, tip = 0.01, "gripper_frame_link"
arm = osik.load_robot("so101")

# the elbow is measured 0.1 rad beyond its limit; accelerations are limited from rest on, so nothing jumps
measured = jnp.zeros(arm.nq).at[2].set(arm.position_upper[2] + 0.1)
calm = osik.ConfigurationLimit(arm, return_speed={"*": 0.1}), osik.VelocityLimit(arm, velocity={"*": 1.5})
limits = (*calm, osik.AccelerationLimit(arm, {"*": 8.0}, return_speed={"*": 0.1}))
start = osik.forward_kinematics(arm, measured).frame_pose(arm, tip)
tasks = {  # five joints: the position comes first, the orientation gets what is left
    "position": osik.FrameTask(arm, tip, rows="position", gain=10.0, priority=1),
    "orientation": osik.FrameTask(arm, tip, rows="orientation", gain=5.0, priority=2),
    "posture": osik.PostureTask(arm, target=measured, priority=3),
}


def device(t):
    """Return a tracker's message: whether the clutch is pressed, and the hand's position and rotation."""
    position = jnp.array([0.12 * jnp.sin(1.1 * t), 0.2 * jnp.sin(0.8 * t), -0.15 * (1.0 - jnp.cos(0.9 * t))])
    half = 0.2 * jnp.sin(0.7 * t)  # of the angle of a turn about x
    return (t % 4.0 > 1.0) & (t % 4.0 < 3.0), (position, jnp.array([jnp.cos(half), jnp.sin(half), 0.0, 0.0]))


@jax.jit
def step(q, clutch, limits, t):
    """One period of a control loop that reads the device and commands the servos."""
    pressed, held = device(t)
    clutch, goal = clutch.step(pressed, held, osik.forward_kinematics(arm, q).frame_pose(arm, tip))
    aimed = tasks | {name: tasks[name].replace(target=goal) for name in ("position", "orientation")}
    sol = osik.solve(arm, q, aimed, scheme=osik.HierarchicalQP(), limits=limits, dt=dt)
    limits = (*calm, limits[2].after(sol.velocity))
    return osik.integrate(arm, q, sol.velocity, dt), clutch, limits, (q, pressed, goal[0], sol.error["position"])


q, clutch, log = measured, osik.Clutch(start, scale=0.5), []
for k in range(1200):
    q, clutch, limits, row = step(q, clutch, limits, k * dt)
    log.append(row)
angles, pressed, goals, errors = map(np.array, zip(*log, strict=True))
print(f"elbow back inside its limit after {dt * np.flatnonzero(angles[:, 2] <= arm.position_upper[2])[0]:.2f} s")
print(f"largest change of a joint in a step: {np.abs(np.diff(angles, axis=0)).max():.4f} rad")
print(f"the gripper follows within {1e3 * np.median(np.linalg.norm(errors, axis=1)):.1f} mm (median)")
figure, axes = plt.subplots(figsize=(9, 3.2), layout="constrained")
time = dt * np.arange(len(log))
axes.fill_between(time, 0, 1, where=pressed, transform=axes.get_xaxis_transform(), alpha=0.12, label="clutch pressed")
axes.plot(time, 100 * (goals + errors), label=["gripper x", "gripper y", "gripper z"])
axes.set_prop_cycle(None)
axes.plot(time, 100 * goals, ls=":")
axes.set(xlabel="time [s]", ylabel="[cm]", title="Gripper (lines) and its target (dots)")
axes.legend(ncols=4)
figure.savefig("so101_teleoperation.png", dpi=110)
