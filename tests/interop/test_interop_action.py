"""Actions of a policy that become joint targets: poses, limits, and environments that use them."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

import osik_jax as osik
from osik_jax.interop.action import TaskSpaceAction
from osik_jax.physics import Simulation, build_world

DT = 0.02


def pose_by_mujoco(robot, q, frame):
    """Position and rotation of a frame, from MuJoCo C."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = robot.mujoco_qpos(jnp.asarray(q))
    mujoco.mj_kinematics(robot.mj_model, data)
    found = data.site(frame) if frame in [robot.mj_model.site(k).name for k in range(robot.mj_model.nsite)] else None
    found = data.body(frame) if found is None else found
    return found.xpos.copy(), found.xmat.reshape(3, 3).copy()


@pytest.fixture(scope="module")
def arm():
    robot = osik.load_robot("arm7")
    tasks = {"hand": osik.FrameTask(robot, "hand", gain=1.0 / DT), "posture": osik.PostureTask(robot, weight=1e-6)}
    return robot, tasks


@pytest.mark.variants(slow=["relative"])
@pytest.mark.parametrize("mode", ["relative", "absolute"])
def test_the_frame_goes_where_the_action_says(arm, mode):
    """A pose in the world, by MuJoCo: moved by scale times action from where it is, or from the task's own target."""
    robot, tasks = arm
    scheme = osik.WeightedQP(curvature_damping=0.0)
    action = TaskSpaceAction(robot, tasks, mode=mode, position_scale=4e-4, rotation_scale=2e-3, scheme=scheme, dt=DT)
    assert action.names == ("hand.x", "hand.y", "hand.z", "hand.rx", "hand.ry", "hand.rz")
    raw = np.array([1.0, -0.5, 7.0, -1.0, 0.25, 0.5])  # 7 is cut at 1
    q = np.asarray(robot.q0) + (0.0 if mode == "absolute" else 0.1)
    p, R = pose_by_mujoco(robot, q, "hand")
    out = jax.jit(action)(q, raw)
    motion = np.clip(raw, -1, 1) * np.repeat([4e-4, 2e-3], 3)
    turn = np.zeros(9)
    quaternion = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quaternion, motion[3:] / np.linalg.norm(motion[3:]), np.linalg.norm(motion[3:]))
    mujoco.mju_quat2Mat(turn, quaternion)
    now = pose_by_mujoco(robot, out.q, "hand")
    assert out.status == osik.Status.SOLVED
    np.testing.assert_allclose(now[0], p + motion[:3], atol=1e-5)  # a step is linear, to its square
    np.testing.assert_allclose(now[1], turn.reshape(3, 3) @ R, atol=3e-5)
    np.testing.assert_array_equal(out.position, out.q)


def test_joints_stay_within_their_limits_whatever_the_action(arm):
    robot, tasks = arm
    action = TaskSpaceAction(robot, tasks, position_scale=0.5, rotation_scale=1.0, dt=DT)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 1, 6)).repeat(15, 1).reshape(300, 6) * 3.0

    def step(q, raw):
        out = action(q, raw)
        return out.q, out

    path = jax.lax.scan(step, robot.q0, jnp.asarray(actions))[1]
    assert (path.q >= robot.position_lower).all() and (path.q <= robot.position_upper).all()
    assert (np.abs(path.velocity) <= robot.velocity_limit).all()
    near = np.minimum(path.q - robot.position_lower, robot.position_upper - path.q).min()
    assert near < 1e-6 and np.isclose(np.abs(path.velocity), robot.velocity_limit).any()  # both are reached


