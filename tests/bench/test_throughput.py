"""The benchmark of batches: its numbers are there, right, and its file may be filled in parts."""

import json
import sys
from typing import Any

import jax
import numpy as np
import pytest
from refusals import refuses

import osik_jax as osik
from benchmarks import jumps, scaling, throughput


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """A file with one row, as the command line writes it."""
    path = tmp_path_factory.mktemp("throughput") / "results.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(throughput, "SECONDS", 0.01)
        run(patch, path, "3")
    return path


def run(patch, path, batches):
    options = ["--robot", "arm7", "--schemes", "weighted", "--precisions", "float64", "--batches", batches]
    options += ["--tasks", "equality"]
    patch.setattr(sys, "argv", ["throughput", str(path), *options])
    throughput.main()


@pytest.mark.release
def test_a_row_is_right(path):
    result = json.loads(path.read_text())
    assert result["jax"] == jax.__version__ and result["platform"] == "cpu"
    (row,) = result["rows"]
    assert row["solved"] == 1.0 and row["error"] < 1e-12
    assert row["steps_per_second"] == row["batch"] / row["seconds"] > 0.0
    assert row["compile_seconds"] > 0.0 and row["program_bytes"] > row["batch"] * 7 * 8


@pytest.mark.release
def test_a_file_is_filled_in_parts(path, tmp_path, monkeypatch):
    other = tmp_path / "results.json"
    other.write_text(path.read_text())
    (first,) = json.loads(path.read_text())["rows"]
    monkeypatch.setattr(throughput, "measure", lambda given, scheme, batch, *_: first | dict(batch=batch, calls=9))
    run(monkeypatch, other, "5")
    assert json.loads(other.read_text())["rows"] == [first, first | dict(batch=5, calls=9)]
    run(monkeypatch, other, "3")
    assert [row["calls"] for row in json.loads(other.read_text())["rows"]] == [9, 9]
    monkeypatch.setattr(throughput, "machine", lambda: {"device": "another"})
    refuses(ValueError, "another machine", throughput.kept, other)


@pytest.mark.release
@pytest.mark.parametrize("robot", ["g1", "nao"])
def test_humanoids_stand_on_both_feet(robot):
    given = throughput.setting(robot, "polygon")
    kinematics = osik.forward_kinematics(given.robot, given.robot.q0)
    feet = np.array([kinematics.frame_pose(given.robot, name)[0][:2] for name in throughput.ROBOTS[robot].feet])
    com = given.tasks["com"]
    assert isinstance(com, osik.ComTask) and com.polygon is not None
    polygon = com.polygon
    outside = np.asarray(feet @ polygon.normals.T - polygon.offsets)
    assert (outside < 0.0).all() and outside.min() < -0.1  # each foot is far from an edge of the other one


@pytest.mark.release
def test_steps_of_a_call_are_those_of_several():
    step, given, state = throughput.batch_of(throughput.setting("arm7"), osik.WeightedQP(), 3)
    at_once = jax.jit(throughput.repeated(step, 4))(*given, state)
    for _ in range(4):
        state, error, fine = jax.jit(step)(*given, state)
    jax.tree.map(np.testing.assert_array_equal, at_once, (state, error, fine))


@pytest.mark.release
def test_lanes_of_a_device_are_measured():
    (row,) = scaling.run("arm7", "weighted", "float64", 4, [1])
    assert row["solved"] == row["efficiency"] == 1.0 and row["error"] < 1e-12


@pytest.mark.release
def test_the_reference_is_the_rollout():
    """The carried step is ``rollout``'s: errors after the checked steps."""
    given = throughput.setting("arm7")
    wanted = throughput.reference("arm7", "weighted", "equality")
    hand: Any = given.tasks["hand"]
    for lane in (0, 7):
        tasks = given.tasks | {"hand": hand.replace(target=(given.targets[lane], hand.target[1]))}
        motion = osik.rollout(
            given.robot,
            given.starts[lane],
            tasks,
            scheme=osik.WeightedQP(),
            limits=given.limits,
            dt=throughput.DT,
            steps=throughput.CHECKED,
        )
        for name, error in motion.solution.error.items():
            np.testing.assert_allclose(wanted[name][lane], error[-1], rtol=0, atol=1e-12)


def test_a_sweep_ends_before_a_call_takes_too_long(monkeypatch):
    monkeypatch.setattr(throughput, "LONGEST", 1.0)
    monkeypatch.setattr(throughput, "reference", lambda *_: {})
    monkeypatch.setattr(throughput, "measure", lambda *args: dict(batch=args[2], seconds=0.1 * args[2]))
    found = throughput.sweep("arm7", "weighted", "float64", [1, 8, 64, 10])
    assert [row["batch"] for row in found] == [1, 8, 10]


@pytest.mark.release
def test_jumps_are_counted():
    given, sample = throughput.setting("arm7"), []
    row = jumps.measure(given, osik.WeightedQP(), robots=4, scans=1, radius=0.5, sample=sample)
    assert row["steps"] == row["statuses"]["SOLVED"] == 4 * 2 * jumps.STEPS
    assert row["finite"] and row["beyond_limits"] == 0.0 and row["steps_per_second"] > 0.0
    assert 0.0 < row["fastest"] <= float(osik.load_robot("arm7").velocity_limit.max())
    steps = jumps.joined(sample)
    right = jumps.compared(given, osik.WeightedQP(), steps)
    assert right["steps"] == right["solved"] == right["in_double_too"] == 4 * 2
    assert right["rows_largest"] < 1e-9 and abs(right["cost_largest"]) < 1e-9
    steps["velocity"][0] *= 0.9
    wrong = jumps.compared(given, osik.WeightedQP(), steps)
    assert wrong["rows_largest"] > 1e-3 and wrong["cost_largest"] > 1e-6
