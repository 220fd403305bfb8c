"""Sessions of a live view, and the controllers' files that they write and take."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest

import osik_jax as osik
from osik_jax.control import _checks
from osik_jax.robot._guesses import find_hands
from osik_jax.saving._controller import read_controller
from osik_jax.viewer import serve
from osik_jax.viewer.live._desk import Desk, Session
from osik_jax.viewer.live._open import default_session
from osik_jax.viewer.live._step import Controller, laid_out

ROBOT = osik.load_robot("nao")


def session(**changes: Any) -> Session:
    """One with a task of each of several families, and numbers that are nobody's default."""
    standing = osik.support_polygon(ROBOT, ROBOT.q0, ("l_sole", "r_sole"), margin=0.01)
    home = osik.forward_kinematics(ROBOT, ROBOT.q0).frame_pose(ROBOT, "l_gripper")
    tasks = {
        "foot": osik.FrameTask(ROBOT, "l_sole", weight=1e4),
        "balance": osik.ComTask(ROBOT, polygon=standing, weight=3.0, priority=2),
        "hand": osik.FrameTask(
            ROBOT,
            "l_gripper",
            target=(home[0] + 0.03, home[1]),
            rows="position",
            gain=osik.AdaptiveGain(20.0, 5.0, 1.0 / 3.0),
            priority=3,
        ),
        "waist": osik.FrameTask(ROBOT, "torso", axes="frame", orientation_weight=(1.0, 2.0, 0.5), priority=3),
        "arms": osik.PostureTask(ROBOT, joints=("LShoulder*", "LElbow*"), weight=0.1, priority=3),
        "posture": osik.PostureTask(ROBOT, weight=1e-2, gain=1.0, priority=4),
    }
    given: dict[str, Any] = dict(
        robot=ROBOT,
        tasks=tasks,
        scheme=osik.WeightedQP(damping=2e-6),
        limits=(osik.ConfigurationLimit(ROBOT, gain=0.7), osik.VelocityLimit(ROBOT, velocity={"L*": 0.1})),
        dt=0.004,
        q=np.asarray(ROBOT.q0),
        off=frozenset({"waist"}),
        source="nao",
    )
    return Session(**{**given, **changes})


def test_what_is_switched_on_comes_back_from_a_controllers_file(tmp_path: Path) -> None:
    start = np.asarray(osik.integrate(ROBOT, ROBOT.q0, 0.01 * np.ones(ROBOT.nv)))
    saved = session(limits_off=frozenset({1}), q=start)
    (path := tmp_path / "controller.json").write_text(saved.to_text())
    loaded = osik.load_controller(path)
    assert "waist" not in loaded.tasks and loaded.dt == 0.004
    np.testing.assert_array_equal(loaded.robot.q0, start)
    numbers = [jax.tree.leaves(one) for one in (saved.active_tasks, saved.scheme, saved.active_limits)]
    for own, found in zip(numbers, (loaded.tasks, loaded.scheme, loaded.limits), strict=True):
        assert all(map(np.array_equal, own, jax.tree.leaves(found)))
    with serve(loaded, port=0) as view:
        view.save(tmp_path / "again.json")  # without source=, the file has the robot itself
        assert view.loop.wait_until_ready()
    assert eqx.tree_equal(osik.load_controller(tmp_path / "again.json").tasks["hand"].gain, saved.tasks["hand"].gain)


@pytest.mark.release
def test_what_is_switched_off_is_as_if_it_were_not_there() -> None:
    arm = osik.load_robot("arm7")
    home = osik.forward_kinematics(arm, arm.q0).frame_pose(arm, "hand")
    tasks = {
        "hand": osik.FrameTask(arm, "hand", target=(home[0] - 0.05, home[1]), rows="position"),
        "turn": osik.FrameTask(arm, "hand", target=(home[0], home[1] @ np.diag([1.0, -1.0, -1.0])), rows="orientation"),
        "posture": osik.PostureTask(arm, weight=1e-3),
    }
    given: dict[str, Any] = dict(scheme=osik.WeightedQP(), dt=0.004, q=np.asarray(arm.q0))
    limits = (osik.ConfigurationLimit(arm), osik.VelocityLimit(arm, velocity={"*": 0.1}))
    wanted = Session(arm, tasks, limits=limits, off=frozenset({"turn"}), limits_off=frozenset({1}), **given)
    parts = wanted.controller()
    off, left = (
        osik.solve(arm, arm.q0, tasks, scheme=wanted.scheme, limits=limits, dt=wanted.dt).velocity
        for tasks, limits in ((parts.tasks, parts.limits), (wanted.active_tasks, wanted.active_limits))
    )
    np.testing.assert_allclose(off, left, atol=1e-8)
    assert np.abs(off).max() > 0.2  # as fast as the limit that is off would let no joint be


