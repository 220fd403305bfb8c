"""Verdicts name what stops a robot, and count the targets that a rollout misses."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import osik_jax as osik

XML = """<mujoco><compiler angle="radian"/><worldbody><body name="a"><joint name="lift" axis="0 0 1" range="-1 1"/>
<geom type="capsule" size=".02" fromto="0 0 0 .4 0 0"/><body name="b" pos=".4 0 0">
<joint name="elbow" axis="0 0 1" range="-2.5 2.5"/><geom name="fore" type="capsule" size=".02" fromto="0 0 0 .3 0 0"/>
<body name="hand" pos=".3 0 0"><geom name="palm" size=".03"/></body></body></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def planar() -> osik.Robot:
    return osik.Robot.from_mjcf(XML)


def place(lift: float, elbow: float) -> np.ndarray:
    """The hand's position by the closed form of two links [m]. (3,)"""
    angles, lengths = np.array([lift, lift + elbow]), np.array([0.4, 0.3])
    return np.append(lengths @ np.stack([np.cos(angles), np.sin(angles)], 1), 0.0)


def reach(robot: osik.Robot, target: np.ndarray, **options: Any) -> osik.FrameTask:
    return osik.FrameTask(robot, "hand", rows="position", target=target, gain=20.0, **options)


def verdict(
    robot: osik.Robot, tasks: dict[str, osik.Task], limits: Any = None, steps: int = 120
) -> osik.RolloutVerdict:
    path = osik.rollout(robot, robot.q0, tasks, limits=limits, dt=0.02, steps=steps)
    return osik.explain_rollout(robot, path, tasks, limits=limits, dt=0.02)


def test_a_joint_at_its_limit_is_named(planar: osik.Robot) -> None:
    tasks = {"hand": reach(planar, place(1.3, 0.0)), "posture": osik.PostureTask(planar, priority=2)}
    found = verdict(planar, tasks)  # the posture comes last and stops nothing
    assert found.last is not None and found.last.joints == ("lift",) and found.last.tasks == ()
    assert found.met_from["hand"] is None
    assert "lift is at its upper limit" in str(found) and "120 of 120 targets missed" in str(found)
    # the nearest point with lift = 1 has the elbow towards the target
    from_elbow = place(1.3, 0.0)[:2] - 0.4 * np.array([np.cos(1.0), np.sin(1.0)])
    np.testing.assert_allclose(found.errors["hand"][-1], np.array([np.linalg.norm(from_elbow) - 0.3, 0.0]), atol=1e-6)


def test_a_target_that_is_met_says_from_when(planar: osik.Robot) -> None:
    found = verdict(planar, {"hand": reach(planar, place(0.3, 0.9))})
    first = found.met_from["hand"]
    assert found.last is None and first is not None and first == found.missed["hand"] and 0 < first < 120
    assert f"met from step {first} on" in str(found)
    assert (found.errors["hand"][first:, 0] <= 1e-3).all() and found.errors["hand"][first - 1, 0] > 1e-3


def test_shapes_that_may_come_no_nearer_are_named(planar: osik.Robot) -> None:
    post = osik.CollisionShape.sphere(0.05, place(0.3, 0.6))
    pairs = [("palm", "post"), ("fore", "post")]
    apart = osik.CollisionAvoidanceLimit(planar, shapes={"post": post}, pairs=pairs, minimum_distance=0.02)
    found = verdict(planar, {"hand": reach(planar, place(0.3, 0.6))}, (apart,))
    assert found.last is not None and ("palm", "post") in found.last.pairs and not found.last.joints
    np.testing.assert_allclose(found.errors["hand"][-1, 0], 0.05 + 0.03 + 0.02, atol=1e-6)


def test_a_stretched_arm_and_its_task_above_are_told_apart(planar: osik.Robot) -> None:
    far = verdict(planar, {"hand": reach(planar, np.array([2.0, 0.0, 0.0]))})
    assert far.last is not None and not far.last.joints and "stretched" in str(far)
    tasks = {"hand": reach(planar, place(0.3, 0.9), priority=2), "posture": osik.PostureTask(planar, priority=1)}
    held = verdict(planar, tasks)
    assert held.last is not None and held.last.tasks == ("posture",) and "stretched" not in str(held)


def test_speed_limits_and_barriers_are_named(planar: osik.Robot) -> None:
    tasks: Any = {"hand": reach(planar, place(0.9, 2.0))}
    slow = osik.VelocityLimit(planar, velocity={"*": 0.1})
    step = osik.explain_step(planar, planar.q0, tasks, limits=(slow,))
    assert set(step.joints) == {"lift", "elbow"} and "elbow is at its upper speed limit" in str(step)
    wall = osik.PositionBarrier(planar, "hand", normals=[0.0, 1.0, 0.0], upper=0.2)
    stopped = verdict(planar, tasks, (wall,))
    assert "a PositionBarrier stops it" in str(stopped)


def test_targets_by_step_are_those_of_the_step(planar: osik.Robot) -> None:
    lifts = np.linspace(0.2, 1.6, 100)  # from 1 on, the joint's limit, most targets are missed
    points = np.array([place(lift, 0.6) for lift in lifts])
    q0 = jnp.array([0.2, 0.6])
    tasks: Any = {"hand": reach(planar, points[0]).replace(gain=50.0)}
    path = osik.rollout(planar, q0, tasks, dt=0.02, steps=100, targets={"hand": jnp.array(points)})
    found = osik.explain_rollout(planar, path, tasks, dt=0.02, targets={"hand": jnp.array(points)})
    reached = np.array([place(*q) for q in np.asarray(path.q[1:])])
    np.testing.assert_allclose(found.errors["hand"][:, 0], np.linalg.norm(reached - points, axis=1), atol=1e-12)
    assert found.missed["hand"] == (np.linalg.norm(reached - points, axis=1) > 1e-3).sum() > (lifts > 1.2).sum()
    assert found.last is not None and "lift" in found.last.joints
