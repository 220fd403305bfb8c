"""Obstacles of a live view: shapes that move, and a robot that keeps off them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest
from core_checks import needs_core
from waiting import until

import osik_jax as osik
from osik_jax import cli
from osik_jax.cli._view import _keeps_off
from osik_jax.viewer.live._desk import Desk
from osik_jax.viewer.live._obstacles import nearest_pair
from osik_jax.viewer.live._open import default_session


@needs_core
def test_obstacles_of_a_scene_are_shown_and_dragged() -> None:
    """The arm gives way to a box that is dragged onto its tool; nothing compiles."""
    arm = osik.load_robot("ur5")
    shapes = {"box": osik.CollisionShape.box([0.1, 0.1, 0.1], [0.0, 2.0, 0.5]), "ball": osik.CollisionShape.sphere(0.1)}
    shapes["post"] = osik.CollisionShape.cylinder(0.05, [-1.0, 0.0, 0.0], [-1.0, 0.0, 1.0])
    apart = osik.CollisionAvoidanceLimit(arm, scene=osik.Scene(shapes).moved("ball", ([0.0, -2.0, 0.5], np.eye(3))))
    session = default_session(arm, source="ur5")
    desk = Desk(dataclasses.replace(session, limits=(*session.limits, apart)))
    assert list(desk.obstacles) == ["box", "ball", "post"] and desk.obstacles["ball"].part.size[0] == 0.1
    with desk.loop as loop:
        assert loop.wait_until_ready(300.0)
        step = loop._stepper
        tool = np.asarray(osik.forward_kinematics(arm, desk.session.q).frame_pose(arm, "tool0")[0])
        place = tool * [1.1, 1.1, 1.0]  # farther out, with the tool inside
        desk.move_obstacle("box", place, np.eye(3))
        moved = desk.session.limits[-1]
        assert isinstance(moved, osik.CollisionAvoidanceLimit) and moved.scene is not None
        np.testing.assert_allclose(desk.obstacles["box"].position, place)
        gaps = jax.jit(lambda q: moved.distances(arm, osik.forward_kinematics(arm, q)).min())
        assert gaps(desk.session.q) < -0.01
        assert until(lambda: float(gaps(loop.snapshot.q)) > 0.009)
        near = nearest_pair(desk.session.active_limits, loop.snapshot.q)
        assert near is not None and "box" in near.names and near.kept == 0.01
        np.testing.assert_allclose(np.linalg.norm(near.points[0] - near.points[1]), near.distance, rtol=1e-6)
        assert loop._stepper is step


@needs_core
def test_a_scene_of_the_command_line_is_kept_off(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The default distance is 1 cm; a motion to play has no scene."""
    arm, scene = osik.load_robot("ur5"), osik.Scene({"ball": osik.CollisionShape.sphere(0.1, [0.0, 2.0, 0.5])})
    (limit,) = _keeps_off(arm, scene, None, 0.0)
    assert isinstance(limit, osik.CollisionAvoidanceLimit) and float(limit.minimum_distance) == 0.01
    assert list(Desk(dataclasses.replace(default_session(arm), limits=(limit,))).obstacles) == ["ball"]
    assert cli.main(["view", str(tmp_path / "motion.npz"), "--scene", "cell.xml"]) == 2
    assert "--scene goes with a robot to drag, not with a file" in capsys.readouterr().err
