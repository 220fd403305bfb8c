"""Weights by row, axis or joint: squares of mink's and pink's cost vectors."""

from pathlib import Path

import jax
import jax.numpy as jnp
import mink
import numpy as np
import pink
import pinocchio as pin
import pytest
from model_files import mjcf
from refusals import refuses
from task_checks import rows_of_each, square

import osik_jax as osik

DT = 0.01
COUPLING = {"joint2": 1.0, "joint5": -2.0}


@pytest.fixture(scope="module")
def floating():
    return osik.Robot.from_mjcf(mjcf("floating_arm"))


def assert_answers(robot, q, ours, expected, atol=1e-8):
    scheme = osik.WeightedQP(damping=1e-12, curvature_damping=0.0)
    solution = osik.solve(robot, q, ours, scheme=scheme, limits=osik.no_limits, dt=DT)
    np.testing.assert_allclose(solution.velocity, expected, atol=atol)
    assert np.abs(expected).max() > 0.1
    return solution


class TestAgainstPeers:
    def test_mink(self, floating, rng):
        """Centre of mass by axis, posture and damping by joint, on a floating base: its (nv,) costs squared."""
        model = floating.mj_model
        q = np.asarray(osik.integrate(floating, floating.q0, jnp.asarray(rng.uniform(-0.5, 0.5, floating.nv))))
        configuration = mink.Configuration(model, q=q)
        costs = dict(com=rng.uniform(0.5, 2.0, 3), posture=rng.uniform(0.1, 1.0, 9), damping=rng.uniform(0.1, 1.0, 9))
        costs["posture"][7] = 0.0
        costs["damping"][:6] = 0.0  # a free base has none: it is not among the joints of ours
        com, posture = mink.ComTask(costs["com"], gain=0.1), mink.PostureTask(model, costs["posture"], gain=0.2)
        com.set_target(np.array([0.2, -0.1, 0.3]))
        posture.set_target(np.asarray(floating.q0))
        trunk = mink.FrameTask("trunk", "body", 0.3, 0.3, gain=0.0)
        trunk.set_target_from_configuration(configuration)
        theirs = [com, posture, mink.DampingTask(model, costs["damping"]), trunk]
        expected = mink.solve_ik(configuration, theirs, DT, "daqp", limits=[])
        ours = {
            "com": osik.ComTask(floating, target=[0.2, -0.1, 0.3], weight=costs["com"] ** 2, gain=0.1 / DT),
            "posture": osik.PostureTask(floating, weight=costs["posture"] ** 2, gain=0.2 / DT),
            "damping": osik.DampingTask(floating, weight=costs["damping"] ** 2),
            "trunk": osik.DampingTask(floating, joints=("base",), weight=0.09),
        }
        assert_answers(floating, q, ours, expected)
        turned = expected[3:6]
        assert np.abs(turned).max() > 1e-3

    def test_mink_by_constraint(self, rng):
        """One cost for each equality constraint, whatever its rows."""
        loop = osik.Robot.from_mjcf(mjcf("two_arms_in_a_loop"))
        q = rng.uniform(-0.3, 0.3, 4)
        configuration = mink.Configuration(loop.mj_model, q=q)
        closed = mink.EqualityConstraintTask(loop.mj_model, cost=[0.7, 2.0], gain=0.1)
        posture = mink.PostureTask(loop.mj_model, 0.5, gain=0.1)
        posture.set_target(np.zeros(4))
        expected = mink.solve_ik(configuration, [closed, posture], DT, "daqp", limits=[])
        ours = {
            "closed": osik.EqualityConstraintTask(loop, weight=[0.49, 4.0], gain=0.1 / DT),
            "posture": osik.PostureTask(loop, target=np.zeros(4), weight=0.25, gain=0.1 / DT),
        }
        assert_answers(loop, q, ours, expected)
        refuses(ValueError, r"expected a scalar, or \(2,\)", osik.EqualityConstraintTask, loop, weight=[1.0] * 4)

    def test_pink(self, arm, rng):
        """A weighted problem: pink's ``cost**2`` is our weight, its gain is ours times dt."""
        model = pin.buildModelFromMJCF(str(Path(osik.__file__).parent / "robot" / "models" / "arm7.xml"))
        q = np.asarray(arm.q0) + rng.uniform(-0.2, 0.2, 7)
        configuration = pink.Configuration(model, model.createData(), q)
        costs = dict(com=[1.0, 0.2, 2.0], posture=rng.uniform(0.1, 1.0, 7), smooth=rng.uniform(0.1, 1.0, 7))
        theirs = {
            "com": pink.tasks.ComTask(costs["com"], gain=0.1),
            "posture": pink.tasks.PostureTask(costs["posture"], gain=0.1),
            "smooth": pink.tasks.LowAccelerationTask(costs["smooth"]),
            "velocity": pink.tasks.JointVelocityTask(costs["smooth"]),
            "coupling": pink.tasks.JointCouplingTask([*COUPLING], [*COUPLING.values()], 0.8, configuration, gain=0.2),
            "damping": pink.tasks.DampingTask(cost=0.5),
        }
        last = rng.uniform(-1.0, 1.0, 7)
        theirs["com"].set_target(np.array([0.2, 0.1, 0.4]))
        theirs["posture"].set_target(np.asarray(arm.q0))
        theirs["smooth"].set_last_integration(last, DT)
        theirs["velocity"].set_target(-last[::-1], DT)  # pink 4.4 moves the opposite way of its target
        expected = pink.solve_ik(configuration, theirs.values(), DT, solver="daqp", limits=[], damping=1e-12)
        squared = {name: np.square(cost) for name, cost in costs.items()}
        ours = {
            "com": osik.ComTask(arm, target=[0.2, 0.1, 0.4], weight=squared["com"], gain=0.1 / DT),
            "posture": osik.PostureTask(arm, weight=squared["posture"], gain=0.1 / DT),
            "smooth": osik.LowAccelerationTask(arm, velocity=last, weight=squared["smooth"]),
            "velocity": osik.JointVelocityTask(arm, last[::-1].copy(), weight=squared["smooth"]),
            "coupling": osik.JointCouplingTask(arm, COUPLING, weight=0.8**2, gain=0.2 / DT),
            "damping": osik.DampingTask(arm, weight=0.5**2),
        }
        solution = assert_answers(arm, q, ours, expected, atol=1e-9)
        error = theirs["coupling"].compute_error(configuration)
        np.testing.assert_allclose(solution.error["coupling"], error, atol=1e-14)


