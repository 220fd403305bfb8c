"""What a clip's plan is worked on with: whole numbers, numbers and memory, by name.

Structure and numbers are one array each, put together in ``retargeting/_plan_kernel.py``; so is the memory.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ._frame import compiled, matrix, vector, whole_numbers
from ._tiles import padded

ROWS = 61
"""Rows of a frame but for those of capsules and the floor: at most 16 of limbs, 3 and 12 of turns, 8 and 8 of soles, 1
of balance."""
POINTS = 8
"""Rows of standing points."""


class Structure(NamedTuple):
    """Whole numbers of a robot with its profile; ``counts`` as in ``retargeting/_plan_kernel.py``."""

    counts: np.ndarray
    parents: np.ndarray
    kinds: np.ndarray
    owners: np.ndarray
    source: np.ndarray
    columns: np.ndarray
    places: np.ndarray  # the body of each place
    joints: np.ndarray  # of each dof, where in q it is, or -1
    limbs: np.ndarray  # the two keypoints of each limb, and of the hips
    above: np.ndarray
    pairs: np.ndarray
    moves: np.ndarray  # whether each dof moves each body
    scalars: np.ndarray  # where numbers that simply add are in q, and then in v
    turns: np.ndarray  # where quaternions are in q, and then their rotations in v


class Numbers(NamedTuple):
    """Numbers of a robot with its profile, and of what is asked of it."""

    coefficient: np.ndarray
    offset: np.ndarray
    reference: np.ndarray
    body_at: np.ndarray
    body_along: np.ndarray
    joint_at: np.ndarray
    joint_along: np.ndarray
    factors: np.ndarray
    points: np.ndarray
    turns: np.ndarray
    home: np.ndarray
    radii: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    rest: np.ndarray
    step: np.ndarray
    change: np.ndarray
    mass_fractions: np.ndarray  # of each body in the robot's mass
    centers: np.ndarray  # where that is in the body
    wishes: np.ndarray


class Memory(NamedTuple):
    """Where a frame is worked on."""

    value: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    linear: np.ndarray
    angular: np.ndarray
    anchors: np.ndarray
    motion: np.ndarray
    masks: np.ndarray
    points: np.ndarray
    turned: np.ndarray
    line: np.ndarray
    near: np.ndarray  # numbers of the pairs that are too near, and how near
    spheres: np.ndarray  # around capsules: center and radius


class Goal(NamedTuple):
    """What a clip asks for, a row a frame."""

    directions: np.ndarray
    pelvis: np.ndarray
    torso: np.ndarray
    root: np.ndarray
    feet: np.ndarray
    contact: np.ndarray
    present: np.ndarray


(
    BODIES,
    JOINTS,
    VALUES,
    FULL,
    KEYS,
    CAPSULES,
    ABOVE,
    PAIRS,
    BENDS,
    MOST_PAIRS,
    ROOT,
    PLACES,
    STRAIGHT,
    LIMBS,
    SCALARS,
    TURNS,
    DOFS,
) = range(17)
COUNTS, WISHES = 17, 21
LIMB, PELVIS, TORSO, ROOT_X, ROOT_Y, ROOT_Z, FOOT, POSTURE, STANCE, APART, LIMIT, MARGIN, STIFFNESS, CLEARANCE = range(
    14
)
SWINGING, SHORTEST, SMOOTH, SMOOTH_BASE, SPEED, BALANCE, INSIDE = range(14, 21)


class Kept(NamedTuple):
    """Rows of a frame and of the one before it, in turn; entry 2 of what standing points do is nothing."""

    rows: np.ndarray
    points: np.ndarray
    weight: np.ndarray
    move: np.ndarray
    count: np.ndarray
    most: int


class Linearised(NamedTuple):
    """Gauss's and Newton's system of a clip. ``blocks`` are those on the diagonal, without ``alone``, times -1."""

    blocks: np.ndarray  # (F N, N)
    moving: np.ndarray  # (F POINTS, N)
    weight: np.ndarray  # (F, POINTS), of what standing points move
    gradient: np.ndarray  # (F, n)
    alone: np.ndarray  # (F, n)
    first: np.ndarray  # (F, n)
    second: np.ndarray  # (F, n)


@compiled
def structure(at):
    """Return the whole numbers at an address."""
    c = whole_numbers(at, COUNTS)
    n = c[DOFS]
    at += 4 * COUNTS
    parents, at = whole_numbers(at, c[BODIES]), at + 4 * c[BODIES]
    kinds, at = whole_numbers(at, c[JOINTS]), at + 4 * c[JOINTS]
    owners, at = whole_numbers(at, c[JOINTS]), at + 4 * c[JOINTS]
    source, at = whole_numbers(at, c[VALUES]), at + 4 * c[VALUES]
    columns, at = whole_numbers(at, c[FULL]), at + 4 * c[FULL]
    places, at = whole_numbers(at, c[PLACES]), at + 4 * c[PLACES]
    joints, at = whole_numbers(at, n), at + 4 * n
    limbs, at = whole_numbers(at, 2 * c[LIMBS]), at + 8 * c[LIMBS]
    above, at = whole_numbers(at, c[ABOVE]), at + 4 * c[ABOVE]
    pairs, at = whole_numbers(at, 2 * c[PAIRS]), at + 8 * c[PAIRS]
    moves, at = whole_numbers(at, c[BODIES] * c[FULL]), at + 4 * c[BODIES] * c[FULL]
    scalars, at = whole_numbers(at, 2 * c[SCALARS]), at + 8 * c[SCALARS]
    turns = whole_numbers(at, 2 * c[TURNS])
    return Structure(
        c, parents, kinds, owners, source, columns, places, joints, limbs, above, pairs, moves, scalars, turns
    )


@compiled
def numbers(c, at, wishes):
    """Return the numbers at an address; of the wishes a copy."""
    n = c[DOFS]
    coefficient, at = vector(at, c[VALUES]), at + 8 * c[VALUES]
    offset, at = vector(at, c[VALUES]), at + 8 * c[VALUES]
    reference, at = vector(at, c[VALUES]), at + 8 * c[VALUES]
    body_at, at = matrix(at, c[BODIES], 3), at + 24 * c[BODIES]
    body_along, at = matrix(at, c[BODIES], 4), at + 32 * c[BODIES]
    joint_at, at = matrix(at, c[JOINTS], 3), at + 24 * c[JOINTS]
    joint_along, at = matrix(at, c[JOINTS], 3), at + 24 * c[JOINTS]
    factors, at = vector(at, c[FULL]), at + 8 * c[FULL]
    points, at = matrix(at, c[PLACES], 3), at + 24 * c[PLACES]
    turns, at = matrix(at, 4, 9), at + 288
    home, at = matrix(at, 4, 9), at + 288
    radii, at = vector(at, c[CAPSULES]), at + 8 * c[CAPSULES]
    lower, at = vector(at, n), at + 8 * n
    upper, at = vector(at, n), at + 8 * n
    rest, at = vector(at, n), at + 8 * n
    step, at = vector(at, n), at + 8 * n
    change, at = vector(at, n), at + 8 * n
    mass_fractions, at = vector(at, c[BODIES]), at + 8 * c[BODIES]
    centers, at = matrix(at, c[BODIES], 3), at + 24 * c[BODIES]
    for i in range(WISHES):
        wishes[i] = vector(at, WISHES)[i]
    return Numbers(
        coefficient, offset, reference, body_at, body_along, joint_at, joint_along, factors, points, turns, home,
        radii, lower, upper, rest, step, change, mass_fractions, centers, wishes,
    )  # fmt: skip


@compiled
def memory(c, at):
    """Return memory for a frame at an address, and where more is."""
    wide = padded(c[FULL])
    value, at = vector(at, c[VALUES]), at + 8 * c[VALUES]
    position, at = matrix(at, c[BODIES], 3), at + 24 * c[BODIES]
    rotation, at = matrix(at, c[BODIES], 9), at + 72 * c[BODIES]
    linear, at = matrix(at, c[FULL], 3), at + 24 * c[FULL]
    angular, at = matrix(at, c[FULL], 3), at + 24 * c[FULL]
    anchors, at = matrix(at, c[FULL], 3), at + 24 * c[FULL]
    motion, at = matrix(at, 6, wide), at + 48 * wide
    masks, at = matrix(at, c[BODIES], wide), at + 8 * c[BODIES] * wide
    points, at = matrix(at, c[PLACES], 3), at + 24 * c[PLACES]
    turned, at = matrix(at, 4, 9), at + 288
    line, at = vector(at, wide), at + 8 * wide
    near, at = vector(at, 2 * c[PAIRS]), at + 16 * c[PAIRS]
    spheres, at = matrix(at, c[CAPSULES], 4), at + 32 * c[CAPSULES]
    return Memory(
        value, position, rotation, linear, angular, anchors, motion, masks, points, turned, line, near, spheres
    ), at


@compiled
def kept(c, at):
    """Return memory for rows at an address, and where more is."""
    N, most = padded(c[DOFS] + 1), ROWS + 2 * c[ABOVE] + c[MOST_PAIRS]
    rows, at = matrix(at, 2 * most, N), at + 16 * most * N
    points, at = matrix(at, 2, POINTS), at + 16 * POINTS
    weight, at = matrix(at, 3, POINTS), at + 24 * POINTS
    move, at = matrix(at, 3, POINTS), at + 24 * POINTS
    return Kept(rows, points, weight, move, whole_numbers(at, 2), most), at + 8
