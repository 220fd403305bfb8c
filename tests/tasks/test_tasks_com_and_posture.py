"""ComTask and PostureTask against mink and numbers worked out by hand."""

from functools import partial

import jax.numpy as jnp
import mink
import numpy as np
import pytest
from refusals import refuses
from task_checks import alone, anywhere, assert_finite_gradients, kinematics_at, rows_of_each, square, the_same_in_mink

import osik_jax as osik

SEED = 7


@pytest.fixture
def beside_mink(nao):
    return the_same_in_mink(nao, SEED)


class TestAgainstMink:
    def test_center_of_mass(self, beside_mink):
        robot, q, configuration, (p, _), reduction = beside_mink
        theirs = mink.ComTask(cost=1.0)
        theirs.set_target(p)
        rows = rows_of_each(robot, {"a": osik.ComTask(robot, target=p)}, q)["a"]
        np.testing.assert_allclose(rows.error, theirs.compute_error(configuration), atol=1e-10)
        np.testing.assert_allclose(rows.jacobian, theirs.compute_jacobian(configuration) @ reduction, atol=1e-10)

    def test_posture(self, beside_mink):
        robot, q, configuration, _, _ = beside_mink
        theirs = mink.PostureTask(robot.mj_model, cost=1.0)
        theirs.set_target(np.asarray(robot.mujoco_qpos(robot.q0)))
        rows = rows_of_each(robot, {"a": osik.PostureTask(robot, weight=1.0)}, q)["a"]
        error = theirs.compute_error(configuration)
        address = [robot.mj_model.joint(name).dofadr[0] for name in robot.joint_names]
        np.testing.assert_allclose(rows.error, error[address], atol=1e-12)
        np.testing.assert_array_equal(rows.jacobian, np.eye(robot.nv)[6:])


class TestInequalities:
    def test_bounds_are_on_the_coordinates(self, nao, rng):
        q = jnp.asarray(anywhere(nao, rng))
        c = np.asarray(osik.center_of_mass(nao, kinematics_at(nao, q)))
        joints = nao.joint_names[3:5]
        values = np.asarray(q)[[nao.joint_qpos_index(name) for name in joints]]
        tasks = {
            "com": osik.ComTask(nao, axes="xz", lower=[0.1, 0.2], upper=0.5, gain=4.0, target_velocity=[1.0, 2.0]),
            "polygon": osik.ComTask(nao, polygon=square(), gain=4.0),
            "joints": osik.PostureTask(nao, joints=joints, lower=[-0.1, -0.2], gain=4.0),
        }
        rows = rows_of_each(nao, tasks, q)
        np.testing.assert_allclose(rows["com"].error, c[[0, 2]], atol=1e-15)
        np.testing.assert_allclose(rows["com"].lower, 4.0 * (np.array([0.1, 0.2]) - c[[0, 2]]) + [1.0, 2.0], atol=1e-13)
        np.testing.assert_allclose(rows["com"].upper, 4.0 * (0.5 - c[[0, 2]]) + [1.0, 2.0], atol=1e-13)
        sides = np.array([c[0], c[1], -c[0], -c[1]])
        np.testing.assert_allclose(rows["polygon"].upper, 4.0 * (0.1 - sides), atol=1e-13)
        np.testing.assert_array_equal(rows["polygon"].lower, np.full(4, -np.inf))
        np.testing.assert_allclose(rows["joints"].error, values, atol=0)
        np.testing.assert_allclose(rows["joints"].lower, 4.0 * (np.array([-0.1, -0.2]) - values), atol=1e-14)
        np.testing.assert_array_equal(rows["joints"].upper, np.full(2, np.inf))


@pytest.mark.slow
def test_gradients_are_finite_with_infinite_bounds(nao):
    tasks = {
        "com": osik.ComTask(nao, upper=[0.1, np.inf, np.inf], gain=osik.AdaptiveGain(5.0, 1.0, 2.0)),
        "polygon": osik.ComTask(nao, polygon=square(), gain=0.0),
        "joints": osik.PostureTask(nao, lower=-np.inf, upper=np.inf, gain=osik.AdaptiveGain(5.0, 5.0, 0.0)),
    }
    assert_finite_gradients(partial(rows_of_each, nao), *alone(tasks, nao.q0))


class TestMistakes:
    @pytest.mark.parametrize(
        ("options", "error", "message"),
        [
            (dict(axes="xx"), ValueError, "at most once"),
            (dict(axes="xy", target=[1.0, 2.0, 3.0, 4.0]), ValueError, "target has shape"),
            (dict(polygon=np.zeros((4, 2))), TypeError, "SupportPolygon"),
        ],
    )
    def test_com_task(self, nao, options, error, message):
        refuses(error, message, osik.ComTask, nao, **options)

    def test_posture_task(self, nao):
        base = nao.tree.joint_names[0]
        refuses(ValueError, f"leave out {base}", osik.PostureTask, nao, joints=(base,), lower=0.0)
