"""A control step in one call of the core: beside plain JAX, its derivatives and certificates, and steps without it."""

import dataclasses
import re
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_checks import needs_core
from mujoco_states import mujoco_at
from step_checks import (
    DT,
    LANES,
    SCHEMES,
    arguments,
    assert_alike_where_numbers_are_not_valid,
    assert_answers_of_plain_jax,
    assert_close,
    assert_near_in_single_precision,
    assert_slopes_are_differences,
    by_core,
    frames_of,
    lanes_of,
    plain,
)
from task_checks import square

import osik_jax as osik
from osik_jax.control import _step
from osik_jax.control._checks import checked_limits
from osik_jax.core import _library
from osik_jax.execution._computed import side_by_side
from osik_jax.limits import with_own_limits
from osik_jax.solvers.qp import _core
from osik_jax.solvers.qp._problem import QP, LeastSquares, kkt_residual

pytestmark = needs_core


def mixed(robot: osik.Robot) -> dict[str, osik.Task]:
    """Equalities of every supported kind, at three priorities."""
    hand, root = frames_of(robot)
    near, rows = robot.joint_names[-1:], (True, True, False, False, True, True)
    return {
        "hand": osik.FrameTask(robot, hand, rows=rows, axes="frame", target_velocity=0.1 * np.ones(6)),
        "turn": osik.FrameTask(robot, hand, rows="orientation", orientation_jacobian="geometric", priority=2),
        "between": osik.RelativeFrameTask(robot, hand, root, position_weight=(1.0, 0.0, 2.0), gain=500.0, priority=2),
        "com": osik.ComTask(robot, axes="yx", weight=(3.0, 4.0), priority=2),
        "own": osik.PostureTask(robot, joints=near, weight=0.5, target_velocity=0.2, priority=2),
        "all": osik.PostureTask(robot, weight=1e-2, priority=3),
    }


def bounded(robot: osik.Robot) -> dict[str, osik.Task]:
    """Inequalities of every supported kind beside equalities."""
    hand, root = frames_of(robot)
    center = osik.center_of_mass(robot, osik.forward_kinematics(robot, robot.q0))[:2]
    polygon, weight = square(0.02), np.array([1.0, 2.0, 0.0, 1.0])
    polygon = dataclasses.replace(polygon, offsets=polygon.normals @ center + polygon.offsets)
    return {
        "com": osik.ComTask(robot, polygon=polygon, weight=weight, priority=1),
        "height": osik.ComTask(robot, axes="z", lower=-0.1, upper=0.1, priority=2),
        "box": osik.FrameTask(robot, root, rows="position", lower=(-0.01, -np.inf, -0.02), upper=0.01, priority=1),
        "range": osik.PostureTask(robot, joints=robot.joint_names[-2:], lower=-0.05, upper=np.inf, priority=2),
        "hand": osik.FrameTask(robot, hand, rows="position", priority=2),
        "all": osik.PostureTask(robot, weight=1e-3, gain=1.0, priority=3),
    }


def gazing(robot: osik.Robot) -> dict[str, osik.Task]:
    """Axes that point at points and along directions, ahead and behind, in the world and on the robot, and cones."""
    hand, root = frames_of(robot)
    look, align, aside = osik.LookAtTask, osik.AxisAlignTask, (1.0, 0.2, -0.3)
    behind = -np.asarray(align(robot, root, axis=aside).target)
    moving = np.array([0.1, -0.2, 0.3])
    return {
        "eye": look(robot, hand, axis=(2.0, 0.0, 0.0), target=(0.4, 0.3, 0.2), target_velocity=moving, weight=2.0),
        "carried": look(robot, root, target=(0.1, 0.3, 0.2), target_frame=hand, target_velocity=moving, priority=2),
        "seen": look(robot, hand, axis=aside, target_frame=root, half_angle=0.5, priority=2, weight=0.1),
        "behind": align(robot, root, axis=aside, target=behind + 0.1, target_velocity=moving, gain=0.2, priority=2),
        "level": align(robot, hand, axis=(0.0, 0.0, -1.0), target=(0.1, 0.0, 1.0), half_angle=0.3, weight=0.1),
        "along": align(robot, hand, axis=aside, target=aside, target_frame=root, target_velocity=moving, priority=2),
        "all": osik.PostureTask(robot, weight=1e-2, priority=3),
    }


