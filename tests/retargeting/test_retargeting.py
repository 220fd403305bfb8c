"""Retargeting to NAO: judged by MuJoCo, dense linear algebra and central differences."""

import dataclasses
import json
import re
from typing import Any
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_files import bent_forward, dancer, sliding, write_bvh
from products import HIGHEST, products_of
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from small_robots import assert_limits_hold, by_mujoco, nao_soles

import osik_jax as osik
from osik_jax import cli
from osik_jax.execution import _backends
from osik_jax.kinematics import forward_kinematics
from osik_jax.kinematics._forward import home_kinematics
from osik_jax.retargeting import (
    HumanMotion,
    Retargeter,
    RobotMotion,
    _plan,
    guess_profile,
    load_motion,
    load_profile,
    report,
    retarget,
    save_profile,
)
from osik_jax.retargeting._balance import overhang
from osik_jax.retargeting._banded import BandedSystem, has_kernel, solve_banded
from osik_jax.retargeting._body import Build, pairs_apart
from osik_jax.retargeting._contact import find_contact, find_ground
from osik_jax.retargeting._facing import by_name
from osik_jax.retargeting._finish import follow
from osik_jax.retargeting._folder import retarget_folder
from osik_jax.retargeting._link_shapes import shrunk
from osik_jax.retargeting._person import read_person
from osik_jax.retargeting._plan import _Clip, _improved, _State, make_plan
from osik_jax.retargeting._profile_file import find_profile
from osik_jax.retargeting._report import notes
from osik_jax.retargeting._roles import NEEDED, SIDES
from osik_jax.retargeting._skeletons import find_roles
from osik_jax.retargeting._terms import Body, frame_rows
from osik_jax.robot.loading import example_urdf
from osik_jax.robot.loading._meshes import unread_points

FPS = 30.0


@pytest.fixture(scope="module")
def dance(tmp_path_factory):
    """The figure's file: 30 frames in centimetres."""
    return write_bvh(tmp_path_factory.mktemp("clips") / "dance.bvh", dancer(30), 0.01)


@pytest.fixture(scope="module")
def danced(nao, dance):
    return retarget(nao, load_motion(dance))


@pytest.fixture
def prepared(nao, dance):
    """A retargeter, and the figure's clip as it plans it."""
    own = Retargeter(nao)
    return own, own._prepared(load_motion(dance), None, None)


def banded_and_dense(rng, frames, n, m=2):
    """A positive definite system with its dense matrix."""
    dense = np.zeros((frames * n, frames * n))
    square, rows = np.zeros((frames, n, n)), rng.normal(size=(frames, m, n))
    alone, weight = rng.uniform(1.0, 2.0, size=(frames, n)), rng.uniform(size=(frames, m))
    first, second = rng.normal(size=(2, frames, n))
    for t in range(frames):
        factor = rng.normal(size=(n, n))
        square[t] = factor @ factor.T + 4.0 * n * np.eye(n)
        at = slice(t * n, (t + 1) * n)
        dense[at, at] = square[t] + np.diag(alone[t])
        coupled = np.diag(first[t]) - (rows[t].T * weight[t]) @ rows[t - 1]
        for back, block in ((1, coupled), (2, np.diag(second[t]))):
            if t >= back:
                before = slice((t - back) * n, (t - back + 1) * n)
                dense[at, before], dense[before, at] = block, block.T
    return BandedSystem(*map(jnp.asarray, (square, alone, rows, weight, first, second))), dense


def test_a_banded_system_is_solved_as_the_dense_one():
    rng = np.random.default_rng(0)
    frames, n = 7, 3
    system, dense = banded_and_dense(rng, frames, n)
    right = rng.normal(size=(frames, n))
    x = solve_banded(system, jnp.asarray(right))
    np.testing.assert_allclose(x, np.linalg.solve(dense, right.ravel()).reshape(frames, n), rtol=1e-10, atol=1e-12)


@pytest.mark.skipif(not _backends.cuda_is_default(), reason="needs a CUDA device")
def test_the_gpu_kernel_solves_a_banded_system_as_the_dense_one():
    rng = np.random.default_rng(3)
    lanes, frames, n = 20, 5, 13
    systems, dense = zip(*(banded_and_dense(rng, frames, n) for _ in range(lanes)), strict=True)
    right = rng.normal(size=(lanes, frames, n))
    single = jax.tree.map(lambda *a: jnp.stack(a).astype(jnp.float32), *systems)
    assert has_kernel(single)
    x = jax.vmap(solve_banded)(single, jnp.asarray(right, jnp.float32))
    for lane in range(lanes):
        exact = np.linalg.solve(dense[lane], right[lane].ravel()).reshape(frames, n)
        np.testing.assert_allclose(x[lane], exact, atol=2e-6 * np.abs(exact).max())


@pytest.mark.slow
def test_rows_of_a_frame_have_the_derivatives_of_their_residuals(nao, dance):
    profile = find_profile(nao)
    person = read_person(load_motion(dance), find_roles(load_motion(dance).joint_names))
    build = Build.of(nao, profile)
    goals = jax.tree.map(lambda leaf: jnp.asarray(leaf[7]), build.goals(person))
    body = Body.of(nao, profile, pairs_apart(nao, profile)[:1], 0.01)
    bounds = build.bounds(np.full(nao.nv, 240.0), 1.0 / FPS)
    rng = np.random.default_rng(1)
    q = osik.integrate(nao, nao.q0, jnp.asarray(rng.normal(scale=0.1, size=nao.nv)))
    # where a turn's goal is met the rotation vector's derivative is the angular velocity itself
    turned = home_kinematics(dataclasses.replace(nao, q0=q)).frame_poses(nao, (profile.pelvis, "l_sole", "r_sole"))[1]
    own = [turn @ home.T for turn, home in zip(turned, (body.home[0], body.home[2], body.home[3]), strict=True)]
    goals = dataclasses.replace(goals, pelvis=own[0], feet=jnp.stack(own[1:]))

    @jax.jit
    @jax.vmap
    def rows_at(move):
        return frame_rows(body, osik.integrate(nao, q, move), goals, profile.weights, bounds)

    step = 1e-6
    rows = rows_at(step * jnp.concatenate([jnp.zeros((1, nao.nv)), jnp.eye(nao.nv), -jnp.eye(nao.nv)]))
    values = np.concatenate([rows.residual, rows.stance], 1)
    jacobian = np.concatenate([rows.jacobian[0], rows.stance_jacobian[0]])
    slopes = (values[1 : nao.nv + 1] - values[nao.nv + 1 :]).T / (2.0 * step)
    np.testing.assert_allclose(slopes, jacobian, atol=2e-8)


