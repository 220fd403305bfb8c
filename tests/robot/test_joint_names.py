"""Names of joints by convention, and spellings of the same: which joint of a clip is which of a person's."""

import itertools
import re

import pytest

from osik_jax.retargeting import find_roles
from osik_jax.retargeting._roles import NEEDED

LEGS_AND_ARMS = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
LEFT_RIGHT, CAPITAL, LETTER, SMALL = ("left", "right"), ("Left", "Right"), ("L", "R"), ("l", "r")
# Sides; hip, knee, ankle, shoulder, elbow, wrist; joints that are none of these; the trunk with the chest first.
CONVENTIONS = {
    "Mixamo": (
        CAPITAL,
        "*UpLeg *Leg *Foot *Arm *ForeArm *Hand",
        "*Shoulder *ToeBase *HandThumb1",
        "Spine Hips Spine1 Spine2",
    ),
    "LAFAN1": (
        CAPITAL,
        "*UpLeg *Leg *Foot *Arm *ForeArm *Hand",
        "*Shoulder *Toe",
        "Spine Hips Spine1 Spine2 Neck Head",
    ),
    "Xsens BVH": (
        CAPITAL,
        "*Hip *Knee *Ankle *Shoulder *Elbow *Wrist",
        "*Collar *Toe",
        "Chest Hips Chest2 Chest3 Neck Head",
    ),
    "Xsens segments": (
        CAPITAL,
        "*UpperLeg *LowerLeg *Foot *UpperArm *ForeArm *Hand",
        "*Shoulder *Toe",
        "T12 Pelvis L5 L3 T8",
    ),
    "SMPL": (
        LEFT_RIGHT,
        "*_hip *_knee *_ankle *_shoulder *_elbow *_wrist",
        "*_foot *_collar *_hand",
        "spine2 pelvis spine1 spine3",
    ),
    "SMPL, short": (
        LETTER,
        "*_Hip *_Knee *_Ankle *_Shoulder *_Elbow *_Wrist",
        "*_Toe *_Collar *_Hand",
        "Spine Pelvis Torso Chest",
    ),
    "OpenPose": (
        LETTER,
        "*Hip *Knee *Ankle *Shoulder *Elbow *Wrist",
        "*BigToe *SmallToe *Heel *Eye",
        "- MidHip Neck Nose",
    ),
    "MediaPipe": (
        LEFT_RIGHT,
        "*_hip *_knee *_ankle *_shoulder *_elbow *_wrist",
        "*_heel *_foot_index *_index",
        "- nose",
    ),
    "Blender": (
        LETTER,
        "thigh.* shin.* foot.* upper_arm.* forearm.* hand.*",
        "shoulder.* pelvis.* heel.02.*",
        "spine.001 spine",
    ),
    "Unreal": (
        SMALL,
        "thigh_* calf_* foot_* upperarm_* lowerarm_* hand_*",
        "ik_foot_* lowerarm_twist_01_* ball_*",
        "spine_01 spine_02",
    ),
    "Unreal, five": (
        SMALL,
        "thigh_* calf_* foot_* upperarm_* lowerarm_* hand_*",
        "ik_hand_*",
        "spine_03 spine_01 spine_02 spine_05",
    ),
    "DeepMimic": (LEFT_RIGHT, "*_hip *_knee *_ankle *_shoulder *_elbow *_wrist", "*_heel *_toe", "chest root neck"),
    "Bandai Namco": (
        LETTER,
        "UpperLeg_* LowerLeg_* Foot_* UpperArm_* LowerArm_* Hand_*",
        "Shoulder_* Toes_*",
        "Spine joint_Root Hips Chest",
    ),
    "SOMA": (
        CAPITAL,
        "*Leg *Shin *Foot *Arm *ForeArm *Hand",
        "*Shoulder *ToeBase",
        "Spine2 Hips Spine1 Chest Neck1 Jaw",
    ),
    "CMU, DAZ": (
        SMALL,
        "*Thigh *Shin *Foot *Shldr *ForeArm *Hand",
        "*Buttock *Collar *Thumb1",
        "chest hip abdomen neck",
    ),
    "CMU, BVH": (
        CAPITAL,
        "*UpLeg *Leg *Foot *Arm *ForeArm *Hand",
        "*Shoulder *FingerBase",
        "Spine Hips LowerBack Spine1",
    ),
    "Unity": (
        CAPITAL,
        "*UpperLeg *LowerLeg *Foot *UpperArm *LowerArm *Hand",
        "*Shoulder *Toes",
        "Spine Hips Chest UpperChest",
    ),
    "OptiTrack": (LETTER, "*Thigh *Shin *Foot *UArm *FArm *Hand", "*Shoulder *Toe", "Chest Hip Ab Neck"),
    "Biped": (
        LETTER,
        "Bip01_*_Thigh Bip01_*_Calf Bip01_*_Foot Bip01_*_UpperArm Bip01_*_Forearm Bip01_*_Hand",
        "Bip01_*_Clavicle Bip01_*_Toe0",
        "Bip01_Spine Bip01 Bip01_Pelvis",
    ),
    "VRM": (
        LETTER,
        "J_Bip_*_UpperLeg J_Bip_*_LowerLeg J_Bip_*_Foot J_Bip_*_UpperArm J_Bip_*_LowerArm J_Bip_*_Hand",
        "J_Sec_*_Bust1 J_Bip_*_Shoulder",
        "J_Bip_C_Spine J_Bip_C_Hips Root",
    ),
    "ASF": (
        SMALL,
        "*femur *tibia *foot *humerus *radius *wrist",
        "*hipjoint *clavicle *hand *toes",
        "upperback root lowerback thorax",
    ),
    "MocapNET": (SMALL, "*hip *knee *foot *shoulder *elbow *hand", "", "chest hip abdomen neck"),
    "Human3.6M": (LETTER, "*Hip *Knee *Foot *Shoulder *Elbow *Wrist", "", "Spine Hip Thorax Neck/Nose Head"),
    "Kinect v1": (
        CAPITAL,
        "Hip* Knee* Ankle* Shoulder* Elbow* Wrist*",
        "Foot* Hand*",
        "Spine HipCenter ShoulderCenter Head",
    ),
    "Kinect v2": (
        CAPITAL,
        "Hip* Knee* Ankle* Shoulder* Elbow* Wrist*",
        "Foot* Hand* HandTip*",
        "SpineMid SpineBase SpineShoulder",
    ),
    "MakeHuman": (
        LETTER,
        "upperleg01.* lowerleg01.* foot.* upperarm01.* lowerarm01.* wrist.*",
        "pelvis.* upperleg02.* lowerleg02.* shoulder01.* upperarm02.* toe1-1.*",
        "spine03 root spine05 spine01",
    ),
    "OpenSim": (SMALL, "femur_* tibia_* calcn_* humerus_* ulna_* hand_*", "radius_* toes_*", "torso pelvis"),
    "OpenSim, talus": (SMALL, "femur_* tibia_* talus_* humerus_* ulna_* hand_*", "calcn_*", "torso pelvis"),
    "MMD": (
        ("左", "右"),
        "*足 *ひざ *足首 *腕 *ひじ *手首",
        "*足ＩＫ *肩 *つま先 *手捩",
        "上半身 センター 上半身2 下半身",
    ),
    "MMD in English": (LETTER, "leg_* knee_* ankle_* arm_* elbow_* wrist_*", "shoulder_* toe_*", "- center"),
}


