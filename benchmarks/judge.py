"""How good a motion is, by Pinocchio in float64: a fast wrong answer has failed."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from .robots import pinocchio_model
from .workload import DT, Workload


class Bound(NamedTuple):
    """The most that a motion may show, and how it is written."""

    largest: float
    unit: str


BOUNDS = {
    "hand": Bound(6e-3, "m"),
    "hand_rotation": Bound(1.2e-2, "rad"),
    "feet": Bound(1e-3, "m"),
    "feet_rotation": Bound(2e-3, "rad"),
    "com": Bound(1e-3, "m"),
    "position_excess": Bound(1e-4, "rad"),
    "velocity_excess": Bound(1e-3, "rad/s"),
}
"""Largest errors after any step. The posture pulls at the hand: the exact weighted answer leaves 3.8 mm and 7 mrad on
G1, whoever computes it; the feet keep to 0.08 mm and the centre of mass to 0.8 mm."""


def judged(work: Workload, motion: np.ndarray, lane: int = 0) -> dict[str, float]:
    """The largest of each error over a motion.

    Args:
        work: what was asked for.
        motion: canonical configurations after each step, from the first step on. (steps, nq)
        lane: whose target it followed.

    Returns:
        By the names of ``BOUNDS``; infinite where a number is not finite.
    """
    if not np.isfinite(motion).all():
        return dict.fromkeys(BOUNDS, float("inf"))
    model = pinocchio_model(work.urdf, work.floating)
    data = model.createData()
    before, worst = work.start, dict.fromkeys(BOUNDS, 0.0)
    for step, q in enumerate(np.asarray(motion, float)):
        q = q.copy()
        if work.floating:
            q[3:7] /= np.linalg.norm(q[3:7])
        found = _tracking(work, model, data, q, step, lane) | _excess(work, before, q)
        worst = {name: max(worst[name], value) for name, value in found.items()}
        before = q
    return worst


def verdict(work: Workload, motions: np.ndarray) -> dict[str, Any]:
    """The largest errors of a row's motions (lanes, steps, nq), and what is worse than it may be."""
    scores = [judged(work, path, lane) for lane, path in enumerate(motions)]
    worst = {name: max(score[name] for score in scores) for name in BOUNDS}
    return dict(score=worst, failures=failures(worst))


def failures(score: dict[str, float]) -> list[str]:
    """What is worse than it may be; empty for a motion that counts."""
    return [
        f"{name} {score[name]:.2g} {bound.unit} > {bound.largest:g}"
        for name, bound in BOUNDS.items()
        if not score[name] <= bound.largest
    ]


def _tracking(
    work: Workload, model: pin.Model, data: pin.Data, q: np.ndarray, step: int, lane: int
) -> dict[str, float]:
    pin.framesForwardKinematics(model, data, q)
    hand = data.oMf[model.getFrameId(work.hand)]
    feet = [data.oMf[model.getFrameId(foot)] for foot in work.feet]
    com = pin.centerOfMass(model, data, q) if work.feet else work.com_at(step)
    moved = [np.linalg.norm(f.translation - p) for f, p in zip(feet, work.foot_positions, strict=True)]
    turned = [np.linalg.norm(pin.log3(f.rotation.T @ R)) for f, R in zip(feet, work.foot_rotations, strict=True)]
    return dict(
        hand=float(np.linalg.norm(hand.translation - work.hand_at(step, lane))),
        hand_rotation=float(np.linalg.norm(pin.log3(hand.rotation.T @ work.hand_rotation))),
        feet=float(max(moved, default=0.0)),
        feet_rotation=float(max(turned, default=0.0)),
        com=float(np.linalg.norm(com - work.com_at(step))),
    )


def _excess(work: Workload, before: np.ndarray, q: np.ndarray) -> dict[str, float]:
    """How far joints are outside their limits; 0 inside."""
    base = 7 if work.floating else 0
    joints, speed = q[base:], np.abs(q[base:] - before[base:]) / DT
    outside = np.maximum(work.position_lower - joints, joints - work.position_upper)
    return dict(
        position_excess=float(max(0.0, outside.max())),
        velocity_excess=float(max(0.0, (speed - work.velocity).max())),
    )
