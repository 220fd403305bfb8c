"""Files as data sets have them, made here: names, tree, units, axes, rest poses and rates of each.

The conventions are those of: LAFAN1 (ubisoft-laforge-animation-dataset), Bandai-Namco-Research-Motiondataset 1 and 2
(their BVH files), SOMA (NVIDIA's soma-retargeter and its BVH files), MediaPipe (guide of the pose landmarker, "world
landmarks"), Human3.6M (17 joints of VideoPose3D) and Kinect for Windows v1 and v2 (documentation of JointType and
CameraSpacePoint).
"""

import dataclasses

import numpy as np
import pytest
from motion_files import (
    FIGURE,
    Figure,
    along_x,
    assert_same_person,
    renamed,
    seen,
    turned_dancer,
    with_between,
    with_rest,
    write_bvh,
)
from small_robots import quietly, robot_of

import osik_jax as osik
from osik_jax.retargeting import HumanMotion, Retargeter, load_motion, report
from osik_jax.retargeting._person import read_person, with_path
from osik_jax.retargeting._skeletons import find_roles

SIDES = {"Left": "left", "Right": "right"}


def is_figure(motion, own):
    """The clip shows the person of a figure, whatever its file looks like."""
    positions, _ = own.forward()
    z_up = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    names = tuple(name for name, _, _ in FIGURE)
    person = assert_same_person(motion, seen(HumanMotion("truth", own.fps, names, positions @ z_up.T)))
    assert person.fps == own.fps and person.contact.all()
    across = person.points["left_shoulder"] - person.points["right_shoulder"]
    assert (np.cross(across, [0.0, 0.0, 1.0]) @ [np.cos(np.radians(25)), np.sin(np.radians(25)), 0.0] > 0.3).all()


def elsewhere(own, place):
    """The same, with the place of the root in its OFFSET; its channels replace that."""
    (name, parent, _), *others = own.joints
    return dataclasses.replace(own, joints=((name, parent, place), *others))


def with_shoulders(own, share=0.3):
    return with_between(with_between(own, "LeftShoulder", "LeftArm", share), "RightShoulder", "RightArm", share)


def rounded(path, digits):
    """A file with its frame time to so many digits."""
    head, rest = path.read_text().split("Frame Time: ")
    time, frames = rest.split("\n", 1)
    path.write_text(f"{head}Frame Time: {float(time):.{digits}f} \n{frames}")
    return path


def test_lafan1(tmp_path):
    """Bones along x on both sides, channels z y x, centimetres, 22 joints; OFFSET of the root is its first place."""
    own = with_shoulders(with_between(with_between(turned_dancer(), "Spine1", "Neck", 0.3), "Spine2", "Neck", 0.5))
    own = renamed(elsewhere(own, (-2.2, 0.9, -4.3)), lambda name: name.replace("ToeBase", "Toe"))
    file = write_bvh(tmp_path / "dance1_subject1.bvh", with_rest(own, along_x(own), "ZYX"), 0.01)
    motion = load_motion(rounded(file, 6))
    is_figure(motion, turned_dancer())
    assert len(motion.joint_names) == 22 and motion.rest_positions is None


def test_bandai_namco(tmp_path):
    """A root that rests on the floor, six channels in every joint, bones of the right against x, centimetres."""
    own = with_shoulders(with_between(turned_dancer(), "Chest", "Neck", 0.4))
    parts = dict(Arm="UpperArm", ForeArm="LowerArm", Hand="Hand", UpLeg="UpperLeg", Leg="LowerLeg", Foot="Foot",
                 ToeBase="Toes", Shoulder="Shoulder")  # fmt: skip
    turns = along_x(own, "Right")
    names = {side + part: f"{theirs}_{side[0]}" for side in SIDES for part, theirs in parts.items()}
    own = renamed(elsewhere(own, (0.01, 0.94, -4.5)), lambda name: names.get(name, name))
    file = tmp_path / "dataset-1_bow_normal_001.bvh"
    write_bvh(file, with_rest(own, turns), 0.01, floor="joint_Root", all_move=True)
    is_figure(load_motion(rounded(file, 7)), turned_dancer())


