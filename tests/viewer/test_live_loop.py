"""The control loop of a live view: what it does with targets, changes, failures and silence."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco_states import mujoco_at
from refusals import refuses
from waiting import steps_of
from waiting import until as until_within

import osik_jax as osik
from osik_jax.robot._mujoco import robot_com
from osik_jax.viewer.live._loop import ControlLoop, Stopwatch
from osik_jax.viewer.live._step import Controller, targets_here

ROBOT = osik.load_robot("arm7")
LIMITS = (osik.ConfigurationLimit(ROBOT), osik.VelocityLimit(ROBOT))
HOME = osik.forward_kinematics(ROBOT, ROBOT.q0).frame_pose(ROBOT, "hand")
DT = 0.005
until = partial(until_within, seconds=20.0)


def tasks(**changes: Any) -> dict[str, osik.Task]:
    """The hand's pose, and a weak posture."""
    return {
        "hand": osik.FrameTask(ROBOT, "hand", priority=1),
        "posture": osik.PostureTask(ROBOT, weight=1e-6, priority=2),
        **changes,
    }


def hand(q: np.ndarray) -> np.ndarray:
    """Where MuJoCo has the hand [m]."""
    return mujoco_at(ROBOT, q).site("hand").xpos.copy()


@pytest.fixture(scope="module")
def running() -> Iterator[ControlLoop]:
    with ControlLoop(ROBOT, Controller(tasks(), osik.WeightedQP(), LIMITS), dt=DT) as loop:
        assert loop.wait_until_ready()
        yield loop


@pytest.fixture
def loop(running: ControlLoop) -> ControlLoop:
    """At the start, at rest, with the controller of the start."""
    running.resume()
    running.change(lambda _: Controller(tasks(), osik.WeightedQP(), LIMITS))
    running.let_go("somebody")
    running.aim("hand", HOME)
    running.reset()
    assert running.wait_until_ready()
    assert until(lambda: running.snapshot.time < 0.2 and running.snapshot.ready)
    return running


def target_of(loop: ControlLoop) -> np.ndarray:
    """Where the hand is asked to be [m]."""
    task: Any = loop.controller.tasks["hand"]
    return np.asarray(task.target[0])


def moved(x: float, y: float, z: float) -> tuple[Any, Any]:
    return HOME[0] + jnp.array([x, y, z]), HOME[1]


def test_the_robot_goes_where_its_target_is(loop: ControlLoop) -> None:
    target = moved(-0.05, 0.08, -0.05)
    loop.aim("hand", target)
    assert until(lambda: bool(np.linalg.norm(hand(loop.snapshot.q) - target[0]) < 1e-4))
    assert loop.snapshot.status == osik.Status.SOLVED
    assert until(lambda: bool(np.linalg.norm(loop.snapshot.errors["hand"]) < 1e-3))


def test_every_step_is_the_solution_of_its_step(loop: ControlLoop) -> None:
    target = moved(-0.1, 0.1, 0.0)
    with steps_of(loop) as steps:
        loop.aim("hand", target)
        assert until(lambda: len(steps) > 60)
    q = np.array([step.q for step in steps])
    np.testing.assert_allclose(np.diff([step.time for step in steps]), DT, atol=1e-12)
    wanted = tasks(hand=tasks()["hand"].replace(target=target))
    for k in (20, 40, len(q) - 2):
        v = osik.solve(ROBOT, q[k], wanted, scheme=osik.WeightedQP(), limits=LIMITS, dt=DT).velocity
        np.testing.assert_allclose(q[k + 1], osik.integrate(ROBOT, q[k], v, DT), atol=1e-9)


def test_limits_hold_on_the_way_to_what_is_out_of_reach(loop: ControlLoop) -> None:
    with steps_of(loop) as steps:
        loop.aim("hand", moved(2.0, 0.5, 1.0))
        assert until(lambda: len(steps) > 300)
    q = np.array([step.q for step in steps])
    speed = np.abs(np.diff(q, axis=0)) / DT
    assert np.all(speed <= np.asarray(ROBOT.velocity_limit) * (1.0 + 1e-9))
    assert speed.max() > 0.5
    assert np.all((q >= np.asarray(ROBOT.position_lower)) & (q <= np.asarray(ROBOT.position_upper)))
    assert loop.snapshot.failures == 0


