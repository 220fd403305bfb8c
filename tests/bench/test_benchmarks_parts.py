"""Parts, rollouts and long jobs: all is there, compiled and timed; a profile names operations of the program."""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import job, parts, rollouts
from osik_jax import scaling


@pytest.mark.release
def test_rows_of_all_parts(tmp_path, monkeypatch, capsys):
    path = tmp_path / "parts.json"
    monkeypatch.setattr(parts, "SECONDS", 0.0)
    monkeypatch.setattr(sys, "argv", ["parts", str(path), "--robot", "arm7", "--batches", "3", "--operations", "4"])
    parts.main()
    rows = {row["part"]: row for row in json.loads(path.read_text())["rows"]}
    assert list(rows) == ["dispatch", "forward kinematics", "rows", "step", "gradient"]
    assert all(row["seconds"] > 0.0 and row["compile_seconds"] > 0.0 and row["batch"] == 3 for row in rows.values())
    operations = {part: row["operations"] for part, row in rows.items()}
    assert operations["dispatch"] == operations["forward kinematics"] == 1  # a kernel is one
    assert 1 < operations["step"] < operations["rows"] < operations["gradient"]  # a step is one call of the core
    slowest = rows["step"]["slowest"]
    assert len(slowest) == 4 and all(seconds > 0.0 for _, seconds in slowest)
    assert "gradient" in capsys.readouterr().out


def test_an_operation_is_found_where_it_is():
    """A product far larger than the rest of its program."""
    big = jnp.ones((400, 400))
    program = jax.jit(lambda a: jnp.sin(a @ a)[0]).lower(big).compile()
    (slowest, seconds), *rest = parts.profiled(program, (big,), 3)
    assert "dot" in slowest
    assert seconds > 2.0 * sum(others for _, others in rest)


@pytest.mark.release
def test_the_gradient_of_rollouts_is_finite_and_timed(tmp_path, monkeypatch):
    path = tmp_path / "rollouts.json"
    monkeypatch.setattr(sys, "argv", ["rollouts", str(path), "--robot", "arm7", "--robots", "2", "--steps", "3"])
    rollouts.main()
    forward, gradient = json.loads(path.read_text())["rows"]
    assert (forward["part"], gradient["part"]) == ("forward", "gradient")
    assert forward["finite"] and gradient["finite"]
    assert forward["seconds"] > 0.0 and gradient["seconds"] > 0.0  # which is longer is not sure in so short a run


@pytest.mark.release
def test_a_job_goes_on_where_it_was(tmp_path, monkeypatch, capsys):
    """Of three chunks the middle one is lost: it alone is run, and comes out as it was."""
    command = ["job", str(tmp_path), "--robot", "arm7", "--steps", "18", "--length", "2", "--chunk", "3"]
    monkeypatch.setattr(sys, "argv", command)
    monkeypatch.setattr(job, "cores", lambda: (0,))
    job.main()
    assert "18 steps in" in capsys.readouterr().out
    before = scaling.load(tmp_path)[:]
    assert before["solved"].all() and 0.0 < before["error"].max() < 1.0 and len(before["error"]) == 9
    (tmp_path / "00000001.npz").unlink()
    job.main()
    assert "6 steps in" in capsys.readouterr().out
    for name, array in scaling.load(tmp_path)[:].items():
        np.testing.assert_array_equal(array, before[name])
