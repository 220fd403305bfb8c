"""Tasks against central differences, mink, Pinocchio, SciPy and numbers worked out by hand."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import mink
import mujoco
import numpy as np
import pinocchio as pin
import pytest
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax.tasks._gain import safe_norm
from osik_jax.tasks._rotation import inverse_left_jacobian, rotation_log
from osik_jax.tasks._rows import rows_of

MASK = (True, True, False, True, False, True)
SEED = 7
SMALL = """
<mujoco><worldbody>
  <body><joint name="ball" type="ball"/><geom size="0.1"/>
    <body name="tip" pos="0.3 0.1 0.2"><joint name="hinge" axis="0 1 1" range="-1 1"/><geom size="0.1"/></body>
  </body>
</worldbody></mujoco>
"""


@pytest.fixture(scope="module")
def nao():
    return osik.load_robot("nao")


@pytest.fixture(scope="module")
def arm():
    return osik.load_robot("arm7")


@jax.jit
def _rows(robot, tasks, q):
    kinematics = osik.forward_kinematics(robot, q)
    return {name: task.rows(robot, kinematics, q) for name, task in tasks.items()}


_kinematics = jax.jit(osik.forward_kinematics)


@jax.jit
def _step(robot, q, v):
    return osik.integrate(robot, q, v)


@jax.jit
def _rows_and_differences(robot, tasks, q, h=1e-6):
    """The rows, and their errors' Jacobians by central differences along the tangent."""
    steps = h * jnp.concatenate([jnp.zeros((1, robot.nv)), jnp.eye(robot.nv), -jnp.eye(robot.nv)])
    batch = jax.vmap(lambda v: _rows(robot, tasks, osik.integrate(robot, q, v)))(steps)
    ahead, behind = slice(1, robot.nv + 1), slice(robot.nv + 1, None)
    differences = {k: (r.error[ahead] - r.error[behind]).T / (2 * h) for k, r in batch.items()}
    return jax.tree.map(lambda x: x[0], batch), differences


def _random_q(robot, rng):
    """Joints anywhere, a base anywhere: the formulas hold outside the joint ranges too."""
    return np.asarray(_step(robot, robot.q0, jnp.asarray(rng.uniform(-1.0, 1.0, robot.nv))))


def _random_pose(rng, near):
    return near + rng.normal(size=3) * 0.3, Rotation.from_quat(rng.normal(size=4)).as_matrix()


def _square(scale=0.1):
    normals = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    vertices = scale * np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]])
    return osik.SupportPolygon(jnp.asarray(normals), jnp.full(4, scale), jnp.asarray(vertices))


def _all_tasks(robot, frame, subtree, rng):
    pose = _random_pose(rng, np.asarray(_kinematics(robot, robot.q0).frame_pose(robot, frame)[0]))
    some = robot.joint_names[1:4]
    tasks = {
        "world": osik.FrameTask(robot, frame, target=pose),
        "own": osik.FrameTask(robot, frame, target=pose, axes="frame"),
        "world mask": osik.FrameTask(robot, frame, target=pose, rows=MASK),
        "own mask": osik.FrameTask(robot, frame, target=pose, rows=MASK, axes="frame"),
        "position": osik.FrameTask(robot, frame, target=pose, rows="position"),
        "orientation": osik.FrameTask(robot, frame, target=pose, rows="orientation", axes="frame"),
        "frame bounds": osik.FrameTask(robot, frame, target=pose, axes="frame", lower=-0.1, upper=[0.1] * 6),
        "com": osik.ComTask(robot),
        "com zy, subtree": osik.ComTask(robot, axes="zy", subtree=subtree, target=[0.1, 0.2, 0.3]),
        "com bounds": osik.ComTask(robot, axes="xy", lower=[-0.1, 0.0]),
        "com polygon": osik.ComTask(robot, polygon=_square()),
        "posture": osik.PostureTask(robot),
        "some joints": osik.PostureTask(robot, joints=some),
        "joint bounds": osik.PostureTask(robot, joints=some, lower=-0.1, upper=0.1),
    }
    if robot.floating_base:
        base = next(n for n, t in zip(robot.tree.joint_names, robot.tree.joint_types, strict=True) if t == 0)
        q = _random_q(robot, rng)
        tasks["base"] = osik.PostureTask(robot, joints=(base, some[0]), target=q)
    return tasks


def _cases(nao, arm):
    rng = np.random.default_rng(SEED)
    return (nao, _all_tasks(nao, "r_wrist", "r_wrist", rng), rng), (arm, _all_tasks(arm, "hand", None, rng), rng)


