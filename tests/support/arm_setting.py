"""An arm with tasks, limits and schemes, and what it answers: what the tests of derivatives of steps share."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

import osik_jax as osik

DT = 0.01
SCHEMES = {
    "weighted": osik.WeightedQP(damping=1e-3),
    "null-space": osik.NullSpace(damping=1e-3),
    "hierarchical": osik.HierarchicalQP(damping=1e-3),
}


def arm_setting(arm, scheme):
    """A pose that conflicts with an inequality, an adaptive gain, speeds that bind: (robot, q, tasks, scheme, ...)."""
    gain = osik.AdaptiveGain(6.0, 2.0, 3.0)
    tasks = {
        "hand": osik.FrameTask(arm, "hand", target_velocity=0.1 * np.arange(6.0), gain=gain, position_weight=[2, 3, 4]),
        "elbow": osik.FrameTask(arm, "link4", rows="position", upper=[np.inf, -0.002, 0.1], gain=3.0, priority=2),
        "mass": osik.ComTask(arm, axes="xy", weight=2.0, gain=2.0, priority=2),
        "posture": osik.PostureTask(arm, weight=0.05, gain=1.0, priority=3),
    }
    limits = osik.ConfigurationLimit(arm), osik.VelocityLimit(arm, velocity={"*": 0.8})
    return arm, arm.q0, tasks, scheme, limits, jnp.asarray(DT)


def solve(setting):
    robot, q, tasks, scheme, limits, dt = setting
    return osik.solve(robot, q, tasks, scheme=scheme, limits=limits, dt=dt)


def answer(setting):
    s = solve(setting)
    return (s.velocity, s.slack, s.error), (s.status, s.warm_start)


def with_numbers(setting, q, place, gain):
    """The setting with a configuration, a place for the hand and a gain of its own."""
    robot, _, tasks, *rest = setting
    hand = tasks["hand"].replace(target=(place, tasks["hand"].target[1]))
    return (robot, q, {**tasks, "hand": hand, "mass": tasks["mass"].replace(gain=gain)}, *rest)
