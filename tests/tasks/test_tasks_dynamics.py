"""Mass matrix, momentum, energy and manipulability against MuJoCo C, pink and central differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pinocchio as pin
import pytest
from model_files import mjcf
from mujoco_states import full_velocities
from pink import Configuration
from pink.tasks import ManipulabilityTask as PinkManipulabilityTask
from refusals import refuses
from task_checks import alone, assert_every_number_counts, assert_finite_gradients, rows_of_each

import osik_jax as osik
from osik_jax.robot.loading import example_urdf

MODEL = mjcf("inertias")
LANES = 4


@pytest.fixture(scope="module")
def robot():
    return osik.Robot.from_mjcf(MODEL, locked_joints={"stuck": 0.4})


@pytest.fixture(scope="module")
def states(robot):
    """Configurations anywhere and velocities. (LANES, nq), (LANES, nv)"""
    rng = np.random.default_rng(5)
    steps = jnp.asarray(rng.uniform(-1.5, 1.5, (LANES, robot.nv)))
    q = jax.jit(jax.vmap(osik.integrate, in_axes=(None, None, 0)))(robot, robot.q0, steps)
    return q, rng.normal(size=(LANES, robot.nv))


@pytest.fixture(scope="module")
def oracles(robot, states):
    """MuJoCo's data at each state, with velocities of all its joints, and the matrix that makes them from v."""
    model, full = robot.mj_model, full_velocities(robot)
    out = []
    for q, v in zip(*states, strict=True):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = robot.mujoco_qpos(q), full @ v
        mujoco.mj_forward(model, data)
        mujoco.mj_energyVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        out.append(data)
    return out, full


_matrices = jax.jit(
    jax.vmap(
        lambda robot, q: (
            osik.mass_matrix(robot, osik.forward_kinematics(robot, q)),
            osik.centroidal_momentum_matrix(robot, osik.forward_kinematics(robot, q)),
        ),
        in_axes=(None, 0),
    )
)


class TestMatrices:
    def test_mass_matrix_is_mujocos(self, robot, states, oracles):
        datas, full = oracles
        ours, _ = _matrices(robot, states[0])
        for matrix, data, v in zip(ours, datas, states[1], strict=True):
            expected = np.zeros((robot.mj_model.nv, robot.mj_model.nv))
            mujoco.mj_fullM(robot.mj_model, data, expected)
            np.testing.assert_allclose(matrix, full.T @ expected @ full, rtol=0.0, atol=1e-13)
            assert v @ matrix @ v / 2.0 == pytest.approx(data.energy[1], rel=1e-13)

    def test_momentum_is_mujocos(self, robot, states, oracles):
        datas, _ = oracles
        _, ours = _matrices(robot, states[0])
        trunk, mass = robot.mj_model.body("trunk").id, float(robot.body_mass.sum())
        for matrix, data, v in zip(ours, datas, states[1], strict=True):
            np.testing.assert_allclose(matrix[:3] @ v, mass * data.subtree_linvel[trunk], rtol=0.0, atol=1e-12)
            np.testing.assert_allclose(matrix[3:] @ v, data.subtree_angmom[trunk], rtol=0.0, atol=1e-12)

    def test_single_precision_keeps_small_links(self, robot, states):
        """Far from the origin, the wrist's own inertia is a 10,000th of what it has about there."""
        exact, _ = _matrices(robot, states[0])
        moved = states[0].at[:, :3].add(jnp.array([30.0, -20.0, 5.0]))
        with jax.enable_x64(False):
            single = osik.Robot.from_mjcf(MODEL, locked_joints={"stuck": 0.4})
            rough, _ = _matrices(single, jnp.asarray(np.asarray(moved), jnp.float32))
        scale = np.sqrt(np.diagonal(exact, axis1=1, axis2=2))
        error = np.abs(np.asarray(rough, float) - exact) / (scale[:, :, None] * scale[:, None])
        assert error.max() < 1e-4, error.max()


