"""Batches of clips: padded to a shared length and solved side by side in one program."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from ..limits import Limit
from ._body import TouchGoal
from ._finish import follow
from ._goals import Goals, Weights
from ._person import Person
from ._plan import make_plan
from ._profile import Limb
from ._terms import Body, Bounds

LENGTHS = 16
"""Programs are compiled for multiples of this number of frames."""


class Solved(NamedTuple):
    """Results of both passes; for several clips every leaf has a leading axis."""

    q: Array
    off_plan: Array
    iterations: Array
    cost: Array


class Clip(NamedTuple):
    """One clip as arrays for planning."""

    person: Person
    frames: int
    goals: Goals
    start: np.ndarray
    bounds: Bounds
    dt: float
    touches: tuple[TouchGoal, ...] = ()

    @property
    def touching(self) -> tuple[Limb, ...]:
        """Return the pairs that are held together."""
        return tuple((touch.first, touch.second) for touch in self.touches)


def as_lane(clip: Clip, length: int) -> _Lane:
    """Return a clip as one lane of a batch, padded to ``length`` frames."""
    goals, start = padded(clip.goals, clip.start, length - len(clip.start))
    return jax.tree.map(np.asarray, (goals, start, clip.bounds, np.asarray(clip.dt)))


def shared_length(clip: Clip) -> int:
    """Return a padded length shared by clips of similar length: at most a quarter more, and few distinct values."""
    # steps of an eighth of the next power of two: at most a quarter is padding, with four lengths per doubling
    step = max(LENGTHS, (1 << (clip.frames - 1).bit_length()) // 8)
    return -(-clip.frames // step) * step


_Lane = tuple[Goals, Array, Bounds, Array]


@jax.jit
def solve_lane(
    lane: _Lane,
    body: Body,
    weights: Weights,
    limits: Sequence[Limit],
    max_iterations: Array,
    smoothness: Array | float = 0.0,
) -> Solved:
    goals, start, bounds, dt = lane
    plan = make_plan(body, goals, weights.smoother(smoothness, dt), bounds, start, max_iterations)
    q, off = follow(body.robot, plan.q, limits, dt)
    return Solved(q, off, plan.iterations, plan.cost)


@jax.jit
def solve_lanes(lanes: _Lane, *shared: Any) -> Solved:
    """Solve all lanes in one program; ``shared`` are the arguments of ``solve_lane`` after the lane."""
    return jax.vmap(lambda lane: solve_lane(lane, *shared))(lanes)


def padded(goals: Goals, start: Float[np.ndarray, "F nq"], more: int) -> tuple[Goals, Float[np.ndarray, "T nq"]]:
    """Return goals and first guess with ``more`` frames appended that do not count (``present`` is 0)."""
    frames = len(start)

    def longer(leaf: np.ndarray) -> np.ndarray:
        return np.concatenate([leaf, np.repeat(leaf[-1:], more, 0)])

    goals, start = jax.tree.map(longer, (goals, start))
    present = np.where(np.arange(frames + more) < frames, goals.present, 0.0).astype(start.dtype)
    return dataclasses.replace(goals, present=present, contact=goals.contact * present[:, None]), start
