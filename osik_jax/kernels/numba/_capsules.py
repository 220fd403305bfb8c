"""Nearest points of two capsules for kernels: ``collision/_distance.py: between_segments``, a pair at a time."""

from __future__ import annotations

import numpy as np

from ...numerics._constants import PARALLEL
from ._frame import lean
from ._rigid import cross, minus, plus

_TINY = np.finfo(float).tiny ** 0.5
"""A length counts as none below it, as in ``collision/_distance.py``."""


@lean
def inner(a, b):
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@lean
def times(by, a):
    """Return a vector times a number."""
    return by * a[0], by * a[1], by * a[2]


@lean
def _over(a, b):
    return 0.0 if b == 0.0 else a / b


@lean
def _inside(x):
    return min(max(x, 0.0), 1.0)


@lean
def _unit(a, otherwise):
    square = inner(a, a)
    return otherwise if square <= _TINY else times(1.0 / np.sqrt(square), a)


@lean
def parameters(a, b, offset):
    """Where along two segments, from 0 to 1, they are nearest; offset: from the start of b to that of a."""
    aa, bb, ab, ao, bo = inner(a, a), inner(b, b), inner(a, b), inner(a, offset), inner(b, offset)
    square = aa * bb - ab * ab
    if square <= PARALLEL * aa * bb:
        s = 0.5 * (_inside(_over(-ao, aa)) + _inside(_over(ab - ao, aa)))
    else:
        s = _inside(_over(ab * bo - ao * bb, square))
    t = _inside(_over(ab * s + bo, bb))
    return _inside(_over(ab * t - ao, aa)), t


@lean
def across(a, b, outward):
    """Return a unit vector perpendicular to two directions, as far outward as may be; any, where there is none."""
    longer = a if inner(a, a) >= inner(b, b) else b
    x, y, z = abs(longer[0]), abs(longer[1]), abs(longer[2])
    if x <= y and x <= z:
        steepest = 1.0, 0.0, 0.0
    elif y <= z:
        steepest = 0.0, 1.0, 0.0
    else:
        steepest = 0.0, 0.0, 1.0
    normal = _unit(cross(a, b), _unit(cross(longer, steepest), (0.0, 0.0, 1.0)))
    return times(-1.0, normal) if inner(normal, outward) < 0.0 else normal


@lean
def nearest(start_a, along_a, radius_a, start_b, along_b, radius_b):
    """Return how far two capsules are apart, the nearest points of their surfaces, and the unit vector to the other.

    Args:
        start_a: one end of the axis.
        along_a: from there to the other end.
        radius_a: of the capsule.
        start_b: of the other capsule.
        along_b: of the other.
        radius_b: of the other.
    """
    s, t = parameters(along_a, along_b, minus(start_a, start_b))
    on_a, on_b = plus(start_a, times(s, along_a)), plus(start_b, times(t, along_b))
    between = minus(on_b, on_a)
    square = inner(between, between)
    if square <= _TINY:
        outward = plus(minus(start_b, start_a), times(0.5, minus(along_b, along_a)))
        normal = across(along_a, along_b, outward)
    else:
        normal = times(1.0 / np.sqrt(square), between)
    distance = np.sqrt(square) - radius_a - radius_b
    return distance, plus(on_a, times(radius_a, normal)), minus(on_b, times(radius_b, normal)), normal
