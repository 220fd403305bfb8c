"""Problems, limits, and what is seen only inside a program."""

# pyright: reportArgumentType=false
from __future__ import annotations

from functools import cache
from typing import Any

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

_TRANSPOSED = np.eye(4) + np.outer([0.0, 0.0, 0.0, 1.0], [0.3, 0.0, 0.4, 0.0])


@cache
def ur5() -> osik.Robot:
    return osik.load_robot("ur5")


def _scene(**options: Any) -> osik.Scene:
    return osik.Scene({"can": osik.CollisionShape.sphere(0.1, [0.3, 0.5, 0.2])}, **options)


def _free(scene: Any = None, poses: Any = None, **options: Any) -> Any:
    poses = {"tool0": ([0.5, 0.1, 0.4], [0.0, 1.0, 0.0, 0.0])} if poses is None else poses
    return osik.inverse_kinematics(ur5(), poses, scene=_scene() if scene is None else scene, **options)


def _held_twice() -> osik.Scene:
    held = osik.Scene({"can": osik.CollisionShape.sphere(0.1)}).attach("can", arm(), "hand")
    return held.attach("can", arm(), "hand")


def _in_frame() -> osik.Scene:
    return osik.Scene({"can": osik.CollisionShape.sphere(0.1, frame="hand")})


def _scenes_for_targets() -> Any:
    poses = {"tool0": (np.tile([0.5, 0.1, 0.4], (3, 1)), np.tile([0.0, 1.0, 0.0, 0.0], (3, 1)))}
    return _free(osik.Scene.stack([_scene(), _scene()]), poses)


def _scenes_for_tasks() -> Any:
    return _free(osik.Scene.stack([_scene()]), {"p": osik.FrameTask(ur5(), "tool0")})


def _clearance_alone() -> Any:
    return osik.inverse_kinematics(ur5(), {"tool0": ([0.5, 0.1, 0.4], [0.0, 1.0, 0.0, 0.0])}, clearance=0.01)


