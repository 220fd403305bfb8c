"""What real robot files do: each quirk in a small file, against MuJoCo C and Pinocchio at random configurations."""

from __future__ import annotations

import importlib.metadata
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax import Robot

CONFIGURATIONS = 3
KINDS = {"body": mujoco.mjtObj.mjOBJ_BODY, "site": mujoco.mjtObj.mjOBJ_SITE, "geom": mujoco.mjtObj.mjOBJ_GEOM}


@jax.jit
def poses(robot: Robot, q: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    kinematics = osik.forward_kinematics(robot, q)
    return *kinematics.frame_poses(robot, robot.frame_names), osik.center_of_mass(robot, kinematics)


def random_configuration(robot: Robot, rng: np.random.Generator) -> np.ndarray:
    """Any positions, unit quaternions."""
    q = rng.uniform(-1.5, 1.5, robot.nq)
    for joint, start in robot.tree.qpos_address.items():
        kind = robot.tree.joint_types[joint]
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            quaternion = slice(start + 3 * (kind == mujoco.mjtJoint.mjJNT_FREE), None)
            q[quaternion][:4] = rng.normal(size=4)
            q[quaternion][:4] /= np.linalg.norm(q[quaternion][:4])
    return q


def check_with_mujoco(robot: Robot, model: mujoco.MjModel) -> None:
    """Every named body, site and geom of MuJoCo's own reading is a frame, at the same place; so is the mass."""
    rng, data = np.random.default_rng(3), mujoco.MjData(model)
    named = [
        (kind, k, mujoco.mj_id2name(model, number, k))
        for kind, number in KINDS.items()
        for k in range(getattr(model, f"n{kind}"))
    ]
    moving = np.where(model.body_weldid != 0, model.body_mass, 0.0)
    for _ in range(CONFIGURATIONS):
        q = random_configuration(robot, rng)
        position, rotation, com = map(np.asarray, poses(robot, jnp.asarray(q)))
        data.qpos[:] = robot.mujoco_qpos(jnp.asarray(q))
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        np.testing.assert_allclose(com, moving @ data.xipos / moving.sum(), rtol=0.0, atol=1e-12)
        for kind, k, name in named:
            if name:
                frame = robot.tree.frame(name if f"{kind}:{name}" not in robot.frame_names else f"{kind}:{name}")
                prefix = "" if kind == "body" else f"{kind}_"
                place, axes = (getattr(data, f"{prefix}{what}" if prefix else what) for what in ("xpos", "xmat"))
                np.testing.assert_allclose(position[frame], place[k], rtol=0.0, atol=1e-12, err_msg=name)
                expected = axes[k].reshape(3, 3)
                np.testing.assert_allclose(rotation[frame], expected, rtol=0.0, atol=1e-12, err_msg=name)


MJCF = {
    "default classes, nested, with childclass and class": """
<mujoco>
  <default>
    <joint axis="0 1 0" damping="1"/><geom type="capsule" size="0.02 0.1"/>
    <default class="leg"><joint range="-1 1" axis="1 0 0"/>
      <default class="knee"><joint pos="0 0 0.1"/></default></default>
  </default>
  <worldbody>
    <body name="trunk"><freejoint name="root"/><geom/>
      <body name="thigh" childclass="leg" pos="0 0.1 -0.2"><joint name="hip"/><geom/>
        <body name="shank" pos="0 0 -0.3"><joint name="knee" class="knee"/><geom/>
          <site name="sole" pos="0 0 -0.1"/></body>
      </body>
      <body name="head" pos="0 0 0.3"><joint name="neck"/><geom name="skull" fromto="0 0 0 0.1 0 0.2"/></body>
    </body>
  </worldbody>
</mujoco>""",
    "angles in degrees, an Euler sequence, axis-angle, xy axes and z axis": """
<mujoco>
  <compiler angle="degree" eulerseq="ZYx"/>
  <worldbody>
    <body name="a" euler="20 30 -40"><joint name="ja" axis="0 1 1" ref="15" range="-90 90"/><geom size="0.1"/>
      <body name="b" axisangle="1 2 3 50" pos="0.1 0 0.3"><joint name="jb" range="-10 80"/><geom size="0.1"/>
        <body name="c" xyaxes="0 1 0 1 0 1" pos="0 0.2 0"><joint name="jc" type="ball" range="0 40"/><geom size="0.1"/>
          <site name="s" zaxis="1 1 1" pos="0 0 0.1"/></body>
      </body>
    </body>
  </worldbody>
</mujoco>""",
    "several roots: two robots that move, one that does not, and a loose box": """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <body name="table" pos="1 0 0.5"><geom size="0.2" name="top"/>
      <body name="lamp" pos="0 0 1"><geom size="0.1"/></body></body>
    <body name="left" pos="0 1 0" euler="0 0 45"><joint name="l1"/><geom size="0.1"/>
      <body name="left_hand" pos="0.3 0 0"><joint name="l2" type="slide" axis="1 0 0"/><geom size="0.1"/></body></body>
    <body name="right" pos="0 -1 0"><freejoint name="fly"/><geom size="0.1"/>
      <body name="right_hand" pos="0.3 0 0"><joint name="r1" axis="0 1 0"/><geom size="0.1"/></body></body>
    <body name="box" pos="0 0 2"><freejoint/><geom size="0.1"/></body>
  </worldbody>
</mujoco>""",
    "a mocap body, and an arm welded to it": """
<mujoco>
  <worldbody>
    <body name="target" mocap="true" pos="0.4 0.1 0.6" euler="10 20 30"><site name="goal" pos="0 0 0.1"/></body>
    <body name="arm" pos="0 0 0.2"><joint name="j1"/><geom size="0.1"/>
      <body name="hand" pos="0.3 0 0"><joint name="j2" axis="0 1 0"/><geom size="0.1"/><site name="grip"/></body></body>
  </worldbody>
  <equality><weld body1="target" body2="hand"/></equality>
</mujoco>""",
    "names with slashes, dots, spaces and brackets": """
<mujoco>
  <worldbody>
    <body name="robot/trunk.0"><joint name="robot/j[0]"/><geom name="robot/trunk.0" size="0.1"/>
      <body name="robot/arm 1" pos="0 0 1"><joint name="robot/j*"/><geom size="0.1"/>
        <site name="robot/a/b/c" pos="0 1 0"/></body>
    </body>
  </worldbody>
  <custom><numeric name="velocity_limit/robot/j[0]" data="2.5"/></custom>
</mujoco>""",
    "fused static bodies": """
<mujoco>
  <compiler fusestatic="true"/>
  <worldbody>
    <body name="base" pos="0 0 0.3"><geom size="0.1"/>
      <body name="arm" pos="0 0 0.2"><joint name="j1" axis="0 1 0"/><geom size="0.1"/>
        <body name="tool" pos="0.3 0 0" quat="1 1 0 0"><geom size="0.1" pos="0 0 0.1"/>
          <body name="tip" pos="0 0.1 0.2"><site name="tcp" pos="0 0 0.05"/></body></body></body></body>
  </worldbody>
</mujoco>""",
    "tendons, actuators, sensors and equality constraints of every kind": """
<mujoco>
  <worldbody>
    <site name="anchor" pos="0 0 1"/>
    <body name="a"><joint name="ja" axis="0 1 0"/><geom size="0.1"/><site name="sa"/>
      <body name="b" pos="0.3 0 0"><joint name="jb" axis="0 1 0"/><geom size="0.1"/><site name="sb"/>
        <body name="c" pos="0.3 0 0"><joint name="jc" axis="0 1 0"/><geom size="0.1"/></body></body></body>
  </worldbody>
  <tendon>
    <spatial name="cable"><site site="anchor"/><site site="sb"/></spatial>
    <fixed name="coupling"><joint joint="ja" coef="1"/><joint joint="jb" coef="-1"/></fixed>
  </tendon>
  <equality>
    <connect body1="c" anchor="0.1 0 0"/><weld body1="b" body2="c" active="false"/><tendon tendon1="coupling"/>
    <joint joint1="jb" joint2="ja" polycoef="0.1 0.5 0 0 0"/>
  </equality>
  <actuator><position joint="ja" kp="10"/><motor tendon="cable"/></actuator>
  <sensor><jointpos joint="jb"/><framepos objtype="site" objname="sb"/></sensor>
</mujoco>""",
    "several joints a body, references, anchors, a slide after hinges": """
<mujoco>
  <worldbody>
    <body name="a" pos="0.1 0.2 0.3" quat="1 0.2 0 0.1"><geom size="0.1"/>
      <joint name="x" axis="1 0 0" pos="0 0.1 0"/><joint name="y" axis="0 1 0" ref="20"/>
      <joint name="z" type="slide" axis="0 1 1" ref="0.2"/>
      <body name="b" pos="0 0 0.4"><geom size="0.1"/><joint name="s" type="slide" axis="1 0 0"/>
        <joint name="ball" type="ball" pos="0 0 0.1"/></body></body>
  </worldbody>
</mujoco>""",
    "frames, replicas and a body without a joint between those with": """
<mujoco>
  <worldbody>
    <frame pos="0 0 1" euler="0 90 0">
      <body name="a"><joint name="ja"/><geom size="0.1"/>
        <frame pos="0.1 0 0"><body name="bridge" pos="0 0.1 0"><geom size="0.1"/>
          <frame euler="45 0 0"><body name="b" pos="0 0 0.2"><joint name="jb"/><geom size="0.1"/></body></frame>
        </body></frame>
        <replicate count="3" euler="0 0 60"><site name="mark" pos="0.2 0 0"/></replicate></body>
    </frame>
  </worldbody>
</mujoco>""",
}


@pytest.mark.parametrize("quirk", MJCF)
def test_mjcf_as_mujoco_reads_it(quirk: str):
    text = MJCF[quirk]
    unfused = text.replace('fusestatic="true"', "")  # MuJoCo itself would lose the names
    check_with_mujoco(Robot.from_mjcf(text), mujoco.MjModel.from_xml_string(unfused))


def test_bodies_without_mass_or_inertia():
    """MuJoCo refuses them unless the file itself asks for a least mass."""
    text = """
<mujoco>
  <compiler/>
  <worldbody>
    <body name="a"><joint name="ja"/>
      <body name="b" pos="0 0 0.2"><joint name="jb" axis="1 0 0"/><geom size="0.1"/>
        <body name="c" pos="0 0 0.2"><joint name="jc" axis="0 1 0"/>
          <site name="tip" pos="0.1 0 0"/></body></body></body>
  </worldbody>
</mujoco>"""
    with pytest.raises(ValueError, match="mass and inertia of moving bodies must be larger"):
        mujoco.MjModel.from_xml_string(text)
    least = text.replace("<compiler/>", '<compiler boundmass="1e-14" boundinertia="1e-14"/>')
    robot = Robot.from_mjcf(text)
    check_with_mujoco(robot, mujoco.MjModel.from_xml_string(least))
    assert float(robot.body_mass.sum()) == pytest.approx(4000.0 / 3.0 * np.pi * 1e-3, rel=1e-12)


def test_a_body_that_moves_without_mass_keeps_the_files_own_least_mass():
    text = '<mujoco><compiler boundmass="0.5"/><worldbody><body name="a"><joint/><geom size="0.1"/>'
    robot = Robot.from_mjcf(f'{text}<body name="b"><joint/></body></body></worldbody></mujoco>')
    np.testing.assert_allclose(robot.body_mass[2], 0.5)


@pytest.mark.parametrize(
    ("compiler", "joint", "expected"),
    [
        ('angle="radian"', "", (-1.0, 1.0)),
        ('angle="radian" autolimits="false"', 'limited="true"', (-1.0, 1.0)),
        ('angle="radian" autolimits="false"', 'limited="false"', (-np.inf, np.inf)),
        ("", "", (-np.pi / 180.0, np.pi / 180.0)),
    ],
)
def test_limits_by_the_compilers_settings(compiler: str, joint: str, expected: tuple[float, float]):
    robot = Robot.from_mjcf(
        f'<mujoco><compiler {compiler}/><worldbody><body><joint name="j" range="-1 1" {joint}/>'
        '<joint name="free" axis="1 0 0"/><geom size="0.1"/></body></worldbody></mujoco>'
    )
    np.testing.assert_allclose([robot.position_lower[0], robot.position_upper[0]], expected, rtol=1e-15)
    assert (float(robot.position_lower[1]), float(robot.position_upper[1])) == (-np.inf, np.inf)


def test_included_files_and_meshes_that_are_not_there(tmp_path: Path):
    """As Menagerie's scenes do: the robot in a file of its own, meshes by class and without names, in a folder."""
    parts = tmp_path / "parts"
    parts.mkdir()
    (parts / "arm.xml").write_text("""
<mujoco>
  <compiler meshdir="assets" texturedir="assets" autolimits="true"/>
  <default><default class="visual"><geom type="mesh" contype="0" group="2"/></default></default>
  <asset><mesh file="link/upper.obj"/><mesh file="lower.stl" scale="0.001 0.001 0.001"/>
    <texture type="2d" file="wood.png"/><material name="wood" texture="wood"/></asset>
  <worldbody>
    <body name="upper"><inertial pos="0 0 0.1" mass="1" diaginertia="1 1 1"/><joint name="j1" range="-1 1"/>
      <geom class="visual" mesh="upper" material="wood"/><geom name="hull" size="0.05" pos="0 0 0.1"/>
      <body name="lower" pos="0 0 0.3"><inertial pos="0 0 0.1" mass="1" diaginertia="1 1 1"/>
        <joint name="j2" axis="1 0 0"/>
        <geom class="visual" mesh="lower"/></body></body>
  </worldbody>
  <keyframe><key name="home" qpos="0.01 -0.5"/></keyframe>
</mujoco>""")
    scene = (
        '<mujoco><include file="parts/arm.xml"/><worldbody><geom name="floor" type="plane" size="1 1 1"/></worldbody>'
    )
    (tmp_path / "scene.xml").write_text(f"{scene}</mujoco>")
    robot = Robot.from_mjcf(tmp_path / "scene.xml")
    assert set(robot.frame_names) == {"world", "upper", "lower", "hull", "floor"}
    np.testing.assert_array_equal(robot.q0, [0.01, -0.5])
    (tmp_path / "missing.xml").write_text('<mujoco><include file="nowhere.xml"/></mujoco>')
    with pytest.raises(ValueError, match=r"missing.xml: .*nowhere.xml"):
        Robot.from_mjcf(tmp_path / "missing.xml")


def test_keyframes_with_quaternions_that_are_not_unit():
    keys = '<keyframe><key time="1" qpos="0 0 1 2 0 0 2"/><key name="other"/></keyframe>'
    body = '<worldbody><body name="a"><freejoint/><geom size="1"/></body></worldbody>'
    robot = Robot.from_mjcf(f"<mujoco>{body}{keys}</mujoco>")
    np.testing.assert_allclose(robot.q0, [0, 0, 1, np.sqrt(0.5), 0, 0, np.sqrt(0.5)], rtol=1e-15)


# --- URDF ---

INERTIAL = (
    '<inertial><origin xyz="0.01 0.02 0.03"/><mass value="1.5"/>'
    '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>'
)
MESH = '<{0}><geometry><mesh filename="{1}" scale="1 2 1"/></geometry></{0}>'


def joint(name: str, kind: str, parent: str, child: str, inner: str = '<axis xyz="0 0 1"/>') -> str:
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="0.1 0 0.2" rpy="0.1 0.2 0.3"/><parent link="{parent}"/>'
        f'<child link="{child}"/><limit lower="-1" upper="2" velocity="3" effort="1"/>{inner}</joint>'
    )


