"""Robots that lack limbs: small models, judged by MuJoCo and by equal motions."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from core_checks import needs_core
from motion_files import dancer, write_bvh
from scipy.spatial.transform import Rotation
from small_robots import FPS, SIDES, on_four, quietly, robot_of

import osik_jax as osik
from osik_jax.retargeting import (
    HumanMotion,
    LiveRetargeter,
    Retargeter,
    describe_profile,
    guess_profile,
    load_motion,
    report,
)
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
    model, data = robot.mj_model, mujoco.MjData(robot.mj_model)
    data.qpos[:] = result.motion.qpos[7]
    mujoco.mj_kinematics(model, data)
    upper = data.body("left_elbow").xpos - data.body("left_roll").xpos
    names = find_roles(motion.joint_names)
    asked = motion.track(names["left_elbow"])[7] - motion.track(names["left_shoulder"])[7]
    asked = Rotation.from_euler("z", 90.0, degrees=True).apply(asked)
    assert np.degrees(np.arccos(upper @ asked / np.linalg.norm(upper) / np.linalg.norm(asked))) < 1.0
    # its files have no free joint
    result.motion.save_csv(tmp_path / "motion.csv")
    assert len(result.motion.joint_names) == robot.nv
    np.testing.assert_allclose(np.loadtxt(tmp_path / "motion.csv", delimiter=","), result.motion.qpos, atol=1e-8)


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


@pytest.mark.slow
@needs_core
def test_the_core_plans_other_shapes_as_the_plain_method(motion):
    own = quietly(Retargeter, robot_of("arms", free=False))
    short = dataclasses.replace(motion, positions=motion.positions[:9], rotations=None)
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
    robot = robot_of("legs", "arms")
    profile = quietly(guess_profile, robot)
    with pytest.raises(ValueError, match="nothing holds the robot's base"):
        Retargeter(robot, profile=dataclasses.replace(profile, feet={}))
    with pytest.raises(ValueError, match="it has no feet"):
        guess_profile(robot_of("arms"))
    with pytest.raises(ValueError, match="no keypoints right_hip"):
        dataclasses.replace(profile, keypoints={r: p for r, p in profile.keypoints.items() if r != "right_hip"})
    with pytest.raises(KeyError, match="no keypoint 'tail'"):
        dataclasses.replace(profile, keypoints={**profile.keypoints, "tail": ("base", (0.0, 0.0, 0.0))})
    with pytest.raises(ValueError, match="has feet left; it has left, right and hips, or none"):
        dataclasses.replace(profile, feet={"left": profile.feet["left"]})
    with pytest.raises(ValueError, match="two feet are needed, and 4 frames look like some"):
        guess_profile(on_four())
    fixed = robot_of("arms", free=False)
    with pytest.raises(ValueError, match="balance is that of a robot on feet"):
        Retargeter(fixed, profile=quietly(guess_profile, fixed), balance=0.01)
