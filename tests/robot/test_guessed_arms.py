"""Guessed profiles of robots whose arms have no wrist joint, twist above the elbow, or have fingers."""

import numpy as np
import pytest
from motion_files import dancer, write_bvh
from small_robots import LEG

import osik_jax as osik
from osik_jax.kinematics._forward import home_kinematics
from osik_jax.retargeting import guess_profile, load_motion, report, retarget

UPPER, FOREARM = 0.3, 0.28
ARM = """<body name="{s}_pitch" pos="0 {y} 0.4"><joint name="{s}_pitch" axis="0 1 0" range="-170 170"/>
  <geom size="0.03"/><body name="{s}_roll" pos="0 {dy} 0"><joint name="{s}_roll" axis="1 0 0" range="-150 150"/>
  <geom size="0.04"/>
  {yaw}<body name="{s}_elbow" pos="0.02 0 {elbow}"><joint name="{s}_elbow" axis="0 1 0" range="-140 60"/>
    {forearm}</body>{end}</body></body>"""
YAW = """<body name="{s}_yaw" pos="0 0 -0.12"><joint name="{s}_yaw" axis="0 0 1" range="-100 100"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.15" size="0.03"/>"""
CAPSULE = f'<geom type="capsule" fromto="0.03 0 0 {FOREARM - 0.03} 0 0" size="0.03" density="800"/>'
CAMERA = '<site name="{s}_hand_camera" pos="0.01 0 0.05"/>'
FRAME = f'<site name="{{s}}_hand_frame" pos="{FOREARM + 0.07} 0 0.01"/>'
MESH = '<geom type="mesh" mesh="stick" density="1" pos="0.2 0 0"/>'
PLACEHOLDER = '<inertial pos="0.1 0 0" mass="1" diaginertia="1 1 1"/>'


def stick_robot(left, right, *, yaw=True):
    """A robot whose forearms point forward at home.

    Args:
        left: what the left forearm has.
        right: the same of the right one.
        yaw: whether the upper arms twist.
    """
    sides = []
    for s, sign, forearm in (("left", 1.0, left), ("right", -1.0, right)):
        own = YAW.format(s=s) if yaw else ""
        parts = dict(s=s, y=0.15 * sign, dy=0.05 * sign, yaw=own, end="</body>" if yaw else "")
        arm = ARM.format(elbow=-0.18 if yaw else -UPPER, forearm=forearm.format(s=s), **parts)
        sides += [LEG.format(s=s, y=0.1 * sign), arm]
    return osik.Robot.from_mjcf(
        f"""<mujoco><compiler autolimits="true"/><default><geom contype="0" conaffinity="0"/></default>
        <asset><mesh name="stick" vertex="-0.2 -0.02 -0.02 -0.2 0.02 -0.02 -0.2 -0.02 0.02 -0.2 0.02 0.02
          0.2 -0.02 -0.02 0.2 0.02 -0.02 0.2 -0.02 0.02 0.2 0.02 0.02"/></asset>
        <worldbody><body name="base" pos="0 0 0.85"><freejoint/>
        <geom type="box" pos="0 0 0.2" size="0.06 0.1 0.2"/>{"".join(sides)}</body></worldbody></mujoco>"""
    )


def places(robot, profile, *roles):
    kinematics, out = home_kinematics(robot), []
    for role in roles:
        frame, point = profile.keypoints[role]
        position, rotation = (np.asarray(x) for x in kinematics.frame_pose(robot, frame))
        out.append(position + rotation @ np.array(point))
    return out


@pytest.mark.parametrize(
    ("left", "right", "yaw"),
    [
        ((CAPSULE + CAMERA, FOREARM, 0.03), (CAPSULE + FRAME, np.hypot(FOREARM + 0.07, 0.01), 2e-6), True),
        ((CAPSULE + MESH, 0.4, 0.01), (PLACEHOLDER, 1.2 * np.hypot(UPPER, 0.02), 2e-6), True),
        ((CAPSULE, FOREARM, 0.03), (CAPSULE, FOREARM, 0.03), False),
    ],
    ids=["masses, a hand frame", "a mesh, placeholders", "three joints"],
)
def test_the_end_of_the_last_link_is_the_wrist_of_an_arm_without_one(left, right, yaw):
    robot = stick_robot(left[0], right[0], yaw=yaw)
    profile = guess_profile(robot)
    for side, (_, length, tolerance) in (("left", left), ("right", right)):
        assert profile.keypoints[f"{side}_elbow"][0] == f"{side}_elbow"
        elbow, wrist = places(robot, profile, f"{side}_elbow", f"{side}_wrist")
        assert np.linalg.norm(wrist - elbow) == pytest.approx(length, abs=tolerance)
        assert (wrist - elbow)[0] > 0.99 * np.linalg.norm(wrist - elbow)
        own = {(capsule.start, capsule.end) for capsule in profile.capsules if capsule.frame == f"{side}_elbow"}
        assert len(own) == 1  # its own masses, and nothing more from joint to joint


