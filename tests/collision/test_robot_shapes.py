"""Collision shapes of a robot beside Pinocchio's, and the pairs of them that are kept apart."""

import mujoco
import numpy as np
import pytest
import urdfs
from example_files import example_file
from refusals import no_warnings, refuses
from robot_support import beside_pinocchio, directions, table_support

import osik_jax as osik
from osik_jax.collision._robot_shapes import robot_shapes
from osik_jax.collision._table import ShapeKind
from osik_jax.robot.loading._named import EXAMPLES
from osik_jax.robot.loading._srdf import read_srdf


def ball(link: str, place: str = "0 0 0", radius: float = 0.05) -> str:
    shape = f'<origin xyz="{place}"/><geometry><sphere radius="{radius}"/></geometry>'
    return urdfs.link(link, f"{urdfs.INERTIAL}<visual>{shape}</visual><collision>{shape}</collision>")


def hinge(name: str, parent: str, child: str) -> str:
    return urdfs.joint(name, parent, child, origin='xyz="0 0 .2"', axis="0 1 0")


def chain(*balls: str, **options) -> osik.Robot:
    joints = [hinge(f"j{k}", "abcd"[k], "abcd"[k + 1]) for k in range(3)]
    return osik.Robot.from_urdf(urdfs.urdf(*balls, *joints), floating_base=False, **options)


def named_pairs(shapes) -> set[str]:
    return {f"{shapes.links[i]}{shapes.links[j]}" for i, j in shapes.pairs}


SRDF = """<robot name="r">
  <group name="arm"><chain base_link="a" tip_link="d"/></group>
  <group name="all"><group name="arm"/><joint name="j1"/></group>
  <group_state name="home" group="arm"><joint name="j1" value="0.5"/></group_state>
  <group_state name="home" group="all"><joint name="j2" value="-1"/><joint name="base" value="0 0 0"/></group_state>
  <disable_collisions link1="d" link2="b" reason="Never"/><disable_collisions link1="a" link2="tool0"/>
</robot>"""


@pytest.mark.parametrize("name", ["panda", "ur5", "baxter", pytest.param("g1", marks=pytest.mark.slow)])
@pytest.mark.filterwarnings("ignore:these pairs touch")
def test_all_shapes_of_a_urdf_are_those_of_pinocchio(name: str):
    robot, urdf = osik.load_robot(name), example_file(EXAMPLES[name][0])
    shapes = robot_shapes(robot)
    count, difference = beside_pinocchio(robot, shapes, urdf)
    assert count == len(shapes.names) == len(set(shapes.names)) and difference < 1e-6
    assert robot_shapes(robot) is shapes


def test_meshes_of_the_model_are_whole_although_mujoco_thins_its_hulls():
    points = directions(300)
    text = (
        f'<mujoco><asset><mesh name="m" vertex="{" ".join(map(str, points.ravel()))}" maxhullvert="20"/></asset>'
        '<worldbody><body name="b"><joint name="j"/><geom type="mesh" mesh="m" pos=".1 0 0" euler="0 0 30"/>'
        '<geom type="ellipsoid" size=".3 .1 .2"/><geom type="sphere" size="1" contype="0" conaffinity="0"/>'
        "</body></worldbody></mujoco>"
    )
    shapes = robot_shapes(osik.Robot.from_mjcf(text))
    assert shapes.names == ("b:0", "b:1")
    ways, turn = directions(500), np.zeros(9)
    mujoco.mju_quat2Mat(turn, np.array([np.cos(np.pi / 12), 0, 0, np.sin(np.pi / 12)]))
    wanted = (ways @ turn.reshape(3, 3) @ points.T).max(1) + ways @ [0.1, 0, 0]
    np.testing.assert_allclose(table_support(shapes.table, 0, ways), wanted, atol=2e-7)
    excess = table_support(shapes.table, 1, ways) - np.linalg.norm(ways * [0.3, 0.1, 0.2], axis=1)
    assert excess.min() > -1e-8 and excess.max() < 0.005 * 0.3