def test_an_abandoned_target_leaves_the_robot_at_rest_where_it_is(loop: ControlLoop) -> None:
    far = moved(-0.4, 0.4, -0.2)
    loop.aim("hand", far, owner="somebody")
    assert until(lambda: bool(np.abs(loop.snapshot.velocity).max() > 0.2))
    loop.release("somebody")
    assert until(lambda: bool(np.linalg.norm(target_of(loop) - far[0]) > 0.05))
    assert until(lambda: bool(np.abs(loop.snapshot.velocity).max() < 1e-3))
    assert np.linalg.norm(hand(loop.snapshot.q) - target_of(loop)) < 1e-3
    assert np.linalg.norm(hand(loop.snapshot.q) - far[0]) > 0.05


def test_targets_here_are_what_mujoco_has() -> None:
    q = np.asarray(ROBOT.q0) + 0.2
    own = tasks(
        above=osik.ComTask(ROBOT, axes="zx"), part=osik.ComTask(ROBOT, subtree="link4"), calm=osik.DampingTask(ROBOT)
    )
    here, data = targets_here(ROBOT, q, own, [*own, "nobody"]), mujoco_at(ROBOT, q)
    assert here.keys() == {"hand", "posture", "above", "part"}
    np.testing.assert_allclose(here["hand"][0], data.site("hand").xpos, atol=1e-9)
    np.testing.assert_allclose(here["hand"][1], data.site("hand").xmat.reshape(3, 3), atol=1e-9)
    np.testing.assert_allclose(here["above"], robot_com(ROBOT, data)[[2, 0]], atol=1e-9)
    np.testing.assert_allclose(here["part"], data.body("link4").subtree_com, atol=1e-9)
    np.testing.assert_array_equal(here["posture"], q)


def test_a_target_that_was_let_go_stays(loop: ControlLoop) -> None:
    target = moved(-0.05, -0.05, 0.0)
    loop.aim("hand", target, owner="somebody")
    loop.let_go("somebody")
    loop.release("somebody")
    assert until(lambda: bool(np.linalg.norm(hand(loop.snapshot.q) - target[0]) < 1e-4))
    np.testing.assert_array_equal(target_of(loop), target[0])


def test_numbers_change_without_compiling(loop: ControlLoop) -> None:
    step = loop._stepper
    loop.aim("hand", moved(-0.05, 0.0, 0.0))
    softer = tasks(hand=tasks()["hand"].replace(gain=2.0, weight=0.5))
    slow = (LIMITS[0], osik.VelocityLimit(ROBOT, velocity={"*": 0.01}))
    loop.change(lambda now: Controller(softer, now.scheme.replace(damping=1e-4), slow))
    assert until(lambda: loop._laid is loop.controller) and loop._stepper is step
    assert until(lambda: bool(0.0 < np.abs(loop.snapshot.velocity).max() <= 0.01 * (1.0 + 1e-9)))


def test_a_new_structure_follows_the_target_from_where_the_robot_is(loop: ControlLoop) -> None:
    loop.change(lambda now: Controller(now.tasks, osik.HierarchicalQP(), now.limits))
    target = moved(-0.05, 0.05, 0.0)
    loop.aim("hand", target)
    assert loop.wait_until_ready()
    assert loop._stepper is not None and isinstance(loop._stepper.scheme, osik.HierarchicalQP)
    assert until(lambda: bool(np.linalg.norm(hand(loop.snapshot.q) - target[0]) < 1e-4))


def test_a_change_that_cannot_be_compiled_is_taken_back_and_told(loop: ControlLoop) -> None:
    broken = _broken()
    loop.change(lambda now: Controller({**now.tasks, "broken": broken}, now.scheme, now.limits))
    assert until(lambda: "this task has no rows" in loop.snapshot.problem)
    assert "broken" not in loop.controller.tasks
    before = loop.snapshot.time
    assert until(lambda: loop.snapshot.time > before + 0.05)


