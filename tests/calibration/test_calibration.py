"""Calibrations beside truth that is not ours: a UR5e by its DH parameters, MuJoCo, SciPy, central differences."""

from __future__ import annotations

import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
import yaml
from compilations import Compilations
from refusals import refuses

import osik_jax as osik
from benchmarks import calibration as studies
from osik_jax import calibration as cal
from osik_jax.cli import main

RNG = np.random.default_rng
GATE = ["SO-101, distances and a plane"]
NIGHT = [name for name in studies.STUDIES if name not in GATE]


@pytest.fixture(scope="module")
def ur5() -> osik.Robot:
    return osik.load_robot("ur5")


@jax.jit
@jax.vmap
def tips(robot: osik.Robot, q: jax.Array) -> tuple[jax.Array, jax.Array]:
    return osik.forward_kinematics(robot, q).frame_pose(robot, "tool0")


def tips_of(robot: osik.Robot, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    robots = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(q), *leaf.shape)), robot)
    position, rotation = tips(robots, jnp.asarray(q))
    return np.asarray(position), np.asarray(rotation)


def ur_by_dh(q: np.ndarray, d: tuple[float, ...], a: tuple[float, ...]) -> np.ndarray:
    """Return the flange of a UR arm by its maker's Denavit-Hartenberg parameters. (n, 3)"""
    places = []
    for row in q:
        pose = np.eye(4)
        for angle, offset, length, twist in zip(row, d, a, (np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0), strict=True):
            turn = np.eye(4)
            turn[:3, :3] = scipy.spatial.transform.Rotation.from_euler("ZX", [angle, twist]).as_matrix()
            turn[:3, 3] = length * np.cos(angle), length * np.sin(angle), offset
            pose = pose @ turn
        places.append(pose[:3, 3])
    return np.array(places)


UR5 = (0.089159, 0, 0, 0.10915, 0.09465, 0.0823), (0, -0.425, -0.39225, 0, 0, 0)
UR5E = (0.1625, 0, 0, 0.1333, 0.0997, 0.0996), (0, -0.425, -0.3922, 0, 0, 0)
LENGTHS = (
    cal.Unknown("body_position", ("shoulder_link", "forearm_link", "wrist_1_link", "wrist_3_link"), axes="z"),
    cal.Unknown("body_position", "wrist_2_link", axes="y"),
    cal.Unknown("frame_position", "tool0", axes="y"),
    cal.Unknown("base_rotation", axes="z"),
)


def test_the_file_of_a_ur5_becomes_a_ur5e(ur5: osik.Robot):
    """20 tips of the other arm, by its maker's parameters; the base is turned by half a turn."""
    base = cal.FixedFrame(rotation=np.diag([-1.0, -1.0, 1.0]))
    q = RNG(0).uniform(-2.5, 2.5, (40, 6))
    file = np.asarray(tips_of(ur5, q)[0]) * [-1, -1, 1]
    np.testing.assert_allclose(ur_by_dh(q, *UR5), file, atol=2e-4)  # the file is the maker's arm
    tip = ur_by_dh(q, *UR5E)
    found = cal.calibrate(ur5, cal.Points("tool0", q[:20], tip[:20], sigma=1e-4), LENGTHS, base=base)
    assert bool(found.converged) and not found.unobservable
    fitted = cal.calibrate(found.robot, cal.Points("tool0", q[20:], tip[20:]), LENGTHS, base=found.base)
    assert np.linalg.norm(fitted.residuals[0].before, axis=1).max() < 1e-4  # tips that the fit has not seen
    values = found.values
    assert values["body_position[shoulder_link].z"] == pytest.approx(0.1625 - 0.089159, abs=1e-6)
    assert values["frame_position[tool0].y"] == pytest.approx(0.0996 - 0.0823, abs=1e-6)


def test_a_tool_with_its_sigma(ur5: osik.Robot):
    """20 poses with 0.2 mm of noise."""
    q, offset = RNG(1).uniform(-2.0, 2.0, (20, 6)), np.array([0.03, 0.0823 + 0.12, -0.01])
    seen = tips_of(ur5.replace(frame_position={"tool0": offset}), q)[0] + 2e-4 * RNG(2).normal(size=(20, 3))
    found = cal.calibrate(ur5, cal.Points("tool0", q, seen, sigma=2e-4), [cal.Unknown("frame_position", "tool0")])
    at = ur5.tree.frame("tool0")
    assert np.abs(found.robot.frame_position[at] - offset).max() < 2e-4
    np.testing.assert_allclose(list(found.sigma.values()), 2e-4 / 20**0.5, rtol=1e-6)  # a linear problem
    assert "frame_position[tool0].y: +120." in found.explain()
    before, after = (np.sqrt((np.linalg.norm(rows, axis=1) ** 2).mean()) for rows in found.residuals[0][2:4])
    assert f"rms {before:.4g} -> {after:.4g} m" in found.explain()  # of lengths, as the picture has them
    legend: Any = found.figure().axes[0].get_legend()
    assert f"before, rms {1e3 * before:.3g} mm" in [text.get_text() for text in legend.texts]


