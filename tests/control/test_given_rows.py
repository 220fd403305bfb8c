"""Steps in one call of the core with rows that JAX has computed: beside plain JAX, and where numbers are not valid."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_checks import needs_core
from every_class import all_tasks
from jaxtyping import Array, Int
from small_robots import quietly
from step_checks import (
    DT,
    SCHEMES,
    arguments,
    assert_alike,
    assert_answers_of_plain_jax,
    assert_close,
    assert_near_in_single_precision,
    assert_slopes_are_differences,
    by_core,
    frames_of,
    lanes_of,
    plain,
)

import osik_jax as osik
from osik_jax.control import _step

pytestmark = needs_core

LOOP = """
<mujoco>
  <default><geom size="0.05" mass="1"/></default>
  <worldbody>
    <body name="a"><joint name="a" axis="0 1 0"/><geom/>
      <body name="b" pos="0.3 0 0"><joint name="b" axis="0 1 0"/><geom/>
        <body name="c" pos="0.3 0 0.1"><joint name="c" axis="0 1 0"/><geom/>
          <body name="tip" pos="0.2 0 0"><joint name="d" axis="0 0 1"/><geom/></body></body></body></body>
    <body name="e" pos="0.7 0 0"><joint name="e" axis="0 1 0"/><geom/></body>
  </worldbody>
  <equality><connect body1="c" body2="e" anchor="0.1 0 -0.1"/></equality>
</mujoco>
"""


class OwnTask(osik.Task):
    """A user's task: one row on two joints' speeds, without pull and levers."""

    wanted: Array

    def rows(self, robot: osik.Robot, kinematics: osik.Kinematics, q: Array) -> osik.TaskRows:
        jacobian = jnp.zeros((1, robot.nv)).at[0, :2].set(jnp.stack([jnp.cos(q[-1]), 1.0 + q[0]]))
        return osik.TaskRows(q[:1], jacobian, self.wanted, self.wanted, jnp.ones(1) * self.weight)


class OwnLimit(osik.Limit):
    """A user's box."""

    most: Array

    def box(self, robot: osik.Robot, q: Array, dt: Any) -> tuple[Array, Array]:
        upper = self.most * (2.0 + jnp.cos(q[: robot.nv]))
        return -upper, upper


def classes(arm: osik.Robot) -> dict[str, osik.Task]:
    """One task of each class that is no constraint, at three priorities."""
    soft = {name: task for name, task in all_tasks(arm).items() if not task.hard}
    own = {"own": OwnTask(jnp.array([0.1])), "function": osik.FunctionTask(arm, twisted, lower=-0.1, upper=0.2)}
    return soft | own | {"last": osik.PostureTask(arm, weight=0.1, priority=4)}


def twisted(robot: osik.Robot, kinematics: osik.Kinematics, q: Array) -> Array:
    position, rotation = kinematics.frame_pose(robot, frames_of(robot)[0])
    return jnp.stack([position[0] * q[-1], rotation[2, 0], jnp.sin(q[-2])])


def looking(robot: osik.Robot) -> dict[str, osik.Task]:
    """A few tasks of which JAX computes the rows beside those that the core knows."""
    hand, _ = frames_of(robot)
    return {
        "eye": osik.LookAtTask(robot, hand, axis=(1.0, 0.0, 0.0), target=(0.4, 0.3, 0.2), priority=2),
        "cone": osik.LookAtTask(robot, hand, axis=(1.0, 0.2, 0.0), half_angle=0.3, priority=2),
        "twist": osik.FunctionTask(robot, twisted, target=(0.1, 0.2, 0.3), priority=1, weight=(1.0, 0.0, 2.0)),
        "slow": osik.DampingTask(robot, weight=0.1, priority=2),
        "com": osik.ComTask(robot, weight=0.5, gain=osik.AdaptiveGain(9.0, 2.0, 1.0), priority=1),
        "hand": osik.FrameTask(robot, hand, rows="position", priority=2),
        "speeds": osik.LimitTask(robot, osik.VelocityLimit(robot, velocity=0.5 * robot.velocity_limit), priority=3),
        "all": osik.PostureTask(robot, weight=1e-2, priority=3),
    }


def closing(robot: osik.Robot) -> dict[str, osik.Task]:
    """A closed loop above what pulls it and a posture."""
    return {
        "loop": osik.EqualityConstraintTask(robot),
        "tip": osik.FrameTask(robot, "tip", rows="position", target=(0.9, 0.1, 0.3), priority=2),
        "rest": osik.PostureTask(robot, weight=0.1, priority=3),
    }


ROBOTS = {
    "classes": (lambda: osik.load_robot("arm7"), classes),
    "looking": (lambda: osik.load_robot("nao"), looking),
    "closing": (lambda: quietly(osik.Robot.from_mjcf, LOOP), closing),
}


