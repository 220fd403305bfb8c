"""Kernels for CPUs beside plain JAX on random problems, as ``python -m benchmarks.agreement`` counts them."""

import sys

import pytest
from core_checks import needs_core

from benchmarks import agreement

pytestmark = [needs_core, pytest.mark.slow]


@pytest.fixture
def said(monkeypatch, capsys):
    """What the command prints for a few problems of each family, and its solvers as they were afterwards."""

    def run(solver):
        for module, name, _ in agreement._SEARCHES:
            monkeypatch.setattr(module, name, getattr(module, name))
        monkeypatch.setattr(sys, "argv", ["agreement", "--solver", solver, "--count", "1", "--batch", "32"])
        agreement.main()
        return capsys.readouterr().out.splitlines()

    return run


@pytest.mark.variants(release=["hqp", "qp"])
@pytest.mark.parametrize("solver", ["qp", "hqp", "nullspace", "saturated"])
def test_every_family_agrees(solver, said):
    """But for null spaces of the degenerate one, where roundoff decides which rows and bounds count."""
    lines = said(solver)
    assert [line.split(":")[0] for line in lines] == list(agreement.comparison(solver).families)
    for line in lines:
        assert ": 32 problems; " in line
        if not line.startswith("degenerate") or solver in ("qp", "hqp"):
            assert "statuses: none; apart: 0, " in line, line
