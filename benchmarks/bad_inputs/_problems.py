"""Problems, limits, and what is seen only inside a program."""

# pyright: reportArgumentType=false
from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import osik_jax as osik
from osik_jax.collision import robot_shapes

from ._given import (
    OK,
    Add,
    H,
    K,
    N,
    T,
    V,
    W,
    arm,
    hand,
    nao,
    posture,
    reach,
    rollout,
    solve,
    status_in_a_program,
    warm,
)


def _held_twice() -> osik.Scene:
    held = osik.Scene({"can": osik.CollisionShape.sphere(0.1)}).attach("can", arm(), "hand")
    return held.attach("can", arm(), "hand")


def problems(add: Add) -> None:
    add("no task", lambda: solve({}), V, "PostureTask")
    add("a list of tasks", lambda: solve([posture()]), T, "dict")
    add("a task without a name", lambda: solve(posture()), T, "dict")
    add("a task's class", lambda: solve({"p": osik.PostureTask}), T, "the class PostureTask")
    add("numbers for names", lambda: solve({1: posture(), 2: hand()}), T, "strings")
    add("names of two types", lambda: solve({1: posture(), "a": hand()}), T, "strings")
    add("a function of time in solve", lambda: solve(lambda t: {"p": posture()}), T, "dict")
    add(
        "a frame task of another robot", lambda: solve({"hand": osik.FrameTask(nao(), "l_gripper")}), V, "another robot"
    )
    add("a posture of another robot", lambda: solve({"p": osik.PostureTask(nao())}), V, "another robot")
    add("a centre of mass of another robot", lambda: solve({"com": osik.ComTask(nao())}), V, "another robot")
    add("a function of time that returns no tasks", lambda: rollout(lambda t: posture(), steps=2), T, "dict")
    add("the scheme's class", lambda: solve(scheme=W), T, "WeightedQP()")
    add("scheme='weighted'", lambda: solve(scheme="weighted"), T, "WeightedQP()")
    add("damping 0", lambda: W(damping=0.0), V, "positive")
    add("a negative damping", lambda: N(damping=-1.0), V, "not negative")
    add("a damping for each joint", lambda: W(damping=np.ones(7)), V, "scalar")
    add("max_iterations=10.0", lambda: W(max_iterations=10.0), V, "integer")
    add("max_iterations=-1", lambda: H(max_iterations=-1), V, "integer")
    add("a method that does not exist", lambda: N(method="backward"), V, "reverse")
    add("dt 0", lambda: solve(dt=0.0), V, "positive")
    add("dt negative", lambda: solve(dt=-0.01), V, "positive")
    add("dt NaN", lambda: solve(dt=np.nan), V, "finite")
    add("dt='5ms'", lambda: solve(dt="5ms"), T, "seconds")
    add("dt=None", lambda: solve(dt=None), T, "seconds")
    add("two dts", lambda: solve(dt=np.full(2, 0.01)), V, "jax.vmap")
    add(
        "a warm start of another problem",
        lambda: solve({"h": hand()}, warm_start=jnp.zeros(31, int)),
        V,
        "another problem",
    )
    add(
        "a hierarchy's warm start for a weighted QP",
        lambda: solve({"h": hand()}, warm_start=warm(H())),
        V,
        "that of another problem or scheme",
        foreign=True,
    )
    add(
        "a hierarchy's warm start with other tasks",
        lambda: solve({"h": hand(), "p": posture(priority=2)}, scheme=H(), warm_start=warm(H())),
        V,
        "that of another problem or scheme",
        foreign=True,
    )
    add("a warm start for a null space", lambda: solve({"h": hand()}, scheme=N(), warm_start=warm(W())), V, "NullSpace")
    add("warm_start=True", lambda: solve(warm_start=True), T, "Solution")
    add("a Solution for a warm start", lambda: solve(warm_start=reach()), T, "Solution")
    add("steps -1", lambda: rollout(steps=-1), V, "integer")
    add("steps 10.0", lambda: rollout(steps=10.0), V, "integer")
    add(
        "9 targets for 10 steps",
        lambda: rollout(steps=10, targets={"hand": (np.zeros((9, 3)), np.zeros((9, 3, 3)))}),
        V,
        "10",
    )
    add(
        "targets of a task that does not exist",
        lambda: rollout(steps=10, targets={"foot": np.zeros((10, 3))}),
        K,
        "hand",
    )
    add("targets a list", lambda: rollout(steps=10, targets=[np.zeros((10, 3))]), T, "dict")
    add("feedback of another length", lambda: rollout(steps=10, feedback=np.zeros((10, 6))), V, "(10, 7)")
    add(
        "a verdict with a tolerance of 0",
        lambda: osik.explain_step(arm(), arm().q0, {"p": posture()}, position_tolerance=0.0),
        V,
        "positive",
    )
    add(
        "a verdict inside jit",
        lambda: jax.jit(lambda q: osik.explain_step(arm(), q, {"p": posture()}))(arm().q0),
        V,
        "outside of jit",
    )