class TestJacobians:
    def test_every_task_against_central_differences(self, nao, arm):
        for robot, tasks, rng in _cases(nao, arm):
            for _ in range(3):
                q = jnp.asarray(_random_q(robot, rng))
                rows, expected = _rows_and_differences(robot, tasks, q)
                for name, row in rows.items():
                    scale = max(1.0, np.abs(expected[name]).max())
                    np.testing.assert_allclose(row.jacobian, expected[name], atol=1e-7 * scale, rtol=0, err_msg=name)

    def test_geometric_is_the_analytic_one_without_the_inverse_jacobian(self, arm, rng):
        frame = "hand"
        pose = _random_pose(rng, np.zeros(3))
        both = {
            (axes, kind): osik.FrameTask(arm, frame, target=pose, axes=axes, orientation_jacobian=kind)
            for axes in ("world", "frame")
            for kind in ("analytic", "geometric")
        }
        q = jnp.asarray(_random_q(arm, rng))
        rows = _rows(arm, both, q)
        R = np.asarray(_kinematics(arm, q).frame_pose(arm, frame)[1])
        angular = np.asarray(osik.frame_jacobian(arm, _kinematics(arm, q), frame))[3:]
        np.testing.assert_allclose(rows["world", "geometric"].jacobian[3:], angular, atol=1e-14)
        np.testing.assert_allclose(rows["frame", "geometric"].jacobian[3:], R.T @ angular, atol=1e-14)
        for axes, factor in (("world", pin.Jlog3(R @ pose[1].T).T), ("frame", pin.Jlog3(pose[1].T @ R))):
            expected = factor @ np.asarray(rows[axes, "geometric"].jacobian[3:])
            np.testing.assert_allclose(rows[axes, "analytic"].jacobian[3:], expected, atol=1e-12)
            np.testing.assert_array_equal(rows[axes, "analytic"].error, rows[axes, "geometric"].error)

    def test_masks_pick_rows_of_the_whole(self, arm, rng):
        tasks = _all_tasks(arm, "hand", None, rng)
        rows, _ = _rows_and_differences(arm, tasks, jnp.asarray(_random_q(arm, rng)))
        for whole, part in (("world", "world mask"), ("own", "own mask")):
            for field in ("error", "jacobian", "lower", "upper", "weight"):
                expected = np.asarray(getattr(rows[whole], field))[np.array(MASK)]
                np.testing.assert_array_equal(getattr(rows[part], field), expected)


class TestErrors:
    def test_frame_errors_against_scipy(self, nao, rng):
        pose = _random_pose(rng, np.zeros(3))
        tasks = {axes: osik.FrameTask(nao, "r_wrist", target=pose, axes=axes) for axes in ("world", "frame")}
        q = jnp.asarray(_random_q(nao, rng))
        p, R = map(np.asarray, _kinematics(nao, q).frame_pose(nao, "r_wrist"))
        rows = _rows(nao, tasks, q)
        world = np.concatenate([p - pose[0], Rotation.from_matrix(R @ pose[1].T).as_rotvec()])
        own = np.concatenate([R.T @ (p - pose[0]), Rotation.from_matrix(pose[1].T @ R).as_rotvec()])
        np.testing.assert_allclose(rows["world"].error, world, atol=1e-13)
        np.testing.assert_allclose(rows["frame"].error, own, atol=1e-13)
        np.testing.assert_allclose(rows["world"].lower, -10.0 * world, atol=1e-12)
        np.testing.assert_array_equal(rows["world"].lower, rows["world"].upper)

    def test_default_targets_leave_no_error_at_home(self, nao):
        tasks = {
            "foot": osik.FrameTask(nao, "l_sole"),
            "own": osik.FrameTask(nao, "l_sole", axes="frame"),
            "com": osik.ComTask(nao),
            "posture": osik.PostureTask(nao),
        }
        for rows in _rows(nao, tasks, nao.q0).values():
            np.testing.assert_allclose(rows.error, 0.0, atol=1e-14)

    def test_a_matrix_is_a_pose(self, arm, rng):
        p, R = _random_pose(rng, np.zeros(3))
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = R, p
        task = osik.FrameTask(arm, "hand", target=matrix)
        np.testing.assert_array_equal(task.target[0], p)
        np.testing.assert_array_equal(task.target[1], R)

    def test_weights_multiply(self, arm):
        frame = "hand"
        task = osik.FrameTask(arm, frame, position_weight=[1.0, 2.0, 3.0], orientation_weight=0.5, weight=4.0)
        expected = [4.0, 8.0, 12.0, 2.0, 2.0, 2.0]
        np.testing.assert_array_equal(_rows(arm, {"a": task}, arm.q0)["a"].weight, expected)


def _reduction(robot):
    """Full MuJoCo velocities from v, built from names alone. (full nv, nv)."""
    model, out = robot.mj_model, np.zeros((robot.mj_model.nv, robot.nv))
    for joint in range(model.njnt):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
        _, multiplier = robot.mimic_joints.get(name, (name, 1.0))
        width = 6 if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE else 1
        start, own = model.jnt_dofadr[joint], robot.joint_dof_index(name)
        out[start : start + width, own : own + width] = multiplier * np.eye(width)
    return out


