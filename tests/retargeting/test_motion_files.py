"""Readers of motion files beside SciPy's rotations, and what they say of broken files."""

import dataclasses
import re
import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_files import FIGURE, Figure, dancer, with_first, write_bvh
from scipy.spatial.transform import Rotation

from osik_jax import OsikWarning
from osik_jax.retargeting import HumanMotion, RobotMotion, load_motion
from osik_jax.retargeting._bvh import read_bvh
from osik_jax.retargeting._person import measure
from osik_jax.retargeting._skeletons import find_roles
from osik_jax.retargeting._up import find_up

_TO_Z_UP = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2)}


def known(array):
    """What a motion may or may not have, and has here."""
    assert array is not None
    return array


@st.composite
def figures(draw):
    """Trees of up to five joints, with any orders of rotation."""
    count = draw(st.integers(1, 5))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    joints = tuple(
        (f"joint {i}", -1 if i == 0 else draw(st.integers(0, i - 1)), tuple(rng.normal(size=3))) for i in range(count)
    )
    orders = tuple(draw(st.sampled_from(["ZXY", "XYZ", "ZYX", "YXZ", "YZX", "XZY"])) for _ in joints)
    frames = draw(st.integers(1, 4))
    return Figure(joints, rng.normal(size=(frames, 3)), rng.uniform(-180, 180, (frames, count, 3)), orders, 50.0)


@given(figures(), st.sampled_from(["x", "y", "z"]), st.sampled_from([1.0, 0.01, 0.0254]))
@settings(max_examples=40, deadline=None)
def test_a_bvh_file_is_the_tree_that_was_written(tmp_path_factory, figure, up, unit):
    path = write_bvh(tmp_path_factory.mktemp("bvh") / "clip.bvh", figure, unit)
    motion = read_bvh(path, unit=unit, up=up)
    positions, turns = figure.forward()
    order = list(_TO_Z_UP[up])
    change = np.eye(3)[order]
    names = [name for name, _, _ in figure.joints]
    found = [motion.joint_names.index(name) for name in names]
    np.testing.assert_allclose(motion.positions[:, found], positions[..., order], atol=1e-12)
    own = Rotation.from_quat(known(motion.rotations)[:, found].reshape(-1, 4), scalar_first=True).as_matrix()
    np.testing.assert_allclose(own, (change @ turns @ change.T).reshape(-1, 3, 3), atol=1e-12)
    assert np.linalg.det(change) == pytest.approx(1.0)
    assert motion.fps == 50.0 and motion.frames == len(positions)


@pytest.mark.parametrize("unit", [1.0, 0.01, 0.001, 0.0254, 0.0254 / 0.45])
def test_the_unit_is_found_from_the_size_of_the_skeleton(tmp_path, unit):
    motion = load_motion(write_bvh(tmp_path / "clip.bvh", dancer(), unit))
    tall = known(motion.rest_positions)[:, 2].max() - known(motion.rest_positions)[:, 2].min()
    assert tall == pytest.approx(0.25 + 0.22 + 0.15 + 0.02 + 0.42 + 0.41 + 0.06, rel=1e-9)


def test_the_up_axis_is_found_from_the_head(tmp_path):
    figure = dancer()
    turned = tuple((name, parent, (z, x, y)) for name, parent, (x, y, z) in FIGURE)
    lying = Figure(turned, figure.root[:, [2, 0, 1]], 0.0 * figure.angles, figure.orders, figure.fps)
    motion = load_motion(write_bvh(tmp_path / "clip.bvh", lying))
    assert motion.positions[:, motion.joint_names.index("Head"), 2].min() > 1.3
    left, right = (motion.track(f"{side}UpLeg") for side in ("Left", "Right"))
    np.testing.assert_allclose(left - right, np.tile([0.0, 0.18, 0.0], (motion.frames, 1)), atol=1e-12)


def turned(figure, up):
    """A figure that is turned as a whole, its rest pose as it is: the skeleton stands on y, the motion on another."""
    turn = Rotation.from_euler(*{"z": ("x", 90), "x": ("z", -90), "-y": ("x", 180)}[up], degrees=True)
    local = Rotation.from_euler(figure.orders[0], figure.angles[:, 0], degrees=True)
    angles = figure.angles.copy()
    angles[:, 0] = (turn * local).as_euler("XYZ", degrees=True)
    orders = ("XYZ", *figure.orders[1:])
    return dataclasses.replace(figure, root=turn.apply(figure.root), angles=angles, orders=orders)


