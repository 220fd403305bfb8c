"""Limits that are rows, and limits that give way: against MuJoCo, mink, and in closed loop."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mink
import mujoco
import numpy as np
import pytest
from derivative_checks import assert_exact, check
from model_files import mjcf
from mujoco_states import mujoco_at
from refusals import refuses
from task_checks import anywhere, kinematics_at

import osik_jax as osik
from osik_jax.limits import limit_rows
from osik_jax.solvers import Status

LINEAR, ANGULAR = np.array([0.3, 0.2, np.inf]), np.array([1.0, 0.5, 0.7])
DT = 0.01


@pytest.fixture(scope="module")
def flying():
    return osik.Robot.from_mjcf(mjcf("flying"))


@jax.jit
def asked(robot, limit, q):
    """The limit's box and rows."""
    kinematics = osik.forward_kinematics(robot, q)
    return osik.limit_box(robot, q, (limit,), DT), limit_rows(robot, kinematics, q, (limit,), DT)


def sides(box, rows):
    """All that is bounded, as one matrix and its bounds."""
    matrix = np.concatenate([np.eye(len(box[0])), rows.jacobian])
    lower, upper = (np.concatenate([a, b]) for a, b in zip(box, (rows.lower, rows.upper), strict=True))
    bounded = np.isfinite(lower) | np.isfinite(upper)
    return matrix[bounded], lower[bounded], upper[bounded]


class TestFloatingBase:
    def test_in_its_own_axes_against_mink(self, flying, rng):
        ours = osik.FloatingBaseVelocityLimit(flying, linear=LINEAR, angular=ANGULAR)
        model = flying.mj_model
        theirs = mink.FreeJointVelocityLimit(model, LINEAR, ANGULAR)
        for _ in range(5):
            q = anywhere(flying, rng)
            configuration = mink.Configuration(model, q)
            constraint = theirs.compute_qp_inequalities(configuration, DT)
            assert constraint.G is not None and constraint.h is not None
            finite = np.isfinite(constraint.h)
            expected = np.column_stack([constraint.G[finite], constraint.h[finite] / DT])
            matrix, lower, upper = sides(*asked(flying, ours, q))
            found = np.concatenate([np.column_stack([matrix, upper]), np.column_stack([-matrix, -lower])])
            assert found.shape == expected.shape
            for row in expected:
                assert np.abs(found - row).max(1).min() < 1e-12

    def test_in_the_worlds_axes_against_mujoco(self, flying, rng):
        ours = osik.FloatingBaseVelocityLimit(flying, linear=LINEAR, angular=ANGULAR, axes="world", joint="root")
        model, velocity = flying.mj_model, np.zeros(6)
        data = mujoco.MjData(model)
        for _ in range(5):
            q, v = anywhere(flying, rng), rng.normal(size=flying.nv)
            data.qpos[:], data.qvel[:] = q, v
            mujoco.mj_forward(model, data)
            body = model.body("torso").id
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
            matrix, lower, upper = sides(*asked(flying, ours, q))
            np.testing.assert_allclose(matrix @ v, np.r_[velocity[3:5], velocity[:3]], atol=1e-12)
            np.testing.assert_allclose(upper, np.r_[LINEAR[:2], ANGULAR], atol=1e-15)
            np.testing.assert_array_equal(lower, -upper)

    def test_one_of_the_two(self, flying):
        kinematics = jax.jit(osik.forward_kinematics)(flying, flying.q0)
        make = osik.FloatingBaseVelocityLimit
        for limit, rows in (
            (make(flying, linear=1.0), 3),
            (make(flying, angular=1.0), 0),
            (make(flying, linear=1.0, axes="world"), 0),
            (make(flying, angular=1.0, axes="world"), 3),
        ):
            found = limit.rows(flying, kinematics, flying.q0, DT)
            assert (0 if found is None else len(found.lower)) == rows
            assert np.isfinite(limit.box(flying, flying.q0, DT)[1]).sum() == 3 - rows

    def test_mistakes(self, flying, arm):
        make: Any = osik.FloatingBaseVelocityLimit
        refuses(ValueError, "needs linear, angular or both", make, flying)
        refuses(ValueError, "no free joint", make, arm, linear=1.0)
        refuses(KeyError, "free joints: root", make, flying, linear=1.0, joint="rot")
        refuses(ValueError, "0 or more", make, flying, angular=[1.0, -1.0, 1.0])
        refuses(ValueError, "'base' or 'world'", make, flying, linear=1.0, axes="body")


