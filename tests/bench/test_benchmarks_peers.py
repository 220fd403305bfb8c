"""The benchmark beside the peers: motions are judged by Pinocchio, wrong ones fail, processes take turns."""

import json
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from rich.console import Console

import osik_jax as osik
from benchmarks import gate, motions, report
from benchmarks.descriptions import ROBOTS
from benchmarks.judge import BOUNDS, failures, judged, verdict
from benchmarks.peers import ours, peer
from benchmarks.processes import ROOT, Entrant, cores
from benchmarks.race import Race
from benchmarks.robots import pinocchio_model, workload
from benchmarks.workload import DT, Workload

STEPS = 40


@pytest.fixture(scope="module")
def work():
    return workload("panda")


def motion_of(runner: Any, work: Workload, steps: int = STEPS, lane: int = 0) -> np.ndarray:
    return np.array([runner.canonical(runner.step(work.hand_at(k, lane), work.com_at(k))) for k in range(steps)])


@pytest.fixture(scope="module")
def paths(work):
    """Ours and mink's."""
    return {name: motion_of(peer(name)(work), work) for name in ("osik_jax", "mink")}


@pytest.mark.slow
def test_ours_is_minks_motion(work, paths, monkeypatch):
    """Without curvature damping. Orientation errors are written in other ways, which differ by the angle's square."""
    assert np.abs(paths["mink"] - work.start).max() > 0.02
    monkeypatch.setitem(ours.SCHEMES, "weighted", lambda: osik.WeightedQP(damping=1e-9, curvature_damping=0.0))
    motion = motion_of(ours.Runner(work), work)
    np.testing.assert_allclose(motion, paths["mink"], rtol=0, atol=1e-5)


@pytest.mark.variants(release=["osik_jax"])
@pytest.mark.parametrize("name", ["osik_jax", "mink"])
def test_a_good_motion_counts(work, paths, name):
    score = judged(work, paths[name])
    assert not failures(score)
    assert 0.0 < score["hand"] < 2e-3 and score["position_excess"] == 0.0


def test_a_wrong_motion_fails(work, paths):
    """Standing still, a step late at full speed, another lane's target, beyond limits, not a number."""

    def named(motion, lane=0):
        return {text.split()[0] for text in failures(judged(work, motion, lane))}

    good = paths["mink"]
    assert named(np.tile(work.start, (STEPS, 1))) == {"hand"}
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


@pytest.mark.parametrize("name", ["nao", "arm7"])
def test_urdfs_of_embedded_robots_are_those_robots(name):
    """All links, sites and the centre of mass by Pinocchio are where MuJoCo has those of the MJCF."""
    work = workload(name)
    model = mujoco.MjModel.from_xml_path(str(ROOT / "osik_jax" / "robot" / "models" / f"{name}.xml"))
    data, theirs = mujoco.MjData(model), pinocchio_model(work.urdf, work.floating)
    pin_data, base = theirs.createData(), 7 if work.floating else 0
    moving = 1 if work.floating else 2  # Pinocchio leaves out what is fixed to the world
    rng = np.random.default_rng(0)
    for _ in range(5):
        q = work.start.copy()
        q[base:] = rng.uniform(work.position_lower, work.position_upper)
        data.qpos[:base] = q[[0, 1, 2, 6, 3, 4, 5]][:base]
        data.qpos[[model.joint(joint).qposadr[0] for joint in work.joints]] = q[base:]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        pin.framesForwardKinematics(theirs, pin_data, q)
        for body in range(1, model.nbody):
            own = theirs.getFrameId(model.body(body).name, pin.FrameType.BODY)
            np.testing.assert_allclose(pin_data.oMf[own].translation, data.xpos[body], atol=1e-14)
            np.testing.assert_allclose(pin_data.oMf[own].rotation.ravel(), data.xmat[body], atol=1e-14)
        for site in {*work.feet, work.hand} - {model.body(i).name for i in range(model.nbody)}:
            own = pin_data.oMf[theirs.getFrameId(site)].translation
            np.testing.assert_allclose(own, data.site(site).xpos, atol=1e-14)
        np.testing.assert_allclose(pin.centerOfMass(theirs, pin_data, q), data.subtree_com[moving], atol=1e-14)
    for joint, speed in zip(work.joints, work.velocity, strict=True):
        assert speed == model.numeric(f"velocity_limit/{joint}").data[0]


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_every_robot_can_do_its_workload(name):
    """The exact answer of a QP, mink's, is within the judge's bounds wherever the curve is fastest."""
    work = workload(name)
    for lane in (0, 1):
        assert not failures(judged(work, motion_of(peer("mink")(work), work, steps=600, lane=lane), lane))


@pytest.mark.slow
def test_processes_take_turns_and_who_is_missing_is_left_out(work, tmp_path, capsys):
    said: list[str] = []
    with Race(work, pythons={"placo": "no-such-python"}, report=said.append) as race:
        entrants = [Entrant("one", "mink", cores=cores(1)), Entrant("nobody", "placo")]
        (row,) = race.run(entrants, rounds=2, steps=20, seconds=1.0)
    assert row["timed_steps"] == 40 and row["robots"] == 1
    assert row["judged_steps"] == 51 and row["motion"].shape == (1, 51, 7)
    assert 2**24 < row["peak_bytes"] < 2**34 and row["device"] is row["device_peak_bytes"] is None
    assert 0.0 < row["step_seconds_median"] <= row["step_seconds_p99"] < 1.0
    assert 0.0 < row["kernel_ratio"] <= row["step_seconds_median"] / row["kernel_seconds"]
    assert "no-such-python" in race.missing["placo"] and any("placo is left out" in text for text in said)
    assert race.versions["mink"].keys() >= {"mink", "mujoco", "daqp", "python"}
    result = report.surroundings() | dict(robot="panda", one_robot=[row], many_robots=[], gradients=[], missing={})
    path = tmp_path / "results.json"
    path.write_text(json.dumps(motions.kept(result, work, path)))
    report.show(Console(width=160), result)
    assert "not yet" in capsys.readouterr().out
    later = motions.judged_later(path)
    (found,) = later["one_robot"]
    assert not found["failures"] and "motion" not in found and 0.0 < found["score"]["hand"] < 1e-3
    report.show(Console(width=160), later)
    assert "1.00" in capsys.readouterr().out


def test_the_worst_lane_of_a_batch_counts(work, motions_of_lanes):
    good = verdict(work, motions_of_lanes)
    assert not good["failures"]
    motions_of_lanes[1, 20:, 0] += 0.05
    assert verdict(work, motions_of_lanes)["failures"]


@pytest.fixture
def motions_of_lanes(work):
    """Of two robots, each with its own target, by mink."""
    return np.array([motion_of(peer("mink")(work), work, lane=lane) for lane in range(2)])


def test_the_gate_sees_what_is_slow_or_wrong():
    baseline = dict(margin=1.5, ratios=dict(slow=1.0, wrong=1.0, fine=1.0))
    rows: dict[str, dict[str, Any]] = dict(
        slow=dict(kernel_ratio=1.6, failures=[]),
        wrong=dict(kernel_ratio=1.0, failures=["hand 1 m > 0.006"]),
        fine=dict(kernel_ratio=1.4, failures=[]),
    )
    found = gate.verdicts(rows, baseline)
    assert "1.6 times the kernel > 1.5" in found["slow"] and "hand" in found["wrong"] and not found["fine"]