def _solve(robot, q, tasks, scheme):
    """Of all lanes; tasks are shared."""
    return jax.jit(jax.vmap(lambda q: osik.solve(robot, q, tasks, scheme=scheme, limits=osik.no_limits)))(q)


class TestAngularMomentum:
    def test_rows_are_the_momentum(self, robot, states, oracles):
        trunk = robot.mj_model.body("trunk").id
        tasks = {
            "all": osik.AngularMomentumTask(robot, target=[0.1, 0.2, 0.3], weight=2.0),
            "zx": osik.AngularMomentumTask(robot, axes="zx", target=[0.1, 0.2, 0.3]),
            "bounds": osik.AngularMomentumTask(robot, axes="y", lower=-0.1, upper=0.2),
        }
        rows = jax.jit(jax.vmap(rows_of_each, in_axes=(None, None, 0)))(robot, tasks, states[0])
        for k, (data, v) in enumerate(zip(oracles[0], states[1], strict=True)):
            momentum = data.subtree_angmom[trunk]
            np.testing.assert_allclose(rows["all"].jacobian[k] @ v, momentum, atol=1e-12)
            np.testing.assert_allclose(rows["zx"].jacobian[k] @ v, momentum[[2, 0]], atol=1e-12)
            np.testing.assert_allclose(rows["bounds"].jacobian[k] @ v, momentum[[1]], atol=1e-12)
        np.testing.assert_array_equal(rows["zx"].lower[0], [0.3, 0.1])
        np.testing.assert_array_equal(rows["all"].weight[0], [2.0, 2.0, 2.0])
        np.testing.assert_array_equal((rows["bounds"].lower[0], rows["bounds"].upper[0]), ([-0.1], [0.2]))
        assert all(not np.asarray(r.error).any() for r in rows.values())

    @pytest.mark.release
    def test_a_reach_turns_the_floating_robot_by_as_much(self, robot, states):
        """With no momentum, MuJoCo's is 0 at the answer, though the arm moves."""
        rate = np.array([0.3, -0.2, 0.1, 0.0, 0.0, 0.0])
        tasks = {
            "momentum": osik.AngularMomentumTask(robot, priority=1),
            "tip": osik.FrameTask(robot, "tip", rows="position", gain=0.0, target_velocity=rate, priority=2),
        }
        answer = _solve(robot, states[0], tasks, osik.HierarchicalQP())
        trunk, full = robot.mj_model.body("trunk").id, full_velocities(robot)
        for q, v in zip(states[0], answer.velocity, strict=True):
            data = mujoco.MjData(robot.mj_model)
            data.qpos[:], data.qvel[:] = robot.mujoco_qpos(q), full @ v
            mujoco.mj_forward(robot.mj_model, data)
            mujoco.mj_subtreeVel(robot.mj_model, data)
            np.testing.assert_allclose(data.subtree_angmom[trunk], 0.0, atol=1e-12)
            velocity = np.zeros(6)
            site = robot.mj_model.site("tip").id
            mujoco.mj_objectVelocity(robot.mj_model, data, mujoco.mjtObj.mjOBJ_SITE, site, velocity, 0)
            np.testing.assert_allclose(velocity[3:], rate[:3], atol=1e-9)

    def test_mistakes(self, robot):
        task = osik.AngularMomentumTask(robot, axes="xy", lower=-1.0, upper=1.0)
        refuses(ValueError, "lower > upper", task.replace, lower=2.0)
        refuses(TypeError, "it has: weight, lower, upper", task.replace, gain=2.0)
        np.testing.assert_array_equal(
            osik.AngularMomentumTask(robot, axes="zy").replace(target=[1, 2, 3]).target, [3, 2]
        )


