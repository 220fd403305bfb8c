"""Kinematics against MuJoCo C, MJX, Pinocchio and central differences."""

import copy
import time
from importlib.metadata import files

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pinocchio
import pytest
from mujoco import mjx
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax.kinematics import _composition

# All joint types, two joints on one body, anchors off the body's origin, references other than 0, branches, links fixed
# to others, a second tree that hangs from the world, and every kind of frame.
TOY = """
<mujoco model="toy">
  <compiler angle="radian" autolimits="true"/>
  <default><geom type="box" size="0.05 0.03 0.02" mass="0.4"/></default>
  <worldbody>
    <body name="base" pos="0.1 -0.2 0.5" quat="0.9 0.1 -0.3 0.2">
      <freejoint name="root"/>
      <geom name="trunk" pos="0.02 0.01 -0.03" quat="0.7 0.1 0.2 0.5" mass="3"/>
      <site name="imu" pos="-0.04 0.02 0.05" quat="0.5 -0.5 0.1 0.7"/>
      <body name="upper" pos="0.1 0.2 0.05" quat="0.8 0 0.6 0">
        <joint name="ball" type="ball" pos="0.02 -0.01 0.03"/>
        <geom pos="0.1 0 0" mass="0.8"/>
        <body name="bracket" pos="0.2 0.03 0" quat="0.6 0.8 0 0">
          <geom pos="0 0.02 0"/>
          <body name="cross" pos="0.05 0.02 0.01" quat="0.9 -0.2 0.3 0.1">
            <joint name="first" axis="1 0.2 0" pos="0.01 0.02 -0.03" ref="0.4" range="-2 2"/>
            <joint name="second" axis="0 1 0.5" pos="-0.02 0 0.01" ref="-0.7" range="-2 2"/>
            <geom pos="0 0.1 0.02"/>
            <body name="piston" pos="0.1 0 0.02" quat="0.3 0.4 0.1 -0.8">
              <joint name="slide" type="slide" axis="0.3 0.1 1" pos="0.03 0 0" ref="0.15" range="-0.5 0.5"/>
              <geom name="tip" pos="0 0 0.1" quat="0.2 0.9 0.1 0.1"/>
              <site name="tool" pos="0.02 0.03 0.15" quat="0.1 0.2 0.3 0.9"/>
            </body>
          </body>
        </body>
      </body>
      <body name="lower" pos="-0.1 0 -0.1">
        <joint name="rail" type="slide" axis="0 1 0" range="-0.3 0.3"/>
        <joint name="socket" type="ball" pos="0 0.02 0.01"/>
        <geom pos="0 0 -0.1"/>
      </body>
    </body>
    <body name="pillar" pos="1 0 0" quat="0.7 0 0 0.7">
      <geom pos="0 0 0.1" mass="2"/>
      <body name="crane" pos="0 0.1 0.4" quat="0.9 0.4 0 0">
        <joint name="swing" axis="0 0 1" pos="0.05 0 0" range="-3 3"/>
        <geom pos="0.2 0 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

NAMES = ("toy", "nao", "arm7")


def quick_jit(function):
    """Jit with little optimisation, for functions that run once."""
    return jax.jit(function, compiler_options={"xla_backend_optimization_level": 0})


def toy_robot(**options) -> osik.Robot:
    return osik.Robot.from_mjmodel(mujoco.MjModel.from_xml_string(TOY), root=("base", "crane"), **options)


def make(name: str) -> osik.Robot:
    return toy_robot() if name == "toy" else osik.load_robot(name)


@pytest.fixture(scope="module")
def robots() -> dict[str, osik.Robot]:
    return {name: make(name) for name in NAMES}


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


def random_configurations(robot: osik.Robot, seed: int, count: int = 4) -> np.ndarray:
    """Made with MuJoCo's own integrator, quaternions left off unit length to see that they are normalised."""
    rng = np.random.default_rng(seed)
    model, tree = robot.mj_model, robot.tree
    out = []
    for _ in range(count):
        full = np.array(robot.mujoco_qpos(robot.q0))
        mujoco.mj_integratePos(model, full, rng.uniform(-1.0, 1.0, model.nv), 1.0)
        q = np.concatenate([full[tree.full_qpos_address[j] : tree.full_qpos_address[j + 1]] for j in tree.independent])
        out.append(q)
    return np.array(out)


