"""Tasks on joints against pink, mink, central differences and numbers worked out by hand."""

from typing import Any

import jax
import jax.numpy as jnp
import mink
import numpy as np
import pytest
from model_files import mjcf
from refusals import refuses
from scipy.spatial.transform import Rotation
from task_checks import assert_every_number_counts, assert_jacobians, at_each, moved_by, rows_of_each

import osik_jax as osik

DT = 0.01
NO_MAPPING: Any = ["elbow"]


@pytest.fixture(scope="module")
def robot():
    return osik.Robot.from_mjcf(mjcf("one_arm"))


@pytest.fixture(scope="module")
def tasks(robot):
    speeds = np.arange(1.0, robot.nv + 1.0)
    return {
        "damping": osik.DampingTask(robot, weight=0.1),
        "base damping": osik.DampingTask(robot, joints=("base", "el*"), weight=0.2),
        "freeze": osik.FreezeTask(robot, ("grip", "shoulder")),
        "velocity": osik.JointVelocityTask(robot, [0.1, 0.2], joints=("elbow", "grip")),
        "all velocities": osik.JointVelocityTask(robot, speeds, joints=("base", "*")),
        "low acceleration": osik.LowAccelerationTask(robot, velocity=speeds, joints=("base", "slide")),
        "coupling": osik.JointCouplingTask(robot, {"grip": -2.0, "elbow": 1.0}, target=0.3, target_velocity=0.5),
        "bounds": osik.JointCouplingTask(robot, {"elbow": 1.0, "slide": 3.0}, lower=-0.5, upper=0.1, gain=4.0),
    }


@pytest.fixture(scope="module")
def configurations(robot):
    rng = np.random.default_rng(5)
    moves = jnp.asarray(rng.uniform(-1.5, 1.5, (3, robot.nv)))
    return jax.vmap(moved_by, in_axes=(None, None, 0))(robot, robot.q0, moves)


class TestRows:
    def test_velocity_rows_are_rows_of_the_identity(self, robot, tasks, configurations):
        """Elbow, slide and grip are dofs 9, 10 and 11, after six of the base and three of the shoulder."""
        rows = rows_of_each(robot, tasks, configurations[0])
        speeds = np.arange(1.0, 13.0)
        expected = {
            "damping": (range(6, 12), np.zeros(6)),
            "base damping": ((*range(6), 9), np.zeros(7)),
            "freeze": ((6, 7, 8, 11), np.zeros(4)),
            "velocity": ((9, 11), [0.1, 0.2]),
            "all velocities": (range(12), speeds),
            "low acceleration": ((*range(6), 10), speeds[[*range(6), 10]]),
        }
        for name, (dofs, wanted) in expected.items():
            assert rows[name].dofs == tuple(dofs)
            np.testing.assert_array_equal(rows[name].jacobian, np.eye(12)[list(dofs)])
            np.testing.assert_array_equal(rows[name].lower, wanted)
            np.testing.assert_array_equal(rows[name].upper, wanted)
            np.testing.assert_array_equal(rows[name].error, np.zeros(len(wanted)))
            np.testing.assert_array_equal(rows[name].weight, np.full(len(wanted), tasks[name].weight))

    def test_coupling_by_hand(self, robot, tasks):
        q = robot.q0.at[jnp.array([11, 12, 13])].set(jnp.array([0.4, 0.05, 0.1]))
        assert [robot.joint_qpos_index(name) for name in ("elbow", "slide", "grip")] == [11, 12, 13]
        rows = rows_of_each(robot, tasks, q)
        np.testing.assert_allclose(rows["coupling"].error, [0.4 - 2.0 * 0.1 - 0.3], atol=1e-16)
        np.testing.assert_array_equal(rows["coupling"].jacobian, [[0.0] * 9 + [1.0, 0.0, -2.0]])
        np.testing.assert_allclose(rows["coupling"].upper, [10.0 * 0.1 + 0.5], rtol=1e-14)
        np.testing.assert_allclose(rows["bounds"].error, [0.4 + 3.0 * 0.05], rtol=1e-15)
        np.testing.assert_array_equal(rows["bounds"].jacobian, [[0.0] * 9 + [1.0, 3.0, 0.0]])
        np.testing.assert_allclose(rows["bounds"].lower, [4.0 * (-0.5 - 0.55)], rtol=1e-14)
        np.testing.assert_allclose(rows["bounds"].upper, [4.0 * (0.1 - 0.55)], rtol=1e-14)

    def test_the_order_of_ratios_is_that_of_v(self, robot, tasks):
        task = tasks["coupling"]
        np.testing.assert_array_equal(task.ratios, [1.0, -2.0])
        other = osik.JointCouplingTask(robot, {"elbow": 1.0, "grip": -2.0})
        assert jax.tree.structure(other) == jax.tree.structure(task)

    def test_coupling_against_central_differences(self, robot, tasks, configurations):
        chosen = {name: tasks[name] for name in ("coupling", "bounds")}
        assert_jacobians(*at_each(robot, chosen, configurations))

    def test_every_number_counts_and_compiles_nothing(self, robot, tasks, configurations):
        replaceable = {name: task.replaceable for name, task in tasks.items()}
        assert replaceable["damping"] == replaceable["freeze"] == ("weight",)
        assert replaceable["velocity"] == ("weight", "target")
        assert replaceable["low acceleration"] == ("weight", "velocity")
        for task in tasks.values():
            if "gain" not in task.replaceable:
                refuses(TypeError, "no 'gain' to replace; it has: weight", task.replace, gain=1.0)
        none = [f"['{name}'].gain" for name, task in tasks.items() if "gain" not in task.replaceable]
        assert len(none) == 6
        assert_every_number_counts(robot, tasks, configurations[0], idle=none)

    def test_a_new_velocity_of_the_last_step(self, robot, tasks):
        task = tasks["low acceleration"]
        new = task.after(jnp.full(robot.nv, 0.5))
        np.testing.assert_array_equal(new.velocity, np.full(robot.nv, 0.5))
        assert jax.tree.structure(new) == jax.tree.structure(task)
        assert tasks["damping"].after(jnp.zeros(robot.nv)) is tasks["damping"]
        np.testing.assert_array_equal(osik.LowAccelerationTask(robot).velocity, np.zeros(robot.nv))


