"""The benchmark of inverse kinematics: its sets of poses are what they are called, its judges agree."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.ik._arms import Arm
from benchmarks.ik.humanoids import Judge
from benchmarks.ik.many import measured
from benchmarks.throughput import loaded


@pytest.fixture(scope="module")
def ur5() -> Arm:
    return Arm("ur5")


def configurations(arm: Arm, count: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    return arm.lower + (arm.upper - arm.lower) * rng.random((count, arm.model.nq))


def test_a_configuration_is_at_its_own_pose_and_a_turned_one_is_not(ur5: Arm) -> None:
    rng = np.random.default_rng(2)
    poses = ur5.reachable(20, rng)
    q = configurations(ur5, 20)
    away, turned = ur5.errors(q, ur5._of(q))
    assert away.max() < 1e-12 and turned.max() < 1e-7
    away, turned = ur5.errors(q, poses)
    assert away.min() > 1e-3 and turned.min() > 1e-2


def test_no_configuration_comes_to_the_poses_out_of_reach(ur5: Arm) -> None:
    rng, root = np.random.default_rng(3), ur5.model.jointPlacements[1].translation
    far = ur5.out_of_reach(50, rng).positions - root
    reached = ur5._of(configurations(ur5, 2000)).positions - root
    assert np.linalg.norm(reached, axis=1).max() < np.linalg.norm(far, axis=1).min()


def test_no_configuration_comes_as_near_to_the_base_as_the_poses_too_near(ur5: Arm) -> None:
    _, tip = ur5._offset()

    def last_joint(positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        """Distance of the last joint from the first axis [m]."""
        return np.linalg.norm((positions + rotations @ tip)[:, :2], axis=1)

    near, reached = ur5.too_near(50, np.random.default_rng(4)), ur5._of(configurations(ur5, 5000))
    assert last_joint(reached.positions, reached.rotations).min() >= last_joint(near.positions, near.rotations).max()


def test_judges_agree() -> None:
    arm, robot = Arm("panda"), loaded("panda")
    judge, q = Judge(robot), configurations(arm, 5)
    own = np.empty((5, robot.nq))
    own[:, [robot.joint_qpos_index(name) for name in arm.joints]] = q
    for each, _ in zip(q, judge.along(own), strict=True):
        position, rotation = judge.pose(arm.frame)
        pose = arm.pose(each)
        np.testing.assert_allclose(position, pose.translation, atol=1e-12)
        np.testing.assert_allclose(rotation, pose.rotation, atol=1e-12)


def test_many_poses_of_an_arm_are_found() -> None:
    row = measured("arm7", 16, calls=3)
    assert row["found"] == 1.0 and row["wrongly called found"] == 0 and row["limits broken"] == 0
    assert row["median position error [m]"] < 1e-4 and row["poses a second"] > 0.0