def standing(robot: osik.Robot) -> dict[str, osik.Task]:
    hand, root = frames_of(robot)
    return {
        "foot": osik.FrameTask(robot, root),
        "hand": osik.FrameTask(robot, hand, priority=2, weight=0.1),
        "posture": osik.PostureTask(robot, priority=3),
    }


SETS = {"mixed": mixed, "bounded": bounded, "gazing": gazing, "standing": standing}
CASES = [(name, tasks) for name in ("arm7", "nao", "g1") for tasks in ("mixed", "bounded", "gazing")]


@pytest.mark.variants(
    ordinary=["arm7-bounded-weighted", "arm7-gazing-hierarchy", "nao-mixed-hierarchy"],
    slow=["arm7-bounded-null-space", "nao-mixed-saturated", "nao-gazing-weighted", "g1-gazing-null-space"],
)
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(("name", "tasks"), [*CASES, ("nao", "standing")])
def test_the_core_answers_as_plain_jax_does(name, tasks, scheme):
    robot = osik.load_robot(name)
    given = arguments(robot, SETS[tasks](robot), SCHEMES[scheme]())
    found, wanted = assert_answers_of_plain_jax(robot, given, 1e-12)
    if isinstance(given[1], osik.NullSpace):  # the residual is that of the first priority, met or not
        np.testing.assert_allclose(found.kkt_residual, wanted.kkt_residual, rtol=1e-9, atol=1e-9)
        # rounding decides in which of two orders joints that are at their bounds were saturated
        same = np.asarray(found.iterations == wanted.iterations) & np.asarray(
            found.factorizations == wanted.factorizations
        )
        assert same.mean() > 0.8
    else:
        assert float(jnp.abs(found.kkt_residual).max()) <= 1e-9


