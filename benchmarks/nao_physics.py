"""The motions of ``osik demo`` in MuJoCo, fed back from what is sensed: ``python -m benchmarks.nao_physics``.

Prints how far the base is off the kinematic motion, how far standing feet slip, and what the servos use.
"""

from __future__ import annotations

import dataclasses
import math
import time
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from osik_jax.demo._motion import Motion
from osik_jax.demo._nao import double_support, single_support
from osik_jax.demo._observed import observe
from osik_jax.demo._run import TITLES, Run, make_scheme, run_scheme
from osik_jax.physics import Servo, Simulation, build_world, simulate
from osik_jax.physics._loop import Recording
from osik_jax.runtime import configure_cpu
from osik_jax.tasks import PostureTask, Task

_LEGS: dict[str, Servo] = dict.fromkeys(("*Hip*", "*Knee*", "*Ankle*"), Servo(stiffness=150.0, damping=5.0))
"""Position servos of NAO's legs at the torque limits of its motors; other servos are those of its model."""
FEEDBACK_GAIN = 5.0
"""Gain of all tasks but the posture [1/s] that the servos follow without oscillation; the kinematic loop uses 20."""


@dataclasses.dataclass(frozen=True)
class PhysicsRun(Run):
    """Motion of one scheme with dynamics, whose configurations are sensed; T is shorter if the robot fell."""

    plan: Run  # the kinematic motion
    recording: Recording  # MuJoCo's data
    height_error: Float[np.ndarray, " T"]  # height of the base minus that of the plan [m]
    tilt_error: Float[np.ndarray, " T"]  # angle between the base and the plan [rad]
    effort_used: Float[np.ndarray, " T"]  # largest effort of a servo relative to its limit


def run_physics(motion: Motion, scheme: str, *, dt: float) -> PhysicsRun:
    """Run the kinematic motion as a plan, then the same tasks in closed loop with MuJoCo.

    NAO stands on its plastic soles, which extend 10 to 20 mm beyond its force sensors.
    """
    plan = run_scheme(motion, scheme, dt=dt)
    # the timestep is the largest divisor of dt up to 1 ms; 1e-9 keeps an exact divisor from being rounded up
    world = build_world(motion.robot, servos=_LEGS, timestep=dt / math.ceil(dt / 0.001 - 1e-9))
    simulation = Simulation(world, motion.q0)
    # sensed errors of the feet are those of servos and contacts: no step of the kinematics leaves them out
    own = make_scheme(scheme).replace(curvature_damping=0.0)

    def tasks(t: Any) -> dict[str, Task]:
        tasks = motion.tasks(t).items()
        return {k: task if isinstance(task, PostureTask) else task.replace(gain=FEEDBACK_GAIN) for k, task in tasks}

    start = time.perf_counter()
    simulate(simulation, tasks, scheme=own, dt=dt, steps=1)
    simulation.reset(motion.q0)
    compiled = time.perf_counter()
    recording = simulate(simulation, tasks, scheme=own, dt=dt, steps=round(motion.duration / dt))
    done = time.perf_counter()
    base = motion.robot.tree.qpos_address[motion.robot.tree.free_bases[0]]
    sensed, planned = (q[: len(recording.q), base : base + 7] for q in (recording.q, plan.q))
    limits = np.array([servo.effort for servo in world.servos.values()])
    return PhysicsRun(
        scheme=scheme,
        q=recording.q,
        solution=jax.tree.map(np.asarray, recording.solution),
        compile_seconds=compiled - start,
        run_seconds=done - compiled,
        seen=observe(motion, recording.q, dt),
        plan=plan,
        recording=recording,
        height_error=np.abs(sensed[:, 2] - planned[:, 2]),
        tilt_error=_angle(sensed[:, 3:], planned[:, 3:]),
        effort_used=(np.abs(recording.effort) / limits).max(-1),
    )


def _angle(a: Float[np.ndarray, "T 4"], b: Float[np.ndarray, "T 4"]) -> Float[np.ndarray, " T"]:
    """Return the angle between unit quaternions [rad], by the chord between them, which is accurate for small ones."""
    chord = np.minimum(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    return 4.0 * np.arcsin(0.5 * chord)


def main() -> None:
    """Runs both motions with each scheme."""
    for motion in (double_support(), single_support()):
        for scheme in TITLES:
            run = run_physics(motion, scheme, dt=0.005)
            height, tilt, effort = (a.max() for a in (run.height_error, run.tilt_error, run.effort_used))
            drift, inside = np.nanmax(run.seen.drift), run.seen.com_inside.min()
            print(
                f"{motion.name}, {scheme}: fell {run.recording.fell}; base at most {1e3 * height:.2f} mm and "
                f"{np.degrees(tilt):.2f} deg off the plan; feet {1e3 * drift:.2f} mm off their place; mass inside by "
                f"{1e3 * inside:.0f} mm; effort {effort:.2f} of the greatest"
            )


if __name__ == "__main__":
    configure_cpu()
    jax.config.update("jax_enable_x64", True)
    main()
