"""NAO with dynamics: figures of the report again from MuJoCo alone, and the judge on spoiled recordings."""

import dataclasses
import json
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from osik_jax import cli
from osik_jax.demo import _nao
from osik_jax.demo._demo import run_demo
from osik_jax.demo._figures import figures
from osik_jax.demo._physics import measure_physics
from osik_jax.demo._report import table
from osik_jax.physics import Servo
from osik_jax.viewer._mujoco import mujoco_poses

DT = 0.005


@pytest.fixture(scope="module")
def lift(tmp_path_factory):
    """The single-support motion of 8 s at 200 Hz: its motion, folder, report and run."""
    motion, folder = _nao.single_support(), tmp_path_factory.mktemp("physics")
    summary, _, runs = run_demo(motion, folder, schemes=("weighted",), dt=DT, physics=True, animation=False)
    return motion, folder, summary, runs[0]


def judged(motion, run, **changes) -> dict[str, Any]:
    """Figures of a recording with something changed: their worst values, and the names of those that miss."""
    recording = dataclasses.replace(run.recording, **changes)
    physics = measure_physics(motion, run.world, recording, run.plan.q)
    rows = figures(motion, dataclasses.replace(run, physics=physics))
    return {row.name: row.worst for row in rows} | {"missed": {row.name for row in rows if row.missed}}


@pytest.mark.release
def test_single_support_reaches_its_numbers(lift):
    """What is wanted: 1 cm, 3 degrees and 5 mm, from the sensed configurations."""
    motion, _, summary, run = lift
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
    told = summary["schemes"]["weighted"]
    assert told["falls"] == 0 and told["missed"] == []
    assert told["base_height_mm"] == pytest.approx(1e3 * height.max(), rel=1e-9)
    assert told["base_turn_deg"] == pytest.approx(tilt.max(), rel=1e-6)
    slip = max(moved[:, 0].max(), moved[~lifted, 1].max())
    assert told["feet_slip_mm"] == pytest.approx(1e3 * slip, abs=0.2)
    assert told["feet_slip_mm"] <= 5.0 and told["contact_slip_mm"] <= 5.0


@pytest.mark.slow
def test_forces_are_those_of_the_motion(lift):
    """The floor carries the weight on the foot that stands, under the centre of mass, within friction."""
    motion, _, summary, run = lift
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
    assert run.physics.pressure_margin[700] == pytest.approx(inside, abs=1e-9)
    assert summary["schemes"]["weighted"]["pressure_inside_mm"] == pytest.approx(
        1e3 * np.nanmin(run.physics.pressure_margin)
    )
    assert np.nanmin(run.physics.pressure_margin) > 0.0


@pytest.mark.slow
def test_torques_are_held_against_the_motors(lift):
    motion, _, summary, run = lift
    model = motion.robot.mj_model
    limits = np.array([model.actuator(joint).forcerange[1] for joint in run.world.servos])
    used = np.abs(run.recording.effort) / limits
    told = summary["schemes"]["weighted"]
    assert told["torque"] == pytest.approx(used.max())
    assert used.max() <= 1.0 + 1e-9
    assert told["busiest_joint"] == list(run.world.servos)[int(used.max(0).argmax())]


@pytest.mark.slow
def test_sensed_joints_are_held_against_their_limits(lift):
    """Against the ranges of MuJoCo's model, hinge by hinge."""
    motion, _, summary, run = lift
    model = motion.robot.mj_model
    qpos = np.array([data.qpos.copy() for data in mujoco_poses(motion.robot, run.recording.q)])
    hinges = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    angle, (lower, upper) = qpos[:, model.jnt_qposadr[hinges]], model.jnt_range[hinges].T
    beyond = np.degrees(np.maximum(np.maximum(lower - angle, angle - upper), 0.0))
    assert summary["schemes"]["weighted"]["beyond_limits_deg"] == pytest.approx(beyond.max(), rel=1e-9)
    assert 0.0 < beyond.max() < 0.5
    within = run.recording.q.copy()
    within[:] = np.asarray(motion.q0)
    assert judged(motion, run, q=within)["beyond_limits_deg"] == 0.0
    within[7, motion.robot.joint_qpos_index("LKneePitch")] = model.joint("LKneePitch").range[1] + 0.1
    assert judged(motion, run, q=within)["beyond_limits_deg"] == pytest.approx(np.degrees(0.1))


@pytest.mark.slow
def test_the_judge_sees_what_is_wrong(lift):
    motion, _, summary, run = lift
    sunk, turned, slid = run.recording.q.copy(), run.recording.q.copy(), run.recording.contact_points.copy()
    sunk[300, 2] -= 0.02
    turned[300, 3:7] = Rotation.from_euler("x", 4.0, degrees=True).as_quat(scalar_first=True)
    slid[1500:, 4:, 0] += 0.006
    assert not judged(motion, run)["missed"] and not summary["schemes"]["weighted"]["missed"]
    assert judged(motion, run, q=sunk)["missed"] == {"base_height_mm"}
    assert judged(motion, run, q=turned)["base_turn_deg"] == pytest.approx(4.0, abs=0.2)
    assert judged(motion, run, q=turned)["missed"] == {"base_turn_deg"}
    late = judged(motion, run, contact_points=slid)
    assert late["feet_slip_mm"] > 5.0 and late["contact_slip_mm"] > 5.0
    assert {"feet_slip_mm", "contact_slip_mm"} <= late["missed"]
    fell = judged(motion, run, fell=True)
    assert fell["fell_at_s"] == pytest.approx(8.0) and fell["missed"] == {"falls"}
    fallen = dataclasses.replace(run, physics=dataclasses.replace(run.physics, fell=8.0))
    cells = [cell for column in table("x", {"weighted": figures(motion, fallen)}).columns for cell in column.cells]
    assert "[red]1[/red]" in cells and "8" in cells


@pytest.mark.slow
def test_files_hold_what_was_recorded(lift):
    _, folder, summary, run = lift
    assert {path.name for path in folder.iterdir()} == {"comparison.png", "motion.npz", "report.json"}
    assert json.loads((folder / "report.json").read_text()) == summary
    arrays = np.load(folder / "motion.npz")
    np.testing.assert_array_equal(arrays["q_weighted"], run.recording.q)
    np.testing.assert_array_equal(arrays["contact_forces_weighted"], run.recording.contact_forces)
    assert run.world.model.opt.timestep == 0.001 and run.world.servos["LKneePitch"] == Servo(150.0, 5.0, 3.023)


def test_physics_of_a_file_is_refused(capsys, tmp_path):
    assert cli.main(["demo", "--physics", "--robot", "arm7", "--out", str(tmp_path)]) == 2
    assert "osik_jax.physics" in capsys.readouterr().err