def check_with_pinocchio(text: str) -> Robot:
    """Every link of a fixed-base URDF is a frame where Pinocchio has it, followers and continuous joints included."""
    robot, model = Robot.from_urdf(text, floating_base=False), pin.buildModelFromXML(text)
    data, rng = model.createData(), np.random.default_rng(3)
    links = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    assert set(links) <= set(robot.frame_names)
    for _ in range(CONFIGURATIONS):
        q = random_configuration(robot, rng)
        full = dict(zip(robot.tree.joint_names, np.asarray(robot.mujoco_qpos(jnp.asarray(q))), strict=True))
        theirs = pin.neutral(model)
        for name, one in list(zip(model.names, model.joints, strict=True))[1:]:
            value = full[name]
            theirs[one.idx_q : one.idx_q + one.nq] = [np.cos(value), np.sin(value)] if one.nq == 2 else [value]
        pin.framesForwardKinematics(model, data, theirs)
        position, rotation, com = map(np.asarray, poses(robot, jnp.asarray(q)))
        for link in links:
            place, frame = data.oMf[model.getFrameId(link)], robot.tree.frame(link)
            np.testing.assert_allclose(position[frame], place.translation, rtol=0.0, atol=1e-12, err_msg=link)
            np.testing.assert_allclose(rotation[frame], place.rotation, rtol=0.0, atol=1e-12, err_msg=link)
        np.testing.assert_allclose(com, pin.centerOfMass(model, data, theirs), rtol=0.0, atol=1e-12)
    return robot