def test_a_step_that_raises_is_told_and_the_robot_stands_still(
    loop: ControlLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(q: Any) -> None:
        raise ValueError(f"no step at {len(q)} numbers")

    with monkeypatch.context() as broken:
        broken.setattr(loop._stepper, "step", refuse)
        assert until(lambda: loop.snapshot.problem == "no step at 7 numbers" and loop.snapshot.failures > 3)
        assert not loop.snapshot.velocity.any()
    loop.change(lambda now: Controller(tasks(), now.scheme, now.limits))
    before = loop.snapshot.time
    assert until(lambda: not loop.snapshot.problem and loop.snapshot.time > before + 0.05)


def _broken() -> osik.Task:
    class Broken(osik.PostureTask):
        def rows(self, robot: Any, kinematics: Any, q: Any) -> Any:
            raise ValueError("this task has no rows")

    made: Any = Broken
    return made(ROBOT)


def test_where_the_answer_is_not_finite_the_robot_stands_still(loop: ControlLoop) -> None:
    before = loop.snapshot.q
    spoiled = eqx.tree_at(lambda task: task.gain, tasks()["hand"], jnp.asarray(jnp.nan))
    loop.change(lambda now: Controller({**now.tasks, "hand": spoiled}, now.scheme, now.limits))
    assert until(lambda: loop.snapshot.failures > 5)
    assert loop.snapshot.status == osik.Status.NUMERICAL_ERROR
    np.testing.assert_allclose(loop.snapshot.q, before, atol=1e-3)
    loop.change(lambda now: Controller(tasks(), now.scheme, now.limits))
    assert until(lambda: loop.snapshot.status == osik.Status.SOLVED)


def test_pause_and_reset(loop: ControlLoop) -> None:
    loop.aim("hand", moved(-0.2, 0.2, 0.0))
    assert until(lambda: bool(np.abs(loop.snapshot.velocity).max() > 0.1))
    loop.pause()
    assert until(lambda: loop.snapshot.paused)
    still = loop.snapshot.q
    time.sleep(0.1)
    np.testing.assert_array_equal(loop.snapshot.q, still)
    loop.aim("hand", HOME)
    loop.reset()
    loop.resume()
    assert until(lambda: not loop.snapshot.paused and loop.snapshot.time > 0.1)
    np.testing.assert_allclose(loop.snapshot.q, ROBOT.q0, atol=1e-6)


def test_wrong_targets_raise_where_they_are_given(loop: ControlLoop) -> None:
    refuses(KeyError, "hand", loop.aim, "hnad", HOME)
    refuses(ValueError, "finite", loop.aim, "hand", (np.full(3, np.nan), HOME[1]))
    refuses(ValueError, "dt is 0", ControlLoop, ROBOT, Controller(tasks(), osik.WeightedQP(), LIMITS), dt=0.0)
    with pytest.raises(ValueError, match="q0 has shape"):
        ControlLoop(ROBOT, Controller(tasks(), osik.WeightedQP(), LIMITS), q0=jnp.zeros(3))


def test_pythons_own_settings_come_back_after_the_loop() -> None:
    before, frozen = sys.getswitchinterval(), gc.get_freeze_count()
    with ControlLoop(ROBOT, Controller({"broken": _broken()}, osik.WeightedQP(), LIMITS)) as loop:
        assert until(lambda: "this task has no rows" in loop.snapshot.problem)
        assert sys.getswitchinterval() <= 5e-5 + 1e-9
    assert sys.getswitchinterval() == before
    assert (gc.get_freeze_count() > 0) == (frozen > 0)  # as long as another loop runs


def test_a_stopwatch_tells_percentiles_of_what_it_keeps() -> None:
    watch, rng = Stopwatch(length=100), np.random.default_rng(0)
    starts, durations = np.cumsum(rng.uniform(0.004, 0.006, 250)), rng.uniform(0.0, 0.002, 250)
    for start, duration in zip(starts, durations, strict=True):
        watch.add(start, duration)
    timing = watch.timing()
    assert timing.steps == 250
    np.testing.assert_allclose(timing.period[:2], np.percentile(np.diff(starts[150:]), (50, 99)))
    np.testing.assert_allclose(timing.step, (*np.percentile(durations[150:], (50, 99)), durations[150:].max()))
    watch.clear()
    assert watch.timing().period == (0.0, 0.0, 0.0)
