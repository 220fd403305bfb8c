"""Robots from URDF, MJCF and MuJoCo models: what is read, what is refused, and with which words."""

from __future__ import annotations

import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco_states import mujoco_at
from refusals import refuses
from scipy.spatial.transform import Rotation
from task_checks import kinematics_at
from urdfs import INERTIAL, LIMIT, joint, link, tree, urdf

import osik_jax as osik
from osik_jax import Robot

ARM = tree(joint("a", "base", "upper"), joint("b", "upper", "lower"))


def fingers(mimic: str, *, low: float = -1.0, high: float = 1.0, speed: float = 3.0) -> str:
    """A leader ``a`` (limits -1, 2, speed 3) and a follower ``b`` on two branches."""
    limit = f'<limit lower="{low}" upper="{high}" velocity="{speed}"/>'
    return tree(joint("a", "base", "upper"), joint("b", "base", "lower", mimic + limit))


# --- URDF: base, frames, names ---


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
    refuses(ValueError, r"'world'.*Joints there: turn", Robot.from_urdf, text, floating_base=True)


def test_floating_joint_of_the_file_is_the_base():
    text = tree(joint("free", "odom", "base", kind="floating"), joint("a", "base", "tip"))
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
    refuses(ValueError, r"'free' hangs from 'b', which moves", Robot.from_urdf, text, floating_base=True)


def test_odd_names_survive():
    names = ("base/0", "upper arm", "größe-2", "a.b:c")
    text = urdf(*(link(n) for n in names), *(joint(f"j/{n}", p, n) for p, n in itertools.pairwise(names)))
    robot = Robot.from_urdf(text, floating_base=True)
    assert set(names) <= set(robot.frame_names)
    assert robot.joint_names == ("j/upper arm", "j/größe-2", "j/a.b:c")


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
    text = ARM.replace('<robot name="r">', f'<robot name="r">{extra}')
    assert Robot.from_urdf(text, floating_base=True).joint_names == ("a", "b")


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
    text = urdf(link("base"), link("tip"), joint("a", "base", "tip").replace(LIMIT, ""))
    assert limits(Robot.from_urdf(text, floating_base=True), "a") == [-np.inf, np.inf, np.inf]


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


def test_chain_of_mimics_ends_at_the_leader():
    """c = 2 b + 1, b = -3 a + 0.5: c = -6 a + 2. The follower is written before its leader."""
    text = tree(
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
    np.testing.assert_array_equal(robot.mujoco_qpos(jnp.array([0.25])), [0.25, 0.5])


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

A = joint("a", "base", "tip")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<svg/>", r"root element is <svg>"),
        (urdf(), r"no <link>"),
        (tree(A, joint("x", "c", "d"), joint("y", "d", "c")), r"loop that the root 'base' does not reach: c, d"),
        (tree(A.replace("0.1 0 0.2", "0.1 0")), r"joint 'a', origin xyz: '0.1 0' is not 3 finite numbers"),
        (tree(joint("a", "base", "world")), r"only the root link may be called 'world', and the root link is 'base'"),
        (fingers('<mimic joint="a" offset="5"/>'), r"'a' and its follower 'b' have no position in common"),
        (
            tree(A, joint("w", "tip", "c", kind="fixed"), joint("m", "c", "d", '<mimic joint="w"/>')),
            r"'m' mimics 'w', which is fixed",
        ),
    ],
)
def test_broken_urdf_is_refused_by_name(text: str, message: str):
    refuses(ValueError, message, Robot.from_urdf, text, floating_base=True)


def test_missing_files_are_named_with_what_lies_there(tmp_path: Path):
    (tmp_path / "robot.urdf").write_text(ARM)
    for path in (tmp_path / "robot.urdf", str(tmp_path / "robot.urdf")):
        assert Robot.from_urdf(path, floating_base=False).joint_names == ("a", "b")
    nearest = r"robt.urdf'; did you mean 'robot.urdf'\? .urdf files in .*: robot.urdf"
    refuses(FileNotFoundError, nearest, Robot.from_urdf, tmp_path / "robt.urdf")
    refuses(FileNotFoundError, r".xml files in .*: \(none\)", Robot.from_mjcf, tmp_path)


@pytest.mark.parametrize(
    ("locked", "error", "message"),
    [
        (("bb",), KeyError, r"no joint 'bb'; did you mean 'b'"),
        (("x*",), KeyError, r"no joint 'x\*'"),
        ("a", TypeError, r"not one string: use \('a',\)"),
        ({"floating_base": 0.0}, ValueError, r"'floating_base' is free or ball"),
    ],
)
def test_wrong_locks_are_refused(locked, error: type[Exception], message: str):
    refuses(error, message, Robot.from_urdf, ARM, locked_joints=locked, floating_base=True)


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
    element = getattr(mujoco_at(robot, q), kind)(name)
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
    message = r"body 'arm' takes its mass from the mesh file 'hull.stl', which cannot be read"
    refuses(ValueError, message, Robot.from_mjcf, MESHES.format(inertial="", mesh=""))


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