def test_urdf_as_pinocchio_reads_it():
    """In one file: slashes, meshes in packages that nobody has, links without inertia, chains of fixed joints before
    and after moving ones, continuous joints and followers of them, axes that are not unit, mass without inertia."""
    visual = MESH.format("visual", "package://nowhere/meshes/a.dae") + MESH.format("collision", "package://no/b.stl")
    weightless = '<inertial><mass value="0.3"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial>'
    text = f"""<?xml version="1.0" encoding="utf-8"?>
<robot name="r">
  <link name="robot/base">{INERTIAL}{visual}</link><link name="robot/a">{INERTIAL}{visual}</link>
  <link name="bare"/><link name="tool0"/><link name="robot/b">{INERTIAL}</link><link name="c">{weightless}</link>
  <link name="tool/tip"/>
  {joint("fixed/0", "fixed", "robot/base", "bare", "")}
  {joint("robot/j1", "continuous", "bare", "robot/a", '<axis xyz="0 2 2"/>')}
  {joint("fixed/1", "fixed", "robot/a", "tool0", "")}
  {joint("j/2", "revolute", "tool0", "robot/b")}
  {joint("slide", "prismatic", "robot/b", "c", '<axis xyz="1 1 0"/>')}
  {joint("fixed/2", "fixed", "c", "tool/tip", "")}
</robot>"""
    robot = check_with_pinocchio(text)
    assert robot.joint_names == ("robot/j1", "j/2", "slide")
    np.testing.assert_array_equal(robot.position_lower, [-np.inf, -1.0, -1.0])
    np.testing.assert_array_equal(robot.velocity_limit, [3.0, 3.0, 3.0])
    mimic = '<axis xyz="0 0 1"/><mimic joint="robot/j1" multiplier="-2" offset="0.1"/>'
    follower = joint("follower", "continuous", "robot/base", "e", mimic)
    again = check_with_pinocchio(text.replace("</robot>", f'<link name="e">{INERTIAL}</link>{follower}</robot>'))
    assert again.mimic_joints == {"follower": ("robot/j1", -2.0)}
    assert Robot.from_urdf(text, floating_base=True, velocity_limits={"*/*": 1.0}).velocity_limit[6:].tolist() == [
        1.0,
        1.0,
        3.0,
    ]


