"""The benchmark beside the peers: motions are judged by Pinocchio, wrong ones fail, processes take turns."""

from typing import Any

import numpy as np
import pytest
from rich.console import Console

from benchmarks import gate, report
from benchmarks.__main__ import QUICK, Selection, many_robots, one_robot
from benchmarks.judge import BOUNDS, failures, judged
from benchmarks.peers import peer
from benchmarks.processes import Entrant, cores
from benchmarks.race import Race
from benchmarks.robots import workload
from benchmarks.workload import DT, Workload

TICKS = 40


@pytest.fixture(scope="module")
def work():
    return workload("panda")


def motion_of(runner: Any, work: Workload) -> np.ndarray:
    return np.array([runner.canonical(runner.tick(work.hand_at(k), work.com_at(k))) for k in range(TICKS)])


@pytest.fixture(scope="module")
def motions(work):
    """Ours and mink's."""
    return {name: motion_of(peer(name)(work), work) for name in ("osik_jax", "mink")}


def test_ours_is_minks_motion(work, motions):
    """Orientation errors are written in other ways, which differ as the angle itself does, by its square."""
    assert np.abs(motions["mink"] - work.start).max() > 0.02
    np.testing.assert_allclose(motions["osik_jax"], motions["mink"], rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", ["osik_jax", "mink"])
def test_a_good_motion_counts(work, motions, name):
    score = judged(work, motions[name])
    assert not failures(score)
    assert 0.0 < score["hand"] < 2e-3 and score["position_excess"] == 0.0


def test_a_wrong_motion_fails(work, motions):
    """Standing still, a tick late at full speed, another lane's target, beyond limits, not a number."""

    def named(motion, lane=0):
        return {text.split()[0] for text in failures(judged(work, motion, lane))}

    good = motions["mink"]
    assert named(np.tile(work.start, (TICKS, 1))) == {"hand"}
    assert "hand" in named(good, lane=1)
    jump = good.copy()
    jump[20:, 0] += 1.1 * DT * work.velocity[0]
    assert "velocity_excess" in named(jump)
    outside = good.copy()
    outside[:, 5] = work.position_upper[5] + 1e-3
    assert "position_excess" in named(outside)
    assert named(np.full_like(good, np.nan)) == set(BOUNDS)


def test_feet_and_centre_of_mass_are_judged():
    """Of a G1 that sinks and leans: by so much, Pinocchio says."""
    work = workload("g1")
    motion = np.tile(work.start, (2, 1))
    assert not failures(judged(work, motion))
    motion[1, 2] -= 0.01
    score = judged(work, motion)
    for name in ("feet", "com", "hand"):
        assert score[name] == pytest.approx(0.01, abs=1e-4)
    motion[1] = work.start
    motion[1, 3:7] = 0.0, np.sin(0.01), 0.0, np.cos(0.01)
    assert judged(work, motion)["feet_rotation"] == pytest.approx(0.02, abs=1e-9)


def test_a_workload_survives_its_file(work):
    again = Workload.from_json(work.to_json())
    assert again.joints == work.joints and again.costs == work.costs
    np.testing.assert_array_equal(again.hand_at(70, np.arange(3)), work.hand_at(70, np.arange(3)))


def test_processes_take_turns_and_who_is_missing_is_left_out(capsys):
    said: list[str] = []
    with Race("panda", pythons={"placo": "no-such-python"}, report=said.append) as race:
        entrants = [Entrant("one", "mink", cores=cores(1)), Entrant("nobody", "placo")]
        (row,) = race.run(entrants, rounds=2, ticks=20, seconds=1.0)
    assert row["timed_ticks"] == 40 and not row["failures"] and row["robots"] == 1
    assert 0.0 < row["tick_seconds_median"] <= row["tick_seconds_p99"] < 1.0
    assert 0.0 < row["kernel_ratio"] <= row["tick_seconds_median"] / row["kernel_seconds"]
    assert "no-such-python" in race.missing["placo"] and any("placo is left out" in text for text in said)
    assert race.versions["mink"].keys() >= {"mink", "mujoco", "daqp", "python"}
    result = dict(robot="panda", one_robot=[row], many_robots=[row], missing=race.missing)
    report.show(Console(width=160), report.surroundings() | result)
    assert "1.00" in capsys.readouterr().out


def test_the_gate_sees_what_is_slow_or_wrong():
    baseline = dict(margin=1.5, ratios=dict(slow=1.0, wrong=1.0, fine=1.0))
    rows: dict[str, dict[str, Any]] = dict(
        slow=dict(kernel_ratio=1.6, failures=[]),
        wrong=dict(kernel_ratio=1.0, failures=["hand 1 m > 0.006"]),
        fine=dict(kernel_ratio=1.4, failures=[]),
    )
    found = gate.verdicts(rows, baseline)
    assert "1.6 times the kernel > 1.5" in found["slow"] and "hand" in found["wrong"] and not found["fine"]


def test_everyone_is_in_the_program():
    names = [entrant.name for entrant in one_robot(Selection())]
    assert {"mink", "pink", "placo"} < set(names) and len(names) == len(set(names)) == 9
    batches = [entrant.options["batch"] for group in many_robots(Selection()) for entrant in group if entrant.options]
    assert sorted(set(batches)) == [1, 64, 1024, 16384] and len(batches) == 24
    (group,) = many_robots(QUICK)
    assert [entrant.peer for entrant in group] == ["mink", "pink", "placo", "osik_jax"]
    assert group[-1].robots == 1024 and group[0].robots == len(cores())
