"""A robot written as MJCF and read again is the same robot, by our kinematics and by MuJoCo's."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from frames_beside_mujoco import assert_as_in_mujoco, poses, random_configurations
from model_files import mjcf
from refusals import refuses

import osik_jax as osik
from osik_jax import Robot


def locked_g1() -> Robot:
    return osik.load_robot("g1", locked_joints={"waist_*": 0.1, "*_wrist_*": -0.2})


def locked_nao() -> Robot:
    locked = {"?Shoulder*": 0.3, "LHipYawPitch": -0.4, "Head*": 0.1, "?KneePitch": 0.8}
    return osik.load_robot("nao", locked_joints=locked)


def scaled_nao() -> Robot:
    """Retargeted: other lengths and masses, and edited limits and speeds."""
    robot = osik.load_robot("nao").scaled(length={"*Thigh": 1.3, "*Tibia": 0.9, "torso": 1.1}, mass={"*Thigh": 2.0})
    at = robot.joint_dof_index("LHipYawPitch")
    edited = (
        robot.position_upper.at[at].set(0.9),  # beyond what its follower's own range in mj_model allows
        robot.velocity_limit.at[at].set(1.5),
        robot.q0.at[2].add(0.1),
    )
    return eqx.tree_at(lambda r: (r.position_upper, r.velocity_limit, r.q0), robot, edited)


ODD = mjcf("odd")


def odd() -> Robot:
    return Robot.from_mjcf(ODD, locked_joints={"y": 0.7, "w": -0.4, "z": 0.25, "s": 0.1})


ROBOTS = {
    "arm7": lambda: osik.load_robot("arm7"),
    "odd": odd,
    "nao, scaled and edited": scaled_nao,
    "nao, locked": locked_nao,
    "g1, locked": locked_g1,
}
SLOW = ("g1, locked",)


@pytest.fixture(
    scope="module", params=[pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in ROBOTS]
)
def pair(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Robot, Robot]:
    """A robot, and what is read from the file that it wrote."""
    robot, path = ROBOTS[request.param](), tmp_path_factory.mktemp("written") / "robot.xml"
    text = robot.to_mjcf(path)
    assert path.read_text(encoding="utf-8") == text
    return robot, Robot.from_mjcf(path)


def test_names_limits_and_masses_come_back(pair: tuple[Robot, Robot]):
    robot, again = pair
    assert again.joint_names == robot.joint_names
    assert set(again.frame_names) == set(robot.frame_names)
    assert (again.nq, again.nv, again.locked_joints) == (robot.nq, robot.nv, ())
    assert again.mimic_joints == {f: (leader, m) for f, (leader, m) in robot.mimic_joints.items()}
    for leaf in ("q0", "position_lower", "position_upper", "velocity_limit"):
        np.testing.assert_allclose(getattr(again, leaf), getattr(robot, leaf), rtol=0.0, atol=1e-12, err_msg=leaf)
    for joint in robot.joint_names:
        assert again.joint_dof_index(joint) == robot.joint_dof_index(joint)
    assert float(again.body_mass.sum()) == pytest.approx(float(robot.body_mass.sum()), rel=1e-12)


@pytest.mark.variants(release=["odd"])
def test_frames_and_centre_of_mass_come_back(pair: tuple[Robot, Robot]):
    robot, again = pair
    q = jnp.asarray(random_configurations(robot))
    ours, theirs = ([np.asarray(x) for x in poses(one, q)] for one in pair)
    order = [again.tree.frame(name) for name in robot.frame_names]
    for a, b in zip(ours[:2], theirs[:2], strict=True):
        np.testing.assert_allclose(b[:, order], a, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(theirs[2], ours[2], rtol=0.0, atol=1e-12)
    assert_as_in_mujoco(again, again.mj_model)


def test_inertias_come_back():
    """Where no joint is locked the bodies are the same, one by one."""
    robot = scaled_nao()
    again = Robot.from_mjcf(robot.to_mjcf())
    assert again.body_names == robot.body_names
    assert again.tree.geom_types == robot.tree.geom_types
    leaves = "body_mass", "body_com", "body_inertia", "dof_armature", "geom_position", "geom_rotation", "geom_size"
    for leaf in leaves:
        ours, theirs = getattr(robot, leaf), getattr(again, leaf)
        np.testing.assert_allclose(theirs, ours, rtol=0.0, atol=1e-13, err_msg=leaf)


def test_written_twice_is_written_once():
    once = Robot.from_mjcf(odd().to_mjcf()).to_mjcf()
    assert Robot.from_mjcf(once).to_mjcf().count("<") == once.count("<")
    model = Robot.from_mjcf(once).mj_model
    assert (model.ngeom, model.nmesh, model.neq, model.nkey) == (6, 0, 2, 1)
    np.testing.assert_array_equal(model.geom("pin").rgba, [1.0, 0.0, 0.0, 1.0])


def edited(name: str, joint: str, value: float) -> Robot:
    robot = Robot.from_mjcf(ODD)
    dof = robot.joint_dof_index(joint)
    return eqx.tree_at(lambda r: getattr(r, name), robot, getattr(robot, name).at[dof].set(value))


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        (lambda: edited("position_lower", "y", -1.0), r"joint 'y' is limited on one side, \[-1.0, inf\]"),
        (lambda: edited("position_lower", "fly", -1.0), r"joint 'fly' is free: .* no place for its position"),
        (lambda: edited("velocity_limit", "ball", 1.0), r"the dofs of joint 'ball' differ in greatest speed"),
        (
            lambda: osik.stack([osik.load_robot("arm7")] * 2),
            r"a stack of robots, body_position \(2, 8, 3\): write them",
        ),
    ],
)
def test_what_mjcf_cannot_say_is_refused(robot, message: str):
    refuses(ValueError, message, robot().to_mjcf)


def test_moved_frames_are_written_and_moved_bodies_are_not_mistaken_for_frames():
    robot = osik.load_robot("arm7")
    at = robot.tree.frame("hand")
    moved = eqx.tree_at(lambda r: r.frame_position, robot, robot.frame_position.at[at].add(0.01))
    again = Robot.from_mjcf(moved.to_mjcf())
    ours, theirs = (np.asarray(r.frame_position)[r.tree.frame("hand")] for r in (moved, again))
    np.testing.assert_allclose(theirs, ours, rtol=0.0, atol=1e-15)
    at = robot.tree.frame("link7")
    wrong = eqx.tree_at(lambda r: r.frame_position, robot, robot.frame_position.at[at].add(0.01))
    refuses(ValueError, r"frame 'link7' is a body or geom of its own and not where that is", wrong.to_mjcf)


def test_a_locked_base_stands_where_it_was():
    """A free joint locked away from home; its body is then the world's, whose mass does not count."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="base" pos="0 0 1" euler="10 20 30"><freejoint name="root"/><geom size="0.1"/>'
        '<body name="lid" pos="0 0 0.1"><joint name="hinge" axis="1 0 0"/><geom size="0.1" name="ball"/></body></body>'
        "</worldbody></mujoco>"
    )
    model.qpos0[:3] = 1.0, 2.0, 3.0
    robot = Robot.from_mjmodel(model, locked_joints=("root",))
    again = Robot.from_mjcf(robot.to_mjcf())
    assert (again.nv, again.floating_base, again.body_names) == (1, False, ("lid",))
    q = jnp.array([[0.3]])
    for name in ("base", "lid", "ball"):
        for a, b in zip(poses(robot, q)[:2], poses(again, q)[:2], strict=True):
            np.testing.assert_allclose(b[0, again.tree.frame(name)], a[0, robot.tree.frame(name)], rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(again.body_mass.sum(), robot.body_mass[2], rtol=1e-15)


def test_a_speed_of_zero_is_kept():
    held = osik.load_robot("arm7").replace(velocity_limit={"joint2": 0.0}, acceleration_limit={"joint3": 0.0})
    again = Robot.from_mjcf(held.to_mjcf())
    np.testing.assert_array_equal(again.velocity_limit, held.velocity_limit)
    np.testing.assert_array_equal(again.acceleration_limit, held.acceleration_limit)