def test_offsets_axes_and_rotations_are_what_replace_sets(ur5: osik.Robot):
    """Exact readings of a robot whose numbers were set by name: each number is found, followers not disturbed."""
    axis = np.array([0.004, 1.0, -0.003])
    turn = scipy.spatial.transform.Rotation.from_rotvec([0.002, -0.003, 0.0])
    old = np.asarray(ur5.body_quaternion[3])
    new = (scipy.spatial.transform.Rotation.from_quat(old, scalar_first=True) * turn).as_quat(scalar_first=True)
    true = ur5.replace(
        joint_reference={"wrist_1_joint": -0.01, "wrist_2_joint": 0.02},
        joint_axis={"shoulder_lift_joint": axis},
        body_quaternion={"forearm_link": new},
    )
    q = RNG(3).uniform(-2.0, 2.0, (12, 6))
    unknowns = [
        cal.Unknown("joint_offset", "wrist_[12]_joint"),
        cal.Unknown("joint_axis", "shoulder_lift_joint"),
        cal.Unknown("body_rotation", "forearm_link", axes="xy"),
    ]
    found = cal.calibrate(ur5, cal.Poses("tool0", q, *tips_of(true, q)), unknowns)
    unit = axis / np.linalg.norm(axis)
    np.testing.assert_allclose(found.robot.joint_axis[1], unit, atol=1e-8)
    np.testing.assert_allclose(found.vector, [0.01, -0.02, 0.004, -0.003, 0.002, -0.003], atol=1e-8)
    again = osik.Robot.from_urdf(found.robot.to_urdf())
    np.testing.assert_allclose(tips_of(again, q)[0], tips_of(true, q)[0], atol=1e-9)


@pytest.mark.variants(slow=GATE, release=NIGHT)
@pytest.mark.parametrize("name", studies.STUDIES)
def test_errors_are_as_large_as_sigma_says(name: str):
    """Coverage by a normal law; with 100 cases of 8 to 14 numbers the deviation is known to 3 %."""
    found = studies.cases_of(studies.STUDIES[name], 100)
    assert found["converged"].all() and found["full_rank"].all()
    inside, deviation = studies.coverage(found)
    assert inside > 0.99 and deviation == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_outliers_cost_little(ur5: osik.Robot):
    """20 % of the readings are off by 100 times the noise; with least squares the errors are 20 times as large."""
    q, truth = RNG(4).uniform(-2.0, 2.0, (60, 40, 6)), np.array([0.01, -0.02, 0.03])
    tool = cal.Unknown("frame_position", "tool0")
    exact = np.stack([tips_of(ur5.replace(frame_position={"tool0": truth}), row)[0] for row in q])
    noise = 2e-4 * RNG(5).normal(size=exact.shape)
    wild = np.where(RNG(6).uniform(size=(60, 40, 1)) < 0.2, 100.0, 1.0)

    def errors(seen: np.ndarray, loss: str) -> tuple[float, float]:
        def run(q: jax.Array, seen: jax.Array) -> tuple[jax.Array, jax.Array]:
            found = cal.calibrate(ur5, cal.Points("tool0", q, seen, sigma=2e-4), [tool], loss=loss)
            return found.robot.frame_position[ur5.tree.frame("tool0")] - truth, found.deviation

        off, sigma = jax.jit(jax.vmap(run))(q, seen)
        return float(jnp.sqrt((off**2).mean())), float((off / sigma).std())

    clean, robust = errors(exact + noise, "squared")[0], errors(exact + wild * noise, "geman_mcclure")
    assert robust[0] < 1.5 * clean
    assert robust[1] == pytest.approx(1.0, abs=0.15)
    assert errors(exact + wild * noise, "squared")[0] > 10.0 * clean


