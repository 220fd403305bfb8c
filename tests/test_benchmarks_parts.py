"""Benchmarks of parts and of rollouts: all is there, compiled and timed; a profile names operations of the program."""

import json
import sys

import jax
import jax.numpy as jnp

from benchmarks import parts, rollouts


def test_rows_of_all_parts(tmp_path, monkeypatch, capsys):
    path = tmp_path / "parts.json"
    monkeypatch.setattr(parts, "SECONDS", 0.0)
    monkeypatch.setattr(sys, "argv", ["parts", str(path), "--robot", "arm7", "--batches", "3", "--operations", "4"])
    parts.main()
    rows = {row["part"]: row for row in json.loads(path.read_text())["rows"]}
    assert list(rows) == ["dispatch", "forward kinematics", "rows", "tick", "gradient"]
    assert all(row["seconds"] > 0.0 and row["compile_seconds"] > 0.0 and row["batch"] == 3 for row in rows.values())
    assert (
        rows["dispatch"]["operations"] == 1 < rows["forward kinematics"]["operations"] < rows["gradient"]["operations"]
    )
    slowest = rows["tick"]["slowest"]
    assert len(slowest) == 4 and all(seconds > 0.0 for _, seconds in slowest)
    assert "gradient" in capsys.readouterr().out


def test_an_operation_is_found_where_it_is():
    """A product far larger than the rest of its program."""
    big = jnp.ones((400, 400))
    program = jax.jit(lambda a: jnp.sin(a @ a)[0]).lower(big).compile()
    (slowest, seconds), *rest = parts.profiled(program, (big,), 3)
    assert "dot" in slowest
    assert seconds > 2.0 * sum(others for _, others in rest)


def test_the_gradient_of_rollouts_is_finite_and_timed(tmp_path, monkeypatch):
    path = tmp_path / "rollouts.json"
    monkeypatch.setattr(sys, "argv", ["rollouts", str(path), "--robot", "arm7", "--robots", "2", "--ticks", "3"])
    rollouts.main()
    forward, gradient = json.loads(path.read_text())["rows"]
    assert (forward["part"], gradient["part"]) == ("forward", "gradient")
    assert forward["finite"] and gradient["finite"]
    assert 0.0 < forward["seconds"] < gradient["seconds"]
