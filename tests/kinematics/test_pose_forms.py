"""Targets: every way to write a pose is the same pose, and a configuration sets any target."""

from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import mink
import numpy as np
import pinocchio as pin
import pytest
from refusals import refuses
from scipy.spatial.transform import Rotation
from task_checks import anywhere, kinematics_at, rows_of_each

import osik_jax as osik
from osik_jax.kinematics._pose_forms import as_pose

POSITION = np.array([0.3, -0.1, 0.5])
TURN = Rotation.from_rotvec([0.4, -0.8, 0.3])
WXYZ = np.roll(TURN.as_quat(), 1)
R = TURN.as_matrix()
MATRIX = np.block([[R, POSITION[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
WAYS = {
    "rotation matrix": (POSITION, R),
    "quaternion": (POSITION, WXYZ),
    "lists": [POSITION.tolist(), WXYZ.tolist()],
    "the other quaternion": (POSITION, -WXYZ),
    "jaxlie.SO3": (POSITION, jaxlie.SO3(jnp.asarray(WXYZ))),
    "SciPy": (POSITION, TURN),
    "4 x 4": MATRIX,
    "4 x 4 in lists": MATRIX.tolist(),
    "jaxlie.SE3": jaxlie.SE3(jnp.concatenate([WXYZ, POSITION])),
    "mink.SE3": mink.SE3(np.concatenate([WXYZ, POSITION])),
    "pinocchio.SE3": pin.SE3(R, POSITION),
}
TRACED = ("rotation matrix", "quaternion", "4 x 4", "jaxlie.SE3")


def assert_the_pose(target):
    np.testing.assert_allclose(target[0], POSITION, atol=1e-15)
    np.testing.assert_allclose(target[1], R, atol=1e-15)


class TestWays:
    @pytest.mark.parametrize("way", WAYS)
    def test_are_one_pose_wherever_a_pose_is_taken(self, arm, way):
        given = WAYS[way]
        assert_the_pose(osik.FrameTask(arm, "hand", target=given).target)
        assert_the_pose(osik.FrameTask(arm, "hand").replace(target=given).target)
        assert_the_pose(osik.RelativeFrameTask(arm, "hand", "link2", target=given).target)
        assert_the_pose(osik.RelativeFrameTask(arm, "hand", "link2").replace(target=given).target)
        assert_the_pose(osik.ContactTask(arm, "hand", anchor=given).anchor)
        assert_the_pose(osik.ContactTask(arm, "hand").replace(anchor=given).anchor)

    @pytest.mark.parametrize("way", TRACED)
    def test_inside_jit_and_in_batches(self, arm, way):
        task = osik.FrameTask(arm, "hand")
        assert_the_pose(jax.jit(lambda given: task.replace(target=given).target)(WAYS[way]))
        batch = jax.tree.map(lambda part: jnp.stack([jnp.asarray(part)] * 3), WAYS[way])
        targets = jax.vmap(lambda given: task.replace(target=given).target)(batch)
        for k in range(3):
            assert_the_pose(jax.tree.map(lambda part, k=k: part[k], targets))

    @pytest.mark.variants(release=["rotation matrix", "quaternion"])
    @pytest.mark.parametrize("way", TRACED)
    def test_at_every_step_of_a_rollout(self, arm, way):
        task, steps = osik.FrameTask(arm, "hand"), 3
        targets = jax.tree.map(lambda part: jnp.stack([jnp.asarray(part)] * steps), WAYS[way])
        options: Any = dict(scheme=osik.WeightedQP(), steps=steps)
        path = osik.rollout(arm, arm.q0, {"hand": task}, targets={"hand": targets}, **options)
        alike = osik.rollout(arm, arm.q0, {"hand": task.replace(target=(POSITION, R))}, **options)
        np.testing.assert_allclose(path.q, alike.q, atol=1e-12)

    def test_gradients_reach_a_quaternion(self, arm):
        """It counts by its direction alone: the gradient has no part along it."""

        @jax.jit
        @jax.value_and_grad
        def error(wxyz):
            task = osik.FrameTask(arm, "hand").replace(target=(POSITION, wxyz))
            return jnp.sum(task.rows(arm, kinematics_at(arm, arm.q0), arm.q0).error ** 2)

        gradient = error(jnp.asarray(WXYZ))[1]
        assert np.abs(gradient).max() > 0.1
        assert abs(gradient @ WXYZ) < 1e-12
        h = 1e-6
        differences = [(error(WXYZ + h * e)[0] - error(WXYZ - h * e)[0]) / (2 * h) for e in np.eye(4)]
        np.testing.assert_allclose(gradient, differences, atol=1e-7)

    def test_are_cast(self):
        with jax.enable_x64(False):
            arm = osik.load_robot("arm7")
            for given in (WAYS[way] for way in WAYS if not way.startswith("jaxlie")):
                target = osik.FrameTask(arm, "hand", target=given).target
                assert {part.dtype for part in target} == {jnp.float32.dtype}


class TestParts:
    """What the rows do not depend on may be left out, and stays as it is."""

    def test_a_position_alone(self, arm):
        p, home = kinematics_at(arm, arm.q0).frame_pose(arm, "hand")
        task = osik.FrameTask(arm, "hand", rows="position", target=POSITION)
        np.testing.assert_array_equal(task.target[0], POSITION)
        np.testing.assert_allclose(task.target[1], home, atol=1e-14)
        turned = task.replace(target=(POSITION, R)).replace(target=p)
        np.testing.assert_array_equal(turned.target[0], p)
        np.testing.assert_array_equal(turned.target[1], R)
        relative = osik.RelativeFrameTask(arm, "hand", "link2", rows="position", target=POSITION)
        np.testing.assert_array_equal(relative.target[0], POSITION)

    def test_positions_of_a_rollout(self, arm):
        task, steps = osik.FrameTask(arm, "hand", rows="position"), 4
        p = np.asarray(task.target[0])
        points = p + np.linspace(0.0, 0.1, steps)[:, None]
        options: Any = dict(scheme=osik.WeightedQP(), steps=steps)
        path = osik.rollout(arm, arm.q0, {"hand": task}, targets={"hand": points}, **options)
        whole = (points, np.tile(np.eye(3), (steps, 1, 1)))
        alike = osik.rollout(arm, arm.q0, {"hand": task}, targets={"hand": whole}, **options)
        np.testing.assert_allclose(path.q, alike.q, atol=1e-12)

    @pytest.mark.parametrize("given", [R, WXYZ, TURN, jaxlie.SO3(jnp.asarray(WXYZ))], ids=["R", "wxyz", "SciPy", "SO3"])
    def test_a_rotation_alone(self, arm, given):
        task = osik.FrameTask(arm, "hand", rows="orientation", target=given)
        np.testing.assert_allclose(task.target[1], R, atol=1e-15)
        np.testing.assert_allclose(task.target[0], kinematics_at(arm, arm.q0).frame_pose(arm, "hand")[0], atol=1e-14)


class TestMistakes:
    @pytest.mark.parametrize(
        ("given", "error", "message"),
        [
            (np.zeros((3, 4)), ValueError, r"shape \(3, 4\).*\(4, 4\) matrix or a jaxlie.SE3"),
            (np.zeros(7), ValueError, r"quaternion w x y z \(4,\)"),
            ((np.zeros(3), np.zeros(3)), ValueError, r"a pair of shapes \(3,\) and \(3,\)"),
            ((np.zeros((5, 3)), np.tile(WXYZ, (5, 1))), ValueError, "vmap"),
            (jaxlie.SE3(jnp.zeros((5, 7)).at[:, 0].set(1.0)), ValueError, "vmap"),
        ],
    )
    def test_are_told_with_what_is_accepted(self, arm, given, error, message):
        refuses(error, message, osik.FrameTask(arm, "hand").replace, target=given)

    def test_says_where_a_part_will_do(self, arm):
        with pytest.raises(ValueError, match=r"shape \(2,\).*here a position \(3,\) alone will do"):
            osik.FrameTask(arm, "hand", rows="position", target=np.zeros(2))

    def test_of_a_rollout(self, arm):
        options: Any = dict(scheme=osik.WeightedQP(), steps=3)
        tasks = {"hand": osik.FrameTask(arm, "hand")}
        with pytest.raises(ValueError, match=r"shape \(3,\); a pose is"):
            osik.rollout(arm, arm.q0, tasks, targets={"hand": np.zeros((3, 3))}, **options)
        with pytest.raises(TypeError, match=r"targets\['hand'\] holds objects of type SE3; .*arrays"):
            osik.rollout(arm, arm.q0, tasks, targets={"hand": [mink.SE3.identity()] * 3}, **options)

    def test_a_position_has_no_default_rotation(self):
        refuses(ValueError, "got an array", as_pose, POSITION, jnp.float64)


class Reach(osik.FunctionTask):
    """A subclass keeps what its base knows."""


@pytest.fixture(scope="module")
def tasks(nao):
    """Every task with a target, none of them met at q0's neighbours."""

    kind: Any = Reach

    def height(robot, kinematics, q):
        return kinematics.frame_pose(robot, "l_gripper")[0][2:]

    return {
        "frame": osik.FrameTask(nao, "l_gripper"),
        "se3": osik.FrameTask(nao, "l_gripper", error="se3"),
        "position": osik.FrameTask(nao, "Head", rows="position", axes="frame"),
        "relative": osik.RelativeFrameTask(nao, "l_gripper", "Head"),
        "com": osik.ComTask(nao),
        "height": osik.ComTask(nao, axes="z"),
        "posture": osik.PostureTask(nao, joints=("*",)),
        "coupling": osik.JointCouplingTask(nao, {"HeadYaw": 1.0, "HeadPitch": 2.0}),
        "function": osik.FunctionTask(nao, height),
        "own": kind(nao, height),
        "manipulability": osik.ManipulabilityTask(nao, "l_gripper", target=0.1, rows="position"),
        "look": osik.LookAtTask(nao, "Head", axis=(1.0, 0.0, 0.0)),
        "look at a hand": osik.LookAtTask(nao, "Head", axis=(1.0, 0.0, 0.0), target_frame="l_gripper"),
        "axis": osik.AxisAlignTask(nao, "r_gripper"),
        "axis beside": osik.AxisAlignTask(nao, "r_gripper", target_frame="torso"),
        "sole": osik.ContactTask(nao, "l_sole"),
        "sliding point": osik.ContactTask(nao, "r_sole", contact="point", sliding=True, point=(0.1, 0.0, 0.0)),
    }


class TestAt:
    """mink's and pink's ``set_target_from_configuration``."""

    @pytest.mark.release
    def test_the_error_is_nought_there_and_was_not_before(self, nao, tasks, rng):
        q = jnp.asarray(anywhere(nao, rng))
        before = rows_of_each(nao, tasks, q)
        there = jax.jit(lambda q: {name: task.at(nao, q) for name, task in tasks.items()})(q)
        after = rows_of_each(nao, there, q)
        for name, rows in after.items():
            assert np.abs(before[name].error).max() > 1e-3, name
            np.testing.assert_allclose(rows.error, 0.0, atol=2e-8, err_msg=name)

    def test_at_home_is_the_default_which_leaves_no_error(self, nao, tasks):
        names = ("frame", "se3", "position", "relative", "com", "posture", "look", "axis", "axis beside", "sole")
        for name, rows in rows_of_each(nao, {name: tasks[name] for name in names}, nao.q0).items():
            np.testing.assert_allclose(rows.error, 0.0, atol=1e-12, err_msg=name)
            there = jax.tree.leaves(tasks[name].at(nao, nao.q0))
            for new, old in zip(there, jax.tree.leaves(tasks[name]), strict=True):
                np.testing.assert_allclose(new, old, atol=1e-12, err_msg=name)

    @pytest.mark.parametrize(
        "make",
        [
            lambda robot: osik.ComTask(robot, lower=0.0),
            lambda robot: osik.PostureTask(robot, lower=0.0),
            lambda robot: osik.DampingTask(robot),
            lambda robot: osik.JointVelocityTask(robot, 1.0),
            lambda robot: osik.AngularMomentumTask(robot),
            lambda robot: osik.ManipulabilityTask(robot, "hand"),
            lambda robot: osik.JointCouplingTask(robot, {"joint1": 1.0}, upper=1.0),
        ],
    )
    def test_a_task_without_a_target_says_so(self, arm, make):
        task = make(arm)
        with pytest.raises(TypeError, match=f"this {type(task).__name__} has no target that a configuration could set"):
            task.at(arm, arm.q0)

    def test_a_wrong_configuration_is_told(self, arm):
        refuses(ValueError, r"q has shape \(3,\)", osik.FrameTask(arm, "hand").at, arm, jnp.zeros(3))