def bodies(*inside: str) -> str:
    return f"<mujoco><worldbody>{''.join(inside)}</worldbody></mujoco>"


def tied(*equalities: str) -> str:
    return leg("", f"<equality>{''.join(f'<joint {equality}/>' for equality in equalities)}</equality>")


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("<mujoco>\n<worldbodyy/></mujoco>", {}, r"XML text: .*unrecognized element\s.*worldbodyy.*line 2"),
        (leg().replace("-90 45", "90 45"), {}, r"joint 'hip' has limits with lower > upper"),
        (leg('<joint name="turn"/>'), {"floating_base": True}, r"root body 'trunk' already has a joint"),
        (bodies("<body><geom size='1'/></body>"), {"floating_base": True}, r"with joints: \(none\)"),
        (bodies(BODY.format("a"), BODY.format("b")), {"floating_base": True}, r"with joints: a, b"),
        (
            tied("joint1='hip' joint2='knee'", "joint1='knee' joint2='hip' polycoef='0.1 1 0 0 0'"),
            {},
            r"contradict each other: one says knee = 1 hip .*, which the others do not allow",
        ),
        (tied("joint1='hip'", "joint1='hip' polycoef='0.1 0 0 0 0'"), {}, r"'hip' is held at 0 and at 0\.1 by two"),
    ],
)
def test_broken_mjcf_is_refused_by_name(text: str, options: dict, message: str):
    refuses(ValueError, f"(?s){message}", Robot.from_mjcf, text, **options)


@pytest.mark.parametrize(
    "equalities",
    [
        ("joint1='ja' joint2='jb' polycoef='0.1 2 0 0 0'", "joint1='ja' joint2='jb' polycoef='0.1 2 0 0 0'"),
        ("joint1='ja' joint2='jb' polycoef='0.1 2 0 0 0'", "joint1='jb' joint2='ja' polycoef='-0.05 0.5 0 0 0'"),
        ("joint1='ja' joint2='jb' polycoef='0.1 2 0 0 0'", "joint1='ja' joint2='jc' polycoef='0 -1 0 0 0'"),
        ("joint1='ja' polycoef='0.1 0 0 0 0'", "joint1='ja' joint2='jb' polycoef='0 2 0 0 0'"),
    ],
    ids=["twice", "both ways", "two leaders", "a leader that is held"],
)
def test_several_equalities_on_a_joint_hold_in_mujoco(equalities: tuple[str, ...], rng):
    ties = "".join(f"<joint {equality}/>" for equality in equalities)
    text = bodies(*map(BODY.format, "abc")).replace("</mujoco>", f"<equality>{ties}</equality></mujoco>")
    robot = Robot.from_mjcf(text)
    data = mujoco.MjData(robot.mj_model)
    for q in np.asarray(robot.q0) + rng.uniform(-0.2, 0.2, (3, robot.nq)):
        data.qpos[:] = np.asarray(robot.mujoco_qpos(q))
        mujoco.mj_forward(robot.mj_model, data)
        assert data.ne == 2 and np.abs(data.efc_pos[:2]).max() < 1e-9


def test_unknown_names_in_velocity_limits():
    with pytest.raises(KeyError, match=r"no joint 'hipp'; did you mean 'hip'\? joints: joint0, hip, knee"):
        Robot.from_mjcf(leg(), velocity_limits={"hipp": 1.0})
    refuses(KeyError, r"no joint 'hipp'", Robot.from_mjcf, leg(extra=SPEEDS.replace("hip", "hipp")))


def test_unnamed_elements_get_names_of_their_own():
    body = '<body name="body2"><joint name="joint1"/><geom size="1"/><body><joint/><geom size="1"/></body></body>'
    robot = Robot.from_mjcf(bodies(body))
    assert robot.tree.body_names == ("world", "body2", "body2_")
    assert robot.joint_names == ("joint1", "joint1_")


def test_shapes_without_a_name_are_called_by_their_link():
    """In the pairs of a limit, too; a shape that has this very name keeps it."""
    inner = (
        '<body name="fore" pos="3 0 0"><joint/><geom size="1"/><geom name="fore:1" size="1"/><geom size="1"/></body>'
    )
    robot = Robot.from_mjcf(bodies(f'<body name="upper"><joint/><geom size="1"/>{inner}</body>'))
    assert robot.tree.geom_names == ("upper:0", "fore:0", "fore:1", "fore:2")
    limit = osik.CollisionAvoidanceLimit(robot, pairs=[("upper", "fore:2")])
    assert limit.pairs == (("upper:0", "fore:2"),)
    box = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
    table = osik.CollisionShape.sphere(0.1, [9.0, 9.0, 9.0])
    arm = Robot.from_urdf(urdf(link("a"), link("b", INERTIAL + 2 * box), joint("j", "a", "b")), floating_base=False)
    limit = osik.CollisionAvoidanceLimit(arm, shapes={"table": table}, pairs=[("table", "b")])
    assert {name for pair in limit.pairs for name in pair} == {"table", "b:0", "b:1"}


