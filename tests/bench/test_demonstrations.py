"""Motions of robots that somebody brings along: where they start, what moves, and how far."""

import jax
import numpy as np
import pytest
from example_files import example_file
from mujoco_states import mujoco_at

import osik_jax as osik
from benchmarks.demonstrated import file_motion, guess_moving_frame
from benchmarks.swaying import JointPath
from osik_jax.demo._figures import figures
from osik_jax.demo._run import run_scheme
from osik_jax.robot._guesses import guess_feet
from osik_jax.robot._mujoco import mujoco_frame_pose
from osik_jax.viewer._crouch import crouched

LINK = """<link name="{0}"><inertial><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/>
</inertial><visual><origin xyz="0 0 {1}"/><geometry><cylinder radius="{2}" length="{3}"/></geometry></visual></link>"""
JOINT = """<joint name="j{0}" type="{1}"><parent link="{2}"/><child link="l{0}"/><origin xyz="0 0 {3}"/>
<axis xyz="{4}"/>{5}</joint>"""
TIP = """<link name="end"/><joint name="t" type="fixed"><parent link="{0}"/><child link="end"/><origin xyz="0 0 {1}"/>
</joint>"""
LIMIT = '<limit lower="-0.02" upper="0.3" velocity="1" effort="1"/>'
X, Y, Z = "1 0 0", "0 1 0", "0 0 1"


def chain(length, axes, kind="continuous", limit="", tip=1.0):
    """A tower of links, each so long [m], on joints about or along the axes."""
    names = ["base", *(f"l{k}" for k in range(len(axes)))]
    links = "".join(LINK.format(name, length / 2, length / 10, length) for name in names)
    joints = "".join(JOINT.format(k, kind, names[k], length, axis, limit) for k, axis in enumerate(axes))
    return osik.Robot.from_urdf(
        f'<robot name="x">{links}{joints}{TIP.format(names[-1], tip * length)}</robot>', floating_base=False
    )


def motion_of(robot):
    return file_motion(robot, name="x", duration=2.0)


def joint_path(motion):
    path = motion.goals["hand"].path
    assert isinstance(path, JointPath)
    return path


def test_one_joint_takes_its_tip_along_its_arc():
    """No straight line to the left exists: what is asked is what the joint can do, and its rate is its velocity."""
    motion = motion_of(chain(0.3, (Y,)))
    path = joint_path(motion)
    assert motion.goals["hand"].frame == "end" and motion.goals["hand"].rows == "pose"
    at, h = jax.jit(path.at), 1e-6
    (start, _), (top, _) = at(0.0)[0], at(1.0)[0]
    assert np.linalg.norm(top - start) == pytest.approx(0.05, rel=0.01)
    np.testing.assert_allclose([np.linalg.norm(p - np.array([0.0, 0.0, 0.3])) for p in (start, top)], 0.3)
    for t in (0.3, 0.6):
        rate = (at(t + h)[0][0] - at(t - h)[0][0]) / (2 * h)
        np.testing.assert_allclose(at(t)[1][:3], rate, atol=1e-8)


def test_a_slide_goes_towards_its_room():
    """Home is 2 cm above the lower limit and 30 cm below the upper one."""
    motion = motion_of(chain(0.3, (X,), "prismatic", LIMIT))
    (start, _), (there, _) = (joint_path(motion).at(t)[0] for t in (0.0, 1.0))
    np.testing.assert_allclose(there - start, [0.05, 0.0, 0.0], atol=1e-9)


def test_a_gantry_goes_left():
    robot = chain(0.3, (X, Y, Z), "prismatic", '<limit lower="-0.3" upper="0.3" velocity="1" effort="1"/>')
    goal = motion_of(robot).goals["hand"]
    assert goal.rows == "position" and not isinstance(goal.path, JointPath)
    np.testing.assert_allclose(goal.path.at(1.0)[0][0] - goal.path.position, [0.0, 0.05, 0.0], atol=1e-12)


@pytest.mark.variants(slow=["huge"])
@pytest.mark.parametrize(("length", "scale"), [(100 / 7, 10.0), (0.01 / 7, 0.0345)], ids=["huge", "tiny"])
def test_huge_and_tiny_robots_move_in_proportion(length, scale):
    motion = motion_of(chain(length, (Z, Y, Y, X, Y, Z, Y)))
    assert motion.scale == pytest.approx(scale, rel=0.15)
    path = motion.goals["hand"].path
    (there, R), _ = path.at(1.0)
    np.testing.assert_allclose((there - path.position) / motion.scale, [0.0, 0.05, 0.0], atol=1e-12)
    np.testing.assert_array_equal(R, path.rotation)
    assert motion.goals["hand"].rows == "pose"
    labels = [row.label for row in figures(motion, run_scheme(motion, "weighted", dt=0.1))]
    assert "hand, from path [mm]" in labels
    assert not any("feet" in label or "mass" in label for label in labels)


@pytest.mark.variants(slow=["solo_description/robots/solo12.urdf"])
@pytest.mark.parametrize("file", ["nao", "solo_description/robots/solo12.urdf"])
def test_legs_bend_over_feet_that_stay(file, nao):
    """Solo's legs are stretched in the middle of their range at home; heights and limits by MuJoCo."""
    robot = nao if file == "nao" else osik.Robot.from_urdf(example_file(file), floating_base=True)
    feet, waist = guess_feet(robot), robot.tree.body_names[robot.tree.root]
    poses = [
        {name: mujoco_frame_pose(robot, mujoco_at(robot, q), name) for name in (*feet, waist)}
        for q in (np.asarray(robot.q0), np.asarray(crouched(robot, feet)))
    ]
    home, low = ({name: p for name, (p, _) in each.items()} for each in poses)
    for foot in feet:
        np.testing.assert_allclose(low[foot], home[foot], rtol=0, atol=1e-6)
    sunk = 0.05 * (home[waist] - min(home.values(), key=lambda p: p[2]))[2]
    np.testing.assert_allclose(low[waist], home[waist] - [0.0, 0.0, sunk], rtol=0, atol=1e-4)
    q = np.asarray(robot.mujoco_qpos(crouched(robot, feet)))
    model = robot.mj_model
    limited = model.jnt_limited.astype(bool)
    value, (lower, upper) = q[model.jnt_qposadr[limited]], model.jnt_range[limited].T
    assert (value >= lower - 1e-9).all() and (value <= upper + 1e-9).all()


def test_feet_and_hands_are_guessed(nao):
    assert guess_feet(nao) == ("l_sole", "r_sole")
    assert guess_moving_frame(nao) == "torso"
    assert guess_moving_frame(osik.load_robot("arm7")) == "hand"
