"""What a file asks for and a robot does not keep: reported element by element, and in one warning."""

import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from refusals import refuses
from urdfs import INERTIAL

import osik_jax as osik
from osik_jax import Robot
from osik_jax.collision import robot_shapes

ARM = """<mujoco>{head}<worldbody>
  <body name="first"><joint name="a" axis="0 1 0" range="-90 90" {a}/><geom name="one" size=".1" {geom}/>
    <body name="second" pos="0 0 .3"><joint name="b" axis="0 1 0" range="-90 90"/><geom name="two" size=".1"/>
      <site name="end" pos="0 0 .3"/></body></body>
  <body name="other" pos="1 0 0"><joint name="c" axis="0 1 0"/>
    <geom name="three" size=".1" contype="0" conaffinity="0"/></body>
</worldbody>{more}</mujoco>"""
TIED = '<equality><{} name="e" {}/></equality>'
FIXED = '<tendon><fixed name="t" {}><joint joint="a" coef="1"/><joint joint="b" coef="-1"/></fixed></tendon>'


def loaded(load, *args, **options) -> tuple[Robot, list[str]]:
    """The robot and the warnings about its report."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        robot = load(*args, **options)
    return robot, [str(w.message) for w in seen if "does not keep" in str(w.message)]


def notes(robot: Robot) -> set[tuple[str, str]]:
    return {(note.element, note.name) for note in robot.load_report}


def assert_named(robot: Robot, told: list[str], expected: tuple[str, str] | None) -> None:
    """The report and the one warning name this element and no other; without one there is neither."""
    assert notes(robot) == ({expected} if expected else set())
    assert len(told) == bool(expected)
    if expected:
        assert f"{expected[0]} {expected[1]!r}: " in told[0]
    else:
        assert str(robot.load_report) == "everything in the file that constrains motion is kept"


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        (dict(more=FIXED.format("") + '<equality><tendon name="e" tendon1="t"/></equality>'), ("tendon equality", "e")),
        (dict(more=FIXED.format('limited="true" range="0 1"')), ("tendon range", "t")),
        (dict(more=FIXED.format("") + '<actuator><motor name="m" tendon="t"/></actuator>'), ("tendon actuator", "t")),
        (dict(more=TIED.format("connect", 'body1="second" body2="other" anchor="0 0 0"')), ("connect equality", "e")),
        (dict(more=TIED.format("weld", 'body1="second" body2="other"')), ("weld equality", "e")),
        (dict(more=TIED.format("joint", 'joint1="a" joint2="b" polycoef="0 1 2 0 0"')), ("joint equality", "e")),
        (dict(more='<keyframe><key name="k" qpos="2 0 0"/></keyframe>'), ("keyframe", "k")),
        # kept, or a force
        (dict(a='damping="3" frictionloss="1" armature="0.1" actuatorfrclimited="true" actuatorfrcrange="-1 1"'), None),
        (dict(more='<actuator><motor joint="a" ctrlrange="-1 1" forcerange="-2 2"/></actuator>'), None),
        (dict(more='<actuator><position joint="a" ctrlrange="-1 1"/></actuator>', geom='margin="0.02"'), None),
        (dict(more='<equality><joint joint1="a" joint2="b" polycoef="0 2 0 0 0"/></equality>'), None),
        (dict(more='<equality><weld body1="second" body2="other" active="false"/></equality>'), None),
        (dict(more='<contact><exclude body1="first" body2="other"/><pair geom1="one" geom2="two"/></contact>'), None),
        (dict(more='<keyframe><key qpos="1 0 0"/></keyframe>'), None),
    ],
)  # fmt: skip
def test_each_element_of_an_mjcf_is_named(parts: dict[str, str], expected: tuple[str, str] | None):
    robot, told = loaded(Robot.from_mjcf, ARM.format_map(dict(head="", a="", geom="", more="") | parts))
    assert_named(robot, told, expected)


def test_embedded_robots_keep_everything():
    for name in ("nao", "arm7"):
        robot, told = loaded(osik.load_robot, name)
        assert (robot.load_report, told) == ((), [])


def test_geoms_without_their_files_are_named():
    text = """<mujoco><asset><mesh name="hull" file="nowhere.stl"/></asset><worldbody><body><joint/>
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><geom name="shell" type="mesh" mesh="hull"/>
      <geom name="drawn" type="mesh" mesh="hull" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""
    robot, told = loaded(Robot.from_mjcf, text)
    assert notes(robot) == {("geom", "shell")} and "nowhere.stl" in told[0]


# --- URDF ---