def spread(robot: osik.Robot) -> np.ndarray:
    """Matrix from v to MuJoCo's qvel, from the joints' names alone: followers move with their leaders."""
    model = robot.mj_model
    matrix = np.zeros((model.nv, robot.nv))
    for j in range(model.njnt):
        joint = model.joint(j)
        if joint.name in robot.locked_joints:
            continue
        width = {0: 6, 1: 3, 2: 1, 3: 1}[int(joint.type[0])]
        _, factor = robot.mimic_joints.get(joint.name, (None, 1.0))
        rows = np.arange(width)
        matrix[joint.dofadr[0] + rows, robot.joint_dof_index(joint.name) + rows] = factor
    return matrix


def mujoco_frame(model: mujoco.MjModel, data: mujoco.MjData, name: str):
    """Body, position and rotation of a frame, asked of MuJoCo by name."""
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body >= 0:
        return body, data.xpos[body], data.xmat[body].reshape(3, 3)
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    if site >= 0:
        return int(model.site_bodyid[site]), data.site_xpos[site], data.site_xmat[site].reshape(3, 3)
    geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
    return int(model.geom_bodyid[geom]), data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)


def moving_model(robot: osik.Robot) -> mujoco.MjModel:
    """The robot's model without the mass of what is fixed to the world: only what moves has a centre of mass here."""
    model = copy.deepcopy(robot.mj_model)
    model.body_mass[model.body_weldid == 0] = 0.0
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def mujoco_everything(robot: osik.Robot, subtree: str, q: np.ndarray) -> dict:
    """The same as ``everything``, by MuJoCo C."""
    model, matrix = moving_model(robot), spread(robot)
    data = mujoco.MjData(model)
    data.qpos[:] = np.asarray(robot.mujoco_qpos(jnp.asarray(q)))
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    positions, rotations, jacobians = [], [], []
    for name in robot.frame_names:
        body, position, rotation = mujoco_frame(model, data, name)
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, linear, angular, position.reshape(3, 1), body)
        positions.append(position)
        rotations.append(rotation)
        jacobians.append(np.vstack([linear, angular]) @ matrix)
    root = model.body(subtree).id
    whole, part = np.zeros((3, model.nv)), np.zeros((3, model.nv))
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


@pytest.mark.variants(release=["toy"])
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


@pytest.fixture(scope="module")
def panda():
    """The panda.urdf of example-robot-data, our robot, ten configurations, and our pose and Jacobian there."""
    urdf = next(f for f in files("example-robot-data") or () if f.match("panda_description/urdf/panda.urdf"))
    robot = osik.Robot.from_urdf(str(urdf.locate()), floating_base=False)
    q = np.random.default_rng(13).uniform(robot.position_lower, robot.position_upper, (10, robot.nq))

    @quick_jit
    @jax.vmap
    def tcp(q):
        kin = osik.forward_kinematics(robot, q)
        return *kin.frame_pose(robot, "panda_hand_tcp"), osik.frame_jacobian(robot, kin, "panda_hand_tcp")

    assert robot.joint_names[:7] == tuple(f"panda_joint{i}" for i in range(1, 8))
    return urdf, robot, q, tcp(q)