def test_soma(tmp_path):
    """Thighs called Leg, a root on the floor above Hips, fingers, eyes and ends as joints, 120 frames a second."""
    own = with_between(with_between(turned_dancer(40, 120.0), "Spine1", "Spine", 0.5), "Chest", "Neck", 0.3)
    own = with_shoulders(with_between(own, "Neck2", "Head", 0.4))
    names = dict(Spine="Spine2", Neck="Neck1")
    names |= {side + part: side + theirs for side in SIDES for part, theirs in (("UpLeg", "Leg"), ("Leg", "Shin"))}
    own, joints = renamed(own, lambda name: names.get(name, name)), []
    at = {name: i for i, (name, _, _) in enumerate(own.joints)}
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        joints += [(f"{side}HandIndex1", at[f"{side}Hand"], (0.08 * sign, 0.0, 0.03)),
                   (f"{side}HandThumbEnd", at[f"{side}Hand"], (0.03 * sign, 0.0, 0.06)),
                   (f"{side}ToeEnd", at[f"{side}ToeBase"], (0.0, 0.0, 0.06)),
                   (f"{side}Eye", at["Head"], (0.03 * sign, 0.05, 0.1))]  # fmt: skip
    joints += [("Jaw", at["Head"], (0.0, 0.02, 0.05)), ("HeadEnd", at["Head"], (0.0, 0.2, 0.0))]
    angles = np.concatenate([own.angles, np.zeros((len(own.root), len(joints), 3))], 1)
    own = Figure((*own.joints, *joints), own.root, angles, own.orders[:1] * (len(own.joints) + len(joints)), 120.0)
    for which, turns in (("bones along x", along_x(own)), ("T pose", np.tile(np.eye(3), (len(own.joints), 1, 1)))):
        file = write_bvh(tmp_path / f"{which}.bvh", with_rest(own, turns, "ZYX"), 0.01, floor="Root")
        is_figure(load_motion(rounded(file, 6)), turned_dancer(40, 120.0))


JOINTS = {
    name: text.split()
    for name, text in {
        "MediaPipe": """
        nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye right_eye_outer left_ear right_ear
        mouth_left mouth_right left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist left_pinky
        right_pinky left_index right_index left_thumb right_thumb left_hip right_hip left_knee right_knee left_ankle
        right_ankle left_heel right_heel left_foot_index right_foot_index""",
        "Kinect v1": """
        HipCenter Spine ShoulderCenter Head ShoulderLeft ElbowLeft WristLeft HandLeft ShoulderRight ElbowRight
        WristRight HandRight HipLeft KneeLeft AnkleLeft FootLeft HipRight KneeRight AnkleRight FootRight""",
        "Kinect v2": """
        SpineBase SpineMid Neck Head ShoulderLeft ElbowLeft WristLeft HandLeft ShoulderRight ElbowRight WristRight
        HandRight HipLeft KneeLeft AnkleLeft FootLeft HipRight KneeRight AnkleRight FootRight SpineShoulder
        HandTipLeft ThumbLeft HandTipRight ThumbRight""",
        "Human3.6M": """
        Hip RHip RKnee RFoot LHip LKnee LFoot Spine Thorax Neck/Nose Head LShoulder LElbow LWrist RShoulder RElbow
        RWrist""",
    }.items()
}
"""Joints of each data set, in its order."""
_PARTS = dict(hip="Hip", knee="Knee", ankle="Ankle", toe="Foot", shoulder="Shoulder", elbow="Elbow", wrist="Wrist")
ROLES = {
    "MediaPipe": {f"{side}_{part}": f"{side}_{'foot_index' if part == 'toe' else part}"
                  for side in SIDES.values() for part in (*_PARTS, "heel")},
    "Kinect v1": {f"{side.lower()}_{part}": name + side for side in SIDES for part, name in _PARTS.items()}
    | dict(pelvis="HipCenter", chest="Spine", neck="ShoulderCenter", head="Head"),
    "Kinect v2": {f"{side.lower()}_{part}": name + side for side in SIDES for part, name in _PARTS.items()}
    | dict(pelvis="SpineBase", chest="SpineMid", neck="Neck", head="Head"),
    "Human3.6M": {f"{side.lower()}_{part}": side[0] + (name if part != "ankle" else "Foot") for side in SIDES
                  for part, name in _PARTS.items() if part != "toe"}
    | dict(pelvis="Hip", chest="Spine", neck="Thorax", head="Head"),
}  # fmt: skip