def urdf(limit: str = 'lower="-1" upper="1" velocity="2"', *, joint: str = "", more: str = "", kind="revolute") -> str:
    return f"""<robot name="r"><link name="base">{INERTIAL}</link><link name="l1">{INERTIAL}</link>
      <link name="l2">{INERTIAL}</link><link name="tip"/>
      <joint name="a" type="{kind}"><parent link="base"/><child link="l1"/><axis xyz="0 1 0"/>
        <limit {limit}/>{joint}</joint>
      <joint name="b" type="revolute"><parent link="l1"/><child link="l2"/><origin xyz="1 0 0"/><axis xyz="0 1 0"/>
        <limit lower="-1" upper="1" velocity="2"/></joint>
      <joint name="t" type="fixed"><parent link="l2"/><child link="tip"/><origin xyz="1 0 0"/></joint>{more}</robot>"""


def test_balanced_moments_of_inertia_are_named_with_their_change():
    """MuJoCo uses the mean of moments that no body has; the masses are the file's."""
    flat = '<inertial><mass value="3.5"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="4"/></inertial>'
    text = urdf().replace(f'<link name="l1">{INERTIAL}', f'<link name="l1">{flat}')
    robot, told = loaded(Robot.from_urdf, text, floating_base=False)
    (note,) = robot.load_report
    assert (note.element, note.name) == ("inertia", "l1")
    assert "1 1 4 kg m^2" in note.done and "2 2 2 are used, 2 kg m^2 away" in note.done
    assert told == [] and robot.body_mass[robot.body_names.index("l1") + 1] == 3.5
    model = pin.buildModelFromXML(text.replace("velocity=", 'effort="1" velocity='))
    np.testing.assert_allclose(sorted(np.linalg.eigvalsh(model.inertias[1].inertia)), [1.0, 1.0, 4.0], atol=1e-12)


def test_a_file_without_masses_is_kinematics_alone():
    bare = urdf().replace(INERTIAL, "")
    robot, told = loaded(Robot.from_urdf, bare, floating_base=False)
    assert notes(robot) == {("inertial", "l1; l2; tip")}
    assert "nothing that moves has a mass" in told[0]
    whole = Robot.from_urdf(urdf(), floating_base=False)
    q = whole.configuration({"a": 0.3})
    for frame in ("l2", "tip"):
        ours, theirs = (osik.forward_kinematics(one, q).frame_pose(one, frame)[0] for one in (robot, whole))
        np.testing.assert_allclose(ours, theirs, atol=1e-12)
    found = jax.eval_shape(lambda place: osik.inverse_kinematics(robot, {"l2": place}, seeds=4, restarts=0).q, ours)
    assert found.shape == (robot.nq,)
    for task in (osik.ComTask, osik.KineticEnergyTask, osik.AngularMomentumTask):
        refuses(ValueError, "the robot has no mass, so it has no centre of mass", task, robot)
    kinematics = osik.forward_kinematics(robot, q)
    for function in (osik.center_of_mass, osik.centroidal_momentum_matrix):
        refuses(ValueError, "the robot has no mass", function, robot, kinematics)


SAFETY = '<safety_controller k_velocity="1" k_position="1" soft_lower_limit="{}" soft_upper_limit="{}"/>'


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (urdf('lower="-1" upper="1" velocity="2" jerk="9"'), ("limit jerk", "a")),
        (urdf('lower="-1" upper="1" acceleration="5" deceleration="4"'), ("limit deceleration", "a")),
        (urdf('lower="-1" upper="1"', kind="continuous"), ("limit", "a")),
        (urdf(joint=SAFETY.format(-0.5, 1)), ("safety_controller", "a")),
        (urdf(joint='<spring k="3"/>'), ("spring", "a")),
        (urdf(more='<loop_joint name="closing" type="revolute"/>'), ("loop_joint", "closing")),
        (urdf(more='<drake:ball_constraint name="x"/>'), ("ball_constraint", "x")),
        (urdf(more='<link name="x"><collision><geometry><cylinder radius="1"/></geometry></collision></link>'
              '<joint name="y" type="fixed"><parent link="tip"/><child link="x"/></joint>'), ("collision", "x")),
        (urdf(more=f'<link name="x">{INERTIAL.replace("value", "worth")}</link>'
              '<joint name="y" type="fixed"><parent link="tip"/><child link="x"/></joint>'), ("mass", "x")),
        # kept, or a force
        (urdf(joint='<dynamics damping="abc" friction="2"/><calibration rising="0"/>' + SAFETY.format(-1, 1)), None),
        (urdf('lower="-7" upper="7" velocity="0" effort="nan"'), None),
        (urdf('lower="-1e9" upper="1e9"', kind="continuous"), None),
        (urdf(more='<transmission><passive_joint name="a"/></transmission><ros2_control name="c"/>'), None),
        (urdf(more='<gazebo reference="base"><material>Red</material></gazebo>', joint='<mimic joint="b"/>'), None),
        (urdf('lower="-1" upper="1" acceleration="5"'), None),
    ],
)  # fmt: skip
def test_each_element_of_a_urdf_is_named(text: str, expected: tuple[str, str] | None):
    assert_named(*loaded(Robot.from_urdf, text, floating_base=False), expected)