def test_fingers_do_not_make_the_wrist_an_elbow():
    """Fingertips are farther from the wrist than the elbow is from the shoulder."""
    finger = """<body name="{{s}}_{f}" pos="0.08 {y} 0"><joint name="{{s}}_{f}" axis="0 0 1" range="-30 90"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.008"/>
      <body name="{{s}}_{f}_tip" pos="0.4 0 0"><joint name="{{s}}_{f}_2" axis="0 0 1"/><geom size="0.01"/></body>
      </body>"""
    wrist = f"""<body name="{{s}}_twist" pos="0.1 0 0"><joint name="{{s}}_wrist_roll" axis="1 0 0" range="-90 90"/>
      <geom size="0.03"/>
      <body name="{{s}}_palm" pos="0.15 0 0"><joint name="{{s}}_wrist_pitch" axis="0 1 0" range="-60 60"/>
      <geom type="box" size="0.05 0.03 0.02"/>{finger.format(f="index", y=0.02)}{finger.format(f="ring", y=-0.02)}
      </body></body>"""
    gripper = """<body name="{s}_claw" pos="0.3 0 0"><joint name="{s}_gripper" axis="0 0 1" range="0 60"/>
      <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.01"/></body>"""
    profile = guess_profile(stick_robot(CAPSULE + wrist, CAPSULE + gripper))
    assert [profile.keypoints[f"left_{role}"][0] for role in ("elbow", "wrist")] == ["left_elbow", "left_palm"]
    assert [profile.keypoints[f"right_{role}"][0] for role in ("elbow", "wrist")] == ["right_elbow", "right_claw"]


def test_arms_that_do_not_bend_end_at_the_elbow():
    robot = stick_robot('<geom size="0.02"/>', '<geom size="0.02"/>', yaw=False)
    with pytest.warns(osik.OsikWarning, match=r"left arm to the elbow \(no wrist\)"):
        profile = guess_profile(robot)
    assert {role.split("_")[1] for role in profile.keypoints} == {"hip", "knee", "ankle", "shoulder", "elbow"}
    for side in ("left", "right"):
        shoulder, elbow = places(robot, profile, f"{side}_shoulder", f"{side}_elbow")
        assert np.linalg.norm(elbow - shoulder) == pytest.approx(np.hypot(UPPER, 0.02), abs=1e-9)


@pytest.mark.release
def test_elbows_without_wrists_follow_the_person(tmp_path):
    motion = load_motion(write_bvh(tmp_path / "dance.bvh", dancer(20), 0.01))
    result = retarget(stick_robot(CAPSULE, CAPSULE), motion)
    figures = report(result)
    assert figures["tracking"]["segment_angle_deg_mean"] < 2.0 and figures["feet"]["slip_mm_max"] < 0.1


@pytest.mark.parametrize("mass, moment", [(10.0, 0.1), (15.0, 1.0), (1.0, 1.0), (30.0, 1e-5)])
@pytest.mark.parametrize("solid", [True, False], ids=["a shape", "no shape"])
def test_a_trunk_with_placeholder_inertia_is_as_large_as_its_shape(mass, moment, solid):
    """A box of 12 by 20 by 40 cm that meets others; without it the trunk is as wide as the shoulders are apart."""
    stick = stick_robot((CAPSULE, FOREARM, 0.03)[0], (CAPSULE, FOREARM, 0.03)[0])
    text = stick.to_mjcf()
    start = text.index("<inertial", text.index('name="base"'))
    end = text.index("/>", start) + 2
    placeholder = f'<inertial pos="0 0 0.2" mass="{mass}" diaginertia="{moment} {moment} {moment}"/>'
    box = '<geom type="box" pos="0 0 0.2" size="0.06 0.1 0.2" mass="0"/>' if solid else ""
    robot = osik.Robot.from_mjcf(text[:start] + placeholder + box + text[end:])
    trunk = [capsule for capsule in guess_profile(robot).capsules if capsule.frame == "base"]
    assert trunk
    for capsule in trunk:
        ends = np.array([capsule.start, capsule.end])
        most = 0.061 if solid else 0.3 * 0.4 + 1e-6
        assert capsule.radius <= most and np.abs(ends[:, 0]).max() < 1e-6
        assert ends[:, 2].min() - capsule.radius > -0.01 and ends[:, 2].max() + capsule.radius < 0.5