@pytest.mark.slow
def test_nao_dances_with_its_feet_where_they_are(nao, danced):
    figures = report(danced)
    assert figures["feet"]["contact_share"] == 1.0
    assert figures["feet"]["slip_mm_max"] < 0.01
    assert figures["feet"]["float_mm_max"] < 0.01 and figures["feet"]["below_floor_mm_max"] < 0.01
    assert figures["tracking"]["segment_angle_deg_mean"] < 0.5
    assert figures["shapes"]["penetration_mm_max"] == 0.0
    assert figures["joints"]["jump_frames"] == 0 and figures["joints"]["beyond_range_max"] == 0.0
    # the same from the file's numbers alone: soles stand where MuJoCo has them
    corners = nao_soles(nao, danced.motion.qpos)
    assert np.abs(corners[..., 2]).max() < 1e-5 and np.ptp(corners, axis=0).max() < 1e-5
    assert np.ptp(danced.q[:, 2]) > 0.005  # and the waist goes down and up


def edge_distance(point, corners):
    """From a convex hull's edge, positive outside: SciPy's facets inside, the nearest point of its edges outside."""
    hull = ConvexHull(corners)
    inside = (hull.equations[:, :2] @ point + hull.equations[:, 2]).max()
    if inside <= 0.0:
        return inside
    start, end = corners[hull.simplices[:, 0]], corners[hull.simplices[:, 1]]
    along = np.sum((point - start) * (end - start), -1) / np.sum((end - start) ** 2, -1)
    return np.linalg.norm(start + np.clip(along, 0.0, 1.0)[:, None] * (end - start) - point, axis=-1).min()


def test_the_distance_from_the_edge_of_the_feet_and_its_derivative():
    rng, step = np.random.default_rng(6), 1e-7
    for _ in range(20):
        corners, stands = rng.normal(size=(8, 2)), rng.permutation([1.0] * 5 + [0.0] * 3)
        center, moves = rng.normal(size=2), rng.normal(size=(9, 2))
        found = overhang(jnp.asarray(center), jnp.asarray(corners), jnp.asarray(stands))
        assert found.distance == pytest.approx(edge_distance(center, corners[stands > 0]), abs=1e-12)
        ends = [edge_distance(center + s * moves[8], (corners + s * moves[:8])[stands > 0]) for s in (step, -step)]
        slope = found.direction @ (moves[8] - found.coefficients @ moves[:8])
        assert slope == pytest.approx((ends[0] - ends[1]) / (2.0 * step), abs=1e-6)
        turns = np.linspace(0.0, np.pi, 20_000)
        across = corners[stands > 0] @ np.stack([np.cos(turns), np.sin(turns)])
        assert found.width == pytest.approx(np.ptp(across, axis=0).min(), abs=1e-3)
    for same in (corners[:1] + np.zeros((8, 2)), np.zeros((8, 2))):  # no edge, and nothing but the point itself
        found = overhang(jnp.zeros(2), jnp.asarray(same), jnp.ones(8))
        assert not any(np.isnan(part).any() for part in found)


@pytest.fixture(scope="module")
def leaning(dance):
    """The figure bends forward while it dances."""
    return bent_forward(load_motion(dance))


@pytest.mark.slow
def test_the_centre_of_mass_stays_over_the_feet_where_that_is_asked_for(nao, leaning, dance, tmp_path, capsys):
    free, kept = retarget(nao, leaning), retarget(nao, leaning, balance=0.01)
    assert kept.contact.all()
    margins = []
    for result in (free, kept):
        centers = by_mujoco(nao, result.motion.qpos, lambda data: data.subtree_com[0, :2])
        soles = nao_soles(nao, result.motion.qpos)[..., :2]
        margins.append([-edge_distance(center, corners) for center, corners in zip(centers, soles, strict=True)])
    without, within = map(min, margins)
    assert without < -0.01 and within > 0.01 - 5e-5
    figures = report(kept)
    assert figures["balance"]["double_support_frames"] == 30 and figures["balance"]["com_inside_share"] == 1.0
    assert figures["balance"]["com_margin_mm_min"] == pytest.approx(1e3 * within, abs=1e-6)
    assert report(free)["balance"]["com_inside_share"] == pytest.approx(np.mean(np.array(margins[0]) >= 0.0))
    assert figures["feet"]["slip_mm_max"] < 0.05 and figures["feet"]["below_floor_mm_max"] < 0.05
    assert figures["joints"]["jump_frames"] == 0 and figures["joints"]["beyond_range_max"] == 0.0
    # on one foot it is where it was
    one_foot = np.tile([True, True, False, False], (30, 1))
    alone = [retarget(nao, dataclasses.replace(leaning, contact=one_foot), balance=b).q for b in (None, 0.01)]
    np.testing.assert_allclose(alone[0], alone[1], atol=1e-9)
    out = tmp_path / "out"
    assert cli.main(["retarget", str(dance), "--out", str(out), "--balance", "0.02"]) == 0
    assert json.loads((out / "report.json").read_text())["balance"]["com_margin_mm_min"] > 20.0 - 0.05
    capsys.readouterr()