@pytest.mark.variants(slow=["weighted"], release=["hierarchy", "null-space", "saturated"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_in_single_precision_the_core_answers_within_its_roundoff(scheme):
    assert_near_in_single_precision("nao", mixed, scheme)


@pytest.mark.variants(slow=["weighted", "hierarchy"], release=["null-space", "saturated"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_derivatives_are_central_differences(scheme):
    robot = osik.load_robot("arm7")
    q = lanes_of(robot)[0]

    @jax.jit
    def cost(q: Any, point: Any, gain: Any) -> Any:
        hand, _ = frames_of(robot)
        tasks = {"hand": osik.FrameTask(robot, hand, rows="position", gain=gain).replace(target=point)}
        tasks |= {"rest": osik.PostureTask(robot, weight=0.1, priority=2)}
        return jnp.sum(osik.solve(robot, q, tasks, scheme=SCHEMES[scheme](), dt=DT).velocity ** 2)

    assert_slopes_are_differences(cost, q, jnp.array([0.4, 0.1, 0.5]), jnp.asarray(3.0))


@pytest.mark.variants(slow=["weighted"], release=["hierarchy", "null-space", "saturated"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_lane_that_is_not_valid_adds_nothing_to_a_derivative_by_what_lanes_share(scheme):
    robot = osik.load_robot("arm7")
    tasks = {"hand": osik.FrameTask(robot, frames_of(robot)[0]), "rest": osik.PostureTask(robot, priority=2)}

    @jax.jit
    @partial(jax.grad, has_aux=True)
    def gradient(shared: Any, q: Any, counts: Any) -> Any:
        moved = eqx.tree_at(lambda robot: robot.body_position, robot, shared)
        found = jax.vmap(lambda q: _step.step(moved, q, tasks, SCHEMES[scheme](), None, DT))(q)
        return jnp.sum(counts[:, None] * jnp.sin(found.velocity)), found.status

    q = lanes_of(robot)
    wanted, _ = gradient(robot.body_position, q, jnp.ones(LANES).at[3].set(0.0))
    found, status = gradient(robot.body_position, q.at[3, 2].set(jnp.nan), jnp.ones(LANES))
    assert float(jnp.abs(wanted).max()) > 1e-2 and int(status[3]) == 3
    assert_close(found, wanted, 1e-12 * float(jnp.abs(wanted).max()))


def test_robots_of_a_batch_turn_joints_by_any_angle_as_mujoco_does():
    """Rows of a batch are computed for several robots at once, with sines and cosines of its own."""
    robot = osik.load_robot("arm7")
    angles = jnp.asarray([1e-9, 0.3, -2.0, 40.0, -1e3, 9e4, 3e5, -1e9, 7.0])
    q = jnp.zeros((len(angles), robot.nq)).at[:, 1:5].set(angles[:, None])
    frame = robot.frame_names[-1]
    tasks = {"tip": osik.FrameTask(robot, frame, target=(jnp.zeros(3), jnp.eye(3)))}
    given = tasks, osik.WeightedQP(), (), jnp.asarray(DT), None
    found, _ = by_core(robot, q, *given)
    for lane in range(len(q)):
        data = mujoco_at(robot, np.asarray(q[lane]))
        place = data.body(frame) if frame in robot.body_names else data.site(frame)
        np.testing.assert_allclose(found.error["tip"][lane, :3], place.xpos, rtol=0.0, atol=1e-12)


@pytest.mark.variants(ordinary=[], slow=["mixed-weighted", "bounded-null-space", "gazing-hierarchy"])
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("tasks", [mixed, bounded, gazing])
def test_numbers_that_are_not_valid_are_answered_as_by_plain_jax(tasks, scheme):
    robot = osik.load_robot("arm7")
    given = robot, lanes_of(robot)[0], *arguments(robot, tasks(robot), SCHEMES[scheme]())
    assert_alike_where_numbers_are_not_valid(given, scheme)


def test_gaze_at_the_edges_of_its_formulas_is_that_of_plain_jax():
    """Right ahead, nearly, around 120 degrees, nearly behind, where D is bounded, and a point that is too near."""
    robot, axis = osik.load_robot("arm7"), np.array([1.0, 0.0, 0.0])
    hand, _ = frames_of(robot)
    q = lanes_of(robot)[0]
    place, turn = (np.asarray(a) for a in osik.forward_kinematics(robot, q).frame_pose(robot, hand))
    angles = np.array([0.0, 1e-9, 1e-4, 0.0316, 0.0317, 1.0, 2.09, 2.1, 3.0, 3.05, 3.1415, np.pi - 1e-6])
    ways = np.stack([np.cos(angles), 0.6 * np.sin(angles), 0.8 * np.sin(angles)], -1) @ turn.T
    points = [*(place + 0.5 * ways), place + 0.9e-3 * ways[5], place + 1.1e-3 * ways[5], place]
    rest = osik.PostureTask(robot, weight=0.1)

    def answers(step: Any, task: osik.Task, targets: Any) -> osik.Solution:
        def answer(target: Any) -> osik.Solution:
            tasks = {"gaze": task.replace(target=target), "rest": rest}
            return step(robot, q, *arguments(robot, tasks, osik.WeightedQP()))

        return jax.jit(jax.vmap(answer))(jnp.stack(targets))

    for half_angle in (None, 0.2):
        look = osik.LookAtTask(robot, hand, axis=axis, target=points[0], half_angle=half_angle)
        along = osik.AxisAlignTask(robot, hand, axis=axis, target=ways[0], half_angle=half_angle)
        for task, targets in ((look, points), (along, ways)):
            found, wanted = (answers(step, task, targets) for step in (_step._compiled_step, _step._plain_step))
            np.testing.assert_array_equal(found.status, wanted.status)
            largest = jnp.abs(wanted.velocity).max(1, keepdims=True)
            assert (
                jnp.abs(found.velocity - wanted.velocity) <= 1e-9 * (1.0 + largest)
            ).all()  # rounding decides the way


SMALL = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <default><geom size="0.05" mass="1"/></default>
  <worldbody>
    <body><joint name="hip" axis="0 0 1" range="-1 1"/><geom/>
      <body pos="0 0 0.3"><joint name="lift" type="slide" axis="0 0 1" range="-0.2 0.2"/><geom/>
        <body pos="0.2 0 0.1">{ball}<geom/>
          <body name="tool" pos="0.3 0 0.1"><joint name="wrist" axis="0 1 0" range="-2 2"/><geom/>
            <body pos="0.2 0.1 0"><joint name="tip" axis="1 0 0"/><geom/></body></body></body></body></body>
  </worldbody>
  {equality}
</mujoco>
"""
MIMIC = '<equality><joint joint1="tip" joint2="wrist" polycoef="0.1 -2 0 0 0"/></equality>'


def variants(robot: osik.Robot) -> dict[str, tuple[dict[str, osik.Task], Any]]:
    """Tasks and limits at the edges of what is allowed."""
    tool = osik.FrameTask(robot, "tool", rows="position")
    rest = osik.PostureTask(robot, joints=["hip", "lift"], weight=0.1, priority=2)
    far = tool.replace(target=np.asarray(tool.target[0]) + 0.05)
    narrow = osik.ConfigurationLimit(robot, upper={"hip": -0.2}, gain=np.linspace(0.3, 1.0, robot.nv))
    speed = osik.VelocityLimit(robot, velocity={"hip": 0.3, "lift": 0.0})
    fast = osik.AccelerationLimit(robot, {"hip": 5.0, "lift": 2.0, "wrist": 3.0}, velocity={"hip": 0.1})
    return {
        "weight 0": ({"tool": far.replace(weight=0.0), "rest": rest}, osik.no_limits),
        "gain above 1 / dt": ({"tool": far.replace(gain=1e3), "rest": rest.replace(gain=900.0)}, osik.no_limits),
        "outside its range": ({"tool": far, "rest": rest}, [osik.no_limits, narrow, speed]),
        "accelerations": ({"tool": far, "rest": rest}, [osik.no_limits, speed, fast]),
        "one priority": ({"tool": far, "rest": eqx.tree_at(lambda t: t.weight, rest, rest.weight * 5)}, osik.no_limits),
        "part of the robot": (
            {"com": osik.ComTask(robot, subtree="tool", target=[0.5, 0.1, 0.5]), "rest": rest},
            osik.no_limits,
        ),
    }


@pytest.mark.variants(ordinary=[], slow=["mimic-hierarchy", "ball-null-space"])
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("kind", ["mimic", "ball", "locked"])
def test_edges_of_what_is_allowed_are_those_of_plain_jax(kind, scheme):
    ball = '<joint name="ball" type="ball"/>' if kind == "ball" else ""
    text = SMALL.format(ball=ball, equality=MIMIC if kind == "mimic" else "")
    robot = osik.Robot.from_mjcf(text, locked_joints={"tip": 0.4} if kind == "locked" else ())
    q = lanes_of(robot)
    for name, (tasks, limits) in variants(robot).items():
        given = tasks, SCHEMES[scheme](), with_own_limits(robot, checked_limits(robot, limits)), jnp.asarray(DT), None
        has_rows = kind == "ball" and any(type(limit) is osik.ConfigurationLimit for limit in given[2])
        if has_rows and scheme != "weighted":
            assert not _step.is_compiled(robot, q[0], *given), name
            continue
        assert _step.is_compiled(robot, q[0], *given), name
        found, done = by_core(robot, q, *given)
        wanted = plain(robot, q, *given)
        assert done.all(), name
        assert float(jnp.abs(wanted.velocity).max()) > 1e-3, name
        for field in ("velocity", "slack", "error"):
            assert_close(getattr(found, field), getattr(wanted, field), 1e-11)


@pytest.mark.variants(release=["saturated"])
@pytest.mark.parametrize("scheme", ["hierarchy", "saturated"])
def test_a_step_is_one_call_with_few_operations_around_it(scheme):
    robot = osik.load_robot("nao")
    tasks = standing(robot)
    hand = tasks["hand"]
    assert isinstance(hand, osik.FrameTask)
    rotation = jnp.asarray(np.asarray(hand.target[1]))

    def velocity(q: Any, point: Any) -> Any:
        aimed = tasks | {"hand": hand.replace(target=(point, rotation))}
        return osik.solve(robot, q, aimed, scheme=SCHEMES[scheme](), dt=DT).velocity

    text = jax.jit(velocity).lower(robot.q0, jnp.ones(3)).compile().as_text() or ""
    entry = text[text.index("ENTRY") :]
    operations = re.findall(r"= .*? (fusion|custom-call|conditional|while|copy|broadcast|concatenate)\(", entry)
    assert operations.count("custom-call") == 1 and len(operations) <= 4, operations
    # XLA makes place for the numbers of branches in every step, taken or not
    assert "conditional" not in text and "while" not in text and len(text.splitlines()) < 300


@pytest.mark.slow
def test_rows_of_limits_are_answered_as_by_plain_jax(rng):
    """Beside soft rows; with walls that are tight, contradict each other, or are not finite."""
    robot = osik.load_robot("arm7")
    hand, _ = frames_of(robot)
    tasks, scheme = bounded(robot), osik.WeightedQP()
    at = np.asarray(osik.forward_kinematics(robot, robot.q0).frame_pose(robot, hand)[0])
    wall = osik.PositionBarrier(robot, hand, lower=at - 0.01, upper=at + 0.01, gain=20.0)
    q = np.asarray(robot.q0) + 0.02 * rng.normal(size=(60, 7))

    def step(limits: Any, q: Any, lower: Any) -> Any:
        own = *limits, wall.replace(lower=lower)
        return robot, q, tasks, scheme, own, jnp.asarray(DT), None

    places = np.tile(at - 0.01, (60, 1))
    places[:10] += 0.5  # above the upper bounds
    places[10] = np.nan
    limits = with_own_limits(robot, None)
    found, wanted = (
        jax.jit(jax.vmap(lambda q, lower, f=f: f(*step(limits, q, lower))))(q, places)
        for f in (_step._compiled_step, _step._plain_step)
    )
    np.testing.assert_array_equal(found.status, wanted.status)
    assert np.bincount(found.status, minlength=4).min() == 0 and (np.bincount(found.status)[[0, 2, 3]] > 0).all()
    solved = np.asarray(found.status) == 0
    np.testing.assert_allclose(found.velocity[solved], wanted.velocity[solved], atol=1e-9)
    np.testing.assert_allclose(found.box_violation, wanted.box_violation, rtol=1e-6, atol=1e-9)
    assert found.warm_start.shape == wanted.warm_start.shape


def test_other_steps_take_the_plain_path():
    robot = osik.load_robot("arm7")
    hand, _ = frames_of(robot)
    own = {"hand": osik.FrameTask(robot, hand)}
    q, limits = robot.q0, with_own_limits(robot, None)

    def known(tasks: Any = own, scheme: Any = None, limits: Any = limits, warm: Any = None) -> bool:
        return _step.is_compiled(robot, q, tasks, scheme or osik.WeightedQP(), limits, jnp.asarray(DT), warm)

    assert known() and known(warm=jnp.zeros(7, int))
    assert not known({"hand": osik.FrameTask(robot, hand, hard=True)})
    assert known({"hand": osik.FrameTask(robot, hand, error="se3")})
    assert known(scheme=osik.NullSpace()) and known(scheme=osik.NullSpace(method="saturated"))
    assert not known(scheme=osik.WeightedQP(backend="jax")) and not known(scheme=osik.NullSpace(backend="jax"))
    with_rows = *limits, osik.PositionBarrier(robot, hand, lower=0.0)
    assert known(limits=with_rows) and known(limits=with_rows, warm=jnp.zeros(10, int))
    assert not known(limits=with_rows, scheme=osik.HierarchicalQP())
    assert not known(warm=jnp.zeros(8, int))


def test_the_residual_of_the_certificate_is_that_of_plain_jax(rng):
    batch, m, n, p, tolerance = 200, 6, 9, 4, 1e-12

    cost = LeastSquares(
        *(rng.normal(size=(batch, m, n)), rng.normal(size=(batch, m)), rng.uniform(0.1, 9.0, (batch, m))),
        *(rng.uniform(0.01, 1.0, (batch, n)), rng.normal(size=(batch, n))),
    )
    bounds = rng.uniform(0.05, 0.5, (batch, n + p))
    qp = QP(cost, rng.normal(size=(batch, p, n)), rng.uniform(0.1, 1.0, (batch, p)), -bounds, bounds)
    qp = jax.tree.map(jnp.asarray, qp)
    matrix, *others = jax.tree.leaves(qp)
    packed = side_by_side(*others)
    solved = _core.solve(qp, jnp.zeros((batch, n + p), int), jnp.full(batch, tolerance), 1000)
    # errors of 1e-16 to 1 in x, in a multiplier or in a label of every second problem
    size = 10.0 ** rng.uniform(-16.0, 0.0, batch) * (np.arange(batch) % 2)
    x = solved.x + size[:, None] * rng.normal(size=(batch, n)) * (np.arange(batch) % 3 == 0)[:, None]
    y = solved.row_multipliers + size[:, None] * rng.normal(size=(batch, p)) * (np.arange(batch) % 3 == 1)[:, None]
    active = jnp.where((np.arange(batch) % 6 == 5)[:, None] & (np.arange(n + p) == 3), 1, solved.active)
    residual = jax.jit(jax.vmap(kkt_residual))(qp, x, y, active)
    holds, own = _library.call(
        "weighted_qp_certificate",
        [((batch,), int), ((batch,), float)],
        *(matrix, packed, x, y, active, jnp.tile(jnp.array([tolerance, 1e-9]), (batch, 1))),
    )
    right = np.arange(batch) % 2 == 0
    assert np.asarray(holds, bool)[right].all() and np.mean(np.asarray(holds)[~right]) < 0.8
    assert (np.asarray(residual)[np.asarray(holds, bool)] <= 1e-9).all()
    np.testing.assert_allclose(own, residual, rtol=1e-6, atol=1e-15)