class TestAgainstMink:
    """mink's body twists coincide with ours on orientation in own axes, the centre of mass and the posture."""

    @pytest.fixture
    def case(self, nao):
        rng = np.random.default_rng(SEED)
        q = jnp.asarray(_random_q(nao, rng))
        configuration = mink.Configuration(nao.mj_model, q=np.asarray(nao.mujoco_qpos(q)))
        return nao, q, configuration, _random_pose(rng, np.zeros(3)), _reduction(nao)

    def test_orientation(self, case):
        robot, q, configuration, (p, R), reduction = case
        theirs = mink.FrameTask("l_sole", "site", position_cost=1.0, orientation_cost=1.0)
        theirs.set_target(mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(R), p))
        ours = osik.FrameTask(robot, "l_sole", target=(p, R), axes="frame", rows="orientation")
        rows = _rows(robot, {"a": ours}, q)["a"]
        np.testing.assert_allclose(rows.error, -theirs.compute_error(configuration)[3:], atol=1e-10)
        expected = -theirs.compute_jacobian(configuration)[3:] @ reduction
        np.testing.assert_allclose(rows.jacobian, expected, atol=1e-9)

    def test_position(self, case):
        """mink's linear part is ours in own axes where the orientation is already right; its error only."""
        robot, q, configuration, (p, _), reduction = case
        _, R = map(np.asarray, _kinematics(robot, q).frame_pose(robot, "l_sole"))
        theirs = mink.FrameTask("l_sole", "site", position_cost=1.0, orientation_cost=1.0)
        theirs.set_target(mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(R), p))
        tasks = {
            "own": osik.FrameTask(robot, "l_sole", target=(p, R), axes="frame", rows="position"),
            "world": osik.FrameTask(robot, "l_sole", target=(p, R), rows="position"),
        }
        rows = _rows(robot, tasks, q)
        np.testing.assert_allclose(rows["own"].error, -theirs.compute_error(configuration)[:3], atol=1e-10)
        linear = R @ configuration.get_frame_jacobian("l_sole", "site")[:3] @ reduction
        np.testing.assert_allclose(rows["world"].jacobian, linear, atol=1e-10)

    def test_center_of_mass(self, case):
        robot, q, configuration, (p, _), reduction = case
        theirs = mink.ComTask(cost=1.0)
        theirs.set_target(p)
        rows = _rows(robot, {"a": osik.ComTask(robot, target=p)}, q)["a"]
        np.testing.assert_allclose(rows.error, theirs.compute_error(configuration), atol=1e-10)
        np.testing.assert_allclose(rows.jacobian, theirs.compute_jacobian(configuration) @ reduction, atol=1e-10)

    def test_posture(self, case):
        robot, q, configuration, _, _ = case
        theirs = mink.PostureTask(robot.mj_model, cost=1.0)
        theirs.set_target(np.asarray(robot.mujoco_qpos(robot.q0)))
        rows = _rows(robot, {"a": osik.PostureTask(robot)}, q)["a"]
        error = theirs.compute_error(configuration)
        address = [robot.mj_model.joint(name).dofadr[0] for name in robot.joint_names]
        np.testing.assert_allclose(rows.error, error[address], atol=1e-12)
        np.testing.assert_array_equal(rows.jacobian, np.eye(robot.nv)[6:])


class TestRotation:
    @pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.9e-3, 2.1e-3, 0.09, 0.11, 1.0, 3.0, math.pi - 1e-5])
    def test_against_scipy_and_pinocchio(self, angle, rng):
        axis = rng.normal(size=3)
        vector = angle * axis / np.linalg.norm(axis)
        R = Rotation.from_rotvec(vector).as_matrix()
        np.testing.assert_allclose(rotation_log(jnp.asarray(R)), vector, atol=3e-14)
        expected = pin.Jlog3(R).T
        np.testing.assert_allclose(inverse_left_jacobian(jnp.asarray(vector)), expected, atol=1e-10)

    @pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, 0.8)])
    @pytest.mark.parametrize("angle", [0.0, 1e-12, 1.0, math.pi - 1e-7, math.pi])
    def test_the_logarithm_differentiates_to_the_inverse_jacobian(self, axis, angle):
        """At pi too, where a branch of the logarithm that holds the angle constant would be wrong."""
        R = jnp.asarray(Rotation.from_rotvec(angle * np.array(axis)).as_matrix())
        generators = jnp.stack([jnp.cross(e, R.T).T for e in jnp.eye(3)])
        derivative = jax.jacfwd(lambda w: rotation_log(R + jnp.tensordot(w, generators, 1)))(jnp.zeros(3))
        np.testing.assert_allclose(derivative, inverse_left_jacobian(rotation_log(R)), atol=1e-7)

    def test_norm(self):
        np.testing.assert_array_equal(jax.grad(safe_norm)(jnp.zeros(3)), np.zeros(3))
        np.testing.assert_allclose(safe_norm(jnp.array([3.0, 4.0])), 5.0, rtol=1e-15)


