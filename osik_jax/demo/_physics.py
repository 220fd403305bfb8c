"""NAO's motions with the full dynamics, and what MuJoCo's data say of them."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import scipy.spatial
from jaxtyping import Float

from ..physics import Integrated, Recording, Servo, Simulation, World, build_world, simulate
from ..robot import Robot
from ..tasks import PostureTask, Task
from ._measure import measure
from ._motion import Motion
from ._report import Outcome
from ._run import Run, run_scheme
from ._schemes import make_scheme

LEGS = Servo(stiffness=150.0, damping=5.0)
"""Position servos of NAO's legs, at the torque limits of its motors; the others are as in its model."""
LEG_JOINTS = ("*Hip*", "*Knee*", "*Ankle*")
FEEDBACK_GAIN = 5.0
"""[1/s], of all tasks but the posture: what the servos follow without swinging, where the kinematic loop takes 20."""
HEIGHT, TILT, SLIP = 0.01, np.radians(3.0), 0.005
"""What has to be reached: base height off plan [m], base turned off plan [rad], a standing foot off its place [m]."""


def nao_world(robot: Robot, *, timestep: float = 0.001) -> World:
    """NAO on a floor, standing on its plastic soles, which reach 10 to 20 mm beyond its force sensors."""
    return build_world(robot, servos=dict.fromkeys(LEG_JOINTS, LEGS), timestep=timestep)


def with_feedback_gain(tasks: Mapping[str, Task], gain: float = FEEDBACK_GAIN) -> dict[str, Task]:
    """The same tasks with another gain [1/s], the posture aside."""
    return {k: t if isinstance(t, PostureTask) else t.replace(gain=gain) for k, t in tasks.items()}


@dataclasses.dataclass(frozen=True)
class PhysicsMeasurement:
    """What a simulated motion achieved, all of it from MuJoCo's data; T ends early where the robot fell.

    Attributes:
        height_error: of the base against the plan [m]. (T,)
        tilt_error: angle between the base and the plan, all three axes together [rad]. (T,)
        slip: foot to the greatest distance, over the floor, of its contact points from where they stood at first [m];
            nan while the plan has it in the air. Each (T,)
        contact_slip: foot to the greatest distance that a point moved over the floor while it touched it [m].
        pressure_margin: of the centre of pressure inside the hull of the soles that the plan has on the floor [m];
            nan where nothing touches. (T,)
        com_margin: the same of the centre of mass, positive inside [m]. (T,)
        effort_used: the greatest part of its limit that any servo exerts. (T,)
        busiest: the joint with the greatest part.
        saturated: servos times ticks at their limit.
        fell: when the robot fell [s], or ``None``.
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
    fell: float | None


@dataclasses.dataclass(frozen=True)
class PhysicsRun:
    """One scheme's motion with dynamics.

    Attributes:
        plan: the kinematic motion that it is compared with.
        run: the sensed motion, judged as the kinematic one is.
        recording: all that was recorded.
        physics: what came of it.
    """

    plan: Run
    run: Run
    recording: Recording
    physics: PhysicsMeasurement


def run_physics(motion: Motion, scheme: str, *, dt: float, world: World | None = None) -> PhysicsRun:
    """The kinematic motion as the plan, then the same tasks in closed loop with MuJoCo.

    Args:
        motion: of NAO, or of another robot with ``world``.
        scheme: a name from ``SCHEMES``.
        dt: control period [s], a whole number of the world's timesteps.
        world: default: ``nao_world``.

    Raises:
        KeyError: no such scheme.
        ValueError: ``dt`` is no whole number of timesteps.
    """
    plan = run_scheme(motion, scheme, dt=dt)
    simulation = Simulation(world or nao_world(motion.robot), motion.q0)
    start = time.perf_counter()
    recording = simulate(
        simulation,
        lambda t: with_feedback_gain(motion.tasks(t)),
        scheme=make_scheme(scheme),
        limits=motion.limits,
        dt=dt,
        steps=round(motion.duration / dt),
        command=Integrated(),
    )
    solution = recording.solution
    outcome = Outcome(
        compile_seconds=0.0,
        run_seconds=time.perf_counter() - start,
        status=np.asarray(solution.status),
        iterations=np.asarray(solution.iterations),
        kkt_residual=np.asarray(solution.kkt_residual),
    )
    velocity = np.asarray(solution.velocity)
    run = Run(scheme, recording.q, velocity, outcome, measure(motion, recording.q, dt))
    return PhysicsRun(plan, run, recording, measure_physics(motion, simulation.world, recording, plan.q))


def measure_physics(
    motion: Motion, world: World, recording: Recording, plan: Float[np.ndarray, "T nq"]
) -> PhysicsMeasurement:
    """Judges a recording against the plan, for as long as it lasts."""
    base = next(world.robot.tree.qpos_address[j] for j in world.robot.tree.independent)
    is_, wanted = recording.q[:, base : base + 7], plan[: len(recording.q), base : base + 7]
    standing = {s.frame: s.on_ground(recording.time) for s in motion.stances}
    hulls = _hulls(world, recording, standing)
    used = np.abs(recording.effort) / np.array([servo.effort for servo in world.servos.values()])
    return PhysicsMeasurement(
        height_error=np.abs(is_[:, 2] - wanted[:, 2]),
        tilt_error=_turn(is_[:, 3:], wanted[:, 3:]),
        slip={foot: np.where(down, _slip(world, recording, foot), np.nan) for foot, down in standing.items()},
        contact_slip={foot: _contact_slip(*_of_foot(world, recording, foot)) for foot in standing},
        pressure_margin=_margins(_pressure(recording), hulls),
        com_margin=_margins(recording.com[:, :2], hulls),
        effort_used=used.max(-1),
        busiest=list(world.servos)[int(used.max(0).argmax())],
        saturated=int((used >= 1.0 - 1e-9).sum()),
        fell=float(recording.time[-1]) if recording.fell else None,
    )


def _turn(a: Float[np.ndarray, "T 4"], b: Float[np.ndarray, "T 4"]) -> Float[np.ndarray, " T"]:
    """Angle between unit quaternions."""
    out, difference = np.zeros(len(a)), np.zeros(3)
    for k, (x, y) in enumerate(zip(a, b, strict=True)):
        mujoco.mju_subQuat(difference, x, y)
        out[k] = np.linalg.norm(difference)
    return out


def _of_foot(world: World, recording: Recording, foot: str) -> tuple[np.ndarray, np.ndarray]:
    """Contact points (T, k, 3) and forces (T, k, 3) of one foot."""
    ends = np.cumsum([0, *(len(points) for points in world.feet.values())])
    first = list(world.feet).index(foot)
    part = slice(ends[first], ends[first + 1])
    return recording.contact_points[:, part], recording.contact_forces[:, part]


def _slip(world: World, recording: Recording, foot: str) -> Float[np.ndarray, " T"]:
    points, _ = _of_foot(world, recording, foot)
    return np.linalg.norm((points - points[:1])[..., :2], axis=-1).max(-1)


def _contact_slip(points: Float[np.ndarray, "T k 3"], forces: Float[np.ndarray, "T k 3"]) -> float:
    """Over all points, and all times in which one touches the floor without a break."""
    worst = 0.0
    for place, touching in zip(np.moveaxis(points[..., :2], 1, 0), (forces[..., 2] > 0.0).T, strict=True):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], touching, [False]]).astype(int)))
        for start, end in edges.reshape(-1, 2):
            worst = max(worst, float(np.linalg.norm(place[start:end] - place[start], axis=-1).max()))
    return worst


def _hulls(world: World, recording: Recording, standing: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Vertices of the hull of the soles that stand, where they are at each time, counter-clockwise."""
    feet = {foot: _of_foot(world, recording, foot)[0][..., :2] for foot in standing}
    out = []
    for k in range(len(recording.time)):
        points = np.concatenate([feet[foot][k] for foot, down in standing.items() if down[k]])
        out.append(points[scipy.spatial.ConvexHull(points).vertices])
    return out


