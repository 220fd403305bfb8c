"""Motions of NAO with full dynamics, and their figures from MuJoCo's data."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np
import scipy.spatial
from jaxtyping import Float

from ..physics import Integrated, Recording, Servo, Simulation, World, build_world, simulate
from ..robot import Robot
from ..robot._tree import HINGE
from ..tasks import PostureTask, Task
from ._measure import margins, measure
from ._motion import Motion
from ._report import Outcome
from ._run import Run, run_scheme
from ._schemes import make_scheme

LEGS = Servo(stiffness=150.0, damping=5.0)
"""Position servos of NAO's legs at the torque limits of its motors; other servos are those of its model."""
LEG_JOINTS = ("*Hip*", "*Knee*", "*Ankle*")
FEEDBACK_GAIN = 5.0
"""Gain of all tasks but the posture [1/s] that the servos follow without oscillation; the kinematic loop uses 20."""


def nao_world(robot: Robot, *, timestep: float = 0.001) -> World:
    """Return NAO on a floor, standing on its plastic soles, which extend 10 to 20 mm beyond its force sensors."""
    return build_world(robot, servos=dict.fromkeys(LEG_JOINTS, LEGS), timestep=timestep)


def with_feedback_gain(tasks: Mapping[str, Task], gain: float = FEEDBACK_GAIN) -> dict[str, Task]:
    """Return the tasks with another gain [1/s], except the posture."""
    return {k: t if isinstance(t, PostureTask) else t.replace(gain=gain) for k, t in tasks.items()}


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
        com_margin: distance of the centre of mass inside the hull of the soles that stand in the plan [m]. (T,)
        effort_used: largest effort of a servo relative to its limit. (T,)
        busiest: name of the joint with that effort.
        saturated: number of servos times steps at their limit.
        beyond_limits: largest excess of a sensed hinge beyond its position limits [rad], 0 inside. (T,)
        furthest: name of the hinge with that excess; ``None`` without any.
        fell: time of the fall [s], or ``None``.
    """

    height_error: Float[np.ndarray, " T"]
    tilt_error: Float[np.ndarray, " T"]
    slip: dict[str, Float[np.ndarray, " T"]]
    contact_slip: dict[str, float]
    pressure_margin: Float[np.ndarray, " T"]
    com_margin: Float[np.ndarray, " T"]
    effort_used: Float[np.ndarray, " T"]
    busiest: str
    saturated: int
    beyond_limits: Float[np.ndarray, " T"]
    furthest: str | None
    fell: float | None


@dataclasses.dataclass(frozen=True)
class PhysicsRun:
    """Motion of one scheme with dynamics.

    Attributes:
        world: the simulated world.
        plan: the kinematic motion used as a reference.
        run: the sensed motion, measured like the kinematic one.
        recording: the recorded data.
        physics: figures of the simulated motion.
    """

    world: World
    plan: Run
    run: Run
    recording: Recording
    physics: PhysicsMeasurement


def run_physics(motion: Motion, scheme: str, *, dt: float, world: World | None = None) -> PhysicsRun:
    """Run the kinematic motion as a plan, then the same tasks in closed loop with MuJoCo.

    Args:
        motion: of NAO, or of another robot with ``world``.
        scheme: a name from ``SCHEMES``.
        dt: control period [s].
        world: default: ``nao_world``, its timestep the greatest part of ``dt`` up to 1 ms.

    Raises:
        KeyError: no such scheme.
        ValueError: ``dt`` is no whole number of the timesteps of ``world``.
    """
    plan = run_scheme(motion, scheme, dt=dt)
    # the timestep is the largest divisor of dt up to 1 ms; 1e-9 keeps an exact divisor from being rounded up
    simulation = Simulation(world or nao_world(motion.robot, timestep=dt / math.ceil(dt / 0.001 - 1e-9)), motion.q0)
    # sensed errors of the feet are those of servos and contacts: no step of the kinematics leaves them out
    own = make_scheme(scheme).replace(curvature_damping=0.0)
    settings = dict(scheme=own, limits=motion.limits, dt=dt, command=Integrated())
    start = time.perf_counter()
    tasks = _slow(motion)
    simulate(simulation, tasks, steps=1, **settings)
    simulation.reset(motion.q0)
    compiled = time.perf_counter()
    recording = simulate(simulation, tasks, steps=round(motion.duration / dt), **settings)
    solution = recording.solution
    outcome = Outcome(
        compile_seconds=compiled - start,
        run_seconds=time.perf_counter() - compiled,
        status=np.asarray(solution.status),
        iterations=np.asarray(solution.iterations),
        kkt_residual=np.asarray(solution.kkt_residual),
    )
    run = Run(scheme, recording.q, np.asarray(solution.velocity), outcome, measure(motion, recording.q, dt))
    physics = measure_physics(motion, simulation.world, recording, plan.q)
    return PhysicsRun(simulation.world, plan, run, recording, physics)


def _slow(motion: Motion) -> Callable[[Any], dict[str, Task]]:
    """Return the tasks of a motion with the gain that servos can follow."""
    return lambda t: with_feedback_gain(motion.tasks(t))


def measure_physics(
    motion: Motion, world: World, recording: Recording, plan: Float[np.ndarray, "T nq"]
) -> PhysicsMeasurement:
    """Compare a recording with the plan over the time that it lasts."""
    base = next(world.robot.tree.qpos_address[j] for j in world.robot.tree.independent)
    is_, wanted = recording.q[:, base : base + 7], plan[: len(recording.q), base : base + 7]
    standing = {s.frame: s.on_ground(recording.time) for s in motion.stances}
    touching = {foot: _touches(_of_foot(world, recording, foot)[1]) for foot in standing}
    used = np.abs(recording.effort) / np.array([servo.effort for servo in world.servos.values()])
    hinges, beyond = _beyond_limits(world.robot, recording.q)
    return PhysicsMeasurement(
        height_error=np.abs(is_[:, 2] - wanted[:, 2]),
        tilt_error=_turn(is_[:, 3:], wanted[:, 3:]),
        slip={foot: np.where(down, _slip(world, recording, foot), np.nan) for foot, down in standing.items()},
        contact_slip={foot: _contact_slip(*_of_foot(world, recording, foot)) for foot in standing},
        pressure_margin=_margins(_pressure(recording), _hulls(world, recording, touching)),
        com_margin=_margins(recording.com[:, :2], _hulls(world, recording, standing)),
        effort_used=used.max(-1),
        busiest=list(world.servos)[int(used.max(0).argmax())],
        # MuJoCo clips efforts to the limit, so a saturated servo has a ratio of 1 up to rounding
        saturated=int((used >= 1.0 - 1e-9).sum()),
        beyond_limits=beyond.max(-1, initial=0.0),
        furthest=hinges[int(beyond.max(0).argmax())] if beyond.any() else None,
        fell=float(recording.time[-1]) if recording.fell else None,
    )


def _beyond_limits(robot: Robot, q: Float[np.ndarray, "T nq"]) -> tuple[list[str], Float[np.ndarray, "T n"]]:
    """Return the names of the independent hinges, and the excess of each beyond its limits [rad]. (T, k)."""
    tree = robot.tree
    hinges = [j for j in tree.dof_address if tree.joint_types[j] == HINGE]
    angle, dof = q[:, [tree.qpos_address[j] for j in hinges]], [tree.dof_address[j] for j in hinges]
    lower, upper = np.asarray(robot.position_lower)[dof], np.asarray(robot.position_upper)[dof]
    return [tree.joint_names[j] for j in hinges], np.maximum(np.maximum(lower - angle, angle - upper), 0.0)


def _turn(a: Float[np.ndarray, "T 4"], b: Float[np.ndarray, "T 4"]) -> Float[np.ndarray, " T"]:
    """Return the angle between unit quaternions [rad]."""
    out, difference = np.zeros(len(a)), np.zeros(3)
    for k, (x, y) in enumerate(zip(a, b, strict=True)):
        mujoco.mju_subQuat(difference, x, y)
        out[k] = np.linalg.norm(difference)
    return out


def _of_foot(world: World, recording: Recording, foot: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the contact points (T, k, 3) and forces (T, k, 3) of one foot."""
    ends = np.cumsum([0, *(len(points) for points in world.feet.values())])
    first = list(world.feet).index(foot)
    part = slice(ends[first], ends[first + 1])
    return recording.contact_points[:, part], recording.contact_forces[:, part]


