"""The coupled error of pose tasks against Pinocchio, pink, mink and central differences."""

import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mink
import numpy as np
import pink
import pinocchio as pin
import pytest
from refusals import refuses
from scipy.spatial.transform import Rotation
from task_checks import (
    anywhere,
    assert_every_number_counts,
    assert_finite_gradients,
    assert_jacobians,
    at_each,
    kinematics_at,
    random_pose,
    rows_of_each,
)

import osik_jax as osik
from osik_jax.tasks._pose import pose_log, seen_from

DT = 0.01


@pytest.fixture(scope="module")
def pinocchio_arm():
    return pin.buildModelFromMJCF(str(Path(osik.__file__).parent / "robot" / "models" / "arm7.xml"))


@pytest.fixture
def tasks(arm, rng):
    """Of a frame in the world and in another frame, whole and in parts, with targets that stand still."""
    poses = [random_pose(rng, np.array([0.3, 0.1, 0.4])) for _ in range(4)]
    weights: Any = dict(position_weight=[1.0, 2.0, 3.0], orientation_weight=[0.5, 0.0, 2.0])
    return {
        "whole": osik.FrameTask(arm, "hand", target=poses[0], error="se3", **weights),
        "position": osik.FrameTask(arm, "hand", target=poses[1], error="se3", rows="position"),
        "bounded": osik.FrameTask(
            arm, "hand", target=poses[2], error="se3", rows=(True, False) * 3, lower=-0.1, upper=0.2
        ),
        "relative": osik.RelativeFrameTask(arm, "hand", "link3", target=poses[3], error="se3"),
    }


class TestLogarithm:
    @pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.09, 0.11, 1.0, 3.0, math.pi - 1e-3])
    def test_against_pinocchio(self, angle, rng):
        axis = rng.normal(size=3)
        rotation = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
        position = rng.normal(size=3)
        pose = pin.SE3(rotation, position)
        found, matrix = jax.jit(pose_log)(jnp.asarray(position), jnp.asarray(rotation))
        np.testing.assert_allclose(found, pin.log6(pose).vector, atol=1e-9)
        np.testing.assert_allclose(matrix, pin.Jlog6(pose), atol=1e-9)

    def test_a_twist_seen_from_another_frame(self, rng):
        position, rotation = random_pose(rng, np.zeros(3))
        twist = rng.normal(size=6)
        expected = pin.SE3(rotation, position).actInv(pin.Motion(twist)).vector
        np.testing.assert_allclose(seen_from(position, rotation, twist), expected, atol=1e-14)


class TestRows:
    @pytest.mark.slow
    def test_against_central_differences(self, arm, tasks, rng):
        configurations = jnp.stack([anywhere(arm, rng) for _ in range(5)])
        assert_jacobians(*at_each(arm, tasks, configurations))

    def test_every_number_counts_and_compiles_nothing(self, arm, tasks, rng):
        moving = {name: task.replace(target_velocity=rng.normal(size=6)) for name, task in tasks.items()}
        idle = ("['position'].orientation_weight",)
        assert_every_number_counts(arm, moving, jnp.asarray(anywhere(arm, rng)), idle=idle)

    def test_are_pinks(self, arm, tasks, pinocchio_arm, rng):
        """With the other sign: pink's error is the target's, ours the frame's."""
        q = anywhere(arm, rng)
        configuration = pink.Configuration(pinocchio_arm, pinocchio_arm.createData(), q)
        theirs = {
            "whole": pink.tasks.FrameTask("hand", 1.0, 1.0),
            "relative": pink.tasks.RelativeFrameTask("hand", "link3", 1.0, 1.0),
        }
        rows = rows_of_each(arm, tasks, q)
        for name, task in theirs.items():
            position, rotation = (np.asarray(part) for part in tasks[name].target)
            task.set_target(pin.SE3(rotation, position))
            sign = -1.0 if name == "whole" else 1.0
            np.testing.assert_allclose(rows[name].error, sign * task.compute_error(configuration), atol=1e-9)
            np.testing.assert_allclose(rows[name].jacobian, sign * task.compute_jacobian(configuration), atol=1e-9)

    def test_are_minks(self, arm, tasks, rng):
        q = anywhere(arm, rng)
        configuration = mink.Configuration(arm.mj_model, q=q)
        theirs = {
            "whole": mink.FrameTask("hand", "site", 1.0, 1.0),
            "relative": mink.RelativeFrameTask("hand", "site", "link3", "body", 1.0, 1.0),
        }
        rows = rows_of_each(arm, tasks, q)
        for name, task in theirs.items():
            position, rotation = (np.asarray(part) for part in tasks[name].target)
            task.set_target(mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(rotation), position))
            sign = -1.0 if name == "whole" else 1.0
            np.testing.assert_allclose(rows[name].error, sign * task.compute_error(configuration), atol=1e-9)
            np.testing.assert_allclose(rows[name].jacobian, sign * task.compute_jacobian(configuration), atol=1e-9)

    def test_weights_are_squared_costs_along_the_frames_axes(self, arm, tasks):
        weight = rows_of_each(arm, tasks, arm.q0)["whole"].weight
        np.testing.assert_array_equal(weight, [1.0, 2.0, 3.0, 0.5, 0.0, 2.0])