def test_notes_on_locked_joints_are_left_out():
    text = urdf(joint=SAFETY.format(-0.5, 1))
    assert loaded(Robot.from_urdf, text, floating_base=False, locked_joints=["a"])[0].load_report == ()


def test_a_long_report_is_shortened_in_the_warning():
    more = "".join(f'<loop_joint name="loop{k}"/>' for k in range(12))
    robot, told = loaded(Robot.from_urdf, urdf(more=more), floating_base=False)
    assert len(robot.load_report) == 12 and "and 4 more" in told[0] and "loop8" not in told[0]
    table = str(robot.load_report).splitlines()
    assert table[0].split() == ["element", "name", "what", "was", "done", "instead"] and len(table) == 13


# --- accelerations ---


def test_accelerations_of_urdf_1_2_are_the_default():
    """The lesser of acceleration and deceleration; a mapping replaces some; a follower narrows its leader's."""
    limit = 'lower="-1" upper="1" velocity="2" acceleration="{}" deceleration="{}"'
    robot = loaded(Robot.from_urdf, urdf(limit.format(5, 4)), floating_base=False)[0]
    np.testing.assert_array_equal(robot.acceleration_limit, [4.0, np.inf])
    np.testing.assert_array_equal(osik.AccelerationLimit(robot).acceleration, [4.0, np.inf])
    np.testing.assert_array_equal(osik.AccelerationLimit(robot, {"b": 3.0}).acceleration, [4.0, 3.0])
    path = osik.rollout(
        robot, robot.q0, {"posture": osik.PostureTask(robot, target=jnp.array([0.5, 0.0]))},
        limits=(osik.AccelerationLimit(robot),), steps=100, dt=0.01,
    )  # fmt: skip
    change = np.diff(np.asarray(path.solution.velocity)[:, 0], prepend=0.0)
    assert np.abs(change).max() == pytest.approx(0.04, rel=1e-6)
    mimic = urdf(limit.format(6, 6), joint='<mimic joint="b" multiplier="2"/>')
    np.testing.assert_array_equal(Robot.from_urdf(mimic, floating_base=False).acceleration_limit, [3.0])
    again = Robot.from_mjcf(robot.to_mjcf())
    np.testing.assert_array_equal(again.acceleration_limit, robot.acceleration_limit)


def test_no_accelerations_to_take():
    refuses(ValueError, "no acceleration limits of its own", osik.AccelerationLimit, osik.load_robot("arm7"))


# --- numbers and details as people have them ---


@pytest.mark.parametrize(
    ("limit", "expected"),
    [
        ('lower="-inf" upper="inf" effort="inf" velocity="inf"', (-np.inf, np.inf, np.inf)),
        ('lower="-INF" upper="Infinity" velocity="2"', (-np.inf, np.inf, 2.0)),
        ('lower="-1e400" upper="2" velocity="2"', (-np.inf, 2.0, 2.0)),
        ('lower="-3" upper="+inf" velocity="1e500"', (-3.0, np.inf, np.inf)),
    ],
)
def test_infinite_limits_are_none(limit: str, expected: tuple[float, ...]):
    robot = Robot.from_urdf(urdf(limit), floating_base=False)
    assert (robot.position_lower[0], robot.position_upper[0], robot.velocity_limit[0]) == expected
    assert robot.position_upper[1] == 1.0


@pytest.mark.parametrize("limit", ['lower="nan" upper="1"', 'lower="inf" upper="inf"', 'upper="1" velocity="nan"'])
def test_limits_that_are_no_numbers_are_refused(limit: str):
    refuses(ValueError, "joint 'a', limit", Robot.from_urdf, urdf(limit), floating_base=False)


