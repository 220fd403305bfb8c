"""Configurations, targets and tasks."""

# pyright: reportArgumentType=false
from __future__ import annotations

from functools import partial

import jax.numpy as jnp
import numpy as np

import osik_jax as osik

from ._given import Add, Fraction, K, NoRows, OddRows, T, V, arm, hand, nao, posture, rollout, solve, with_double_off


def configurations(add: Add) -> None:
    q = arm().q0
    add("q of 5 numbers for 7 joints", lambda: solve(q=q[:5]), V, "joint1, joint2")
    add("a batch of q without vmap", lambda: solve(q=jnp.tile(q, (4, 1))), V, "jax.vmap")
    add("q with a NaN", lambda: solve(q=q.at[0].set(jnp.nan)), V, "indices [0]")
    add("q of strings", lambda: solve(q=["a"] * 7), T, "7 numbers")
    add("q a dict", lambda: solve(q={"joint1": 0.0}), T, "7 numbers")
    add("q=None", lambda: osik.solve(arm(), None, {"p": posture()}), T, "7 numbers")
    add("a quaternion of zeros", lambda: solve(robot=nao(), q=nao().q0.at[3:7].set(0.0)), V, "floating_base")
    add("robot=None", lambda: osik.solve(None, q, {"p": posture()}), T, "load_robot")
    add("robot a name", lambda: osik.FrameTask("nao", "l_sole"), T, "load_robot")
    add("a robot's class", lambda: osik.forward_kinematics(osik.Robot, q), T, "load_robot")
    add(
        "two robots stacked, no vmap",
        lambda: osik.solve(osik.stack([arm(), arm()]), q, {"p": posture()}),
        V,
        "jax.vmap",
    )
    add("v of another robot", lambda: osik.integrate(arm(), q, np.zeros(31)), V, "(7,)")
    add("x64 switched off later, solve", lambda: with_double_off(solve), V, "robot.astype")
    add("x64 switched off later, rollout", lambda: with_double_off(partial(rollout, steps=2)), V, "robot.astype")
    add("astype(int)", lambda: arm().astype(int), T, "floating-point")


def targets(add: Add) -> None:
    nan = np.full(3, np.nan)
    add("target with a NaN", lambda: hand(target=(nan, np.eye(3))), V, "finite")
    add("target with a NaN, by replace", lambda: hand().replace(target=(nan, np.eye(3))), V, "finite")
    add("target at infinity", lambda: hand(target=(np.full(3, np.inf), np.eye(3))), V, "finite")
    add("a position for a pose", lambda: hand(target=np.zeros(3)), V, "(3, 3)")
    add("five numbers for a pose", lambda: hand(target=np.zeros(5)), V, "(4, 4)")
    add("a quaternion of zeros for a rotation", lambda: hand(target=(np.zeros(3), np.zeros(4))), V, "quaternion")
    add("a 4 x 4 matrix of ones", lambda: hand(target=np.ones((4, 4))), V, "0 0 0 1")
    add("a rotation of length 2", lambda: hand(target=(np.zeros(3), 2.0 * np.eye(3))), V, "R R' = I")
    add("a rotation of length 2, by replace", lambda: hand().replace(target=(np.zeros(3), 2.0 * np.eye(3))), V, "R R'")
    add("a reflection", lambda: hand(target=(np.zeros(3), np.diag([1.0, 1.0, -1.0]))), V, "det R = 1")
    add("an object that is not a pose", lambda: hand(target=Fraction()), T, "no pose")
    add("posture target of nv numbers", lambda: osik.PostureTask(nao(), target=np.zeros(31)), V, "(32,)")
    add("posture target with a NaN, by replace", lambda: posture().replace(target=np.full(7, np.nan)), V, "finite")
    add("centre of mass at NaN", lambda: osik.ComTask(nao(), target=nan), V, "finite")
    add(
        "a polygon and a target",
        lambda: osik.ComTask(nao(), polygon=osik.support_polygon(nao(), nao().q0, ("l_sole",)), target=np.zeros(3)),
        T,
        "polygon",
    )
    add(
        "a polygon of a frame without corners",
        lambda: osik.support_polygon(arm(), arm().q0, ("hand",)),
        V,
        "hand_corner_0",
    )
    add(
        "a margin that leaves nothing",
        lambda: osik.support_polygon(nao(), nao().q0, ("l_sole",), margin=1.0),
        V,
        "margin",
    )
    add("axes that do not exist", lambda: osik.ComTask(nao(), axes="xw"), V, "x, y and z")