def test_what_cannot_be_told_apart_is_named(ur5: osik.Robot):
    """With a still fifth joint at 0 the axes of joints 4 and 6 are parallel: d4 and d6 add up."""
    assert studies.still_wrist(5) == (5, 5)
    q = RNG(7).uniform(-2.0, 2.0, (20, 6)) * [1, 1, 1, 1, 0, 1]
    both = [cal.Unknown("body_position", "wrist_2_link", axes="y"), cal.Unknown("frame_position", "tool0", axes="y")]
    seen = cal.Points("tool0", q, tips_of(ur5, q)[0] + [0.0, 0.0, 1e-3])
    found = cal.calibrate(ur5, seen, [*both, cal.Unknown("body_position", "shoulder_link", axes="z")])
    (lost,) = found.unobservable
    names = "body_position[wrist_2_link].y", "frame_position[tool0].y"
    assert set(lost.coefficients) == set(names)
    assert lost.coefficients[names[0]] == pytest.approx(-lost.coefficients[names[1]], abs=1e-6)
    assert np.isinf([found.sigma[name] for name in names]).all()
    assert found.values["body_position[shoulder_link].z"] == pytest.approx(1e-3, abs=1e-9)
    assert np.isfinite(found.covariance).all() and np.isfinite(found.vector).all()
    with_prior = [cal.Unknown("body_position", "wrist_2_link", axes="y", prior=1e-4), both[1]]
    known = cal.calibrate(ur5, seen, with_prior)
    assert known.sigma[names[0]] == pytest.approx(1e-4, rel=1e-3) and len(known.unobservable) == 1


@pytest.mark.variants(slow=GATE, release=NIGHT)
@pytest.mark.parametrize("name", studies.STUDIES)
def test_the_same_optimum_as_scipy(name: str):
    assert studies.beside_scipy(studies.STUDIES[name])[0] < 1e-3  # of a deviation


@pytest.mark.slow
def test_next_poses_tell_more_than_random_ones(ur5: osik.Robot):
    unknowns = [cal.Unknown("joint_offset", ("shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint"))]
    drawn = RNG(8).uniform(-2.0, 2.0, (200, 6))
    reading = cal.Points("tool0", drawn[:3], np.zeros((3, 3)))
    best = cal.next_poses(ur5, reading, unknowns, 4, candidates=drawn, allowed=lambda q: q[:, 0] > 0.0)
    assert best.shape == (4, 6) and (best[:, 0] > 0.0).all()
    assert all((row == drawn).all(1).any() for row in best)

    def determinant(q: np.ndarray) -> float:
        found = cal.calibrate(ur5, cal.Points("tool0", q, tips_of(ur5, q)[0]), unknowns)
        return float(np.linalg.slogdet(found.information)[1])

    others = [determinant(drawn[drawn[:, 0] > 0.0][4 * k : 4 * k + 4]) for k in range(10)]
    assert determinant(best) > max(others)
    first = cal.calibrate(ur5, cal.Points("tool0", best, tips_of(ur5, best)[0]), unknowns)
    assert cal.next_poses(ur5, reading, unknowns, 2, after=first, candidates=np.int64(50)).shape == (2, 6)  # pyright: ignore[reportArgumentType]


def test_vmap_derivatives_and_no_compilation(ur5: osik.Robot):
    q = RNG(9).uniform(-2.0, 2.0, (3, 10, 6))
    seen = np.stack([tips_of(ur5, row)[0] for row in q]) + 1e-3 * RNG(10).normal(size=(3, 10, 3))
    unknowns = [cal.Unknown("joint_offset", "elbow_joint"), cal.Unknown("frame_position", "tool0", prior=0.01)]

    def run(q: jax.Array, seen: jax.Array) -> jax.Array:
        return cal.calibrate(ur5, cal.Points("tool0", q, seen), unknowns).vector

    together = jax.jit(jax.vmap(run))(q, seen)
    for one, row, points in zip(together, q, seen, strict=True):
        np.testing.assert_allclose(one, run(row, points), atol=1e-12)
    other = cal.Points("tool0", jnp.asarray(q[1]), jnp.asarray(seen[1]), sigma=2e-3)
    with Compilations() as programs:
        cal.calibrate(ur5, other, [unknowns[0], cal.Unknown("frame_position", "tool0", prior=0.02)])
    assert not [name for name in programs.names if "calibrated" in name]
    step = np.zeros((10, 3))
    step[3, 1] = 1e-5
    numeric = (run(q[0], seen[0] + step) - run(q[0], seen[0] - step)) / 2e-5
    exact = jax.jit(jax.jacrev(run, argnums=1))(q[0], seen[0])[:, 3, 1]
    np.testing.assert_allclose(exact, numeric, rtol=0.02, atol=1e-3)  # residuals of 1 mm bend the problem