def test_panda_from_urdf_equals_pinocchio(panda):
    urdf, robot, q, (position, rotation, jacobian) = panda
    model = pinocchio.buildModelFromUrdf(str(urdf.locate()))
    data = model.createData()
    frame = model.getFrameId("panda_hand_tcp")
    arm = [model.joints[model.getJointId(name)].idx_v for name in robot.joint_names[:7]]
    for k, row in enumerate(q):
        full = pinocchio.neutral(model)
        full[arm] = row[:7]
        expected = pinocchio.computeFrameJacobian(
            model, data, full, frame, pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )
        np.testing.assert_allclose(position[k], data.oMf[frame].translation, atol=1e-9, rtol=0)
        np.testing.assert_allclose(rotation[k], data.oMf[frame].rotation, atol=1e-9, rtol=0)
        np.testing.assert_allclose(jacobian[k, :, :7], expected[:, arm], atol=1e-9, rtol=0)


@pytest.mark.parametrize("name", NAMES)
def test_jacobians_equal_central_differences_along_the_tangent(robots, evaluators, name):
    robot, step = robots[name], 1e-5
    q = random_configurations(robot, seed=5, count=1)[0]
    moves = np.concatenate([np.eye(robot.nv), -np.eye(robot.nv)]) * step
    moved = jax.jit(jax.vmap(lambda v: osik.integrate(robot, q, v)))(moves)
    here = jax.tree.map(lambda leaf: leaf[0], evaluators[name](robot, q[None]))
    ahead, behind = (evaluators[name](robot, np.asarray(part)) for part in (moved[: robot.nv], moved[robot.nv :]))
    linear = (ahead["poses"][0] - behind["poses"][0]) / (2 * step)
    turn = ahead["poses"][1] @ behind["poses"][1].swapaxes(-1, -2)
    angular = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec().reshape(linear.shape) / (2 * step)
    numeric = np.moveaxis(np.concatenate([linear, angular], -1), 0, -1)
    np.testing.assert_allclose(here["jacobians"], numeric, atol=1e-8, rtol=0)
    for point in ("com", "subtree_com"):
        numeric = (ahead[point] - behind[point]).T / (2 * step)
        np.testing.assert_allclose(here[f"{point}_jacobian"], numeric, atol=1e-8, rtol=0)


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


@pytest.mark.parametrize("name", ["toy", "nao"])
def test_vmap_equals_a_loop(robots, evaluators, name):
    robot = robots[name]
    q = random_configurations(robot, seed=7)
    one = quick_jit(everything(robot, SUBTREES[name]))
    assert_trees_close(evaluators[name](robot, q), stacked([one(robot, row) for row in q]), 1e-12)


def longer(robot: osik.Robot, factor: float) -> osik.Robot:
    return eqx.tree_at(lambda r: (r.body_position, r.body_mass), robot, replace_fn=lambda leaf: leaf * factor)


def test_vmap_over_robots_of_other_lengths_equals_a_loop(robots, evaluators):
    robot = robots["nao"]
    family = [longer(robot, factor) for factor in (1.0, 1.3)]
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *family)
    q = random_configurations(robot, seed=8, count=2)
    evaluate = everything(robot, SUBTREES["nao"])
    together = quick_jit(jax.vmap(evaluate))(stack, q)
    loop = [evaluators["nao"](member, row[None]) for member, row in zip(family, q, strict=True)]
    loop = [jax.tree.map(lambda leaf: leaf[0], part) for part in loop]
    assert_trees_close(together, stacked(loop), 1e-12)


def test_longer_links_equal_mujoco_with_longer_links(robots, evaluators):
    robot = robots["arm7"]
    q = random_configurations(robot, seed=9, count=1)
    edited = make("arm7")
    edited.mj_model.body_pos *= 1.2
    expected = mujoco_everything(edited, SUBTREES["arm7"], q[0])
    moved = eqx.tree_at(lambda r: r.body_position, robot, robot.body_position * 1.2)
    actual = jax.tree.map(lambda leaf: leaf[0], evaluators["arm7"](moved, q))
    assert_trees_close(actual, expected, 1e-9)