@jax.jit
def places(arm, q):
    return jax.vmap(lambda q: osik.forward_kinematics(arm, q).frame_pose(arm, "hand")[0])(q)


class TestBarrier:
    def test_rows_against_mujoco(self, flying, rng):
        normals = rng.normal(size=(4, 3))
        lower, upper = np.array([-0.1, -np.inf, 0.0, -1.0]), np.array([0.2, 0.3, np.inf, 1.0])
        wall = osik.PositionBarrier(flying, "fist", lower=lower, upper=upper, normals=normals, gain=3.0)
        model, jacobian = flying.mj_model, np.zeros((3, flying.nv))
        for _ in range(5):
            q = anywhere(flying, rng)
            data = mujoco_at(flying, q)
            mujoco.mj_jacBody(model, data, jacobian, None, model.body("fist").id)
            value = normals @ data.body("fist").xpos
            rows = asked(flying, wall, q)[1]
            np.testing.assert_allclose(rows.jacobian, normals @ jacobian, atol=1e-12)
            np.testing.assert_allclose(rows.lower, 3.0 * (lower - value), atol=1e-12)
            np.testing.assert_allclose(rows.upper, 3.0 * (upper - value), atol=1e-12)
        steep = eqx.tree_at(lambda limit: limit.gain, wall, jnp.asarray(1e6))
        np.testing.assert_allclose(asked(flying, steep, q)[1].upper, (upper - value) / DT, rtol=1e-12, atol=1e-10)

    @pytest.mark.slow
    def test_a_hand_that_wants_through(self, arm):
        """The hand slides along the walls, and does not pass them by more than the path curves in a step."""
        p, R = kinematics_at(arm, arm.q0).frame_pose(arm, "hand")
        tasks = {
            "hand": osik.FrameTask(arm, "hand", target=(p + np.array([0.3, 0.2, 0.0]), R), orientation_weight=0.0),
            "posture": osik.PostureTask(arm, weight=1e-4, priority=2),
        }
        skew = np.array([0.6, 0.8, 0.0])
        walls = (
            osik.PositionBarrier(arm, "hand", upper=p + np.array([0.1, np.inf, np.inf]), gain=20.0),
            osik.PositionBarrier(arm, "hand", normals=skew, upper=skew @ p + 0.15, gain=20.0),
        )
        limits = (osik.ConfigurationLimit(arm), osik.VelocityLimit(arm, velocity={"*": 1.0}), *walls)
        path = osik.rollout(arm, arm.q0, tasks, scheme=osik.HierarchicalQP(), limits=limits, dt=DT, steps=150)
        assert (path.solution.status == Status.SOLVED).all()
        assert path.solution.box_violation.max() < 1e-9
        hand = np.asarray(places(arm, path.q))
        assert (hand[:, 0] - p[0]).max() < 0.1 + 1e-4
        assert (hand @ skew - skew @ p).max() < 0.15 + 1e-4
        np.testing.assert_allclose(hand[-1, 0] - p[0], 0.1, atol=1e-3)
        np.testing.assert_allclose(hand[-1] @ skew - skew @ p, 0.15, atol=1e-3)

    def test_mistakes(self, arm):
        make = osik.PositionBarrier
        refuses(ValueError, "needs lower, upper or both", make, arm, "hand")
        refuses(ValueError, r"normals has shape \(2,\)", make, arm, "hand", lower=0.0, normals=[1.0, 0.0])
        refuses(ValueError, "not 0", make, arm, "hand", lower=0.0, normals=[0.0, 0.0, 0.0])
        refuses(ValueError, "gain is 0", make, arm, "hand", lower=0.0, gain=0.0)


