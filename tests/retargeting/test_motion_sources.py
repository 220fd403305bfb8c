"""One motion in the ways in which programs write it: names, orders, units, axes, rest poses, more joints."""

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
    turned_up,
    with_between,
    with_rest,
    write_bvh,
)
from scipy.spatial.transform import Rotation

from osik_jax.retargeting import HumanMotion, load_motion
from osik_jax.retargeting._roles import NEEDED
from osik_jax.retargeting._skeletons import find_roles

NAMES = [name for name, _, _ in FIGURE]


def no_turns():
    return np.tile(np.eye(3), (len(FIGURE), 1, 1))


def a_pose():
    """Arms 45 degrees down in the rest pose."""
    turns = no_turns()
    for side, sign in (("Left", -1.0), ("Right", 1.0)):
        for name in ("Arm", "ForeArm", "Hand"):
            turns[NAMES.index(f"{side}{name}")] = Rotation.from_euler("z", sign * -45.0, degrees=True).as_matrix()
    return turns


def turned_along_x():
    """All bones along x in the rest pose, as they are in files of programs with axes on their bones."""
    turns = along_x(turned_dancer())
    turns[0] = Rotation.from_euler("zx", [90.0, 30.0], degrees=True).as_matrix()
    return turns


def with_more(own):
    """With fingers, eyes and a second joint in the neck's place, which nobody asked for."""
    hands = [(f"{side}HandIndex{k}", NAMES.index(f"{side}Hand"), (0.02, 0.0, 0.03)) for side in ("Left", "Right")
             for k in (1, 2)]  # fmt: skip
    eyes = [(name, NAMES.index("Head"), (x, 0.05, 0.08)) for name, x in (("LeftEye", 0.03), ("RightEye", -0.03))]
    more = [*hands, *eyes]
    angles = np.concatenate([own.angles, np.full((len(own.root), len(more), 3), 20.0)], 1)
    joints, orders = (*own.joints, *more), own.orders + own.orders[:1] * len(more)
    return Figure(joints, own.root, angles, orders, own.fps)


RIGIFY = dict(zip(NAMES, (
    "spine", "spine.001", "neck", "head", "upper_arm.L", "forearm.L", "hand.L", "upper_arm.R", "forearm.R", "hand.R",
    "thigh.L", "shin.L", "foot.L", "toe.L", "thigh.R", "shin.R", "foot.R", "toe.R"), strict=True))  # fmt: skip
UNREAL = dict(zip(NAMES, (
    "pelvis", "spine_01", "neck_01", "head", "upperarm_l", "lowerarm_l", "hand_l", "upperarm_r", "lowerarm_r", "hand_r",
    "thigh_l", "calf_l", "foot_l", "ball_l", "thigh_r", "calf_r", "foot_r", "ball_r"), strict=True))  # fmt: skip
FRIENDLY = dict(Arm="Shoulder", ForeArm="Elbow", Hand="Wrist", UpLeg="Hip", Leg="Knee", Foot="Ankle", ToeBase="Toe")


def with_hip_joints(own):
    """CMU's skeleton as 3ds Max has it: LHipJoint and RHipJoint are at the pelvis, above LeftHip and RightHip."""
    names = {f"{side}{part}": f"{side}{theirs}" for side in ("Left", "Right") for part, theirs in FRIENDLY.items()}
    for side in ("Left", "Right"):
        own = with_between(own, f"{side[0]}HipJoint", f"{side}UpLeg", 0.0)
    return renamed(own, lambda name: names.get(name, name).replace("Spine", "Chest"))


WRITTEN = {
    "CMU, 3ds Max": lambda path: write_bvh(path, with_hip_joints(turned_dancer()), 0.0254 / 0.45),
    "CMU": lambda path: write_bvh(path, with_rest(turned_dancer(), no_turns(), "ZYX"), 0.0254 / 0.45),
    "Mixamo, cm, A-pose": lambda path: write_bvh(
        path, renamed(with_more(with_rest(turned_dancer(), a_pose())), lambda name: f"mixamorig:{name}"), 0.01
    ),
    "Mixamo, number before the colon, mm": lambda path: write_bvh(
        path, renamed(with_more(turned_dancer()), lambda name: f"mixamorig9:{name}"), 0.001
    ),
    "XYZ, inch, z up": lambda path: write_bvh(
        path, turned_up(with_rest(turned_dancer(), no_turns(), "XYZ"), "z"), 0.0254
    ),
    "YXZ, m, x up": lambda path: write_bvh(path, turned_up(with_rest(turned_dancer(), a_pose(), "YXZ"), "x"), 1.0),
    "bones along x, cm": lambda path: write_bvh(path, with_rest(turned_dancer(), turned_along_x(), "ZYX"), 0.01),
    "bones along x, cm, z up": lambda path: write_bvh(
        path, turned_up(with_rest(turned_dancer(), turned_along_x()), "z"), 0.01
    ),
    "toes called LeftToe": lambda path: write_bvh(
        path, renamed(turned_dancer(), lambda name: name.replace("ToeBase", "Toe"))
    ),
    "Blender": lambda path: write_bvh(path, turned_up(renamed(turned_dancer(), RIGIFY.__getitem__), "z")),
    "Unreal, cm": lambda path: write_bvh(path, turned_up(renamed(turned_dancer(), UNREAL.__getitem__), "z"), 0.01),
}


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return seen(load_motion(write_bvh(tmp_path_factory.mktemp("bvh") / "clip.bvh", turned_dancer())))