class TestKineticEnergy:
    def test_weighted_squares_are_the_energy(self, robot, states, oracles):
        tasks = {"energy": osik.KineticEnergyTask(robot, weight=0.5)}
        rows = jax.jit(jax.vmap(rows_of_each, in_axes=(None, None, 0)))(robot, tasks, states[0])["energy"]
        for k, (data, v) in enumerate(zip(oracles[0], states[1], strict=True)):
            cost = rows.weight[k] @ (rows.jacobian[k] @ v) ** 2 / 2.0
            assert cost == pytest.approx(0.5 * data.energy[1], rel=1e-11)

    @pytest.mark.slow
    def test_of_all_motions_the_least_energy(self, robot, states, oracles):
        """Khatib's inertia-weighted inverse, from MuJoCo's mass matrix and Jacobian."""
        rate = np.array([0.3, -0.2, 0.1, 0.0, 0.0, 0.0])
        tasks = {
            "tip": osik.FrameTask(robot, "tip", rows="position", gain=0.0, target_velocity=rate, priority=1),
            "energy": osik.KineticEnergyTask(robot, priority=2),
        }
        answer = _solve(robot, states[0], tasks, osik.HierarchicalQP())
        datas, full = oracles
        model = robot.mj_model
        for data, v in zip(datas, answer.velocity, strict=True):
            mass, linear = np.zeros((model.nv, model.nv)), np.zeros((3, model.nv))
            mujoco.mj_fullM(model, data, mass)
            mujoco.mj_jacSite(model, data, linear, None, model.site("tip").id)
            weighted = np.linalg.solve(full.T @ mass @ full, (linear @ full).T)
            expected = weighted @ np.linalg.solve(linear @ full @ weighted, rate[:3])
            np.testing.assert_allclose(v, expected, atol=1e-9)

    @pytest.mark.release
    def test_finite_where_a_motion_moves_no_mass(self):
        """Two hinges about one axis, and one about the line on which all the mass is: M has rank 1."""
        robot = osik.Robot.from_mjcf(
            """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/>
            <inertial pos="0 0 0" mass="1" diaginertia="1e-3 1e-3 1e-3"/>
            <body><joint name="b" axis="0 1 0"/><joint name="c" axis="1 0 0"/>
            <inertial pos="0.3 0 0" mass="1" diaginertia="1e-9 1e-9 1e-9"/></body></body></worldbody></mujoco>"""
        )
        point = eqx.tree_at(lambda r: r.body_inertia, robot, jnp.zeros_like(robot.body_inertia))
        rows = rows_of_each(point, {"energy": osik.KineticEnergyTask(point)}, point.q0)["energy"]
        expected = 0.09 * np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
        np.testing.assert_allclose(rows.jacobian.T @ rows.jacobian, expected, atol=1e-14)
        assert_finite_gradients(rows_of_each, *alone(point, {"energy": osik.KineticEnergyTask(point)}, point.q0))


FLAT = (True, True) + (False,) * 4


@pytest.fixture(scope="module")
def planar():
    """Two links of half a metre."""
    return osik.Robot.from_mjcf(
        """<mujoco><worldbody><body><joint name="a" axis="0 0 1"/><geom size="0.1"/>
        <body pos="0.5 0 0"><joint name="b" axis="0 0 1"/><geom size="0.1"/><site name="tip" pos="0.5 0 0"/>
        </body></body></worldbody></mujoco>"""
    )


@pytest.fixture(scope="module")
def panda():
    return osik.load_robot("panda")


def _index(robot, **options):
    return osik.ManipulabilityTask(robot, "hand", **options)