def test_planes_and_shapes_fixed_to_the_world_do_not_meet_a_scene():
    text = (
        '<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1" euler="0 90 0"/>'
        '<body name="base" pos="1 0 0"><geom type="box" size=".1 .1 .1"/>'
        '<body name="arm"><joint name="j"/><geom type="capsule" size=".1 .2" pos="0 .2 0"/></body>'
        '<body name="locked" pos=".2 0 0"><joint name="k"/><geom type="sphere" size=".1"/></body>'
        "</body></worldbody></mujoco>"
    )
    shapes = robot_shapes(osik.Robot.from_mjcf(text, locked_joints=["k"]))
    row = shapes.names.index("floor")
    assert shapes.table.kind[row] == ShapeKind.HALF_SPACE
    np.testing.assert_allclose(shapes.table.rotation[row][:, 2], [1, 0, 0], atol=1e-7)
    assert [name for name, meets in zip(shapes.names, shapes.world, strict=True) if meets] == ["arm:0"]
    assert named_pairs(shapes) == {"worldarm"}


def test_an_srdf_allows_pairs_and_has_groups_and_states():
    rules = read_srdf(SRDF)
    assert rules.groups == {"arm": ("a to d",), "all": ("arm", "j1")}
    assert rules.states == {"home": {"j1": 0.5, "j2": -1.0}}
    robot = chain(*map(ball, "abcd"))
    assert named_pairs(robot_shapes(robot)) == {"ac", "ad", "bd"}
    with pytest.warns(osik.OsikWarning, match="names 1 links that the robot lacks; they are passed over: tool0"):
        assert named_pairs(robot_shapes(robot, SRDF)) == {"ac", "ad"}
    untested = '<robot name="r"><disable_default_collisions link="d"/><enable_collisions link1="d" link2="a"/></robot>'
    assert named_pairs(robot_shapes(robot, read_srdf(untested))) == {"ac", "ad"}
    refuses(
        ValueError, "the XML text: a <group> lacks the attribute 'name'", read_srdf, '<robot name="r"><group/></robot>'
    )


@pytest.mark.filterwarnings("ignore:these pairs touch")
@pytest.mark.parametrize("name", ["panda", "ur5", "baxter"])
def test_the_srdf_of_a_known_robot_is_found(name: str):
    robot = osik.load_robot(name)
    path = {"ur5": "srdf/ur5.srdf", "baxter": "srdf/baxter_manipulation.srdf"}.get(name, f"srdf/{name}.srdf")
    found = robot_shapes(robot, srdf=True)
    assert np.array_equal(found.pairs, robot_shapes(robot, example_file(path)).pairs)
    assert 0 < len(found.pairs) < len(robot_shapes(robot).pairs)


def test_no_srdf_is_guessed():
    refuses(FileNotFoundError, r"give srdf=PATH. SRDFs there: \(none\)", robot_shapes, osik.load_robot("g1"), True)
    refuses(FileNotFoundError, "needs a robot read from a URDF", robot_shapes, chain(*map(ball, "abcd")), True)


def test_pairs_that_always_touch_are_told_and_rare_contacts_are_kept():
    # the ball on c is up to 0.537 m from the middle of the ball on a, within the limits of the joints between them
    balls = [ball("a"), ball("b"), ball("d")]
    with pytest.warns(osik.OsikWarning, match="touch in each of 1001 configurations.*: a:0-c:0. If they"):
        shapes = robot_shapes(chain(*balls, ball("c", "0 0 -.2", 0.49)))
    assert shapes.touching == (("a:0", "c:0"),) and named_pairs(shapes) == {"ad", "bd"}
    with no_warnings():
        assert "ac" in named_pairs(robot_shapes(chain(*balls, ball("c", "0 0 -.2", 0.47))))


def test_what_has_no_shapes_is_refused():
    refuses(ValueError, "the robot has no collision shape: a URDF needs", robot_shapes, osik.load_robot("arm7"))
    lost = '<collision><geometry><mesh filename="package://lost/a.stl"/></geometry></collision>'
    robot = chain(urdfs.link("a", urdfs.INERTIAL + lost), *map(ball, "bcd"))
    refuses(FileNotFoundError, "the collision mesh of a:0.*package_dirs", robot_shapes, robot)
