"""Every argument of every public class comes back from a file; one that is missing there has its default."""

from __future__ import annotations

import inspect
import json
from typing import Any

import equinox as eqx
import numpy as np
import pytest
from model_files import mjcf
from task_checks import square

import osik_jax as osik
from osik_jax.saving._parts import decode, encode, makes

with pytest.warns(osik.OsikWarning, match="EqualityConstraintTask"):
    ROBOT = osik.Robot.from_mjcf(mjcf("cart_with_a_loop"))
TURN = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
IMPORTANCE: dict[str, Any] = dict(weight=3.0, priority=2, hard=True)
COMMON: dict[str, Any] = dict(gain=osik.AdaptiveGain(9.0, 2.0, 1.0 / 3.0), **IMPORTANCE)
POSE: dict[str, Any] = dict(
    target=((0.1, 0.2, 0.3), TURN),
    target_velocity=np.arange(6) / 7.0,
    axes="frame",
    orientation_jacobian="geometric",
    position_weight=(1.0, 2.0, 3.0),
    orientation_weight=(0.3, 0.2, 0.1),
    **COMMON,
)
WITHIN: dict[str, Any] = dict(lower=-0.1, upper=0.7)
POINT: dict[str, Any] = dict(axis=(0.6, 0.0, 0.8), target_velocity=(0.1, 0.2, 0.3), half_angle=0.2, **COMMON)
SHAPES = {
    "stone": osik.CollisionShape.convex(np.random.default_rng(0).normal(size=(9, 3)), (3.0, 0.0, 0.0), TURN),
    "tool": osik.CollisionShape.capsule(0.01, (0.3, 0.0, 0.0), (0.4, 0.0, 0.0), frame="coupler"),
    "floor": osik.CollisionShape.half_space((0.0, 0.0, -2.0), (0.0, 0.6, 0.8)),
    "post": osik.CollisionShape.cylinder(0.1, (2.0, 0.0, 0.0), (2.0, 0.0, 1.0)),
}
BARRIER = osik.PositionBarrier(ROBOT, "coupler", lower=-5.0, upper=(4.0, 3.0, 2.0), normals=TURN, gain=3.0)
PARTS: list[tuple[type, list[Any], dict[str, Any]]] = [
    (osik.FrameTask, ["coupler"], POSE),
    (osik.FrameTask, ["coupler"], dict(rows=(True, False, True, False, False, True), error="se3", **WITHIN)),
    (osik.RelativeFrameTask, ["coupler", "wheel"], POSE),
    (osik.RelativeFrameTask, ["coupler", "wheel"], dict(rows="position", error="se3", **WITHIN)),
    (osik.LookAtTask, ["coupler"], dict(target=(3.0, 0.1, 0.2), target_frame="wheel", **POINT)),
    (osik.AxisAlignTask, ["coupler"], dict(target=(0.0, 0.6, 0.8), target_frame="wheel", **POINT)),
    (osik.ComTask, [], dict(target=(0.1, 0.2), target_velocity=(0.3, 0.4), axes="xy", subtree="crank", **COMMON)),
    (osik.ComTask, [], WITHIN),
    (osik.ComTask, [], dict(polygon=square(1.0))),
    (osik.PostureTask, [], dict(target=ROBOT.q0.at[8].set(0.3), target_velocity=(0.1, 0.2), joints=("c*",), **COMMON)),
    (osik.PostureTask, [], dict(joints=("crank",), **WITHIN)),
    (osik.JointCouplingTask, [{"crank": 1.0, "roll": -0.5}], dict(target=0.2, target_velocity=0.1, **COMMON)),
    (osik.JointCouplingTask, [{"coupler": 2.0}], WITHIN),
    (osik.JointVelocityTask, [(0.1, 0.2)], dict(joints=("roll", "crank"), **IMPORTANCE)),
    (osik.DampingTask, [], dict(joints=("roll",), **IMPORTANCE)),
    (osik.LowAccelerationTask, [], dict(velocity=np.arange(9) / 7.0, joints=("roll",), **IMPORTANCE)),
    (osik.FreezeTask, [], dict(joints=("coupler",), **IMPORTANCE)),
    (
        osik.ManipulabilityTask,
        ["coupler"],
        dict(
            target=0.2,
            target_velocity=0.1,
            rows=(1, 0, 1, 0, 0, 0),
            axes="frame",
            joints=("base", "coupler"),
            log=True,
            **COMMON,
        ),
    ),
    (osik.ManipulabilityTask, ["coupler"], dict(rows=(1, 0, 1, 0, 0, 0), **WITHIN)),
    (osik.AngularMomentumTask, [], dict(target=(0.1, 0.2), axes="xz", **IMPORTANCE)),
    (osik.AngularMomentumTask, [], WITHIN),
    (osik.KineticEnergyTask, [], IMPORTANCE),
    (
        osik.ContactTask,
        ["wheel"],
        dict(
            point=(0.0, 0.1, 0.2),
            normal=(0.3, -0.7, 0.2),
            offset=0.3,
            anchor=((0.1, 0.2, 0.3), TURN),
            axis=(0.6, 0.8, 0.0),
            **COMMON,
        ),
    ),
    (osik.ContactTask, ["wheel"], dict(contact="point", sliding=True)),
    (
        osik.WheelTask,
        ["wheel"],
        dict(radius=0.05, axis=(0.1, 0.6, -0.3), roller_angle=0.7, normal=(0.0, 0.1, 1.0), offset=0.2, **COMMON),
    ),
    (osik.EqualityConstraintTask, [], COMMON),
    (osik.LimitTask, [BARRIER], IMPORTANCE),
    (
        osik.ConfigurationLimit,
        [],
        dict(lower={"crank": -0.7}, upper={"crank": 0.9}, gain=0.3, return_speed={"crank": 0.2}),
    ),
    (osik.VelocityLimit, [], dict(velocity={"roll": 0.3})),
    (
        osik.AccelerationLimit,
        [{"crank": 3.0}],
        dict(velocity=np.arange(9) / 7.0, lower={"crank": -0.7}, upper={"crank": 0.9}, return_speed={"crank": 0.2}),
    ),
    (osik.LinearLimit, [np.arange(18.0).reshape(2, 9)], dict(lower=(-1.0, -np.inf), upper=(2.0, 3.0))),
    (osik.FloatingBaseVelocityLimit, [], dict(linear=(0.3, 0.2, 0.1), angular=0.5, axes="world", joint="base")),
    (
        osik.CollisionAvoidanceLimit,
        [],
        dict(
            shapes=SHAPES,
            pairs=[("tool", "stone"), ("tool", "floor"), ("tool", "post")],
            minimum_distance=0.03,
            detection_distance=0.4,
            gain=3.0,
            recovery_speed=0.1,
            max_pairs=2,
        ),
    ),
]
SCHEMES = [
    osik.WeightedQP(2e-6, max_iterations=7, curvature_damping=0.7, backend="jax"),
    osik.HierarchicalQP(9, damping=1e-6, curvature_damping=0.7, backend="jax"),
    osik.NullSpace(
        damping=1e-6,
        potential_gain=0.1,
        margin=0.2,
        rank_tolerance=1e-4,
        method="saturated",
        curvature_damping=0.7,
        backend="jax",
    ),
]
MADE = [cls(ROBOT, *first, **given) for cls, first, given in PARTS] + [BARRIER, osik.no_limits, *SCHEMES]


