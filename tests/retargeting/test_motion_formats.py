"""Files of other programs, made here: poses of SMPL as AMASS has them, and a robot's table from a spreadsheet."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from osik_jax.retargeting import RobotMotion, load_motion
from osik_jax.retargeting._skeletons import find_roles
from osik_jax.retargeting._smpl import _TREE

TURN = Rotation.from_euler("x", 90, degrees=True)  # y up becomes z up


def smpl_arrays(frames=20, joints=52):
    """A person who bends a knee and an elbow and turns, with z up, by SciPy's rotations."""
    phase = np.linspace(0.0, 1.0, frames)
    local = np.zeros((frames, joints, 3))
    local[:, 4, 0], local[:, 18, 1] = 1.2 * phase, -0.9 * phase
    local[:, 0] = (Rotation.from_euler("z", phase[:, None]) * TURN).as_rotvec()
    return {"poses": local.reshape(frames, -1), "trans": np.stack([phase, 0 * phase, 0.9 + 0 * phase], 1),
            "mocap_framerate": np.array(120.0), "betas": np.zeros(16), "gender": np.array("neutral")}  # fmt: skip


def expected_joints(arrays, offsets):
    """Positions of the body's joints, one frame and one joint at a time."""
    out = np.zeros((len(arrays["trans"]), len(_TREE), 3))
    for f, row in enumerate(arrays["poses"].reshape(len(out), -1, 3)):
        turns = []
        for j, (_, parent, _) in enumerate(_TREE):
            own = Rotation.from_rotvec(row[j])
            turns.append(own if parent < 0 else turns[parent] * own)
            out[f, j] = arrays["trans"][f] if parent < 0 else out[f, parent] + turns[parent].apply(offsets[j])
    return out


@pytest.mark.parametrize("joints", [24, 52, 55])
def test_poses_of_smpl(tmp_path, joints):
    arrays = smpl_arrays(joints=joints)
    np.savez(tmp_path / "walk_poses.npz", **arrays)
    motion = load_motion(tmp_path / "walk_poses.npz")
    offsets = np.array([offset for _, _, offset in _TREE])
    np.testing.assert_allclose(motion.positions, expected_joints(arrays, offsets), atol=1e-12)
    assert motion.fps == 120.0 and find_roles(motion.joint_names)["left_toe"] == "left_foot"
    assert motion.rest_positions is not None and np.argmax(np.ptp(motion.rest_positions, axis=0)) in (1, 2)
    head, foot = (motion.joint_names.index(name) for name in ("head", "left_foot"))
    assert motion.rest_positions[head, 2] - motion.rest_positions[foot, 2] > 1.3  # the rest pose stands along z too


def test_split_poses_and_bones_of_the_file(tmp_path):
    arrays = smpl_arrays()
    rest = np.zeros((52, 3))
    for j, (_, parent, offset) in enumerate(_TREE):
        rest[j] = (rest[parent] if parent >= 0 else np.array([0.0, 0.05, 0.02])) + 1.1 * np.array(offset)
    split = {"root_orient": arrays["poses"][:, :3], "pose_body": arrays["poses"][:, 3:66], "trans": arrays["trans"]}
    np.savez(tmp_path / "stage.npz", **split, mocap_frame_rate=60, rest_joints=rest)
    motion = load_motion(tmp_path / "stage.npz")
    offsets = rest[:22] - np.array([rest[parent] if parent >= 0 else np.zeros(3) for _, parent, _ in _TREE])
    moved = {**arrays, "trans": arrays["trans"] + rest[0]}
    np.testing.assert_allclose(motion.positions, expected_joints(moved, offsets), atol=1e-12)


def test_files_of_smplx_hold_an_array_of_objects(tmp_path):
    """AMASS's ``_stageii.npz``: the indices of markers are a dictionary, and poses are there twice."""
    arrays = smpl_arrays(joints=55)
    poses, rate = arrays["poses"], arrays.pop("mocap_framerate")
    parts = {"root_orient": poses[:, :3], "pose_body": poses[:, 3:66], "pose_jaw": poses[:, 66:69],
             "pose_eye": poses[:, 69:75], "pose_hand": poses[:, 75:], "mocap_frame_rate": rate}  # fmt: skip
    marks = {"surface_model_type": "smplx", "num_betas": 16, "markers_latent": np.zeros((2, 3)),
             "markers_latent_vids": np.array({"C7": 3832, "CLAV": 5533})}  # fmt: skip
    np.savez(tmp_path / "walk_stageii.npz", **arrays, **parts, **marks)
    motion = load_motion(tmp_path / "walk_stageii.npz")
    offsets = np.array([offset for _, _, offset in _TREE])
    np.testing.assert_allclose(motion.positions, expected_joints(arrays, offsets), atol=1e-12)
    assert motion.fps == 120.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mocap_framerate": None}, "has no rate; poses come with one of mocap_framerate"),
        ({"poses": np.zeros((20, 60))}, r"poses has shape \(20, 60\)"),
        ({"trans": np.full((20, 3), np.nan)}, "trans has numbers that are not finite"),
        ({"J": np.zeros((10, 3))}, r"joints of the rest pose have shape \(10, 3\)"),
    ],
)
def test_broken_poses_are_told(tmp_path, change, message):
    arrays = {name: value for name, value in {**smpl_arrays(), **change}.items() if value is not None}
    np.savez(tmp_path / "broken.npz", **arrays)
    with pytest.raises(ValueError, match=message):
        load_motion(tmp_path / "broken.npz")


def test_a_robots_table_that_a_spreadsheet_saved(tmp_path):
    file = tmp_path / "take.csv"
    robot = ["0,0,1,0,0,0,1,0.5", "0,0,1,0,0,0,1,0.6"]
    file.write_text("\r\n".join([*robot, ",,,,,,,"]) + "\r\n", encoding="utf-8-sig")
    np.testing.assert_array_equal(RobotMotion.load(file, joint_names=("knee",), fps=30.0).qpos[:, 7], [0.5, 0.6])
