"""Numbers of a motion from its configurations alone, by Pinocchio in float64."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from ..robots import pinocchio_model
from ..workload import DT, Workload
from ._motion import Motion

MOVING = 0.01
"""A joint slower than this stands still where changes of direction are counted [rad/s]."""
AT_TOP = 0.999
"""A joint that has this share of its top speed is at it."""
AT_RANGE = 1e-4
"""A joint nearer than this to an end of its range is at it [rad]."""


class Numbers(NamedTuple):
    """Of the judged steps of a motion.

    Attributes:
        rms: joint speed, root of the mean square over joints and steps [rad/s].
        fastest: the largest speed of a joint as a share of that joint's top speed.
        turns: changes of direction a second, of the joint with most; both speeds are above ``MOVING``.
        at_top: share of the steps with a joint at its top speed.
        at_range: share of the steps that end with a joint at an end of its range, or beyond it.
        feet: the largest distance of a foot from its place [m]; 0 without feet.
        hand: the largest distance of the hand from its target [m].
        hand_at_end: that distance after the last step [m].
        base: the fastest that the base moves [m/s], of the whole motion; 0 where it is fixed.
        solved: share of the steps of the whole motion that are solved.
        seconds: of a step, on average over the whole motion.
    """

    rms: float
    fastest: float
    turns: float
    at_top: float
    at_range: float
    feet: float
    hand: float
    hand_at_end: float
    base: float
    solved: float
    seconds: float


WORST_IS_LEAST = ("solved",)


def judged(work: Workload, motion: Motion) -> Numbers:
    """The numbers of one motion; infinite where a configuration is not finite."""
    if not np.isfinite(motion.path).all():
        return Numbers(**dict.fromkeys(Numbers._fields[:-2], np.inf), solved=motion.solved, seconds=motion.seconds)
    first = motion.case.judged
    speed, ends = joint_speeds(work, motion)[first:], _joints(work, motion)[first + 1 :]
    share = np.abs(speed) / work.velocity
    at_range = (ends < work.position_lower + AT_RANGE) | (ends > work.position_upper - AT_RANGE)
    feet, hand = _distances(work, motion)
    return Numbers(
        rms=float(np.sqrt(np.mean(speed**2))),
        fastest=float(share.max()),
        turns=float(_turns(speed).max() / (DT * len(speed))),
        at_top=float((share >= AT_TOP).any(axis=1).mean()),
        at_range=float(at_range.any(axis=1).mean()),
        feet=float(feet.max()),
        hand=float(hand.max()),
        hand_at_end=float(hand[-1]),
        base=float(np.linalg.norm(np.diff(motion.path[:, :3], axis=0), axis=1).max() / DT) if work.floating else 0.0,
        solved=motion.solved,
        seconds=motion.seconds,
    )


def joint_speeds(work: Workload, motion: Motion) -> np.ndarray:
    """Of each joint in each step [rad/s], (steps, joints)."""
    return np.diff(_joints(work, motion), axis=0) / DT


def _joints(work: Workload, motion: Motion) -> np.ndarray:
    return motion.path[:, 7 if work.floating else 0 :]


def worst(numbers: list[Numbers]) -> Numbers:
    """The worst of each over some motions."""
    return Numbers(*(
        (min if field in WORST_IS_LEAST else max)(values)
        for field, values in zip(Numbers._fields, zip(*numbers, strict=True), strict=True)
    ))  # fmt: skip


def _turns(speed: np.ndarray) -> np.ndarray:
    """How often each joint changes direction from one step to the next, (joints,)."""
    way = np.where(np.abs(speed) > MOVING, np.sign(speed), 0.0)
    return np.sum(way[1:] * way[:-1] < 0.0, axis=0)


def _distances(work: Workload, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Of the worst foot from its place and of the hand from its target, after each judged step; (steps,) each."""
    model = pinocchio_model(work.urdf, work.floating)
    data, first = model.createData(), motion.case.judged
    hand, feet = model.getFrameId(work.hand), [model.getFrameId(foot) for foot in work.feet]
    found = []
    for q, target in zip(motion.path[first + 1 :], motion.case.hand[first:], strict=True):
        q = q.copy()
        if work.floating:
            q[3:7] /= np.linalg.norm(q[3:7])
        pin.framesForwardKinematics(model, data, q)
        moved = [np.linalg.norm(data.oMf[i].translation - p) for i, p in zip(feet, work.foot_positions, strict=True)]
        found.append((max(moved, default=0.0), np.linalg.norm(data.oMf[hand].translation - target)))
    return tuple(np.array(found).T)