def _apart(scene: Any, **options: Any) -> osik.CollisionAvoidanceLimit:
    return osik.CollisionAvoidanceLimit(ur5(), scene=scene, **options)


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
    add("a method that does not exist", lambda: N(method="backward"), V, "saturated")
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
    for size in ("a radius of -1", -1.0), ("a radius of 0", 0.0), ("a radius of NaN", np.nan):
        add(f"a ball with {size[0]}", lambda size=size: osik.CollisionShape.sphere(size[1]), V, "positive")
    add("a ball of a word", lambda: osik.CollisionShape.sphere("a"), T, "a size is 'a'")
    add("a hull of nothing", lambda: osik.CollisionShape.convex(None), T, "points is None")
    add("a mesh scaled by NaN", lambda: osik.CollisionShape.mesh((np.eye(4, 3), [[0, 1, 2]]), scale=np.nan), V, "scale")
    add("a box of 2 sizes", lambda: osik.CollisionShape.box([0.1, 0.1]), V, "half_sizes has shape (2,)")
    add("a cylinder without length", lambda: osik.CollisionShape.cylinder(0.1, np.zeros(3), np.zeros(3)), V, "length")
    add("a hull of one point", lambda: osik.CollisionShape.convex(np.zeros((1, 3))), V, "no convex hull")
    add("a mesh file that is not there", lambda: osik.CollisionShape.mesh("none.stl"), FileNotFoundError, "none.stl")
    add("a scene file that is not there", lambda: osik.Scene.from_file("none.xml"), FileNotFoundError, "none.xml")
    add("a shape of a frame in a scene", _in_frame, V, "attach")
    add("a capacity of -1", lambda: _scene(capacity=-1), V, "capacity")
    add("a capacity of '3'", lambda: _scene(capacity="3"), V, "capacity")
    add("an object moved to no pose", lambda: _scene().moved("can", np.zeros(2)), V, "pose")
    add("an object held by no frame", lambda: _scene().attach("can", arm(), "hnd"), K, "hand")
    add("an object let go that nobody holds", lambda: _scene().detach("can", arm(), arm().q0), V, "cannot be detached")
    add("contacts that are no pairs", lambda: _scene().allow("can"), T, "pairs of names")
    add("contacts of an unknown object", lambda: _scene().allow(("cam", "hand")), K, "can")
    add("an object held by no robot", lambda: _scene().attach("can", "arm", "hand"), T, "robot is 'arm'")
    add("a stack of nothing", lambda: osik.Scene.stack([None]), T, "scene is a NoneType")
    add("a stack of no scenes", lambda: osik.Scene.stack([]), V, "no scene")
    add("a stack of stacks", lambda: osik.Scene.stack([osik.Scene.stack([_scene()])]), V, "stack")
    add("an object of a stack moved", lambda: osik.Scene.stack([_scene()]).moved("can", np.eye(4)), V, "before")
    add("shapes for a scene", lambda: _free({"can": ball}), T, "Scene({name: shape})")
    add("a negative clearance", lambda: _free(clearance=-0.01), V, "0 or more")
    add("a clearance of a word", lambda: _free(clearance="a"), T, "clearance is 'a'")
    add("a tolerance of a word", lambda: _free(position_tolerance="a"), T, "a tolerance is 'a'")
    add("a key of 1.5", lambda: _free(key=1.5), T, "key is 1.5")
    add("a check of freedom with -1 m", lambda: osik.is_free(ur5(), np.zeros(6), _scene(), -1.0), V, "0 or more")
    add("a pose that is transposed", lambda: _free(poses={"tool0": _TRANSPOSED}), V, "is it transposed?")
    add("poses that are transposed", lambda: _free(poses={"tool0": _TRANSPOSED[None]}), V, "is it transposed?")
    add("positions of two numbers", lambda: _free(poses={"tool0": (np.zeros((2, 2)), np.zeros((2, 4)))}), V, "(n, 3)")
    add("clearance of q of words", lambda: osik.clearance(ur5(), "x", _scene()), T, "q is 'x'")
    add("a clearance for each target", lambda: _free(clearance=[0.0, 0.1]), V, "one number")
    add("a clearance without a scene", _clearance_alone, V, "scene")
    add("two scenes for three targets", _scenes_for_targets, V, "2 scenes and 3 targets")
    add("scenes for tasks", _scenes_for_tasks, V, "one scene for all targets")
    add("an SRDF that is not there", lambda: _free(srdf="none.srdf"), FileNotFoundError, "none.srdf")
    add("an SRDF of broken text", lambda: _free(srdf="<robot"), V, "broken XML")
    add("clearance of q of another length", lambda: osik.clearance(ur5(), np.zeros(7), _scene()), V, "6 entries")
    add("a limit with shapes for a scene", lambda: _apart({"can": ball}), T, "Scene({name: shape})")
    add("a limit with a stack of scenes", lambda: _apart(osik.Scene.stack([_scene()])), V, "jax.vmap")
    add("a limit with a scene and pairs", lambda: _apart(_scene(), pairs=[("*", "*")]), T, "scene.allow")
    add("a limit with an SRDF alone", lambda: _apart(None, srdf=True), T, "scene=osik_jax.Scene({})")
    add("shapes of a robot without any", lambda: robot_shapes(arm()), V, "<collision>")


def in_programs(add: Add) -> None:
    status, bad = status_in_a_program(), OK.NUMERICAL_ERROR
    add("a traced weight of -1", lambda: status(weight=-1.0), None, status=bad)
    for dt in (0.0, -0.005, np.nan, np.inf):
        add(f"a traced dt of {dt}", lambda dt=dt: status(dt=dt), None, status=bad)
    add("a traced target that is NaN", lambda: status(place=np.nan), None, status=bad)
    add("a traced lower bound above the upper", lambda: status(lower=10.0), None, status=OK.INFEASIBLE)