@pytest.mark.parametrize("source", WRITTEN)
def test_a_person_is_the_same_whoever_wrote_the_file(tmp_path, truth, source):
    person = assert_same_person(load_motion(WRITTEN[source](tmp_path / "clip.bvh")), truth)
    assert person.lengths == pytest.approx(truth.lengths, abs=1e-9) and abs(person.ankle - truth.ankle) < 1e-9


SMPL = dict(
    Hips="pelvis", LeftUpLeg="left_hip", LeftLeg="left_knee", LeftFoot="left_ankle", LeftToeBase="left_foot",
    Spine="spine2", Neck="neck", Head="head", LeftArm="left_shoulder", LeftForeArm="left_elbow", LeftHand="left_wrist",
)  # fmt: skip


def smpl(name):
    return SMPL[name] if name in SMPL else SMPL[name.replace("Right", "Left")].replace("left", "right")


SPELLED = {
    "smpl": {},
    "smpl short": {"left_": "L_", "right_": "R_", "_foot": "_toe", "spine2": "spine"},
    "roles": {"_foot": "_toe", "spine2": "chest"},
    "deepmimic": {"_foot": "_toe", "spine2": "chest", "pelvis": "root"},
}


@pytest.mark.parametrize("kind", SPELLED)
def test_keypoints_are_the_same_person_as_the_file(tmp_path, truth, kind):
    source = load_motion(write_bvh(tmp_path / "clip.bvh", turned_dancer()))
    kept = [source.joint_names.index(name) for name in NAMES]
    names = [smpl(name) for name in NAMES]
    for old, new in SPELLED[kind].items():
        names = [name.replace(old, new) for name in names]
    rest = source.rest_positions
    assert rest is not None
    extra = np.random.default_rng(0).normal(size=(source.frames, 1, 3))  # a joint that no preset knows
    positions = np.concatenate([source.positions[:, kept], extra], 1)
    rest = np.concatenate([rest[kept], extra[0]])
    np.savez(tmp_path / "clip.npz", fps=30.0, positions=positions, joint_names=[*names, "jaw"], rest_positions=rest)
    assert_same_person(load_motion(tmp_path / "clip.npz"), truth, atol=1e-12)


def test_limbs_that_end_at_end_sites(tmp_path):
    # skeletons without hands and toes, whose forearms and feet are leaves: the End Sites are wrist and toe
    own = renamed(turned_up(turned_dancer(), "z"), RIGIFY.__getitem__)
    whole = load_motion(write_bvh(tmp_path / "whole.bvh", own))
    kept = [i for i, (name, _, _) in enumerate(own.joints) if not name.startswith(("hand", "toe"))]
    ends = {own.joints[parent][0]: offset for i, (_, parent, offset) in enumerate(own.joints) if i not in kept}
    joints = [own.joints[i] for i in kept]
    joints = tuple((name, kept.index(parent) if parent >= 0 else -1, offset) for name, parent, offset in joints)
    cut = dataclasses.replace(own, joints=joints, angles=own.angles[:, kept])
    motion = load_motion(write_bvh(tmp_path / "clip.bvh", cut, ends=ends))
    roles = find_roles(motion.joint_names)
    assert roles["left_wrist"] == "forearm.L_end" and roles["right_toe"] == "foot.R_end" and len(joints) == 14
    for name, own in (("forearm.L_end", "hand.L"), ("foot.R_end", "toe.R")):
        np.testing.assert_allclose(motion.track(name), whole.track(own), atol=1e-12)


def test_an_end_site_at_its_parent_is_no_joint(tmp_path):
    motion = load_motion(write_bvh(tmp_path / "clip.bvh", turned_dancer()))
    assert sorted(motion.joint_names) == sorted(NAMES)
    assert isinstance(motion, HumanMotion) and set(NEEDED) <= set(find_roles(motion.joint_names))


def as_clip(places, names=NAMES):
    """Keypoints of the dancer, with some joints at the places of others."""
    motion = HumanMotion("clip", 30.0, tuple(NAMES), turned_dancer().forward()[0][..., [2, 0, 1]])
    positions = motion.positions.copy()
    for name, other in places.items():
        positions[:, NAMES.index(name)] = motion.track(other)
    return names, positions


@pytest.mark.parametrize("pair", [("LeftUpLeg", "RightUpLeg"), ("LeftLeg", "LeftFoot"), ("RightHand", "RightForeArm")])
def test_two_landmarks_at_one_point_are_told(pair):
    names, positions = as_clip({pair[0]: pair[1]})
    roles = find_roles(tuple(names))
    both = f"\\({pair[0]}\\) and .*\\({pair[1]}\\)|\\({pair[1]}\\) and .*\\({pair[0]}\\)"
    for mapping in (None, roles):
        with pytest.raises(ValueError, match=f"({both}) are at one point in all frames; say which"):
            find_roles(tuple(names), mapping, positions=positions)
    near = positions.copy()
    near[0, NAMES.index(pair[0])] += 0.1  # in one frame they are apart
    assert find_roles(tuple(names), positions=near) == roles
    # such a toe is no toe, and is made up as where there is none
    names, positions = as_clip({"LeftToeBase": "LeftFoot"})
    assert "left_toe" not in find_roles(tuple(names), positions=positions)
