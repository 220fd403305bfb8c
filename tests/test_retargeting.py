"""Retargeting to NAO: judged by MuJoCo, dense linear algebra and central differences."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from motion_files import dancer, write_bvh
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax import cli
from osik_jax._home import home_kinematics
from osik_jax.retargeting import (
    HumanMotion,
    Retargeter,
    find_profile,
    find_roles,
    guess_profile,
    load_motion,
    load_profile,
    load_robot_motion,
    report,
    retarget,
    save_profile,
)
from osik_jax.retargeting._banded import BandedSystem, solve_banded
from osik_jax.retargeting._body import Build, pairs_apart
from osik_jax.retargeting._contact import find_contact, find_ground
from osik_jax.retargeting._finish import follow
from osik_jax.retargeting._g1 import g1_urdf
from osik_jax.retargeting._person import NEEDED, read_person
from osik_jax.retargeting._terms import Body, frame_rows

FPS = 30.0


@pytest.fixture(scope="module")
def nao():
    return osik.load_robot("nao")


@pytest.fixture(scope="module")
def dance(tmp_path_factory):
    """The figure's file: 30 frames in centimetres."""
    return write_bvh(tmp_path_factory.mktemp("clips") / "dance.bvh", dancer(30), 0.01)


@pytest.fixture(scope="module")
def danced(nao, dance):
    return retarget(nao, load_motion(dance))


def steps_of(result):
    """Speeds and accelerations of the joints out of the file's numbers."""
    speed = np.diff(result.motion.qpos[:, 7:], axis=0) * result.motion.fps
    return speed, np.diff(speed, axis=0) * result.motion.fps


def test_a_banded_system_is_solved_as_the_dense_one():
    rng = np.random.default_rng(0)
    frames, n = 7, 3
    dense = np.zeros((frames * n, frames * n))
    diagonal, first, second = (np.zeros((frames, n, n)), np.zeros((frames, n, n)), np.zeros((frames, n)))
    for t in range(frames):
        square = rng.normal(size=(n, n))
        diagonal[t] = square @ square.T + 12.0 * np.eye(n)
        first[t], second[t] = rng.normal(size=(n, n)), rng.normal(size=n)
        at = slice(t * n, (t + 1) * n)
        dense[at, at] = diagonal[t]
        for back, block in ((1, first[t]), (2, np.diag(second[t]))):
            if t >= back:
                before = slice((t - back) * n, (t - back + 1) * n)
                dense[at, before], dense[before, at] = block, block.T
    right = rng.normal(size=(frames, n))
    x = solve_banded(BandedSystem(*map(jnp.asarray, (diagonal, first, second))), jnp.asarray(right))
    np.testing.assert_allclose(x, np.linalg.solve(dense, right.ravel()).reshape(frames, n), rtol=1e-10, atol=1e-12)


def test_rows_of_a_frame_have_the_derivatives_of_their_residuals(nao, dance):
    profile = find_profile(nao)
    person = read_person(load_motion(dance), find_roles(load_motion(dance).joint_names))
    build = Build.of(nao, profile)
    goals = jax.tree.map(lambda leaf: leaf[7], build.goals(person))
    body, bounds = Body.of(nao, profile, pairs_apart(nao, profile)[:1]), build.bounds(np.full(nao.nv, 240.0), 1.0 / FPS)
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


def test_nao_dances_with_its_feet_where_they_are(nao, danced):
    figures = report(danced)
    assert figures["feet"]["contact_share"] == 1.0
    assert figures["feet"]["slip_mm_max"] < 0.01
    assert figures["feet"]["float_mm_max"] < 0.01 and figures["feet"]["below_floor_mm_max"] < 0.01
    assert figures["tracking"]["segment_angle_deg_mean"] < 0.5
    assert figures["shapes"]["penetration_mm_max"] == 0.0
    assert figures["joints"]["jump_frames"] == 0 and figures["joints"]["beyond_range_max"] == 0.0
    # the same from the file's numbers alone: soles stand where MuJoCo has them
    model = nao.mj_model
    data, corners = mujoco.MjData(model), []
    for qpos in danced.motion.qpos:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        corners.append([data.site(f"{side}_sole_corner_{k}").xpos.copy() for side in "lr" for k in range(4)])
    drift = np.ptp(np.array(corners), axis=0)
    assert np.abs(np.array(corners)[..., 2]).max() < 1e-5 and drift.max() < 1e-5
    assert np.ptp(danced.q[:, 2]) > 0.005  # and the waist goes down and up