@pytest.mark.slow
def test_derivatives_of_rows(flying):
    """With respect to the configuration and all numbers of the limits, in both modes."""
    rng = np.random.default_rng(3)
    count = 8
    q = jnp.stack([jnp.asarray(anywhere(flying, rng)) for _ in range(count)])
    limits = (
        osik.FloatingBaseVelocityLimit(flying, linear=[0.3, 0.2, 0.1], angular=ANGULAR),
        osik.FloatingBaseVelocityLimit(flying, linear=0.4, angular=ANGULAR, axes="world"),
        osik.PositionBarrier(flying, "fist", lower=-0.2, upper=[0.3, np.inf, 0.4]),
    )
    point = jnp.zeros(flying.nv), limits
    rates = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=(count, *leaf.shape))), point)

    def path(case, t):
        q, (v, more) = case
        moved = jax.tree.map(lambda leaf, rate: jnp.where(jnp.isinf(leaf), leaf, leaf * (1.0 + t * rate)), limits, more)
        return osik.integrate(flying, q, v, t), moved

    def function(point):
        q, limits = point
        rows = limit_rows(flying, osik.forward_kinematics(flying, q), q, limits, DT)
        assert rows is not None
        return (rows.jacobian, *(jnp.where(jnp.isinf(b), 0.0, b) for b in (rows.lower, rows.upper))), ()

    assert_exact(check(function, path, (q, rates)), most=1.0)


@jax.jit
def solve(robot, tasks, scheme, limits):
    return osik.solve(robot, robot.q0, tasks, scheme=scheme, limits=limits, dt=DT)


class TestLimitTask:
    def tasks(self, arm, limit, priority):
        p, R = kinematics_at(arm, arm.q0).frame_pose(arm, "hand")
        return {
            "hand": osik.FrameTask(arm, "hand", target=(p + np.array([0.2, 0.3, 0.1]), R), rows="position", priority=2),
            "speed": osik.LimitTask(arm, limit, priority=priority),
            "posture": osik.PostureTask(arm, priority=4, weight=1e-3),
        }

    def test_above_the_others_it_is_the_limit(self, arm):
        limit = osik.VelocityLimit(arm, velocity={"*": 0.5})
        tasks = self.tasks(arm, limit, 1)
        ranked = solve(arm, tasks, osik.HierarchicalQP(), osik.no_limits)
        rest = {name: task for name, task in tasks.items() if name != "speed"}
        strict = solve(arm, rest, osik.HierarchicalQP(), (limit,))
        np.testing.assert_allclose(ranked.velocity, strict.velocity, atol=1e-9)
        np.testing.assert_allclose(np.abs(ranked.velocity).max(), 0.5, atol=1e-12)

    def test_below_another_it_gives_way(self, arm):
        """The hand's task is met, and the speeds are as little beyond the limit as that allows."""
        limit = osik.VelocityLimit(arm, velocity={"*": 0.5})
        s = solve(arm, self.tasks(arm, limit, 3), osik.HierarchicalQP(curvature_damping=0.0), osik.no_limits)
        assert s.status == Status.SOLVED
        assert np.abs(s.slack["hand"]).max() < 1e-9
        v = np.asarray(s.velocity)
        beyond = v - np.clip(v, -0.5, 0.5)
        np.testing.assert_allclose(s.slack["speed"], beyond, atol=1e-15)
        assert np.abs(beyond).max() > 0.1
        J = np.asarray(osik.frame_jacobian(arm, kinematics_at(arm, arm.q0), "hand"))[:3]
        null = np.linalg.svd(J)[2][3:]
        np.testing.assert_allclose(null @ beyond, 0.0, atol=1e-9)  # its gradient, where the hand leaves freedom

    def test_knows_the_step_and_the_last_velocity(self, arm):
        soft = {
            "range": osik.LimitTask(arm, osik.ConfigurationLimit(arm)),
            "jerk": osik.LimitTask(arm, osik.AccelerationLimit(arm, {"*": 2.0})),
            "posture": osik.PostureTask(arm, target=arm.q0.at[0].set(5.0), priority=2, weight=1.0),
        }
        path = osik.rollout(arm, arm.q0, soft, scheme=osik.HierarchicalQP(), dt=0.05, steps=60, limits=osik.no_limits)
        assert np.abs(np.diff(np.asarray(path.solution.velocity), axis=0, prepend=0.0)).max() < 2.0 * 0.05 + 1e-9
        reached = np.asarray(path.q[:, 0])
        np.testing.assert_allclose(reached.max(), arm.position_upper[0], atol=1e-9)

    def test_mistakes(self, arm):
        task = osik.LimitTask(arm, osik.VelocityLimit(arm))
        assert task.replaceable == ("weight", "limit")
        refuses(ValueError, "another structure", task.replace, limit=osik.ConfigurationLimit(arm))
        new = osik.VelocityLimit(arm, velocity={"*": 0.1})
        np.testing.assert_array_equal(jax.tree.leaves(task.replace(limit=new).limit)[0], 0.1)
