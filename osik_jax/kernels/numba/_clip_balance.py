"""For the kernel of ``retargeting/_plan.py``: the centre of mass over the feet, as ``retargeting/_balance.py`` says."""

from __future__ import annotations

import numpy as np

from ._capsules import inner, times
from ._clip_rows import add_point, add_rates, put_row
from ._clip_workspace import BALANCE, BODIES, INSIDE, KEYS, ROOT, SHORTEST, STIFFNESS
from ._frame import lean
from ._rigid import cross, minus, plus, triple, turning
from ._rigid import turned as rotated

CORNERS = 8


@lean
def center_of(K, V, W):
    """Return the centre of mass."""
    center = (0.0, 0.0, 0.0)
    for body in range(K.counts[BODIES]):
        if V.mass_fractions[body] != 0.0:
            at = plus(triple(W.position, body), rotated(turning(W.rotation, body), triple(V.centers, body)))
            center = plus(center, times(V.mass_fractions[body], at))
    return center


@lean
def support(first, W, contact, d):
    """Return the support function of the standing corners, along d and along -d."""
    farthest, nearest = -np.inf, np.inf
    for k in range(CORNERS):
        if contact[k // 2] > 0.5:
            at = inner(d, triple(W.points, first + k))
            farthest, nearest = max(farthest, at), min(nearest, at)
    return farthest, -nearest


@lean
def flat(vector):
    """Return a vector's part in the plane of the floor, and its length."""
    return (vector[0], vector[1], 0.0), np.sqrt(vector[0] * vector[0] + vector[1] * vector[1])


@lean
def find_overhang(K, V, W, contact, center):
    """Return ``overhang``; for its coefficients, both corners of the edge and the ratio at its nearest point too."""
    first, shortest = K.counts[KEYS] + 4, V.wishes[SHORTEST]
    most, direction, a, b, ratio, width = -np.inf, (0.0, 0.0, 0.0), 0, 0, 0.0, np.inf
    for i in range(CORNERS):
        if not contact[i // 2] > 0.5:
            continue
        start = triple(W.points, first + i)
        off, length = flat(minus(center, start))
        if length > shortest:
            d = times(1.0 / length, off)
            distance = inner(d, center) - support(first, W, contact, d)[0]
            if distance > most:
                most, direction, a, b, ratio = distance, d, i, i, 0.0
        for j in range(i + 1, CORNERS):
            edge, length = flat(minus(triple(W.points, first + j), start))
            if not contact[j // 2] > 0.5 or not length > shortest:
                continue
            along = times(1.0 / length, edge)
            across = (along[1], -along[0], 0.0)
            one, other = support(first, W, contact, across)
            width = min(width, one + other)
            for side in range(2):
                d = across if side == 0 else times(-1.0, across)
                distance = inner(d, center) - (one if side == 0 else other)
                if distance > most:
                    most, direction, a, b = distance, d, i, j
                    ratio = min(max(inner(along, off) / length, 0.0), 1.0)
    return most, direction, a, b, ratio, width


@lean
def ask_balance(K, V, W, J, row, contact, n):
    """Return the row of a centre of mass that is beyond its bound, where both feet stand."""
    weight = V.wishes[BALANCE]
    if weight == 0.0 or not (max(contact[0], contact[1]) > 0.5 and max(contact[2], contact[3]) > 0.5):
        return row, 0.0
    center = center_of(K, V, W)
    distance, d, a, b, ratio, width = find_overhang(K, V, W, contact, center)
    gap = distance + min(V.wishes[INSIDE], width / 3.0)
    if not gap > 0.0:
        return row, 0.0
    origin = triple(W.position, K.counts[ROOT])
    for body in range(K.counts[BODIES]):
        if V.mass_fractions[body] != 0.0:
            at = plus(triple(W.position, body), rotated(turning(W.rotation, body), triple(V.centers, body)))
            direction = times(V.mass_fractions[body], d)
            add_rates(W.line, W.masks[body], W.motion, direction, cross(minus(at, origin), direction))
    first = K.counts[KEYS] + 4
    add_point(K, W, first + a, times(ratio - 1.0, d))
    add_point(K, W, first + b, times(-ratio, d))
    put_row(K, V, W, J, row, np.sqrt(V.wishes[STIFFNESS] * weight), gap, n)
    return row + 1, 0.5 * weight * gap * gap