class TestAgainstPeers:
    def test_mink(self, arm, rng):
        """Frozen joints as a constraint, damping, a posture and a frame's orientation."""
        wanted = rng.uniform(-1.0, 1.0, 7)
        q = np.asarray(arm.q0) + 0.1 * wanted
        model, turn = arm.mj_model, Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
        configuration = mink.Configuration(model, q=q)
        hand, posture = mink.FrameTask("hand", "site", 0.0, 2.0, gain=0.1), mink.PostureTask(model, cost=0.3, gain=0.05)
        hand.set_target(mink.SE3.from_rotation(mink.SO3.from_matrix(turn)))
        posture.set_target(wanted)
        frozen = mink.DofFreezingTask(model, dof_indices=[1, 4])
        theirs = [hand, posture, mink.DampingTask(model, cost=0.2)]
        expected = mink.solve_ik(configuration, theirs, DT, "daqp", limits=[], constraints=[frozen])
        ours = {
            "hand": osik.FrameTask(
                arm, "hand", target=(np.zeros(3), turn), rows="orientation", axes="frame", orientation_weight=4.0
            ),
            "posture": osik.PostureTask(arm, target=wanted, weight=0.09, gain=0.05 / DT),
            "damping": osik.DampingTask(arm, weight=0.04),
            "still": osik.FreezeTask(arm, ("joint2", "joint5"), hard=True),
        }
        solution = osik.solve(
            arm, q, ours, scheme=osik.WeightedQP(damping=1e-12, curvature_damping=0.0), dt=DT, limits=osik.no_limits
        )
        assert solution.status == osik.Status.SOLVED
        np.testing.assert_allclose(solution.velocity, expected, atol=1e-8)
        np.testing.assert_allclose(solution.velocity[np.array([1, 4])], 0.0, atol=1e-12)
        assert np.abs(expected).max() > 0.3


