"""Robots that lack limbs, roll or stand on four feet: small models, judged by MuJoCo and by equal motions."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_checks import needs_core
from motion_files import dancer, write_bvh
from scipy.spatial.transform import Rotation
from small_robots import ARM, FOREARM, FPS, SIDES, by_mujoco, on_four, quietly, robot_of, trotting

import osik_jax as osik
from osik_jax.retargeting import (
    HumanMotion,
    LiveRetargeter,
    Retargeter,
    RobotMotion,
    SourceMotion,
    describe_profile,
    guess_profile,
    load_motion,
    load_profile,
    report,
    save_profile,
)
from osik_jax.retargeting._person import read_person
from osik_jax.retargeting._plan import _Clip, _descended, _descended_plain
from osik_jax.retargeting._skeletons import find_roles


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    return load_motion(write_bvh(tmp_path_factory.mktemp("clips") / "dance.bvh", dancer(20), 0.01))


def judged(result):
    """The report; what has to hold of every robot is asserted."""
    figures = report(result)
    joints = figures["joints"]
    assert joints["beyond_range_max"] == 0.0 and joints["speed_over_limit_max"] <= 1.0 + 1e-6
    assert joints["jump_frames"] == 0 and figures["shapes"]["penetration_mm_max"] < 1.0
    return figures


@pytest.mark.release
def test_arms_on_a_fixed_base_follow_beside_the_trunk(motion, tmp_path):
    """Wherever the person goes and however the trunk is turned, the arms are the same; the robot faces y."""
    robot = robot_of("arms", free=False, turn=90.0)
    retargeter = quietly(Retargeter, robot)
    assert "the base is fixed" in describe_profile(robot, retargeter.profile) and not retargeter.profile.feet
    result = retargeter.retarget(motion)
    assert judged(result)["tracking"]["segment_angle_deg_mean"] < 1.0
    turns = Rotation.from_euler("zy", np.linspace([0, 0], [80, 30], motion.frames), degrees=True).as_matrix()
    way = np.linspace([0.0, 0.0, 0.0], [2.0, 1.0, 0.1], motion.frames)
    carried = np.einsum("fij,fkj->fki", turns, motion.positions) + way[:, None]
    elsewhere = dataclasses.replace(motion, positions=carried, rotations=None, rest_positions=None)
    plain = dataclasses.replace(motion, rotations=None, rest_positions=None)
    other, own = quietly(retargeter.retarget, elsewhere), retargeter.retarget(plain)
    np.testing.assert_allclose(other.q, own.q, atol=1e-6)
    # directions by MuJoCo beside those of the clip, turned as the robot faces
    ends = by_mujoco(
        robot, result.motion.qpos[7:8], lambda data: [data.body(f"left_{part}").xpos for part in ("roll", "elbow")]
    )
    upper = ends[0, 1] - ends[0, 0]
    names = find_roles(motion.joint_names)
    asked = motion.track(names["left_elbow"])[7] - motion.track(names["left_shoulder"])[7]
    asked = Rotation.from_euler("z", 90.0, degrees=True).apply(asked)
    assert np.degrees(np.arccos(upper @ asked / np.linalg.norm(upper) / np.linalg.norm(asked))) < 1.0
    # its files have no free joint
    result.save(tmp_path / "motion.npz")
    result.motion.save_csv(tmp_path / "motion.csv")
    joints = result.motion.joint_names
    for loaded in (
        RobotMotion.load(tmp_path / "motion.npz"),
        RobotMotion.load(tmp_path / "motion.csv", joint_names=joints, fps=FPS),
    ):
        assert not loaded.is_free and loaded.joint_names == joints
        np.testing.assert_allclose(loaded.qpos, result.motion.qpos, atol=1e-8)


def test_an_upper_body_needs_no_legs_in_the_clip(motion):
    names = find_roles(motion.joint_names)
    lower = {names[f"{side}_{role}"] for side, _ in SIDES for role in ("knee", "ankle", "toe")}
    kept = [i for i, name in enumerate(motion.joint_names) if name not in lower]
    half = HumanMotion("half", FPS, tuple(motion.joint_names[i] for i in kept), motion.positions[:, kept])
    retargeter = quietly(Retargeter, robot_of("arms", free=False))
    whole = dataclasses.replace(motion, rotations=None, rest_positions=None)
    np.testing.assert_allclose(retargeter.retarget(half).q, retargeter.retarget(whole).q, atol=1e-6)
    with pytest.raises(ValueError, match="has no left_wrist"):
        left = [i for i, name in enumerate(half.joint_names) if name != names["left_wrist"]]
        retargeter.retarget(HumanMotion("half", FPS, tuple(half.joint_names[i] for i in left), half.positions[:, left]))


@pytest.mark.slow
def test_legs_without_arms_and_arms_that_end_at_the_elbow_walk_as_the_person(motion):
    for robot, lacks in ((robot_of("legs"), "no left arm"), (robot_of("legs", "arms", forearm=""), "no wrist")):
        with pytest.warns(osik.OsikWarning, match=lacks):
            retargeter = Retargeter(robot)
        figures = judged(retargeter.retarget(motion))
        assert figures["feet"]["slip_mm_max"] < 0.1 and figures["feet"]["float_mm_max"] < 0.1
        assert figures["feet"]["contact_share"] == 1.0 and figures["tracking"]["segment_angle_deg_mean"] < 2.0


@pytest.mark.release
def test_a_base_on_wheels_takes_heading_and_path_and_stays_level(motion):
    robot = robot_of("arms", "wheels")
    retargeter = quietly(Retargeter, robot)
    assert retargeter.profile.rolls and len(retargeter.profile.feet) == 2
    way = np.linspace([0.0, 0.0, 0.0], [0.6, 0.3, 0.0], motion.frames)
    turns = Rotation.from_euler("zy", np.linspace([0, 0], [60, 20], motion.frames), degrees=True).as_matrix()
    moved = np.einsum("fij,fkj->fki", turns, motion.positions) + way[:, None]
    clip = dataclasses.replace(motion, positions=moved, rotations=None, rest_positions=None)
    result = quietly(retargeter.retarget, clip)
    figures = judged(result)
    assert figures["feet"]["float_mm_max"] < 0.2 and figures["feet"]["below_floor_mm_max"] < 0.2
    assert figures["feet"]["slip_mm_max"] is None
    base = Rotation.from_quat(result.q[:, 3:7], scalar_first=True)
    np.testing.assert_allclose(base.as_matrix()[:, 2, 2], 1.0, atol=1e-5)
    heading = base.as_euler("zyx", degrees=True)[:, 0]
    assert heading[-1] - heading[0] == pytest.approx(60.0, abs=2.0)
    person = read_person(clip, find_roles(clip.joint_names))
    scale = retargeter._build.scale(person)
    walked = result.q[-1, :2] - result.q[0, :2]
    np.testing.assert_allclose(walked, scale * (person.root[-1] - person.root[0])[:2], atol=0.02)
    assert figures["tracking"]["segment_angle_deg_mean"] < 2.0


@pytest.mark.release
def test_four_feet_follow_a_dog(tmp_path):
    robot = on_four()
    retargeter = quietly(Retargeter, robot)
    profile = retargeter.profile
    assert tuple(profile.feet) == ("left", "left_front", "right", "right_front")
    assert {foot.radius for foot in profile.feet.values()} == {0.02} and len(profile.reached) == 4
    clip = trotting()
    result = retargeter.retarget(clip)
    figures = judged(result)
    np.testing.assert_allclose(result.contact.mean(0), 0.5, atol=0.1)
    # by MuJoCo: balls that stand are where they landed and touch the floor; the others are lifted
    names = [f"{s}_{row}_ball" for s, _ in SIDES for row in ("hind", "front")]
    balls = by_mujoco(robot, result.motion.qpos, lambda data: [data.geom(name).xpos for name in names])
    assert np.abs(balls[..., 2][result.contact] - 0.02).max() < 2e-4 and balls[..., 2].min() > 0.0198
    both = result.contact[1:] & result.contact[:-1]
    assert np.linalg.norm(np.diff(balls, axis=0)[..., :2], axis=-1)[both].max() < 5e-5
    scale = retargeter._build.scale(read_person(clip, find_roles(clip.joint_names), standing=profile.standing))
    assert balls[..., 2].max() - 0.02 == pytest.approx(0.06 * scale, rel=0.2)
    assert result.q[-1, 0] - result.q[0, 0] == pytest.approx(scale * 0.4 * (clip.frames - 1) / FPS, rel=0.05)
    assert figures["feet"]["slip_mm_max"] < 0.5
    # and the profile comes back from its file
    save_profile(profile, tmp_path / "robot.toml")
    assert load_profile(tmp_path / "robot.toml") == profile


@pytest.mark.release
def test_four_feet_stay_where_an_arm_follows(motion):
    """The feet stand all the time, and the trunk leans as the person's does beside the heading."""
    arm = ARM.format(s="right", y=0, dy=-0.05, forearm=FOREARM.format(s="right"))
    robot = on_four(f'<body name="mount" pos="0.4 0 0.2">{arm}</body>')
    with pytest.warns(osik.OsikWarning, match="no left arm; .*right arm to the wrist; 4 feet; the feet stay"):
        retargeter = Retargeter(robot)
    assert not retargeter.profile.walks and not retargeter.profile.reached
    turns = Rotation.from_euler("ZY", np.linspace([0, 0], [60, 10], motion.frames), degrees=True).as_matrix()
    turned = np.einsum("fij,fkj->fki", turns, motion.positions)
    result = quietly(
        retargeter.retarget, dataclasses.replace(motion, positions=turned, rotations=None, rest_positions=None)
    )
    figures = judged(result)
    assert figures["feet"]["contact_share"] == 1.0 and figures["feet"]["slip_mm_max"] < 0.1
    assert figures["feet"]["float_mm_max"] < 0.1 and figures["tracking"]["segment_angle_deg_mean"] < 3.0
    lean = Rotation.from_quat(result.q[:, 3:7], scalar_first=True).as_euler("zyx", degrees=True)
    assert lean[-1, 1] - lean[0, 1] == pytest.approx(10.0, abs=3.0) and np.abs(lean[:, 0]).max() < 3.0
    np.testing.assert_allclose(result.q[:, 2], 0.42, atol=0.02)


