"""Obstacles of a live view: what links are taken for, obstacles that move, a robot that keeps off them and itself."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from functools import cache
from typing import Any

import equinox as eqx
import jax
import mujoco
import numpy as np
import pytest
from core_checks import needs_core
from waiting import until

import osik_jax as osik
from osik_jax.collision._geometry import Kind
from osik_jax.robot._mujoco import model_bodies, mujoco_poses
from osik_jax.viewer._parts import RobotParts, robot_parts
from osik_jax.viewer.live._covers import link_covers
from osik_jax.viewer.live._desk import Desk
from osik_jax.viewer.live._obstacles import MARGIN, _as_model
from osik_jax.viewer.live._open import default_session
from osik_jax.viewer.live._session import RobotSource, session_from_json
from osik_jax.viewer.live._surfaces import part_triangles

ARM, NAO = osik.load_robot("arm7"), osik.load_robot("nao")


@cache
def looks(arm: bool) -> tuple[RobotParts, list[np.ndarray]]:
    """What is drawn of a robot, and the points of each part in its own frame [m]."""
    shapes = robot_parts(ARM if arm else NAO)
    return shapes, [part_triangles(part).vertices for part in shapes.parts]


def drawn(robot: osik.Robot, q: Any) -> dict[int, np.ndarray]:
    """Of each of MuJoCo's bodies, the points of what is drawn in the world [m]."""
    shapes, surfaces = looks(robot is ARM)
    data, out = next(mujoco_poses(robot, q)), dict[int, list[np.ndarray]]()
    for points, body, place, turn in zip(surfaces, shapes.bodies, *shapes.poses(data), strict=True):
        out.setdefault(int(robot.mj_model.body_weldid[body]), []).append(points @ turn.T + place)
    return {body: np.concatenate(points) for body, points in out.items()}


def with_a_ball() -> Desk:
    """Return an arm that keeps off itself and has a ball; nothing runs yet."""
    desk = Desk(default_session(ARM, source=RobotSource("arm7")), robot_parts(ARM))
    desk.avoid_itself()
    assert desk.add_obstacle("ball", np.array([0.0, 2.0, 0.5]), 1.0) == "ball 1"
    return desk


@pytest.fixture(scope="module")
def desk() -> Iterator[Desk]:
    desk = with_a_ball()
    with desk.loop as loop:
        assert loop.wait_until_ready(300.0)
        yield desk


@needs_core
def test_obstacles_of_a_scene_are_shown_and_dragged() -> None:
    """The arm gives way to a box that is dragged onto its tool; nothing compiles."""
    arm = osik.load_robot("ur5")
    shapes = {"box": osik.CollisionShape.box([0.1, 0.1, 0.1], [0.0, 2.0, 0.5]), "ball": osik.CollisionShape.sphere(0.1)}
    shapes["post"] = osik.CollisionShape.cylinder(0.05, [-1.0, 0.0, 0.0], [-1.0, 0.0, 1.0])
    apart = osik.CollisionAvoidanceLimit(arm, scene=osik.Scene(shapes).moved("ball", ([0.0, -2.0, 0.5], np.eye(3))))
    session = default_session(arm, source=RobotSource("ur5"))
    desk = Desk(dataclasses.replace(session, limits=(*session.limits, apart)), robot_parts(arm))
    assert list(desk.obstacles) == ["box", "ball"] and desk.obstacles["ball"].size[0] == 0.1
    with desk.loop as loop:
        assert loop.wait_until_ready(300.0)
        program = desk.loop._job
        tool = np.asarray(osik.forward_kinematics(arm, desk.session.q).frame_pose(arm, "tool0")[0])
        place = tool * [1.1, 1.1, 1.0]  # farther out, with the tool inside
        desk.move_obstacle("box", position=place)
        desk.move_obstacle("box", size=np.array([0.12, 0.12, 0.12]))
        moved = desk.session.limits[-1]
        assert isinstance(moved, osik.CollisionAvoidanceLimit) and moved.scene is not None
        np.testing.assert_allclose(moved.scene.table.size[0], 0.12)
        np.testing.assert_allclose(desk.obstacles["box"].position, place)
        gaps = jax.jit(lambda q: moved.distances(arm, osik.forward_kinematics(arm, q)).min())
        assert gaps(desk.session.q) < -0.01
        assert until(lambda: float(gaps(loop.snapshot.q)) > 0.009)
        assert program is not None and loop._job is not None and loop._job.program is program.program


