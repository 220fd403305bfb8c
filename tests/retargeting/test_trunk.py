"""Pelvis and chest of a person whose skeleton slants, and what a report says of trunk and waist."""

import numpy as np
import pytest
from lafan_walk import as_published, lafan_walk
from motion_files import bent_forward, dancer, seen, write_bvh
from scipy.spatial.transform import Rotation

from osik_jax.retargeting import HumanMotion, Retargeter, _person, load_motion, report
from osik_jax.retargeting._report import notes

FRAMES = 32


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    return load_motion(write_bvh(tmp_path_factory.mktemp("lafan") / "walk.bvh", as_published(lafan_walk(FRAMES)), 0.01))


def leans(turns):
    """Forward lean of axes in each frame [deg]."""
    return np.degrees(np.arctan2(turns[:, 0, 2], turns[:, 2, 2]))


def test_the_pelvis_of_lafan1_is_upright(walk):
    """Its lowest spine joint is 33 degrees behind the hips; the trunk of the walk leans forward by 1 degree."""
    assert walk.rest_positions is None
    left, right, spine = (walk.track(name) for name in ("LeftUpLeg", "RightUpLeg", "Spine"))
    raw = spine - 0.5 * (left + right)
    assert np.degrees(np.arctan2(raw[:, 0], raw[:, 2])).max() < -30.0
    person = seen(walk)
    for turns in (person.pelvis, person.torso):
        assert np.abs(leans(turns)).max() < 2.5
        np.testing.assert_allclose(turns[:, 1, 1], 1.0, atol=1e-3)


@pytest.mark.parametrize("ahead", [-0.15, -0.05, 0.1])
@pytest.mark.parametrize("crouched", [0, 40])
def test_the_upright_frames_tell_what_is_upright(ahead, crouched):
    """Keypoints with the chest before or behind the line from hips to neck; frames that are bent do not count."""
    positions, _ = dancer(40).forward()
    z_up = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    names = tuple(name for name, _, _ in dancer().joints)
    positions[:, names.index("Hips")] = positions[:, [names.index("LeftUpLeg"), names.index("RightUpLeg")]].mean(1)
    upright = HumanMotion("clip", 30.0, names, positions @ z_up.T)
    bent = bent_forward(upright, 60.0)
    positions = np.concatenate([upright.positions, *([bent.positions] if crouched else [])])
    trunk = positions[:, names.index("Neck")] - positions[:, names.index("Hips")]
    across = positions[:, names.index("LeftUpLeg")] - positions[:, names.index("RightUpLeg")]
    forward = np.cross(across, trunk)
    positions[:, names.index("Spine")] += ahead * forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    person = seen(HumanMotion("clip", 30.0, names, positions))
    lean = np.degrees(np.arctan2(trunk[:, 0], trunk[:, 2]))
    for found in (person.pelvis, person.torso):
        np.testing.assert_allclose(leans(found), lean, atol=1e-6)


def test_a_report_has_the_trunk_and_tells_what_leans_and_rests(nao, walk, monkeypatch):
    own = Retargeter(nao)
    result = own.retarget(walk)
    figures = report(result)
    trunk = figures["tracking"]["trunk_angle_deg"]
    # the base's quaternion of the file is the pelvis; NAO's trunk is rigid
    base = Rotation.from_quat(result.motion.qpos[:, 3:7], scalar_first=True)
    person = seen(walk)
    for part, turns in (("pelvis", person.pelvis), ("chest", person.torso)):
        off = (base.inv() * Rotation.from_matrix(turns)).magnitude()
        assert trunk[part] == pytest.approx(np.degrees(off).mean(), abs=1e-6) and trunk[part] < 5.0
    assert trunk["hips-shoulders"] < 5.0 and not figures["notes"]
    for name, share in figures["joints"]["at_end_share"].items():
        low, high = nao.mj_model.joint(name).range
        q = result.motion.qpos[:, 7 + result.motion.joint_names.index(name)]
        assert share == np.mean((q <= low + 0.01 * (high - low)) | (q >= high - 0.01 * (high - low)))
    # as if the skeleton did not slant
    monkeypatch.setattr(_person, "_upright", lambda points: (np.eye(3)[None], np.eye(3)[None]))
    leaning = report(own.retarget(walk))
    assert leaning["tracking"]["trunk_angle_deg"]["hips-shoulders"] > 10.0
    assert any("the trunk leans" in note for note in leaning["notes"])


def test_a_joint_that_rests_at_its_end_is_told(nao, walk):
    figures = report(Retargeter(nao, max_iterations=1).retarget(walk))
    figures["joints"]["at_end_share"] = {"LKneePitch": 0.51, "HeadYaw": 0.5, "RElbowYaw": 1.0}
    assert notes(figures)[0] == (
        "joints rest at an end of their range: RElbowYaw (100 % of the frames), LKneePitch (51 % of the frames)"
    )