class TestRows:
    def test_joint_weights_by_row_by_dof_and_by_name(self, floating):
        by_name = {"*": 2.0, "elbow": 5.0}
        for weight in ([2.0, 5.0, 2.0], [9.0] * 6 + [2.0, 5.0, 2.0], by_name):
            for make in (osik.PostureTask, osik.DampingTask, osik.LowAccelerationTask):
                np.testing.assert_array_equal(make(floating, weight=weight).weight, [2.0, 5.0, 2.0])
        named = osik.PostureTask(floating, joints=("base", "wrist"), weight={"base": 3.0})
        np.testing.assert_array_equal(named.weight, [3.0] * 6 + [0.0])
        np.testing.assert_array_equal(osik.FreezeTask(floating, ("elbow",), weight=by_name).weight, [5.0])

    def test_of_every_task_reach_their_rows(self, arm):
        tasks = {
            "com": osik.ComTask(arm, axes="zx", weight=[1.0, 2.0]),
            "polygon": osik.ComTask(arm, polygon=square(), weight=[1.0, 2.0, 3.0, 4.0]),
            "posture": osik.PostureTask(arm, lower=-1.0, weight=np.arange(7.0)),
            "momentum": osik.AngularMomentumTask(arm, axes="yz", weight=[3.0, 1.0]),
            "function": osik.FunctionTask(arm, lambda robot, kinematics, q: q[:3] ** 2, weight=[1.0, 0.0, 2.0]),
            "sole": osik.ContactTask(arm, "hand", weight=np.arange(6.0)),
            "point": osik.ContactTask(arm, "hand", contact="point", sliding=True, weight=[2.0]),
            "wheel": osik.WheelTask(arm, "hand", radius=0.1, weight=[1.0, 2.0, 3.0]),
            "rollers": osik.WheelTask(arm, "hand", radius=0.1, roller_angle=0.3, weight=[1.0, 2.0]),
        }
        for name, rows in rows_of_each(arm, tasks, arm.q0).items():
            np.testing.assert_array_equal(rows.weight, tasks[name].weight, err_msg=name)

    def test_replaced_in_the_same_shape_or_from_one_number(self, arm):
        task = osik.ComTask(arm, weight=[1.0, 2.0, 3.0])
        np.testing.assert_array_equal(task.replace(weight=4.0).weight, [4.0] * 3)
        np.testing.assert_array_equal(osik.ComTask(arm).replace(weight=[1.0, 2.0, 3.0]).weight, [1.0, 2.0, 3.0])
        traces = []

        @jax.jit
        def rows(task):
            traces.append(1)
            return task.rows(arm, osik.forward_kinematics(arm, arm.q0), arm.q0).weight

        for weight in ([1.0, 2.0, 3.0], [3.0, 2.0, 1.0], 5.0):
            np.testing.assert_array_equal(rows(task.replace(weight=weight)), np.broadcast_to(weight, 3))
        assert len(traces) == 1

    def test_a_class_of_ones_own_has_them_too(self, arm):
        class Level(osik.Task):
            def rows(self, robot, kinematics, q):
                return osik.TaskRows.of(q[:2], jnp.eye(2, robot.nv), gain=self.gain, weight=self.weight)

        np.testing.assert_array_equal(Level(weight=[1.0, 2.0]).weight, [1.0, 2.0])
        refuses(ValueError, "a scalar or a vector", Level, weight=np.ones((2, 2)))

    @pytest.mark.slow
    def test_a_gradient_by_joint_against_differences(self, arm, rng):
        q = jnp.asarray(np.asarray(arm.q0) + rng.uniform(-0.3, 0.3, 7))
        hand = osik.FrameTask(arm, "hand", rows="position")

        @jax.jit
        def speed(weight):
            posture = osik.PostureTask(arm, weight=weight, gain=1.0)
            tasks = {"hand": hand, "posture": posture}
            return jnp.sum(osik.solve(arm, q, tasks, scheme=osik.WeightedQP()).velocity ** 2)

        weight, h = jnp.asarray(rng.uniform(0.1, 1.0, 7)), 1e-6
        differences = [(speed(weight + h * e) - speed(weight - h * e)) / (2 * h) for e in np.eye(7)]
        gradient = jax.grad(speed)(weight)
        np.testing.assert_allclose(gradient, differences, atol=1e-6 * np.abs(gradient).max())


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda robot: osik.ComTask(robot, weight=[1.0, 2.0]), ValueError, r"expected a scalar, or \(3,\)"),
        (lambda robot: osik.PostureTask(robot, weight=np.ones(5)), ValueError, r"expected a scalar, or \(7,\)"),
        (lambda robot: osik.DampingTask(robot).replace(weight=np.ones(3)), ValueError, r"expected a scalar, or \(7,\)"),
        (lambda robot: osik.LookAtTask(robot, "hand", weight=[1.0, 2.0]), ValueError, r"weight has shape \(2,\)"),
    ],
)
def test_mistakes_are_told(arm, make, error, message):
    refuses(error, message, make, arm)
