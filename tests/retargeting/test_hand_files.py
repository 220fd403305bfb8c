"""Hands as their makers' URDFs have them: how parts are called and coupled, judged by the files' own text."""

import dataclasses

import equinox as eqx
import mujoco
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from small_robots import quietly

import osik_jax as osik
from osik_jax.retargeting import HumanMotion, Profile, Retargeter, guess_profile, report
from osik_jax.retargeting._person import palm_axes

KNUCKLES = dict(thumb=(0.02, 0.04, 0.03), index=(0.0, 0.03, 0.1), middle=(0.0, 0.0, 0.1), ring=(0.0, -0.03, 0.095),
                little=(0.0, -0.055, 0.085))  # fmt: skip
"""Places on the palm of a right hand [m]: fingers along z, palm to x, index to y."""
TURNS = dict.fromkeys(KNUCKLES, "0 0 0") | {"thumb": "-1 0 0.7"}
LENGTHS = 0.045, 0.03, 0.025


def link(name, inside=""):
    inertia = '<inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/>'
    return (
        f'<link name="{name}"><inertial><origin xyz="0 0 0.01"/><mass value="0.02"/>{inertia}</inertial>{inside}</link>'
    )


def fixed(parent, name, at):
    ends = f'<parent link="{parent}"/><child link="{name}"/><origin xyz="{at}"/>'
    return f'<link name="{name}"/><joint name="{name}_fixed" type="fixed">{ends}</joint>'


def hinge(name, parent, child, at, *, turn="0 0 0", axis="0 1 0", low=0.0, high=1.6, mimic=""):
    return (
        f'{link(child)}<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{at}" rpy="{turn}"/><axis xyz="{axis}"/>'
        f'<limit lower="{low}" upper="{high}" effort="1" velocity="20"/>{mimic}</joint>'
    )


def finger(palm, at, joints, links, *, turn="0 0 0", tip="", low=0.0, couple=None):
    """Three hinges that bend to x, with the joints after the first led by it if ``couple`` has (factor, offset)s."""
    out, parent = "", palm
    for k, (joint, child) in enumerate(zip(joints, links, strict=True)):
        place = " ".join(map(str, at)) if not k else f"0 0 {LENGTHS[k - 1]}"
        follows = "" if not k or couple is None else (
            f'<mimic joint="{joints[0]}" multiplier="{couple[k - 1][0]}" offset="{couple[k - 1][1]}"/>'
        )  # fmt: skip
        high = 3.0 if follows else 1.6
        out += hinge(joint, parent, child, place, turn=turn if not k else "0 0 0", low=low, high=high, mimic=follows)
        parent = child
    return out + (fixed(parent, tip, f"0 0 {LENGTHS[2]}") if tip else "")


def loaded(*parts, palm="base"):
    text = f'<robot name="hand">{link(palm)}{"".join(parts)}</robot>'
    return osik.Robot.from_urdf(text, floating_base=False), text


def person(bends, frames=16):
    """A right hand whose fingers bend by these angles [rad] and open again; the thumb a little."""
    share, points = 0.5 - 0.5 * np.cos(np.linspace(0.0, 2.0 * np.pi, frames)), {"wrist": np.zeros((frames, 3))}
    for name, first in KNUCKLES.items():
        at, angle = np.tile(first, (frames, 1)), np.zeros(frames)
        turn = Rotation.from_euler("xyz", [float(a) for a in TURNS[name].split()]).as_matrix()
        points[f"{name}_1"] = at
        for joint, (length, bend) in enumerate(zip(LENGTHS, bends, strict=True), 2):
            angle = angle + (0.2 + share * bend) * (0.4 if name == "thumb" else 1.0)
            at = at + length * np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], 1) @ turn.T
            points[f"{name}_{joint}"] = at
    return HumanMotion("fist", 10.0, tuple(points), np.stack(list(points.values()), 1))


def columns(result):
    return dict(zip(result.motion.joint_names, result.motion.qpos.T, strict=True))