@pytest.mark.variants(release=["1e10"])
@pytest.mark.parametrize("bound", ["1e10", "600.283", "101"])
def test_huge_limits_count_as_none_for_starts(bound: str):
    """The two joints' answers stay within some turns, in both precisions, and the true error is small."""
    text = urdf(f'lower="-{bound}" upper="{bound}" velocity="2"').replace('lower="-1"', f'lower="-{bound}"')
    rng, robot = np.random.default_rng(0), Robot.from_urdf(text, floating_base=False)
    q = np.column_stack([rng.uniform(-3, 3, 20), rng.uniform(-2.5, 0.9, 20)])
    points = np.column_stack([np.cos(q[:, 0]) + np.cos(q.sum(1)), np.zeros(20), -np.sin(q[:, 0]) - np.sin(q.sum(1))])
    for typed in (robot, robot.astype("float32")):
        found = osik.inverse_kinematics(typed, {"tip": points}, seeds=16)
        here = np.asarray(found.q, float)
        reached = np.column_stack([np.cos(here[:, 0]) + np.cos(here.sum(1)), -np.sin(here[:, 0]) - np.sin(here.sum(1))])
        assert found.converged.all() and np.abs(here).max() < 20.0
        assert np.linalg.norm(reached - points[:, [0, 2]], axis=1).max() < 1.1e-3


@pytest.mark.parametrize(
    "more",
    [
        '<material name="m"><color rgba="red"/></material>',
        '<material name="m"><color rgba="1 0 0"/></material>',
        '<material name="m"><color/></material>',
        '<link name="x"><visual><geometry><cylinder radius=".1"/></geometry></visual></link>'
        '<joint name="y" type="fixed"><parent link="tip"/><child link="x"/><origin xyz="" rpy=""/></joint>',
        '<link name="x"><visual><geometry><mesh/></geometry><origin rpy="a b c"/></visual></link>'
        '<joint name="y" type="fixed"><parent link="tip"/><child link="x"/></joint>',
        '<gazebo reference="tom & jerry"/>',
    ],
)
def test_details_that_no_kinematics_needs_stop_nothing(more: str):
    robot, told = loaded(Robot.from_urdf, urdf(more=more), floating_base=False)
    assert robot.nq == 2 and told == []


def test_colours_of_three_numbers_are_opaque():
    color = '<material name="m"><color rgba="1 0.5 0"/></material>'
    visual = f'<visual><geometry><sphere radius="1"/></geometry>{color}</visual>'
    text = urdf().replace(f'<link name="l1">{INERTIAL}', f'<link name="l1">{INERTIAL}{visual}')
    np.testing.assert_allclose(Robot.from_urdf(text, floating_base=False).mj_model.geom_rgba, [[1.0, 0.5, 0.0, 1.0]])


PLATE = "v 0 0 0\nv .1 0 0\nv .1 .2 0\nv 0 .2 0\nf 1 2 3\nf 1 3 4\n"
LINE = "v 0 0 0\nv .1 0 0\nv .2 0 0\nv .3 0 0\nf 1 2 3\nf 2 3 4\n"
TETRA = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


TEXT_STL = "solid x\nfacet normal 0 0 1\nouter loop\n{}endloop\nendfacet\nendsolid\n"


def with_mesh(folder: Path, file: str, scale: str = "1 1 1") -> Robot:
    """A robot whose first link has a collision mesh."""
    mesh = f'<collision><geometry><mesh filename="{file}" scale="{scale}"/></geometry></collision>'
    path = folder / "robot.urdf"
    path.write_text(urdf().replace(f'<link name="l1">{INERTIAL}', f'<link name="l1">{INERTIAL}{mesh}'))
    return Robot.from_urdf(path, floating_base=False)


@pytest.mark.parametrize(
    "text",
    [TEXT_STL.format("vertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"), TEXT_STL.format(""), "solid facet 1 a", LINE],
)
def test_meshes_without_a_body_do_not_stop_the_robot(tmp_path: Path, text: str):
    """A single triangle, nothing at all, and a line; MuJoCo does not read such STL files, so this package does."""
    name = "flat.obj" if text == LINE else "flat.stl"
    (tmp_path / name).write_text(text)
    robot = with_mesh(tmp_path, name)
    message = "area is too small" if text == LINE else f"{name}: nothing in it has a surface"
    refuses(ValueError, f"the collision mesh of l1.*{message}", robot_shapes, robot)


@pytest.mark.parametrize(("mesh", "scale"), [(PLATE, "1 1 1"), (TETRA, "1 0 1"), (TETRA, "2 2 2")])
def test_flat_meshes_are_thickened(tmp_path: Path, mesh: str, scale: str):
    """A flat mesh gets 1 mm, another one stays as it is. The address is written with %20."""
    (tmp_path / "plate file.obj").write_text(mesh)
    robot = with_mesh(tmp_path, "plate%20file.obj", scale=scale)
    table = robot_shapes(robot).table
    (row,) = np.flatnonzero(table.count)
    spans = np.ptp(table.vertices[table.first[row] :][: table.count[row]], axis=0)
    assert min(spans) == pytest.approx(0.2 if scale == "2 2 2" else 1e-3, rel=1e-5)
