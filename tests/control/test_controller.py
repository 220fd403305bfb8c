"""Steps outside ``jit``, by ``solve`` and a ``Controller``: beside compiled ones, with new numbers, by two threads."""

from __future__ import annotations

import copy
import gc
import pickle
import threading
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
from compilations import Compilations
from core_checks import needs_core
from jax.core import Tracer
from jaxtyping import Float
from refusals import refuses

import osik_jax as osik
from osik_jax.control import _plain_step, _step

DT = 0.01
SCHEMES = {
    "default": None,
    "weighted": osik.WeightedQP(damping=1e-6),
    "classical": osik.NullSpace(),
    "saturated": osik.NullSpace(method="saturated"),
}


def tasks_of(robot: osik.Robot) -> dict[str, osik.Task]:
    hand, other = robot.tree.body_names[-1], robot.tree.body_names[2]
    return {
        "hand": osik.FrameTask(robot, hand, gain=20.0),
        "com": osik.ComTask(robot, axes="xy", lower=-0.02, upper=0.05, priority=1),
        "other": osik.FrameTask(robot, other, rows="position", priority=2),
        "posture": osik.PostureTask(robot, priority=3),
    }


def moved(robot: osik.Robot, seed: int) -> np.ndarray:
    """A configuration beside home, and so a target that is not met there."""
    aside = np.random.default_rng(seed).uniform(-0.2, 0.2, robot.nv)
    return np.asarray(osik.integrate(robot, robot.q0, aside))


def compiled(robot: osik.Robot, q: Any, tasks: Any, **options: Any) -> osik.control.Solution:
    return jax.jit(lambda q: osik.solve(robot, q, tasks, dt=DT, **options))(q)


def assert_same(found: osik.control.Solution, wanted: osik.control.Solution) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, atol=1e-9)


@needs_core
@pytest.mark.parametrize(
    ("name", "scheme"), [("nao", "default"), ("arm7", "weighted"), ("arm7", "classical"), ("nao", "saturated")]
)
@pytest.mark.filterwarnings("ignore:a WeightedQP ignores priorities")
def test_answers_are_those_of_a_compiled_step(name: str, scheme: str) -> None:
    robot = osik.load_robot(name)
    tasks, options = tasks_of(robot), {"scheme": SCHEMES[scheme], "dt": DT}
    controller = osik.Controller(robot, tasks, **options)
    home: Any = vars(tasks["hand"])["target"]
    aim = osik.forward_kinematics(robot, moved(robot, 9)).frame_pose(robot, robot.tree.body_names[-1])
    program = jax.jit(
        lambda q, target, warm: osik.solve(robot, q, tasks, targets={"hand": target}, warm_start=warm, **options)
    )
    cold = program(moved(robot, 0), home, None)
    for seed in range(3):
        q = moved(robot, seed)
        wanted = program(q, home, None)
        plain = osik.solve(robot, q, tasks, **options)
        assert isinstance(plain.velocity, jax.Array)
        assert_same(plain, wanted)
        if cold.warm_start is not None:
            warm = osik.solve(robot, q, tasks, warm_start=cold.warm_start, **options)
            assert_same(warm, program(q, home, cold.warm_start))
        found = controller.step(q)
        assert isinstance(found.velocity, np.ndarray)
        assert_same(found, wanted)
        aimed = program(q, aim, None)
        assert_same(osik.solve(robot, q, tasks, targets={"hand": aim}, **options), aimed)
        assert_same(controller.step(q, {"hand": tuple(map(np.asarray, aim))}), aimed)
        assert_same(controller.step(q), wanted)  # the target was that of one step
        after = controller.integrate(q, found.velocity)
        traced = jax.jit(osik.integrate, static_argnums=())(robot, q, wanted.velocity, DT)
        np.testing.assert_allclose(after, traced, atol=1e-12)
        np.testing.assert_allclose(after, osik.integrate(robot, q, wanted.velocity, DT), atol=1e-12)