class TestGain:
    def test_equation_3_by_hand(self):
        gain = osik.AdaptiveGain(10.0, 2.0, 3.0)
        # ||(0.3, 0.4)|| = 0.5; 8 exp(-1.5) + 2 with exp(-1.5) = 0.22313016014842982
        np.testing.assert_allclose(gain(jnp.array([0.3, 0.4])), 3.7850412811874386, rtol=1e-15)
        np.testing.assert_allclose(gain(jnp.zeros(2)), 10.0, rtol=0)
        np.testing.assert_allclose(gain(jnp.full(2, 100.0)), 2.0, rtol=1e-15)
        np.testing.assert_array_equal(jax.grad(lambda e: gain(e))(jnp.zeros(2)), np.zeros(2))

    def test_in_a_task(self, arm):
        frame = "hand"
        p, R = _kinematics(arm, arm.q0).frame_pose(arm, frame)
        target = (p - jnp.array([0.3, 0.4, 0.0]), R)
        gain = osik.AdaptiveGain(10.0, 2.0, 3.0)
        tasks = {
            "pose": osik.FrameTask(arm, frame, target=target, gain=gain),
            # rows of weight 0 do not count: the error that is left is (0.3, 0, 0), 8 exp(-0.9) + 2
            "x alone": osik.FrameTask(arm, frame, target=target, gain=gain, position_weight=[1, 0, 0]),
            # distance to the interval (0.3 - 0.25, 0.4 - 0.25), norm 0.15811388300841897
            "bounds": osik.FrameTask(arm, frame, target=target, gain=gain, rows="position", upper=0.25),
            "inside": osik.FrameTask(arm, frame, target=target, gain=gain, rows="position", upper=0.5),
        }
        rows = _rows(arm, tasks, arm.q0)
        np.testing.assert_allclose(rows["pose"].lower[:3], [-1.1355123843562316, -1.5140165124749755, 0.0], atol=1e-13)
        np.testing.assert_allclose(rows["x alone"].lower[0], -0.3 * 5.252557277924793, atol=1e-13)
        np.testing.assert_array_equal(rows["bounds"].lower, np.full(3, -np.inf))
        rate = 8.0 * math.exp(-3.0 * 0.15811388300841897) + 2.0
        np.testing.assert_allclose(rows["bounds"].upper, rate * np.array([-0.05, -0.15, 0.25]), atol=1e-13)
        np.testing.assert_allclose(rows["inside"].upper, 10.0 * np.array([0.2, 0.1, 0.5]), atol=1e-13)

    def test_a_gain_of_zero_keeps_infinite_bounds(self, arm):
        task = osik.PostureTask(arm, lower=-0.1, gain=0.0)
        rows = _rows(arm, {"a": task}, arm.q0)["a"]
        np.testing.assert_array_equal(rows.upper, np.full(arm.nv, np.inf))
        np.testing.assert_array_equal(rows.lower, np.zeros(arm.nv))


class TestInequalities:
    def test_bounds_are_on_the_coordinates(self, nao, rng):
        q = jnp.asarray(_random_q(nao, rng))
        c = np.asarray(osik.center_of_mass(nao, _kinematics(nao, q)))
        joints = nao.joint_names[3:5]
        values = np.asarray(q)[[nao.joint_qpos_index(name) for name in joints]]
        tasks = {
            "com": osik.ComTask(nao, axes="xz", lower=[0.1, 0.2], upper=0.5, gain=4.0, target_velocity=[1.0, 2.0]),
            "polygon": osik.ComTask(nao, polygon=_square(), gain=4.0),
            "joints": osik.PostureTask(nao, joints=joints, lower=[-0.1, -0.2], gain=4.0),
        }
        rows = _rows(nao, tasks, q)
        np.testing.assert_allclose(rows["com"].error, c[[0, 2]], atol=1e-15)
        np.testing.assert_allclose(rows["com"].lower, 4.0 * (np.array([0.1, 0.2]) - c[[0, 2]]) + [1.0, 2.0], atol=1e-13)
        np.testing.assert_allclose(rows["com"].upper, 4.0 * (0.5 - c[[0, 2]]) + [1.0, 2.0], atol=1e-13)
        sides = np.array([c[0], c[1], -c[0], -c[1]])
        np.testing.assert_allclose(rows["polygon"].upper, 4.0 * (0.1 - sides), atol=1e-13)
        np.testing.assert_array_equal(rows["polygon"].lower, np.full(4, -np.inf))
        np.testing.assert_allclose(rows["joints"].error, values, atol=0)
        np.testing.assert_allclose(rows["joints"].lower, 4.0 * (np.array([-0.1, -0.2]) - values), atol=1e-14)
        np.testing.assert_array_equal(rows["joints"].upper, np.full(2, np.inf))


