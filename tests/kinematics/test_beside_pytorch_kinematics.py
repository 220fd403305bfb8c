"""Poses and Jacobians of a Panda against pytorch-kinematics, which reads its URDF.

Only where that library is installed (`tests/conftest.py`): the extra `test` has it for Python 3.11 alone.
"""

from importlib.metadata import files
from typing import Any

import jax
import numpy as np
import pytest
import pytorch_kinematics
import torch

import osik_jax as osik


@pytest.fixture(scope="module")
def urdf() -> Any:
    return next(f for f in files("example-robot-data") or () if f.match("panda_description/urdf/panda.urdf"))


def by_pytorch_kinematics(urdf: Any, frame: str, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    chain: Any = pytorch_kinematics.build_serial_chain_from_urdf(urdf.read_binary(), frame).to(dtype=torch.float64)
    pose = chain.forward_kinematics(torch.tensor(angles)).get_matrix().numpy()
    return pose[:, :3, 3], pose[:, :3, :3], chain.jacobian(torch.tensor(angles)).numpy()


def by_us(robot: osik.Robot, frame: str, q: np.ndarray) -> Any:
    def pose_and_jacobian(q):
        kin = osik.forward_kinematics(robot, q)
        return *kin.frame_pose(robot, frame), osik.frame_jacobian(robot, kin, frame)

    return jax.jit(jax.vmap(pose_and_jacobian))(q)


def test_panda_from_urdf(urdf, rng):
    """To 1e-7: pytorch-kinematics reads the URDF's angles in single precision, so its frames are 4e-8 off."""
    robot = osik.Robot.from_urdf(str(urdf.locate()), floating_base=False)
    assert robot.joint_names[:7] == tuple(f"panda_joint{i}" for i in range(1, 8))
    q = rng.uniform(robot.position_lower, robot.position_upper, (10, robot.nq))
    position, rotation, jacobian = by_us(robot, "panda_hand_tcp", q)
    expected = by_pytorch_kinematics(urdf, "panda_hand_tcp", q[:, :7])
    for ours, theirs in zip((position, rotation, jacobian[..., :7]), expected, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-7, rtol=0)
    np.testing.assert_array_equal(jacobian[..., 7:], 0.0)


def test_the_embedded_arm(urdf, rng):
    """The Jacobian of pytorch-kinematics is in the base's axes, as ours is."""
    robot = osik.load_robot("arm7")
    q = rng.uniform(robot.position_lower, robot.position_upper, (10, robot.nq))
    for ours, theirs in zip(by_us(robot, "flange", q), by_pytorch_kinematics(urdf, "panda_link8", q), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6, rtol=0)
