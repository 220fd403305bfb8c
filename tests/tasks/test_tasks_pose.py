"""FrameTask, and the rotations that it rests on, against mink, Pinocchio, SciPy and exact solutions."""

import inspect
import math
from functools import partial

import jax
import jax.numpy as jnp
import mink
import numpy as np
import pinocchio as pin
import pytest
from refusals import refuses
from scipy.spatial.transform import Rotation
from task_checks import anywhere, assert_finite_gradients, kinematics_at, random_pose, rows_of_each, the_same_in_mink

import osik_jax as osik
from osik_jax.tasks._rotation import inverse_left_jacobian, rotation_log

MASK = (True, True, False, True, False, True)
SEED = 7
SMALL = """
<mujoco><worldbody>
  <body><joint name="ball" type="ball"/><geom size="0.1"/>
    <body name="tip" pos="0.3 0.1 0.2"><joint name="hinge" axis="0 1 1" range="-1 1"/><geom size="0.1"/></body>
  </body>
</worldbody></mujoco>
"""
# six joints whose forearm and wrist rolls are in line where the pitch of the wrist, joint 5, is 0
_LINKS = {"1": ("0 0 .1", "0 0 1"), "2": ("0 0 0", "0 1 0"), "3": (".05 0 .3", "0 1 0"), "4": (".2 0 0", "1 0 0")}
_LINKS |= {"5": (".1 0 0", "0 1 0"), "tool": (".17 0 0", "1 0 0")}
WRISTED = (
    '<mujoco><compiler angle="radian"/><worldbody>'
    + "".join(
        f'<body name="{name}" pos="{place}"><joint name="j{name}" axis="{axis}" range="-3 3"/><geom size=".02"/>'
        for name, (place, axis) in _LINKS.items()
    )
    + "</body>" * len(_LINKS)
    + "</worldbody></mujoco>"
)


@pytest.fixture
def beside_mink(nao):
    return the_same_in_mink(nao, SEED)


class TestJacobians:
    def test_geometric_is_the_analytic_one_without_the_inverse_jacobian(self, arm, rng):
        frame = "hand"
        pose = random_pose(rng, np.zeros(3))
        both = {
            (axes, kind): osik.FrameTask(arm, frame, target=pose, axes=axes, orientation_jacobian=kind)
            for axes in ("world", "frame")
            for kind in ("analytic", "geometric")
        }
        q = jnp.asarray(anywhere(arm, rng))
        rows = rows_of_each(arm, both, q)
        R = np.asarray(kinematics_at(arm, q).frame_pose(arm, frame)[1])
        angular = np.asarray(osik.frame_jacobian(arm, kinematics_at(arm, q), frame))[3:]
        np.testing.assert_allclose(rows["world", "geometric"].jacobian[3:], angular, atol=1e-14)
        np.testing.assert_allclose(rows["frame", "geometric"].jacobian[3:], R.T @ angular, atol=1e-14)
        for axes, factor in (("world", pin.Jlog3(R @ pose[1].T).T), ("frame", pin.Jlog3(pose[1].T @ R))):
            expected = factor @ np.asarray(rows[axes, "geometric"].jacobian[3:])
            np.testing.assert_allclose(rows[axes, "analytic"].jacobian[3:], expected, atol=1e-12)
            np.testing.assert_array_equal(rows[axes, "analytic"].error, rows[axes, "geometric"].error)

    def test_masks_pick_rows_of_the_whole(self, arm, rng):
        pose = random_pose(rng, np.zeros(3))
        tasks = {
            "world": osik.FrameTask(arm, "hand", target=pose),
            "own": osik.FrameTask(arm, "hand", target=pose, axes="frame"),
            "world mask": osik.FrameTask(arm, "hand", target=pose, rows=MASK),
            "own mask": osik.FrameTask(arm, "hand", target=pose, rows=MASK, axes="frame"),
        }
        rows = rows_of_each(arm, tasks, jnp.asarray(anywhere(arm, rng)))
        for whole, part in (("world", "world mask"), ("own", "own mask")):
            for field in ("error", "jacobian", "lower", "upper", "weight"):
                expected = np.asarray(getattr(rows[whole], field))[np.array(MASK)]
                np.testing.assert_array_equal(getattr(rows[part], field), expected)