def coupled_hand():
    """As the Inspire hand and the Ability hand: ``proximal`` leads, with an offset; frames named after the thumb."""
    parts, mount = [fixed("base", "thumb_base", "-0.02 0.01 0")], np.array([-0.02, 0.01, 0.0])
    for f, at in KNUCKLES.items():
        name = "pinky" if f == "little" else f
        links = [f"{name}_{part}" for part in ("proximal", "intermediate", "distal")]
        joints, couple, turn = [f"{own}_joint" for own in links], [(1.06, 0.3), (0.5, 0.0)], TURNS[f]
        place = np.array(at) - mount
        parts.append(finger("thumb_base", place, joints, links, couple=couple, tip=f"{name}_tip", turn=turn))
    return loaded(*parts)


def test_joints_that_follow_do_as_the_file_says_and_the_wrist_is_no_part_of_the_thumb():
    robot, _ = coupled_hand()
    assert robot.nv == 5
    profile = quietly(guess_profile, robot)
    assert profile.keypoints["wrist"] == ("base", (0.0, 0.0, 0.0))
    assert [profile.keypoints[f"{f}_4"][0] for f in KNUCKLES] == [
        "thumb_tip", "index_tip", "middle_tip", "ring_tip", "pinky_tip"
    ]  # fmt: skip
    own = columns(Retargeter(robot, profile=profile).retarget(person((1.0, 1.0, 0.6))))
    for name in ("thumb", "index", "middle", "ring", "pinky"):
        leads = own[f"{name}_proximal_joint"]
        np.testing.assert_allclose(own[f"{name}_intermediate_joint"], 1.06 * leads + 0.3, atol=1e-9)
        np.testing.assert_allclose(own[f"{name}_distal_joint"], 0.5 * leads, atol=1e-9)
        assert leads.min() >= 0.0 and leads.max() <= 1.6 and np.ptp(leads) > 0.3


def test_a_hand_that_is_too_slow_for_its_clip_is_told():
    robot, _ = coupled_hand()
    profile, motion = quietly(guess_profile, robot), person((1.0, 1.0, 0.6))
    slow = eqx.tree_at(lambda robot: robot.velocity_limit, robot, 0.02 * robot.velocity_limit)
    quick, late = (report(Retargeter(own, profile=profile).retarget(motion)) for own in (robot, slow))
    assert quick["joints"]["at_speed_limit_share"] == 0.0 and not quick["notes"]
    assert late["joints"]["at_speed_limit_share"] > 0.5 and late["joints"]["speed_over_limit_max"] <= 1.0 + 1e-6
    assert any("at its largest speed" in note for note in late["notes"])


def test_a_palm_that_folds_has_all_five_fingers():
    """As the Schunk SVH: ring and little on a half of the palm that the thumb leads, links with letters, short tips."""
    half = hinge("j5", "e1", "e2", "0 -0.02 0.02", axis="0 0 1", low=-1.0, high=1.0,
                 mimic='<mimic joint="Thumb_Opposition" multiplier="1"/>')  # fmt: skip
    thumb = hinge("Thumb_Opposition", "e1", "z", "0.02 0.04 0.03", axis="0 0 1", high=1.0)
    parts, letters = [half, thumb], iter("abcdefghijklmnopq")
    tips = dict(thumb="thtip", index="fftip", middle="mftip", ring="rftip", little="lftip")
    names = dict(thumb="Thumb", index="Index_Finger", middle="Middle_Finger", ring="Ring_Finger", little="Pinky")
    for f, name in names.items():
        palm = {"thumb": "z", "ring": "e2", "little": "e2"}.get(f, "e1")
        at = dict(z=(0.0, 0.0, 0.0), e2=np.array(KNUCKLES[f]) - (0.0, -0.02, 0.02)).get(palm, KNUCKLES[f])
        links = [next(letters) for _ in range(3)]
        parts.append(finger(palm, at, [f"{name}_{k}" for k in range(3)], links, turn=TURNS[f]))
        parts.append(fixed(links[-1], tips[f], "0 0 0.006"))  # nearer to its joint than a hand to a forearm's
    robot, _ = loaded(*parts, palm="e1")
    profile = quietly(guess_profile, robot)
    assert {f: profile.keypoints[f"{f}_4"] for f in tips} == {f: (tip, (0.0, 0.0, 0.0)) for f, tip in tips.items()}
    assert profile.keypoints["ring_1"][0] == "j" and profile.keypoints["little_3"][0] == "o"