@pytest.mark.parametrize("robot", [ARM, NAO])
def test_links_are_within_what_they_are_taken_for(robot: osik.Robot) -> None:
    covers, data = link_covers(robot, robot_parts(robot)), next(mujoco_poses(robot, np.asarray(robot.q0)))
    points, bodies = drawn(robot, robot.q0), dict(zip(robot.tree.body_names, model_bodies(robot), strict=True))
    assert len(covers) >= 6
    for name, shape in covers.items():
        body = bodies[str(shape.frame)]
        assert name == f"{shape.frame}_shape"
        own = (points[body] - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
        local, size = (own - np.asarray(shape.position)) @ np.asarray(shape.rotation), np.asarray(shape.size)
        if shape.kind is Kind.BOX:
            assert np.all(np.abs(local) <= size * (1.0 + 1e-9) + 1e-9)
        else:
            local[:, 2] -= np.clip(local[:, 2], -size[1], size[1])
            assert np.linalg.norm(local, axis=1).max() <= size[0] * (1.0 + 1e-6) + 1e-9


def hand(desk: Desk) -> np.ndarray:
    """Where the hand is asked to be [m]."""
    task: Any = desk.session.tasks["hand"]
    return np.asarray(task.target[0])


def gap(desk: Desk, q: np.ndarray) -> float:
    """Between what is drawn of the links that move and the ball [m]."""
    ball = desk.obstacles["ball 1"]
    links = np.concatenate([points for body, points in drawn(ARM, q).items() if body])
    return float(np.linalg.norm(links - ball.position, axis=1).min() - ball.size[0])


@pytest.mark.release
def test_a_ball_on_the_way_is_kept_off_and_pushes_the_robot(desk: Desk) -> None:
    home = osik.forward_kinematics(ARM, ARM.q0).frame_pose(ARM, "hand")
    program, ahead = desk.loop._job, np.asarray(home[0]) + np.array([-0.1, 0.12, -0.1])
    desk.move_obstacle("ball 1", position=ahead, size=np.array([0.05, 0.0, 0.0]))
    desk.loop.record()
    desk.loop.aim("hand", (ahead, home[1]))
    assert until(lambda: (desk.loop.snapshot.recording or 0.0) > 1.5)
    assert until(lambda: float(np.abs(desk.loop.snapshot.velocity).max()) < 0.02)
    q = desk.loop.recorded().q
    assert min(gap(desk, row) for row in q[::5]) > MARGIN - 1e-3
    assert gap(desk, q[-1]) < 0.05  # it went as near as it may
    desk.loop.record()
    for step in range(40):  # dragged into the robot, at 3 cm a second
        desk.move_obstacle("ball 1", position=ahead + 0.001 * step * np.array([0.0, -1.0, 0.0]))
        time.sleep(0.033)
    assert gap(desk, desk.loop.recorded().q[-1]) > 0.0
    assert desk.loop.snapshot.failures == 0
    assert program is not None and desk.loop._job is not None and desk.loop._job.program is program.program


@pytest.mark.release
def test_a_hand_sent_into_its_own_arm(desk: Desk) -> None:
    desk.move_obstacle("ball 1", position=np.array([0.0, 2.0, 0.5]))
    home = osik.forward_kinematics(ARM, ARM.q0)
    covers, limit = link_covers(ARM, robot_parts(ARM)), desk.session.limits[2]
    assert isinstance(limit, osik.CollisionAvoidanceLimit)
    desk.loop.record()
    desk.loop.aim(
        "hand", (home.frame_pose(ARM, "link0")[0] + np.array([0.0, 0.0, 0.2]), home.frame_pose(ARM, "hand")[1])
    )
    assert until(lambda: (desk.loop.snapshot.recording or 0.0) > 2.0)
    names, q = list(covers), desk.loop.recorded().q
    nearest = np.inf
    for row in q[::10]:
        model, data = _as_model(ARM, covers, row)
        each = [mujoco.mj_geomDistance(model, data, names.index(a), names.index(b), 1.0, None) for a, b in limit.pairs]
        nearest = min(nearest, *each)
    assert 3.0 * MARGIN > nearest > MARGIN - 1e-3  # it came near, and no nearer


@pytest.mark.slow
def test_adding_moving_and_removing_compiles_nothing(desk: Desk) -> None:
    program = desk.loop._job
    assert desk.add_obstacle("box", np.array([0.0, 2.0, 0.5]), 1.0) == "box 1"
    desk.move_obstacle("box 1", size=np.array([0.5, 0.1, 0.2]))
    assert list(desk.obstacles) == ["ball 1", "box 1"]
    np.testing.assert_array_equal(desk.obstacles["box 1"].size, [0.5, 0.1, 0.2])
    for _ in range(2):
        desk.add_obstacle("box", np.array([0.0, 3.0, 0.5]), 1.0)
    with pytest.raises(ValueError, match="there are 3 of these already"):
        desk.add_obstacle("box", np.zeros(3), 1.0)
    for name in ("box 1", "box 2", "box 3"):
        desk.remove_obstacle(name)
    assert list(desk.obstacles) == ["ball 1"]
    assert program is not None and desk.loop._job is not None and desk.loop._job.program is program.program
    off = dataclasses.replace(desk.session, limits_off=frozenset({3})).controller()
    assert len(off.limits) == 4 and off.structure() != desk.session.controller().structure()


def test_obstacles_are_kept_by_sessions_and_lines_of_python() -> None:
    now = with_a_ball().session
    again = session_from_json(now.to_json())
    assert eqx.tree_equal(now.limits, again.limits)
    names: dict[str, Any] = {}
    exec(now.to_python().split("solution =")[0], names)
    assert eqx.tree_equal(list(now.active_limits), list(names["limits"]), rtol=0.0, atol=1e-14)