class TestFeedForward:
    def test_the_rate_of_every_error(self, nao, rng):
        """Robot and target both move: the error's rate is ``jacobian @ v - feed-forward``, by central differences."""
        robot, h = nao, 1e-5
        q, v = jnp.asarray(_random_q(robot, rng)), jnp.asarray(rng.normal(size=robot.nv))
        p, R = _random_pose(rng, np.zeros(3))
        twist, drift = rng.normal(size=6), rng.normal(size=3)
        base = robot.tree.joint_names[0]
        target, rate = jnp.asarray(_random_q(robot, rng)), jnp.asarray(rng.normal(size=robot.nv))
        tasks = {
            "world": osik.FrameTask(robot, "r_wrist", target=(p, R), target_velocity=twist),
            "own": osik.FrameTask(robot, "r_wrist", target=(p, R), target_velocity=twist, axes="frame"),
            "bounds": osik.FrameTask(robot, "r_wrist", target=(p, R), target_velocity=twist, lower=-0.1, upper=0.1),
            "com": osik.ComTask(robot, target=p, target_velocity=drift),
            "posture": osik.PostureTask(robot, joints=(base, "*"), target=target, target_velocity=rate),
        }

        def moved(t):
            pose = (p + t * twist[:3], Rotation.from_rotvec(t * twist[3:]).as_matrix() @ R)
            new = {k: tasks[k].replace(target=pose) for k in ("world", "own", "bounds")}
            new["com"] = tasks["com"].replace(target=p + t * drift)
            new["posture"] = tasks["posture"].replace(target=_step(robot, target, t * rate))
            return _rows(robot, new, _step(robot, q, t * v))

        ahead, behind = moved(h), moved(-h)
        still = _rows(robot, {name: task.replace(target_velocity=0.0) for name, task in tasks.items()}, q)
        for name, row in _rows(robot, tasks, q).items():
            feedforward = row.upper - still[name].upper
            np.testing.assert_allclose(row.lower - still[name].lower, feedforward, atol=1e-13, err_msg=name)
            expected = (ahead[name].error - behind[name].error) / (2 * h)
            np.testing.assert_allclose(row.jacobian @ v - feedforward, expected, atol=2e-8, err_msg=name)

    @pytest.mark.parametrize("axes", ["world", "frame"])
    def test_the_error_of_a_moving_target_decays_exponentially(self, arm, axes):
        """Fourth-order integration of ``v = pinv(J) (wanted)``: e(t) = exp(-gain t) e(0), nothing lags."""
        frame, gain, dt, steps = "hand", 5.0, 0.005, 60
        q0 = jnp.asarray([0.3, 0.6, -0.4, 1.2, 0.5, -0.8, 0.2])
        p0, R0 = _kinematics(arm, q0).frame_pose(arm, frame)
        start = Rotation.from_rotvec([0.5, -0.3, 0.4]).as_matrix() @ R0
        spin = jnp.array([0.4, 0.7, -0.5])
        task = osik.FrameTask(arm, frame, axes=axes, gain=gain)

        def at(t):
            position = p0 + jnp.array([0.05, -0.04, 0.03]) + 0.05 * jnp.sin(3.0 * t) * jnp.array([1.0, 0.5, -1.0])
            linear = 0.15 * jnp.cos(3.0 * t) * jnp.array([1.0, 0.5, -1.0])
            angle = jnp.linalg.norm(spin) * t
            K = jnp.cross(spin / jnp.linalg.norm(spin), jnp.eye(3)).T
            turn = jnp.eye(3) + jnp.sin(angle) * K + (1.0 - jnp.cos(angle)) * K @ K
            return task.replace(target=(position, turn @ start), target_velocity=jnp.concatenate([linear, spin]))

        def rows(t, q):
            return at(t).rows(arm, osik.forward_kinematics(arm, q), q)

        def velocity(t, q):
            row = rows(t, q)
            return jnp.linalg.lstsq(row.jacobian, row.lower)[0]

        def step(carry, offset):
            """One stage of the classical Runge-Kutta method."""
            t, q, k, total = carry
            weight, ahead = offset
            k = velocity(t + ahead * dt, q + ahead * dt * k)
            return (t, q, k, total + weight * k), None

        def tick(q, t):
            stages = jnp.array([[1 / 6, 0.0], [1 / 3, 0.5], [1 / 3, 0.5], [1 / 6, 1.0]])
            (_, _, _, total), _ = jax.lax.scan(step, (t, q, jnp.zeros_like(q), jnp.zeros_like(q)), stages)
            return q + dt * total, rows(t, q).error

        times = dt * jnp.arange(steps)
        _, errors = jax.jit(lambda q: jax.lax.scan(tick, q, times))(q0)
        assert np.linalg.norm(errors[0][3:]) > 0.5
        np.testing.assert_allclose(errors, np.exp(-gain * times)[:, None] * errors[0], atol=1e-6 * 0.1)