def test_fingers_that_bend_backwards_too_close_as_a_search_closes_them():
    """As the LEAP hand, whose fingers lean back by 0.4 rad; links are called by their place, tips by the finger."""
    parts = [
        finger("base", KNUCKLES[f], [str(3 * k), str(3 * k + 1), str(3 * k + 2)],
               [f"pip_{k}", f"dip_{k}", f"fingertip_{k}"], turn=TURNS[f], tip=f"{f}_tip_head", low=-0.4)
        for k, f in enumerate(KNUCKLES)
    ]  # fmt: skip
    robot, text = loaded(*parts)
    profile = quietly(guess_profile, robot)
    assert profile.keypoints["index_1"][0] == "pip_1" and profile.keypoints["index_4"][0] == "index_tip_head"
    motion = person((1.5, 1.5, 0.9))
    profile = dataclasses.replace(profile, scale=1.0)
    result = Retargeter(robot, profile=profile).retarget(motion)
    frame, tips = motion.frames // 2, [f"{f}_tip_head" for f in KNUCKLES]
    model = mujoco.MjModel.from_xml_string(
        text.replace("</robot>", '<mujoco><compiler fusestatic="false"/></mujoco></robot>')
    )
    data, seen = mujoco.MjData(model), {name: motion.positions[:, k] for k, name in enumerate(motion.joint_names)}
    turn = palm_axes({name: track[frame] for name, track in seen.items()}).T
    goal = np.array([turn @ seen[f"{f}_4"][frame] for f in KNUCKLES])

    def off(q):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        return np.linalg.norm([data.body(tip).xpos for tip in tips] - goal, axis=-1)

    own = columns(result)
    q = np.array([own[model.joint(j).name][frame] for j in range(model.njnt)])
    starts = [q, np.full(15, 0.5), np.full(15, 1.0)]
    best = min((least_squares(off, start, bounds=(-0.4, 1.6)) for start in starts), key=lambda found: found.cost)
    assert np.sqrt((off(q) ** 2).mean()) < np.sqrt(2.0 * best.cost / 5) + 1e-3


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_claw_without_names_is_a_right_hand(mirrored):
    """As D'Claw: links ``f1`` to ``f3``, the thumb opposite the middle of two; without tips, shapes end the links."""
    parts, ends = [], '<collision><geometry><box size="0.01 0.01 0.05"/></geometry></collision>'
    places = {1: (0.0, 0.03, 0.05), 2: (0.0, -0.03, 0.05), 3: (0.08, 0.0, 0.05)}
    for k, (x, y, z) in places.items():
        links = [f"link_f{k}_{joint}" for joint in (1, 2, 3)]
        at, lean = (-x if mirrored else x, y, z), 0.3 if k == 3 else 0.0
        face = f"0 {lean} {np.pi if mirrored != (k == 3) else 0.0}"
        own = finger("base", at, [f"joint_f{k}_{joint}" for joint in (1, 2, 3)], links, turn=face)
        parts.append(own.replace(link(links[-1]), link(links[-1], ends)))
    robot, _ = loaded(*parts)
    profile = quietly(guess_profile, robot)
    assert isinstance(profile, Profile) and profile.is_hand
    assert [profile.keypoints[f"{f}_4"] for f in ("thumb", "index", "middle")] == [
        (f"link_f{k}_3", (0.0, 0.0, 0.025)) for k in ((3, 2, 1) if mirrored else (3, 1, 2))
    ]


def test_an_arm_with_a_hand_is_no_hand():
    arm, parent = "", "base"
    for k in range(4):
        arm += hinge(f"arm_{k}", parent, f"arm_link_{k}", "0 0 0.2", axis="1 0 0" if k % 2 else "0 0 1", low=-2.0)
        parent = f"arm_link_{k}"
    parts = [
        finger(parent, at, [f"{f}_{k}" for k in range(3)], [f"{f}_link_{k}" for k in range(3)], turn=TURNS[f])
        for f, at in KNUCKLES.items()
    ]
    robot, _ = loaded(arm, *parts)
    try:
        assert not quietly(guess_profile, robot).is_hand
    except ValueError as error:
        assert "arm" in str(error)
