"""Robots, tasks and steps that are right but for one thing."""

# pyright: reportArgumentType=false
from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import osik_jax as osik

W, H, N = osik.WeightedQP, osik.HierarchicalQP, osik.NullSpace
FAR = (np.array([0.3, 0.0, 0.5]), np.eye(3))
V, K, T, F = ValueError, KeyError, TypeError, FileNotFoundError
OK = osik.Status

Add = Callable[..., None]


@functools.cache
def nao() -> osik.Robot:
    return osik.load_robot("nao")


@functools.cache
def arm() -> osik.Robot:
    return osik.load_robot("arm7")


def posture(**options: Any) -> osik.PostureTask:
    return osik.PostureTask(arm(), **options)


def hand(**options: Any) -> osik.FrameTask:
    return osik.FrameTask(arm(), "hand", **options)


def solve(tasks: Any = None, q: Any = None, *, robot: osik.Robot | None = None, **options: Any) -> osik.Solution:
    """A step of the arm, or of another robot, which may be wrong in one thing."""
    robot = arm() if robot is None else robot
    tasks = {"posture": osik.PostureTask(robot)} if tasks is None else tasks
    return osik.solve(robot, robot.q0 if q is None else q, tasks, **options)


def rollout(tasks: Any = None, **options: Any) -> osik.Trajectory:
    tasks = {"hand": hand(rows="position")} if tasks is None else tasks
    return osik.rollout(arm(), arm().q0, tasks, **options)


def with_double_off(run: Callable[..., Any]) -> Any:
    """Double precision is switched off after robot and tasks were made."""
    tasks = {"posture": posture()}
    with jax.enable_x64(False):
        return run(tasks)


@functools.cache
def status_in_a_program() -> Callable[..., jax.Array]:
    """The status of a step whose numbers are all traced; compiled once."""
    own, limits = hand(rows="position", target=FAR), (osik.ConfigurationLimit(arm()),)
    bounded = posture(lower=-9.0, upper=9.0)

    @jax.jit
    def status(weight: float, dt: float, place: float, lower: float) -> jax.Array:
        task = own.replace(weight=weight, target=(jnp.full(3, place), np.eye(3)))
        tasks = {"hand": task, "within": bounded.replace(lower=lower)}
        return solve(tasks, dt=dt, limits=limits).status

    return lambda weight=1.0, dt=0.005, place=0.3, lower=-9.0: status(weight, dt, place, lower)


def warm(scheme: osik.Scheme) -> Any:
    """A warm start of a step with one task, of the right shapes."""
    shapes = jax.eval_shape(lambda: solve({"h": hand(target=FAR)}, scheme=scheme).warm_start)
    return jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)


def reach(
    q: Any = None, *, target: Any = None, gain: float = 10.0, speeds: Any = None, **options: Any
) -> osik.Solution:
    """A step of the arm, with the same program whatever the numbers."""
    limits = (osik.ConfigurationLimit(arm()), osik.VelocityLimit(arm(), velocity=speeds))
    task = hand(rows="position", target=FAR if target is None else target, gain=gain)
    return solve({"hand": task}, q, limits=limits, **options)


class OddRows(osik.Task):
    """A task whose Jacobian has three columns."""

    def rows(self, robot: osik.Robot, kinematics: osik.Kinematics, q: jax.Array) -> osik.TaskRows:
        return osik.TaskRows(*(jnp.zeros(shape) for shape in (2, (2, 3), 2, 2, 2)))


class NoRows(osik.Task):
    """A task that returns nothing."""

    def rows(self, robot: osik.Robot, kinematics: osik.Kinematics, q: jax.Array) -> Any:
        return None


class Fraction:
    """No number, with the same text at each run."""

    def __repr__(self) -> str:
        return "Fraction()"