class TestGradients:
    @pytest.mark.parametrize("x64", [True, False])
    def test_finite_at_zero_error_and_near_pi(self, x64):
        with jax.enable_x64(x64):
            arm, frame = osik.Robot.from_mjcf(SMALL), "tip"
            p, R = _kinematics(arm, arm.q0).frame_pose(arm, frame)
            adaptive = osik.AdaptiveGain(10.0, 1.0, 2.0)
            angles = np.array([0.0, 1e-12, 1e-6, math.pi - 1e-4, math.pi - 1e-7, math.pi])
            turns = jnp.asarray(Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0]).as_matrix(), R.dtype)

            def cost(tasks, q):
                kinematics = osik.forward_kinematics(arm, q)
                rows = [task.rows(arm, kinematics, q) for task in tasks]
                bounds = [jnp.where(jnp.isfinite(r.lower), r.lower, 0.0) for r in rows]
                return sum(jnp.sum(b) for b in bounds) + sum(jnp.sum(r.jacobian**2) for r in rows)

            world = osik.FrameTask(arm, frame, gain=adaptive)
            own = osik.FrameTask(arm, frame, axes="frame", gain=adaptive, lower=-jnp.inf)
            tasks = jax.vmap(lambda turn: [task.replace(target=(p, turn @ R)) for task in (world, own)])(turns)
            gradients = jax.jit(jax.vmap(jax.grad(cost, argnums=(0, 1)), in_axes=(0, None)))(tasks, arm.q0)
            for leaf in jax.tree.leaves(gradients):
                assert leaf.dtype == (jnp.float64 if x64 else jnp.float32)
                assert np.isfinite(leaf).all()

    def test_finite_for_inequalities_with_infinite_bounds(self, nao):
        tasks = {
            "com": osik.ComTask(nao, upper=[0.1, np.inf, np.inf], gain=osik.AdaptiveGain(5.0, 1.0, 2.0)),
            "polygon": osik.ComTask(nao, polygon=_square(), gain=0.0),
            "joints": osik.PostureTask(nao, lower=-np.inf, upper=np.inf, gain=osik.AdaptiveGain(5.0, 5.0, 0.0)),
        }

        def total(tasks, q):
            rows = _rows(nao, tasks, q)
            bounds = [b for r in rows.values() for b in (r.lower, r.upper)]
            return sum(jnp.sum(jnp.where(jnp.isfinite(b), b, 0.0)) for b in bounds)

        for leaf in jax.tree.leaves(jax.jit(jax.grad(total, argnums=(0, 1)))(tasks, nao.q0)):
            assert np.isfinite(leaf).all()

    def test_a_float32_robot_has_float32_tasks(self, arm):
        robot = jax.tree.map(lambda x: x.astype(jnp.float32), arm)
        task = osik.FrameTask(robot, "hand", gain=osik.AdaptiveGain(5.0, 1.0, 2.0), lower=-1.0)
        for leaf in jax.tree.leaves((task, osik.ComTask(robot), osik.PostureTask(robot))):
            assert leaf.dtype == jnp.float32


class TestBatchesAndCompilation:
    def test_vmap_equals_a_loop(self, nao, rng):
        count = 4
        q = jnp.asarray(_random_q(nao, rng))
        p, R = (
            jnp.asarray(rng.normal(size=(count, 3))),
            jnp.asarray(Rotation.from_quat(rng.normal(size=(count, 4))).as_matrix()),
        )
        numbers = jnp.asarray(rng.uniform(1.0, 2.0, (count, 3)))
        frame = osik.FrameTask(nao, "r_wrist", gain=osik.AdaptiveGain(10.0, 1.0, 2.0), lower=-0.1)
        com, posture = osik.ComTask(nao), osik.PostureTask(nao)

        def rows(p, R, n):
            tasks = {
                "frame": frame.replace(
                    target=(p, R), position_weight=n, weight=n[0], lower=-n[1], gain=osik.AdaptiveGain(10.0, n[0], n[1])
                ),
                "com": com.replace(target=p, target_velocity=n, gain=n[0], weight=n[1]),
                "posture": posture.replace(target=nao.q0 + 0.01 * n[0], gain=n[1], weight=n[2]),
            }
            return _rows(nao, tasks, q)

        batch = jax.jit(jax.vmap(rows))(p, R, numbers)
        single = jax.jit(rows)
        for i in range(count):
            expected = jax.tree.leaves(single(p[i], R[i], numbers[i]))
            for ours, theirs in zip(jax.tree.leaves(batch), expected, strict=True):
                np.testing.assert_allclose(ours[i], theirs, atol=1e-12)

    def test_a_batch_of_robots(self, arm):
        """Tasks and limits made and used inside vmap, for arms of three sizes: the rows of the arms one by one."""

        def at(scale):
            position = arm.body_position * scale
            return dataclasses.replace(arm, body_position=position)

        def rows(scale):
            robot = at(scale)
            tasks = {
                "home": osik.FrameTask(robot, "hand"),
                "frame": osik.FrameTask(robot, "hand", target=(jnp.full(3, 0.1), jnp.eye(3)), axes="frame"),
                "com": osik.ComTask(robot, axes="xy", lower=0.1),
                "posture": osik.PostureTask(robot, target=robot.q0 + 0.1),
            }
            limits = (osik.ConfigurationLimit(robot), osik.VelocityLimit(robot))
            return _rows(robot, tasks, robot.q0), osik.limit_box(robot, robot.q0, limits, 0.01)

        scales = jnp.array([0.5, 1.0, 1.5])
        batch, _ = jax.jit(jax.vmap(rows))(scales)
        np.testing.assert_allclose(batch["home"].error, 0.0, atol=1e-14)
        positions = [_kinematics(at(scale), arm.q0).frame_pose(arm, "hand") for scale in scales]
        expected = [R.T @ (p - 0.1) for p, R in positions]
        np.testing.assert_allclose(batch["frame"].error[:, :3], expected, atol=1e-13)
        assert np.linalg.norm(positions[0][0] - positions[2][0]) > 0.1

    def test_changing_any_number_compiles_nothing(self, arm):
        traces = []

        @jax.jit
        def total(tasks, q):
            traces.append(1)
            return jax.tree.map(jnp.sum, _rows(arm, tasks, q))

        frame = "hand"
        tasks = {
            "pose": osik.FrameTask(arm, frame, lower=-0.1, gain=osik.AdaptiveGain(3, 2, 1)),
            "com": osik.ComTask(arm, polygon=_square()),
            "posture": osik.PostureTask(arm),
        }
        total(tasks, arm.q0)
        pose = tasks["pose"]
        changes = [
            dict(target=np.eye(4, dtype=np.float32)),
            dict(target_velocity=[1, 2, 3, 4, 5, 6]),
            dict(lower=0, upper=np.float32(2.0)),
            dict(position_weight=2),
            dict(orientation_weight=(1, 2, 3)),
            dict(weight=np.int32(3)),
            dict(gain=osik.AdaptiveGain(np.float32(5), 4.0, jnp.asarray(1.0))),
        ]
        assert {name for change in changes for name in change} == set(pose.replaceable)
        for change in changes:
            total({**tasks, "pose": pose.replace(**change)}, arm.q0)
        total({**tasks, "com": tasks["com"].replace(polygon=_square(0.2), gain=2, weight=1)}, arm.q0)
        posture = tasks["posture"].replace(target=np.zeros(arm.nq), target_velocity=1, gain=2, weight=3)
        total({**tasks, "posture": posture}, arm.q0)
        assert len(traces) == 1

    def test_a_replaced_task_is_another_one(self, arm):
        task = osik.PostureTask(arm, gain=2.0)
        assert task.replace(gain=3.0).gain == 3.0
        assert task.gain == 2.0
        assert task.replace() is task