@pytest.mark.parametrize("up", ["z", "x", "-y"])
def test_the_up_axis_is_that_of_the_motion_where_the_skeleton_has_another(tmp_path, up):
    upright = load_motion(write_bvh(tmp_path / "clip.bvh", dancer()))
    with pytest.warns(OsikWarning, match=f"the person stands along {up} and not along y"):
        motion = load_motion(write_bvh(tmp_path / "clip.bvh", turned(dancer(), up)))
    heights = motion.positions[..., 2]
    np.testing.assert_allclose(heights, upright.positions[..., 2], atol=1e-9)
    beside, own = (m.positions - m.positions[:, :1] for m in (motion, upright))
    heading = Rotation.align_vectors(beside.reshape(-1, 3), own.reshape(-1, 3))[0]
    np.testing.assert_allclose(heading.apply([0.0, 0.0, 1.0]), [0.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(beside.reshape(-1, 3), heading.apply(own.reshape(-1, 3)), atol=1e-9)
    # the rest pose is upright, and rotations are counted from it
    np.testing.assert_allclose(known(motion.rest_positions), known(upright.rest_positions), atol=1e-12)
    for one, other in zip(known(motion.rotations)[5], known(upright.rotations)[5], strict=True):
        one, other = (Rotation.from_quat(q, scalar_first=True) for q in (one, other))
        np.testing.assert_allclose((heading * other).as_matrix(), one.as_matrix(), atol=1e-9)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(load_motion(tmp_path / "clip.bvh", up=up).positions, motion.positions)
        lying = load_motion(tmp_path / "clip.bvh", up="y")
    assert np.ptp(lying.positions[0, :, 2]) < 1.0 or up == "-y"


@pytest.mark.parametrize("up", ["y", "x", "-y"])
@pytest.mark.parametrize("rest", [True, False])
def test_keypoints_with_another_axis_up_are_turned_and_told(tmp_path, up, rest):
    upright = load_motion(write_bvh(tmp_path / "clip.bvh", dancer()))
    turns = {"y": "0 1 0 0 0 1 1 0 0", "x": "0 0 1 1 0 0 0 1 0", "-y": "0 -1 0 0 0 -1 1 0 0"}
    turn = np.array(turns[up].split(), float).reshape(3, 3)
    parts: Any = dict(rest_positions=known(upright.rest_positions) @ np.transpose(turn)) if rest else {}
    np.savez(
        tmp_path / "clip.npz",
        fps=30.0,
        positions=upright.positions @ np.transpose(turn),
        joint_names=np.array(upright.joint_names),
        **parts,
    )
    with pytest.warns(OsikWarning, match=f"the person stands along {up} and not along z.*up='z' keeps z"):
        motion = load_motion(tmp_path / "clip.npz")
    np.testing.assert_allclose(motion.positions, upright.positions, atol=1e-12)
    if rest:
        np.testing.assert_allclose(known(motion.rest_positions), known(upright.rest_positions), atol=1e-12)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        kept = load_motion(tmp_path / "clip.npz", up="z")
    with pytest.warns(OsikWarning, match=f"looks as if {up} did"):
        measure(kept, find_roles(kept.joint_names))
    no_axis: Any = "w"
    with pytest.raises(ValueError, match="up is 'w'; it is one of x, y, z, -x"):
        load_motion(tmp_path / "clip.npz", up=no_axis)


def test_a_person_who_lies_or_crawls_stays_down(tmp_path):
    """On a floor at height 0; crawling along x the trunk points along x in all frames."""
    standing = load_motion(write_bvh(tmp_path / "clip.bvh", dancer()))
    down = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    positions = standing.positions @ down.T
    positions += [0.5, 0.0, -positions[..., 2].min()]
    still = HumanMotion("lying", 30.0, standing.joint_names, positions)
    moving = dataclasses.replace(
        still, positions=positions + np.linspace(0.0, 2.0, len(positions))[:, None, None] * [1, 0, 0]
    )
    assert find_up(still, "z") == find_up(moving, "z") == "z"


def test_a_skeleton_of_no_persons_size_asks_for_the_unit(tmp_path):
    path = write_bvh(tmp_path / "clip.bvh", dancer(), 5.0)
    with pytest.raises(ValueError, match="units large.*unit=METRES"):
        load_motion(path)
    assert known(load_motion(path, unit=5.0).rest_positions)[:, 2].max() == pytest.approx(0.62)
    with pytest.raises(KeyError, match="no unit 'yard'.*inch"):
        load_motion(path, unit="yard")


_SPINE = "\t\tOFFSET 0.0 0.25 0.0\n"
_THREE = "\t\tCHANNELS 3 Zrotation Xrotation Yrotation\n"
_END = "\tOFFSET 0 0 0\n"
BROKEN = {
    "no start": (lambda t: t.replace("HIERARCHY", "TREE"), r"line 1: HIERARCHY should come here"),
    "nothing": (lambda t: "", r"ends where HIERARCHY should come"),
    "two numbers": (lambda t: t.replace("0.0 0.25 0.0", "0.0 0.25"), r"line 9: CHANNELS is no length"),
    "no number": (lambda t: t.replace("0.0 0.25 0.0", "0.0 0.25 up"), r"line 8: UP is no length"),
    "decimal commas": (lambda t: t.replace("0.0 0.25 0.0", "0,0 0,25 0,0"), r"line 8: 0,0 is no length"),
    "a huge offset": (lambda t: t.replace("0.0 0.25 0.0", "0.0 -1e300 0.0"), r"line 8: -1E300 is no length.*1e\+08"),
    "no offset": (lambda t: t.replace(_SPINE, ""), r"line 8: OFFSET should come here"),
    "two offsets": (lambda t: t.replace(_SPINE, 2 * _SPINE), r"line 9: JOINT, End Site or } should come here"),
    "channels twice": (lambda t: t.replace(_THREE, 2 * _THREE, 1), r"line 10: JOINT, End Site or } should come"),
    "no channel": (lambda t: t.replace("6 Xposition", "6 Wposition"), r"line 5: CHANNELS is followed by.*xposition"),
    "count of channels": (lambda t: t.replace("CHANNELS 6", "CHANNELS 7"), r"line 6: CHANNELS is followed by"),
    "superscript": (lambda t: t.replace("CHANNELS 6", "CHANNELS ²"), r"line 5: CHANNELS is followed by"),
    "nested": (
        lambda t: t.replace(_THREE, _THREE + 3000 * "JOINT a {\nOFFSET 0 0 0\n", 1),
        "inside each other without end",
    ),
    "joint in an end": (lambda t: t.replace(_END, _END + "JOINT tip\n{\n}\n", 1), r"line \d+: } should come here"),
    "no name": (lambda t: t.replace("ROOT Hips", "ROOT"), r"line 2: a joint has no name"),
    "a name twice": (lambda t: t.replace("JOINT Neck", "JOINT Spine"), r"a second joint is called Spine"),
    "two roots": (lambda t: t.replace("MOTION\n", "ROOT Other\n{\n}\nMOTION\n"), r"line 112: MOTION should come here"),
    "cut": (lambda t: t[: t.index("MOTION")], r"ends where MOTION should come"),
    "no frame time": (lambda t: t.replace("Frame Time: 0.033333333\n", ""), r"line 114: FRAME should come here"),
    "milliseconds": (lambda t: t.replace("Time: 0.033333333", "Time: 33.3"), r"line 114: .* time is 33.3; .*seconds"),
    "negative time": (lambda t: t.replace("Time: 0.03", "Time: -0.03"), r"line 114: the frame time is -"),
    "frames": (lambda t: t.replace("Frames: 24", "Frames: 25"), r"says Frames: 25, and has 24"),
    "nan": (lambda t: t[: t.rindex(" ")] + " nan\n", r"line 138: nan is no length and no angle"),
    "short": (lambda t: t[: t.rindex(" ")] + "\n", r"line 138: a frame has 56 numbers where there should be 57"),
    "long": (lambda t: t.rstrip() + " 3.0\n", r"line 138: a frame has 58 numbers where there should be 57"),
    "one line, a number less": (lambda t: " ".join(t.split()[:-1]), r"line 1: a frame has 1367 numbers.* 57"),
}


@pytest.mark.parametrize("which", BROKEN)
def test_a_broken_bvh_says_which_line_and_what_is_wrong(tmp_path, which):
    spoil, message = BROKEN[which]
    path = write_bvh(tmp_path / "clip.bvh", dancer())
    broken = spoil(path.read_text())
    assert broken != path.read_text()
    path.write_text(broken)
    with pytest.raises(ValueError, match=message):
        read_bvh(path)


def test_statements_of_a_bvh_may_stand_on_any_lines(tmp_path):
    path = write_bvh(tmp_path / "clip.bvh", dancer())
    text, whole = path.read_text().replace("JOINT Spine", "JOINT the end of the Spine"), read_bvh(path)
    tree, motion = text.split("MOTION\n")
    head, rows = motion.split("\n", 2)[:2], motion.split("\n", 2)[2]
    spellings = {
        "one line": text.replace("\n", " "),
        "the tree on one line": " ".join(tree.split()) + "\nMOTION\n" + motion,
        "braces without spaces": tree.replace("\n\t{\n", "{").replace("}\n", "}") + "MOTION\n" + motion,
        "head on MOTION's line": tree + " ".join(["MOTION", *head]) + "\n" + rows,
        "a number a line": tree + "MOTION\n" + "\n".join(head) + "\n" + rows.replace(" ", "\n"),
        "numbers under OFFSET": text.replace("OFFSET ", "OFFSET\n"),
        "a brace behind a name": text.replace("the Spine\n\t{", "the Spine {"),
    }
    for what, spelled in spellings.items():
        path.write_text(spelled)
        motion = read_bvh(path)
        assert motion.joint_names[1] == "the end of the Spine", what
        np.testing.assert_array_equal(motion.positions, whole.positions, what)


def test_a_joint_of_a_bvh_may_have_no_channels(tmp_path):
    path = write_bvh(tmp_path / "clip.bvh", dancer())
    found = re.search(r"End Site\n(\t*)\{\n\t*OFFSET 0 0 0\n", path.read_text())
    assert found is not None
    path.write_text(path.read_text().replace(found[0], found[0].replace("End Site", "JOINT tip") + "CHANNELS 0\n", 1))
    motion = read_bvh(path)
    tip = motion.joint_names.index("tip")
    np.testing.assert_array_equal(motion.positions[:, tip], motion.positions[:, tip - 1])


def _written(path, **changes):
    rng = np.random.default_rng(0)
    arrays = dict(fps=30.0, positions=rng.normal(size=(4, 2, 3)), joint_names=["hip", "knee"])
    np.savez(path, **{name: value for name, value in {**arrays, **changes}.items() if value is not None})
    return path, arrays


def test_keypoints_come_back(tmp_path):
    quaternions = Rotation.random(8, random_state=0).as_quat(scalar_first=True).reshape(4, 2, 4)
    flags = np.array([[1, 0], [0, 1], [1, 1], [0, 0]], bool)
    path, arrays = _written(tmp_path / "clip.npz", rotations=quaternions, contact=flags, ground=0.1)
    motion = load_motion(path)
    np.testing.assert_array_equal(motion.positions, arrays["positions"])
    same = np.abs(np.sum(motion.rotations * quaternions, -1))
    np.testing.assert_allclose(same, 1.0, atol=1e-12)
    assert (np.sum(known(motion.rotations)[1:] * known(motion.rotations)[:-1], -1) >= 0.0).all()
    np.testing.assert_array_equal(motion.contact, flags[:, [0, 0, 1, 1]])
    assert (motion.ground, motion.fps, motion.joint_names) == (0.1, 30.0, ("hip", "knee"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(fps=None), "has no fps; it has positions, joint_names"),
        (dict(positions=np.zeros((4, 3, 3))), r"positions has shape \(4, 3, 3\), expected \(4, 2, 3\)"),
        (dict(positions=np.full((4, 2, 3), np.nan)), r"positions is not finite at \(0, 0, 0\)"),
        (dict(positions=np.full((4, 2, 3), -1e300)), r"positions is -1e\+300 at \(0, 0, 0\); it is 1e\+06 m at most"),
        (dict(rest_positions=np.full((2, 3), 1e7)), r"rest_positions is 1e\+07 at"),
        (dict(fps=1e300), "fps is 1e\\+300; it is frames a second, more than 0 and 100000 at most"),
        (dict(ground=1e300), "ground is 1e\\+300"),
        (dict(rotations=np.ones((4, 2, 4))), "of hip in frame 0 has length 2"),
        (dict(joint_names=["hip", "hip"]), "joint names occur twice: hip"),
        (dict(fps=0.0), "fps is 0.0"),
        (dict(contact=np.zeros((4, 3))), r"contact has shape \(4, 3\)"),
        (
            dict(positions=np.array([object()])),
            "cannot be read as an .npz of plain arrays: it is none, or holds objects",
        ),
        (dict(positions=np.full((4, 2, 3), "a")), "positions is of type <U1; it has to be numbers"),
        (dict(positions=np.zeros((4, 6))), r"positions has shape \(4, 6\), expected \(4, 2, 3\)"),
        (dict(positions=np.zeros((0, 2, 3))), "a frame and a joint at least; this one has 0 and 2"),
        (dict(fps=np.array([30.0, 30.0])), "fps is one number, not 2"),
        (dict(contact=np.full((4, 4), "yes")), "contact is of type <U3; it has to be numbers"),
        (dict(contact=np.full((4, 4), 0.5)), "contact is 0 or 1, not 0.5"),
        (dict(contact=np.full((4, 4), np.nan)), "contact is 0 or 1, not nan"),
        (dict(ground=np.zeros(4)), "ground is one number, not 4"),
        (dict(rest_positions=np.zeros((3, 3))), r"rest_positions has shape \(3, 3\), expected \(2, 3\)"),
    ],
)
def test_broken_keypoints_say_what_is_wrong(tmp_path, changes, message):
    path, _ = _written(tmp_path / "clip.npz", **changes)
    with pytest.raises(ValueError, match=message):
        load_motion(path)


def test_text_is_read_however_it_is_encoded(tmp_path):
    path = write_bvh(tmp_path / "clip.bvh", dancer())
    text, whole = path.read_text(), load_motion(path)
    for content in (text.encode("utf-8-sig"), text.replace("\n", "\r\n").encode()):
        path.write_bytes(content)
        np.testing.assert_array_equal(load_motion(path).positions, whole.positions)
    (tmp_path / "folder.bvh").mkdir()
    with pytest.raises(FileNotFoundError, match=r"no such file: .*folder\.bvh"):
        load_motion(tmp_path / "folder.bvh")


def test_positions_in_millimetres_are_told(tmp_path):
    motion = load_motion(write_bvh(tmp_path / "clip.bvh", dancer()))
    large = HumanMotion("clip", 30.0, motion.joint_names, 1000.0 * motion.positions)
    with pytest.raises(ValueError, match="legs of clip are 830 m long; positions are metres"):
        measure(large, find_roles(large.joint_names))


def test_files_that_are_not_there_and_options_that_do_not_go_with_them(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_motion(tmp_path / "none.npz")
    with pytest.raises(ValueError, match=r"none of \.bvh, \.npz"):
        load_motion(tmp_path / "clip.fbx")
    with pytest.raises(FileNotFoundError, match="no such file: .*clips"):
        load_motion(tmp_path / "clips")
    with pytest.raises(ValueError, match="unit goes with BVH files"):
        load_motion(tmp_path / "clip.npz", unit="cm")


def test_a_compressed_file_with_a_wrong_byte_is_told(tmp_path):
    np.savez_compressed(tmp_path / "clip.npz", positions=np.random.default_rng(0).normal(size=(50, 3)))
    content = (tmp_path / "clip.npz").read_bytes()
    for at in range(60, len(content) - 100, 40):
        (tmp_path / "clip.npz").write_bytes(content[:at] + bytes([content[at] ^ 255]) + content[at + 1 :])
        with pytest.raises(ValueError, match="cannot be read as an .npz of plain arrays|has no fps, joint_names"):
            load_motion(tmp_path / "clip.npz")


def test_another_rate_goes_through_the_frames():
    rng = np.random.default_rng(2)
    turns = Rotation.from_rotvec(np.outer(np.arange(7), [0.1, 0.2, 0.0])).as_quat(scalar_first=True)[:, None]
    motion = HumanMotion("clip", 30.0, ("hip",), rng.normal(size=(7, 1, 3)), turns, contact=np.ones((7, 4), bool))
    fine = motion.resampled(90.0)
    np.testing.assert_allclose(fine.positions[::3], motion.positions, atol=1e-12)
    np.testing.assert_allclose(fine.positions[1], (2 * motion.positions[0] + motion.positions[1]) / 3, atol=1e-12)
    third = Rotation.from_rotvec([0.1 / 3, 0.2 / 3, 0.0]).as_quat(scalar_first=True)
    np.testing.assert_allclose(known(fine.rotations)[1, 0], third, atol=1e-9)
    assert fine.frames == 19 and known(fine.contact).all()
    assert motion.resampled(10.0).frames == 3


def test_a_robots_motion_comes_back_from_both_files(tmp_path):
    rng = np.random.default_rng(3)
    qpos = np.hstack([rng.normal(size=(4, 3)), Rotation.random(4, random_state=1).as_quat(scalar_first=True)])
    motion = RobotMotion(30.0, ("hip", "knee"), np.hstack([qpos, rng.normal(size=(4, 2))]))
    np.savez(tmp_path / "motion.npz", fps=motion.fps, joint_names=motion.joint_names, qpos=motion.qpos)
    back = RobotMotion.load(tmp_path / "motion.npz")
    assert back.joint_names == motion.joint_names and (back.qpos == motion.qpos).all()
    motion.save_csv(tmp_path / "motion.csv")
    first = np.loadtxt(tmp_path / "motion.csv", delimiter=",")[0]
    np.testing.assert_allclose(first[3:7], np.roll(motion.qpos[0, 3:7], -1), rtol=1e-8)
    back = RobotMotion.load(tmp_path / "motion.csv", joint_names=("hip", "knee"), fps=30.0)
    np.testing.assert_allclose(back.qpos, motion.qpos, rtol=1e-8)
    with pytest.raises(ValueError, match="say joint_names and fps"):
        RobotMotion.load(tmp_path / "motion.csv")
    with pytest.raises(ValueError, match="line 1: 9 numbers, not 8"):
        RobotMotion.load(tmp_path / "motion.csv", joint_names=("hip",), fps=30.0)
    with pytest.raises(ValueError, match="not of unit length in frame 0"):
        RobotMotion(30.0, (), np.ones((1, 7)))


@pytest.mark.parametrize("frames", [1, 4])
def test_a_rest_pose_before_the_motion_is_left_out(tmp_path, frames):
    alone = load_motion(write_bvh(tmp_path / "alone.bvh", dancer()))
    path = write_bvh(tmp_path / "clip.bvh", with_first(frames))
    with pytest.warns(OsikWarning, match=f"rest pose \\({frames} of {24 + frames} frames\\)"):
        motion = load_motion(path)
    np.testing.assert_allclose(motion.positions, alone.positions, atol=1e-14)
    np.testing.assert_allclose(known(motion.rotations), known(alone.rotations), atol=1e-14)


def test_a_motion_that_begins_in_the_rest_pose_keeps_all_frames(tmp_path):
    own = dancer()
    share = np.clip(np.arange(24) / 12.0, 0.0, 1.0)[:, None, None]
    slowly = dataclasses.replace(own, angles=share * own.angles)  # arms from the sides down, in 0.4 s
    jump_later = with_first(
        1, dataclasses.replace(own, angles=own.angles * np.where(np.arange(24) == 12, -1, 1)[:, None, None])
    )
    moved = own.angles.copy()
    moved[0, :, 1] += 90.0  # a jump after the first frame, out of no rest pose
    jump_from_elsewhere = dataclasses.replace(own, angles=moved)
    with warnings.catch_warnings():
        warnings.simplefilter("error", OsikWarning)
        for figure in (slowly, jump_later, jump_from_elsewhere):
            motion = load_motion(write_bvh(tmp_path / "clip.bvh", figure))
            assert motion.frames == len(figure.root)