@pytest.mark.slow
@pytest.mark.variants(release=["wheels", "four feet"])
@needs_core
@pytest.mark.parametrize("shape", ["four feet", "wheels", "fixed"])
def test_the_core_plans_other_shapes_as_the_plain_method(shape, motion):
    shapes = {
        "four feet": on_four,
        "wheels": partial(robot_of, "arms", "wheels"),
        "fixed": partial(robot_of, "arms", free=False),
    }
    own = quietly(Retargeter, shapes[shape]())
    few = dataclasses.replace(motion, positions=motion.positions[:9], rotations=None)
    short = trotting(9) if shape == "four feet" else few
    asked = own._prepared(short, None, None)
    clip = jax.tree.map(
        jnp.asarray, _Clip(own._body, asked.goals, own.profile.weights, asked.bounds, jnp.ones(len(asked.start)))
    )
    q = jnp.asarray(asked.start + 0.1 * np.random.default_rng(0).normal(size=asked.start.shape))
    kernel, plain = (jax.jit(partial(f, until="mended"))(clip, q, jnp.array(3)) for f in (_descended, _descended_plain))
    np.testing.assert_allclose(kernel.cost, plain.cost, rtol=1e-7)
    np.testing.assert_allclose(kernel.q, plain.q, rtol=1e-7, atol=1e-8)
    assert float(kernel.cost.sum()) < float(own_cost(clip, q))


