"""A robot written as URDF has the same kinematics, by Pinocchio's reading of the file and by our own."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from frames_beside_mujoco import poses, random_configurations
from model_files import mjcf
from refusals import refuses

import osik_jax as osik
from osik_jax import Robot


def calibrated_ur5() -> Robot:
    """Zero offsets, an axis that is tilted, a link that is longer."""
    return osik.load_robot("ur5").replace(
        joint_reference={"wrist_*": 0.02, "elbow_joint": -0.03},
        joint_axis={"shoulder_lift_joint": (0.01, 1.0, -0.02)},
        body_position={"forearm_link": (-0.001, 0.002, 0.4301)},
        frame_position={"tool0": (0.01, 0.0, 0.05)},
    )


def odd() -> Robot:
    """Several joints a body, anchors off the origin, references, slides, a follower; a locked ball and free joint."""
    robot = Robot.from_mjcf(mjcf("odd"), locked_joints=("ball", "fly"))
    return robot.replace(frame_position={"mark": (0.1, 0.2, 0.3)})


ROBOTS = {
    "ur5, calibrated": calibrated_ur5,
    "odd": odd,
    "panda": lambda: osik.load_robot("panda", locked_joints={"panda_joint3": 0.3}),
    "nao": lambda: osik.load_robot("nao"),
}


def pinocchio_poses(path: str, robot: Robot, q: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the pose of each link of the file at a configuration of the robot."""
    model = pin.buildModelFromUrdf(path)
    full, values = np.asarray(robot.mujoco_qpos(jnp.asarray(q))), pin.neutral(model)
    for j, name in enumerate(robot.tree.joint_names):
        if j not in robot.tree.locked:
            joint, at = model.joints[model.getJointId(name)], robot.tree.full_qpos_address[j]
            of_kind = {1: full[[at]], 2: np.array([np.cos(full[at]), np.sin(full[at])])}
            own = full[at + np.array([0, 1, 2, 4, 5, 6, 3])] if joint.nq == 7 else of_kind[joint.nq]
            values[joint.idx_q : joint.idx_q + joint.nq] = own
    data = model.createData()
    pin.framesForwardKinematics(model, data, values)
    links = [(f.name, data.oMf[i]) for i, f in enumerate(model.frames) if f.type == pin.FrameType.BODY]
    return {name: (pose.translation, pose.rotation) for name, pose in links}


@pytest.mark.parametrize("name", ROBOTS)
def test_the_file_has_the_robots_kinematics(name: str, tmp_path):
    robot, path = ROBOTS[name](), tmp_path / "robot.urdf"
    assert robot.to_urdf(path) == path.read_text(encoding="utf-8")
    again = Robot.from_urdf(path)
    assert again.joint_names == robot.joint_names and again.mimic_joints == robot.mimic_joints
    for leaf in ("position_lower", "position_upper", "velocity_limit"):
        ours, theirs = (np.clip(getattr(r, leaf), -1e9, 1e9) for r in (robot, again))  # slides have no infinite ones
        np.testing.assert_allclose(theirs, ours, rtol=0.0, atol=1e-12, err_msg=leaf)
    q = random_configurations(robot)
    ours, theirs = poses(robot, q), poses(again, q)
    order = [again.tree.frame(frame) for frame in robot.frame_names if frame in again.frame_names]
    kept = [k for k, frame in enumerate(robot.frame_names) if frame in again.frame_names]
    assert len(kept) >= len(robot.frame_names) - 1  # of the odd robot all but a plane
    for a, b in zip(ours[:2], theirs[:2], strict=True):
        np.testing.assert_allclose(b[:, order], a[:, kept], rtol=0.0, atol=1e-12)
    links = pinocchio_poses(str(path), robot, q[0])
    seen = [k for k, frame in enumerate(robot.frame_names) if frame in links]
    assert len(seen) >= len(robot.body_names)
    for k in seen:
        for a, b in zip((ours[0][0, k], ours[1][0, k]), links[robot.frame_names[k]], strict=True):
            np.testing.assert_allclose(b, a, rtol=0.0, atol=1e-12, err_msg=robot.frame_names[k])


def test_inertias_come_back():
    robot = calibrated_ur5()
    again = Robot.from_urdf(robot.to_urdf())
    for leaf in ("body_mass", "body_com", "body_inertia"):
        np.testing.assert_allclose(getattr(again, leaf), getattr(robot, leaf), rtol=0.0, atol=1e-12, err_msg=leaf)


def test_what_urdf_cannot_say_is_refused():
    refuses(ValueError, "joint 'ball' is a ball joint: URDF has none", Robot.from_mjcf(mjcf("odd")).to_urdf)
    refuses(ValueError, "a stack of robots", osik.stack([osik.load_robot("arm7")] * 2).to_urdf)
    held = osik.load_robot("arm7").replace(acceleration_limit={"joint2": 0.0})
    refuses(ValueError, "joint 'joint2' is limited to 0, which URDF reads as unknown: lock", held.to_urdf)
    moved = osik.load_robot("arm7").replace(frame_position={"link7": (0.0, 0.0, 0.1)})
    refuses(ValueError, "frame 'link7' is a body or geom of its own and not where that is", moved.to_urdf)


def test_fixed_joints_do_not_take_the_names_of_others():
    text = """<mujoco><worldbody><body><joint name="tip_fixed" axis="0 0 1"/><geom size=".1"/><site name="tip"/></body>
    </worldbody></mujoco>"""
    assert Robot.from_urdf(Robot.from_mjcf(text).to_urdf()).joint_names == ("tip_fixed",)