class TestManipulability:
    @pytest.mark.variants(slow=["position"], release=["orientation"])
    @pytest.mark.parametrize("rows", ["pose", "position", "orientation"])
    def test_index_and_slope_are_pinks(self, panda, rows):
        model = pin.buildModelFromUrdf(str(example_urdf("panda")))
        mask = {"pose": None}.get(rows, rows)
        theirs = PinkManipulabilityTask("panda_hand", model, mask=mask)
        task = osik.ManipulabilityTask(panda, "panda_hand", rows=rows, target=0.05, log=False)
        rng = np.random.default_rng(3)
        q = np.append(rng.uniform(panda.position_lower, panda.position_upper)[:7], 0.01)
        own = rows_of_each(panda, {"m": task}, jnp.asarray(q))["m"]

        def index(joints):
            return theirs.compute_manipulability(
                Configuration(model, model.createData(), np.append(joints, [q[7]] * 2))
            )

        assert own.error[0] + 0.05 == pytest.approx(index(q[:7]), rel=1e-10)
        steps = 1e-6 * np.eye(7)
        slope = [(index(q[:7] + step) - index(q[:7] - step)) / 2e-6 for step in steps]
        np.testing.assert_allclose(own.jacobian[0], [*slope, 0.0], atol=1e-8)

    @pytest.mark.release
    def test_forms_against_singular_values(self, arm):
        """Chosen rows and joints in the frame's axes, the logarithm; slopes by differences. A row a dof to climb."""
        q = arm.configuration({name: 0.3 + 0.2 * i for i, name in enumerate(arm.joint_names)})
        kept, some = (True, True, False, False, False, True), arm.joint_names[1:6]
        tasks = {
            "own": _index(arm, target=0.02, rows=kept, joints=some, axes="frame", gain=3.0, target_velocity=0.4),
            "log": _index(arm, lower=-1.0, rows="position", log=True, gain=2.0, target_velocity=0.5),
            "climb": _index(arm, rows="position", gain=2.0, weight=3.0),
        }
        rows = rows_of_each(arm, tasks, q)
        steps = 1e-6 * jnp.concatenate([jnp.zeros((1, arm.nv)), jnp.eye(arm.nv), -jnp.eye(arm.nv)])

        @jax.jit
        @jax.vmap
        def around(step):
            kinematics = osik.forward_kinematics(arm, osik.integrate(arm, q, step))
            return osik.frame_jacobian(arm, kinematics, "hand"), kinematics.frame_pose(arm, "hand")[1]

        jacobian, turn = (np.asarray(a) for a in around(steps))
        turned = np.concatenate([turn.mT @ jacobian[:, :3], turn.mT @ jacobian[:, 3:]], 1)
        own, whole = (
            np.prod(np.linalg.svd(matrix, compute_uv=False), -1)
            for matrix in (turned[:, np.array(kept)][:, :, 1:6], jacobian[:, :3])
        )

        def slope(values):
            return (values[1 : arm.nv + 1] - values[arm.nv + 1 :]) / 2e-6

        assert rows["own"].error[0] == pytest.approx(own[0] - 0.02, rel=1e-10)
        assert rows["own"].lower[0] == pytest.approx(0.4 - 3.0 * (own[0] - 0.02), rel=1e-10)
        np.testing.assert_allclose(rows["own"].jacobian[0], slope(own), atol=1e-8)
        assert rows["log"].error[0] == pytest.approx(np.log(whole[0]), rel=1e-12)
        assert rows["log"].lower[0] == pytest.approx(2.0 * (-1.0 - np.log(whole[0])) + 0.5, rel=1e-12)
        assert rows["log"].upper[0] == np.inf
        np.testing.assert_allclose(rows["log"].jacobian[0], slope(np.log(whole)), atol=1e-7)
        np.testing.assert_allclose(rows["climb"].lower, 2.0 * slope(whole), atol=1e-8)
        np.testing.assert_array_equal(rows["climb"].jacobian, np.eye(arm.nv))
        np.testing.assert_array_equal(rows["climb"].weight, np.full(arm.nv, 3.0))

    def test_followers_count_with_their_leaders(self, robot):
        climbs = osik.ManipulabilityTask(robot, "hand", rows=(False, False, True, True, False, False))
        names = [robot.tree.joint_names[j] for j, dof in robot.tree.dof_address.items() if dof in climbs.dofs]
        assert names == ["elbow", "lift"]  # the wrist follows the elbow

    @pytest.mark.release
    def test_climbing_reaches_a_greatest_index(self, planar):
        """Of the elbow of a planar arm: at a right angle between its two equal links."""
        task = osik.ManipulabilityTask(planar, "tip", rows=FLAT, gain=20.0)
        start = jnp.array([0.2, 0.3])
        path = osik.rollout(
            planar, start, {"m": task}, scheme=osik.WeightedQP(damping=1e-9), dt=0.02, steps=200, limits=osik.no_limits
        )
        np.testing.assert_allclose(path.q[-1], [0.2, np.pi / 2], atol=1e-6)

    @pytest.mark.release
    def test_a_lower_bound_keeps_away_from_singularities(self, planar):
        """A tip pulled out of reach: its index is sin(elbow) / 4, and the elbow stays bent by as much as is asked."""
        far = np.array([1.5, 0.0, 0.0]), np.eye(3)
        reach = osik.FrameTask(planar, "tip", rows=FLAT, target=far, gain=2.0)
        bound = osik.ManipulabilityTask(planar, "tip", rows=FLAT, lower=0.05, hard=True)
        start, scheme = jnp.array([0.5, 1.0]), osik.WeightedQP(damping=1e-3)
        limits = (osik.VelocityLimit(planar, velocity={"*": 2.0}),)
        tasks = {"reach": reach, "index": bound}
        path = osik.rollout(planar, start, tasks, scheme=scheme, limits=limits, dt=0.01, steps=200)
        index = np.sin(np.asarray(path.q[:, 1])) / 4.0
        assert index[0] > 0.2
        assert index.min() > 0.05 - 1e-3
        assert index[-1] == pytest.approx(0.05, abs=1e-5)

    @pytest.mark.release
    def test_finite_where_it_is_singular(self, planar):
        """Stretched out; and close to it, where nothing but the size of the index changes."""
        tasks = {
            "flat": osik.ManipulabilityTask(planar, "tip", rows=FLAT, lower=0.1),
            "log": osik.ManipulabilityTask(planar, "tip", rows=FLAT, lower=0.1, log=True),
            "climb": osik.ManipulabilityTask(planar, "tip", rows=FLAT),
        }
        straight = jnp.array([0.2, 0.0])
        rows = rows_of_each(planar, tasks, straight)
        assert rows["flat"].error[0] == 0.0
        assert rows["log"].error[0] == pytest.approx(np.log(np.finfo(float).tiny))
        np.testing.assert_array_equal(rows["climb"].lower, [0.0, 0.0])
        assert_finite_gradients(
            rows_of_each, *alone(planar, {name: tasks[name] for name in ("log", "climb")}, straight)
        )
        near = rows_of_each(planar, tasks, jnp.array([0.2, 1e-7]))
        assert near["flat"].error[0] == pytest.approx(0.25e-7, rel=1e-7)
        np.testing.assert_allclose(near["flat"].jacobian, [[0.0, 0.25]], atol=1e-7)

    def test_mistakes(self, arm):
        with pytest.raises(ValueError, match="2 dofs of the chosen joints move 'hand'"):
            osik.ManipulabilityTask(arm, "hand", joints=arm.joint_names[:2])
        refuses(TypeError, "there are none", osik.ManipulabilityTask, arm, "hand", target_velocity=0.1)


def test_every_number_counts_and_nothing_compiles_again(planar):
    tasks = {
        "bounds": osik.ManipulabilityTask(planar, "tip", rows=FLAT, lower=0.1, upper=0.2),
        "climb": osik.ManipulabilityTask(planar, "tip", rows=FLAT, gain=osik.AdaptiveGain(4.0, 1.0, 2.0)),
    }
    assert_every_number_counts(planar, tasks, jnp.array([0.3, 0.7]))