@pytest.mark.release
def test_several_frames_and_the_joints_of_actuators():
    robot = osik.load_robot("nao")
    tasks = {
        "left": osik.FrameTask(robot, "l_wrist", rows="position"),
        "right": osik.FrameTask(robot, "r_wrist", rows="orientation"),
        "foot": osik.FrameTask(robot, "r_ankle"),
    }
    names = [robot.tree.joint_names[j] for j in robot.tree.independent if "floating" not in robot.tree.joint_names[j]]
    scales = {"left": 0.1, "right": 0.3}
    action = TaskSpaceAction(
        robot, tasks, commanded=("right", "left"), position_scale=scales, rotation_scale=scales, joints=names[::-1]
    )
    assert action.names == ("right.rx", "right.ry", "right.rz", "left.x", "left.y", "left.z")
    np.testing.assert_allclose(action.scale, [0.3] * 3 + [0.1] * 3)
    assert action.joints == tuple(names[::-1])
    targets = action.targets(robot.q0, jnp.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
    p, R = Simulation(build_world(robot)).frame_pose("l_wrist")
    np.testing.assert_allclose(targets["left"][0], p + np.array([0.1, 0.0, 0.0]), atol=1e-12)
    np.testing.assert_allclose(targets["left"][1], R, atol=1e-12)
    out = action(robot.q0, np.zeros(6))
    np.testing.assert_array_equal(out.position, np.asarray(out.q)[7:][::-1])


@pytest.mark.release
def test_a_nan_holds_the_robot_and_gradients_are_finite(arm):
    robot, tasks = arm
    action = TaskSpaceAction(robot, tasks, dt=DT)
    out = jax.jit(action)(robot.q0, np.full(6, np.nan))
    assert out.status == osik.Status.NUMERICAL_ERROR
    np.testing.assert_array_equal(out.q, robot.q0)
    raw = jnp.array([0.3, -0.2, 0.1, 0.2, 0.1, -0.1])
    slope = jax.jacrev(lambda a: action(robot.q0, a).position)(raw)
    h = 1e-5
    wanted = [
        (action(robot.q0, raw + h * e).position - action(robot.q0, raw - h * e).position) / (2 * h) for e in jnp.eye(6)
    ]
    np.testing.assert_allclose(slope, np.stack(wanted, 1), atol=1e-6)


def test_what_does_not_fit_is_told(arm):
    robot, tasks = arm
    options: Any
    for options, message in (
        (dict(mode="both"), "mode is 'both'"),
        (dict(commanded=("foot",)), "no task 'foot'"),
        (dict(commanded=("posture",)), "PostureTask; an action moves a FrameTask"),
        (dict(commanded="hand"), "not one string"),
        (dict(commanded=()), "no task to command"),
        (dict(position_scale=0.0), "position_scale of 'hand' is 0.0"),
        (dict(position_scale={"foot": 1.0}), "no entry for 'hand'"),
        (dict(joints=("elbow",)), "no joint 'elbow'"),
        (dict(dt=-1.0), "dt is -1.0"),
    ):
        with pytest.raises(osik.OsikError, match=message):
            TaskSpaceAction(robot, tasks, **options)
    with pytest.raises(osik.OsikError, match=r"action has shape \(3,\), expected \(6,\): hand\.x"):
        TaskSpaceAction(robot, tasks)(robot.q0, np.zeros(3))
    floating = osik.load_robot("nao")
    with pytest.raises(osik.OsikError, match="has several entries"):
        wrist = {"wrist": osik.FrameTask(floating, "l_wrist")}
        TaskSpaceAction(floating, wrist, joints=(floating.tree.joint_names[floating.tree.independent[0]],))


@pytest.mark.release
def test_a_batch_of_environments_in_mjx(arm):
    """Servos in MJX follow the joint targets: the hand of each goes its own way, as far as its actions say."""
    robot, tasks = arm
    tasks = {**tasks, "hand": osik.FrameTask(robot, "hand", rows="position", gain=1.0 / DT)}
    action = TaskSpaceAction(robot, tasks, position_scale=0.005, dt=DT)
    model = mjx.put_model(robot.mj_model)
    substeps = round(DT / robot.mj_model.opt.timestep)
    data = mjx.put_data(robot.mj_model, mujoco.MjData(robot.mj_model)).replace(qpos=robot.q0, ctrl=robot.q0)
    raw = jnp.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 0.0]])

    @jax.jit
    @jax.vmap
    def episode(raw):
        def step(data, _):
            data = data.replace(ctrl=action(data.ctrl, raw).position)
            return jax.lax.fori_loop(0, substeps, lambda _, d: mjx.step(model, d), data), None

        idle = lambda data, _: (mjx.step(model, data), None)  # noqa: E731
        moved, _ = jax.lax.scan(step, data, length=10)
        return jax.lax.scan(idle, moved, length=400)[0].qpos

    moved = [pose_by_mujoco(robot, q, "hand")[0] for q in episode(raw)]
    start = pose_by_mujoco(robot, robot.q0, "hand")[0]
    for now, wanted in zip(moved, 0.05 * np.asarray(raw), strict=True):
        np.testing.assert_allclose(now - moved[2], wanted, atol=5e-3)
    np.testing.assert_allclose(moved[2], start, atol=0.02)  # gravity, on servos without integral action
