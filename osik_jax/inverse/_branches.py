"""All solutions of a target: those that differ by more than whole turns, and their copies by turns."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ._fixed import Outcomes
from ._solution import InverseKinematicsSolution
from ._turns import TURN, apart, unwound

_SEPARATION = 0.1
"""Solutions that differ by less in every joint [rad or m] are one."""
_ISOLATED_SEPARATION = 0.01
"""The same where the solutions are isolated points, as most poses of an arm with six joints have them."""


@dataclasses.dataclass(frozen=True)
class Coordinates:
    """Entries of q that a search moves.

    Attributes:
        entries: their numbers.
        turns: whether a whole turn of each changes no pose.
        lower: limits, -inf where free [rad or m].
        upper: likewise.
        first: the configuration that solutions are near to.
    """

    entries: np.ndarray
    turns: Bool[np.ndarray, " n"]
    lower: Float[np.ndarray, " n"]
    upper: Float[np.ndarray, " n"]
    first: Float[np.ndarray, " n"]


def with_all(
    found: InverseKinematicsSolution, outcomes: Outcomes, isolated: Bool[Array, "targets seeds"], own: Coordinates
) -> InverseKinematicsSolution:
    """Add the solutions that differ, ``q`` first, then the other branches, then their copies by whole turns."""
    score, x, q = np.asarray(outcomes.errors.score), np.asarray(outcomes.x), np.asarray(found.q)
    separation = np.where(isolated, _ISOLATED_SEPARATION, _SEPARATION)
    rows = score.shape[1]
    solutions = np.full((*score.shape, q.shape[1]), np.nan, q.dtype)
    alone = np.zeros(score.shape, bool)
    counts, branches = np.zeros(len(q), np.int32), np.zeros(len(q), np.int32)
    for target in np.flatnonzero(np.asarray(found.converged)):
        # a score is the error over its tolerance, so up to 1 it is a solution
        good = score[target] <= 1.0
        near = unwound(x[target][good], own.first, own.lower, own.upper, own.turns)  # pyright: ignore
        solved = np.concatenate([q[target, own.entries][None], near])
        # a further search has none of these starts: it found the only solution, so its separation does not matter
        at = np.append(np.minimum(found.seed[target], rows - 1), np.flatnonzero(good))
        kept = _distinct(solved, separation[target][at], own.turns)[:rows]
        distinct, alone[target, : len(kept)] = solved[kept], np.asarray(isolated)[target][at[kept]]
        every = np.concatenate([distinct, _copies(distinct, own, rows)])[:rows]
        branches[target], counts[target] = len(distinct), len(every)
        solutions[target, : len(every)] = q[target]
        solutions[target, : len(every), own.entries] = every.T
    return dataclasses.replace(
        found,
        solutions=jnp.asarray(solutions),
        count=jnp.asarray(counts),
        branches=jnp.asarray(branches),
        isolated=jnp.asarray(alone),
    )


def _distinct(
    x: Float[np.ndarray, "k n"], separation: Float[np.ndarray, " k"], turns: Bool[np.ndarray, " n"]
) -> Int[np.ndarray, " m"]:
    """Return the first of each set of configurations that differ by less than their separation, modulo whole turns."""
    kept: list[int] = []
    left = np.arange(len(x))
    while len(left):
        first = int(left[0])
        kept.append(first)
        left = left[apart(x[left], x[first], turns) > np.maximum(separation[left], separation[first])]
    return np.array(kept)


def _copies(branches: Float[np.ndarray, "k n"], own: Coordinates, most: int) -> Float[np.ndarray, "m n"]:
    """Return other configurations by whole turns of joints within limits, those near the first configuration first.

    A joint without limits has no copies: there is no end to them.
    """
    copies = branches[:, None]
    for at in np.flatnonzero(own.turns & np.isfinite(own.lower) & np.isfinite(own.upper)):
        number = np.arange(-(reach := int((own.upper[at] - own.lower[at]) // TURN)), reach + 1)
        turned = copies[:, :, None].repeat(len(number), 2)
        turned[..., at] += TURN * number
        inside = (turned[..., at] >= own.lower[at]) & (turned[..., at] <= own.upper[at])
        flat = turned.reshape(len(branches), -1, len(own.first)), inside.reshape(len(branches), -1)
        copies = _nearest(*flat, own, most)
    every = copies.reshape(-1, copies.shape[-1])
    others = ~(every[:, None] == branches).all(-1).any(1) & np.isfinite(every[:, 0])
    every = every[others]
    return every[np.argsort(np.linalg.norm(every - own.first, axis=1), kind="stable")]


def _nearest(
    x: Float[np.ndarray, "k m n"], inside: Bool[np.ndarray, "k m"], own: Coordinates, most: int
) -> Float[np.ndarray, "k some n"]:
    """Return at most ``most`` copies of each branch, nearest first; copies outside the limits become NaN, last."""
    away = np.where(inside & np.isfinite(x[..., 0]), np.linalg.norm(x - own.first, axis=-1), np.inf)
    kept = np.argsort(away, 1, kind="stable")[:, : min(most, int(np.isfinite(away).sum(1).max(initial=1)))]
    out = np.take_along_axis(x, kept[..., None], 1)
    return np.where(np.isfinite(np.take_along_axis(away, kept, 1))[..., None], out, np.nan)