class TestErrors:
    def test_frame_errors_against_scipy(self, nao, rng):
        pose = random_pose(rng, np.zeros(3))
        tasks = {axes: osik.FrameTask(nao, "r_wrist", target=pose, axes=axes) for axes in ("world", "frame")}
        q = jnp.asarray(anywhere(nao, rng))
        p, R = map(np.asarray, kinematics_at(nao, q).frame_pose(nao, "r_wrist"))
        rows = rows_of_each(nao, tasks, q)
        world = np.concatenate([p - pose[0], Rotation.from_matrix(R @ pose[1].T).as_rotvec()])
        own = np.concatenate([R.T @ (p - pose[0]), Rotation.from_matrix(pose[1].T @ R).as_rotvec()])
        np.testing.assert_allclose(rows["world"].error, world, atol=1e-13)
        np.testing.assert_allclose(rows["frame"].error, own, atol=1e-13)
        np.testing.assert_allclose(rows["world"].lower, -10.0 * world, atol=1e-12)
        np.testing.assert_array_equal(rows["world"].lower, rows["world"].upper)

    def test_weights_multiply(self, arm):
        frame = "hand"
        task = osik.FrameTask(arm, frame, position_weight=[1.0, 2.0, 3.0], orientation_weight=0.5, weight=4.0)
        expected = [4.0, 8.0, 12.0, 2.0, 2.0, 2.0]
        np.testing.assert_array_equal(rows_of_each(arm, {"a": task}, arm.q0)["a"].weight, expected)


class TestAgainstMink:
    """mink's body twists coincide with ours on orientation in own axes."""

    def test_orientation(self, beside_mink):
        robot, q, configuration, (p, R), reduction = beside_mink
        theirs = mink.FrameTask("l_sole", "site", position_cost=1.0, orientation_cost=1.0)
        theirs.set_target(mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(R), p))
        ours = osik.FrameTask(robot, "l_sole", target=(p, R), axes="frame", rows="orientation")
        rows = rows_of_each(robot, {"a": ours}, q)["a"]
        np.testing.assert_allclose(rows.error, -theirs.compute_error(configuration)[3:], atol=1e-10)
        expected = -theirs.compute_jacobian(configuration)[3:] @ reduction
        np.testing.assert_allclose(rows.jacobian, expected, atol=1e-9)

    def test_position(self, beside_mink):
        """mink's linear part is ours in own axes where the orientation is already right; its error only."""
        robot, q, configuration, (p, _), reduction = beside_mink
        _, R = map(np.asarray, kinematics_at(robot, q).frame_pose(robot, "l_sole"))
        theirs = mink.FrameTask("l_sole", "site", position_cost=1.0, orientation_cost=1.0)
        theirs.set_target(mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(R), p))
        tasks = {
            "own": osik.FrameTask(robot, "l_sole", target=(p, R), axes="frame", rows="position"),
            "world": osik.FrameTask(robot, "l_sole", target=(p, R), rows="position"),
        }
        rows = rows_of_each(robot, tasks, q)
        np.testing.assert_allclose(rows["own"].error, -theirs.compute_error(configuration)[:3], atol=1e-10)
        linear = R @ configuration.get_frame_jacobian("l_sole", "site")[:3] @ reduction
        np.testing.assert_allclose(rows["world"].jacobian, linear, atol=1e-10)


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


class TestFeedForward:
    @pytest.mark.parametrize("axes", ["world", "frame"])
    def test_the_error_of_a_moving_target_decays_exponentially(self, arm, axes):
        """Fourth-order integration of ``v = pinv(J) (wanted)``: e(t) = exp(-gain t) e(0), nothing lags."""
        frame, gain, dt, steps = "hand", 5.0, 0.005, 60
        q0 = jnp.asarray([0.3, 0.6, -0.4, 1.2, 0.5, -0.8, 0.2])
        p0, R0 = kinematics_at(arm, q0).frame_pose(arm, frame)
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

        def one_step(q, t):
            stages = jnp.array([[1 / 6, 0.0], [1 / 3, 0.5], [1 / 3, 0.5], [1 / 6, 1.0]])
            (_, _, _, total), _ = jax.lax.scan(step, (t, q, jnp.zeros_like(q), jnp.zeros_like(q)), stages)
            return q + dt * total, rows(t, q).error

        times = dt * jnp.arange(steps)
        _, errors = jax.jit(lambda q: jax.lax.scan(one_step, q, times))(q0)
        assert np.linalg.norm(errors[0][3:]) > 0.5
        np.testing.assert_allclose(errors, np.exp(-gain * times)[:, None] * errors[0], atol=1e-6 * 0.1)


@pytest.mark.slow
@pytest.mark.variants(release=["True"])
@pytest.mark.parametrize("x64", [True, False])
def test_gradients_are_finite_at_zero_error_and_near_pi(x64):
    with jax.enable_x64(x64):
        robot = osik.Robot.from_mjcf(SMALL)
        p, R = kinematics_at(robot, robot.q0).frame_pose(robot, "tip")
        angles = np.array([0.0, 1e-12, 1e-6, math.pi - 1e-4, math.pi - 1e-7, math.pi])
        turns = jnp.asarray(Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0]).as_matrix(), R.dtype)
        adaptive = osik.AdaptiveGain(10.0, 1.0, 2.0)
        made = {
            "world": osik.FrameTask(robot, "tip", gain=adaptive),
            "own": osik.FrameTask(robot, "tip", axes="frame", gain=adaptive, lower=-jnp.inf),
        }
        tasks = jax.vmap(lambda t: {name: task.replace(target=(p, t @ R)) for name, task in made.items()})(turns)
        rows = partial(rows_of_each, robot)
        assert_finite_gradients(rows, tasks, jnp.tile(robot.q0, (len(angles), 1)))


