"""Inputs that look wrong and are not, or that cannot be told from right ones."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

import osik_jax as osik
from osik_jax import raise_if_failed

from ._given import OK, Add, W, arm, hand, nao, posture, reach, rollout, solve
from ._models import JOINT_IN_MJCF, LIMIT, MESH, joint, link, mimics, mjcf, one_joint, two_joints, urdf


def accepted(add: Add) -> None:
    q, solved = arm().q0, OK.SOLVED
    add("q of integers", lambda: reach(np.zeros(7, int)), None, "they are numbers", status=solved)
    add(
        "a quaternion of length 2 in q",
        lambda: solve(robot=nao(), q=nao().q0.at[3:7].multiply(2.0)),
        None,
        "it is normalised",
        status=solved,
    )
    add(
        "a quaternion x y z w in q",
        lambda: solve(robot=nao(), q=nao().q0.at[3:7].set(jnp.array([0, 0, 0, 1.0]))),
        None,
        "it is a quaternion w x y z too: the robot lies on its back",
        status=solved,
    )
    add(
        "q outside its limits",
        lambda: reach(q + 10.0),
        osik.OsikWarning,
        "q is far outside the joints' ranges",
    )
    add("a 4 x 4 matrix for a target", lambda: hand(target=np.eye(4)), None, "a pose")
    add(
        "a target 1e300 m away",
        lambda: reach(target=(np.full(3, 1e300), np.eye(3))),
        None,
        "the limits hold all the same",
        status=solved,
    )
    add(
        "a posture target in degrees",
        lambda: posture(target=np.full(7, 90.0)),
        None,
        "targets may be outside the limits, which hold all the same",
    )
    add(
        "a gain above 2 / dt",
        lambda: reach(gain=1e6),
        osik.OsikWarning,
        "gain times dt is above 2",
    )
    add("priority of NumPy", lambda: hand(priority=np.int64(2)), None, "an integer")
    add("dt=1", lambda: reach(dt=1), osik.OsikWarning, "dt is in seconds")
    add("dt=5 where 5 ms are meant", lambda: reach(dt=5.0), osik.OsikWarning, "dt is in seconds")
    add("limits=None, no scheme", solve, None, "the robot's own limits, WeightedQP()", status=solved)
    add(
        "speeds of 0",
        lambda: reach(speeds={"*": 0.0}),
        None,
        "nothing moves",
        status=solved,
    )
    add(
        "max_iterations=0",
        lambda: reach(speeds={"*": 0.1}, scheme=W(max_iterations=0)),
        None,
        "the status says that the cap was met",
        status=OK.MAX_ITERATIONS,
    )
    add(
        "a warm start of wrong numbers",
        lambda: reach(warm_start=jnp.full(7, 99)),
        None,
        "it costs time only",
        status=solved,
    )
    add("steps 0", lambda: rollout(steps=0), None, "a path of one configuration")
    add(
        "a function that returns a number",
        lambda: osik.FunctionTask(arm(), lambda r, k, q: q[0]),
        None,
        "one row",
    )
    add("raise_if_failed of what is solved", lambda: raise_if_failed(reach()), None, "nothing to raise")
    add(
        "a chain of mimic joints",
        lambda: mimics("", '<mimic joint="j1"/>', '<mimic joint="j2" multiplier="2"/>'),
        None,
        "all follow the first",
    )
    add("a mimic joint times 0", lambda: mimics("", '<mimic joint="j1" multiplier="0"/>'), None, "it is locked")
    add("a revolute joint without a limit", lambda: one_joint(inner=""), None, "it has none")
    add("a continuous joint", lambda: one_joint(kind="continuous", inner=""), None, "it has no limit")
    add("an axis of length 2", lambda: one_joint(inner='<axis xyz="0 0 2"/>' + LIMIT), None, "it is normalised")
    add(
        "a mesh that is not there, not asked for",
        lambda: urdf(link("a", MESH), link("b"), joint("j", "a", "b")),
        None,
        "meshes are not read",
    )
    add(
        "a lock outside the limits",
        lambda: two_joints(locked_joints={"j1": 5.0}),
        None,
        "what does not move has no limits",
    )
    add("an MJCF with joints without names", lambda: mjcf(JOINT_IN_MJCF), None, "they are called joint0, joint1, ...")
