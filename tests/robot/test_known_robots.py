"""Well-known robots from example-robot-data against Pinocchio and MuJoCo C, at random configurations."""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pinocchio as pin
import pytest
from example_files import example_file
from mujoco_states import full_velocities, mujoco_at

import osik_jax as osik

ROBOTS = {
    "g1": ("g1_description/urdf/g1_29dof_rev_1_0.urdf", True),
    "talos": ("talos_data/robots/talos_full_v2.urdf", True),
    "romeo": ("romeo_description/urdf/romeo.urdf", True),
    "solo12": ("solo_description/robots/solo12.urdf", True),
    "panda": ("panda_description/urdf/panda.urdf", False),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", False),
    "tiago": ("tiago_description/robots/tiago.urdf", True),
    "tiago_pro": ("tiago_pro_description/robots/tiago_pro.urdf", True),
}
SLOW = {"talos", "romeo", "solo12", "tiago"}
"""Robots whose files have nothing that the others lack."""
CONFIGURATIONS = 4
ARRAYS = ("position", "rotation", "jacobian", "com", "com_jacobian", "mass_matrix", "momentum")


def urdf_path(name: str) -> Path:
    return example_file(ROBOTS[name][0])


@dataclasses.dataclass(frozen=True)
class Description:
    """What the test itself reads from the XML, apart from the library's reader."""

    links: tuple[str, ...]
    mass: dict[str, float]
    mimic: dict[str, tuple[str, float, float]]

    def resolve(self, joint: str) -> tuple[str, float, float]:
        """The joint that moves this one in the end: name, multiplier, offset."""
        if joint not in self.mimic:
            return joint, 1.0, 0.0
        leader, multiplier, offset = self.mimic[joint]
        leader, m, o = self.resolve(leader)
        return leader, multiplier * m, multiplier * o + offset


def describe(path: Path) -> Description:
    root = ElementTree.parse(path).getroot()
    mimic = {}
    for joint in root.findall("joint"):
        element = joint.find("mimic")
        if element is not None and joint.get("type") != "fixed":
            numbers = float(element.get("multiplier", "1")), float(element.get("offset", "0"))
            mimic[joint.get("name", "")] = (element.get("joint", ""), *numbers)
    mass = {link.get("name", ""): link.find("inertial/mass") for link in root.findall("link")}
    masses = {name: 0.0 if at is None else float(at.get("value", "0")) for name, at in mass.items()}
    return Description(tuple(mass), masses, mimic)


def possible(path: Path) -> str:
    """The URDF with an inertia that no body has (two antennas of TIAGo's) replaced by a ball's, as MuJoCo does."""
    tree = ElementTree.parse(path).getroot()
    for element in tree.iter("inertia"):
        keys = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
        tensor = np.array([[float(element.get(key, "0")) for key in row] for row in keys])
        least, middle, most = np.linalg.eigvalsh(tensor)
        if least < 0.0 or least + middle < most:
            element.attrib.update({key: "0" for row in keys for key in row})
            element.attrib.update(dict.fromkeys(("ixx", "iyy", "izz"), repr(float(np.trace(tensor)) / 3.0)))
    return ElementTree.tostring(tree, encoding="unicode")


@dataclasses.dataclass(frozen=True)
class Case:
    name: str
    path: Path
    floating: bool
    description: Description
    robot: osik.Robot
    oracle: pin.Model
    q: np.ndarray
    v: np.ndarray
    ours: dict[str, np.ndarray]
    theirs: dict[str, np.ndarray]


def load(name: str) -> osik.Robot:
    """Robots with feet float, and UR5's root link is called world: that is said of the others alone."""
    said = None if name in ("g1", "talos", "romeo", "solo12", "ur5") else ROBOTS[name][1]
    return osik.Robot.from_urdf(urdf_path(name), floating_base=said)


def random_configurations(robot: osik.Robot, rng: np.random.Generator) -> np.ndarray:
    """Inside the limits; exact in single precision, so that both precisions see the same configuration."""
    lower = np.clip(np.asarray(robot.position_lower), -np.pi, None)
    upper = np.clip(np.asarray(robot.position_upper), None, np.pi)
    joints = rng.uniform(lower, upper, (CONFIGURATIONS, robot.nv))[:, 6 * robot.floating_base :]
    base = [rng.uniform(-1.0, 1.0, (CONFIGURATIONS, 3)), rng.normal(size=(CONFIGURATIONS, 4))]
    q = np.concatenate([*base, joints], 1) if robot.floating_base else joints
    return q.astype(np.float32).astype(float)


def everything(links: tuple[str, ...]) -> Callable[[osik.Robot, jax.Array, jax.Array], dict[str, jax.Array]]:
    """One program: poses and Jacobians of all links, the centre of mass, inertias over the mass, and one step."""

    def at(robot: osik.Robot, q: jax.Array, v: jax.Array) -> dict[str, jax.Array]:
        kin, mass = osik.forward_kinematics(robot, q), robot.body_mass.sum()
        position, rotation = kin.frame_poses(robot, links)
        return dict(
            position=position,
            rotation=rotation,
            jacobian=osik.frame_jacobian(robot, kin, links),
            com=osik.center_of_mass(robot, kin),
            com_jacobian=osik.com_jacobian(robot, kin),
            mass_matrix=osik.mass_matrix(robot, kin) / mass,
            momentum=osik.centroidal_momentum_matrix(robot, kin) / mass,
            qpos=robot.mujoco_qpos(q),
            stepped=robot.mujoco_qpos(osik.integrate(robot, q, v, 0.01)),
        )

    return jax.jit(jax.vmap(at, in_axes=(None, 0, 0)))


