"""Kinematics against MuJoCo C, MJX, Pinocchio and central differences."""

import copy

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from frames_beside_mujoco import random_configurations
from model_files import mjcf
from mujoco import mjx
from mujoco_states import full_velocities, mujoco_at
from refusals import refuses
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax.kinematics import _composition
from osik_jax.kinematics._forward import kinematics_on_host

NAMES = ("toy", "nao", "arm7")


def quick_jit(function):
    """Jit with little optimisation, for functions that run once."""
    return jax.jit(function, compiler_options={"xla_backend_optimization_level": 0})


def toy_robot(**options) -> osik.Robot:
    return osik.Robot.from_mjmodel(mujoco.MjModel.from_xml_string(mjcf("toy")), root=("base", "crane"), **options)


def make(name: str) -> osik.Robot:
    return toy_robot() if name == "toy" else osik.load_robot(name)


@pytest.fixture(scope="module")
def robots() -> dict[str, osik.Robot]:
    return {name: make(name) for name in NAMES}


def test_kinematics_outside_jit_are_one_program(robots):
    """Operation by operation they took half a second for one configuration."""
    robot = robots["arm7"]
    kinematics = osik.forward_kinematics(robot, robot.q0)
    frame = robot.frame_names[-1]
    for function in (
        lambda q: osik.forward_kinematics(robot, q),
        lambda q: osik.frame_jacobian(robot, kinematics, (frame,)) * q[0],
    ):
        assert len(jax.make_jaxpr(function)(robot.q0).eqns) < 6


def everything(robot: osik.Robot, subtree: str):
    """Poses and Jacobians of all frames, centre of mass and its Jacobian, of the whole and of a subtree."""

    def evaluate(robot: osik.Robot, q):
        kin = osik.forward_kinematics(robot, q)
        return {
            "poses": kin.frame_poses(robot, robot.frame_names),
            "jacobians": osik.frame_jacobian(robot, kin, robot.frame_names),
            "com": osik.center_of_mass(robot, kin),
            "com_jacobian": osik.com_jacobian(robot, kin),
            "subtree_com": osik.center_of_mass(robot, kin, subtree),
            "subtree_com_jacobian": osik.com_jacobian(robot, kin, subtree),
        }

    return evaluate


CHUNK = 4
SUBTREES = {"toy": "cross", "nao": "LThigh", "arm7": "link4"}


@pytest.fixture(scope="module")
def evaluators(robots):
    """``everything`` of each robot over a batch, compiled once: batches are cut into chunks of one size."""

    def make_evaluator(robot: osik.Robot, subtree: str):
        compiled = jax.jit(jax.vmap(everything(robot, subtree), in_axes=(None, 0)))

        def evaluate(robot: osik.Robot, q: np.ndarray):
            padded = np.resize(q, (-(-len(q) // CHUNK) * CHUNK, q.shape[1]))
            parts = [compiled(robot, padded[start : start + CHUNK]) for start in range(0, len(padded), CHUNK)]
            return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(q)], *parts)

        return evaluate

    return {name: make_evaluator(robot, SUBTREES[name]) for name, robot in robots.items()}


def moving_model(robot: osik.Robot) -> mujoco.MjModel:
    """The robot's model without the mass of what is fixed to the world: only what moves has a centre of mass here."""
    model = copy.deepcopy(robot.mj_model)
    model.body_mass[model.body_weldid == 0] = 0.0
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def mujoco_frame(model: mujoco.MjModel, data: mujoco.MjData, name: str):
    """Body, position and rotation of a frame, asked of MuJoCo by name."""
    for kind, of in (("BODY", "body"), ("SITE", "site"), ("GEOM", "geom")):
        if mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind}"), name) >= 0:
            own, place = getattr(model, of)(name), getattr(data, of)(name)
            return own.id if of == "body" else int(own.bodyid[0]), place.xpos, place.xmat.reshape(3, 3)
    raise KeyError(name)


def mujoco_everything(robot: osik.Robot, subtree: str, q: np.ndarray) -> dict:
    """The same as ``everything``, by MuJoCo C."""
    model, matrix = moving_model(robot), full_velocities(robot)
    data, root = mujoco_at(robot, q, model), model.body(subtree).id
    positions, rotations, jacobians = [], [], []
    for name in robot.frame_names:
        body, position, rotation = mujoco_frame(model, data, name)
        linear, angular = np.zeros((2, 3, model.nv))
        mujoco.mj_jac(model, data, linear, angular, position.reshape(3, 1), body)
        positions.append(position)
        rotations.append(rotation)
        jacobians.append(np.vstack([linear, angular]) @ matrix)
    whole, part = np.zeros((2, 3, model.nv))
    mujoco.mj_jacSubtreeCom(model, data, whole, 0)
    mujoco.mj_jacSubtreeCom(model, data, part, root)
    return {
        "poses": (np.array(positions), np.array(rotations)),
        "jacobians": np.array(jacobians),
        "com": data.subtree_com[0],
        "com_jacobian": whole @ matrix,
        "subtree_com": data.subtree_com[root],
        "subtree_com_jacobian": part @ matrix,
    }