@needs_core
def test_new_numbers_and_new_structures_are_seen(arm: osik.Robot) -> None:
    tasks, q = {"hand": osik.FrameTask(arm, "hand"), "posture": osik.PostureTask(arm)}, moved(arm, 1)
    controller = osik.Controller(arm, tasks, dt=DT)
    changes = (
        {"hand": tasks["hand"].replace(gain=3.0, weight=2.0)},
        {"posture": tasks["posture"].replace(weight=np.linspace(0.1, 1.0, arm.nv), target=moved(arm, 2))},
        {"hand": osik.FrameTask(arm, "hand", rows="position", axes="frame")},
        {"hand": osik.FrameTask(arm, "hand", lower=-0.01, upper=0.02)},
        {"extra": osik.FrameTask(arm, "link3", rows="orientation")},
        {"hand": osik.LookAtTask(arm, "hand", target=[1.0, 0.0, 0.3])},
        {"hand": tasks["hand"]},
    )
    for change in changes:
        tasks = {**tasks, **change}
        controller.tasks.update(change)
        wanted = compiled(arm, q, tasks)
        assert_same(osik.solve(arm, q, tasks, dt=DT), wanted)
        np.testing.assert_allclose(controller.step(q).velocity, wanted.velocity, atol=1e-9)
    scheme, limits = osik.HierarchicalQP(damping=1e-3), (osik.VelocityLimit(arm, velocity={"*": 0.1}),)
    longer = arm.scaled(length={"link3": 1.2})
    _plain_step._kept.clear()
    variants: Any = [(arm, {"scheme": scheme}), (arm, {"limits": limits}), (longer, {}), (arm, {})]
    for robot, options in variants:
        assert_same(osik.solve(robot, q, tasks, dt=DT, **options), compiled(robot, q, tasks, **options))
    program = jax.jit(lambda dt: osik.solve(arm, q, tasks, dt=dt).velocity)
    for dt in (0.02, np.float64(0.003), jax.numpy.asarray(0.004)):
        np.testing.assert_allclose(osik.solve(arm, q, tasks, dt=dt).velocity, program(np.float64(dt)), atol=1e-9)


@needs_core
def test_numbers_that_are_not_finite_get_a_status(arm: osik.Robot) -> None:
    task = osik.FrameTask(arm, "hand")
    position = np.asarray(task.target[0]) * np.nan
    spoiled = jax.tree.map(lambda leaf: leaf, task)
    vars(spoiled)["target"] = (jax.numpy.asarray(position), task.target[1])
    for tasks in ({"hand": spoiled}, {"hand": task}):  # the second is not harmed by the first
        assert_same(osik.solve(arm, arm.q0, tasks, dt=DT), compiled(arm, arm.q0, tasks))


@needs_core
def test_a_step_of_the_core_compiles_nothing(arm: osik.Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_step, "step", None)
    tasks = {"hand": osik.FrameTask(arm, "hand"), "posture": osik.PostureTask(arm, weight=1e-3)}
    q = moved(arm, 3)
    for _ in range(3):
        q = osik.integrate(arm, q, osik.solve(arm, q, tasks, dt=DT).velocity, DT)
        tasks = {**tasks, "hand": tasks["hand"].replace(target=(np.array([0.4, 0.1, 0.4]), np.eye(3)))}


@needs_core
@pytest.mark.parametrize("scheme", ["default", "weighted"])
@pytest.mark.filterwarnings("ignore:a WeightedQP ignores priorities")
def test_rows_that_jax_computes_enter_the_call_of_the_core(arm: osik.Robot, scheme: str) -> None:
    """New targets and gains compile nothing; a point in the hand gets the status of a compiled step."""
    hand = arm.tree.body_names[-1]
    tasks = {**tasks_of(arm), "look": osik.LookAtTask(arm, hand, target=[1.0, 0.2, 0.4], priority=2)}
    tasks["height"] = osik.FunctionTask(arm, lambda r, k, q: k.frame_pose(r, hand)[0][2:], lower=0.1, upper=0.3)
    controller, q = osik.Controller(arm, tasks, scheme=SCHEMES[scheme], dt=DT), moved(arm, 3)
    assert isinstance(controller._plain, _plain_step.PlainStep)
    assert_same(controller.step(q), compiled(arm, q, tasks, scheme=SCHEMES[scheme]))
    points = np.array([0.5, 0.5, 0.5]), np.asarray(osik.forward_kinematics(arm, q).frame_pose(arm, hand)[0])
    controller.tasks["look"] = tasks["look"] = tasks["look"].replace(gain=3.0)
    with Compilations() as later:
        found = [controller.step(q, {"look": point}) for point in points]
    assert later.names == []
    for answer, point in zip(found, points, strict=True):
        aimed = {**tasks, "look": tasks["look"].replace(target=point)}
        assert_same(answer, compiled(arm, q, aimed, scheme=SCHEMES[scheme]))


