"""A robot written as MJCF and read again is the same robot, by our kinematics and by MuJoCo's."""

from __future__ import annotations

import importlib.metadata

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import osik_jax as osik
from osik_jax import Robot

CONFIGURATIONS = 3


def g1() -> Robot:
    (path,) = (f for f in importlib.metadata.files("example-robot-data") or [] if f.name == "g1_29dof_rev_1_0.urdf")
    return Robot.from_urdf(str(path.locate()), locked_joints={"waist_*": 0.1, "*_wrist_*": -0.2})


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


ODD = """
<mujoco model="odd">
  <compiler angle="radian"/>
  <asset><mesh name="wedge" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/><material name="red" rgba="1 0 0 1"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/><site name="mark" pos="1 2 3" euler="0.1 0.2 0.3"/>
    <body name="table" pos="0 0 0.5" euler="0 0 0.3"><geom name="top" type="box" size="0.5 0.5 0.02"/>
      <body name="a/1" pos="0.1 0.2 0.3" quat="1 0.2 0 0.1"><geom size="0.1" pos="0.1 0 0"/>
        <joint name="x" axis="1 0 0" pos="0 0.1 0" range="-1 1" armature="0.1"/>
        <joint name="y" axis="0 1 0.5" ref="0.3"/>
        <joint name="z" type="slide" axis="0 1 1" ref="0.2" pos="0.1 0.1 0.1"/>
        <joint name="w" axis="1 1 0" pos="0 0 1"/>
        <body name="b" pos="0 0 0.4"><geom type="mesh" mesh="wedge" name="hull"/>
          <joint name="s" type="slide" axis="1 0 0"/>
          <joint name="ball" type="ball" pos="0 0 0.1"/><site name="b" pos="0 0 0.2"/>
          <body name="fixed" pos="0.1 0 0" euler="1 0 0"><geom name="pin" type="capsule" size="0.1 0.2" material="red"/>
            <body name="massless" pos="0 0.2 0"/></body>
          <body name="c" pos="0 0 0.4"><joint name="m" axis="0 1 0" ref="0.1"/>
            <geom size="0.1"/></body></body></body></body>
    <body name="größe" pos="2 0 1" euler="0.1 0.2 0.3"><freejoint name="fly"/>
      <geom size="0.2 0.1 0.1" type="ellipsoid"/></body>
  </worldbody>
  <custom><numeric name="velocity_limit/ball" data="4"/><numeric name="velocity_limit/x" data="2"/></custom>
  <equality><joint joint1="m" joint2="x" polycoef="0.2 -0.5 0 0 0"/><connect body1="c" anchor="0 0 0"/></equality>
</mujoco>
"""


def odd() -> Robot:
    return Robot.from_mjcf(ODD, locked_joints={"y": 0.7, "w": -0.4, "z": 0.25, "s": 0.1})


ROBOTS = {
    "arm7": lambda: osik.load_robot("arm7"),
    "odd": odd,
    "nao, scaled and edited": scaled_nao,
    "nao, locked": locked_nao,
    "g1, locked": g1,
}
SLOW = ("g1, locked",)


@jax.jit
def poses(robot: Robot, q: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    def at(q: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        kinematics = osik.forward_kinematics(robot, q)
        return *kinematics.frame_poses(robot, robot.frame_names), osik.center_of_mass(robot, kinematics)

    return jax.vmap(at)(q)


def random_configurations(robot: Robot) -> np.ndarray:
    """Near home, quaternions turned too."""
    rng = np.random.default_rng(11)
    v = rng.uniform(-1.0, 1.0, (CONFIGURATIONS, robot.nv))
    return np.asarray(jax.jit(jax.vmap(lambda v: osik.integrate(robot, robot.q0, v, 1.0)))(v))


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


def test_mujoco_reads_the_file_as_we_meant_it(pair: tuple[Robot, Robot]):
    """Poses of bodies, sites and geoms by name, and the centre of mass."""
    robot, again = pair
    model, q = again.mj_model, random_configurations(robot)
    data = mujoco.MjData(model)
    position, rotation, com = map(np.asarray, poses(robot, jnp.asarray(q)))
    kinds = {"body": data.body, "site": data.site, "geom": data.geom}
    named = [(kind, getattr(model, kind)(k).name) for kind in kinds for k in range(getattr(model, f"n{kind}"))]
    named = [(kind, name) for kind, name in named if not name.startswith("equality_end/")]
    own = np.isin(model.body_rootid, [model.body(robot.tree.body_names[top]).id for top in robot.tree.tops])
    moving = np.where((model.body_weldid != 0) & own, model.body_mass, 0.0)
    assert own[1:].all() == (model.nbody != 5)  # of the odd scene, the ellipsoid that floats is not the robot
    for k in range(CONFIGURATIONS):
        data.qpos[:] = again.mujoco_qpos(jnp.asarray(q[k]))
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for kind, name in named:
            if name:
                frame, element = robot.tree.frame(name), kinds[kind](name)
                np.testing.assert_allclose(position[k, frame], element.xpos, rtol=0.0, atol=1e-12, err_msg=name)
                expected = element.xmat.reshape(3, 3)
                np.testing.assert_allclose(rotation[k, frame], expected, rtol=0.0, atol=1e-12, err_msg=name)
        np.testing.assert_allclose(com[k], moving @ data.xipos / moving.sum(), rtol=0.0, atol=1e-12)


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
    with pytest.raises(ValueError, match=message):
        robot().to_mjcf()


def test_moved_frames_are_written_and_moved_bodies_are_not_mistaken_for_frames():
    robot = osik.load_robot("arm7")
    at = robot.tree.frame("hand")
    moved = eqx.tree_at(lambda r: r.frame_position, robot, robot.frame_position.at[at].add(0.01))
    again = Robot.from_mjcf(moved.to_mjcf())
    ours, theirs = (np.asarray(r.frame_position)[r.tree.frame("hand")] for r in (moved, again))
    np.testing.assert_allclose(theirs, ours, rtol=0.0, atol=1e-15)
    at = robot.tree.frame("link7")
    wrong = eqx.tree_at(lambda r: r.frame_position, robot, robot.frame_position.at[at].add(0.01))
    with pytest.raises(ValueError, match=r"frame 'link7' is a body or geom of its own and not where that is"):
        wrong.to_mjcf()


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
