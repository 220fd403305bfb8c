"""Motions of NAO with full dynamics, and their figures from MuJoCo's data."""

from __future__ import annotations

import dataclasses
import math
import time
from typing import Any

import jax
import mujoco
import numpy as np
from jaxtyping import Float

from ..physics import Servo, Simulation, build_world, simulate
from ..physics._loop import Recording
from ..physics._world import World
from ..robot import Robot
from ..robot._tree import HINGE
from ..tasks import PostureTask, Task
from ..tasks._polygon import hull
from ._measure import margins, measure
from ._motion import Motion
from ._run import Run, make_scheme, run_scheme

_LEGS: dict[str, Servo] = dict.fromkeys(("*Hip*", "*Knee*", "*Ankle*"), Servo(stiffness=150.0, damping=5.0))
"""Position servos of NAO's legs at the torque limits of its motors; other servos are those of its model."""
FEEDBACK_GAIN = 5.0
"""Gain of all tasks but the posture [1/s] that the servos follow without oscillation; the kinematic loop uses 20."""


@dataclasses.dataclass(frozen=True)
class PhysicsMeasurement:
    """Figures of a simulated motion, from MuJoCo's data; T is shorter if the robot fell.

    Attributes:
        height_error: height of the base minus that of the plan [m]. (T,)
        tilt_error: angle of the rotation between the base and the plan [rad]. (T,)
        slip: per foot, the largest horizontal distance of its contact points from their first places [m]; NaN while the
            plan lifts it. (T,) each
        contact_slip: per foot, the largest distance that a point moved over the floor during a contact [m].
        pressure_margin: distance of the centre of pressure inside the hull of the soles in contact [m]; NaN without
            contact. (T,)
        effort_used: largest effort of a servo relative to its limit. (T,)
        busiest: name of the joint with that effort.
        beyond_limits: largest excess of a sensed hinge beyond its position limits [rad], 0 inside. (T,)
        fell: time of the fall [s], or ``None``.
    """

    height_error: Float[np.ndarray, " T"]
    tilt_error: Float[np.ndarray, " T"]
    slip: dict[str, Float[np.ndarray, " T"]]
    contact_slip: dict[str, float]
    pressure_margin: Float[np.ndarray, " T"]
    effort_used: Float[np.ndarray, " T"]
    busiest: str
    beyond_limits: Float[np.ndarray, " T"]
    fell: float | None


@dataclasses.dataclass(frozen=True)
class PhysicsRun(Run):
    """Motion of one scheme with dynamics: its configurations are sensed, and measured like those of the plan.

    Attributes:
        world: the simulated world.
        plan: the kinematic motion used as a reference.
        recording: the recorded data.
        physics: figures of the simulated motion.
    """

    world: World
    plan: Run
    recording: Recording
    physics: PhysicsMeasurement