def _touches(forces: Float[np.ndarray, "T k 3"]) -> np.ndarray:
    """Return whether the floor exerts a force on any of the points. (T,)."""
    return np.max(forces[..., 2], axis=-1) > 0.0


def _slip(world: World, recording: Recording, foot: str) -> Float[np.ndarray, " T"]:
    points, _ = _of_foot(world, recording, foot)
    return np.linalg.norm((points - points[:1])[..., :2], axis=-1).max(-1)


def _contact_slip(points: Float[np.ndarray, "T k 3"], forces: Float[np.ndarray, "T k 3"]) -> float:
    """Return the largest distance [m] that a point moves over the floor during one uninterrupted contact."""
    worst = 0.0
    for place, touching in zip(np.moveaxis(points[..., :2], 1, 0), (forces[..., 2] > 0.0).T, strict=True):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], touching, [False]]).astype(int)))
        for start, end in edges.reshape(-1, 2):
            worst = max(worst, float(np.linalg.norm(place[start:end] - place[start], axis=-1).max()))
    return worst


def _hulls(world: World, recording: Recording, down: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Return, per time, the hull vertices of the soles that should stand, counter-clockwise; (0, 2) without any."""
    feet = {foot: _of_foot(world, recording, foot)[0][..., :2] for foot in down}
    out = []
    for k in range(len(recording.time)):
        points = [feet[foot][k] for foot, on in down.items() if on[k]]
        soles = np.concatenate(points) if points else np.zeros((0, 2))
        out.append(soles[scipy.spatial.ConvexHull(soles).vertices] if points else soles)
    return out


def _pressure(recording: Recording) -> Float[np.ndarray, "T 2"]:
    """Return the centre of pressure on the floor [m]; NaN without contact. (T, 2)."""
    weight = recording.contact_forces[..., 2:]
    total = weight.sum(1)
    return (weight * recording.contact_points[..., :2]).sum(1) / np.where(total > 0.0, total, np.nan)


def _margins(points: Float[np.ndarray, "T 2"], hulls: list[np.ndarray]) -> Float[np.ndarray, " T"]:
    """Return the least signed distance to the hull's edge lines [m], positive inside; NaN without a hull. (T,)."""
    out = np.full(len(points), np.nan)
    for k, vertices in enumerate(hulls):
        if len(vertices):
            out[k] = margins(points[k : k + 1], [vertices])[0]
    return out