@pytest.mark.parametrize("value", ["x", None, [0.1], True, 1j])
def test_a_value_of_a_joint_is_one_number(value):
    robot = Robot.from_urdf(ARM, floating_base=False)
    refuses(TypeError, "the value of joint 'a' is .*; it is one number", robot.configuration, {"a": value})


def test_a_site_called_like_its_body_gets_a_prefix():
    robot = Robot.from_mjcf(leg().replace('name="sole"', 'name="shank"'))
    for name, kind in (("shank", "body"), ("site:shank", "site")):
        ours = kinematics_at(robot, robot.q0).frame_pose(robot, name)[0]
        np.testing.assert_allclose(ours, mujoco_pose(robot, robot.q0, "shank", kind)[0], atol=1e-14)


# --- asking a robot for what it does not have ---


def test_joints_without_a_place_in_q_are_named():
    robot = Robot.from_urdf(ARM, floating_base=True)
    refuses(KeyError, r"no joint 'c'. joints: floating_base, a, b", robot.joint_qpos_index, "c")
    with pytest.raises(KeyError, match=r"joint 'a' is locked, so it has no place in q; joints: b"):
        Robot.from_urdf(ARM, locked_joints=("a",), floating_base=True).joint_dof_index("a")
    with pytest.raises(ValueError, match=r"'floating_base' is free or ball: set its entries of q"):
        robot.configuration({"floating_base": 1.0})


def test_a_configuration_begins_at_one_of_the_same_robot_whatever_its_type():
    robot = Robot.from_urdf(ARM, floating_base=False)
    refuses(ValueError, r"base has shape \(3,\)", robot.configuration, {"a": 0.1}, base=np.zeros(3))
    q = robot.configuration({"b": 0.25}, base=np.zeros(2, int))
    assert q.dtype == robot.q0.dtype and q.tolist() == [0.0, 0.25]


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


@pytest.mark.parametrize(
    "read", [lambda **how: Robot.from_urdf(ARM, **how), lambda **how: osik.load_robot("nao", **how)]
)
@pytest.mark.parametrize("value", ["fixed", "no", 0, 1.0])
def test_a_floating_base_is_true_false_or_none(read, value):
    refuses(TypeError, f"floating_base is {value!r}; it is True, False, or None", read, floating_base=value)
    assert read(floating_base=np.True_).floating_base


@pytest.mark.parametrize(
    "options, error, message",
    [
        (dict(velocity_limits={"a": "fast"}), TypeError, "velocity limit of joint 'a' is 'fast'; it is a number"),
        (dict(velocity_limits={"a": None}), TypeError, "velocity limit of joint 'a' is None; it is a number"),
        (dict(velocity_limits=[1.0, 2.0]), TypeError, "velocity_limits is .*it maps joint names"),
        (dict(position_limits={"a": (np.inf, np.inf)}), ValueError, "no position is between"),
        (dict(position_limits={"a": (-np.inf, -np.inf)}), ValueError, "no position is between"),
        (dict(locked_joints={"a": "x"}), TypeError, "joint 'a' is locked is 'x'; it is a number"),
        (dict(locked_joints=3), TypeError, "locked_joints is 3; it is a sequence of names"),
    ],
)
def test_options_that_are_no_numbers_are_named(options, error, message):
    refuses(error, message, Robot.from_urdf, ARM, floating_base=False, **options)


@pytest.mark.parametrize("factor", [-1.0, np.nan, np.inf])
@pytest.mark.parametrize("what", ["length", "mass"])
def test_links_are_scaled_by_finite_factors(what, factor):
    robot = Robot.from_urdf(ARM, floating_base=False)
    for given in (factor, {"*": factor}):
        refuses(ValueError, f"{what}.* is .*finite and not negative", robot.scaled, **{what: given})
    refuses(TypeError, f"{what} is 'a'; it is a number", robot.scaled, **{what: "a"})
    refuses(ValueError, "length is 0.0; a length is scaled by a positive factor", robot.scaled, length=0.0)
    assert float(robot.scaled(mass={"lower": 0.0}).body_mass[-1]) == 0.0


@pytest.mark.parametrize("shape", [(), (1,), (4, 2), (9,)])
def test_a_configuration_of_another_shape_has_no_qpos(shape):
    robot = Robot.from_urdf(ARM, floating_base=False)
    assert robot.nq == 2
    refuses(ValueError, r"q has shape .*configurations have shape", robot.mujoco_qpos, np.zeros(shape))