def own_cost(clip, q):
    """The cost before the first iteration."""
    return jax.jit(partial(_descended_plain, until="mended"))(clip, q, jnp.array(0)).cost.sum()


@pytest.mark.release
def test_a_stream_drives_a_fixed_base(motion):
    robot = robot_of("arms", free=False)
    live = quietly(LiveRetargeter, robot, motion, look_ahead=0.1)
    frames = [live.step(positions) for positions in motion.positions[:8]]
    frames = [frame for frame in frames if frame is not None] + live.finish()
    assert len(frames) == 8 and all(frame.feet_off == 0.0 and not frame.contact.any() for frame in frames)
    whole = Retargeter(robot, profile=live.profile).retarget(motion)
    np.testing.assert_allclose(frames[-1].q, whole.q[7], atol=0.1)


def test_profiles_of_other_shapes_say_what_is_wrong():
    profile = quietly(guess_profile, on_four())
    robot = robot_of("legs", "arms")
    with pytest.raises(ValueError, match="nothing holds the robot's base"):
        Retargeter(robot, profile=dataclasses.replace(quietly(guess_profile, robot), feet={}))
    with pytest.raises(ValueError, match="it has no feet and no wheels"):
        guess_profile(robot_of("arms"))
    with pytest.raises(ValueError, match="no keypoints right_hip"):
        dataclasses.replace(profile, keypoints={r: p for r, p in profile.keypoints.items() if r != "right_hip"})
    with pytest.raises(KeyError, match="no keypoint 'tail'"):
        dataclasses.replace(profile, keypoints={**profile.keypoints, "tail": ("trunk", (0.0, 0.0, 0.0))})
    with pytest.raises(ValueError, match="has feet left, left_front, right;"):
        dataclasses.replace(profile, feet={name: foot for name, foot in profile.feet.items() if name != "right_front"})
    fixed = robot_of("arms", free=False)
    with pytest.raises(ValueError, match="balance is that of a robot on feet"):
        Retargeter(fixed, profile=quietly(guess_profile, fixed), balance=0.01)


@pytest.mark.release
def test_a_robot_follows_one_with_the_limbs_that_it_has(motion):
    """Arms of a humanoid on a fixed base; no arms, and other feet, are refused."""
    walker = robot_of("legs", "arms")
    danced = Retargeter(walker).retarget(motion)
    source = SourceMotion(walker, danced.motion, danced.profile)
    retargeter = quietly(Retargeter, robot_of("arms", free=False))
    followed = retargeter.retarget(source)
    own = retargeter.retarget(motion)
    np.testing.assert_allclose(followed.q, own.q, atol=0.05)
    legs = quietly(Retargeter, robot_of("legs")).retarget(motion)
    with pytest.raises(ValueError, match="has no left_shoulder, left_elbow"):
        retargeter.retarget(SourceMotion(legs.robot, legs.motion, legs.profile))
    with pytest.raises(ValueError, match="4 feet cannot follow 2"):
        quietly(Retargeter, on_four()).retarget(source)