def test_edits_at_the_desk() -> None:
    desk = Desk(session())
    desk.loop.aim("hand", (np.array([0.1, 0.1, 0.3]), np.eye(3)))
    desk.rank("foot", 2)
    desk.renumber("hand", weight=7.0)
    name = desk.add_frame("r_gripper")
    now: Any = desk.session
    assert now.tasks["foot"].priority == 2 and float(now.tasks["hand"].weight) == 7.0
    np.testing.assert_array_equal(now.tasks["hand"].target[0], [0.1, 0.1, 0.3])
    home = osik.forward_kinematics(ROBOT, ROBOT.q0).frame_pose(ROBOT, "r_gripper")
    np.testing.assert_allclose(now.tasks[name].target[0], home[0], atol=1e-12)
    desk.remove(name)
    desk.take_scheme("Hierarchical QP")
    desk.switch("waist", True)
    now = desk.session
    assert name not in now.tasks and not now.off and isinstance(now.scheme, osik.HierarchicalQP)
    for other in desk.session.tasks.keys() - {"waist"}:
        desk.switch(other, False)
    with pytest.raises(ValueError, match="one task at least stays on"):
        desk.switch("waist", False)
    desk.load(read_controller(session().to_text().encode(), "the file"))
    assert isinstance(desk.session.scheme, osik.WeightedQP) and not desk.session.off
    arm = osik.load_robot("arm7")
    with pytest.raises(ValueError, match="another robot"):
        desk.load(osik.Controller(arm, {"posture": osik.PostureTask(arm)}, dt=0.004))
    with pytest.raises(ValueError, match="step is 0.01 s, this page's 0.004 s"):
        desk.load(osik.Controller(ROBOT, {"posture": osik.PostureTask(ROBOT)}, dt=0.01))


def test_a_page_without_source_takes_the_file_that_it_wrote() -> None:
    """The file has the robot's MJCF, whose frames come in another order."""
    arm = osik.load_robot("arm7")
    tasks = {"hand": osik.FrameTask(arm, "hand", weight=3.0), "posture": osik.PostureTask(arm)}
    own = Session(arm, tasks, osik.WeightedQP(), (), 0.005, np.asarray(arm.q0))
    desk, controller = Desk(own), read_controller(own.to_text().encode(), "the file")
    assert controller.robot.tree != arm.tree
    desk.load(controller)
    now: Any = desk.session
    assert now.robot is arm and now.tasks["hand"].frame == "hand" and float(now.tasks["hand"].weight) == 3.0


def test_a_default_session_has_what_there_is_to_drag() -> None:
    assert find_hands(ROBOT) == ("l_gripper", "r_gripper")
    assert find_hands(osik.load_robot("arm7")) == ("hand",)
    one = default_session(ROBOT, feet=("l_sole", "r_sole"))
    assert list(one.tasks) == ["l_sole", "r_sole", "l_gripper", "r_gripper", "torso", "centre of mass", "posture"]
    assert one.off == {"torso", "centre of mass"}
    kinematics = osik.forward_kinematics(ROBOT, ROBOT.q0)
    for name in one.active_tasks:
        np.testing.assert_allclose(one.tasks[name].rows(ROBOT, kinematics, ROBOT.q0).error, 0.0, atol=1e-9)


def test_the_page_of_a_robot_does_not_complain_of_its_own_scheme(
    recwarn: pytest.WarningsRecorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_checks, "_said_ignored", set())  # each set of tasks is warned of once
    made = default_session(osik.load_robot("arm7"))
    laid_out(made.robot, Controller(dict(made.tasks), made.scheme, made.limits), made.dt).step(made.q)
    assert len({task.priority for task in made.tasks.values()}) > 1 and isinstance(made.scheme, osik.WeightedQP)
    assert not [w for w in recwarn if issubclass(w.category, osik.OsikWarning)]