def test_limits_hold_exactly(nao, dance, danced):
    tight = Retargeter(nao, acceleration=12.0).retarget(load_motion(dance))
    assert np.abs(np.diff(danced.motion.qpos[:, 7:], 2, axis=0)).max() * FPS**2 > 15.0  # so that the limit is one
    assert_limits_hold(nao, tight.motion.qpos[:, 7:], FPS, 12.0, tight.motion.joint_names)
    # met by leading: the plan keeps them by itself, and the feet stay
    assert tight.off_plan.max() < 1e-3
    assert report(tight)["feet"]["slip_mm_max"] < 0.5


def test_many_clips_give_what_each_gives_alone(nao, dance, danced, monkeypatch):
    motion = load_motion(dance)
    short = dataclasses.replace(motion, name="short", positions=motion.positions[:21], rotations=None)
    own = Retargeter(nao)
    with monkeypatch.context() as batched:  # as on a GPU
        batched.setattr("osik_jax.retargeting._retarget.cpu_is_default", lambda: False)
        together = own.retarget_all([motion, short, motion], chunk=2, progress=False)
    assert [len(result.q) for result in together] == [30, 21, 30]
    np.testing.assert_allclose(together[0].q, danced.q, atol=1e-5)
    np.testing.assert_array_equal(together[2].q, together[0].q)
    np.testing.assert_allclose(together[1].q, own.retarget(short).q, atol=1e-5)
    alone = [own._made(own._prepared(clip, None, None), 32) for clip in (motion, short, motion)]
    by_cores = own.retarget_all([motion, short, motion], progress=False)
    for one, other, batched in zip(by_cores, alone, together, strict=True):
        np.testing.assert_array_equal(one.q, other.q)
        assert (one.iterations, one.cost) == (other.iterations, other.cost)
        assert one.iterations == batched.iterations
        np.testing.assert_allclose(one.q, batched.q, atol=1e-12)
    ((_, filled_up),) = own._solved([(0, own._prepared(short, None, None))], 32, 2)
    np.testing.assert_allclose(filled_up().q, together[1].q, atol=1e-12)
    with pytest.raises(ValueError, match="chunk is 0"):
        own.retarget_all([motion], chunk=0, progress=False)
    with pytest.raises(ValueError, match="short: .*it takes three"):
        own.retarget_all([motion, dataclasses.replace(short, positions=short.positions[:2])], progress=False)


def test_more_smoothness_is_less_acceleration_and_feet_stay(nao, dance, danced, monkeypatch):
    """Of a clip whose arms are noisy; slip, ranges and speeds are held as without."""
    motion, rng = load_motion(dance), np.random.default_rng(4)
    positions = motion.positions.copy()
    arms = [i for i, name in enumerate(motion.joint_names) if "Arm" in name or "Hand" in name]
    positions[:, arms] += rng.normal(scale=0.02, size=(len(positions), len(arms), 3))
    noisy = dataclasses.replace(motion, positions=positions, rotations=None)
    monkeypatch.setattr(_plan, "_from_a_part", None)  # what a plan that is compiled again would call
    mean_squares, angles = [], []
    own = [7 + danced.motion.joint_names.index(name) for name in nao.joint_names]  # less what follows another
    for smoothness in (0.0, 0.03, 0.1):
        result = Retargeter(nao, smoothness=smoothness).retarget(noisy)
        q, figures = result.motion.qpos[:, own], report(result)
        acceleration, jerk = (np.diff(q, n, axis=0) * FPS**n for n in (2, 3))
        mean_squares.append([np.mean(acceleration**2), np.mean(jerk**2)])
        assert figures["feet"]["slip_mm_max"] < 0.1
        assert_limits_hold(nao, q, FPS)
        np.testing.assert_allclose(figures["joints"]["acceleration_rms"] ** 2, mean_squares[-1][0], rtol=1e-9)
        np.testing.assert_allclose(figures["joints"]["jerk_rms"] ** 2, mean_squares[-1][1], rtol=1e-9)
        angles.append(figures["tracking"]["segment_angle_deg_mean"])
    least = np.array(mean_squares)
    assert (least[1:] < 0.5 * least[:-1]).all() and angles[0] < angles[-1]  # and that is what it costs
    with pytest.raises(ValueError, match="smoothness is -1.0; it is a time in seconds"):
        Retargeter(nao, smoothness=-1.0)


def test_a_folder_goes_on_where_it_was(nao, dance, danced, tmp_path, capsys, monkeypatch):
    clips, out = tmp_path / "clips", tmp_path / "out"
    clips.mkdir()
    motion = load_motion(dance)
    (clips / "dance.bvh").write_bytes(dance.read_bytes())
    (clips / "broken.bvh").write_text("HIERARCHY")
    (clips / "notes.txt").write_text("no clip")
    np.savez(clips / "short.npz", fps=FPS, positions=motion.positions[:21], joint_names=np.array(motion.joint_names))

    def kill(done, of):
        assert of == 3
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), monkeypatch.context() as one_core:
        one_core.setattr("osik_jax.retargeting._retarget.cores", lambda: 1)
        retarget_folder(Retargeter(nao), clips, out, progress=kill)
    first = out / "dance" / "report.json"  # the longest
    before = first.stat().st_mtime_ns
    assert cli.main(["retarget", str(clips), "--out", str(out)]) == 1
    told, wrong = capsys.readouterr()
    assert "no clips, and not read: notes.txt\n" in told
    assert "2 clips, 51 frames" in told and "osik: 1 of 3 clips failed" in wrong
    assert "broken: " in wrong and "ends where ROOT should come" in wrong
    assert first.stat().st_mtime_ns == before
    assert {path.name for path in (out / "short").iterdir()} == {"motion.npz", "motion.csv", "report.json"}
    summary = json.loads((out / "report.json").read_text())
    assert set(summary["figures"]) == {"dance", "short"} and set(summary["failed"]) == {"broken"}
    index = [line.split(",") for line in (out / "index.csv").read_text().splitlines()]
    assert [row[0] for row in index] == ["clip", "broken", "dance", "short"] and "ROOT" in ",".join(index[1])
    assert float(index[2][index[0].index("slip_mm_max")]) == summary["figures"]["dance"]["slip_mm_max"]
    slips = [json.loads((out / name / "report.json").read_text())["feet"]["slip_mm_max"] for name in ("dance", "short")]
    assert summary["worst"]["slip_mm_max"] == max(slips) < 0.1
    np.testing.assert_allclose(RobotMotion.load(out / "dance" / "motion.npz").qpos, danced.motion.qpos, atol=1e-5)
    # what is there is not made again, but where its file is another one now
    made = []
    monkeypatch.setattr(Retargeter, "_made", lambda own, clip, length: made.append(length))
    again = retarget_folder(Retargeter(nao), clips, out, progress=False)
    assert again == summary and made == []

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("osik_jax.retargeting._folder.retarget_folder", interrupted)
    assert cli.main(["retarget", str(clips), "--out", str(out)]) == 130
    assert f"the same command goes on where it was ({out})" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"another job in it.*smoothness was 0\.0, is 0\.1"):
        retarget_folder(Retargeter(nao, smoothness=0.1), clips, out, progress=False)
    with pytest.raises(ValueError, match=r"has no clips \(.bvh, .npz\); in it: dance, short"):
        (out / "job.json").unlink()
        for path in [*out.glob("*.*")]:
            path.unlink()
        retarget_folder(Retargeter(nao), out, tmp_path / "none", progress=False)