def test_every_public_class_and_argument_comes_back_and_a_missing_one_is_its_default():
    needed: dict[str, set[str]] = {}
    for part in MADE:
        data = json.loads(json.dumps(encode(part, ROBOT, "it")))
        assert eqx.tree_equal(decode(data, ROBOT, "it"), part), data
        own = needed.setdefault(type(part).__name__, set())
        own |= {name for name in data if not makes({n: v for n, v in data.items() if n != name}, ROBOT, part)}
    bases = (osik.Task, osik.Limit, osik.Scheme)
    public = {
        name: c for name, c in vars(osik).items() if inspect.isclass(c) and issubclass(c, bases) and c not in bases
    }
    assert needed.keys() - {"NoLimits"} == public.keys() - {"FunctionTask"}
    lost = {
        name: set(inspect.signature(c).parameters) - {"robot"} - needed[name]
        for name, c in public.items()
        if name in needed
    }
    # the model has one constraint and one free joint; a file names the pairs that are kept, and holds no scene
    same_as_default = {
        "EqualityConstraintTask": {"constraints"},
        "FloatingBaseVelocityLimit": {"joint"},
        "CollisionAvoidanceLimit": {"exclude", "q0_distance", "scene", "srdf"},
    }
    assert {name: own for name, own in lost.items() if own} == same_as_default


def test_rotations_and_directions_are_kept_to_the_last_bit_in_both_precisions(arm, rng):
    for robot in (arm, arm.astype("float32")):
        for _ in range(2):
            axis, normal = rng.normal(size=(2, 3))
            turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
            target = (rng.normal(size=3), turn * np.linalg.det(turn))
            parts = [
                osik.WheelTask(robot, "hand", radius=0.1, axis=axis, normal=normal),
                osik.ContactTask(robot, "hand", normal=normal, axis=axis),
                osik.FrameTask(robot, "hand", target=target),
                osik.LookAtTask(robot, "hand", axis=axis, target=normal),
                osik.PositionBarrier(robot, "hand", upper=1.0, normals=[axis, normal]),
                osik.CollisionAvoidanceLimit(
                    robot,
                    shapes={"wall": osik.CollisionShape.half_space(axis, normal)},
                    pairs=[("wall", "link7:0")],
                    q0_distance=-np.inf,
                ),
            ]
            for part in parts:
                assert eqx.tree_equal(decode(json.loads(json.dumps(encode(part, robot, "it"))), robot, "it"), part)
