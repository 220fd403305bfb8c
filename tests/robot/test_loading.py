"""Robots from URDF, MJCF and MuJoCo models: what is read, what is refused, and with which words."""

from __future__ import annotations

import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from task_checks import kinematics_at

import osik_jax as osik
from osik_jax import Robot

INERTIAL = (
    '<inertial><origin xyz="0.01 0.02 0.03"/><mass value="1.5"/>'
    '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>'
)


def link(name: str, inner: str = INERTIAL) -> str:
    return f'<link name="{name}">{inner}</link>'


def joint(name: str, parent: str, child: str, inner: str = "", kind: str = "revolute") -> str:
    limit = '<limit lower="-1" upper="2" velocity="3" effort="1"/>' if "<limit" not in inner and kind != "fixed" else ""
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="0.1 0 0.2" rpy="0.1 0.2 0.3"/><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="0 0 1"/>{limit}{inner}</joint>'
    )


def urdf(*elements: str) -> str:
    return f'<?xml version="1.0"?>\n<robot name="r">{"".join(elements)}</robot>'


ARM = urdf(link("base"), link("upper"), link("lower"), joint("a", "base", "upper"), joint("b", "upper", "lower"))


def fingers(mimic: str, *, low: float = -1.0, high: float = 1.0, speed: float = 3.0) -> str:
    """A leader ``a`` (limits -1, 2, speed 3) and a follower ``b`` on two branches."""
    limit = f'<limit lower="{low}" upper="{high}" velocity="{speed}"/>'
    return urdf(
        link("base"),
        link("upper"),
        link("lower"),
        joint("a", "base", "upper"),
        joint("b", "base", "lower", mimic + limit),
    )


# --- URDF: base, frames, names ---


def test_floating_base_on_request():
    assert Robot.from_urdf(ARM, floating_base=True).tree.joint_names == ("floating_base", "a", "b")
    assert Robot.from_urdf(ARM, floating_base=True).nv == 8
    fixed = Robot.from_urdf(ARM, floating_base=False)
    assert (fixed.nv, fixed.floating_base) == (2, False)


def test_fixed_root_link_is_a_frame_at_the_world():
    robot = Robot.from_urdf(ARM, floating_base=False)
    position, rotation = kinematics_at(robot, jnp.array([0.3, 0.4])).frame_pose(robot, "base")
    np.testing.assert_array_equal(position, np.zeros(3))
    np.testing.assert_array_equal(rotation, np.eye(3))
    assert robot.mj_model.body_mass.sum() == 4.5
    assert float(robot.body_mass.sum()) == 3.0  # what is fixed to the world is not moved


WORLD = urdf(
    link("world", ""), link("base"), link("tip"), joint("w", "world", "base", kind="fixed"), joint("a", "base", "tip")
)


def test_root_link_called_world_stays_fixed_unless_freed():
    assert Robot.from_urdf(WORLD).tree.joint_names == ("a",)
    free = Robot.from_urdf(WORLD, floating_base=True)
    assert free.tree.joint_names == ("floating_base", "a")
    np.testing.assert_allclose(free.q0[:3], [0.1, 0.0, 0.2])  # where the joint "w" had it
    kin = kinematics_at(free, free.q0)
    fixed = Robot.from_urdf(WORLD)
    expected = kinematics_at(fixed, fixed.q0).frame_pose(fixed, "tip")
    for ours, theirs in zip(kin.frame_pose(free, "tip"), expected, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-15)


def test_freeing_from_world_needs_one_fixed_joint():
    text = urdf(link("world", ""), link("tip"), joint("turn", "world", "tip"))
    with pytest.raises(ValueError, match=r"'world'.*Joints there: turn"):
        Robot.from_urdf(text, floating_base=True)


def test_floating_joint_of_the_file_is_the_base():
    text = urdf(
        link("odom", ""),
        link("base"),
        link("tip"),
        joint("free", "odom", "base", kind="floating"),
        joint("a", "base", "tip"),
    )
    for floating_base in (None, True):
        assert Robot.from_urdf(text, floating_base=floating_base).tree.joint_names == ("free", "a")
    locked = Robot.from_urdf(text, floating_base=False)
    assert (locked.nv, locked.locked_joints, locked.floating_base) == (1, ("free",), False)
    moving = Robot.from_urdf(text)
    for robot in (locked, moving):  # both start where the joint's origin puts the link
        position, _ = kinematics_at(robot, robot.q0).frame_pose(robot, "base")
        np.testing.assert_allclose(position, [0.1, 0.0, 0.2])


def test_floating_joint_on_a_moving_link_is_refused():
    text = urdf(link("a"), link("b"), link("c"), joint("turn", "a", "b"), joint("free", "b", "c", kind="floating"))
    with pytest.raises(ValueError, match=r"'free' hangs from 'b', which moves"):
        Robot.from_urdf(text, floating_base=True)


