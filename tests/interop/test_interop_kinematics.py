"""Kinematics of Pinocchio in place of MJX's: an adapter, and steps with both."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from example_files import example_file
from refusals import refuses

import osik_jax as osik
from osik_jax.interop.kinematics import kinematics_from


def by_pinocchio(robot: osik.Robot, file: str, floating_base: bool) -> Callable[[Any], osik.Kinematics]:
    """Return a function of q that has Pinocchio compute poses and Jacobians of all bodies, by a callback."""
    model = pin.buildModelFromUrdf(file, pin.JointModelFreeFlyer()) if floating_base else pin.buildModelFromUrdf(file)
    data, base = model.createData(), 6 if floating_base else 0
    frames = [model.getFrameId(name, pin.FrameType.BODY) for name in robot.body_names]
    joints = [name for name in robot.joint_names if model.existJointName(name)]
    columns = [model.joints[model.getJointId(name)].idx_v for name in joints]
    places = [model.joints[model.getJointId(name)].idx_q for name in joints]
    count = len(frames)

    def compute(q: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        theirs, q = pin.neutral(model), np.asarray(q, float)
        if floating_base:
            theirs[:7] = q[[0, 1, 2, 4, 5, 6, 3]]  # quaternions are x, y, z, w there
        theirs[places] = q[7 if floating_base else 0 :]
        pin.computeJointJacobians(model, data, theirs)
        pin.updateFramePlacements(model, data)
        poses = [data.oMf[frame] for frame in frames]
        full = np.stack([pin.getFrameJacobian(model, data, k, pin.LOCAL_WORLD_ALIGNED) for k in frames])
        jacobian = np.empty((count, 6, robot.nv))
        jacobian[:, :, base:] = full[:, :, columns]
        if floating_base:  # the base's linear velocity is in its own axes there
            jacobian[:, :, :3] = full[:, :, :3] @ data.oMf[frames[0]].rotation.T
            jacobian[:, :, 3:6] = full[:, :, 3:6]
        return np.stack([pose.translation for pose in poses]), np.stack([pose.rotation for pose in poses]), jacobian

    shapes = [jax.ShapeDtypeStruct(s, float) for s in ((count, 3), (count, 3, 3), (count, 6, robot.nv))]

    def kinematics(q: Any) -> osik.Kinematics:
        return kinematics_from(robot, *jax.pure_callback(compute, shapes, q, vmap_method="sequential"))

    return kinematics


ROBOTS = {
    "ur5": ("ur_description/urdf/ur5_robot.urdf", False, "ee_link"),
    "solo": ("solo_description/robots/solo12.urdf", True, "FL_FOOT"),
}


@pytest.fixture(scope="module", params=ROBOTS)
def other(request: pytest.FixtureRequest) -> tuple[osik.Robot, Callable[[Any], osik.Kinematics], str]:
    name, floating_base, frame = ROBOTS[request.param]
    robot = osik.Robot.from_urdf(str(example_file(name)), floating_base=floating_base)
    return robot, by_pinocchio(robot, str(example_file(name)), floating_base), frame


def configurations(robot: osik.Robot, rng: np.random.Generator, count: int) -> jax.Array:
    v = jnp.asarray(rng.uniform(-1.0, 1.0, (count, robot.nv)))
    return jax.vmap(lambda v: osik.integrate(robot, robot.q0, v))(v)


@pytest.mark.variants(slow=["solo"])
def test_poses_and_jacobians_are_mjx_s(other: Any, rng: np.random.Generator) -> None:
    robot, kinematics, frame = other

    def looked_at(kinematics: osik.Kinematics) -> Any:
        return (
            kinematics.frame_pose(robot, frame),
            osik.frame_jacobian(robot, kinematics, frame),
            osik.center_of_mass(robot, kinematics),
            osik.com_jacobian(robot, kinematics),
        )

    q = configurations(robot, rng, 5)
    theirs = jax.jit(jax.vmap(lambda q: looked_at(kinematics(q))))(q)
    ours = jax.jit(jax.vmap(lambda q: looked_at(osik.forward_kinematics(robot, q))))(q)
    for a, b in zip(jax.tree.leaves(theirs), jax.tree.leaves(ours), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


@pytest.mark.variants(
    slow=["ur5-WeightedQP", "solo-HierarchicalQP"], release=["solo-WeightedQP", "ur5-HierarchicalQP", "solo-NullSpace"]
)
@pytest.mark.parametrize(
    "scheme", [osik.WeightedQP(), osik.HierarchicalQP(), osik.NullSpace()], ids=lambda s: type(s).__name__
)
def test_a_step_is_that_with_mjx(other: Any, scheme: Any, rng: np.random.Generator) -> None:
    robot, kinematics, frame = other
    point = osik.FunctionTask(robot, lambda r, k, q: k.frame_pose(r, frame)[0][:1] ** 2, priority=2)
    tasks = {"frame": osik.FrameTask(robot, frame), "point": point, "posture": osik.PostureTask(robot, priority=3)}

    def velocity(q: Any, kinematics: osik.Kinematics) -> Any:
        return scheme.solve(osik.build_problem(robot, q, tasks, kinematics=kinematics)).velocity

    q = configurations(robot, rng, 5)
    theirs = jax.jit(jax.vmap(lambda q: velocity(q, kinematics(q))))(q)
    ours = jax.jit(jax.vmap(lambda q: velocity(q, osik.forward_kinematics(robot, q))))(q)
    assert np.abs(ours).max() > 0.1
    np.testing.assert_allclose(theirs, ours, atol=1e-9)


@pytest.mark.slow
def test_a_ball_joint_turns_about_its_anchor(rng: np.random.Generator) -> None:
    robot = osik.Robot.from_mjcf(
        "<mujoco><worldbody><body name='a' pos='0.1 0.2 0.3'><joint name='b' type='ball' pos='0.05 -0.02 0.01'/>"
        "<geom size='0.1' mass='1'/><body name='c' pos='0.2 0 0'><joint name='s' type='slide' axis='0 1 0.5'/>"
        "<geom size='0.1' mass='1'/></body></body></worldbody></mujoco>"
    )
    q = configurations(robot, rng, 1)[0]
    ours = osik.forward_kinematics(robot, q)
    again = kinematics_from(
        robot, ours.body_position[1:], ours.body_rotation[1:], osik.frame_jacobian(robot, ours, robot.body_names)
    )
    for name in ("body_position", "dof_linear", "dof_angular"):
        np.testing.assert_allclose(getattr(again, name), getattr(ours, name), atol=1e-14)
    np.testing.assert_allclose(again.dof_anchor[:3], ours.dof_anchor[:3], atol=1e-14)


@pytest.mark.slow
def test_wrong_arrays_are_named() -> None:
    robot = osik.load_robot("arm7")
    kinematics = osik.forward_kinematics(robot, robot.q0)
    position, rotation = kinematics.body_position[1:], kinematics.body_rotation[1:]
    jacobian = osik.frame_jacobian(robot, kinematics, robot.body_names)
    with pytest.raises(ValueError, match=r"jacobian has shape \(6, 7\); expected \("):
        kinematics_from(robot, position, rotation, jacobian[0])
    refuses(ValueError, "position has shape", kinematics_from, robot, kinematics.body_position, rotation, jacobian)
    locked = osik.load_robot("arm7", locked_joints=robot.joint_names[:1])
    refuses(ValueError, "without locked and following joints", kinematics_from, locked, position, rotation, jacobian)
