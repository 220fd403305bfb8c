"""The benchmark of batches: its numbers are there and right, and jumps are counted."""

import json
import sys
from typing import Any

import jax
import numpy as np
import pytest

import osik_jax as osik
from benchmarks import jumps, throughput


@pytest.mark.release
def test_a_row_is_right(tmp_path, monkeypatch):
    """As the command line writes it."""
    path = tmp_path / "results.json"
    options = ["--robot", "arm7", "--schemes", "weighted", "--precisions", "float64", "--batches", "3"]
    monkeypatch.setattr(sys, "argv", ["throughput", str(path), *options, "--tasks", "equality"])
    monkeypatch.setattr(throughput, "SECONDS", 0.01)
    throughput.main()
    result = json.loads(path.read_text())
    assert result["jax"] == jax.__version__ and result["platform"] == "cpu"
    (row,) = result["rows"]
    assert row["solved"] == 1.0 and row["error"] < 1e-12
    assert row["steps_per_second"] == row["batch"] / row["seconds"] > 0.0
    assert row["compile_seconds"] > 0.0 and row["program_bytes"] > row["batch"] * 7 * 8


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