def test_limits_hold_exactly(nao, dance, danced):
    tight = Retargeter(nao, acceleration=12.0).retarget(load_motion(dance))
    speed, acceleration = steps_of(tight)
    loose = np.abs(steps_of(danced)[1]).max()
    assert loose > 15.0  # so that the limit is one
    assert np.abs(acceleration).max() <= 12.0 * (1.0 + 1e-9)
    dofs = [nao.joint_dof_index(name) for name in tight.motion.joint_names]
    assert (np.abs(speed) <= np.asarray(nao.velocity_limit)[dofs] * (1.0 + 1e-9)).all()
    q = tight.motion.qpos[:, 7:]
    assert (q >= np.asarray(nao.position_lower)[dofs] - 1e-12).all()
    assert (q <= np.asarray(nao.position_upper)[dofs] + 1e-12).all()
    # met by leading: the plan keeps them by itself, and the feet stay
    assert tight.off_plan.max() < 1e-3
    assert report(tight)["feet"]["slip_mm_max"] < 0.5


def test_many_clips_give_what_each_gives_alone(nao, dance, danced, tmp_path):
    motion = load_motion(dance)
    short = dataclasses.replace(motion, name="short", positions=motion.positions[:21], rotations=None)
    own = Retargeter(nao)
    together = own.retarget_all([motion, short, motion], chunk=2, out=tmp_path / "job", progress=False)
    assert [len(result.q) for result in together] == [30, 21, 30]
    np.testing.assert_allclose(together[0].q, danced.q, atol=1e-5)
    np.testing.assert_array_equal(together[2].q, together[0].q)
    np.testing.assert_allclose(together[1].q, own.retarget(short).q, atol=1e-5)
    again = own.retarget_all([motion, short, motion], chunk=2, out=tmp_path / "job", progress=False)
    np.testing.assert_array_equal(again[1].q, together[1].q)
    with pytest.raises(ValueError, match="short: .*it takes three"):
        own.retarget_all([motion, dataclasses.replace(short, positions=short.positions[:2])], progress=False)


def test_the_last_pass_keeps_limits_whatever_the_plan(nao):
    rng = np.random.default_rng(2)
    plan = jax.vmap(lambda v: osik.integrate(nao, nao.q0, v))(jnp.asarray(rng.normal(scale=0.5, size=(30, nao.nv))))
    most = np.full(nao.nv, 100.0)
    limits = (osik.ConfigurationLimit(nao), osik.VelocityLimit(nao), osik.AccelerationLimit(nao, most))
    q, off = follow(nao, plan, limits, 1.0 / FPS)
    assert off.max() > 0.1
    v = jax.vmap(lambda a, b: osik.difference(nao, a, b))(q[:-1], q[1:]) * FPS
    assert np.abs(np.diff(np.asarray(v), axis=0)[:, 6:]).max() * FPS <= 100.0 * (1.0 + 1e-6)
    assert (np.abs(v) <= nao.velocity_limit * (1.0 + 1e-9)).all()
    dofs = [nao.joint_dof_index(name) for name in nao.joint_names]
    at = np.asarray(q)[:, [nao.joint_qpos_index(name) for name in nao.joint_names]]
    assert (at >= np.asarray(nao.position_lower)[dofs] - 1e-9).all()
    assert (at <= np.asarray(nao.position_upper)[dofs] + 1e-9).all()


def test_files_come_back(danced, tmp_path):
    danced.save(tmp_path / "motion.npz")
    back = load_robot_motion(tmp_path / "motion.npz")
    np.testing.assert_array_equal(back.qpos, danced.motion.qpos)
    with np.load(tmp_path / "motion.npz", allow_pickle=False) as data:
        assert set(data.files) == {"fps", "qpos", "joint_names", "human", "human_names", "contact", "ground"}
        assert data["human"].shape == (30, len(data["human_names"]), 3) and data["contact"].shape == (30, 4)
        names = data["human_names"].tolist()
    assert {"left_heel", "right_toe", "left_wrist", "root"} <= set(names)