class TestClosedLoop:
    def test_a_step_is_pinks(self, arm, pinocchio_arm, rng):
        """Position alone, anisotropic costs and another frame's pose, in one weighted problem."""
        q = np.asarray(arm.q0) + 0.2 * rng.uniform(-1.0, 1.0, 7)
        hand, elbow = (random_pose(rng, np.array([0.4, 0.0, 0.5])) for _ in range(2))
        theirs = {
            "hand": pink.tasks.FrameTask("hand", [1.0, 2.0, 0.5], [0.3, 0.1, 0.0], gain=0.1),
            "elbow": pink.tasks.FrameTask("link4", 0.7, 0.0, gain=0.2),
            "posture": pink.tasks.PostureTask(cost=0.1, gain=0.1),
        }
        theirs["posture"].set_target(np.asarray(arm.q0))
        for name, (position, rotation) in (("hand", hand), ("elbow", elbow)):
            theirs[name].set_target(pin.SE3(rotation, position))
        configuration = pink.Configuration(pinocchio_arm, pinocchio_arm.createData(), q)
        expected = pink.solve_ik(configuration, theirs.values(), DT, solver="daqp", limits=[])
        squared: Any = dict(position_weight=np.square([1.0, 2.0, 0.5]), orientation_weight=np.square([0.3, 0.1, 0.0]))
        ours = {
            "hand": osik.FrameTask(arm, "hand", target=hand, error="se3", gain=0.1 / DT, **squared),
            "elbow": osik.FrameTask(
                arm, "link4", target=elbow, error="se3", rows="position", weight=0.49, gain=0.2 / DT
            ),
            "posture": osik.PostureTask(arm, weight=0.01, gain=0.1 / DT),
        }
        scheme = osik.WeightedQP(damping=1e-12, curvature_damping=0.0)
        solution = osik.solve(arm, q, ours, scheme=scheme, dt=DT, limits=osik.no_limits)
        np.testing.assert_allclose(solution.velocity, expected, atol=1e-8)
        assert np.abs(expected).max() > 0.5


class TestGradients:
    @pytest.mark.slow
    @pytest.mark.variants(release=["True"])
    @pytest.mark.parametrize("x64", [True, False])
    def test_finite_at_zero_error_and_near_pi_in_both_modes(self, x64):
        with jax.enable_x64(x64):
            arm = osik.load_robot("arm7")
            p, R = kinematics_at(arm, arm.q0).frame_pose(arm, "hand")
            angles = np.array([0.0, 1e-12, 1e-6, math.pi - 1e-4, math.pi])
            turns = jnp.asarray(Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0]).as_matrix(), R.dtype)
            task = osik.FrameTask(arm, "hand", error="se3", gain=osik.AdaptiveGain(10.0, 1.0, 2.0))
            batch = jax.vmap(lambda turn: task.replace(target=(p, turn @ R)))(turns)

            def rows(task, q):
                return {"hand": task.rows(arm, osik.forward_kinematics(arm, q), q)}

            assert_finite_gradients(rows, batch, jnp.tile(arm.q0, (len(angles), 1)))

    @pytest.mark.release
    def test_through_a_solve_at_the_target(self, arm):
        task = osik.FrameTask(arm, "hand", error="se3")

        def speed(task, q):
            return jnp.sum(osik.solve(arm, q, {"hand": task}, scheme=osik.WeightedQP(damping=1e-4)).velocity)

        value, gradient = jax.value_and_grad(speed, argnums=(0, 1))(task, arm.q0)
        assert abs(value) < 1e-9
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
        assert np.abs(gradient[1]).max() > 1.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(error="log"), "'decoupled', 'se3'"),
        (dict(error="se3", axes="world"), "frame's own axes"),
        (dict(error="se3", orientation_jacobian="geometric"), "goes with 'decoupled'"),
        (dict(error="se3", rows="position", target=np.zeros(3)), r"a pose is \(position \(3,\)"),
    ],
)
def test_mistakes_are_told(arm, options, message):
    refuses(ValueError, message, osik.FrameTask, arm, "hand", **options)