def test_the_last_lines_say_what_gave_way_and_that_feet_hardly_stand(dance, danced, tmp_path, capsys):
    """A hand that holds what moves by 18 m cannot follow it."""
    assert report(danced)["notes"] == []
    motion, many = load_motion(dance), tmp_path / "clips"
    box = np.linspace([-9.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], [9.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], motion.frames)
    held: Any = {"object.box": box, "touch.left_wrist.box": np.ones(motion.frames, bool)}
    many.mkdir()
    names = np.array(motion.joint_names)
    np.savez(many / "dance.npz", fps=FPS, positions=motion.positions, joint_names=names, **held)
    arguments = ["--out", str(tmp_path / "out")]
    assert cli.main(["retarget", str(many / "dance.npz"), *arguments]) == 0
    last = capsys.readouterr().out.strip().splitlines()[-1]
    figures = json.loads((tmp_path / "out" / "report.json").read_text())
    assert max(figures["feet"]["slip_mm_max"], figures["touches"]["off_mm_max"]) > 5.0
    assert last == f"note: {figures['notes'][-1]}" and last.startswith("note: a bound gave way: ")
    rare = dataclasses.replace(danced, contact=danced.contact & (np.arange(30) < 5)[:, None])
    assert report(rare)["notes"][0].startswith("feet stand in 17 % of the frames")
    whole = report(danced)
    tipped = {**whole, "balance": {"com_margin_mm_min": -3.0}, "shapes": {"penetration_mm_max": 2.5}}
    assert notes(tipped) == ["a bound gave way: shapes overlap by 2.5 mm"]
    assert notes(tipped, 0.01)[1] == "a bound gave way: the centre of mass is 3.0 mm outside the feet"
    assert cli.main(["retarget", str(many), *arguments[:-1], str(tmp_path / "all")]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "note: dance: a bound gave way: " in told


def test_the_last_pass_keeps_limits_whatever_the_plan(nao):
    rng = np.random.default_rng(2)
    plan = jax.vmap(lambda v: osik.integrate(nao, nao.q0, v))(jnp.asarray(rng.normal(scale=0.5, size=(30, nao.nv))))
    most = np.full(nao.nv, 100.0)
    limits = (osik.ConfigurationLimit(nao), osik.VelocityLimit(nao), osik.AccelerationLimit(nao, most))
    q, off = follow(nao, plan, limits, 1.0 / FPS)
    assert off.max() > 0.1
    assert_limits_hold(nao, np.asarray(q)[:, [nao.joint_qpos_index(name) for name in nao.joint_names]], FPS, 100.0)


def test_files_come_back(danced, tmp_path):
    danced.save(tmp_path / "motion.npz")
    back = RobotMotion.load(tmp_path / "motion.npz")
    np.testing.assert_array_equal(back.qpos, danced.motion.qpos)
    with np.load(tmp_path / "motion.npz", allow_pickle=False) as data:
        pictured = {"human", "human_names", "human_bones", "human_standing"}
        assert set(data.files) == {"fps", "qpos", "joint_names", *pictured, "contact", "ground"}
        assert data["human"].shape == (30, len(data["human_names"]), 3) and data["contact"].shape == (30, 4)
        names = data["human_names"].tolist()
    assert {"left_heel", "right_toe", "left_wrist", "root"} <= set(names)


def test_the_command_writes_its_files(dance, tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main(["retarget", str(dance), "--out", str(out)]) == 0
    assert "written to" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {"motion.npz", "motion.csv", "report.json", "profile.toml"}
    figures = json.loads((out / "report.json").read_text())
    assert figures["clip"] == "dance" and figures["feet"]["slip_mm_max"] < 0.01
    motion = RobotMotion.load(out / "motion.npz")
    table = RobotMotion.load(out / "motion.csv", joint_names=motion.joint_names, fps=motion.fps)
    np.testing.assert_allclose(table.qpos, motion.qpos, atol=1e-8)
    assert load_profile(out / "profile.toml").keypoints == load_profile("nao").keypoints


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.bvh"], "no such file"),
        (["none"], "no such file: none"),
        (["DANCE", "--robot", "g2"], "no such file: g2 (robots by name: nao, arm7, g1, talos, "),
        (["DANCE", "--smooth", "-1"], "smoothness is -1.0; it is a time in seconds, 0 or more"),
        (["DANCE", "--balance", "-0.01"], "balance is -0.01; it is a length in metres, 0 or more"),
        (["DANCE", "--robot", "none.urdf"], "no such file: none.urdf"),
        (["DANCE", "--robot", "arm7"], "--base floating"),
        (["DANCE", "--profile", "none.toml"], "profiles that come with the package: nao, g1, talos"),
        (["DANCE", "--acceleration", "0"], "acceleration is 0.0; it has to be more than 0"),
        (["DANCE", "--mapping", "left_hip"], "--mapping takes ROLE=NAME; got left_hip"),
        (["DANCE", "--mapping", "left_hip=Hip"], "no joint of the clip 'Hip'"),
        (["DANCE", "--unit", "yard"], "no unit 'yard'"),
        (["NPZ", "--unit", "cm"], "unit goes with BVH files"),
        (["DANCE", "--base", "fixed"], "--base goes with a file; nao is what it is"),
    ],
)
def test_the_command_refuses_in_one_line(arguments, message, dance, tmp_path, capsys):
    files = {"DANCE": str(dance), "NPZ": str(tmp_path / "clip.npz")}
    np.savez(files["NPZ"], fps=30.0, qpos=np.zeros((3, 7)), joint_names=[])
    arguments = [files.get(word, word) for word in arguments]
    assert cli.main(["retarget", *arguments, "--out", str(tmp_path / "out")]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and message in lines[0]


SMPL = ("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
        "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
        "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist")  # fmt: skip
MIXAMO = tuple(f"mixamorig:{name}" for name in (
    "Hips", "Spine", "Neck", "Head", "LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand", "RightArm", "RightForeArm",
    "RightHand", "LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase", "RightUpLeg", "RightLeg", "RightFoot"))  # fmt: skip


def test_joints_are_found_by_the_names_that_files_use():
    smpl = find_roles(SMPL)
    assert smpl["left_toe"] == "left_foot" and smpl["left_ankle"] == "left_ankle" and smpl["chest"] == "spine2"
    mixamo = find_roles(MIXAMO)
    assert mixamo["left_shoulder"] == "mixamorig:LeftArm" and mixamo["right_knee"] == "mixamorig:RightLeg"
    assert mixamo["left_ankle"] == "mixamorig:LeftFoot" and "right_toe" not in mixamo
    short = find_roles(tuple(f"{side}_{name}" for side in "LR" for name in ("Hip", "Knee", "Ankle", "Shoulder", "Elbow",
                                                                          "Wrist")))  # fmt: skip
    assert short["right_elbow"] == "R_Elbow"
    with pytest.raises(ValueError, match="no left_wrist that can be told.*left_elbow=left_elbow.* joints: spine1"):
        find_roles(tuple(name for name in SMPL if name != "left_wrist"))
    with pytest.raises(KeyError, match="no joint of the clip 'hip'.* joints of the clip: pelvis, left_hip"):
        find_roles(SMPL, {"left_hip": "hip"})
    with pytest.raises(KeyError, match="no role 'left_hand'"):
        find_roles(SMPL, {"left_hand": "left_wrist"})
    with pytest.raises(ValueError, match="no right_hip"):
        find_roles(SMPL, {role: role for role in NEEDED if role != "right_hip"})


def test_contact_is_what_is_low_and_slow():
    frames, fps = 60, 30.0
    points = np.zeros((frames, 2, 3))
    points[:, 0, 2] = 0.02
    points[20:40, 0, 2] = 0.02 + 0.2 * np.sin(np.linspace(0.0, np.pi, 20))  # a step
    points[20:40, 0, 0] = np.linspace(0.0, 0.5, 20)
    points[40:, 0, 0] = 0.5
    points[:, 1, 0] = np.arange(frames) * 0.02  # slides at 0.6 m/s
    points[10, 0, 1] = 0.011  # a shake of one frame that comes back
    ground = find_ground(points)
    assert ground == 0.0
    stands = find_contact(points, fps, ground)
    assert stands[:19, 0].all() and stands[41:, 0].all() and not stands[21:39, 0].any() and not stands[:, 1].any()


def test_trunk_and_feet_are_turned_as_the_person_is(dance):
    motion = load_motion(dance)
    heading = Rotation.from_euler("z", 0.7).as_matrix()
    turned = dataclasses.replace(motion, positions=motion.positions @ heading.T, rotations=None)
    person = read_person(turned, find_roles(turned.joint_names))
    # hips do not turn in the dance, and the rest pose is upright
    np.testing.assert_allclose(person.pelvis, np.broadcast_to(heading, (30, 3, 3)), atol=1e-9)
    np.testing.assert_allclose(person.torso, np.broadcast_to(heading, (30, 3, 3)), atol=1e-9)
    np.testing.assert_allclose(person.feet[:, 0], np.broadcast_to(heading, (30, 3, 3)), atol=0.4)
    np.testing.assert_allclose(person.feet[:, 0, 2, 0], 0.0, atol=1e-9)  # flat
    for name in ("left_heel", "left_toe"):
        np.testing.assert_allclose(person.points[name][:, 2], 0.0, atol=1e-9)
    assert person.contact.all() and person.lengths["left_hip", "left_knee"] == pytest.approx(0.42)


@pytest.mark.variants(slow=["90.0", "180.0"])
@pytest.mark.parametrize("degrees", [180.0, 90.0, -90.0])
def test_a_robot_may_face_any_way_at_home(nao, degrees):
    q = np.array(nao.q0)
    turn = Rotation.from_euler("z", degrees, degrees=True)
    q[:3] = turn.apply(q[:3])
    q[3:7] = (turn * Rotation.from_quat(q[3:7], scalar_first=True)).as_quat(scalar_first=True)
    turned = nao.with_home(q)
    assert guess_profile(turned).keypoints == guess_profile(nao).keypoints
    ours, own = Retargeter(turned), Retargeter(nao)
    assert own.robot is nao
    np.testing.assert_allclose(ours.robot.q0[:3], nao.q0[:3], atol=1e-12)
    np.testing.assert_allclose(np.abs(ours.robot.q0[3:7] @ nao.q0[3:7]), 1.0, atol=1e-12)
    np.testing.assert_array_equal(ours.robot.q0[7:], nao.q0[7:])


def test_the_left_of_two_is_told_by_name():
    sides = dict(l_sole="r_sole", LeftFoot="RightFoot", LLEG_LINK5="RLEG_LINK5", leg_left_6_link="leg_right_6_link")
    for left, right in (*sides.items(), ("foot.L", "foot.R")):
        assert by_name([right, left]) == by_name([left, right]) == [left, right]
    for pair in (["foot_1", "foot_2"], ["lower_leg", "roller"], ["l_sole", "sole"]):
        assert by_name(pair) == pair


def test_feet_stay_where_limbs_pull_at_them(nao):
    """The legs of a person whose standing feet move apart pull for 90 frames; a step's slip adds up over all frames."""
    figures = report(Retargeter(nao).retarget(sliding(90, 0.1)))
    assert figures["feet"]["slip_mm_max"] < 0.1 and figures["feet"]["float_mm_max"] < 0.01
    assert figures["tracking"]["segment_angle_deg_mean"] > 1.0  # so that they pull


@pytest.mark.slow
def test_a_step_that_is_damped_does_not_end_a_plan_whose_bounds_are_broken(prepared):
    own, asked = prepared
    weights = own.profile.weights
    clip = _Clip(own._body, asked.goals, weights, asked.bounds, jnp.ones(len(asked.start)))
    plan = make_plan(own._body, asked.goals, weights, asked.bounds, asked.start, 100)

    @jax.jit
    def stepped(q, damping):
        before = _State.at(clip, q, 1.0, damping)
        return before.here.costs, _improved(clip, before)

    def counted(q, damping):
        costs, after = stepped(q, damping)
        gain = sum(costs) - sum(after.here.costs)
        assert 0.0 < gain < 2e-3 * costs[0]
        return int(after.settled)

    sunk = plan.q.at[:, 2].add(-0.02)
    assert counted(plan.q, 1e4) == 2 and counted(sunk, 1e17) == 1


def test_a_guess_sees_the_same_robot(nao):
    guess, own = guess_profile(nao), load_profile("nao")
    assert find_profile(nao) == own
    same = {role for role in NEEDED if guess.keypoints[role][0] == own.keypoints[role][0]}
    assert same == set(NEEDED) - {"left_hip", "right_hip"}
    guessed, made = Build.of(nao, guess).points, Build.of(nao, own).points
    for role in NEEDED:  # of a profile that was found by clips, points have moved a little
        np.testing.assert_allclose(guessed[role], made[role], atol=1e-3)
    assert guess.feet == own.feet and guess.pelvis == "torso" and guess.torso is None


def test_a_g1_is_guessed_from_its_urdf():
    g1 = osik.Robot.from_urdf(example_urdf("g1"), floating_base=True)
    guess, own = guess_profile(g1), load_profile("g1")
    assert find_profile(g1) == own
    for side in ("left", "right"):
        # the URDF's balls of 5 mm at these places, 30 mm below the ankle
        np.testing.assert_allclose(guess.feet[side].heel, [[-0.05, 0.025, -0.035], [-0.05, -0.025, -0.035]], atol=1e-9)
        np.testing.assert_allclose(guess.feet[side].toe, [[0.12, 0.03, -0.035], [0.12, -0.03, -0.035]], atol=1e-9)
    assert (guess.pelvis, guess.torso) == ("pelvis", "torso_link")
    for role in ("left_knee", "right_elbow", "left_wrist", "right_shoulder"):
        assert guess.keypoints[role][0] == own.keypoints[role][0]
        np.testing.assert_allclose(own.keypoints[role][1], guess.keypoints[role][1], atol=0.02)


@pytest.mark.variants(release=["romeo_description/urdf/romeo.urdf-l_wrist"])
@pytest.mark.parametrize(
    ("urdf", "wrist"),
    [
        ("talos_data/robots/talos_full_v2.urdf", "arm_left_7_link"),
        ("talos_data/robots/talos_reduced.urdf", "arm_left_7_link"),
        ("romeo_description/urdf/romeo.urdf", "l_wrist"),
    ],
)
def test_a_wrist_is_not_what_grips(urdf, wrist):
    robot = osik.Robot.from_urdf(example_urdf("g1").parents[2] / urdf, floating_base=True)
    assert guess_profile(robot).keypoints["left_wrist"][0] == wrist


def test_talos_comes_with_a_profile_whose_soles_are_those_of_its_urdf():
    path = example_urdf("talos")
    talos, own = osik.Robot.from_urdf(path, floating_base=True), load_profile("talos")
    assert find_profile(talos) == own
    boxes = ElementTree.parse(path.with_name("talos_full_v2_box.urdf")).getroot()
    for side in SIDES:
        (size,) = boxes.iterfind(f"./link[@name='leg_{side}_6_link']/collision/geometry/box")
        length, width = (float(number) for number in size.attrib["size"].split()[:2])
        corners = np.array([*own.feet[side].heel, *own.feet[side].toe])
        signs = np.array([[-1, 1, 0], [-1, -1, 0], [1, 1, 0], [1, -1, 0]])
        np.testing.assert_allclose(corners, 0.5 * signs * [length, width, 0.0])
    made, guessed = (Build.of(talos, profile).points for profile in (own, guess_profile(talos)))
    for role in NEEDED:
        np.testing.assert_allclose(made[role], guessed[role], atol=0.02 * np.sqrt(3.0))


@pytest.mark.release
def test_talos_dances_with_its_feet_where_they_are(dance):
    talos = osik.Robot.from_urdf(example_urdf("talos"), floating_base=True)
    figures = report(retarget(talos, load_motion(dance)))
    assert figures["feet"]["contact_share"] == 1.0 and figures["feet"]["slip_mm_max"] < 0.05
    assert figures["feet"]["float_mm_max"] < 0.05 and figures["feet"]["below_floor_mm_max"] < 0.05
    assert figures["joints"]["beyond_range_max"] == 0.0 and figures["joints"]["speed_over_limit_max"] <= 1.0 + 1e-9
    assert figures["joints"]["jump_frames"] == 0 and figures["shapes"]["penetration_mm_max"] < 1.0
    assert figures["tracking"]["segment_angle_deg_mean"] < 2.0


def outside_capsules(robot, capsules, points):
    """How far points of the world are outside the nearest capsule of a robot at home, negative inside [m]."""
    places, distances = home_kinematics(robot), []
    for capsule in capsules:
        position, rotation = (np.asarray(x) for x in places.frame_pose(robot, capsule.frame))
        a, b = position + np.array([capsule.start, capsule.end]) @ rotation.T
        share = np.clip((points - a) @ (b - a) / np.dot(b - a, b - a), 0.0, 1.0)
        distances.append(np.linalg.norm(points - a - share[:, None] * (b - a), axis=-1) - capsule.radius)
    return np.min(distances, 0)


@pytest.mark.parametrize("name", ["g1", "talos"])
def test_guessed_capsules_cover_the_meshes_of_limbs(name):
    """The vertices of the collision meshes, beside capsules out of masses alone."""
    plain = osik.Robot.from_urdf(example_urdf(name), floating_base=True)
    places, vertices = home_kinematics(plain), []
    for mesh in plain.holder.meshes:
        if re.search(r"gripper|leg_.*_[56]|ankle", mesh.link):
            continue  # feet have their corners, and fingers are too light
        position, turn = (np.asarray(part) for part in places.frame_pose(plain, mesh.link))
        vertices.append((unread_points(mesh) @ np.array(mesh.rotation).T + mesh.position) @ turn.T + position)
    outside = np.maximum(outside_capsules(plain, guess_profile(plain).capsules, np.concatenate(vertices)), 0.0)
    assert 1e3 * outside.mean() < {"g1": 0.3, "talos": 3.0}[name]


def triangles_of_g1(mesh):
    """The triangles of one of a G1's meshes, in its link's frame [m]. (n, 3, 3)."""
    raw = (example_urdf("g1").parents[1] / f"meshes/{mesh}.STL").read_bytes()
    faces = np.frombuffer(raw[84:], np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")]))
    return faces["corners"].astype(float)


def test_capsules_of_the_g1_cover_its_trunk():
    """The surface of the mesh, by area: two capsules side by side left a groove of 33 mm between them."""
    g1 = osik.Robot.from_urdf(example_urdf("g1"), floating_base=True)
    trunk = [capsule for capsule in load_profile("g1").capsules if capsule.frame == "torso_link"]
    triangles = triangles_of_g1("torso_link_rev_1_0")
    position, rotation = (np.asarray(x) for x in home_kinematics(g1).frame_pose(g1, "torso_link"))
    edges = triangles[:, 1:] - triangles[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    outside = outside_capsules(g1, trunk, position + triangles.mean(1) @ rotation.T)
    assert outside.max() < 0.016
    assert area[outside > 0.009].sum() < 0.003 * area.sum()


@pytest.mark.parametrize("part", ["rubber_hand", "wrist_yaw_link"])
def test_guessed_capsules_of_hands_cover_thumbs_and_wrists(part):
    """The vertices of a G1's hands as they look; the hand is fixed to a wrist that is too light for a capsule."""
    path = example_urdf("g1")
    g1 = osik.Robot.from_urdf(path, floating_base=True)
    profile, places = guess_profile(g1), home_kinematics(g1)
    for side in SIDES:
        position, rotation = (np.asarray(x) for x in places.frame_pose(g1, f"{side}_{part}"))
        at = position + triangles_of_g1(f"{side}_{part}").reshape(-1, 3) @ rotation.T
        hands = [capsule for capsule in profile.capsules if capsule.frame == f"{side}_rubber_hand"]
        most = 1e3 * outside_capsules(g1, hands, at).max()
        assert most < {"rubber_hand": 6.0, "wrist_yaw_link": 0.0}[part]  # 22 and 30 mm when hands were as limbs


def test_links_without_a_size_get_no_capsule():
    path = example_urdf("g1").parents[2] / "icub_description/robots/icub_reduced.urdf"
    icub = osik.Robot.from_urdf(path, floating_base=True)
    profile = guess_profile(icub)
    capsules = {capsule.frame: capsule.radius for capsule in profile.capsules}
    assert "l_ankle_2" not in capsules and min(capsules.values()) > 1e-3
    assert any(capsule.start == capsule.end for capsule in profile.capsules)  # balls
    assert Retargeter(icub, profile=profile)._pairs


@pytest.mark.variants(slow=["romeo_description/urdf/romeo.urdf-LHipPitchLink-ends1"])
@pytest.mark.parametrize(
    ("urdf", "link", "ends"),
    [
        ("icub_description/robots/icub.urdf", "chest", ("l_shoulder_1", "r_shoulder_1")),
        ("romeo_description/urdf/romeo.urdf", "LHipPitchLink", ("LHipPitchLink", "LKneePitchLink")),
    ],
)
def test_links_are_no_longer_than_between_their_joints(urdf, link, ends):
    """By their inertias an iCub's chest is 63 cm wide, and a Romeo's thigh 88 cm long."""
    robot = osik.Robot.from_urdf(example_urdf("g1").parents[2] / urdf, floating_base=True)
    places = home_kinematics(robot)
    first, last = (np.asarray(places.frame_pose(robot, frame)[0]) for frame in ends)
    along = (last - first) / np.linalg.norm(last - first)
    capsules = [capsule for capsule in guess_profile(robot).capsules if capsule.frame == link]
    position, rotation = (np.asarray(x) for x in places.frame_pose(robot, link))
    for c in capsules:
        at = (position + np.array([c.start, c.end]) @ rotation.T - first) @ along
        room = 2.0 * max(capsule.radius for capsule in capsules) + 1e-6  # a housing, and the capsule's round end
        assert at.min() - c.radius > -room and at.max() + c.radius < np.linalg.norm(last - first) + room
    assert capsules


def test_links_that_are_too_light_for_their_size_are_made_smaller():
    """An ellipsoid of water weighs 4/3 pi a b c times 1,000; one of 8 times its volume and its mass is too light."""
    axes = np.array([0.2, 0.1, 0.05])
    mass = 4.0 / 3.0 * np.pi * float(np.prod(axes)) * 1000.0
    assert shrunk(mass, 2.0 * axes) == pytest.approx(0.5)
    assert shrunk(mass, axes) == shrunk(mass, 1.5 * axes) == 1.0


def test_limbs_that_are_straight_at_home_begin_bent(nao):
    profile = load_profile("nao")
    np.testing.assert_array_equal(Build.of(nao, profile).start, nao.q0)  # nothing is at an end of its range
    elbows = {side: nao.joint_qpos_index(f"{side}ElbowRoll") for side in "LR"}
    straight = np.array(nao.q0)
    straight[elbows["L"]] = nao.position_upper[nao.joint_dof_index("LElbowRoll")]
    straight[elbows["R"]] = nao.position_lower[nao.joint_dof_index("RElbowRoll")]
    other = dataclasses.replace(nao, q0=jnp.asarray(straight))
    start = Build.of(other, profile).start
    assert set(np.flatnonzero(start != straight)) == set(elbows.values())
    for side, turn in (("L", -1.0), ("R", 1.0)):
        width = 1.54461 - 0.0349066  # NAO's documentation: elbow roll from 2 to 88.5 degrees
        assert start[elbows[side]] - straight[elbows[side]] == pytest.approx(turn * width / 2, abs=1e-3)
    straight[elbows["R"]] += 0.03 * width  # overstretched by as much as a GR3's
    nearly = Build.of(dataclasses.replace(nao, q0=jnp.asarray(straight)), profile).start
    np.testing.assert_allclose(nearly, start, atol=1e-12)


def test_robots_that_cannot_walk_are_refused():
    arm = osik.load_robot("arm7")
    with pytest.raises(ValueError, match="floating_base=True"):
        Retargeter(arm)
    with pytest.raises(ValueError, match="bolted down"):
        guess_profile(arm)


@pytest.mark.slow
def test_a_plan_that_begins_on_its_side_ends_on_its_soles(nao, prepared):
    """On their backs, feet have their corners on the floor too, which is what bounds ask for."""
    own, clip = prepared
    start = clip.start.copy()
    rolled = Rotation.from_euler("x", 120.0, degrees=True) * Rotation.from_quat(start[:, 3:7], scalar_first=True)
    start[:, 3:7] = rolled.as_quat(scalar_first=True)
    plan = make_plan(own._body, clip.goals, own.profile.weights, clip.bounds, start, 100)
    turns = [forward_kinematics(nao, q).frame_poses(nao, ("l_sole", "r_sole"))[1] for q in plan.q[: clip.frames : 10]]
    assert np.array(turns)[..., 2, 2].min() > 1.0 - 1e-6
    assert float(plan.cost[1]) < 1e-4


def test_products_are_in_full_precision(prepared):
    """A GPU takes TF32 otherwise, and a plan in single precision does not see its end."""
    own, clip = prepared
    program = jax.make_jaxpr(make_plan)(own._body, clip.goals, own.profile.weights, clip.bounds, clip.start, 1)
    products = list(products_of(program.jaxpr))
    assert len(products) > 20 and all(precision == (HIGHEST, HIGHEST) for precision in products)


def test_profiles_come_back_and_say_what_is_wrong(nao, tmp_path):
    profile = dataclasses.replace(load_profile("g1"), scale=0.8, stretch=1.1)
    save_profile(profile, tmp_path / "robot.toml")
    assert load_profile(tmp_path / "robot.toml") == profile
    with pytest.raises(KeyError, match="no frame 'pelvis'"):
        Retargeter(nao, profile=profile)
    text = (tmp_path / "robot.toml").read_text()
    for old, new, message in (
        ('pelvis = "pelvis"', "", "there is no pelvis"),
        ("limb = 1.0", "limbs = 1.0", "no weight 'limbs'"),
        ("limb = 1.0", "limb = -1.0", "weights.limb is -1.0"),
        ("left_hip = ", "left_hips = ", "no keypoints left_hip"),
        ("scale = 0.8", "scale = 0.0", "scale is 0.0"),
        ("stretch = 1.1", "stretch = 0.0", "stretch is 0.0"),
        ("[feet.left]", "[feet.left", "is no TOML"),
        ("radius = ", "radius = -", "has radius -.*; it is a length in metres, over 0"),
    ):
        assert old in text
        (tmp_path / "broken.toml").write_text(text.replace(old, new))
        with pytest.raises(ValueError, match=message):
            load_profile(tmp_path / "broken.toml")


def test_clips_that_are_too_short_or_lack_joints_are_refused(nao, dance):
    motion = load_motion(dance)
    short = dataclasses.replace(motion, positions=motion.positions[:2], rotations=None)
    with pytest.raises(ValueError, match="2 frames; it takes three"):
        retarget(nao, short)
    wrong: Any
    for wrong in (0, -3, 2.5, None):
        with pytest.raises(ValueError, match=f"max_iterations is {wrong}; it is an integer, at least 1"):
            Retargeter(nao, max_iterations=wrong)
    with pytest.raises(ValueError, match="has no left_hip"):
        retarget(nao, HumanMotion("clip", 30.0, ("Hips",), np.zeros((5, 1, 3))))