def joints_of(convention, spelled=lambda name: name, form=None, words=None):
    """Names of a convention, and the roles that they have.

    Args:
        convention: its name.
        spelled: how a name is changed.
        form: where the word for the side stands, with ``side`` and ``name``; None: as the convention has it.
        words: for left and right; None: the convention's.
    """
    own, limbs, others, trunk = CONVENTIONS[convention]
    chest, *rest = trunk.split()
    roles = {} if chest == "-" else {"chest": spelled(chest)}
    names = [*roles.values(), *map(spelled, rest)]
    for side, word in zip(("left", "right"), own if words is None else words, strict=True):

        def named(names, word=word):
            if form is None:
                return [spelled(name.replace("*", word)) for name in names.split()]
            without = [name.replace("*_", "").replace("*", "").rstrip("._") for name in names.split()]
            return [spelled(form.format(side=word, name=name)) for name in without]

        roles |= {f"{side}_{role}": name for role, name in zip(LEGS_AND_ARMS, named(limbs), strict=True)}
        names += [*named(limbs), *named(others)]
    return tuple(dict.fromkeys(names)), roles


def assert_found(names, roles):
    found = find_roles(names)
    assert {role: found.get(role) for role in (*NEEDED, "chest")} == {"chest": None} | roles


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_conventions_of_names_are_known(convention):
    names, roles = joints_of(convention)
    assert set(NEEDED) <= set(roles)
    assert_found(names, roles)
    assert_found(names[::-1], roles)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_spellings_of_a_convention_are_known(convention):
    spellings = (
        str.upper,
        str.lower,
        lambda name: re.sub("[_. ]", "", name),
        lambda name: re.sub("(?<=[a-z])(?=[A-Z])|_", "-", name),
        *(form.format for form in ("mixamorig:{}", "Character1_{}", "Skel 2|{}", "DEF-{}", "{}_jnt")),
    )
    for spelled in spellings:
        assert_found(*joints_of(convention, spelled))


@pytest.mark.parametrize("convention", [name for name in CONVENTIONS if not name.startswith("MMD")])
def test_the_word_for_the_side_stands_before_or_after(convention):
    forms = ("{side}{name}", "{side}_{name}", "{side} {name}", "{name}_{side}", "{name}{side}", "{name}.{side}")
    for form, sides in itertools.product(forms, (CAPITAL, LEFT_RIGHT, LETTER, SMALL)):
        assert_found(*joints_of(convention, form=form, words=sides))


def test_the_error_names_what_is_found_and_what_is_not():
    names, roles = joints_of("Mixamo", "mixamorig:{}".format)
    fingers = tuple(
        f"mixamorig:{side}Hand{finger}{k}" for side in CAPITAL for finger in ("Index", "Ring") for k in range(9)
    )
    gone = (roles["left_wrist"], roles["right_knee"])
    with pytest.raises(ValueError, match="no right_knee, left_wrist that can be told by name") as error:
        find_roles(tuple(name for name in names if name not in gone) + fingers)
    text = str(error.value)
    assert "right_elbow=mixamorig:RightForeArm" in text and "left_hip=mixamorig:LeftUpLeg" in text
    assert "LeftHandIndex0" in text and "more" in text and "mapping={role: joint}" in text
    assert len(text) < 10 * 120
    with pytest.raises(ValueError, match="found: none; other joints: a, b; "):
        find_roles(("a", "b"))
    with pytest.raises(ValueError, match="other joints: none"):
        find_roles(())