def test_odd_names_survive():
    names = ("base/0", "upper arm", "größe-2", "a.b:c")
    text = urdf(*(link(n) for n in names), *(joint(f"j/{n}", p, n) for p, n in itertools.pairwise(names)))
    robot = Robot.from_urdf(text, floating_base=True)
    assert set(names) <= set(robot.frame_names)
    assert robot.joint_names == ("j/upper arm", "j/größe-2", "j/a.b:c")


def test_fixed_links_are_frames_with_their_mass():
    tool = urdf(
        link("base"), link("tip"), link("tool"), joint("a", "base", "tip"), joint("weld", "tip", "tool", kind="fixed")
    )
    robot = Robot.from_urdf(tool, floating_base=False)
    assert robot.tree.body_names == ("world", "tip")
    assert "tool" in robot.frame_names
    assert float(robot.body_mass[1]) == 3.0
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = robot.mujoco_qpos(jnp.array([0.7]))
    mujoco.mj_kinematics(robot.mj_model, data)
    position, rotation = kinematics_at(robot, jnp.array([0.7])).frame_pose(robot, "tool")
    np.testing.assert_allclose(position, data.body("tool").xpos, atol=1e-14)
    np.testing.assert_allclose(rotation, data.body("tool").xmat.reshape(3, 3), atol=1e-14)


def test_massless_links_may_move():
    text = urdf(
        link("base"),
        link("a", ""),
        link("b", ""),
        link("c"),
        *(joint(f"j{x}{y}", x, y) for x, y in (("base", "a"), ("a", "b"), ("b", "c"))),
    )
    robot = Robot.from_urdf(text, floating_base=True)
    assert float(robot.body_mass.sum()) == pytest.approx(3.0, rel=1e-12, abs=0.0)
    assert robot.mj_model.body_mass.sum() == pytest.approx(3.0, rel=1e-12, abs=0.0)


def test_quaternion_origin_equals_angles():
    quat = " ".join(map(repr, Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_quat().tolist()))
    other = ARM.replace('rpy="0.1 0.2 0.3"', f'quat_xyzw="{quat}"')
    ours, theirs = Robot.from_urdf(other, floating_base=True), Robot.from_urdf(ARM, floating_base=True)
    np.testing.assert_allclose(ours.body_quaternion, theirs.body_quaternion, atol=1e-15)


def test_comments_with_dashes_and_foreign_elements_are_skipped():
    extra = "<!-- ---- links ---- --><gazebo><link name='no'/></gazebo><transmission><joint name='no'/></transmission>"
    assert Robot.from_urdf(
        ARM.replace('<robot name="r">', f'<robot name="r">{extra}'), floating_base=True
    ).joint_names == ("a", "b")


SHAPES = (
    '<visual><geometry><mesh filename="package://nowhere/a.stl"/></geometry></visual>'
    '<visual><origin xyz="1 2 3"/><geometry><box size="2 4 6"/></geometry><material name="red"/></visual>'
    '<collision><geometry><cylinder radius="0.5" length="3"/></geometry></collision>'
    '<collision><geometry><sphere radius="0.25"/></geometry></collision>'
)