def evaluate(robot: osik.Robot, links: tuple[str, ...], q: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
    out = everything(links)(robot, jnp.asarray(q), jnp.asarray(v))
    return {key: np.asarray(value) for key, value in out.items()}


def base_rotation(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q[3:7] / np.linalg.norm(q[3:7])
    return pin.Quaternion(w, x, y, z).toRotationMatrix()


def pinocchio_joints(model: pin.Model) -> list[tuple[str, pin.JointModel]]:
    named = zip(model.names, model.joints, strict=True)
    return [(name, joint) for name, joint in named if name not in ("universe", "root_joint")]


def pinocchio_configuration(robot: osik.Robot, model: pin.Model, description: Description, q: np.ndarray) -> np.ndarray:
    out = pin.neutral(model)
    if robot.floating_base:
        w, x, y, z = q[3:7] / np.linalg.norm(q[3:7])
        out[:7] = [*q[:3], x, y, z, w]
    for name, joint in pinocchio_joints(model):
        if "Mimic" not in joint.shortname():
            leader, multiplier, offset = description.resolve(name)
            value = multiplier * q[robot.joint_qpos_index(leader)] + offset
            circle = joint.nq == 2  # unbounded joints are points of a circle there
            out[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(value), np.sin(value)] if circle else [value]
    return out


def pinocchio_velocities(robot: osik.Robot, model: pin.Model, description: Description, q: np.ndarray) -> np.ndarray:
    """Pinocchio's velocity = this matrix @ v: its base moves in body axes, and it knows all joints apart."""
    out = np.zeros((model.nv, robot.nv))
    if robot.floating_base:
        out[:3, :3] = base_rotation(q).T
        out[3:6, 3:6] = np.eye(3)
    for name, joint in pinocchio_joints(model):
        if "Mimic" not in joint.shortname():
            leader, multiplier, _ = description.resolve(name)
            out[joint.idx_v, robot.joint_dof_index(leader)] = multiplier
    return out


def pinocchio_evaluate(robot: osik.Robot, model: pin.Model, description: Description, q: np.ndarray) -> dict:
    data = model.createData()
    configuration = pinocchio_configuration(robot, model, description, q)
    velocities = pinocchio_velocities(robot, model, description, q)
    pin.computeJointJacobians(model, data, configuration)
    pin.updateFramePlacements(model, data)
    com_jacobian = pin.jacobianCenterOfMass(model, data, configuration) @ velocities
    mass = pin.computeTotalMass(model)
    upper = np.triu(pin.crba(model, data, configuration))
    mass_matrix = velocities.T @ (upper + np.triu(upper, 1).T) @ velocities / mass
    momentum = pin.computeCentroidalMap(model, data, configuration) @ velocities / mass
    ids = [model.getFrameId(link, pin.FrameType.BODY) for link in description.links]
    axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    return dict(
        position=np.array([data.oMf[i].translation for i in ids]),
        rotation=np.array([data.oMf[i].rotation for i in ids]),
        jacobian=np.array([pin.getFrameJacobian(model, data, i, axes) @ velocities for i in ids]),
        com=data.com[0].copy(),
        com_jacobian=com_jacobian,
        mass_matrix=mass_matrix,
        momentum=momentum,
    )


@pytest.fixture(
    scope="module", params=[pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in ROBOTS]
)
def case(request: pytest.FixtureRequest) -> Case:
    name = request.param
    path, floating = urdf_path(name), ROBOTS[name][1]
    description, robot, rng = describe(path), load(name), np.random.default_rng(7)
    base = (pin.JointModelFreeFlyer(),) if floating else ()
    oracle = pin.buildModelFromXML(possible(path), *base)
    q, v = random_configurations(robot, rng), rng.normal(size=(CONFIGURATIONS, robot.nv))
    rows = [pinocchio_evaluate(robot, oracle, description, row) for row in q]
    ours = evaluate(robot, description.links, q, v)
    theirs = {key: np.array([row[key] for row in rows]) for key in ARRAYS}
    return Case(name, path, floating, description, robot, oracle, q, v, ours, theirs)


def test_names_and_sizes(case: Case):
    robot, description = case.robot, case.description
    assert robot.floating_base == case.floating
    assert set(description.links) <= set(robot.frame_names)
    moving = [name for name, _ in pinocchio_joints(case.oracle)]
    assert set(robot.joint_names) == set(moving) - set(description.mimic)
    assert robot.mimic_joints == {j: description.resolve(j)[:2] for j in description.mimic if j in moving}
    assert robot.nv == len(robot.joint_names) + 6 * case.floating


@pytest.mark.parametrize("key", ARRAYS)
def test_double_precision_agrees_with_pinocchio(case: Case, key: str):
    np.testing.assert_allclose(case.ours[key], case.theirs[key], rtol=0.0, atol=1e-9)


@pytest.mark.variants(release=["tiago_pro", "romeo", "talos", "solo12", "tiago", "panda"])
def test_single_precision_agrees_with_pinocchio(case: Case):
    with jax.enable_x64(False):
        robot = load(case.name)
        ours = evaluate(robot, case.description.links, case.q, case.v)
    for key in ARRAYS:
        assert ours[key].dtype == np.float32
        np.testing.assert_allclose(ours[key], case.theirs[key], rtol=0.0, atol=1e-5, err_msg=key)


@pytest.mark.parametrize("case", ["panda", "tiago_pro"], indirect=True)
def test_followers_agree_with_pinocchio_own_mimic_joints(case: Case):
    """The other robots with mimic joints list followers before leaders, which Pinocchio refuses."""
    base = (pin.JointModelFreeFlyer(),) if case.floating else ()
    model = pin.buildModelFromXML(possible(case.path), *base, mimic=True)
    assert model.nv == case.robot.nv
    for k, q in enumerate(case.q):
        theirs = pinocchio_evaluate(case.robot, model, case.description, q)
        for key in ARRAYS:
            np.testing.assert_allclose(case.ours[key][k], theirs[key], rtol=0.0, atol=1e-9, err_msg=key)


def test_masses(case: Case):
    total = sum(case.description.mass.values())
    fixed = case.oracle.inertias[0].mass
    assert case.robot.mj_model.body_mass.sum() == pytest.approx(total, rel=1e-12, abs=0.0)
    assert float(case.robot.body_mass.sum()) == pytest.approx(pin.computeTotalMass(case.oracle), rel=1e-12, abs=0.0)
    assert float(case.robot.body_mass.sum()) == pytest.approx(total - fixed, rel=1e-12, abs=0.0)


def test_limits(case: Case):
    """Pinocchio's limits, those of followers mapped to their leaders by hand; a speed of 0 means unknown."""
    robot, model = case.robot, case.oracle
    lower, upper, speed = (np.full(robot.nv, s * np.inf) for s in (-1, 1, 1))
    for name, joint in pinocchio_joints(model):
        leader, multiplier, offset = case.description.resolve(name)
        dof = robot.joint_dof_index(leader)
        speed[dof] = min(speed[dof], (model.velocityLimit[joint.idx_v] or np.inf) / abs(multiplier))
        if joint.nq == 1:
            low, high = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
            low, high = sorted(((low - offset) / multiplier, (high - offset) / multiplier))
            lower[dof], upper[dof] = max(lower[dof], low), min(upper[dof], high)
    np.testing.assert_array_equal(robot.position_lower, lower)
    np.testing.assert_array_equal(robot.position_upper, upper)
    np.testing.assert_array_equal(robot.velocity_limit, speed)
    assert np.isfinite(lower[6 * case.floating :]).any()
    assert np.isfinite(speed[6 * case.floating :]).any()


def test_poses_and_step_agree_with_mujoco(case: Case):
    robot, model = case.robot, case.robot.mj_model
    velocities = full_velocities(robot)
    links = [k for k, link in enumerate(case.description.links) if link != "world"]
    bodies = [model.body(case.description.links[k]).id for k in links]
    moving = np.where(model.body_weldid != 0, model.body_mass, 0.0)
    for k, q in enumerate(case.q):
        ours = {key: value[k] for key, value in case.ours.items()}
        data = mujoco_at(robot, q)
        np.testing.assert_allclose(ours["qpos"], data.qpos, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(ours["position"][links], data.xpos[bodies], rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(ours["rotation"][links], data.xmat[bodies].reshape(-1, 3, 3), rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(ours["com"], moving @ data.xipos / moving.sum(), rtol=0.0, atol=1e-9)
        qpos = data.qpos.copy()
        mujoco.mj_integratePos(model, qpos, velocities @ case.v[k], 0.01)
        if robot.floating_base:
            qpos[3:7] /= np.linalg.norm(qpos[3:7])
        np.testing.assert_allclose(ours["stepped"], qpos, rtol=0.0, atol=1e-9)


def test_mj_model_alone_gives_the_same_robot(case: Case):
    """All that was read from the URDF is in ``mj_model``: limits, speeds and mimic joints too.

    Collision meshes that nothing has asked for are not read yet.
    """
    again = osik.Robot.from_mjmodel(case.robot.mj_model)
    read, shapes = again.mj_model.ngeom, ("geom_names", "geom_types", "geom_bodies")
    for name in (field.name for field in dataclasses.fields(again.tree)):
        have, want = getattr(again.tree, name), getattr(case.robot.tree, name)
        assert have == (want[:read] if name in shapes else want), name
    for have, want in zip(jax.tree.leaves(again), jax.tree.leaves(case.robot), strict=True):
        np.testing.assert_array_equal(have, want[: len(have)] if have.ndim else want)  # without shapes not read