def limits(add: Add) -> None:
    add(
        "a speed of a joint that does not exist",
        lambda: osik.VelocityLimit(arm(), velocity={"jont1": 1.0}),
        K,
        "joint1",
    )
    add("a negative speed", lambda: osik.VelocityLimit(arm(), velocity={"*": -1.0}), V, "joint1 (-1.0)")
    add("a speed of 'fast'", lambda: osik.VelocityLimit(arm(), velocity={"*": "fast"}), T, "'fast'")
    add(
        "a lower limit above the upper",
        lambda: osik.ConfigurationLimit(arm(), lower={"joint1": 1.0}, upper={"joint1": -1.0}),
        V,
        "joint1 (1.0 > -1.0)",
    )
    add(
        "a lower limit above the robot's upper",
        lambda: osik.ConfigurationLimit(arm(), lower={"joint1": 100.0}),
        V,
        "joint1",
    )
    add("one limit, no sequence", lambda: solve(limits=osik.VelocityLimit(arm())), T, "sequence")
    add("a dict of limits", lambda: solve(limits={"v": osik.VelocityLimit(arm())}), T, "sequence")
    add("a limit's class", lambda: solve(limits=(osik.VelocityLimit,)), T, "limits[0]")
    add("limits=(None,)", lambda: solve(limits=(None,)), T, "limits[0]")
    add("limits=3", lambda: solve(limits=3), T, "sequence")
    add("a limit of another robot", lambda: solve(limits=(osik.VelocityLimit(nao()),)), V, "another robot")
    add(
        "a limit of another robot as a task",
        lambda: osik.LimitTask(arm(), osik.VelocityLimit(nao())),
        V,
        "another robot",
    )
    add("no limit as a task", lambda: osik.LimitTask(arm(), 3.0), T, "Limit")
    add("an acceleration of 0", lambda: osik.AccelerationLimit(arm(), {"*": 0.0}), V, "joint1")
    add(
        "a barrier for a frame that does not exist",
        lambda: osik.PositionBarrier(arm(), "zz", upper=np.ones(3)),
        K,
        "hand",
    )
    add(
        "a barrier with nothing inside",
        lambda: osik.PositionBarrier(arm(), "hand", lower=np.ones(3), upper=-np.ones(3)),
        V,
        "lower > upper",
    )
    add(
        "collisions of a geom that does not exist",
        lambda: osik.CollisionAvoidanceLimit(arm(), pairs=[("zz", "link0:1")]),
        K,
        "link0:0",
    )
    add(
        "collisions of names, not of pairs",
        lambda: osik.CollisionAvoidanceLimit(arm(), pairs=["hand"]),
        T,
        "pairs of names",
    )
    add(
        "collisions of neighbours alone",
        lambda: osik.CollisionAvoidanceLimit(arm(), pairs=[("link1:0", "link2:[0]")]),
        V,
        "neighbouring",
    )
    ball = osik.CollisionShape.sphere(0.1)
    add("a scene from a list", lambda: osik.Scene([ball]), T, "name to CollisionShape")
    add("a scene beyond its capacity", lambda: osik.Scene({"a": ball, "b": ball}, capacity=1), V, "capacity is 1")
    add("a scene of numbers", lambda: osik.Scene({"a": 1.0}), T, "CollisionShapes")
    add("a scene with a NaN", lambda: osik.Scene({"a": osik.CollisionShape.sphere(0.1, [np.nan] * 3)}), V, "finite")
    add("an object that is not in the scene", lambda: osik.Scene({"can": ball}).moved("cam", np.eye(4)), K, "can")
    add("an object held twice", _held_twice, V, "detach")
    add("a box of words", lambda: osik.CollisionShape.box("abc"), T, "half_sizes is 'abc'")
    add("a scene of another kind of file", lambda: osik.Scene.from_file("scene.stl"), V, ".yaml")
    add("shapes of a robot without any", lambda: robot_shapes(arm()), V, "<collision>")


def in_programs(add: Add) -> None:
    status, bad = status_in_a_program(), OK.NUMERICAL_ERROR
    add("a traced weight of -1", lambda: status(weight=-1.0), None, status=bad)
    for dt in (0.0, -0.005, np.nan, np.inf):
        add(f"a traced dt of {dt}", lambda dt=dt: status(dt=dt), None, status=bad)
    add("a traced target that is NaN", lambda: status(place=np.nan), None, status=bad)
    add("a traced lower bound above the upper", lambda: status(lower=10.0), None, status=OK.INFEASIBLE)
