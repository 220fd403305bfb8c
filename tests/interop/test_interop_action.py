"""Actions of a policy that become joint targets: poses, limits, and environments that use them."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from mujoco_states import mujoco_at
from refusals import refuses
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax.interop.action import TaskSpaceAction
from osik_jax.physics import Simulation, build_world

DT = 0.02


def hand_by_mujoco(robot, q):
    """Position and rotation of the hand, from MuJoCo C."""
    found = mujoco_at(robot, q).site("hand")
    return found.xpos, found.xmat.reshape(3, 3)


@pytest.fixture(scope="module")
def tasks(arm):
    return {"hand": osik.FrameTask(arm, "hand", gain=1.0 / DT), "posture": osik.PostureTask(arm, weight=1e-6)}


def test_the_frame_goes_where_the_action_says(arm, tasks):
    """A pose in the world, by MuJoCo: moved by scale times action from where it is."""
    scheme = osik.WeightedQP(curvature_damping=0.0)
    action = TaskSpaceAction(arm, tasks, position_scale=4e-4, rotation_scale=2e-3, scheme=scheme, dt=DT)
    assert action.names == ("hand.x", "hand.y", "hand.z", "hand.rx", "hand.ry", "hand.rz")
    raw = np.array([1.0, -0.5, 7.0, -1.0, 0.25, 0.5])  # 7 is cut at 1
    q = np.asarray(arm.q0) + 0.1
    p, R = hand_by_mujoco(arm, q)
    out = jax.jit(action)(q, raw)
    motion = np.clip(raw, -1, 1) * np.repeat([4e-4, 2e-3], 3)
    turn = Rotation.from_rotvec(motion[3:]).as_matrix()
    now = hand_by_mujoco(arm, out.q)
    assert out.status == osik.Status.SOLVED
    np.testing.assert_allclose(now[0], p + motion[:3], atol=1e-5)  # a step is linear, to its square
    np.testing.assert_allclose(now[1], turn @ R, atol=3e-5)
    np.testing.assert_array_equal(out.position, out.q)


def test_joints_stay_within_their_limits_whatever_the_action(arm, tasks):
    action = TaskSpaceAction(arm, tasks, position_scale=0.5, rotation_scale=1.0, dt=DT)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 1, 6)).repeat(15, 1).reshape(300, 6) * 3.0

    def step(q, raw):
        out = action(q, raw)
        return out.q, out

    path = jax.lax.scan(step, arm.q0, jnp.asarray(actions))[1]
    assert (path.q >= arm.position_lower).all() and (path.q <= arm.position_upper).all()
    assert (np.abs(path.velocity) <= arm.velocity_limit).all()
    near = np.minimum(path.q - arm.position_lower, arm.position_upper - path.q).min()
    assert near < 1e-6 and np.isclose(np.abs(path.velocity), arm.velocity_limit).any()  # both are reached


@pytest.mark.release
def test_several_frames_and_the_joints_of_actuators(nao):
    tasks = {
        "left": osik.FrameTask(nao, "l_wrist", rows="position"),
        "right": osik.FrameTask(nao, "r_wrist", rows="orientation"),
        "foot": osik.FrameTask(nao, "r_ankle"),
    }
    names = [nao.tree.joint_names[j] for j in nao.tree.independent if "floating" not in nao.tree.joint_names[j]]
    action = TaskSpaceAction(
        nao, tasks, commanded=("right", "left"), position_scale=0.1, rotation_scale=0.3, joints=names[::-1]
    )
    assert action.names == ("right.rx", "right.ry", "right.rz", "left.x", "left.y", "left.z")
    np.testing.assert_allclose(action.scale, [0.3] * 3 + [0.1] * 3)
    assert action.joints == tuple(names[::-1])
    targets = action.targets(nao.q0, jnp.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
    p, R = Simulation(build_world(nao)).frame_pose("l_wrist")
    np.testing.assert_allclose(targets["left"][0], p + np.array([0.1, 0.0, 0.0]), atol=1e-12)
    np.testing.assert_allclose(targets["left"][1], R, atol=1e-12)
    out = action(nao.q0, np.zeros(6))
    np.testing.assert_array_equal(out.position, np.asarray(out.q)[7:][::-1])


@pytest.mark.release
def test_a_nan_holds_the_robot_and_gradients_are_finite(arm, tasks):
    action = TaskSpaceAction(arm, tasks, dt=DT)
    out = jax.jit(action)(arm.q0, np.full(6, np.nan))
    assert out.status == osik.Status.NUMERICAL_ERROR
    np.testing.assert_array_equal(out.q, arm.q0)
    raw = jnp.array([0.3, -0.2, 0.1, 0.2, 0.1, -0.1])
    slope = jax.jacrev(lambda a: action(arm.q0, a).position)(raw)
    h = 1e-5
    wanted = [
        (action(arm.q0, raw + h * e).position - action(arm.q0, raw - h * e).position) / (2 * h) for e in jnp.eye(6)
    ]
    np.testing.assert_allclose(slope, np.stack(wanted, 1), atol=1e-6)


def test_what_does_not_fit_is_told(arm, tasks):
    options: Any
    for options, message in (
        (dict(commanded=("foot",)), "no task 'foot'"),
        (dict(commanded=("posture",)), "PostureTask; an action moves a FrameTask"),
        (dict(commanded="hand"), "not one string"),
        (dict(commanded=()), "no task to command"),
        (dict(position_scale=0.0), "position_scale is 0.0"),
        (dict(position_scale={"hand": 0.1}), "position_scale is .* a positive number"),
        (dict(joints=("elbow",)), "no joint 'elbow'"),
        (dict(dt=-1.0), "dt is -1.0"),
    ):
        refuses(osik.OsikError, message, TaskSpaceAction, arm, tasks, **options)
    with pytest.raises(osik.OsikError, match=r"action has shape \(3,\), expected \(6,\): hand\.x"):
        TaskSpaceAction(arm, tasks)(arm.q0, np.zeros(3))
    floating = osik.load_robot("nao")
    with pytest.raises(osik.OsikError, match="has several entries"):
        wrist = {"wrist": osik.FrameTask(floating, "l_wrist")}
        TaskSpaceAction(floating, wrist, joints=(floating.tree.joint_names[floating.tree.independent[0]],))


@pytest.mark.release
def test_a_batch_of_environments_in_mjx(arm, tasks):
    """Servos in MJX follow the joint targets: the hand of each goes its own way, as far as its actions say."""
    tasks = {**tasks, "hand": osik.FrameTask(arm, "hand", rows="position", gain=1.0 / DT)}
    action = TaskSpaceAction(arm, tasks, position_scale=0.005, dt=DT)
    model = mjx.put_model(arm.mj_model)
    substeps = round(DT / arm.mj_model.opt.timestep)
    data = mjx.put_data(arm.mj_model, mujoco.MjData(arm.mj_model)).replace(qpos=arm.q0, ctrl=arm.q0)
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

    moved = [hand_by_mujoco(arm, q)[0] for q in episode(raw)]
    start = hand_by_mujoco(arm, arm.q0)[0]
    for now, wanted in zip(moved, 0.05 * np.asarray(raw), strict=True):
        np.testing.assert_allclose(now - moved[2], wanted, atol=5e-3)
    np.testing.assert_allclose(moved[2], start, atol=0.02)  # gravity, on servos without integral action