def run_physics(motion: Motion, scheme: str, *, dt: float) -> PhysicsRun:
    """Run the kinematic motion as a plan, then the same tasks in closed loop with MuJoCo.

    NAO stands on its plastic soles, which extend 10 to 20 mm beyond its force sensors.

    Args:
        motion: of NAO.
        scheme: ``"weighted"``, ``"null-space"`` or ``"hierarchical"``.
        dt: control period [s].

    Raises:
        KeyError: no such scheme.
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
    return PhysicsRun(
        scheme=scheme,
        q=recording.q,
        solution=jax.tree.map(np.asarray, recording.solution),
        compile_seconds=compiled - start,
        run_seconds=time.perf_counter() - compiled,
        measurement=measure(motion, recording.q, dt),
        world=world,
        plan=plan,
        recording=recording,
        physics=measure_physics(motion, world, recording, plan.q),
    )


def measure_physics(
    motion: Motion, world: World, recording: Recording, plan: Float[np.ndarray, "T nq"]
) -> PhysicsMeasurement:
    """Compare a recording with the plan over the time that it lasts."""
    base = next(world.robot.tree.qpos_address[j] for j in world.robot.tree.independent)
    is_, wanted = recording.q[:, base : base + 7], plan[: len(recording.q), base : base + 7]
    ends = np.cumsum([len(points) for points in world.feet.values()])[:-1]
    parts = (np.split(array, ends, 1) for array in (recording.contact_points, recording.contact_forces))
    feet = dict(zip(world.feet, zip(*parts, strict=True), strict=True))
    slip = {s.frame: _slip(feet[s.frame][0], s.on_ground(recording.time)) for s in motion.stances}
    used = np.abs(recording.effort) / np.array([servo.effort for servo in world.servos.values()])
    return PhysicsMeasurement(
        height_error=np.abs(is_[:, 2] - wanted[:, 2]),
        tilt_error=_turn(is_[:, 3:], wanted[:, 3:]),
        slip=slip,
        contact_slip={foot: _contact_slip(*of_foot) for foot, of_foot in feet.items()},
        pressure_margin=_pressure_margin(list(feet.values())),
        effort_used=used.max(-1),
        busiest=list(world.servos)[int(used.max(0).argmax())],
        beyond_limits=_beyond_limits(world.robot, recording.q),
        fell=float(recording.time[-1]) if recording.fell else None,
    )


def _beyond_limits(robot: Robot, q: Float[np.ndarray, "T nq"]) -> Float[np.ndarray, " T"]:
    """Return the largest excess of an independent hinge beyond its limits [rad]."""
    tree = robot.tree
    hinges = [j for j in tree.dof_address if tree.joint_types[j] == HINGE]
    angle, dof = q[:, [tree.qpos_address[j] for j in hinges]], [tree.dof_address[j] for j in hinges]
    lower, upper = np.asarray(robot.position_lower)[dof], np.asarray(robot.position_upper)[dof]
    return np.maximum(lower - angle, angle - upper).max(-1, initial=0.0)


def _turn(a: Float[np.ndarray, "T 4"], b: Float[np.ndarray, "T 4"]) -> Float[np.ndarray, " T"]:
    """Return the angle between unit quaternions [rad]."""
    out, difference = np.zeros(len(a)), np.zeros(3)
    for k, (x, y) in enumerate(zip(a, b, strict=True)):
        mujoco.mju_subQuat(difference, x, y)
        out[k] = np.linalg.norm(difference)
    return out


def _slip(points: Float[np.ndarray, "T k 3"], standing: np.ndarray) -> Float[np.ndarray, " T"]:
    """Return the largest horizontal distance of the points from their first places [m], NaN in the air."""
    return np.where(standing, np.linalg.norm((points - points[:1])[..., :2], axis=-1).max(-1), np.nan)


def _contact_slip(points: Float[np.ndarray, "T k 3"], forces: Float[np.ndarray, "T k 3"]) -> float:
    """Return the largest distance [m] that a point moves over the floor during one uninterrupted contact."""
    worst = 0.0
    for place, touching in zip(np.moveaxis(points[..., :2], 1, 0), (forces[..., 2] > 0.0).T, strict=True):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], touching, [False]]).astype(int)))
        for start, end in edges.reshape(-1, 2):
            worst = max(worst, float(np.linalg.norm(place[start:end] - place[start], axis=-1).max()))
    return worst


def _pressure_margin(
    feet: list[tuple[Float[np.ndarray, "T k 3"], Float[np.ndarray, "T k 3"]]],
) -> Float[np.ndarray, " T"]:
    """Return the distance of the centre of pressure inside the hull of the soles in contact [m]; NaN without contact.

    Each foot has its contact points and the forces of the floor on them.
    """
    points = np.concatenate([p[..., :2] for p, _ in feet], 1)
    weights = np.concatenate([f[..., 2:] for _, f in feet], 1)
    total = weights.sum(1)
    pressure = (weights * points).sum(1) / np.where(total > 0.0, total, np.nan)
    soles = [[p[k, :, :2] for p, f in feet if f[k, :, 2].max() > 0.0] for k in range(len(points))]
    return margins(pressure, [hull(np.concatenate(down)) if down else None for down in soles])