def tasks(add: Add) -> None:
    add("a negative weight", lambda: hand(weight=-1.0), V, "not negative")
    add("a negative weight, by replace", lambda: hand().replace(weight=-1.0), V, "not negative")
    add("a weight that is NaN", lambda: hand(weight=np.nan), V, "NaN")
    add("four weights", lambda: hand(weight=np.ones(4)), V, "scalar")
    add("weight='high'", lambda: hand(weight="high"), T, "'high'")
    add("a negative gain", lambda: hand(gain=-1.0), V, "not negative")
    add("two gains", lambda: hand(gain=(1.0, 2.0)), V, "scalar")
    add("gain=None", lambda: hand(gain=None), T, "gain")
    add("a misspelt frame", lambda: osik.FrameTask(arm(), "hnd"), K, "did you mean 'hand'")
    add("a frame of another robot", lambda: osik.FrameTask(nao(), "tool0"), K, "l_ankle")
    add("frame=None", lambda: osik.FrameTask(arm(), None), K, "hand")
    add("a frame's number", lambda: osik.FrameTask(arm(), 3), K, "hand")
    add("a joint that does not exist", lambda: posture(joints=("elbow",)), K, "joint1")
    add("joints='joint1'", lambda: posture(joints="joint1"), T, "('joint1',)")
    add("joints=()", lambda: posture(joints=()), V, "joint1")
    add("joints=3", lambda: posture(joints=3), T, "names and globs")
    add("priority 0", lambda: hand(priority=0), V, "1 for the most important")
    add("priority 1.5", lambda: hand(priority=1.5), V, "integer")
    add("priority a JAX array", lambda: hand(priority=jnp.asarray(2)), V, "got Array(2", foreign=True)
    add("priority=True", lambda: hand(priority=True), V, "integer")
    add("priority, by replace", lambda: hand().replace(priority=2), T, "target, target_velocity")
    add("hard='yes'", lambda: hand(hard="yes"), T, "True")
    add("hard=None", lambda: hand(hard=None), T, "True")
    add("rows='pos'", lambda: hand(rows="pos"), V, "did you mean 'pose'")
    add("three booleans for rows", lambda: hand(rows=(True, True, False)), V, "six booleans")
    add("no row at all", lambda: hand(rows=(False,) * 6), V, "at least one true")
    add("axes='body'", lambda: hand(axes="body"), V, "'frame'")
    add("lower above upper", lambda: hand(lower=1.0, upper=-1.0), V, "lower > upper")
    add("a bound that is NaN", lambda: hand(lower=np.nan), V, "NaN")
    add("a bound that is NaN, by replace", lambda: hand(lower=0.0).replace(lower=np.nan), V, "NaN")
    add("a target and bounds", lambda: posture(target=arm().q0, lower=0.0), T, "not both")
    add("a function of one argument", lambda: osik.FunctionTask(arm(), lambda q: q), T, "(robot, kinematics, q)")
    add(
        "a function that returns a matrix",
        lambda: osik.FunctionTask(arm(), lambda r, k, q: jnp.eye(2)),
        V,
        "the function returns",
        foreign=True,
    )
    add("no function", lambda: osik.FunctionTask(arm(), 3.0), T, "(robot, kinematics, q)")
    add("a task of one's own, its Jacobian too narrow", lambda: solve({"own": OddRows()}), V, "expected (m, 7)")
    add("a task of one's own that returns nothing", lambda: solve({"own": NoRows()}), T, "TaskRows.of")