def test_a_follower_adds_its_column_to_its_leaders(robots, evaluators):
    """NAO's hips: one motor turns both, so its column moves both feet, each as MuJoCo's own joint does."""
    robot = robots["nao"]
    q = random_configurations(robot, seed=10, count=1)
    jacobians = evaluators["nao"](robot, q)["jacobians"][0]
    model = robot.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = np.asarray(robot.mujoco_qpos(q[0]))
    assert data.joint("RHipYawPitch").qpos[0] == data.joint("LHipYawPitch").qpos[0] == q[0, 9]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    column = robot.joint_dof_index("RHipYawPitch")
    assert column == robot.joint_dof_index("LHipYawPitch") == 8
    for foot, joint in (("l_ankle", "LHipYawPitch"), ("r_ankle", "RHipYawPitch")):
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacBody(model, data, linear, angular, model.body(foot).id)
        expected = np.concatenate([linear, angular])[:, model.joint(joint).dofadr[0]]
        assert np.linalg.norm(expected[3:]) == pytest.approx(1.0)
        np.testing.assert_allclose(jacobians[robot.frame_names.index(foot), :, column], expected, atol=1e-9)


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


def test_one_frame_equals_its_row_among_several(robots):
    robot = robots["nao"]
    names = ("r_sole", "gaze", "r_sole")

    @quick_jit
    def both(q):
        kin = osik.forward_kinematics(robot, q)
        several = (*kin.frame_poses(robot, names), osik.frame_jacobian(robot, kin, names))
        single = [(*kin.frame_pose(robot, name), osik.frame_jacobian(robot, kin, name)) for name in names]
        return several, single

    several, single = both(robot.q0)
    assert_trees_close(several, tuple(np.stack(parts) for parts in zip(*single, strict=True)), 1e-15)


def test_wrong_input_is_named(robots):
    robot = robots["nao"]
    kin = quick_jit(osik.forward_kinematics)(robot, robot.q0)
    with pytest.raises(KeyError, match="no frame 'l_ankel'; did you mean 'l_ankle'"):
        kin.frame_pose(robot, "l_ankel")
    with pytest.raises(KeyError, match="no frame 'hand'"):
        osik.frame_jacobian(robot, kin, "hand")
    with pytest.raises(KeyError, match="no frame 'leg'"):
        osik.center_of_mass(robot, kin, "leg")
    with pytest.raises(ValueError, match=r"q has shape \(31,\), this robot's configurations have shape \(32,\)"):
        osik.forward_kinematics(robot, robot.q0[:-1])
    with pytest.raises(ValueError, match=r"q\[3:7\], the quaternion of joint 'floating_base', is zero"):
        osik.forward_kinematics(robot, robot.q0.at[3:7].set(0.0))
    with pytest.raises(ValueError, match=r"q is not finite at indices \[9\]"):
        osik.forward_kinematics(robot, robot.q0.at[9].set(jnp.nan))
    feather = eqx.tree_at(lambda r: r.body_mass, robot, robot.body_mass.at[-1].set(0.0))
    for function in (osik.center_of_mass, osik.com_jacobian):
        with pytest.raises(ValueError, match="the subtree of 'r_gripper' has no mass"):
            function(feather, kin, "r_gripper")


def microseconds(function, q) -> float:
    """Shortest time of a call, per configuration."""
    compiled = jax.jit(jax.vmap(function)).lower(q).compile()
    times = []
    for _ in range(30):
        start = time.perf_counter()
        jax.block_until_ready(compiled(q))
        times.append(time.perf_counter() - start)
    return 1e6 * min(times) / len(q)


@pytest.mark.slow
def test_a_serial_chain_costs_microseconds(robots):
    """XLA's CPU backend can recompute every parent of every link of a chain: thousands of microseconds for an arm."""
    robot = robots["arm7"]

    def pose(q):
        return osik.forward_kinematics(robot, q).frame_pose(robot, "flange")

    def height(q):
        position, rotation = pose(q)
        return position[2] + jnp.sum(jnp.sin(rotation))

    one, batch = (jnp.asarray(random_configurations(robot, seed=12, count=n)) for n in (1, 1024))
    assert microseconds(pose, batch) < 20.0
    assert microseconds(jax.grad(height), batch) < 60.0
    assert microseconds(pose, one) < 1500.0


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
