"""Well-known robots take steps: a frame goes where it is sent, within the limits, as MuJoCo C sees it."""

from __future__ import annotations

import dataclasses
import importlib.metadata
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import osik_jax as osik

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


@dataclasses.dataclass(frozen=True)
class Case:
    robot: osik.Robot
    frame: str
    goal: np.ndarray
    tasks: dict[str, osik.Task]
    run: osik.Trajectory


def urdf_path(name: str) -> Path:
    files = importlib.metadata.files("example-robot-data") or []
    (found,) = [file for file in files if str(file).endswith(ROBOTS[name][0])]
    return Path(str(found.locate()))


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


@pytest.fixture(scope="module", params=ROBOTS)
def case(request: pytest.FixtureRequest) -> Case:
    frame = ROBOTS[request.param][1]
    fixed = request.param in ("panda", "ur5")
    robot = osik.Robot.from_urdf(urdf_path(request.param), floating_base=not fixed)
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
    return Case(robot, frame, goal, tasks, jax.tree.map(np.asarray, run))


def seen_by_mujoco(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """The frame's path, and that of all joints of MuJoCo's model."""
    model = case.robot.mj_model
    data = mujoco.MjData(model)
    tree = case.robot.tree
    k = tree.frame(case.frame)
    body = tree.body_names[tree.frame_bodies[k]]
    places, joints = [], []
    for q in case.run.q:
        data.qpos[:] = np.asarray(case.robot.mujoco_qpos(q))
        mujoco.mj_kinematics(model, data)
        at = data.body(body)
        places.append(at.xpos + at.xmat.reshape(3, 3) @ np.asarray(case.robot.frame_position[k]))
        joints.append(data.qpos.copy())
    return np.array(places), np.array(joints)


@pytest.mark.variants(release=["tiago", "romeo", "solo12", "panda", "ur5", "talos", "g1"])
def test_every_step_is_solved(case: Case):
    np.testing.assert_array_equal(case.run.solution.status, osik.Status.SOLVED)
    assert np.isfinite(case.run.q).all()
    assert case.run.solution.kkt_residual.max() < 1e-8


@pytest.mark.variants(release=["tiago", "romeo", "panda", "solo12", "talos", "ur5"])
def test_the_frame_goes_where_it_is_sent(case: Case):
    """The error falls by 1 - gain dt a step, less what posture and speed limits take."""
    places, _ = seen_by_mujoco(case)
    error = np.linalg.norm(places - case.goal, axis=1)
    assert error[0] == pytest.approx(np.linalg.norm(OFFSET), abs=1e-9)
    ours = np.linalg.norm(case.run.solution.error["frame"][:, :3], axis=1)
    np.testing.assert_allclose(ours, error[:-1], rtol=0, atol=1e-9)
    assert (np.diff(error) < 0.0).all()
    assert error[-1] < 1.2 * (1.0 - GAIN * DT) ** STEPS * error[0]


@pytest.mark.variants(release=["romeo", "solo12", "panda"])
def test_limits_are_kept(case: Case):
    """Of every joint in MuJoCo's model, followers included, and of every speed."""
    robot, model = case.robot, case.robot.mj_model
    _, joints = seen_by_mujoco(case)
    for joint in range(model.njnt):
        if model.jnt_limited[joint]:
            low, high = model.jnt_range[joint]
            values = joints[:, model.jnt_qposadr[joint]]
            assert (values >= low - 1e-12).all(), model.joint(joint).name
            assert (values <= high + 1e-12).all(), model.joint(joint).name
    for joint in robot.joint_names:
        at, dof = robot.joint_qpos_index(joint), robot.joint_dof_index(joint)
        assert (case.run.q[:, at] >= np.asarray(robot.position_lower)[dof]).all(), joint
        assert (case.run.q[:, at] <= np.asarray(robot.position_upper)[dof]).all(), joint
    assert (np.abs(case.run.solution.velocity) <= np.asarray(robot.velocity_limit)).all()
    assert case.run.solution.box_violation.max() == 0.0