def test_two_roots_are_named():
    links = f'<link name="a">{INERTIAL}</link><link name="b"/><link name="lost"/>'
    text = f'<robot name="r">{links}{joint("j", "revolute", "a", "b")}</robot>'
    with pytest.raises(ValueError, match=r"2 links have no parent, one has to be the root: a, lost"):
        Robot.from_urdf(text)


CORNERS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
FACES = ((1, 3, 2), (1, 2, 4), (1, 4, 3), (2, 3, 4))
TETRAHEDRON = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "".join(f"f {a} {b} {c}\n" for a, b, c in FACES)


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A ROS package ``bot_description`` with a URDF and two meshes in a folder ``ws``."""
    package = tmp_path / "ws" / "bot_description"
    (package / "urdf").mkdir(parents=True)
    (package / "meshes").mkdir()
    for name in ("hull.obj", "other.obj"):
        (package / "meshes" / name).write_text(TETRAHEDRON)
    shapes = MESH.format("collision", "package://bot_description/meshes/hull.obj") + MESH.format("visual", "no.dae")
    relative = MESH.format("collision", "../meshes/other.obj")
    (package / "urdf" / "bot.urdf").write_text(
        f'<robot name="bot"><link name="base">{INERTIAL}{shapes}</link>'
        f'<link name="tip">{INERTIAL}{shapes}{relative}</link>'
        f"{joint('j', 'revolute', 'base', 'tip')}</robot>"
    )
    return package


def vertices(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """The corners of a mesh in its body's frame."""
    mesh = model.geom_dataid[geom]
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    return model.mesh_vert[start : start + count] @ rotation.reshape(3, 3).T + model.geom_pos[geom]