@pytest.mark.variants(ordinary=[], slow=["classes-weighted", "closing-hierarchy"])
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("case", ROBOTS)
def test_the_step_with_rows_of_jax_is_that_of_plain_jax(case, scheme):
    load, tasks_of = ROBOTS[case]
    robot = load()
    given = arguments(robot, tasks_of(robot), SCHEMES[scheme]())
    found, wanted = assert_answers_of_plain_jax(robot, given, 1e-10)
    assert float(jnp.abs(wanted.velocity).max()) > 1e-2
    np.testing.assert_array_equal(found.status, wanted.status)


FIELDS = ("error", "jacobian", "lower", "upper", "weight", "pull", "levers", "curvature")


class SpoiledTask(osik.Task):
    """Two rows, with 0, NaN or an infinity added to the first entry of each field."""

    added: Int[Array, " fields"]
    bounded: bool = eqx.field(static=True)

    def rows(self, robot: osik.Robot, kinematics: osik.Kinematics, q: Array) -> osik.TaskRows:
        lower, upper = (jnp.array([-0.1, 0.0]), jnp.array([0.1, 0.2])) if self.bounded else (None, None)
        matrix, weight = jnp.eye(2, robot.nv, 1) + 0.1, jnp.array([2.0, 1.0])
        rows = osik.TaskRows.of(q[1:3] - 0.3, matrix, gain=jnp.asarray(2.0), weight=weight, lower=lower, upper=upper)
        numbers = jnp.array([0.0, jnp.nan, jnp.inf, -jnp.inf])[self.added]
        fields = {name: spoiled(getattr(rows, name), numbers[k]) for k, name in enumerate(FIELDS)}
        return dataclasses.replace(rows, **fields | ({} if self.bounded else {"upper": fields["lower"]}))


def spoiled(a: Array, number: Array) -> Array:
    return jnp.ravel(a).at[0].add(number).reshape(a.shape)


@pytest.mark.variants(ordinary=[], slow=["True-hierarchy"])
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("bounded", [False, True])
def test_rows_that_are_not_finite_fail_as_in_plain_jax_in_their_lane_alone(bounded, scheme):
    robot = osik.load_robot("arm7")
    rest = osik.PostureTask(robot, weight=0.1, priority=2)
    bad = SpoiledTask(jnp.zeros(len(FIELDS), int), bounded)
    given = robot, lanes_of(robot)[0], *arguments(robot, {"bad": bad, "rest": rest}, SCHEMES[scheme]())
    assert _step.is_compiled(*given)
    cases = [np.eye(len(FIELDS), dtype=int)[k] * kind for k in range(len(FIELDS)) for kind in range(4)]
    lanes = jax.tree.map(lambda a: jnp.broadcast_to(a, (len(cases), *jnp.shape(a))), given)
    assert_alike(eqx.tree_at(lambda lanes: lanes[2]["bad"].added, lanes, jnp.array(cases)), scheme)


@pytest.mark.slow
def test_a_limit_of_ones_own_without_rows_is_the_box_of_the_one_call():
    robot = osik.load_robot("arm7")
    chosen = {name: looking(robot)[name] for name in ("hand", "all")}
    tasks, scheme, limits, *rest = arguments(robot, chosen, osik.WeightedQP())
    own = tasks, scheme, (*limits, OwnLimit(jnp.asarray(0.02))), *rest
    q = lanes_of(robot)
    assert _step.is_compiled(robot, q[0], *own)
    found, done = by_core(robot, q, *own)
    assert done.all()
    assert_close(found.velocity, plain(robot, q, *own).velocity, 1e-11)
    assert float(jnp.abs(found.velocity).max()) <= 0.06


@pytest.mark.release
def test_in_single_precision_the_step_with_rows_of_jax_is_within_its_roundoff():
    assert_near_in_single_precision("nao", looking, "weighted")


@pytest.mark.slow
def test_derivatives_by_numbers_of_a_task_of_jax_are_central_differences():
    robot = osik.load_robot("arm7")
    tasks = {name: looking(robot)[name] for name in ("eye", "twist", "slow", "hand", "all")}

    @jax.jit
    def cost(q: Any, point: Any) -> Any:
        own = tasks | {"eye": tasks["eye"].replace(target=point)}
        return jnp.sum(osik.solve(robot, q, own, scheme=osik.WeightedQP(), dt=DT).velocity ** 2)

    assert_slopes_are_differences(cost, lanes_of(robot)[0], jnp.array([0.4, 0.1, 0.5]))


def test_a_step_with_rows_of_jax_has_no_search_beside_it_and_its_own_warm_start():
    robot = osik.load_robot("arm7")
    tasks = {name: looking(robot)[name] for name in ("twist", "slow", "speeds")}

    def solve(q: Any, warm_start: Any = None) -> osik.Solution:
        return osik.solve(robot, q, tasks, scheme=osik.WeightedQP(), dt=DT, warm_start=warm_start)

    program = jax.jit(solve)
    first = program(robot.q0)
    again = program(robot.q0, first.warm_start)
    assert int(again.status) == 0 and int(again.iterations) <= int(first.iterations)
    assert_close(again.velocity, first.velocity, 1e-12)
    text = program.lower(robot.q0, first.warm_start).compile().as_text() or ""
    assert 'custom_call_target="osik_step"' in text and "conditional" not in text and "while" not in text