@needs_core
def test_threads_wait_for_each_other(arm: osik.Robot) -> None:
    tasks = {"hand": osik.FrameTask(arm, "hand"), "posture": osik.PostureTask(arm, weight=1e-3)}
    starts = [moved(arm, seed) for seed in range(4)]
    wanted = [np.asarray(osik.solve(arm, q, tasks, dt=DT).velocity) for q in starts]
    wrong: list[int] = []

    def run(k: int) -> None:
        for _ in range(200):
            if not np.array_equal(osik.solve(arm, starts[k], tasks, dt=DT).velocity, wanted[k]):
                wrong.append(k)

    threads = [threading.Thread(target=run, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_a_loop_is_a_rollout(arm: osik.Robot) -> None:
    """With a limit and a task that remember the last velocity."""
    hand = osik.FrameTask(arm, "hand", target=osik.forward_kinematics(arm, moved(arm, 5)).frame_pose(arm, "hand"))
    tasks = {"hand": hand, "calm": osik.LowAccelerationTask(arm, weight=1e-2)}
    limits = (osik.AccelerationLimit(arm, {"*": 3.0}),)
    path = osik.rollout(arm, arm.q0, tasks, limits=limits, dt=DT, steps=20)
    controller, q = osik.Controller(arm, tasks, limits=limits, dt=DT), arm.q0
    for wanted in path.q[1:]:
        q = controller.integrate(q, controller.step(q).velocity)
        np.testing.assert_allclose(q, wanted, atol=1e-9)
    controller.forget()
    np.testing.assert_allclose(controller.step(arm.q0).velocity, path.solution.velocity[0], atol=1e-9)


def test_limits_of_any_iterable_hold(arm: osik.Robot) -> None:
    slow = osik.VelocityLimit(arm, velocity={"*": 0.05})
    for tasks in ({"hand": osik.FrameTask(arm, "hand")}, {"hand": osik.FrameTask(arm, "hand", hard=True)}):
        for limits in ((one for one in [slow]), {"slow": slow}.values(), [slow]):
            found: Any = osik.solve(arm, moved(arm, 1), tasks, limits=limits)  # pyright: ignore[reportArgumentType]
            assert np.abs(found.velocity).max() <= 0.05
        refuses(TypeError, "limits is VelocityLimit", osik.solve, arm, moved(arm, 1), tasks, limits=slow)


@needs_core
def test_what_a_refused_call_brought_is_not_kept(arm: osik.Robot) -> None:
    """The own limits of another robot, whose given limit does not fit what was laid out."""
    tasks, q = {"hand": osik.FrameTask(arm, "hand"), "posture": osik.PostureTask(arm)}, moved(arm, 2)
    limits = (osik.ConfigurationLimit(arm, gain=0.5),)
    wanted = osik.solve(arm, q, tasks, limits=limits)
    slow = eqx.tree_at(lambda robot: robot.velocity_limit, arm, 0.1 * arm.velocity_limit)
    osik.solve(slow, q, tasks, limits=(osik.ConfigurationLimit(slow, gain=np.full(arm.nv, 0.5)),))
    assert_same(osik.solve(arm, q, tasks, limits=limits), wanted)


def test_numbers_changed_in_place_and_traced_ones_are_not_kept(arm: osik.Robot) -> None:
    task, q, position = osik.FrameTask(arm, "hand"), moved(arm, 2), np.array([0.3, 0.2, 0.4])
    tasks = {"hand": eqx.tree_at(lambda own: own.target, task, (position, np.eye(3)))}

    @jax.jit
    def program(place: Any) -> Any:
        return osik.solve(arm, q, {"hand": task.replace(target=(place, np.eye(3)))}, dt=DT).velocity

    for place in ([0.3, 0.2, 0.4], [0.4, 0.1, 0.3]):
        position[:] = place
        np.testing.assert_allclose(osik.solve(arm, q, tasks, dt=DT).velocity, program(np.array(place)), atol=1e-9)
    hard = osik.FrameTask(arm, "hand", hard=True)

    def velocity(p: Any) -> Any:
        return osik.solve(arm, q, {"hand": hard.replace(target=(p, np.eye(3)))}).velocity

    gc.freeze()  # what was there before is not looked at
    jax.eval_shape(jax.vmap(velocity), np.ones((2, 3)))
    gc.collect()
    assert not any(isinstance(thing, Tracer) for thing in gc.get_objects())
    gc.unfreeze()


@needs_core
def test_exchanged_parts_of_a_controller_are_seen(arm: osik.Robot) -> None:
    tasks, q = {"hand": osik.FrameTask(arm, "hand", gain=50.0), "posture": osik.PostureTask(arm)}, moved(arm, 3)
    controller = osik.Controller(arm, tasks, scheme=osik.NullSpace(), dt=DT)
    for scheme in (osik.NullSpace(method="saturated"), osik.WeightedQP(), osik.WeightedQP(damping=1e-2)):
        controller.scheme = scheme
        assert_same(controller.step(q), compiled(arm, q, tasks, scheme=scheme))
    controller = osik.Controller(arm, tasks, dt=DT)
    controller.scheme = None  # pyright: ignore[reportAttributeAccessIssue]
    assert_same(controller.step(q), compiled(arm, q, tasks))
    controller.scheme = osik.NullSpace()  # where none was given, too
    slow = (osik.VelocityLimit(arm, velocity={"*": 0.1}),)
    for limits in ((), slow, osik.no_limits):
        controller.limits = limits  # pyright: ignore[reportAttributeAccessIssue]  # as the constructor takes them
        assert_same(controller.step(q), compiled(arm, q, tasks, scheme=osik.NullSpace(), limits=limits))
        assert controller._plain.is_of(*list(controller)[:4])  # pyright: ignore[reportOptionalMemberAccess]
    controller = osik.Controller(arm, tasks, dt=DT)
    velocity = controller.step(q).velocity
    calm = osik.LowAccelerationTask(arm, weight=10.0)
    controller.tasks["calm"] = calm
    wanted = compiled(arm, q, {**tasks, "calm": calm.after(jax.numpy.asarray(velocity))})
    np.testing.assert_allclose(controller.step(q).velocity, wanted.velocity, atol=1e-9)
    del controller.tasks["calm"]
    controller.tasks["posture"] = osik.PostureTask(arm, priority=2)
    for same in (controller, copy.deepcopy(controller), pickle.loads(pickle.dumps(controller))):
        assert_same(same.step(q), compiled(arm, q, controller.tasks))
    given, before = q.copy(), controller.step(q).velocity
    given[0] = np.nan
    refuses(ValueError, "not finite", controller.integrate, given, before)
    with pytest.warns(osik.OsikWarning, match="gain times dt"):
        controller.tasks["hand"] = tasks["hand"].replace(gain=5000.0)
        controller.step(q)


@needs_core
def test_a_step_that_ends_early_leaves_no_target(arm: osik.Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    controller, q = osik.Controller(arm, {"hand": osik.FrameTask(arm, "hand")}, dt=DT), moved(arm, 4)
    wanted, real = controller.step(q), _plain_step.functions()
    interrupted = real._replace(step=lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    monkeypatch.setattr(_plain_step, "functions", lambda: interrupted)
    with pytest.raises(KeyboardInterrupt):
        controller.step(q, {"hand": (np.array([0.1, 0.2, 0.3]), np.eye(3))})
    monkeypatch.setattr(_plain_step, "functions", lambda: real)
    assert_same(controller.step(q), wanted)


def test_wrong_arguments_are_named(arm: osik.Robot) -> None:
    tasks = {"hand": osik.FrameTask(arm, "hand"), "posture": osik.PostureTask(arm)}
    controller = osik.Controller(arm, tasks, dt=DT)
    refuses(ValueError, "q has shape", controller.step, np.zeros(3))
    refuses(KeyError, "'hnad'", controller.step, arm.q0, {"hnad": np.zeros(3)})
    refuses(TypeError, "inside jit", jax.jit(lambda q: controller.step(q).velocity), arm.q0)
    refuses(TypeError, "targets is a ndarray", controller.step, arm.q0, np.zeros(3))
    refuses(ValueError, "dt is -1", osik.Controller, arm, tasks, dt=-1.0)
    refuses(TypeError, "inside jit", jax.jit(lambda dt: osik.Controller(arm, tasks, dt=dt).step(arm.q0).velocity), DT)
    for part, wrong, message in (("limits", (3,), "which is no limit"), ("tasks", [tasks["hand"]], "tasks is a list")):
        changed = osik.Controller(arm, tasks, dt=DT)
        setattr(changed, part, wrong)
        refuses(TypeError, message, changed.step, arm.q0)
    bounded = {**tasks, "hand": osik.FrameTask(arm, "hand", lower=-1.0, upper=1.0), "speed": osik.DampingTask(arm)}
    refuses(TypeError, "has no 'target'", osik.Controller(arm, bounded, dt=DT).step, arm.q0, {"speed": arm.q0})


@pytest.mark.parametrize("part", ["tasks", "scheme", "limits"])
def test_a_stack_without_vmap_is_named(arm: osik.Robot, part: str) -> None:
    """The core would take the numbers of its first entry."""
    tasks = {"posture": osik.PostureTask(arm)}
    speeds = [osik.VelocityLimit(arm, velocity={"*": speed}) for speed in (0.1, 1.0)]
    aimed = jax.vmap(lambda weight: tasks["posture"].replace(weight=weight))(np.ones(3))
    stacks: dict[str, Any] = {
        "tasks": {"posture": aimed},
        "scheme": osik.stack([osik.WeightedQP(damping=damping) for damping in (1.0, 2.0)]),
        "limits": (osik.stack(speeds),),
    }
    given = {"tasks": tasks, part: stacks[part]}
    for call in (osik.Controller, lambda robot, **options: osik.solve(robot, robot.q0, **options)):
        refuses(ValueError, f"{part}.* is a stack", call, arm, **given)
    alone = jax.vmap(lambda own: osik.solve(arm, arm.q0, **{"tasks": tasks, part: own}).velocity)(stacks[part])
    assert len(alone) == (3 if part == "tasks" else 2)


class Odd(osik.Task):
    """A user's task whose annotations say little of how many axes its arrays have."""

    net: Callable[[Float[jax.Array, " n"]], Float[jax.Array, " m"]]
    both: tuple[Float[jax.Array, "3"], jax.Array]
    stiff: Float[jax.Array, ""] | eqx.Module
    unknown: Nothing  # noqa: F821  # pyright: ignore[reportUndefinedVariable]

    def rows(self, robot: osik.Robot, kinematics: osik.Kinematics, q: jax.Array) -> osik.TaskRows:
        jacobian = jax.numpy.eye(1, robot.nv)
        return osik.TaskRows.of(self.net(q[:3])[:1], jacobian, gain=self.gain, weight=jax.numpy.ones(1))


def test_annotations_of_ones_own_task_may_say_anything(arm: osik.Robot) -> None:
    net = eqx.nn.Linear(3, 2, key=jax.random.key(0))
    odd = Odd(net, jax.device_put((np.zeros(3), np.zeros((4, 4)))), net, None)
    assert int(osik.solve(arm, arm.q0, {"odd": odd, "posture": osik.PostureTask(arm)}).status) == 0
    stack = jax.vmap(lambda gain: odd.replace(gain=gain))(np.ones(2))
    refuses(ValueError, "tasks.* is a stack.*gain", osik.solve, arm, arm.q0, {"odd": stack})


def test_few_steps_are_kept(arm: osik.Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_plain_step, "_MOST", 4)
    _plain_step._kept.clear()
    for k in range(7):
        osik.solve(arm, arm.q0, {f"posture {k}": osik.PostureTask(arm)})
    assert [next(iter(kept._seen)) for kept in _plain_step._kept.values()] == [f"posture {k}" for k in range(3, 7)]