class HeightTask(osik.Task):
    """A user's own task: a body's height."""

    body: str = eqx.field(static=True)
    height: Float[Array, ""]

    def rows(self, robot, kinematics, q):
        p, _ = kinematics.frame_pose(robot, self.body)
        jacobian = osik.frame_jacobian(robot, kinematics, self.body)[2:3]
        return osik.task_rows(p[2:] - self.height, jacobian, gain=self.gain, weight=self.weight[None])


def test_an_own_task(arm):
    task = HeightTask("hand", jnp.asarray(1.0))
    assert (task.priority, float(task.weight), task.gain) == (1, 1.0, 10.0)
    assert HeightTask("hand", jnp.asarray(1.0), priority=2).priority == 2
    new = task.replace(height=2, gain=3)
    assert set(task.replaceable) == {"height", "weight", "gain"}
    theirs = osik.FrameTask(arm, "hand", target=([0, 0, 2.0], np.eye(3)), rows=[i == 2 for i in range(6)], gain=3)
    rows = _rows(arm, {"own": new, "frame": theirs}, arm.q0)
    for ours, expected in zip(jax.tree.leaves(rows["own"]), jax.tree.leaves(rows["frame"]), strict=True):
        np.testing.assert_allclose(ours, expected, atol=1e-15)
    with pytest.raises(TypeError, match=r"HeightTask has no 'body' to replace; it has: .*height"):
        task.replace(body="link1")