def beside(track, x, y, z):
    """Points at a constant distance from a track."""
    return track + np.array([x, y, z])


def walk(frames=60, fps=30.0, speed=0.8, period=1.2):
    """Points of a person who walks along x: each foot swings for 0.4 of the period, one after the other; z up."""
    time, points = np.arange(frames) / fps, {}
    path = np.stack([speed * time, 0.0 * time, 0.01 * np.cos(4.0 * np.pi * time / period)], 1)
    for side, sign, phase in (("left", 1.0, 0.0), ("right", -1.0, 0.5)):
        steps, part = np.divmod(time / period + phase, 1.0)
        swing = np.clip((part - 0.6) / 0.4, 0.0, 1.0)
        at = (steps - phase + 0.3 + swing**2 * (3.0 - 2.0 * swing)) * period * speed
        foot = np.stack([at, np.full(frames, 0.09 * sign), 0.08 * np.sin(np.pi * swing) ** 2], 1)
        top, arm = beside(path, 0.0, 0.09 * sign, 0.86), beside(path, 0.0, 0.19 * sign, 1.36)
        reach = 0.1 * np.sin(2.0 * np.pi * (time / period + phase))[:, None] * [1.0, 0.0, 0.0]
        parts = {"heel": beside(foot, -0.05, 0.0, 0.0), "toe": beside(foot, 0.15, 0.0, 0.0)}
        parts |= {"ankle": beside(foot, 0.0, 0.0, 0.08), "hip": top, "shoulder": arm}
        parts |= {"knee": beside(0.5 * (top + parts["ankle"]), 0.08, 0.0, 0.0)}
        parts |= {"elbow": beside(arm, 0.0, 0.03 * sign, -0.28) + reach}
        parts |= {"wrist": beside(parts["elbow"], 0.12, 0.0, -0.2) + reach}
        points |= {f"{side}_{name}": track for name, track in parts.items()}
    middle = {"pelvis": 0.87, "chest": 1.1, "neck": 1.38, "head": 1.55}
    points |= {name: beside(path, 0.0, 0.0, height) for name, height in middle.items()}
    return HumanMotion("walk", fps, tuple(points), np.stack(list(points.values()), 1))


def as_joints(motion, kind):
    """Positions of all joints of a data set (F, J, 3), z up; those that are no role of retargeting are at the nose."""
    roles = {name: role for role, name in ROLES[kind].items()}
    nose = beside(motion.track("neck"), 0.1, 0.0, 0.08)
    return np.stack([motion.track(roles[name]) if name in roles else nose for name in JOINTS[kind]], 1)


def by_camera(positions, down):
    """The same as a camera in front of the person sees it: x to the person's left, y down and z away; or y up."""
    x, y, z = np.moveaxis(positions, -1, 0)
    return np.stack([y, -z, -x] if down else [-y, z, -x], -1)


def turned_back(positions):
    """Positions of a person who faces -x."""
    return positions * [-1.0, -1.0, 1.0]


@pytest.mark.parametrize("kind", ["Kinect v1", "Kinect v2"])
def test_kinect(tmp_path, kind):
    """Metres, y up, z away from a sensor that is 0.9 m above the floor and 2.5 m in front of the person."""
    own = walk()
    positions = beside(by_camera(as_joints(own, kind), False), 0.0, -0.9, 2.5)
    np.savez(tmp_path / "body.npz", fps=30.0, joint_names=JOINTS[kind], positions=positions)
    with pytest.warns(osik.OsikWarning, match="the person stands along y and not along z"):
        motion = load_motion(tmp_path / "body.npz")
    roles = find_roles(motion.joint_names)
    assert roles == ROLES[kind]
    for role, name in ROLES[kind].items():
        np.testing.assert_allclose(motion.track(name), beside(turned_back(own.track(role)), 2.5, 0.0, -0.9), atol=1e-9)
    person = seen(motion)
    np.testing.assert_allclose(person.root[:, 2], own.track("left_hip")[:, 2], atol=0.02)  # above the floor


