"""Tasks from functions: against tasks written by hand, central differences and numbers worked out by hand."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from model_files import mjcf
from refusals import refuses
from task_checks import assert_every_number_counts, assert_jacobians, at_each, moved_by, rows_of_each

import osik_jax as osik
from osik_jax.kinematics._rates import kinematics_rates


def place_of_tip(robot, kinematics, q):
    """What a FrameTask has, found by differentiation."""
    return kinematics.frame_pose(robot, "tip")[0]


def center_and_joints(robot, kinematics, q):
    """Rows of different kinds: masses and joint values."""
    return jnp.concatenate([osik.center_of_mass(robot, kinematics), q[-2:]])


def quaternion(robot, kinematics, q):
    """Entries of q that are no coordinates: the Jacobian is along the tangent."""
    return q[3:7]


class Apart(eqx.Module):
    """Half the squared distance of two frames [m^2], scaled: an array, a float, a name and an integer."""

    scale: Float[Array, "2"]
    offset: float
    power: int
    frame: str = eqx.field(static=True)

    def __call__(self, robot, kinematics, q):
        (a, _), (b, _) = (kinematics.frame_pose(robot, name) for name in (self.frame, "right hand"))
        return self.scale * 0.5 * jnp.sum((a - b) ** self.power) + self.offset


class Learned(eqx.Module):
    """A network of the configuration, with an activation that is no number."""

    first: Float[Array, "8 nq"]
    second: Float[Array, "2 8"]
    activation: Callable

    def __call__(self, robot, kinematics, q):
        return self.second @ self.activation(self.first @ q)


@pytest.fixture(scope="module")
def robot():
    return osik.Robot.from_mjcf(mjcf("two_arms"))


@pytest.fixture(scope="module")
def tasks(robot):
    rng = np.random.default_rng(3)
    apart = Apart(jnp.array([1.0, 2.0]), 0.1, 2, "left hand")
    learned = Learned(jnp.asarray(rng.normal(size=(8, robot.nq))), jnp.asarray(rng.normal(size=(2, 8))), jnp.tanh)
    return {
        "tip": osik.FunctionTask(
            robot, place_of_tip, target=[0.1, 0.2, 0.3], target_velocity=[1.0, 2.0, 3.0], gain=4.0
        ),
        "mixed": osik.FunctionTask(robot, center_and_joints, lower=[-0.1, -0.2, 0.1, 0.0, 0.0], upper=0.2, gain=4.0),
        "quaternion": osik.FunctionTask(robot, quaternion, target=[1.0, 0.0, 0.0, 0.0]),
        "apart": osik.FunctionTask(robot, apart, gain=osik.AdaptiveGain(5.0, 1.0, 2.0)),
        "learned": osik.FunctionTask(robot, learned, lower=0.1, upper=5.0),
        "one row": osik.FunctionTask(robot, lambda robot, kinematics, q: jnp.sin(q[-1]), weight=3.0),
    }


@pytest.fixture(scope="module")
def configurations(robot):
    rng = np.random.default_rng(4)
    moves = jnp.asarray(rng.uniform(-1.5, 1.5, (3, robot.nv)))
    return jax.vmap(moved_by, in_axes=(None, None, 0))(robot, robot.q0, moves)


@pytest.fixture(scope="module")
def found(robot, tasks, configurations):
    return at_each(robot, tasks, configurations)


@pytest.mark.slow
def test_how_kinematics_change_is_what_differentiating_them_gives():
    """A body with four joints, one with a slide and a ball joint, a follower: every field, along every entry of v."""
    robot = osik.Robot.from_mjcf(mjcf("joints_of_one_body"))
    assert robot.nv == 8
    q = osik.integrate(robot, robot.q0, jnp.cos(jnp.arange(8.0)))

    @jax.jit
    def both(q):
        expected = jax.jacfwd(lambda v: osik.forward_kinematics(robot, osik.integrate(robot, q, v)))(jnp.zeros(8))
        return kinematics_rates(robot, osik.forward_kinematics(robot, q)), expected

    for ours, expected in zip(*map(jax.tree.leaves, both(q)), strict=True):
        np.testing.assert_allclose(ours, expected, atol=1e-14)
        assert np.abs(expected).max() > 0.1


class TestRows:
    def test_against_central_differences(self, found):
        assert_jacobians(*found)
        for name, row in found[0].items():
            assert np.abs(row.jacobian).max() > 0.1, name

    def test_against_tasks_written_by_hand(self, robot, found, configurations):
        frame = osik.FrameTask(
            robot,
            "tip",
            target=([0.1, 0.2, 0.3], np.eye(3)),
            target_velocity=[1.0, 2.0, 3.0, 0.0, 0.0, 0.0],
            rows="position",
            gain=4.0,
        )
        by_hand = {"tip": frame, "com": osik.ComTask(robot, lower=[-0.1, -0.2, 0.1], upper=0.2, gain=4.0)}
        for i, q in enumerate(configurations):
            expected = rows_of_each(robot, by_hand, q)
            ours = {name: jax.tree.map(lambda a, i=i: a[i], row) for name, row in found[0].items()}
            for field in ("error", "jacobian", "lower", "upper"):
                pairs = ("tip", "tip", slice(None)), ("mixed", "com", slice(3))
                for own, other, rows in pairs:
                    value = getattr(ours[own], field)[rows]
                    np.testing.assert_allclose(value, getattr(expected[other], field), atol=1e-12, err_msg=own)

    def test_by_hand(self, robot, tasks, configurations):
        q = configurations[0]
        rows = rows_of_each(robot, tasks, q)
        np.testing.assert_allclose(rows["one row"].error, np.sin(q[-1:]), rtol=1e-15)
        np.testing.assert_allclose(rows["one row"].jacobian, [[0.0] * (robot.nv - 1) + [np.cos(q[-1])]], atol=1e-15)
        np.testing.assert_allclose(rows["one row"].lower, -10.0 * np.sin(q[-1:]), rtol=1e-14)
        np.testing.assert_array_equal(rows["one row"].weight, [3.0])
        left, right = (
            jax.jit(osik.forward_kinematics)(robot, q).frame_pose(robot, n)[0] for n in ("left hand", "right hand")
        )
        half = 0.5 * np.sum(np.asarray(left - right) ** 2)
        np.testing.assert_allclose(rows["apart"].error, [half + 0.1, 2.0 * half + 0.1], rtol=1e-13)


class TestCompilation:
    def test_every_number_counts_and_compiles_nothing(self, robot, tasks, configurations):
        """Those of functions too."""
        assert_every_number_counts(robot, tasks, configurations[0])
        assert len(jax.tree.leaves(tasks["learned"].numbers)) == len(jax.tree.leaves(tasks["apart"].numbers)) == 2

    def test_another_function_of_the_same_structure_compiles_nothing(self, robot, tasks, configurations):
        traces = []

        @jax.jit
        def error(task, q):
            traces.append(1)
            return task.rows(robot, osik.forward_kinematics(robot, q), q).error

        q, task = configurations[0], tasks["apart"]
        before = error(task, q)
        half = before[0] - 0.1
        made = osik.FunctionTask(
            robot, Apart(jnp.array([5.0, 6.0]), 0.2, 2, "left hand"), gain=osik.AdaptiveGain(9, 8, 7)
        )
        np.testing.assert_allclose(error(made, q), [5.0 * half + 0.2, 6.0 * half + 0.2], rtol=1e-14)
        assert len(traces) == 1
        assert isinstance(made.function, Apart)

    def test_plain_functions_are_told_apart_by_identity(self, robot, tasks, configurations):
        traces = []

        @jax.jit
        def error(task, q):
            traces.append(1)
            return task.rows(robot, osik.forward_kinematics(robot, q), q).error

        def made():
            return osik.FunctionTask(robot, lambda robot, kinematics, q: q[-1])

        first, second = made(), made()
        for task in (first, first.replace(weight=2.0), osik.FunctionTask(robot, first.function)):
            error(task, configurations[0])
        assert len(traces) == 1
        error(second, configurations[0])
        assert len(traces) == 2

    def test_rates_of_bodies_that_the_function_does_not_use_are_not_computed(self):
        robot = osik.load_robot("g1")
        task = osik.FunctionTask(robot, lambda robot, kinematics, q: kinematics.frame_pose(robot, "torso_link")[0])
        step = jax.jit(lambda q: task.rows(robot, osik.forward_kinematics(robot, q), q)).lower(robot.q0).compile()
        of_all = len(robot.body_names) * 9 * robot.nv * robot.q0.dtype.itemsize
        memory = step.memory_analysis()
        assert memory is not None and memory.temp_size_in_bytes < of_all / 4

    def test_a_float32_robot_has_float32_tasks(self, robot):
        small = jax.tree.map(lambda x: x.astype(jnp.float32), robot)
        task = osik.FunctionTask(small, Apart(jnp.ones(2, jnp.float32), 0.1, 2, "left hand"), lower=0.0)
        for leaf in jax.tree.leaves(task):
            assert leaf.dtype == jnp.float32


class TestClosedLoop:
    def test_hands_come_to_a_distance(self, arm):
        """Their squared distance decays to 0.2 m squared like any task's error, as fast as the gain says."""
        home, _ = jax.jit(osik.forward_kinematics)(arm, arm.q0).frame_pose(arm, "hand")

        class FromPoint(eqx.Module):
            point: Float[Array, "3"]

            def __call__(self, robot, kinematics, q):
                return jnp.sum((kinematics.frame_pose(robot, "hand")[0] - self.point) ** 2)

        distance = osik.FunctionTask(arm, FromPoint(home + jnp.array([0.1, 0.0, 0.05])), target=0.2**2, gain=5.0)
        options: Any = dict(scheme=osik.NullSpace(damping=1e-6), limits=osik.no_limits)
        run = osik.rollout(arm, arm.q0, {"distance": distance}, dt=0.01, steps=100, **options)
        error = np.asarray(run.solution.error["distance"])[:, 0]
        np.testing.assert_allclose(error[0], 0.1**2 + 0.05**2 - 0.2**2, rtol=1e-12)
        assert abs(error[-1]) < 0.01 * abs(error[0])

    @pytest.mark.slow
    def test_rows_differentiate_exactly(self, robot, tasks, configurations):
        """The Jacobian has the function's second derivatives: with respect to its numbers and to q, by differences."""
        q, mix = configurations[0], jnp.cos(jnp.arange(2.0 * robot.nv)).reshape(2, robot.nv)

        def total(scale, q):
            task = osik.FunctionTask(robot, Apart(scale, 0.1, 2, "left hand"), gain=tasks["apart"].gain)
            rows = task.rows(robot, osik.forward_kinematics(robot, q), q)
            return jnp.sum(mix * rows.jacobian) + jnp.sum(rows.lower)

        @jax.jit
        def both(scale, q, h=1e-6):
            steps = h * jnp.concatenate([jnp.eye(3), -jnp.eye(3)])
            values = jax.vmap(lambda d: total(scale + d[:2], q.at[-2].add(d[2])))(steps)
            return jax.grad(total, argnums=(0, 1))(scale, q), (values[:3] - values[3:]) / (2 * h)

        (by_scale, by_q), expected = both(jnp.array([1.0, 2.0]), q)
        np.testing.assert_allclose([*by_scale, by_q[-2]], expected, rtol=1e-7, atol=1e-8)
        assert np.abs(expected).min() > 1e-3


class TestMistakes:
    @pytest.mark.parametrize(
        ("options", "error", "message"),
        [
            (dict(function=lambda r, k, q: q[:0]), ValueError, r"\(m,\)"),
            (dict(function=lambda r, k, q: (q, q)), ValueError, r"\(m,\)"),
            (dict(function=quaternion, target=[1.0, 2.0]), ValueError, r"target has shape \(2,\), expected \(4,\)"),
            (dict(function=quaternion, target=1.0, lower=0.0), TypeError, "not both"),
        ],
    )
    def test_at_construction(self, robot, options, error, message):
        refuses(error, message, osik.FunctionTask, robot, **options)

    def test_replace(self, tasks):
        refuses(TypeError, "no 'function' to replace; it has: weight, gain", tasks["tip"].replace, function=quaternion)
        assert tasks["apart"].replaceable == ("weight", "gain", "target", "target_velocity")