def test_a_lane_with_nan_leaves_the_others_alone(ur5: osik.Robot):
    q = RNG(11).uniform(-2.0, 2.0, (2, 10, 6))
    seen = np.stack([tips_of(ur5, row)[0] for row in q])
    bad = seen.copy()
    bad[0, 0, 0] = np.nan

    def run(q: jax.Array, seen: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = cal.calibrate(ur5, cal.Points("tool0", q, seen), [cal.Unknown("joint_offset", "elbow_joint")])
        return found.vector, found.converged

    both = jax.jit(jax.vmap(run))
    (vectors, converged), (healthy, _) = both(q, bad), both(q, seen)
    np.testing.assert_array_equal(vectors[1], healthy[1])
    assert np.isfinite(vectors).all() and converged.tolist() == [False, True]


def test_files_and_command(ur5: osik.Robot, tmp_path, capsys: pytest.CaptureFixture[str]):
    q = RNG(12).uniform(-2.0, 2.0, (15, 6))
    seen = tips_of(ur5.replace(joint_reference={"elbow_joint": -0.01}), q)[0]
    table = tmp_path / "points.csv"
    head = ",".join([*ur5.joint_names, "x", "y", "z"])
    np.savetxt(table, np.hstack([q, seen]), delimiter=",", header=head, comments="")
    options = ["--robot", "ur5", "--measurements", str(table), "--frame", "tool0", "--out", str(tmp_path / "out")]
    assert main(["calibrate", *options, "--sigma", "1e-4", "--unknowns", "joint_offset:elbow_joint"]) == 0
    assert "joint_offset[elbow_joint]: +10.0000" in capsys.readouterr().out
    text = (tmp_path / "out" / "calibration.yaml").read_text()
    saved = yaml.safe_load(text)
    assert saved == json.loads(text)
    assert saved["unknowns"]["joint_offset[elbow_joint]"]["change"] == pytest.approx(0.01, abs=1e-9)
    assert saved["undetermined"] == [] and saved["frames"]["base"]["parent"] is None
    fitted = osik.Robot.from_urdf(tmp_path / "out" / "robot.urdf")
    np.testing.assert_allclose(tips_of(fitted, q)[0], seen, atol=1e-9)
    assert (tmp_path / "out" / "residuals.png").stat().st_size > 10_000
    assert main(["calibrate", *options, "--unknowns", "lengths"]) == 2
    assert "no quantity 'lengths'" in capsys.readouterr().err


def test_a_saved_file_has_numbers_for_readers_of_yaml_and_json(ur5: osik.Robot, tmp_path):
    """PyYAML takes 1e-05 for text; a column of zeros says nothing of a joint, so that its deviation is infinite."""
    q = np.zeros((3, 6))
    frames = {"camera": cal.FixedFrame("tool0", position=(1e-5, -2e-7, 1.5e-5))}
    readings = cal.Points("tool0", q, tips_of(ur5, q)[0])
    found = cal.calibrate(ur5, readings, [cal.Unknown("joint_offset", "wrist_3_joint")], frames=frames)
    found.save(tmp_path / "calibration.yaml")
    text = (tmp_path / "calibration.yaml").read_text()
    saved = yaml.safe_load(text)
    assert saved == json.loads(text)
    assert saved["frames"]["camera"]["position"] == [1e-5, -2e-7, 1.5e-5]
    assert saved["unknowns"]["joint_offset[wrist_3_joint]"]["sigma"] is None


@pytest.mark.parametrize(
    ("error", "message", "unknowns", "options"),
    [
        (TypeError, "unknowns is a sequence", ["joint_offset"], {}),
        (KeyError, "no body 'tool0'", [("body_position", "tool0")], {}),
        (KeyError, "no frame 'camera'", [("frame_position", "camera")], {}),
        (ValueError, "is unknown twice", [("joint_offset", "*"), ("joint_offset", "elbow_joint")], {}),
        (ValueError, "called 'tool0', as a frame", [("joint_offset", "*")], dict(frames={"tool0": cal.FixedFrame()})),
        (KeyError, "no frame 'hand'", [("joint_offset", "*")], dict(frames={"camera": cal.FixedFrame("hand")})),
    ],
)
def test_wrong_arguments_are_told(ur5: osik.Robot, error, message: str, unknowns: list, options: dict):
    reading = cal.Points("tool0", np.zeros((2, 6)), np.zeros((2, 3)))
    unknowns = [cal.Unknown(*one) if isinstance(one, tuple) else one for one in unknowns]
    refuses(error, message, cal.calibrate, ur5, reading, unknowns, **options)