class TestMistakes:
    @pytest.mark.parametrize(
        ("options", "error", "message"),
        [
            (dict(target=np.eye(3)), ValueError, r"\(4, 4\)"),
            (dict(lower=1.0, upper=[0, 2, 2, 2, 2, 0]), ValueError, r"rows \[0, 5\]"),
            (dict(lower=[1.0, 2.0]), ValueError, r"lower has shape \(2,\)"),
            (dict(position_weight=-1.0), ValueError, "position_weight is"),
            (dict(orientation_jacobian="exact"), ValueError, "'analytic', 'geometric'"),
            (dict(target_velocity=[1.0, 2.0]), ValueError, "target_velocity"),
        ],
    )
    def test_frame_task(self, arm, options, error, message):
        refuses(error, message, osik.FrameTask, arm, "hand", **options)


class TestLengthOfARadian:
    """An orientation error beside a position error: one length for a radian in the loop and in inverse kinematics."""

    def test_it_is_the_ratio_of_the_tolerances_of_inverse_kinematics(self, arm: osik.Robot) -> None:
        defaults = inspect.signature(osik.inverse_kinematics).parameters
        length = defaults["position_tolerance"].default / defaults["orientation_tolerance"].default
        for task in (osik.FrameTask(arm, "hand"), osik.RelativeFrameTask(arm, "hand", "link3")):
            np.testing.assert_allclose(task.orientation_weight / task.position_weight, length**2, rtol=1e-12)

    @pytest.mark.slow
    def test_the_loop_rests_where_inverse_kinematics_finds_the_least_error(self, arm: osik.Robot) -> None:
        """Out of reach the loop trades position for orientation as ``inverse_kinematics`` does."""
        target = np.array([1.2, 0.3, 0.5]), np.array([0.0, 1.0, 0.0, 0.0])
        least = osik.inverse_kinematics(arm, {"hand": target}, seeds=8, restarts=0)
        hand = osik.FrameTask(arm, "hand", target=target)
        path = osik.rollout(arm, least.q, {"hand": hand}, scheme=osik.WeightedQP(), dt=0.02, steps=100)
        np.testing.assert_allclose(path.q[-1], least.q, atol=1e-3)
        far = osik.rollout(arm, least.q, {"hand": hand.replace(orientation_weight=1.0)}, dt=0.02, steps=100)
        assert np.abs(far.q[-1] - least.q).max() > 0.05  # with a radian as 1 m the least error is elsewhere

    def test_a_posture_of_default_weight_lets_both_parts_of_a_pose_win(self, arm: osik.Robot) -> None:
        away = arm.q0 + 0.5
        target = jax.jit(osik.forward_kinematics)(arm, away).frame_pose(arm, "hand")
        tasks = {"hand": osik.FrameTask(arm, "hand", target=target), "rest": osik.PostureTask(arm)}
        path = osik.rollout(arm, arm.q0, tasks, scheme=osik.WeightedQP(), dt=0.02, steps=200)
        error = np.abs(path.solution.error["hand"][-1])
        assert error[:3].max() < 1e-3 and error[3:].max() < 1e-2  # the tolerances of inverse kinematics

    def test_a_turn_past_a_singular_wrist_keeps_the_position(self) -> None:
        """A tool turns at 0.5 rad/s and passes the wrist's singularity at 0.06 rad; the speed limits stop the rolls."""
        robot, dt, steps = osik.Robot.from_mjcf(WRISTED, velocity_limits={"*": 3.0}), 0.02, 100
        q = np.array([0.0, 0.4, 0.8, 0.0, -0.5, 0.0])
        p, R = jax.jit(osik.forward_kinematics)(robot, q).frame_pose(robot, "tool")
        about = np.outer(0.5 * dt * np.arange(1, steps + 1), [0.0, 1.0, 0.0])
        aside = Rotation.from_rotvec([0.0, 0.0, 0.06]) * Rotation.from_matrix(np.asarray(R))
        turned = jnp.array((Rotation.from_rotvec(about) * aside).as_matrix())
        targets = {"tool": (jnp.tile(p, (steps, 1)), turned)}
        task = osik.FrameTask(robot, "tool", gain=40.0)
        lost = {}
        for weight in (task.orientation_weight, 1.0):
            tool = {"tool": task.replace(orientation_weight=weight)}
            path = osik.rollout(robot, q, tool, dt=dt, steps=steps, targets=targets)
            lost[float(np.mean(weight))] = np.abs(path.solution.error["tool"][:, :3]).max()
            assert np.abs(path.q[:, 4]).min() < 0.05 and np.abs(path.solution.velocity).max() > 2.5
        by_default, as_a_metre = lost.values()
        assert by_default < 3e-3 and as_a_metre > 5e-2  # metres