def _pressure(recording: Recording) -> Float[np.ndarray, "T 2"]:
    """Centre of pressure on the floor; nan where nothing touches."""
    weight = recording.contact_forces[..., 2:]
    total = weight.sum(1)
    return (weight * recording.contact_points[..., :2]).sum(1) / np.where(total > 0.0, total, np.nan)


def _margins(points: Float[np.ndarray, "T 2"], hulls: list[np.ndarray]) -> Float[np.ndarray, " T"]:
    """Least distance to the lines through the edges, positive inside."""
    out = []
    for point, vertices in zip(points, hulls, strict=True):
        edges = np.roll(vertices, -1, 0) - vertices
        inward = np.stack([-edges[:, 1], edges[:, 0]], -1) / np.linalg.norm(edges, axis=-1, keepdims=True)
        out.append(np.min(np.sum(inward * (point - vertices), -1)))
    return np.array(out)


def reached(physics: PhysicsMeasurement) -> dict[str, bool]:
    """What has to be reached, and whether it was."""
    return {
        "standing": physics.fell is None,
        "height": bool(physics.height_error.max() <= HEIGHT),
        "tilt": bool(physics.tilt_error.max() <= TILT),
        "slip": all(_worst(slip) <= SLIP for slip in physics.slip.values())
        and all(slip <= SLIP for slip in physics.contact_slip.values()),
    }


def _worst(values: Float[np.ndarray, " T"]) -> float:
    """The greatest that is no nan; 0 where there is none."""
    return float(np.nanmax(values, initial=0.0))


def physics_figures(physics: PhysicsMeasurement) -> dict[str, Any]:
    """For the report; lengths in mm, angles in degrees."""
    margin = physics.pressure_margin[~np.isnan(physics.pressure_margin)]
    return {
        "fell_at_s": physics.fell,
        "base_height_error_mm": 1e3 * float(physics.height_error.max()),
        "base_tilt_error_deg": float(np.degrees(physics.tilt_error.max())),
        "slip_mm": {foot: 1e3 * _worst(slip) for foot, slip in physics.slip.items()},
        "contact_slip_mm": {foot: 1e3 * slip for foot, slip in physics.contact_slip.items()},
        "least_pressure_margin_mm": 1e3 * float(margin.min()) if len(margin) else None,
        "least_com_margin_mm": 1e3 * float(physics.com_margin.min()),
        "greatest_effort_of_limit": float(physics.effort_used.max()),
        "busiest_joint": physics.busiest,
        "ticks_at_the_limit": physics.saturated,
        "reached": reached(physics),
    }
