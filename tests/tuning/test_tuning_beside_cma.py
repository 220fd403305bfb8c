"""What tuning wins over its start, and over a search without gradients: the benchmark's experiment on the arm."""

from __future__ import annotations

import pytest

from benchmarks.tuning import arm_reaching, compare

pytestmark = pytest.mark.slow


@pytest.mark.release
def test_the_arm_beats_cma():
    """Held-out loss at least five times lower, and lower than CMA-ES's at the same number of rollouts."""
    result = compare(arm_reaching(), 60, seeds=3, costs=(1,), progress=False)
    assert result["parameters"] >= 10
    assert result["gradient"]["rollouts"] == result["cma"]["rollouts"]
    assert result["gradient"]["held_out_loss"] < 0.2 * result["before"]
    assert result["gradient"]["training_loss"] < result["cma"]["training_loss"]
    assert result["gradient"]["held_out_loss"] < result["cma"]["best_held_out_loss"]