def stacked(parts: list) -> dict:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *parts)


def assert_trees_close(actual, expected, tolerance: float) -> None:
    for (path, a), (_, b) in zip(
        jax.tree_util.tree_leaves_with_path(actual), jax.tree_util.tree_leaves_with_path(expected), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=tolerance, rtol=0, err_msg=jax.tree_util.keystr(path))


@pytest.mark.parametrize("name", NAMES)
def test_everything_equals_mujoco_c(robots, evaluators, name):
    robot = robots[name]
    q = random_configurations(robot, seed=1)
    expected = stacked([mujoco_everything(robot, SUBTREES[name], row) for row in q])
    assert_trees_close(evaluators[name](robot, q), expected, 1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_the_host_finds_the_same_without_a_program(robots, name):
    """Default targets are made so."""
    robot = robots[name]
    for q in random_configurations(robot, seed=7, count=2):
        expected = mujoco_everything(robot, SUBTREES[name], q)
        kin = kinematics_on_host(robot, q)
        found = {
            "poses": kin.frame_poses(robot, robot.frame_names),
            "com": osik.center_of_mass(robot, kin),
            "subtree_com": osik.center_of_mass(robot, kin, SUBTREES[name]),
        }
        assert {type(leaf) for leaf in jax.tree.leaves((kin, found))} == {np.ndarray}
        assert_trees_close(found, {name: expected[name] for name in found}, 1e-12)
        whole = osik.forward_kinematics(robot, q)  # axes too
        assert_trees_close(jax.tree.leaves(kin), jax.tree.leaves(whole), 1e-12)


@pytest.mark.variants(slow=["nao"], release=["toy"])
@pytest.mark.parametrize("name", NAMES)
def test_everything_equals_mujoco_c_in_single_precision(robots, name):
    q = random_configurations(robots[name], seed=2)
    expected = stacked([mujoco_everything(robots[name], SUBTREES[name], row) for row in q])
    with jax.enable_x64(False):
        robot = make(name)
        evaluate = quick_jit(jax.vmap(everything(robot, SUBTREES[name]), in_axes=(None, 0)))
        actual = evaluate(robot, q.astype(np.float32))
        assert {leaf.dtype for leaf in jax.tree.leaves(actual)} == {jnp.dtype("float32")}
    assert_trees_close(actual, expected, 1e-5)


def test_a_quaternion_of_any_length_means_its_direction(robots, evaluators):
    robot = robots["toy"]
    q = random_configurations(robot, seed=3)
    longer = q.copy()
    longer[:, 3:7] *= 1.7
    assert_trees_close(evaluators["toy"](robot, longer), evaluators["toy"](robot, q), 1e-12)


@pytest.mark.slow
def test_poses_and_jacobians_equal_mjx(robots, evaluators):
    robot = robots["toy"]
    q = random_configurations(robot, seed=4, count=2)
    model = mjx.put_model(moving_model(robot), impl="jax")
    empty = mjx.make_data(robot.mj_model, impl="jax")
    bodies = jnp.arange(robot.mj_model.nbody)

    @quick_jit
    @jax.vmap
    def by_mjx(q):
        data = mjx.com_pos(model, mjx.kinematics(model, empty.replace(qpos=q)))
        linear, angular = jax.vmap(lambda p, b: mjx.jac(model, data, p, b))(data.xpos, bodies)
        return data.xpos, data.xmat, jnp.concatenate([linear.mT, angular.mT], 1), data.subtree_com[0]

    position, rotation, jacobian, com = by_mjx(q)
    ours = evaluators["toy"](robot, q)
    at = [robot.frame_names.index(robot.mj_model.body(b).name) for b in range(robot.mj_model.nbody)]
    np.testing.assert_allclose(ours["poses"][0][:, at], position, atol=1e-9, rtol=0)
    np.testing.assert_allclose(ours["poses"][1][:, at], rotation, atol=1e-9, rtol=0)
    np.testing.assert_allclose(ours["jacobians"][:, at], jacobian, atol=1e-9, rtol=0)
    np.testing.assert_allclose(ours["com"], com, atol=1e-9, rtol=0)


@pytest.mark.variants(slow=["nao"], release=["toy"])
@pytest.mark.parametrize("name", NAMES)
def test_derivatives_of_poses_equal_central_differences(robots, evaluators, name):
    robot, step = robots[name], 1e-6
    frames = {"toy": ("tool", "lower"), "nao": ("l_sole", "r_gripper"), "arm7": ("flange",)}[name]
    q = random_configurations(robot, seed=6, count=1)[0]
    positions, rotations = evaluators[name](robot, np.concatenate([q + np.eye(robot.nq) * h for h in (step, -step)]))[
        "poses"
    ]
    at = [robot.frame_names.index(frame) for frame in frames]
    numeric = [(part[: robot.nq, at] - part[robot.nq :, at]) / (2 * step) for part in (positions, rotations)]

    def pose(q):
        return osik.forward_kinematics(robot, q).frame_poses(robot, frames)

    for derivative in (jax.jacfwd, jax.jacrev):
        for actual, expected in zip(quick_jit(derivative(pose))(q), numeric, strict=True):
            np.testing.assert_allclose(actual, np.moveaxis(expected, 0, -1), atol=1e-8, rtol=0)


@pytest.mark.variants(slow=["locked1"])
@pytest.mark.parametrize("locked", [("root", "ball", "second"), {"slide": 0.3, "slid*": 0.1}])
def test_locked_joints_stay_where_they_are(locked):
    robot = toy_robot(locked_joints=locked)
    q = random_configurations(robot, seed=11, count=2)
    expected = stacked([mujoco_everything(robot, "cross", row) for row in q])
    actual = quick_jit(jax.vmap(everything(robot, "cross"), in_axes=(None, 0)))(robot, q)
    assert_trees_close(actual, expected, 1e-9)
    full = np.array(robot.mujoco_qpos(q[0]))
    for name in robot.locked_joints:
        joint = robot.mj_model.joint(name)
        at = slice(joint.qposadr[0], joint.qposadr[0] + len(joint.qpos0))
        value = [0.1] if isinstance(locked, dict) else joint.qpos0
        np.testing.assert_array_equal(full[at], value, err_msg=name)


def test_wrong_input_is_named(robots):
    robot = robots["nao"]
    kin = quick_jit(osik.forward_kinematics)(robot, robot.q0)
    refuses(KeyError, "no frame 'l_ankel'; did you mean 'l_ankle'", kin.frame_pose, robot, "l_ankel")
    refuses(KeyError, "no frame 'hand'", osik.frame_jacobian, robot, kin, "hand")
    refuses(KeyError, "no frame 'leg'", osik.center_of_mass, robot, kin, "leg")
    feather = eqx.tree_at(lambda r: r.body_mass, robot, robot.body_mass.at[-1].set(0.0))
    for function in (osik.center_of_mass, osik.com_jacobian):
        refuses(ValueError, "the subtree of 'r_gripper' has no mass", function, feather, kin, "r_gripper")


@pytest.mark.parametrize("name", NAMES)
def test_the_way_of_gpus_composes_as_that_of_cpus_does(robots, name):
    tree = robots[name].tree
    rng = np.random.default_rng(5)
    local = rng.normal(size=(len(tree.body_names), 3)), Rotation.random(len(tree.body_names), rng=rng).as_matrix()
    rounds = jnp.asarray(tree.doublings, np.int32)
    looped, apart = (jax.jit(way)(*local, rounds) for way in (_composition._in_a_loop, _composition._one_by_one))
    assert_trees_close(looped, apart, 1e-13)
    program = jax.jit(lambda q: osik.forward_kinematics(robots[name], q)).trace(robots[name].q0)
    has_loop = {on: "stablehlo.while" in program.lower(lowering_platforms=(on,)).as_text() for on in ("cpu", "cuda")}
    assert has_loop == {"cpu": True, "cuda": False}


FUNCTIONS = {
    "frame_jacobian": lambda robot, kinematics: osik.frame_jacobian(robot, kinematics, "hand"),
    "center_of_mass": osik.center_of_mass,
    "com_jacobian": osik.com_jacobian,
    "mass_matrix": osik.mass_matrix,
    "centroidal_momentum_matrix": osik.centroidal_momentum_matrix,
}


@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS)
def test_a_configuration_or_another_robots_kinematics_is_an_error(function):
    arm, other = osik.load_robot("arm7"), osik.load_robot("nao")
    message = r"kinematics is a .*; it is what forward_kinematics\(robot, q\) returns"
    refuses(TypeError, message, function, arm, arm.q0)
    refuses(TypeError, message, jax.jit(lambda q: function(arm, q)), arm.q0)
    refuses(ValueError, "that of another robot", function, arm, osik.forward_kinematics(other, other.q0))
    many = jax.vmap(lambda q: osik.forward_kinematics(arm, q))(jnp.tile(arm.q0, (3, 1)))
    refuses(ValueError, "Batch with jax.vmap", function, arm, many)