class TestClosedLoop:
    def test_frozen_joints_stand_still_at_priority_1(self, arm):
        hand = osik.FrameTask(arm, "hand", rows="position", priority=2)
        target = hand.target[0] + jnp.array([0.05, 0.1, 0.05]), hand.target[1]
        tasks = {"still": osik.FreezeTask(arm, ("joint[12]",)), "hand": hand.replace(target=target)}
        run = osik.rollout(arm, arm.q0, tasks, scheme=osik.NullSpace(), dt=DT, steps=100, limits=osik.no_limits)
        np.testing.assert_allclose(run.q[:, :2], np.broadcast_to(arm.q0[:2], (101, 2)), atol=1e-9)
        assert np.linalg.norm(run.solution.error["hand"][0]) > 0.1
        assert np.linalg.norm(run.solution.error["hand"][-1]) < 1e-3

    def test_couplings_decay_and_velocities_are_held(self, arm):
        """``1 - gain dt`` a step, while joint 1 turns at 0.2 rad/s."""
        tasks = {
            "gear": osik.JointCouplingTask(arm, {"joint4": 1.0, "joint6": 2.0}, target=0.5, gain=5.0),
            "turn": osik.JointVelocityTask(arm, 0.2, joints=("joint1",)),
            "calm": osik.DampingTask(arm, joints=("joint[2-7]",), weight=1e-9),
        }
        run = osik.rollout(
            arm, arm.q0, tasks, scheme=osik.WeightedQP(damping=1e-12), dt=DT, steps=50, limits=osik.no_limits
        )
        error = np.asarray(run.solution.error["gear"])[:, 0]
        start = float(arm.q0[3] + 2.0 * arm.q0[5] - 0.5)
        np.testing.assert_allclose(error, start * (1.0 - 5.0 * DT) ** np.arange(50), atol=1e-6)
        np.testing.assert_allclose(run.q[-1, 0] - arm.q0[0], 0.2 * 50 * DT, rtol=1e-7)

    def test_low_acceleration_smooths(self, arm):
        """By hand, one joint: v = (w1 gain (target - q) + w2 v_last) / (w1 + w2)."""
        posture = osik.PostureTask(arm, target=arm.q0 + 0.5, gain=5.0, weight=1.0)
        smooth = osik.LowAccelerationTask(arm, weight=3.0)
        tasks, scheme = {"posture": posture, "smooth": smooth}, osik.WeightedQP(damping=1e-12)
        run = osik.rollout(arm, arm.q0, tasks, scheme=scheme, dt=DT, steps=20, limits=osik.no_limits)
        way, speed, speeds = 0.5, 0.0, []
        for _ in range(20):
            speed = (5.0 * way + 3.0 * speed) / 4.0
            way -= DT * speed
            speeds.append(speed)
        np.testing.assert_allclose(run.solution.velocity, np.repeat(speeds, 7).reshape(20, 7), rtol=1e-9)
        last = smooth.after(run.solution.velocity[-2])
        solution = osik.solve(arm, run.q[-2], tasks | {"smooth": last}, scheme=scheme, dt=DT, limits=osik.no_limits)
        np.testing.assert_allclose(solution.velocity, np.full(7, speed), rtol=1e-9)
        assert 1.0 < speeds[-1] < max(speeds) and speeds[0] < 0.7


class TestMistakes:
    @pytest.mark.parametrize(
        ("make", "error", "message"),
        [
            (lambda r: osik.DampingTask(r, joints=("elbwo",)), KeyError, "did you mean 'elbow'"),
            (lambda r: osik.FreezeTask(r, ()), ValueError, "at least one joint"),
            (lambda r: osik.JointVelocityTask(r, [1.0, 2.0]), ValueError, r"target has shape \(2,\), expected \(6,\)"),
            (lambda r: osik.LowAccelerationTask(r, velocity=[1.0]), ValueError, r"velocity has shape \(1,\)"),
            (lambda r: osik.LowAccelerationTask(r).after(jnp.zeros(3)), ValueError, r"velocity has shape \(3,\)"),
            (lambda r: osik.JointCouplingTask(r, {"elbow": 0.0}), ValueError, "not 0"),
            (lambda r: osik.JointCouplingTask(r, {}), ValueError, "not 0"),
            (lambda r: osik.JointCouplingTask(r, NO_MAPPING), TypeError, "a mapping"),
            (lambda r: osik.JointCouplingTask(r, {"elbow": 1.0, "shoulder": 1.0}), ValueError, "leave out shoulder"),
            (lambda r: osik.JointCouplingTask(r, {"elbow": 1.0}, target=1.0, lower=0.0), TypeError, "not both"),
        ],
    )
    def test_are_told(self, robot, make, error, message):
        refuses(error, message, make, robot)
