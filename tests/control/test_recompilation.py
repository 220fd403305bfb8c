"""Changing a number compiles nothing; changing structure compiles once."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import Compilations
from task_checks import kinematics_at

import osik_jax as osik

STEPS = 4
SCHEMES = {
    "weighted": (osik.WeightedQP(), osik.WeightedQP(damping=1e-3, curvature_damping=0.5)),
    "null-space": (
        osik.NullSpace(),
        osik.NullSpace(damping=1, potential_gain=0, margin=0.1, rank_tolerance=1e-8, curvature_damping=0.5),
    ),
    "hierarchical": (osik.HierarchicalQP(), osik.HierarchicalQP()),
}
all_schemes = pytest.mark.parametrize("name", SCHEMES)


@pytest.fixture(autouse=True, scope="module")
def nothing_is_compiled_yet():
    """Whatever other files have left in this process."""
    jax.clear_caches()


@pytest.fixture(scope="module")
def home(arm):
    return tuple(map(np.asarray, kinematics_at(arm, arm.q0).frame_pose(arm, "hand")))


def first_numbers(robot, home):
    tasks = {
        "hand": osik.FrameTask(robot, "hand", target=home, gain=osik.AdaptiveGain(20.0, 5.0, 3.0)),
        "com": osik.ComTask(robot, lower=-1.0, upper=[0.2, 0.3, 0.4], priority=2),
        "posture": osik.PostureTask(robot, weight=1e-3, priority=3),
    }
    return robot.q0, tasks, (osik.ConfigurationLimit(robot), osik.VelocityLimit(robot)), 0.005


def other_numbers(robot, home):
    """At construction or by ``replace``, as Python numbers, NumPy and JAX arrays; the dict in another order."""
    p, R = home
    hand = osik.FrameTask(
        robot,
        "hand",
        target=(p + 0.1, R),
        target_velocity=[0.1, 0, 0, 0, 0, 0],
        weight=3,
        position_weight=np.float32(2.0),
        gain=osik.AdaptiveGain(jnp.asarray(30), 4, np.float64(1.0)),
    )
    tasks = {
        "posture": osik.PostureTask(robot, target=robot.q0 + 0.1, weight=2, gain=1, priority=3),
        "com": osik.ComTask(robot, lower=[-2, -2, 0], upper=1, weight=7, priority=2).replace(lower=-3, gain=2),
        "hand": hand.replace(target=np.eye(4), orientation_weight=0),
    }
    limits = [
        osik.ConfigurationLimit(robot, upper={"joint1": 1}, lower={"joint1": -1}),
        osik.VelocityLimit(robot, velocity=np.full(robot.nv, 2)),
    ]
    return np.array(robot.q0) + 0.2, tasks, limits, jnp.asarray(0.01)


def longer(robot):
    return eqx.tree_at(lambda r: r.body_position, robot, robot.body_position * 1.1)


@pytest.mark.variants(release=["hierarchical", "weighted"])
@all_schemes
def test_a_step_compiles_once(arm, home, name):
    before, after = SCHEMES[name]

    def step(robot, scheme, q, tasks, limits, dt):
        return osik.solve(robot, q, tasks, scheme=scheme, limits=limits, dt=dt)

    with Compilations() as first:
        a = step(arm, before, *first_numbers(arm, home))
    # the core's step takes the rows of some tasks from a program
    assert first.names == ["jit(given)", "jit(unpacked)"] or first.names.count("jit(step)") == 1
    stretched, numbers = longer(arm), other_numbers(arm, home)
    with Compilations() as second:
        b = step(stretched, after, *numbers)
        c = step(arm, after, *numbers[:3], 1)
    assert second.names == []
    assert np.abs(a.velocity - b.velocity).max() > 1e-3
    assert np.abs(c.velocity - b.velocity).max() > 1e-6


@pytest.mark.variants(release=["hierarchical", "null-space"], slow=["weighted"])
@pytest.mark.parametrize(
    "name", ["weighted", *(pytest.param(name, marks=pytest.mark.slow) for name in list(SCHEMES)[1:])]
)
def test_a_rollout_compiles_once(arm, home, name):
    before, after = SCHEMES[name]

    def run(robot, scheme, q, tasks, limits, dt, targets, feedback):
        options: dict[str, Any] = dict(limits=limits, dt=dt, targets={"posture": targets}, feedback=feedback)
        return osik.rollout(robot, q, tasks, scheme=scheme, steps=STEPS, **options)

    zeros, noise = np.zeros((STEPS, arm.nq)), 0.1 * np.ones((STEPS, arm.nq))
    with Compilations() as first:
        a = run(arm, before, *first_numbers(arm, home), zeros, noise)
    assert first.names.count("jit(_rollout)") == 1
    stretched, numbers = longer(arm), other_numbers(arm, home)
    with Compilations() as second:
        b = run(stretched, after, *numbers, noise, jnp.asarray(zeros))
    assert second.names == []
    assert np.abs(a.q - b.q).max() > 1e-3


class Push(eqx.Module):
    """A task that follows time, with numbers of its own: an array, a NumPy array and a float."""

    task: osik.Task
    start: np.ndarray
    speed: float

    def __call__(self, t):
        return {"posture": self.task.replace(target=self.start + self.speed * t)}


class Drift(eqx.Module):
    """Feedback with a number of its own."""

    amount: float

    def __call__(self, t, q):
        return q + self.amount * t


def test_callables_that_are_pytrees_may_change_their_numbers(arm):
    def run(speed, start, amount):
        tasks = Push(osik.PostureTask(arm, weight=1.0), start, speed)
        scheme = osik.WeightedQP()
        return osik.rollout(
            arm, arm.q0, tasks, scheme=scheme, dt=0.01, steps=STEPS, feedback=Drift(amount), limits=osik.no_limits
        ).q

    a = run(0.1, np.zeros(7), 0.0)
    with Compilations() as count:
        b = run(0.5, np.ones(7), 0.3)
    assert count.names == []
    assert np.abs(a - b).max() > 1e-3
