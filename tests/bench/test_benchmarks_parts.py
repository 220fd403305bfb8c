"""Parts of a step: all is there, compiled and timed; a profile names operations of the program."""

import json
import sys

import jax
import jax.numpy as jnp
import pytest

from benchmarks import parts


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
