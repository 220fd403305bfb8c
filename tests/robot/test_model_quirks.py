"""What real robot files do: each quirk in a small file, against MuJoCo C and Pinocchio at random configurations."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pinocchio as pin
import pytest
from example_files import example_file
from frames_beside_mujoco import assert_as_in_mujoco, poses, random_configurations
from model_files import MJCF, mjcf
from refusals import refuses
from scipy.spatial.transform import Rotation
from urdfs import INERTIAL, joint

from osik_jax import Robot
from osik_jax.collision import robot_shapes
from osik_jax.robot.loading._meshes import unread_points


@pytest.mark.parametrize("quirk", sorted(path.stem for path in (MJCF / "quirks").glob("*.xml")))
def test_mjcf_as_mujoco_reads_it(quirk: str):
    text = mjcf(f"quirks/{quirk}")
    unfused = text.replace('fusestatic="true"', "")  # MuJoCo itself would lose the names
    assert_as_in_mujoco(Robot.from_mjcf(text), mujoco.MjModel.from_xml_string(unfused))


def test_bodies_without_mass_or_inertia():
    """MuJoCo refuses them unless the file itself asks for a least mass."""
    text = mjcf("weightless")
    refuses(ValueError, "mass and inertia of moving bodies must be larger", mujoco.MjModel.from_xml_string, text)
    least = text.replace("<compiler/>", '<compiler boundmass="1e-14" boundinertia="1e-14"/>')
    robot = Robot.from_mjcf(text)
    assert_as_in_mujoco(robot, mujoco.MjModel.from_xml_string(least))
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


def test_included_files_and_meshes_that_are_not_there():
    """As Menagerie's scenes do: the robot in a file of its own, meshes by class and without names, in a folder."""
    robot = Robot.from_mjcf(MJCF / "scene" / "scene.xml")
    assert set(robot.frame_names) == {"world", "upper", "lower", "hull", "floor"}
    np.testing.assert_array_equal(robot.q0, [0.01, -0.5])


def test_keyframes_with_quaternions_that_are_not_unit():
    keys = '<keyframe><key time="1" qpos="0 0 1 2 0 0 2"/><key name="other"/></keyframe>'
    body = '<worldbody><body name="a"><freejoint/><geom size="1"/></body></worldbody>'
    robot = Robot.from_mjcf(f"<mujoco>{body}{keys}</mujoco>")
    np.testing.assert_allclose(robot.q0, [0, 0, 1, np.sqrt(0.5), 0, 0, np.sqrt(0.5)], rtol=1e-15)


# --- URDF ---

MESH = '<{0}><geometry><mesh filename="{1}" scale="1 2 1"/></geometry></{0}>'


def check_with_pinocchio(text: str) -> Robot:
    """Every link of a fixed-base URDF is a frame where Pinocchio has it, followers and continuous joints included."""
    robot, model = Robot.from_urdf(text, floating_base=False), pin.buildModelFromXML(text)
    data = model.createData()
    links = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    assert set(links) <= set(robot.frame_names)
    qs = random_configurations(robot)
    for q, position, rotation, com in zip(qs, *map(np.asarray, poses(robot, jnp.asarray(qs))), strict=True):
        full = dict(zip(robot.tree.joint_names, np.asarray(robot.mujoco_qpos(jnp.asarray(q))), strict=True))
        theirs = pin.neutral(model)
        for name, one in list(zip(model.names, model.joints, strict=True))[1:]:
            value = full[name]
            theirs[one.idx_q : one.idx_q + one.nq] = [np.cos(value), np.sin(value)] if one.nq == 2 else [value]
        pin.framesForwardKinematics(model, data, theirs)
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
  {joint("fixed/0", "robot/base", "bare", kind="fixed")}
  {joint("robot/j1", "bare", "robot/a", kind="continuous", axis="0 2 2")}
  {joint("fixed/1", "robot/a", "tool0", kind="fixed")}
  {joint("j/2", "tool0", "robot/b")}
  {joint("slide", "robot/b", "c", kind="prismatic", axis="1 1 0")}
  {joint("fixed/2", "c", "tool/tip", kind="fixed")}
