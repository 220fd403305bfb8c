"""All solutions of a target: those that differ by more than whole turns, and their copies by turns."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from ._fixed import Explored
from ._turns import TURN, unwound

_SEPARATION = 0.1
"""Solutions that differ by less in every joint [rad or m] are one."""
_ISOLATED_SEPARATION = 0.01
"""The same where the solutions are isolated points, as most poses of an arm with six joints have them."""


@dataclasses.dataclass(frozen=True)
class Coordinates:
    """Entries of q that a search moves."""

    entries: np.ndarray  # their numbers
    turns: Bool[np.ndarray, " n"]  # whether a whole turn of each changes no pose
    lower: Float[np.ndarray, " n"]  # limits, -inf where free [rad or m]
    upper: Float[np.ndarray, " n"]  # likewise
    first: Float[np.ndarray, " n"]  # the configuration that solutions are near to


def all_solutions(explored: Explored, alone: Bool[np.ndarray, " targets"], own: Coordinates) -> dict[str, np.ndarray]:
    """Return the fields ``solutions``, ``count``, ``branches`` and ``isolated`` of the answers.

    The solutions are ``q`` first, then the other branches, then their copies by whole turns. ``alone``: whether each
    answer ``q`` is an isolated solution.
    """
    found, isolated = explored.found, np.asarray(explored.isolated)
    score, x, q = np.asarray(explored.outcomes.errors.score), np.asarray(explored.outcomes.x), np.asarray(found.q)
    rows = score.shape[1]
    solutions = np.full((*score.shape, q.shape[1]), np.nan, q.dtype)
    labels = np.zeros(score.shape, bool)
    counts, branches = np.zeros(len(q), np.int32), np.zeros(len(q), np.int32)
    for target in np.flatnonzero(np.asarray(found.converged)):
        # a score is the error over its tolerance, so up to 1 it is a solution
        good = score[target] <= 1.0
        near = unwound(x[target][good], own.first, own.lower, own.upper, own.turns)  # pyright: ignore
        solved = np.concatenate([q[target, own.entries][None], near])
        points = np.append(alone[target], isolated[target][good])
        kept = _distinct(solved, np.where(points, _ISOLATED_SEPARATION, _SEPARATION), own.turns)[:rows]
        distinct, labels[target, : len(kept)] = solved[kept], points[kept]
        every = np.concatenate([distinct, _copies(distinct, own, rows)])[:rows]
        branches[target], counts[target] = len(distinct), len(every)
        solutions[target, : len(every)] = q[target]
        solutions[target, : len(every), own.entries] = every.T
    return dict(solutions=solutions, count=counts, branches=branches, isolated=labels)


def _distinct(
    x: Float[np.ndarray, "k n"], separation: Float[np.ndarray, " k"], turns: Bool[np.ndarray, " n"]
) -> Int[np.ndarray, " m"]:
    """Return the first of each set of configurations that differ by less than their separation, modulo whole turns."""
    kept: list[int] = []
    left, columns, turn = np.arange(len(x)), np.ascontiguousarray(x.T), TURN * turns[:, None]
    while len(left):
        kept.append(int(left[0]))
        away = columns - columns[:, :1]
        away -= turn * np.rint(away / TURN)
        more = np.abs(away).max(0) > np.maximum(separation, separation[0])
        left, columns, separation = left[more], columns.compress(more, 1), separation[more]
    return np.array(kept)


def _copies(branches: Float[np.ndarray, "k n"], own: Coordinates, most: int) -> Float[np.ndarray, "m n"]:
    """Return other configurations by whole turns of joints within limits, those near the first configuration first.

    A joint without limits has no copies: there is no end to them.
    """
    joints = np.flatnonzero(own.turns & np.isfinite(own.lower) & np.isfinite(own.upper))
    here, unit = branches[:, joints, None], np.eye(len(own.first), dtype=branches.dtype)[joints]
    lower, upper = own.lower[joints, None], own.upper[joints, None]
    fewest, greatest = np.ceil((lower - here) / TURN), np.floor((upper - here) / TURN)
    choices = (greatest - fewest).max((0, 2), initial=0).astype(int) + 1
    moved = (TURN * (fewest + np.arange(choices.max(initial=1)))).astype(branches.dtype)
    # not by their numbers: a sum that is rounded may be outside
    moved[(here + moved < lower) | (here + moved > upper)] = np.nan
    copies = branches[:, None]
    for at in np.flatnonzero(choices > 1):
        turned = moved[:, None, at, : choices[at], None] * unit[at]
        copies = (copies[:, :, None] + turned).reshape(len(branches), -1, len(own.first))
        if copies.shape[1] > most:
            copies = _nearest(copies, own, most)
    every = copies[(copies != branches[:, None]).any(-1) & np.isfinite(copies[..., 0])]
    return every[np.argsort(((every - own.first) ** 2).sum(1), kind="stable")]


def _nearest(x: Float[np.ndarray, "k m n"], own: Coordinates, most: int) -> Float[np.ndarray, "k most n"]:
    """Return the ``most`` copies of each branch that are nearest to the first configuration; those of NaN are last."""
    away = np.linalg.norm(x - own.first, axis=-1)
    return np.take_along_axis(x, np.argsort(away, 1, kind="stable")[:, :most, None], 1)