def test_the_command_writes_its_files(dance, tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main(["retarget", str(dance), "--out", str(out)]) == 0
    assert "written to" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {
        "motion.npz", "motion.csv", "motion.gif", "report.json", "profile.toml"
    }  # fmt: skip
    figures = json.loads((out / "report.json").read_text())
    assert figures["clip"] == "dance" and figures["feet"]["slip_mm_max"] < 0.01
    motion = load_robot_motion(out / "motion.npz")
    table = load_robot_motion(out / "motion.csv", joint_names=motion.joint_names, fps=motion.fps)
    np.testing.assert_allclose(table.qpos, motion.qpos, atol=1e-8)
    assert load_profile(out / "profile.toml").keypoints == load_profile("nao").keypoints


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.bvh"], "No such file"),
        (["DANCE", "--robot", "none.urdf"], "no such file: none.urdf"),
        (["DANCE", "--robot", "arm7"], "floating_base=True"),
        (["DANCE", "--profile", "none.toml"], "profiles that come with the package: nao, g1"),
        (["DANCE", "--acceleration", "0"], "acceleration is 0.0; it has to be more than 0"),
        (["DANCE", "--mapping", "left_hip"], "--mapping takes ROLE=NAME; got left_hip"),
        (["DANCE", "--mapping", "left_hip=Hip"], "no joint of the clip 'Hip'"),
        (["DANCE", "--unit", "yard"], "no unit 'yard'"),
    ],
)
def test_the_command_refuses_in_one_line(arguments, message, dance, tmp_path, capsys):
    arguments = [str(dance) if word == "DANCE" else word for word in arguments]
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
    with pytest.raises(ValueError, match="no left_wrist that can be told by name.*joints: pelvis"):
        find_roles(tuple(name for name in SMPL if name != "left_wrist"))
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
    assert person.contact.all() and person.leg == pytest.approx(0.83)


def test_a_guess_sees_the_same_robot(nao):
    guess, own = guess_profile(nao), load_profile("nao")
    assert find_profile(nao) == own
    same = {role for role in NEEDED if guess.keypoints[role] == own.keypoints[role]}
    assert same == set(NEEDED) - {"left_wrist", "right_wrist", "left_hip", "right_hip"}
    assert guess.keypoints["left_wrist"][0] == "l_gripper"
    np.testing.assert_allclose(
        Build.of(nao, guess).points["left_hip"], Build.of(nao, own).points["left_hip"], atol=1e-9
    )
    assert guess.feet == own.feet and guess.pelvis == "torso" and guess.torso is None


def test_a_g1_is_guessed_from_its_urdf():
    g1 = osik.Robot.from_urdf(g1_urdf(), floating_base=True)
    guess, own = guess_profile(g1), load_profile("g1")
    assert find_profile(g1) == own
    for side in ("left", "right"):
        # the URDF's balls of 5 mm at these places, 30 mm below the ankle
        np.testing.assert_allclose(guess.feet[side].heel, [[-0.05, 0.025, -0.035], [-0.05, -0.025, -0.035]], atol=1e-9)
        np.testing.assert_allclose(guess.feet[side].toe, [[0.12, 0.03, -0.035], [0.12, -0.03, -0.035]], atol=1e-9)
    assert (guess.pelvis, guess.torso) == ("pelvis", "torso_link")
    for role in ("left_knee", "right_elbow", "left_wrist", "right_shoulder"):
        assert guess.keypoints[role] == own.keypoints[role]


def test_robots_that_cannot_walk_are_refused():
    arm = osik.load_robot("arm7")
    with pytest.raises(ValueError, match="floating_base=True"):
        Retargeter(arm)
    with pytest.raises(ValueError, match="bolted down"):
        guess_profile(arm)


def test_profiles_come_back_and_say_what_is_wrong(nao, tmp_path):
    profile = dataclasses.replace(load_profile("g1"), scale=0.8)
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
        ("scale = 0.8", "stretch = 0.0", "stretch is 0.0"),
        ("[feet.left]", "[feet.left", "is no TOML"),
        ("radius = ", "radius = -", "radius and the length have to be more than 0"),
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
    with pytest.raises(ValueError, match="has no left_hip"):
        retarget(nao, HumanMotion("clip", 30.0, ("Hips",), np.zeros((5, 1, 3))))


def test_a_profile_comes_back_from_its_file(tmp_path):
    changed = dataclasses.replace(load_profile("nao"), stretch=1.1)
    save_profile(changed, tmp_path / "robot.toml")
    assert load_profile(tmp_path / "robot.toml") == changed
