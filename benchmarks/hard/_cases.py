"""What is asked of a robot: paths of targets that no robot can follow, and one that it can."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from ..jumps import RADIUS, STEPS, in_ball
from ..workload import DT, Workload
from ._reach import farthest

CHUNK = 400
"""Steps of a chunk; a motion is so many or a multiple."""
BEYOND = 0.35
"""How far targets are out of reach [m]."""
OUTSIDE = 0.10
"""How far the stretched arm's target goes out of reach [m]."""
SEED = 7


SQUAT: Mapping[str, float] = {"g1": 0.10, "nao": 0.05}
"""Strokes that suit a robot [m]."""


@dataclasses.dataclass(frozen=True)
class Case:
    """Targets at each step, and which part of the motion is judged.

    Attributes:
        name: what it is called; those of the same kind have the same name.
        hand: targets of the hand. (steps, 3)
        com: targets of the centre of mass. (steps, 3)
        judged: the first step that is.
    """

    name: str
    hand: np.ndarray
    com: np.ndarray
    judged: int = 0


def without_turning(work: Workload, *, posture: bool) -> Workload:
    """The standard workload's robot and weights; the hand has a place and no orientation, a posture is there or not."""
    changed = dict(hand_rotation=0.0) | ({} if posture else dict(posture=0.0))
    return dataclasses.replace(work, costs=dataclasses.replace(work.costs, **changed))


def cases(work: Workload) -> list[Case]:
    """All that are for this robot: a squat needs feet."""
    found = [*_beyond(work), _jumps(work), _stretch(work), _inside(work)]
    return [*found, _squat(work)] if work.feet else found


def directions(work: Workload) -> np.ndarray:
    """Ahead, to the hand's side, up; unit vectors, (3, 3)."""
    side = -1.0 if work.hand_position[1] < 0.0 else 1.0
    rows = np.array([[1.0, 0.0, 0.2], [0.3, side, 0.1], [0.3, 0.3 * side, 1.0]])
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def _beyond(work: Workload) -> list[Case]:
    """Held for 4 s, judged in the last 2."""
    steps = 2 * CHUNK
    places = [farthest(work, u) + BEYOND * u for u in directions(work)]
    return [Case("beyond", _held(place, steps), _held(work.com_start, steps), CHUNK) for place in places]


def _jumps(work: Workload) -> Case:
    """Uniform in a ball around the hand's place at the start."""
    rng, steps = np.random.default_rng(SEED), 2 * CHUNK
    away = in_ball(rng, steps // STEPS, RADIUS[work.robot])
    path = np.repeat(work.hand_position + away, STEPS, axis=0)
    return Case("jumps", path, _held(work.com_start, steps))


def _stretch(work: Workload) -> Case:
    """In 3 s from the start to a place out of reach ahead, in 3 s back, then 2 s of rest."""
    u = directions(work)[0]
    away = farthest(work, u) + OUTSIDE * u - work.hand_position
    t = DT * np.arange(4 * CHUNK)
    share = _eased(t / 3.0) - _eased(t / 3.0 - 1.0)
    return Case("stretch", work.hand_position + share[:, None] * away, _held(work.com_start, len(t)))


def _inside(work: Workload) -> Case:
    """The standard workload's curve of the hand; judged after its first second."""
    steps = 2 * CHUNK
    path = np.array([work.hand_at(k) for k in range(steps)])
    return Case("inside", path, _held(work.com_start, steps), CHUNK // 2)


def _squat(work: Workload) -> Case:
    """The centre of mass goes down and up twice, higher than straight knees allow; judged in the second period."""
    t = DT * np.arange(2 * CHUNK)
    lift = -SQUAT[work.robot] * np.sin(np.pi * t)
    com = _held(work.com_start, len(t)) + lift[:, None] * np.array([0.0, 0.0, 1.0])
    hand = _held(work.hand_position, len(t)) + lift[:, None] * np.array([0.0, 0.0, 1.0])
    return Case("squat", hand, com, CHUNK)


def _held(place: np.ndarray, steps: int) -> np.ndarray:
    return np.tile(place, (steps, 1))


def _eased(s: np.ndarray) -> np.ndarray:
    """From 0 to 1 with no speed at both ends."""
    s = np.clip(s, 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)