def test_primitives_are_kept_for_drawing_and_meshes_dropped():
    red = '<material name="red"><color rgba="1 0 0 1"/></material>'
    text = urdf(red, link("base", INERTIAL + SHAPES), link("tip"), joint("a", "base", "tip"))
    model = Robot.from_urdf(text, floating_base=True).mj_model
    kinds = mujoco.mjtGeom
    assert model.geom_type.tolist() == [kinds.mjGEOM_BOX, kinds.mjGEOM_CYLINDER, kinds.mjGEOM_SPHERE]
    np.testing.assert_array_equal(model.geom_size, [[1.0, 2.0, 3.0], [0.5, 1.5, 0.0], [0.25, 0.0, 0.0]])
    np.testing.assert_array_equal(model.geom_pos[0], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(model.geom_rgba[0], [1.0, 0.0, 0.0, 1.0])
    assert model.geom_group.tolist() == [2, 3, 3]
    assert model.geom_contype.tolist() == model.geom_conaffinity.tolist() == [0, 1, 1]
    assert model.body_mass.sum() == 3.0


# --- URDF: limits, mimic, locks ---


def limits(robot: Robot, name: str) -> list[float]:
    dof = robot.joint_dof_index(name)
    return [float(x[dof]) for x in (robot.position_lower, robot.position_upper, robot.velocity_limit)]


@pytest.mark.parametrize(
    ("kind", "limit", "expected"),
    [
        ("revolute", '<limit lower="-0.5" upper="0.75" velocity="4"/>', [-0.5, 0.75, 4.0]),
        ("prismatic", '<limit lower="-0.5" upper="0.75" velocity="4"/>', [-0.5, 0.75, 4.0]),
        ("continuous", '<limit lower="-0.5" upper="0.75" velocity="4"/>', [-np.inf, np.inf, 4.0]),
        ("revolute", '<limit lower="-0.5" upper="0.75" velocity="0"/>', [-0.5, 0.75, np.inf]),
        ("revolute", '<limit lower="-0.5" upper="0.75"/>', [-0.5, 0.75, np.inf]),
        ("revolute", '<limit upper="0.75"/>', [0.0, 0.75, np.inf]),
        ("revolute", '<limit lower="0.5" upper="0.5"/>', [0.5, 0.5, np.inf]),
    ],
)
def test_limits_of_a_joint(kind: str, limit: str, expected: list[float]):
    robot = Robot.from_urdf(urdf(link("base"), link("tip"), joint("a", "base", "tip", limit, kind)), floating_base=True)
    np.testing.assert_allclose(limits(robot, "a"), expected, rtol=1e-15)
    assert float(robot.q0[7]) == max(0.0, limits(robot, "a")[0])


def test_no_limit_element_means_no_limit():
    text = joint("a", "base", "tip").replace('<limit lower="-1" upper="2" velocity="3" effort="1"/>', "")
    assert limits(Robot.from_urdf(urdf(link("base"), link("tip"), text), floating_base=True), "a") == [
        -np.inf,
        np.inf,
        np.inf,
    ]


def test_mimic_moves_with_its_leader_and_narrows_its_limits():
    """q_b = -0.5 q_a + 0.25, b in [-0.5, 0.5] at speed 1: a in [-0.5, 1.5] at speed 2."""
    mimic = '<mimic joint="a" multiplier="-0.5" offset="0.25"/>'
    robot = Robot.from_urdf(fingers(mimic, low=-0.5, high=0.5, speed=1.0), floating_base=False)
    assert robot.joint_names == ("a",)
    assert robot.mimic_joints == {"b": ("a", -0.5)}
    assert limits(robot, "a") == [-0.5, 1.5, 2.0]
    np.testing.assert_allclose(robot.mujoco_qpos(jnp.array([0.8])), [0.8, -0.15], atol=1e-15)
    assert robot.joint_qpos_index("b") == robot.joint_qpos_index("a")
    np.testing.assert_allclose(robot.configuration({"b": -0.15}), [0.8], atol=1e-15)


def test_mimic_jacobian_is_that_of_both_joints():
    robot = Robot.from_urdf(fingers('<mimic joint="a" multiplier="-0.5" offset="0.25"/>'), floating_base=False)
    free = Robot.from_urdf(fingers(""), floating_base=False)
    q, full = jnp.array([0.8]), jnp.array([0.8, -0.15])
    kin, kin_free = osik.forward_kinematics(robot, q), osik.forward_kinematics(free, full)
    expected = osik.frame_jacobian(free, kin_free, "lower") @ np.array([[1.0], [-0.5]])
    np.testing.assert_allclose(osik.frame_jacobian(robot, kin, "lower"), expected, atol=1e-14)


def test_chain_of_mimics_ends_at_the_leader():
    """c = 2 b + 1, b = -3 a + 0.5: c = -6 a + 2. The follower is written before its leader."""
    text = urdf(
        *(link(n) for n in ("base", "la", "lb", "lc")),
        joint("c", "base", "lc", '<mimic joint="b" multiplier="2" offset="1"/>', "continuous"),
        joint("b", "base", "lb", '<mimic joint="a" multiplier="-3" offset="0.5"/>', "continuous"),
        joint("a", "base", "la", kind="continuous"),
    )
    robot = Robot.from_urdf(text, floating_base=False)
    assert robot.mimic_joints == {"c": ("a", -6.0), "b": ("a", -3.0)}
    full = dict(zip(robot.tree.joint_names, np.asarray(robot.mujoco_qpos(jnp.array([0.25]))), strict=True))
    assert full == {"a": 0.25, "b": -0.25, "c": 0.5}


def test_locked_joints_by_name_glob_and_value():
    assert Robot.from_urdf(ARM, locked_joints=["a"], floating_base=True).joint_names == ("b",)
    assert Robot.from_urdf(ARM, floating_base=False, locked_joints=("[b-z]",)).locked_joints == ("b",)
    robot = Robot.from_urdf(ARM, floating_base=False, locked_joints={"b": 0.5})
    free = Robot.from_urdf(ARM, floating_base=False)
    np.testing.assert_array_equal(robot.mujoco_qpos(jnp.array([0.25])), [0.25, 0.5])
    kin, kin_free = (
        osik.forward_kinematics(robot, jnp.array([0.25])),
        osik.forward_kinematics(free, jnp.array([0.25, 0.5])),
    )
    for ours, theirs in zip(kin.frame_pose(robot, "lower"), kin_free.frame_pose(free, "lower"), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    expected = osik.frame_jacobian(free, kin_free, "lower")[:, :1]
    np.testing.assert_allclose(osik.frame_jacobian(robot, kin, "lower"), expected, atol=1e-15)


def test_a_locked_leader_locks_its_followers():
    text = fingers('<mimic joint="a" multiplier="-0.5" offset="0.25"/>')
    for locked in ({"a": 0.5}, {"a": 0.5, "b": 0.0}):
        robot = Robot.from_urdf(text, locked_joints=locked, floating_base=True)
        assert robot.locked_joints == ("a", "b")
        np.testing.assert_array_equal(robot.mujoco_qpos(robot.q0)[7:], [0.5, 0.0])
    assert Robot.from_urdf(text, locked_joints=("?",), floating_base=True).locked_joints == ("a", "b")


def test_locked_floating_base():
    robot = Robot.from_urdf(ARM, floating_base=True, locked_joints=("floating_base",))
    assert (robot.nv, robot.floating_base, robot.joint_names) == (2, False, ("a", "b"))


# --- URDF: what is refused ---

CHAIN = (link("base"), link("tip"), joint("a", "base", "tip"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot>\n<link name='a'>\n</robot>", r"XML text: broken XML at line 3, column 3: mismatched tag"),
        ("<mujoco/>", r"root element is <mujoco>, not <robot>: this is an MJCF: use Robot.from_mjcf"),
        ("<svg/>", r"root element is <svg>"),
        (urdf(), r"no <link>"),
        (urdf(link("a", ""), link("b", ""), joint("j", "a", "b")), r"nothing that moves has a mass; .*: a, b"),
        (urdf(*CHAIN, link("c"), link("d")), r"3 links have no parent, one has to be the root: base, c, d"),
        (urdf(*CHAIN, joint("back", "tip", "base")), r"form a loop: every link has a parent.*base, tip"),
        (
            urdf(*CHAIN, link("c"), link("d"), joint("x", "c", "d"), joint("y", "d", "c")),
            r"loop that the root 'base' does not reach: c, d",
        ),
        (
            urdf(*CHAIN, link("c"), joint("x", "base", "c"), joint("y", "tip", "c")),
            r"'c' is the child of two joints, 'x' and 'y'",
        ),
        (
            urdf(*CHAIN, joint("x", "base", "tipp")),
            r"joint 'x': no link 'tipp'; did you mean 'tip'\? links: base, tip \(its child\)",
        ),
        (urdf(*CHAIN, link("tip")), r"two links are called 'tip'"),
        (urdf(*CHAIN, link("c"), joint("a", "base", "c")), r"two joints are called 'a'"),
        (
            urdf(*CHAIN[:2], joint("a", "base", "tip", '<limit lower="1" upper="-1"/>')),
            r"joint 'a', limit: lower 1.0 > upper -1.0",
        ),
        (
            urdf(*CHAIN[:2], joint("a", "base", "tip", '<limit lower="x" upper="1"/>')),
            r"joint 'a', limit, lower: 'x' is not a finite number",
        ),
        (
            urdf(*CHAIN[:2], joint("a", "base", "tip", '<limit upper="1" velocity="-1"/>')),
            r"joint 'a', limit: the velocity -1.0 is negative",
        ),
        (
            urdf(*CHAIN[:2], joint("a", "base", "tip", kind="planar")),
            r"'a' has the type 'planar'.*two prismatic joints and a continuous one",
        ),
        (urdf(*CHAIN[:2], joint("a", "base", "tip").replace("0 0 1", "0 0 0")), r"joint 'a': the axis is zero"),
        (
            urdf(*CHAIN[:2], joint("a", "base", "tip").replace("0.1 0 0.2", "0.1 0")),
            r"joint 'a', origin xyz: '0.1 0' is not 3 finite numbers",
        ),
        (
            urdf(link("base", INERTIAL.replace("1.5", "-1")), *CHAIN[1:]),
            r"link 'base', inertial: the mass -1.0 is negative",
        ),
        (
            urdf(link("base"), link("world"), joint("a", "base", "world")),
            r"only the root link may be called 'world', and the root link is 'base'",
        ),
        (
            fingers('<mimic joint="aa"/>'),
            r"'b' mimics what is not there: no joint 'aa'; did you mean 'a'\? joints: a, b",
        ),
        (fingers('<mimic joint="b"/>'), r"follow each other in a circle: b -> b"),
        (fingers('<mimic joint="a" offset="5"/>'), r"'a' and its follower 'b' have no position in common"),
        (
            urdf(
                link("base"),
                link("t"),
                link("u"),
                joint("a", "base", "t", '<mimic joint="b"/>'),
                joint("b", "t", "u", '<mimic joint="a"/>'),
            ),
            r"follow each other in a circle: a -> b -> a",
        ),
        (
            urdf(
                *CHAIN,
                link("c"),
                joint("w", "tip", "c", kind="fixed"),
                link("d"),
                joint("m", "c", "d", '<mimic joint="w"/>'),
            ),
            r"'m' mimics 'w', which is fixed",
        ),
        (
            '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arm/></robot>',
            r"xacro element <xacro:arm>: run xacro",
        ),
    ],
)
def test_broken_urdf_is_refused_by_name(text: str, message: str):
    with pytest.raises(ValueError, match=message):
        Robot.from_urdf(text, floating_base=True)


def test_a_model_without_joints_is_refused():
    text = urdf(link("a"), link("b"), joint("j", "a", "b", kind="fixed"))
    with pytest.raises(ValueError, match=r"no joint, so nothing can move; bodies: world, a, b"):
        Robot.from_urdf(text, floating_base=False)


def test_missing_files_are_named_with_what_lies_there(tmp_path: Path):
    (tmp_path / "robot.urdf").write_text(ARM)
    for path in (tmp_path / "robot.urdf", str(tmp_path / "robot.urdf")):
        assert Robot.from_urdf(path, floating_base=False).joint_names == ("a", "b")
    with pytest.raises(
        FileNotFoundError, match=r"robt.urdf'; did you mean 'robot.urdf'\? .urdf files in .*: robot.urdf"
    ):
        Robot.from_urdf(tmp_path / "robt.urdf")
    with pytest.raises(FileNotFoundError, match=r"the folder .*gone' does not exist"):
        Robot.from_mjcf(tmp_path / "gone" / "robot.xml")
    with pytest.raises(FileNotFoundError, match=r".xml files in .*: \(none\)"):
        Robot.from_mjcf(tmp_path)


@pytest.mark.parametrize(
    ("locked", "error", "message"),
    [
        (("c",), KeyError, r"no joint 'c'.*joints: floating_base, a, b"),
        (("bb",), KeyError, r"no joint 'bb'; did you mean 'b'"),
        (("x*",), KeyError, r"no joint 'x\*'"),
        ("a", TypeError, r"not one string: use \('a',\)"),
        (("*",), ValueError, r"no joint left to move; joints: floating_base, a, b, all locked"),
        ({"a": np.nan}, ValueError, r"joint 'a' cannot be locked at nan"),
        ({"floating_base": 0.0}, ValueError, r"'floating_base' is free or ball"),
    ],
)
def test_wrong_locks_are_refused(locked, error: type[Exception], message: str):
    with pytest.raises(error, match=message):
        Robot.from_urdf(ARM, locked_joints=locked, floating_base=True)


def test_a_follower_cannot_be_locked_against_its_leader():
    text = fingers('<mimic joint="a"/>')
    with pytest.raises(ValueError, match=r"'b' cannot be locked alone: it mimics 'a', lock that one"):
        Robot.from_urdf(text, locked_joints=("b",), floating_base=True)
    with pytest.raises(ValueError, match=r"'b' cannot be locked at 0.5: it mimics 'a', which puts it at 0.25"):
        Robot.from_urdf(text, locked_joints={"a": 0.25, "b": 0.5}, floating_base=True)


# --- MJCF ---

LEG = """
<mujoco>
  <worldbody>
    <body name="trunk" pos="0 0 1" euler="0 0 90">
      {base}<geom size="0.1"/>
      <body name="thigh" pos="0.1 0 0">
        <joint name="hip" axis="0 1 0" range="-90 45"/>
        <geom name="bone" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.05"/>
        <body name="shank" pos="0 0 -0.3">
          <joint name="knee" axis="0 1 0" ref="10"/><geom size="0.05"/><site name="sole" pos="0 0 -0.3"/>
        </body>
      </body>
    </body>
  </worldbody>
  {extra}
</mujoco>
"""
SPEEDS = '<custom><numeric name="velocity_limit/hip" data="6.5"/></custom>'


def leg(base: str = "<freejoint/>", extra: str = "") -> str:
    return LEG.format(base=base, extra=extra)


def mujoco_pose(robot: Robot, q, name: str, kind: str = "body") -> list[np.ndarray]:
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = robot.mujoco_qpos(q)
    mujoco.mj_kinematics(robot.mj_model, data)
    element = getattr(data, kind)(name)
    return [element.xpos, element.xmat.reshape(3, 3)]


def assert_poses_agree(robot: Robot, q, name: str, kind: str = "body") -> None:
    ours = kinematics_at(robot, q).frame_pose(robot, name)
    for a, b in zip(ours, mujoco_pose(robot, q, name, kind), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-14)


def test_mjcf_names_limits_and_speeds():
    robot = Robot.from_mjcf(leg(extra=SPEEDS), velocity_limits={"k*": 2.0})
    assert robot.tree.joint_names == ("joint0", "hip", "knee")
    assert {"trunk", "thigh", "shank", "sole", "bone"} <= set(robot.frame_names)
    np.testing.assert_allclose(limits(robot, "hip"), [-np.pi / 2, np.pi / 4, 6.5], rtol=1e-15)
    assert limits(robot, "knee") == [-np.inf, np.inf, 2.0]
    assert limits(Robot.from_mjcf(leg(extra=SPEEDS), velocity_limits={"hip": 1.0}), "hip")[2] == 1.0


def test_mjcf_floating_base_as_the_file_says_or_as_asked():
    assert Robot.from_mjcf(leg()).nv == 8
    assert Robot.from_mjcf(leg(""), floating_base=None).nv == 2
    added = Robot.from_mjcf(leg(""), floating_base=True)
    assert (added.nv, added.tree.joint_names[0]) == (8, "floating_base")
    assert Robot.from_mjcf(leg(), floating_base=True).tree.joint_names[0] == "joint0"
    locked = Robot.from_mjcf(leg(), floating_base=False)
    assert (locked.nv, locked.floating_base, locked.locked_joints) == (2, False, ("joint0",))
    for robot in (added, locked):
        assert_poses_agree(robot, robot.q0, "shank")
        assert_poses_agree(robot, robot.q0, "sole", "site")
        np.testing.assert_allclose(mujoco_pose(robot, robot.q0, "trunk")[0], [0.0, 0.0, 1.0])


def test_q0_is_the_first_keyframe_also_under_an_added_base():
    keys = '<keyframe><key name="home" qpos="{}0.25 -0.5"/><key qpos="{}0 0"/></keyframe>'
    robot = Robot.from_mjcf(leg(extra=keys.format(*2 * ("1 2 3 1 0 0 0 ",))))
    np.testing.assert_array_equal(robot.q0, [1, 2, 3, 1, 0, 0, 0, 0.25, -0.5])
    added = Robot.from_mjcf(leg("", keys.format("", "")), floating_base=True)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(added.q0, [0, 0, 1, half, 0, 0, half, 0.25, -0.5], rtol=1e-15)
    outside = Robot.from_mjcf(leg("", '<keyframe><key qpos="-2 0"/></keyframe>'))
    np.testing.assert_allclose(outside.q0, [-np.pi / 2, 0.0])


def test_joint_equalities_become_exact():
    """MuJoCo: knee - knee0 = 0.2 - 0.5 (hip - hip0), knee0 = 10 degrees; the second one locks at 10 degrees + 0.2."""
    two = '<equality><joint joint1="knee" joint2="hip" polycoef="0.2 -0.5 0 0 0"/></equality>'
    robot = Robot.from_mjcf(leg("", two))
    assert robot.mimic_joints == {"knee": ("hip", -0.5)}
    np.testing.assert_allclose(robot.mujoco_qpos(jnp.array([0.3])), [0.3, np.radians(10) + 0.05], rtol=1e-15)
    assert_poses_agree(robot, jnp.array([0.3]), "shank")
    locked = Robot.from_mjcf(leg("", '<equality><joint joint1="knee" polycoef="0.2 0 0 0 0"/></equality>'))
    assert locked.locked_joints == ("knee",)
    np.testing.assert_allclose(locked.mujoco_qpos(jnp.array([0.3])), [0.3, np.radians(10) + 0.2], rtol=1e-15)
    for ignored in ('polycoef="0 1 1 0 0"', 'active="false"'):
        extra = f'<equality><joint joint1="knee" joint2="hip" {ignored}/></equality>'
        assert Robot.from_mjcf(leg("", extra)).nv == 2


def test_locks_without_value_stay_at_the_reference():
    robot = Robot.from_mjcf(leg(""), locked_joints=("knee",))
    np.testing.assert_allclose(robot.mujoco_qpos(jnp.array([0.3])), [0.3, np.radians(10)], rtol=1e-15)


MESHES = """
<mujoco>
  <asset>
    <mesh name="hull" file="hull.stl"/>
    <texture name="paint" type="2d" file="paint.png"/><material name="m" texture="paint"/>
    <hfield name="ground" file="ground.png" size="1 1 1 1"/>
  </asset>
  <worldbody>
    <geom type="hfield" hfield="ground"/>
    <body name="arm">
      <joint name="j" axis="0 0 1"/>{inertial}
      <geom name="mesh" type="mesh" mesh="hull" material="m" {mesh}/><geom name="ball" size="0.1" material="m"/>
    </body>
  </worldbody>
  <contact><pair geom1="mesh" geom2="ball"/></contact>
  <sensor><distance geom1="ball" geom2="mesh" cutoff="1"/></sensor>
</mujoco>
"""
WEIGHED = '<inertial pos="0.1 0.2 0.3" mass="2" diaginertia="1 1 1"/>'


@pytest.mark.parametrize(
    ("inertial", "mesh", "mass"),
    [
        (WEIGHED, "", 2.0),
        ("", 'mass="0"', 4000.0 / 3.0 * np.pi * 1e-3),
        ("", 'density="0"', 4000.0 / 3.0 * np.pi * 1e-3),
    ],
)
def test_missing_asset_files_do_not_matter(inertial: str, mesh: str, mass: float):
    robot = Robot.from_mjcf(MESHES.format(inertial=inertial, mesh=mesh))
    assert robot.frame_names == ("world", "arm", "ball")
    assert float(robot.body_mass[1]) == pytest.approx(mass, rel=1e-12)


def test_a_mass_that_comes_from_a_missing_mesh_is_refused():
    with pytest.raises(
        ValueError, match=r"body 'arm' takes its mass from the mesh file 'hull.stl', which cannot be read"
    ):
        Robot.from_mjcf(MESHES.format(inertial="", mesh=""))


def test_mesh_files_beside_the_mjcf_are_used(tmp_path: Path):
    """A tetrahedron: volume 1/6 m^3, 1000 kg/m^3."""
    corners = ("0 0 0", "1 0 0", "0 1 0", "0 0 1")
    faces = ("1 3 2", "1 2 4", "1 4 3", "2 3 4")
    (tmp_path / "hull.obj").write_text("\n".join([*(f"v {c}" for c in corners), *(f"f {f}" for f in faces)]))
    text = '<mujoco><asset><mesh name="hull" file="hull.obj"/></asset><worldbody><body name="arm"><joint name="j"/>'
    (tmp_path / "arm.xml").write_text(text + '<geom type="mesh" mesh="hull"/></body></worldbody></mujoco>')
    robot = Robot.from_mjcf(tmp_path / "arm.xml")
    assert float(robot.body_mass[1]) == pytest.approx(1000.0 / 6.0, rel=1e-6)
    np.testing.assert_allclose(robot.body_com[1], [0.25, 0.25, 0.25], rtol=1e-6)


BODY = '<body name="{0}"><joint name="j{0}"/><geom size="1"/></body>'


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("<mujoco>\n<worldbody>\n</mujoco>", {}, r"broken XML at line 3, column 3: mismatched tag"),
        ("<mujoco>\n<worldbodyy/></mujoco>", {}, r"XML text: .*unrecognized element\s.*worldbodyy.*line 2"),
        ("<robot/>", {}, r"root element is <robot>, not <mujoco>: this is a URDF: use Robot.from_urdf"),
        ("<mujoco/>", {}, r"no joint, so nothing can move; bodies: world"),
        (leg().replace("-90 45", "90 45"), {}, r"joint 'hip' has limits with lower > upper"),
        (leg('<joint name="turn"/>'), {"floating_base": True}, r"root body 'trunk' already has a joint"),
        (
            "<mujoco><worldbody><body><geom size='1'/></body></worldbody></mujoco>",
            {"floating_base": True},
            r"with joints: \(none\)",
        ),
        (
            f"<mujoco><worldbody>{BODY.format('a')}{BODY.format('b')}</worldbody></mujoco>",
            {"floating_base": True},
            r"with joints: a, b",
        ),
        (leg(), {"velocity_limits": {"hip": 0.0}}, r"velocity limit of joint 'hip' is 0.0; it has to be positive"),
        (
            leg("", "<equality><joint joint1='hip' joint2='knee'/><joint joint1='knee' joint2='hip'/></equality>"),
            {},
            r"mimic each other in a circle: hip, knee",
        ),
        (
            leg("", "<equality><joint joint1='hip' joint2='knee'/><joint joint1='hip'/></equality>"),
            {},
            r"joint 'hip' is tied by more than one joint equality",
        ),
    ],
)
def test_broken_mjcf_is_refused_by_name(text: str, options: dict, message: str):
    with pytest.raises(ValueError, match=f"(?s){message}"):
        Robot.from_mjcf(text, **options)


