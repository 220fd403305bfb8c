"""NAO with dynamics: figures again from MuJoCo alone."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from benchmarks.nao_physics import run_physics
from osik_jax.demo import _nao
from osik_jax.physics import build_world
from osik_jax.robot._mujoco import mujoco_poses

DT = 0.005


@pytest.fixture(scope="module")
def lift():
    """The single-support motion of 8 s at 200 Hz, and its run."""
    motion = _nao.single_support()
    return motion, run_physics(motion, "weighted", dt=DT)


@pytest.mark.release
def test_single_support_reaches_its_numbers(lift):
    """What is wanted: 1 cm, 3 degrees and 5 mm, from the sensed configurations."""
    motion, run = lift
    q, plan = run.recording.q, run.plan.q
    assert len(q) == len(plan) == 1601
    height = np.abs(q[:, 2] - plan[:, 2])
    turns = Rotation.from_quat(q[:, [4, 5, 6, 3]]) * Rotation.from_quat(plan[:, [4, 5, 6, 3]]).inv()
    tilt = np.degrees(turns.magnitude())
    time = DT * np.arange(len(q))
    along = mujoco_poses(motion.robot, q)
    soles = np.array([[data.site(foot).xpos.copy() for foot in ("l_sole", "r_sole")] for data in along])
    moved = np.linalg.norm((soles - soles[:1])[..., :2], axis=-1)
    lifted = (time > motion.stances[1].lifted[0]) & (time < motion.stances[1].lifted[1])
    assert height.max() <= 0.01 and tilt.max() <= 3.0
    assert moved[:, 0].max() <= 0.005 and moved[~lifted, 1].max() <= 0.005
    assert soles[780, 1, 2] - soles[0, 1, 2] > 0.05
    assert not run.recording.fell and (run.solution.status == 0).all()
    assert run.height_error.max() == pytest.approx(height.max(), rel=1e-9)
    assert np.degrees(run.tilt_error.max()) == pytest.approx(tilt.max(), rel=1e-6)


@pytest.mark.slow
def test_forces_are_those_of_the_motion(lift):
    """The floor carries the weight on the foot that stands, under the centre of mass, within friction."""
    motion, run = lift
    forces, points = run.recording.contact_forces, run.recording.contact_points
    weight = 9.81 * float(motion.robot.body_mass.sum())
    total = forces[..., 2].sum(-1)
    assert total[1:].mean() == pytest.approx(weight, rel=2e-3)
    in_the_air = slice(600, 1000)
    np.testing.assert_array_equal(forces[in_the_air, 4:], 0.0)
    assert (np.linalg.norm(forces[..., :2], axis=-1) <= 0.9 * forces[..., 2] * (1.0 + 1e-6) + 1e-9).all()
    com = np.array([data.subtree_com[1].copy() for data in mujoco_poses(motion.robot, run.recording.q)])
    np.testing.assert_allclose(run.recording.com, com, atol=1e-5)  # the sim's joints are geared, not one
    pressure = (forces[..., 2:] * points[..., :2]).sum(1)[in_the_air] / total[in_the_air, None]
    np.testing.assert_allclose(pressure.mean(0), com[in_the_air, :2].mean(0), atol=2e-3)
    hull = ConvexHull(points[700, :4, :2]).equations
    inside = -(hull[:, :2] @ pressure[100] + hull[:, 2]).max()
    assert inside > 0.0


@pytest.mark.slow
def test_torques_are_held_against_the_motors(lift):
    motion, run = lift
    model = motion.robot.mj_model
    limits = np.array([model.actuator(joint).forcerange[1] for joint in build_world(motion.robot).servos])
    used = np.abs(run.recording.effort) / limits
    np.testing.assert_allclose(run.effort_used, used.max(-1), rtol=1e-12)
    assert used.max() <= 1.0 + 1e-9
