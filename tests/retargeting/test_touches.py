"""Hands that hold objects or each other: distances by MuJoCo, the core beside plain JAX, files and errors."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from core_checks import needs_core
from scipy.spatial.transform import Rotation
from small_robots import by_mujoco

import osik_jax as osik
from osik_jax.retargeting import HumanMotion, Retargeter, load_motion, report
from osik_jax.retargeting._plan import _Clip, _descended, _descended_plain

FRAMES = 30
WRISTS = ("left_wrist", "right_wrist")


def carrying(frames=FRAMES):
    """A person who stands, lifts a box off and turns it, and holds it in the frames 8 to 24."""
    share = np.linspace(0.0, 1.0, frames)
    held, points = (np.arange(frames) >= 8) & (np.arange(frames) < 25), {}
    box = np.stack([0.35 - 0.05 * share, 0.06 * np.sin(3.0 * share), 1.0 + 0.25 * share], 1)
    away = 0.05 * np.clip(np.maximum(8 - np.arange(frames), np.arange(frames) - 24) / 5, 0.0, 1.0)
    turns = Rotation.from_euler("z", 0.3 * share[:, None])
    for side, sign in (("left", 1.0), ("right", -1.0)):
        at = np.tile([0.0, 0.1 * sign, 0.0], (frames, 1))
        parts = dict(hip=0.9, knee=0.5, ankle=0.08, heel=0.0, toe=0.0)
        for name, z in parts.items():
            points[f"{side}_{name}"] = at + np.array([{"heel": -0.05, "toe": 0.15}.get(name, 0.0), 0.0, z])
        points[f"{side}_shoulder"] = at + np.array([0.0, 0.08 * sign, 1.4])
        # the person's hands are not still on the box: a robot's are
        wrist = box + turns.apply(np.tile([0.0, 0.16 * sign, 0.0], (frames, 1))) + 0.01 * np.sin(9.0 * share)[:, None]
        points[f"{side}_wrist"] = wrist + away[:, None] * [0.0, sign, 0.0]
        middle = 0.5 * (points[f"{side}_shoulder"] + wrist)
        points[f"{side}_elbow"] = middle + np.array([-0.05, 0.1 * sign, -0.1])
    poses = np.concatenate([box, turns.as_quat(scalar_first=True)], 1)
    positions = np.stack(list(points.values()), 1)
    return HumanMotion(
        "carry", 30.0, tuple(points), positions, objects={"box": poses},
        touches=tuple((role, "box", held) for role in WRISTS),
    )  # fmt: skip


def wrists(result):
    """The wrists by MuJoCo. (2, F, 3)."""
    places = [result.profile.keypoints[role] for role in WRISTS]

    def read(data):
        return [data.body(f).xpos + data.body(f).xmat.reshape(3, 3) @ np.array(point) for f, point in places]

    return np.swapaxes(by_mujoco(result.robot, map(result.robot.mujoco_qpos, result.q), read), 0, 1)


def on(poses, points):
    """Points in the frame of an object. (F, 3)."""
    return Rotation.from_quat(poses[:, 3:], scalar_first=True).inv().apply(points - poses[:, :3])


@pytest.mark.slow
def test_wrists_stay_where_they_hold_the_box(nao):
    motion = carrying()
    retargeter = Retargeter(nao)
    result, loose = retargeter.retarget(motion), retargeter.retarget(dataclasses.replace(motion, touches=()))
    held = motion.touches[0][2]
    scale = result.objects["box"][0, 2] / motion.objects["box"][0, 2]
    np.testing.assert_allclose(result.objects["box"][:, :3], scale * motion.objects["box"][:, :3], atol=1e-12)
    slips = []
    for one in (result, loose):
        inside = [on(result.objects["box"], track)[held] for track in wrists(one)]
        slips.append(max(np.linalg.norm(at - at.mean(0), axis=-1).max() for at in inside))
    assert slips[0] < 1e-3 < 4e-3 < slips[1]
    apart = np.linalg.norm(np.subtract(*wrists(result)), axis=-1)[held]
    assert np.abs(apart - scale * 0.32).max() < 2e-3
    figures = report(result)
    assert figures["touches"]["off_mm_max"] < 1.0 and report(loose)["touches"]["off_mm_max"] is None
    assert figures["joints"]["beyond_range_max"] == 0.0 and figures["joints"]["jump_frames"] == 0
    assert figures["feet"]["slip_mm_max"] < 0.5
    # the box is wide and far for a NAO: it leans towards it, with its shoulders at their ends
    leans, rest = figures["notes"]
    assert (
        "the trunk leans" in leans
        and "RShoulderRoll" in rest
        and figures["tracking"]["trunk_angle_deg"]["pelvis"] < 30.0
    )
    # a batch with clips that hold something and clips that do not gives the same
    other = retargeter.retarget_all([dataclasses.replace(motion, touches=()), motion], progress=False)
    np.testing.assert_allclose(other[1].q, result.q, atol=1e-6)
    np.testing.assert_allclose(other[0].q, loose.q, atol=1e-6)


@pytest.mark.slow
def test_a_hand_holds_the_other(nao):
    motion = carrying()
    touch = ("left_wrist", "right_wrist", motion.touches[0][2])
    result = Retargeter(nao).retarget(dataclasses.replace(motion, objects={}, touches=(touch,)))
    assert report(result)["touches"]["off_mm_max"] < 1.0
    (goal,) = result.touches
    left, right = wrists(result)
    np.testing.assert_allclose((left - right)[goal.held], goal.goal[goal.held], atol=1e-3)


@pytest.mark.slow
def test_arms_on_a_fixed_base_hold_beside_the_trunk():
    robot = osik.load_robot("g1", floating_base=False)
    result = Retargeter(robot).retarget(carrying())
    assert report(result)["touches"]["off_mm_max"] < 1.0


@pytest.mark.release
@needs_core
def test_the_core_holds_as_plain_jax_does(nao):
    retargeter, motion = Retargeter(nao), carrying(12)
    clip = retargeter._prepared(motion, None, None)
    free = jnp.ones(len(clip.start))
    given = _Clip(retargeter._body_that(clip.touching), clip.goals, retargeter.profile.weights, clip.bounds, free)
    most, damping = jnp.asarray(6), jnp.asarray(1.0)
    one, other = (
        f(given, jnp.asarray(clip.start), most, damping, until="mended") for f in (_descended, _descended_plain)
    )
    np.testing.assert_allclose(one.q, other.q, atol=1e-7)
    np.testing.assert_allclose(one.cost, other.cost, rtol=1e-8)


def test_files_rates_and_axes(tmp_path):
    motion = carrying()
    arrays: dict[str, Any] = {"object.box": motion.objects["box"]} | {
        f"touch.{role}.box": held for role, _, held in motion.touches
    }
    np.savez(tmp_path / "carry.npz", fps=30.0, positions=motion.positions, joint_names=motion.joint_names, **arrays)
    read = load_motion(tmp_path / "carry.npz")
    np.testing.assert_array_equal(read.objects["box"], motion.objects["box"])
    assert [touch[:2] for touch in read.touches] == [(role, "box") for role in WRISTS]
    np.testing.assert_array_equal(read.touches[1][2], motion.touches[1][2])
    # y up: wrists are where they were on the box
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    turned = Rotation.from_matrix(turn) * Rotation.from_quat(motion.objects["box"][:, 3:], scalar_first=True)
    poses = np.concatenate([motion.objects["box"][:, :3] @ turn.T, turned.as_quat(scalar_first=True)], 1)
    arrays["object.box"] = poses
    np.savez(
        tmp_path / "y.npz", fps=30.0, positions=motion.positions @ turn.T, joint_names=motion.joint_names, **arrays
    )
    back = load_motion(tmp_path / "y.npz", up="y")
    for role in WRISTS:
        own = on(back.objects["box"], back.track(role))
        np.testing.assert_allclose(own, on(motion.objects["box"], motion.track(role)), atol=1e-9)
    finer = motion.resampled(60.0)
    assert finer.touches[0][2].sum() == pytest.approx(2 * motion.touches[0][2].sum(), abs=2)
    np.testing.assert_allclose(finer.objects["box"][::2], motion.objects["box"], atol=1e-12)


def test_what_is_wrong_is_told(nao):
    motion, held = carrying(), np.ones(FRAMES, bool)
    for touch, text in (
        (("left_wrist", "cup", held), "no object of the clip"),
        (("left_heel", "box", held), "no keypoint left_heel"),
    ):
        with pytest.raises(ValueError, match=text):
            Retargeter(nao).retarget(dataclasses.replace(motion, touches=(touch,)))
    with pytest.raises(ValueError, match="held of left_wrist has shape"):
        dataclasses.replace(motion, touches=(("left_wrist", "box", held[:5]),))
    with pytest.raises(ValueError, match="unit quaternion"):
        dataclasses.replace(motion, objects={"box": np.zeros((FRAMES, 7))})
