"""Hands that follow 21 keypoints: fingertips beside those of a larger hand, and beside a search by SciPy."""

import dataclasses

import mujoco
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from small_robots import by_mujoco, quietly

import osik_jax as osik
from osik_jax.retargeting import (
    HumanMotion,
    Profile,
    Retargeter,
    SourceMotion,
    describe_profile,
    guess_profile,
    load_profile,
    report,
    save_profile,
)
from osik_jax.retargeting._person import palm_axes
from osik_jax.retargeting._roles import FINGERS, HAND
from osik_jax.retargeting._skeletons import find_roles

FPS, SMALLER = 30.0, 0.7
FINGER = """<body name="{f}_1" pos="{at}" euler="{turn}"><joint name="{f}_j4" axis="1 0 0" range="-20 20"/>
  <geom size="0.008"/><body name="{f}_k"><joint name="{f}_j3" axis="0 1 0" range="-10 95"/>
  <geom type="capsule" fromto="0 0 0 0 0 0.05" size="0.007"/>
  <body name="{f}_2" pos="0 0 0.05"><joint name="{f}_j2" axis="0 1 0" range="-10 95"/>
  <geom type="capsule" fromto="0 0 0 0 0 0.03" size="0.007"/>
  <body name="{f}_3" pos="0 0 0.03"><joint name="{f}_j1" axis="0 1 0" range="-10 95"/>
  <geom type="capsule" fromto="0 0 0 0 0 0.025" size="0.007"/>
  <site name="{f}_tip" pos="0 0 0.025"/></body></body></body></body>"""
COUPLED = """<body name="{f}_1" pos="{at}" euler="{turn}"><joint name="{f}_j2" axis="0 1 0" range="0 95"/>
  <geom type="capsule" fromto="0 0 0 0 0 0.045" size="0.007"/>
  <body name="{f}_2" pos="0 0 0.045"><joint name="{f}_j1" axis="0 1 0" range="0 95"/>
  <geom type="capsule" fromto="0 0 0 0 0 0.045" size="0.007"/><site name="{f}_tip" pos="0 0 0.045"/></body></body>"""
PLACES = dict(thumb=("0.02 0.04 0.04", "-60 0 40"), index=("0 0.03 0.1", "0 0 0"), middle=("0 0 0.1", "0 0 0"),
              ring=("0 -0.03 0.1", "0 0 0"), little=("0 -0.06 0.09", "0 0 0"))  # fmt: skip
FOUR = ("thumb", "index", "middle", "ring")


def hand_of(names, finger=FINGER, wrist="", follow=False):
    """A palm with fingers called by ``names``, moved by the joints of a wrist; ``follow`` couples outer joints."""
    inside = "".join(
        finger.format(f=name, at=PLACES[f][0], turn=PLACES[f][1]) for f, name in names.items() if f in PLACES
    )
    coupled = "".join(
        f'<joint joint1="{name}_j1" joint2="{name}_j2" polycoef="0 0.9 0 0 0"/>' for name in names.values() if follow
    )
    return osik.Robot.from_mjcf(
        f"""<mujoco><compiler autolimits="true"/><default><geom contype="0" conaffinity="0"/></default><worldbody>
        <body name="forearm" pos="0.3 0.1 0.5" euler="20 40 0"><geom size="0.02"/>
        <body name="palm">{wrist}<geom type="box" pos="0 0 0.05" size="0.015 0.04 0.05"/>{inside}</body></body>
        </worldbody><equality>{coupled}</equality></mujoco>""",
    )


@pytest.fixture(scope="module")
def hand():
    return hand_of({f: f for f in FOUR})


@pytest.fixture(scope="module")
def profile(hand):
    return quietly(guess_profile, hand)


def placed(robot, profile, qpos):
    """The keypoints of a robot by role, by MuJoCo. (F, 3) each."""

    def read(data):
        frames = [data.site(f) if "tip" in f else data.body(f) for f, _ in profile.keypoints.values()]
        points = [np.array(point) for _, point in profile.keypoints.values()]
        return [own.xpos + own.xmat.reshape(3, 3) @ point for own, point in zip(frames, points, strict=True)]

    return dict(zip(profile.keypoints, np.swapaxes(by_mujoco(robot, qpos, read), 0, 1), strict=True))