class TestMistakes:
    @pytest.mark.parametrize(
        ("options", "error", "message"),
        [
            (dict(target=np.eye(3)), ValueError, r"\(4, 4\)"),
            (dict(target=(np.zeros(3), 2 * np.eye(3))), ValueError, "rotation"),
            (dict(target=(np.zeros(3), np.diag([1.0, 1.0, -1.0]))), ValueError, "rotation"),
            (dict(target=(np.zeros((5, 3)), np.eye(3))), ValueError, "vmap"),
            (dict(target=(np.zeros(3), np.full((3, 3), np.nan))), ValueError, "rotation"),
            (dict(lower=1.0, upper=[0, 2, 2, 2, 2, 0]), ValueError, r"rows \[0, 5\]"),
            (dict(lower=[1.0, 2.0]), ValueError, r"lower has shape \(2,\)"),
            (dict(position_weight=-1.0), ValueError, "position_weight is"),
            (dict(weight=np.nan), ValueError, "weight is"),
            (dict(weight=[1.0, 2.0]), ValueError, "weight has shape"),
            (dict(gain=-1.0), ValueError, "gain is"),
            (dict(rows="orient"), ValueError, "did you mean 'orientation'"),
            (dict(rows=(True, False)), ValueError, "six booleans"),
            (dict(rows=(False,) * 6), ValueError, "at least one"),
            (dict(axes="body"), ValueError, "'world', 'frame'"),
            (dict(orientation_jacobian="exact"), ValueError, "'analytic', 'geometric'"),
            (dict(priority=0), ValueError, "priority"),
            (dict(priority=1.5), ValueError, "priority"),
            (dict(target_velocity=[1.0, 2.0]), ValueError, "target_velocity"),
        ],
    )
    def test_frame_task(self, arm, options, error, message):
        with pytest.raises(error, match=message):
            osik.FrameTask(arm, "hand", **options)

    def test_unknown_names(self, nao):
        with pytest.raises(KeyError, match="did you mean 'l_sole'"):
            osik.FrameTask(nao, "l_soel")
        with pytest.raises(KeyError, match="no frame 'nothing'"):
            osik.ComTask(nao, subtree="nothing")
        with pytest.raises(KeyError, match=r"no joint 'Knee\*'.*HeadYaw"):
            osik.PostureTask(nao, joints=("Knee*",))
        with pytest.raises(TypeError, match="sequence of names"):
            osik.PostureTask(nao, joints="HeadYaw")

    @pytest.mark.parametrize(
        ("options", "error", "message"),
        [
            (dict(target=np.zeros(3), lower=0.0), TypeError, "not both"),
            (dict(axes="xw"), ValueError, "x, y and z"),
            (dict(axes="xx"), ValueError, "at most once"),
            (dict(axes="xy", target=[1.0, 2.0, 3.0, 4.0]), ValueError, "target has shape"),
            (dict(polygon=np.zeros((4, 2))), TypeError, "SupportPolygon"),
            (dict(polygon=_square(), axes="z"), TypeError, "takes no"),
            (dict(lower=1.0, upper=0.0), ValueError, "lower > upper"),
        ],
    )
    def test_com_task(self, nao, options, error, message):
        with pytest.raises(error, match=message):
            osik.ComTask(nao, **options)

    def test_posture_task(self, nao):
        base = nao.tree.joint_names[0]
        with pytest.raises(ValueError, match=f"leave out {base}"):
            osik.PostureTask(nao, joints=(base,), lower=0.0)
        with pytest.raises(TypeError, match="not both"):
            osik.PostureTask(nao, target=nao.q0, lower=0.0)
        with pytest.raises(ValueError, match="q has shape"):
            osik.PostureTask(nao, target=np.zeros(4))

    def test_replace(self, arm):
        task = osik.PostureTask(arm, lower=-1.0)
        with pytest.raises(TypeError, match=r"no 'target' to replace; it has: .*lower, upper"):
            task.replace(target=arm.q0)
        with pytest.raises(TypeError, match="no 'priority'"):
            task.replace(priority=2)
        with pytest.raises(ValueError, match="lower > upper"):
            task.replace(lower=1.0, upper=0.0)
        with pytest.raises(ValueError, match=r"target has shape \(3,\), expected \(7,\)"):
            osik.PostureTask(arm).replace(target=np.zeros(3))
        with pytest.raises(ValueError, match="rotation"):
            osik.FrameTask(arm, "hand").replace(target=2 * np.eye(4))

    def test_gain(self):
        with pytest.raises(ValueError, match="maximum >= minimum"):
            osik.AdaptiveGain(1.0, 2.0, 1.0)
        with pytest.raises(ValueError, match="decay is"):
            osik.AdaptiveGain(2.0, 1.0, -1.0)
        with pytest.raises(ValueError, match="scalar"):
            osik.AdaptiveGain([2.0, 3.0], 1.0, 1.0)


def test_rows_of_all_tasks_together_are_those_of_each():
    """Frames of several manners, one alone in its own, a subclass that goes its own way, and other kinds of tasks."""
    robot = osik.load_robot("nao")

    class Doubled(osik.FrameTask):
        __init__ = osik.FrameTask.__init__

        def rows(self, robot, kinematics, q):
            own = super().rows(robot, kinematics, q)
            return eqx.tree_at(lambda r: r.jacobian, own, 2.0 * own.jacobian)

    tasks = {
        "left": osik.FrameTask(robot, "l_sole", weight=2.0, gain=3.0),
        "right": osik.FrameTask(robot, "r_sole", priority=2, target_velocity=0.1 * np.arange(6.0)),
        "hand": osik.FrameTask(robot, "l_gripper", rows="position"),
        "other hand": osik.FrameTask(robot, "r_gripper", rows="position", gain=osik.AdaptiveGain(5.0, 1.0, 2.0)),
        "head": osik.FrameTask(robot, "Head", axes="frame", rows=(True, False, True, False, True, True)),
        "box": osik.FrameTask(robot, "l_gripper", lower=-0.1, upper=[0.1, np.inf, 0.2, 1.0, 1.0, 1.0]),
        "doubled": Doubled(robot, "torso"),
        "com": osik.ComTask(robot),
        "posture": osik.PostureTask(robot),
    }
    q = osik.integrate(robot, robot.q0, 0.1 * jnp.cos(jnp.arange(robot.nv)))
    kinematics = osik.forward_kinematics(robot, q)
    together = jax.jit(lambda q: rows_of(robot, osik.forward_kinematics(robot, q), q, tasks))(q)
    direct = rows_of(robot, kinematics, q, tasks)
    assert list(direct) == list(tasks)
    for name, task in tasks.items():
        alone = task.rows(robot, kinematics, q)
        assert direct[name].is_equality == alone.is_equality == (name != "box")
        for ours, expected in zip(jax.tree.leaves(together[name]), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-13)