def test_collision_meshes_are_read_where_asked_for(package: Path):
    path = package / "urdf" / "bot.urdf"
    assert Robot.from_urdf(path, floating_base=False).mj_model.ngeom == 0
    robot = Robot.from_urdf(path, floating_base=False, collision_meshes=True)
    model = robot.mj_model
    assert (model.ngeom, model.nmesh) == (3, 2)
    corners = np.array(CORNERS, float) * [1.0, 2.0, 1.0]
    for geom in range(3):
        ours = vertices(model, geom)
        np.testing.assert_allclose(ours[np.lexsort(ours.T.round(3))], corners[np.lexsort(corners.T)], atol=1e-6)
    assert model.body_mass.sum() == 3.0


@pytest.mark.parametrize("slash", ["", "/"])
@pytest.mark.parametrize("where", ["given", "itself", "ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"])
def test_packages_are_found(package: Path, where: str, slash: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    address, folders = f"package://{slash}bot_description/urdf/bot.urdf", ()
    with pytest.raises(FileNotFoundError, match=r"no file 'package:///?bot_description/.*package_dirs.*\(nowhere\)"):
        Robot.from_urdf(address)
    if where in ("given", "itself"):
        folders = ("/not/there", package if where == "itself" else package.parent)
    elif where == "ROS_PACKAGE_PATH":
        monkeypatch.setenv(where, f"/not/there:{package.parent}")
    else:
        share = package.parent.parent / "install" / "share"
        share.mkdir(parents=True)
        package.rename(share / package.name)
        monkeypatch.setenv(where, f"/not/there:{share.parent}")
    robot = Robot.from_urdf(address, package_dirs=folders, floating_base=False, collision_meshes=True)
    assert (robot.joint_names, robot.mj_model.ngeom) == (("j",), 3)


@pytest.mark.parametrize(
    ("old", "new", "error", "message"),
    [
        (
            "../meshes/other.obj",
            "file:///not/there.stl",
            FileNotFoundError,
            r"no file 'file:.*Looked for: /not/there.stl",
        ),
        ("../meshes/other.obj", "other.obj", FileNotFoundError, r"no file 'other.obj'. Looked for: .*/urdf/other.obj"),
        ("bot_description/m", "bot/m", FileNotFoundError, r"no file 'package://bot/m.*name the folder of the package"),
        (
            "../meshes/other.obj",
            "bot.urdf",
            ValueError,
            r"link 'tip': the mesh .*bot.urdf' is of no kind .*\.dae, \.stl",
        ),
    ],
)
def test_meshes_that_cannot_be_read_are_named(package: Path, old: str, new: str, error: type, message: str):
    path = package / "urdf" / "bot.urdf"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(error, match=message):
        Robot.from_urdf(path, collision_meshes=True)


def corners_of_stl(path: Path) -> np.ndarray:
    """All corners of all triangles of a binary STL file."""
    triangle = np.dtype([("normal", "<3f4"), ("corners", "<9f4"), ("flags", "<u2")])
    return np.fromfile(path, triangle, offset=84)["corners"].reshape(-1, 3).astype(float)


def test_collision_meshes_of_a_known_robot():
    """Every STL of a G1 lies in its link's frame where the URDF puts it: the same box around its corners."""
    (file,) = (f for f in importlib.metadata.files("example-robot-data") or [] if f.name == "g1_29dof_rev_1_0.urdf")
    path = Path(str(file.locate()))
    model = Robot.from_urdf(path, floating_base=False, collision_meshes=True).mj_model
    geoms = iter(np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH).tolist())
    shapes = ElementTree.parse(path).getroot().findall("link/collision")
    meshes = [(shape, mesh) for shape in shapes if (mesh := shape.find("geometry/mesh")) is not None]
    assert len(meshes) > 20
    for shape, mesh in meshes:
        name = mesh.get("filename", "").rpartition("/")[2]
        origin = {} if (element := shape.find("origin")) is None else element.attrib
        position, angles = (np.fromstring(origin.get(key, "0 0 0"), sep=" ") for key in ("xyz", "rpy"))
        rotation = Rotation.from_euler("xyz", angles).as_matrix()
        expected = corners_of_stl(path.parent.parent / "meshes" / name) @ rotation.T + position
        ours = vertices(model, next(geoms))
        np.testing.assert_allclose([ours.min(0), ours.max(0)], [expected.min(0), expected.max(0)], atol=1e-5)


def test_package_dirs_is_no_string():
    with pytest.raises(TypeError, match=r"package_dirs is a sequence of folders, not one string: use \('/opt',\)"):
        Robot.from_urdf("package://a/b.urdf", package_dirs="/opt")
