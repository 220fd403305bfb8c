"""Ours and the peers', from poses to configurations in Pinocchio's order of joints."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable
from typing import Any

import mink
import mujoco
import numpy as np
import pink
import pinocchio as pin

import osik_jax as osik

from ..processes import ROOT, PeerUnavailable
from ._arms import Arm, Poses

POSITION, ORIENTATION = 1e-3, 1e-2
"""What counts as found [m, rad]."""
STEPS, STARTS = 100, 8
"""Of the peers: steps of one search, and how many there are at most."""
Answer = tuple[np.ndarray, np.ndarray, float]
"""Configurations, which of them are called found, and seconds."""


def ours(arm: Arm, poses: Poses, **settings: Any) -> Answer:
    """One call for all poses, after one that compiles."""
    robot = osik.Robot.from_urdf(arm.urdf, floating_base=False)
    order = [robot.joint_qpos_index(name) for name in arm.joints]
    given = {arm.frame: (poses.positions, poses.rotations)}
    tolerances = dict(position_tolerance=POSITION, orientation_tolerance=ORIENTATION)

    def find() -> osik.InverseKinematicsSolution:
        return osik.inverse_kinematics(robot, given, **tolerances, **settings)

    find()
    start = time.perf_counter()
    found = find()
    q, converged = np.asarray(found.q), np.asarray(found.converged)
    return q[:, order].astype(float), converged, time.perf_counter() - start


def ours_one_by_one(arm: Arm, poses: Poses) -> Answer:
    """A call for each pose, as from a program that has one."""
    robot = osik.Robot.from_urdf(arm.urdf, floating_base=False)
    order = [robot.joint_qpos_index(name) for name in arm.joints]

    def find(i: int) -> osik.InverseKinematicsSolution:
        pose = {arm.frame: (poses.positions[i], poses.rotations[i])}
        return osik.inverse_kinematics(robot, pose, position_tolerance=POSITION, orientation_tolerance=ORIENTATION)

    find(0)
    start = time.perf_counter()
    found = [find(i) for i in range(len(poses.positions))]
    q, converged = np.array([f.q for f in found]), np.array([bool(f.converged) for f in found])
    return q[:, order].astype(float), converged, time.perf_counter() - start


def with_mink(arm: Arm, poses: Poses) -> Answer:
    """Its closed loop without limits on speeds, from the middle of the ranges, then from random configurations."""
    model = mujoco.MjModel.from_xml_string(bodies_for_mujoco(arm.urdf))
    order = [int(model.joint(name).qposadr[0]) for name in arm.joints]
    configuration, limits = mink.Configuration(model), [mink.ConfigurationLimit(model, gain=1.0)]
    task = mink.FrameTask(arm.frame, "body", 1.0, 1.0, lm_damping=1.0)

    def search(start: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, bool]:
        q = np.empty(model.nq)
        q[order] = start
        configuration.update(q)
        task.set_target(mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(rotation), position))
        for _ in range(STEPS):
            v = mink.solve_ik(configuration, [task], 1.0, "daqp", damping=1e-9, limits=limits)
            configuration.integrate_inplace(v, 1.0)
            error = task.compute_error(configuration)
            if np.linalg.norm(error[:3]) < POSITION / 2 and np.linalg.norm(error[3:]) < ORIENTATION / 2:
                return configuration.q[order].copy(), True
        return configuration.q[order].copy(), False

    return _from_several_starts(arm, poses, search)


def with_pink(arm: Arm, poses: Poses) -> Answer:
    """Likewise."""
    data = arm.model.createData()
    task = pink.FrameTask(arm.frame, 1.0, 1.0, lm_damping=1.0)
    limits = [pink.limits.ConfigurationLimit(arm.model, config_limit_gain=1.0)]

    def search(start: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, bool]:
        configuration = pink.Configuration(arm.model, data, start, copy_data=False)
        task.set_target(pin.SE3(rotation, position))
        for _ in range(STEPS):
            v = pink.solve_ik(
                configuration, [task], 1.0, solver="daqp", damping=1e-9, limits=limits, safety_break=False
            )
            configuration.integrate_inplace(v, 1.0)
            error = task.compute_error(configuration)
            if np.linalg.norm(error[:3]) < POSITION / 2 and np.linalg.norm(error[3:]) < ORIENTATION / 2:
                return configuration.q.copy(), True
        return configuration.q.copy(), False

    return _from_several_starts(arm, poses, search)


def with_pytracik(arm: Arm, poses: Poses, python: str) -> tuple[Answer, str]:
    """TRAC-IK in the environment of an interpreter, and the version of pytracik.

    Raises:
        PeerUnavailable: it did not answer; the message is its last line.
    """
    question = dict(
        urdf=arm.urdf,
        base=arm.root,
        frame=arm.frame,
        lower=arm.lower.tolist(),
        upper=arm.upper.tolist(),
        positions=poses.positions.tolist(),
        rotations=poses.rotations.tolist(),
        tolerance=POSITION / 2.0,
    )
    command = [python, "-m", "benchmarks.ik.with_pytracik"]
    try:
        done = subprocess.run(command, input=json.dumps(question), capture_output=True, text=True, cwd=ROOT)
    except OSError as error:
        raise PeerUnavailable(f"{python}: {error.strerror}") from None
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.strip()]
        raise PeerUnavailable(said[-1] if said else "it ended without a word")
    answer = json.loads(done.stdout)
    return (np.array(answer["q"]), np.array(answer["found"]), answer["seconds"]), answer["version"]


def _from_several_starts(
    arm: Arm, poses: Poses, search: Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, bool]]
) -> Answer:
    rng = np.random.default_rng(1)
    q, converged = np.empty((len(poses.positions), arm.model.nq)), np.zeros(len(poses.positions), bool)
    start = time.perf_counter()
    for i, (position, rotation) in enumerate(zip(poses.positions, poses.rotations, strict=True)):
        for attempt in range(STARTS):
            share = 0.5 if attempt == 0 else rng.random(arm.model.nq)
            try:
                q[i], converged[i] = search(arm.lower + (arm.upper - arm.lower) * share, position, rotation)
            except (mink.MinkError, pink.exceptions.PinkError):
                continue
            if converged[i]:
                break
    return q, converged, time.perf_counter() - start


def bodies_for_mujoco(urdf: str) -> str:
    """With links that are fixed to others kept as bodies, and masses where there are none."""
    spec = mujoco.MjSpec.from_string(urdf)
    spec.compiler.fusestatic = False
    spec.compiler.boundmass, spec.compiler.boundinertia = 1e-3, 1e-6
    spec.compile()
    return spec.to_xml()