</robot>"""
    robot = check_with_pinocchio(text)
    assert robot.joint_names == ("robot/j1", "j/2", "slide")
    np.testing.assert_array_equal(robot.position_lower, [-np.inf, -1.0, -1.0])
    np.testing.assert_array_equal(robot.velocity_limit, [3.0, 3.0, 3.0])
    mimic = '<mimic joint="robot/j1" multiplier="-2" offset="0.1"/>'
    follower = joint("follower", "robot/base", "e", mimic, "continuous")
    again = check_with_pinocchio(text.replace("</robot>", f'<link name="e">{INERTIAL}</link>{follower}</robot>'))
    assert again.mimic_joints == {"follower": ("robot/j1", -2.0)}
    slow = Robot.from_urdf(text, floating_base=True, velocity_limits={"*/*": 1.0})
    assert slow.velocity_limit[6:].tolist() == [1.0, 1.0, 3.0]


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
        f"{joint('j', 'base', 'tip')}</robot>"
    )
    return package


def vertices(robot: Robot, geom: int) -> np.ndarray:
    """The corners of a mesh in its link's frame."""
    mesh = robot.holder.meshes[geom - robot.mj_model.ngeom]
    return unread_points(mesh) @ np.array(mesh.rotation).T + mesh.position


def test_collision_meshes_are_placed_and_scaled(package: Path):
    robot = Robot.from_urdf(package / "urdf" / "bot.urdf", floating_base=False)
    assert (robot.mj_model.ngeom, len(robot.tree.geom_names)) == (0, 3)
    corners = np.array(CORNERS, float) * [1.0, 2.0, 1.0]
    for geom in range(3):
        ours = vertices(robot, geom)
        np.testing.assert_allclose(ours[np.lexsort(ours.T.round(3))], corners[np.lexsort(corners.T)], atol=1e-6)


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
    robot = Robot.from_urdf(address, package_dirs=folders, floating_base=False)
    assert robot.joint_names == ("j",) and all(len(vertices(robot, geom)) == 4 for geom in range(3))


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
            r"the collision mesh of tip.*bot.urdf: a mesh has to be one of \.dae, \.stl",
        ),
    ],
)
def test_meshes_that_cannot_be_read_are_named(package: Path, old: str, new: str, error: type, message: str):
    path = package / "urdf" / "bot.urdf"
    path.write_text(path.read_text().replace(old, new))
    refuses(error, message, robot_shapes, Robot.from_urdf(path, floating_base=False))


def corners_of_stl(path: Path) -> np.ndarray:
    """All corners of all triangles of a binary STL file."""
    triangle = np.dtype([("normal", "<3f4"), ("corners", "<9f4"), ("flags", "<u2")])
    return np.fromfile(path, triangle, offset=84)["corners"].reshape(-1, 3).astype(float)


def test_collision_meshes_of_a_known_robot():
    """Every STL of a G1 lies in its link's frame where the URDF puts it: the same box around its corners."""
    path = example_file("g1_description/urdf/g1_29dof_rev_1_0.urdf")
    robot = Robot.from_urdf(path, floating_base=False)
    geoms = iter(range(robot.mj_model.ngeom, len(robot.tree.geom_names)))
    shapes = ElementTree.parse(path).getroot().findall("link/collision")
    meshes = [(shape, mesh) for shape in shapes if (mesh := shape.find("geometry/mesh")) is not None]
    assert len(meshes) > 20
    for shape, mesh in meshes:
        name = mesh.get("filename", "").rpartition("/")[2]
        origin = {} if (element := shape.find("origin")) is None else element.attrib
        position, angles = (np.fromstring(origin.get(key, "0 0 0"), sep=" ") for key in ("xyz", "rpy"))
        rotation = Rotation.from_euler("xyz", angles).as_matrix()
        expected = corners_of_stl(path.parent.parent / "meshes" / name) @ rotation.T + position
        ours = vertices(robot, next(geoms))
        np.testing.assert_allclose([ours.min(0), ours.max(0)], [expected.min(0), expected.max(0)], atol=1e-5)


def test_package_dirs_is_no_string():
    with pytest.raises(TypeError, match=r"package_dirs is a sequence of folders, not one string: use \('/opt',\)"):
        Robot.from_urdf("package://a/b.urdf", package_dirs="/opt")