def grasping(robot, profile, frames=24):
    """Keypoints of a smaller hand that closes while it is carried and turned; and those of the robot that it is."""
    rng = np.random.default_rng(0)
    low, high = np.asarray(robot.position_lower), np.asarray(robot.position_upper)
    share = 0.5 - 0.5 * np.cos(np.linspace(0.0, 2.0 * np.pi, frames))
    q = np.asarray(robot.q0) + share[:, None] * rng.uniform(0.2, 0.6, robot.nv) * np.where(high > 1.0, high, 0.3 * high)
    assert (q >= low).all() and (q <= high).all()
    points = placed(robot, profile, [np.asarray(robot.mujoco_qpos(own)) for own in q])
    turns = Rotation.from_euler("xyz", np.linspace([0, 0, 0], [30, 50, 70], frames), degrees=True).as_matrix()
    path = np.linspace([0.0, 0.0, 1.0], [0.3, 0.1, 1.2], frames)[:, None]
    carried = np.einsum("fij,fkj->fki", turns, SMALLER * np.stack(list(points.values()), 1)) + path
    return HumanMotion("grasp", FPS, tuple(points), carried), points


def person(curls, frames=20):
    """A person's hand with 21 keypoints that closes by ``curls`` [rad] and opens again."""
    share, points = 0.5 - 0.5 * np.cos(np.linspace(0.0, 2.0 * np.pi, frames)), {"wrist": np.zeros((frames, 3))}
    bones = dict(thumb=(0.045, 0.035, 0.028), index=(0.043, 0.025, 0.022), middle=(0.046, 0.029, 0.023),
                 ring=(0.042, 0.027, 0.023), little=(0.033, 0.02, 0.02))  # fmt: skip
    first = dict(thumb=(0.015, 0.03, 0.03), index=(0.0, 0.027, 0.092), middle=(0.0, 0.004, 0.094),
                 ring=(0.0, -0.017, 0.088), little=(0.0, -0.036, 0.08))  # fmt: skip
    for finger, lengths in bones.items():
        angle, at = np.zeros(frames), np.tile(first[finger], (frames, 1))
        along, towards = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
        if finger == "thumb":
            along, towards = (0.0, 0.87, 0.5), (0.77, 0.32, -0.56)
        points[f"{finger}_1"] = at
        for joint, (length, curl) in enumerate(zip(lengths, curls, strict=True), 2):
            angle = angle + (0.3 + share * curl) * (0.4 if finger == "thumb" else 1.0)
            at = at + length * (np.cos(angle)[:, None] * along + np.sin(angle)[:, None] * towards)
            points[f"{finger}_{joint}"] = at
    return HumanMotion("close", FPS, tuple(points), np.stack(list(points.values()), 1))


def off(robot, profile, result, motion, factor):
    """Distance of each fingertip from the person's, about the wrist in the palm's axes and scaled [m]. (F, tips)."""
    own, home = placed(robot, profile, result.motion.qpos), placed(robot, profile, [robot.mujoco_qpos(robot.q0)])
    seen = {name: motion.positions[:, k] for k, name in enumerate(motion.joint_names)}
    turn = palm_axes(home) @ np.swapaxes(palm_axes(seen), 1, 2)
    tips = [role for role in profile.keypoints if role.endswith("_4")]
    goals = [factor * np.einsum("fij,fj->fi", turn, seen[tip] - seen["wrist"]) for tip in tips]
    errors = [np.linalg.norm(own[tip] - own["wrist"] - goal, axis=-1) for tip, goal in zip(tips, goals, strict=True)]
    return np.stack(errors, 1), np.stack(goals, 1)


@pytest.mark.slow
def test_fingertips_are_those_of_a_smaller_hand_that_is_carried(hand, profile, tmp_path):
    clip, points = grasping(hand, profile)
    result = Retargeter(hand, profile=profile).retarget(clip)
    figures = report(result)
    assert figures["joints"]["beyond_range_max"] == 0.0 and figures["joints"]["speed_over_limit_max"] <= 1.0 + 1e-6
    assert set(figures["tracking"]["limb_error_mm"]) == set(FOUR)
    own = placed(hand, profile, result.motion.qpos)
    away = np.stack([np.linalg.norm(own[f"{f}_4"] - points[f"{f}_4"], axis=-1) for f in FOUR])
    assert away.mean() < 2e-5 and away.max() < 1e-4
    # a given scale is that of all fingers
    closer = dataclasses.replace(profile, scale=0.97 / SMALLER)
    assert off(hand, profile, Retargeter(hand, profile=closer).retarget(clip), clip, 0.97 / SMALLER)[0].mean() < 1e-3
    save_profile(profile, tmp_path / "hand.toml")
    assert load_profile(tmp_path / "hand.toml") == profile


