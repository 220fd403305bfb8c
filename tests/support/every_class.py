"""One task and one limit of each class, and of some options, for the embedded arm."""

from __future__ import annotations

import jax
import numpy as np

import osik_jax as osik


def all_tasks(arm: osik.Robot) -> dict[str, osik.Task]:
    normals = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    corners = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    square = osik.SupportPolygon(*jax.device_put((normals, np.ones(4), corners)))
    return {
        "frame": osik.FrameTask(arm, "hand", gain=osik.AdaptiveGain(9.0, 2.0, 1.0), error="se3", priority=2),
        "bounds": osik.FrameTask(arm, "link4", rows="position", lower=-np.inf, upper=0.3, hard=True),
        "between": osik.RelativeFrameTask(arm, "hand", "link2"),
        "look": osik.LookAtTask(arm, "hand", target=[1.0, 0.0, 0.0]),
        "axis": osik.AxisAlignTask(arm, "hand", target=[0.0, 0.0, 1.0], half_angle=0.3),
        "com": osik.ComTask(arm, weight=[1.0, 2.0, 0.1]),
        "over": osik.ComTask(arm, polygon=square),
        "posture": osik.PostureTask(arm, weight={"joint1": 0.5}),
        "couple": osik.JointCouplingTask(arm, {"joint1": 1.0, "joint2": -1.0}, target=0.5),
        "velocity": osik.JointVelocityTask(arm, np.ones(7)),
        "damping": osik.DampingTask(arm),
        "smooth": osik.LowAccelerationTask(arm),
        "freeze": osik.FreezeTask(arm, joints=("joint3",), hard=True),
        "index": osik.ManipulabilityTask(arm, "hand"),
        "momentum": osik.AngularMomentumTask(arm),
        "energy": osik.KineticEnergyTask(arm),
        "contact": osik.ContactTask(arm, "hand"),
        "limit": osik.LimitTask(arm, osik.PositionBarrier(arm, "hand", upper=1.0), priority=3),
    }


def all_limits(arm: osik.Robot) -> list[osik.Limit]:
    hull = osik.CollisionShape.convex(np.random.default_rng(0).normal(size=(9, 3)), frame="hand")
    post = osik.CollisionShape.sphere(0.05, np.array([3.0, 0.0, 0.0]))
    return [
        osik.ConfigurationLimit(arm, gain=0.5),
        osik.VelocityLimit(arm, velocity={"*": np.inf}),
        osik.AccelerationLimit(arm, {"*": 5.0}),
        osik.PositionBarrier(arm, "hand", upper=(np.inf, 1.0, 2.0)),
        osik.CollisionAvoidanceLimit(arm, shapes={"hull": hull, "post": post}, pairs=[("hull", "post")]),
        osik.LinearLimit(arm, np.ones((1, 7)), upper=1.0),
        osik.no_limits,
    ]
