"""Well-known robots take steps: a frame goes where it is sent, within the limits, as MuJoCo C sees it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from example_files import example_file

import osik_jax as osik
from osik_jax.robot._mujoco import mujoco_frame_pose, mujoco_poses

pytestmark = pytest.mark.slow

DT = 0.01
STEPS = 10
GAIN = 20.0
OFFSET = np.array([0.005, -0.01, 0.0075])
ROBOTS = {
    "g1": ("g1_description/urdf/g1_29dof_rev_1_0.urdf", "left_wrist_yaw_link"),
    "talos": ("talos_data/robots/talos_full_v2.urdf", "gripper_left_base_link"),
    "romeo": ("romeo_description/urdf/romeo.urdf", "l_wrist"),
    "solo12": ("solo_description/robots/solo12.urdf", "FL_FOOT"),
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand"),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", "tool0"),
    "tiago": ("tiago_description/robots/tiago.urdf", "arm_tool_link"),
}


def bent(robot: osik.Robot) -> np.ndarray:
    """A start away from stretched and aligned limbs: joints moved towards the middle of their ranges, then apart."""
    low, high = np.asarray(robot.position_lower), np.asarray(robot.position_upper)
    q = np.array(robot.q0)
    for k, joint in enumerate(robot.joint_names):
        dof, at = robot.joint_dof_index(joint), robot.joint_qpos_index(joint)
        limited = np.isfinite(low[dof]) and np.isfinite(high[dof])
        middle = 0.5 * (low[dof] + high[dof]) if limited else 0.3
        q[at] = np.clip(q[at] + np.clip(middle - q[at], -0.7, 0.7) + 0.2 * np.sin(k + 1), low[dof], high[dof])
    return q


@pytest.mark.variants(release=["romeo", "solo12", "panda", "tiago", "ur5", "talos"])
@pytest.mark.parametrize("name", ROBOTS)
def test_a_frame_goes_where_it_is_sent_within_the_limits(name):
    """The error falls by 1 - gain dt a step, less what posture and speed limits take; followers are limited too."""
    frame = ROBOTS[name][1]
    robot = osik.Robot.from_urdf(example_file(ROBOTS[name][0]), floating_base=name not in ("panda", "ur5"))
    q0 = jnp.asarray(bent(robot))
    position, rotation = map(np.asarray, jax.jit(osik.forward_kinematics)(robot, q0).frame_pose(robot, frame))
    goal = position + OFFSET
    tasks = {
        "frame": osik.FrameTask(robot, frame, target=(goal, rotation), gain=GAIN),
        "posture": osik.PostureTask(robot, target=q0, weight=1e-4, gain=1.0),
    }
    limits = osik.ConfigurationLimit(robot), osik.VelocityLimit(robot)
    scheme = osik.WeightedQP(damping=1e-7, curvature_damping=0.0)  # else the first of the way is slower
    run = osik.rollout(robot, q0, tasks, scheme=scheme, limits=limits, dt=DT, steps=STEPS)
    run = jax.tree.map(np.asarray, run)
    np.testing.assert_array_equal(run.solution.status, osik.Status.SOLVED)
    assert run.solution.kkt_residual.max() < 1e-8

    seen = [(mujoco_frame_pose(robot, data, frame)[0], data.qpos.copy()) for data in mujoco_poses(robot, run.q)]
    places, qpos = map(np.array, zip(*seen, strict=True))
    error = np.linalg.norm(places - goal, axis=1)
    assert error[0] == pytest.approx(np.linalg.norm(OFFSET), abs=1e-9)
    ours = np.linalg.norm(run.solution.error["frame"][:, :3], axis=1)
    np.testing.assert_allclose(ours, error[:-1], rtol=0, atol=1e-9)
    assert (np.diff(error) < 0.0).all()
    assert error[-1] < 1.2 * (1.0 - GAIN * DT) ** STEPS * error[0]

    model = robot.mj_model
    limited = model.jnt_limited.astype(bool)
    values, (low, high) = qpos[:, model.jnt_qposadr[limited]], model.jnt_range[limited].T
    assert (values >= low - 1e-12).all() and (values <= high + 1e-12).all()
    for joint in robot.joint_names:
        at, dof = robot.joint_qpos_index(joint), robot.joint_dof_index(joint)
        assert (run.q[:, at] >= np.asarray(robot.position_lower)[dof]).all(), joint
        assert (run.q[:, at] <= np.asarray(robot.position_upper)[dof]).all(), joint
    assert (np.abs(run.solution.velocity) <= np.asarray(robot.velocity_limit)).all()
    assert run.solution.box_violation.max() == 0.0