def test_a_hand_follows_a_hand(hand, profile):
    clip, _ = grasping(hand, profile)
    first = Retargeter(hand, profile=profile).retarget(clip)
    again = Retargeter(hand, profile=profile).retarget(SourceMotion(hand, first.motion, profile))
    one, two = (placed(hand, profile, result.motion.qpos) for result in (first, again))
    assert max(np.linalg.norm(one[f"{f}_4"] - two[f"{f}_4"], axis=-1).max() for f in FOUR) < 1e-3


SHADOW = dict(thumb="rh_TH", index="rh_FF", middle="rh_MF", ring="rh_RF", little="rh_LF")
WRIST = '<joint name="WRJ2" axis="0 1 0" range="-30 10"/><joint name="WRJ1" axis="1 0 0" range="-40 28"/>'


@pytest.mark.variants(slow=["coupled"], release=["unnamed", "two letters and a wrist"])
@pytest.mark.parametrize(
    ("names", "options", "axes"),
    [
        ({f: f for f in FINGERS}, {}, 20),
        ({f: f"link_{k}" for k, f in enumerate(FOUR)}, {}, 16),
        (SHADOW, {"wrist": WRIST}, 22),
        ({f: f"R_{f}" for f in FINGERS}, {"finger": COUPLED, "follow": True}, 5),
    ],
    ids=["named", "unnamed", "two letters and a wrist", "coupled"],
)
def test_fingers_are_found_and_reach_what_a_search_reaches(names, options, axes):
    robot = hand_of(names, **options)
    assert robot.nv == axes
    profile = quietly(guess_profile, robot)
    for finger, name in names.items():
        assert profile.keypoints[f"{finger}_4"] == (f"{name}_tip", (0.0, 0.0, 0.0))
        assert profile.keypoints[f"{finger}_1"][0].startswith(name)
    assert ("no little" in describe_profile(robot, profile)) == ("little" not in names)
    motion, factor = person((0.8, 0.9, 0.5)), 1.05
    profile = dataclasses.replace(profile, scale=factor)
    result = Retargeter(robot, profile=profile).retarget(motion)
    figures = report(result)
    assert figures["joints"]["beyond_range_max"] == 0.0 and figures["joints"]["jump_frames"] == 0
    errors, goals = off(robot, profile, result, motion, factor)
    low, high = np.asarray(robot.position_lower), np.asarray(robot.position_upper)
    tips, rng = [role for role in profile.keypoints if role.endswith("_4")], np.random.default_rng(1)
    data, wrist = mujoco.MjData(robot.mj_model), placed(robot, profile, [robot.mujoco_qpos(robot.q0)])["wrist"][0]
    index, coefficient = robot.tree.qpos_source
    for frame in (0, 10):

        def residual(q, frame=frame):
            data.qpos[:] = q[index] * coefficient + np.asarray(robot.qpos_offset)
            mujoco.mj_kinematics(robot.mj_model, data)
            own = [data.site(profile.keypoints[tip][0]).xpos for tip in tips]
            return np.concatenate([at - wrist - goals[frame, k] for k, at in enumerate(own)])

        starts = [np.clip(result.q[frame], low, high), *rng.uniform(low, high, (2, robot.nv))]
        found = [least_squares(residual, start, bounds=(low, high)) for start in starts]
        best = np.sqrt(2.0 * min(own.cost for own in found) / len(tips))
        own = np.sqrt((errors[frame] ** 2).mean())
        # a search frame by frame may jump, so it may be better where tips are out of reach
        assert own < 1.2 * best + 5e-4


def test_what_is_no_hand():
    for name in ("ur5", "nao"):
        robot = osik.load_robot(name)
        try:
            assert not quietly(guess_profile, robot).is_hand
        except ValueError:
            assert name == "ur5"
    with pytest.raises(ValueError, match="a hand has a keypoint wrist"):
        Profile(keypoints={"wrist": ("palm", (0.0, 0.0, 0.0)), "index_4": ("tip", (0.0, 0.0, 0.0))}, pelvis="palm")


def test_keypoints_of_a_hand_are_known_by_mediapipes_names():
    names = ["RIGHT_WRIST"]
    for finger in ("thumb", "index", "middle", "ring", "pinky"):
        end = "_finger" if finger in ("index", "middle", "ring") else ""
        parts = ("cmc", "mcp", "ip", "tip") if finger == "thumb" else ("mcp", "pip", "dip", "tip")
        names += [f"{finger}{end}_{part}".upper() for part in parts]
    found = find_roles(tuple(names), needed=HAND)
    assert [found[role] for role in HAND] == names  # in MediaPipe's order
    with pytest.raises(ValueError, match="has no index_4"):
        find_roles(tuple(name for name in names if name != "INDEX_FINGER_TIP"), needed=HAND)