def test_unknown_names_in_velocity_limits():
    with pytest.raises(KeyError, match=r"no joint 'hipp'; did you mean 'hip'\? joints: joint0, hip, knee"):
        Robot.from_mjcf(leg(), velocity_limits={"hipp": 1.0})
    with pytest.raises(KeyError, match=r"no joint 'hipp'"):
        Robot.from_mjcf(leg(extra=SPEEDS.replace("hip", "hipp")))


def test_a_model_with_reversed_limits_is_refused():
    model = mujoco.MjModel.from_xml_string(leg())
    model.jnt_range[1] = [1.0, -1.0]
    with pytest.raises(ValueError, match=r"joint 'hip' has limits with lower > upper: \[1.0, -1.0\]"):
        Robot.from_mjmodel(model)


def test_a_massless_model_is_refused():
    model = mujoco.MjModel.from_xml_string(leg())
    model.body_mass[:] = 0.0
    with pytest.raises(ValueError, match=r"nothing that moves has a mass; .*: trunk, thigh, shank"):
        Robot.from_mjmodel(model)


def test_unnamed_elements_get_names_of_their_own():
    body = '<body name="body2"><joint name="joint1"/><geom size="1"/><body><joint/><geom size="1"/></body></body>'
    robot = Robot.from_mjcf(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    assert robot.tree.body_names == ("world", "body2", "body2_")
    assert robot.joint_names == ("joint1", "joint1_")


def test_a_site_called_like_its_body_gets_a_prefix():
    robot = Robot.from_mjcf(leg().replace('name="sole"', 'name="shank"'))
    for name, kind in (("shank", "body"), ("site:shank", "site")):
        ours = kinematics_at(robot, robot.q0).frame_pose(robot, name)[0]
        np.testing.assert_allclose(ours, mujoco_pose(robot, robot.q0, "shank", kind)[0], atol=1e-14)


# --- asking a robot for what it does not have ---


def test_unknown_frames_and_joints_are_named_with_the_nearest():
    robot = Robot.from_urdf(ARM, floating_base=True)
    kin = kinematics_at(robot, robot.q0)
    with pytest.raises(KeyError, match=r"no frame 'uper'; did you mean 'upper'\? frames: world, base, upper, lower"):
        kin.frame_pose(robot, "uper")
    with pytest.raises(KeyError, match=r"no frame 'uper'"):
        osik.frame_jacobian(robot, kin, "uper")
    with pytest.raises(KeyError, match=r"no joint 'c'. joints: floating_base, a, b"):
        robot.joint_qpos_index("c")
    with pytest.raises(KeyError, match=r"joint 'a' is locked, so it has no place in q; joints: b"):
        Robot.from_urdf(ARM, locked_joints=("a",), floating_base=True).joint_dof_index("a")
    with pytest.raises(ValueError, match=r"'floating_base' is free or ball: set its entries of q"):
        robot.configuration({"floating_base": 1.0})


def test_wrong_configurations_are_refused():
    robot = Robot.from_urdf(ARM, floating_base=True)
    with pytest.raises(ValueError, match=r"shape \(8,\).*\(9,\): floating_base, a, b. Batch with jax.vmap"):
        osik.forward_kinematics(robot, jnp.zeros(8))
    with pytest.raises(ValueError, match=r"q\[3:7\], the quaternion of joint 'floating_base', is zero"):
        osik.forward_kinematics(robot, jnp.zeros(9))
    with pytest.raises(ValueError, match=r"not finite at indices \[8\]"):
        osik.forward_kinematics(robot, robot.q0.at[8].set(jnp.nan))


# --- many robots at once ---


def test_robots_of_one_tree_stack_and_vmap():
    """FK, CoM and a step over the stack equal the loop. One program serves the stack, and one each file's model."""
    texts = [ARM.replace("0.1 0 0.2", f"{0.1 * k} {0.05 * k} 0.2").replace("1.5", str(1.0 + k)) for k in range(1, 4)]
    robots = [Robot.from_urdf(text, floating_base=True) for text in texts]
    q, traced = jnp.asarray(np.random.default_rng(3).normal(size=(3, 9))), []

    @jax.jit
    def at(robot: Robot, q: jax.Array) -> tuple[jax.Array, ...]:
        traced.append(robot)
        kin = osik.forward_kinematics(robot, q)
        jacobian = osik.frame_jacobian(robot, kin, "lower")
        return (*kin.frame_pose(robot, "lower"), jacobian, osik.center_of_mass(robot, kin), robot.position_upper)

    stacked = osik.stack(robots)
    batch = jax.vmap(at)(stacked, q)
    jax.vmap(at)(osik.stack(robots[::-1]), q)
    at(jax.tree.map(lambda leaf: leaf[0], stacked), q[0])
    for k, robot in enumerate(robots):
        for ours, one in zip(batch, at(robot, q[k]), strict=True):
            np.testing.assert_allclose(ours[k], one, rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(batch[0][k], mujoco_pose(robot, normalised(q[k]), "lower")[0], atol=1e-14)
    assert len(traced) == 1 + len(robots)
    assert not np.allclose(batch[0][0], batch[0][1])


def normalised(q: jax.Array) -> jax.Array:
    return q.at[3:7].divide(jnp.linalg.norm(q[3:7]))