def test_human36m(tmp_path):
    """17 joints; Neck/Nose is in the face, so the thorax is where the neck begins. World positions are millimetres."""
    own, names = walk(), np.array(JOINTS["Human3.6M"])
    positions = beside(as_joints(own, "Human3.6M"), 0.3, -1.2, 0.0)
    np.savez(tmp_path / "walking.npz", fps=50.0, joint_names=names, positions=positions)
    motion = load_motion(tmp_path / "walking.npz")
    assert find_roles(motion.joint_names) == ROLES["Human3.6M"]
    np.testing.assert_allclose(seen(motion).torso[..., 2], np.tile([0.0, 0.0, 1.0], (own.frames, 1)), atol=1e-9)
    np.savez(tmp_path / "walking.npz", fps=50.0, joint_names=names, positions=1000.0 * positions)
    large = load_motion(tmp_path / "walking.npz")
    with pytest.raises(ValueError, match="the legs of walking are .* m long; positions are metres"):
        seen(large)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["MediaPipe", "Human3.6M"])
def test_poses_about_the_hips_walk(tmp_path, kind):
    """MediaPipe's world landmarks, and poses of Human3.6M as networks estimate them: y down, the hips at the origin."""
    own = walk()
    positions = by_camera(as_joints(own, kind), True)
    positions -= positions[:, [JOINTS[kind].index(ROLES[kind][f"{side}_hip"]) for side in SIDES.values()]].mean(1)[
        :, None
    ]
    np.savez(tmp_path / "webcam.npz", fps=30.0, joint_names=JOINTS[kind], positions=positions)
    with pytest.warns(osik.OsikWarning, match="the person stands along -y and not along z"):
        motion = load_motion(tmp_path / "webcam.npz")
    assert find_roles(motion.joint_names) == ROLES[kind]
    retargeter = quietly(Retargeter, robot_of("legs", "arms"))
    with pytest.warns(osik.OsikWarning, match="webcam has the hips at the origin in all frames; its path is inferred"):
        result = retargeter.retarget(motion)
    figures, points = report(result), {name: result.human[:, k] for k, name in enumerate(result.human_names)}
    middle = turned_back(0.5 * (own.track("left_hip") + own.track("right_hip")))
    off = points["root"] - middle
    np.testing.assert_allclose(off - off[:1], 0.0, atol=0.015)
    assert np.abs(points["left_ankle"][:, 2] - own.track("left_ankle")[:, 2] - off[:1, 2]).max() < 0.02
    assert result.contact.any(1).all() and 0.5 < result.contact[:, 0].mean() < 0.8
    assert figures["feet"]["slip_mm_max"] < 0.1 and figures["feet"]["float_mm_max"] < 0.1
    assert figures["tracking"]["segment_angle_deg_mean"] < 3.0


def test_the_path_of_noisy_poses_is_smooth_and_feet_stand():
    """With 5 mm of white noise the path of 4 m is 3 % short at most, and standing points are found."""
    own, rng = walk(150), np.random.default_rng(0)
    noisy = own.positions + 0.005 * rng.normal(size=own.positions.shape)
    middle = noisy[:, [own.joint_names.index(f"{side}_hip") for side in SIDES.values()]].mean(1)
    roles = find_roles(own.joint_names)
    with pytest.warns(osik.OsikWarning, match="path is inferred"):
        motion = with_path(dataclasses.replace(own, positions=noisy - middle[:, None]), roles)
    person, truth = read_person(motion, roles), read_person(own, roles)
    off = person.root - truth.root
    assert np.abs(off[-1] - off[0])[:2].max() < 0.03 * 4.0
    assert np.abs(np.diff(person.root - middle, axis=0)).max() < 0.03
    assert (person.contact == truth.contact).mean() > 0.9
    np.testing.assert_allclose(person.contact.mean(0), truth.contact.mean(0), atol=0.06)
