"""The saturated joints and the largest scale of a motion: ``solvers/null_space/_scaled_motion.py`` for a CPU.

    min 1/2 |x - target|^2   over   x = start + scale motion + P u,   lower <= x <= upper

for the largest scale <= 1 for which there is such an x. The problem is that file's and the method is another, for here
a lane may branch as it needs.

At a scale that is given it is the dual method of D. Goldfarb and A. Idnani ("A numerically stable dual method for
solving strictly convex quadratic programs", Mathematical Programming 27, 1983). It begins at x without bounds. Joints
that are violated are put on their bounds one after another, those whose multiplier gets 0 meanwhile are let go, and the
cost never falls, so that no set of joints returns. Where a joint's column of the projector is made up of those of
saturated ones, sum_i rate_i column_i, and none of these can be let go,

    normal . x = x_k - sum_i rate_i x_i

is what the null space does not change, and no x in the box has it as the scale asks. The scale is then lowered to where
all of them are on their bounds, a cut: no larger one is possible, and 0 is, for the start is in the box. These joints
stop the motion. They stay where they are, for with enough of the normal added all their multipliers have the right
sign; where a further combination has one of them let go, the free one among them takes its place. The search goes on at
the new scale, and lets those go first that push in the wrong direction there. The scale falls with every cut, so that
there are finitely many; at the end there is an x in the box. A search may begin with the joints that one at another
scale has saturated, and lets those go in the same way.

Column i of ``turned``, from row ``first`` on, is joint i in coordinates of the null space; these are turned in place,
so that the first ``count`` of them have all of the joints that are on their bounds (an orthogonal factorisation). What
rounding does is then in proportion to how dependent the joints are, and not to its square.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...numerics._constants import LARGEST_RATE, SATURATION_LOSS, SATURATION_ROUNDOFF, SIGN_CHECKS
from ._dense import fill
from ._frame import lean
from ._vectors import add, dot


class Search(NamedTuple):
    """Space for the search of one level, of n numbers each but for two.

    Fields: of the saturated joints, in the order in which coordinates are theirs: ``duals`` (n, n), in coordinates, of
    which each has 1 along its own joint's column and 0 along the others'; the multipliers ``y``; ``rate``, how much of
    a column they make up; ``who`` they are; ``stays``, whether they stop the motion. Of all joints: ``x``; ``along``, a
    direction of theirs; ``normal``, the combination that stops the motion; ``target_part``, of x; ``at_bound``, the
    label of each; ``passed``, the labels of free ones that the saturated ones put on their bounds; ``begin`` and
    ``kept``, where they are at the scale 0, and where they were at the last scale that was accepted. In coordinates:
    ``place`` and ``turn``; ``before`` (n, n) has them as they were.
    """

    duals: np.ndarray
    before: np.ndarray
    x: np.ndarray
    y: np.ndarray
    rate: np.ndarray
    along: np.ndarray
    normal: np.ndarray
    target_part: np.ndarray
    place: np.ndarray
    turn: np.ndarray
    begin: np.ndarray
    kept: np.ndarray
    who: np.ndarray
    stays: np.ndarray
    at_bound: np.ndarray
    passed: np.ndarray


@lean
def bound(W, S, i):
    """Return the bound at which joint i is."""
    return W.high[i] if S.at_bound[i] > 0 else W.low[i]


@lean
def settle(W, S, start, scale, first, count):
    """Compute x at a scale with the saturated joints on their bounds, and their multipliers; refined once."""
    n, stop = len(start), first + count
    for i in range(n):
        S.x[i] = start[i] + scale * W.motion[i] + S.target_part[i]
    for a in range(count):
        S.y[a] = 0.0
    for _ in range(2 if count > 0 else 0):
        fill(S.place, 0.0)
        for a in range(count):
            i = S.who[a]
            add(S.place, bound(W, S, i) - S.x[i], S.duals[a], first, stop)
        for j in range(first, stop):
            add(S.x, S.place[j], W.turned[j], 0, n)
        for a in range(count):
            S.y[a] += dot(S.duals[a], S.place, first, stop)


@lean
def settle_stopped(W, S, start, scale, first, count, stop, rate):
    """Compute the same at the scale near this one that puts the stopping joint on its bound; return the scale."""
    settle(W, S, start, scale, first, count)
    for _ in range(2 if stop >= 0 else 0):
        off = (W.low[stop] if S.passed[stop] < 0 else W.high[stop]) - S.x[stop]
        if off == 0.0:
            break
        scale = min(max(scale + off / rate, 0.0), 1.0)
        settle(W, S, start, scale, first, count)
    return scale


@lean
def size(W, S, start, target, scale, count):
    """Return the size of the numbers that x is made of."""
    most = 0.0
    for i in range(len(start)):
        most = max(most, abs(start[i]) + scale * abs(W.motion[i]) + abs(target[i]))
    for a in range(count):
        most = max(most, abs(bound(W, S, S.who[a])))
    return most


@lean
def most_wrong(S, count, roundoff):
    """Return the saturated joint with the largest multiplier of the wrong sign; -1 for none."""
    worst, which = -roundoff, -1
    for a in range(count):
        push = -S.at_bound[S.who[a]] * S.y[a]
        if S.stays[a] == 0 and push < worst:
            worst, which = push, a
    return which


@lean
def step_left(S, first, count):
    """Return how far a saturated joint would go that is let go: no step, where all multipliers have the right sign."""
    most = 0.0
    for a in range(count):
        wrong = S.at_bound[S.who[a]] * S.y[a]
        if S.stays[a] == 0 and wrong > 0.0:
            most = max(most, wrong / np.sqrt(dot(S.duals[a], S.duals[a], first, first + count)))
    return most


@lean
def most_violated(W, S, n, roundoff):
    """Return the free joint that is furthest beyond its bound; -1 for none."""
    most, which = roundoff, -1
    for i in range(n):
        if S.at_bound[i] == 0 and S.passed[i] == 0:
            beyond = max(W.low[i] - S.x[i], S.x[i] - W.high[i])
            if beyond > most:
                most, which = beyond, i
    return which


@lean
def sum_along(W, S, vector, start, stop):
    """Write to ``along`` what a vector of coordinates is in joints."""
    fill(S.along, 0.0)
    for j in range(start, stop):
        add(S.along, vector[j], W.turned[j], 0, len(S.x))


@lean
def look_along(W, S, first, count, k):
    """Compute what of column k saturated joints make up, and how all move along the rest; return its squared length."""
    n, stop = len(S.x), first + count
    for j in range(first, n):
        S.turn[j] = W.turned[j, k]
    for a in range(count):
        S.rate[a] = dot(S.duals[a], S.turn, first, stop)
    sum_along(W, S, S.turn, stop, n)
    return dot(S.turn, S.turn, stop, n)


@lean
def reflect(W, S, turn, head, norm, start, stop):
    """Reflect rows of coordinates so that a vector of this norm is along ``head`` alone; ``along`` is their sum by it.

    The scale of the reflection, whose vector ``turn`` becomes.
    """
    n, by = len(S.x), -norm if turn[head] < 0.0 else norm
    scale = 1.0 / (norm * (norm + abs(turn[head])))
    turn[head] += by
    add(S.along, by, W.turned[head], 0, n)
    for j in range(start, stop):
        add(W.turned[j], -scale * turn[j], S.along, 0, n)
    return scale


@lean
def saturate(W, S, first, count, k, square):
    """Make joint k the last of the saturated ones, after ``look_along``."""
    n, head = len(S.x), first + count
    reflect(W, S, S.turn, head, np.sqrt(square), head, n)
    for j in range(head + 1, n):
        W.turned[j, k] = 0.0
    pivot = W.turned[head, k]
    for a in range(count):
        S.duals[a, head] = -S.rate[a] / pivot
    fill(S.duals[count], 0.0)
    S.duals[count, head] = 1.0 / pivot
    S.who[count], S.stays[count] = k, 0


@lean
def release(W, S, first, count, a):
    """Release a saturated joint to where it has no multiplier."""
    n, stop, last = len(S.x), first + count, first + count - 1
    own = S.duals[a]
    sum_along(W, S, own, first, stop)
    for b in range(count):  # once more, for rounding
        S.rate[b] = (1.0 if b == a else 0.0) - S.along[S.who[b]]
    fill(S.turn, 0.0)
    for b in range(count):
        add(S.turn, S.rate[b], S.duals[b], first, stop)
    add(own, 1.0, S.turn, first, stop)
    sum_along(W, S, own, first, stop)
    square = dot(own, own, first, stop)
    for j in range(first, stop):
        S.turn[j] = own[j]
    by = S.y[a] / square
    if by != 0.0:
        add(S.x, -by, S.along, 0, n)
        for b in range(count):
            S.y[b] -= by * dot(S.duals[b], own, first, stop)
    scale = reflect(W, S, S.turn, last, np.sqrt(square), first, stop)
    S.at_bound[S.who[a]] = 0
    if a < count - 1:
        S.who[a], S.stays[a], S.y[a] = S.who[count - 1], S.stays[count - 1], S.y[count - 1]
        for j in range(first, stop):
            own[j] = S.duals[count - 1, j]
    for b in range(count - 1):
        add(S.duals[b], -scale * dot(S.duals[b], S.turn, first, stop), S.turn, first, stop)
        S.duals[b, last] = 0.0
        W.turned[last, S.who[b]] = 0.0


@lean
def scale_of(W, S, start, first, count, k, label, least):
    """Return the scale at which joint k, whose column saturated joints make up, is on its bound with them; its rate."""
    stop, largest = first + count, 1.0
    for a in range(count):  # the rates once more, for rounding
        for j in range(first, stop):
            S.turn[j] -= S.rate[a] * W.turned[j, S.who[a]]
    for a in range(count):
        S.rate[a] += dot(S.duals[a], S.turn, first, stop)
        largest = max(largest, abs(S.rate[a]))
    gap, rate = (W.low[k] if label < 0 else W.high[k]) - start[k], W.motion[k]
    for a in range(count):
        if abs(S.rate[a]) > least * largest:
            i = S.who[a]
            gap -= S.rate[a] * (bound(W, S, i) - start[i])
            rate -= S.rate[a] * W.motion[i]
        else:
            S.rate[a] = 0.0
    return (min(max(gap / rate, 0.0), 1.0) if rate != 0.0 else 1.0), rate


@lean
def stop_by(S, count, k, label):
    """Let joint k, and those that its column is made of, stop the motion: no other is beside its bounds or let go."""
    fill(S.normal, 0.0)
    fill(S.passed, 0)
    S.normal[k], S.passed[k] = 1.0, label
    for a in range(count):
        S.stays[a] = S.rate[a] != 0.0
        S.normal[S.who[a]] = -S.rate[a]


@lean
def exchange(W, S, first, count, a, stop):
    """Saturate the joint that stops the motion beside the saturated ones in place of one of these."""
    other, label = S.who[a], S.at_bound[S.who[a]]
    S.y[a] = 0.0
    release(W, S, first, count, a)
    square = look_along(W, S, first, count - 1, stop)
    saturate(W, S, first, count - 1, stop, square)
    S.y[count - 1], S.stays[count - 1], S.at_bound[stop] = 0.0, 1, S.passed[stop]
    S.passed[stop], S.passed[other] = 0, label
    return other


@lean
def first_to_leave(S, count, sign, negligible):
    """Return the dual step at which a saturated joint's multiplier is 0, and which joint; infinite, -1 for none."""
    length, leaving = np.inf, -1
    for a in range(count):
        label = S.at_bound[S.who[a]]
        falls = label * sign * S.rate[a]
        if S.stays[a] == 0 and falls < -negligible:
            step = max(-label * S.y[a], 0.0) / -falls
            if step < length:
                length, leaving = step, a
    return length, leaving


@lean
def first_to_cross(S, count, sign, negligible):
    """Return the saturated joint among those that stop the motion which a further combination releases; -1 for none."""
    out, most = -1, 0.0
    for a in range(count):
        i = S.who[a]
        falls = S.at_bound[i] * sign * S.rate[a]
        if S.stays[a] != 0 and falls < -negligible and -falls > most * abs(S.normal[i]):
            out, most = a, -falls / abs(S.normal[i])
    return out


@lean
def begin_search(W, S, start, target, first):
    """Begin with no joint saturated, and with what the null space makes of the target."""
    n = len(start)
    fill(S.target_part, 0.0)
    fill(S.at_bound, 0)
    for i in range(n):
        S.along[i] = target[i] - start[i]
    for j in range(first, n):
        add(S.target_part, dot(W.turned[j], S.along, 0, n), W.turned[j], 0, n)


@lean
def search(W, S, start, target, first, scale, most, least, count):
    """Return the scale, how many joints are saturated, the one that stops the motion, changes, and whether it is done.

    After ``begin_search``, or from the ``count`` joints that a search at another scale has saturated. ``S.x`` is the
    answer, inside its box; ``scale`` is the largest that is asked for.
    """
    n = len(start)
    stop, rate, changes, entering, sign, push = -1, 0.0, 0, -1, 1.0, 0.0
    fill(S.stays, 0)
    fill(S.passed, 0)
    settle(W, S, start, scale, first, count)
    whole = size(W, S, start, target, scale, count)
    dropping, crossings, checks = count > 0, 0, 0
    while changes < most:
        if dropping:
            wrong = most_wrong(S, count, SATURATION_ROUNDOFF * whole)
            dropping = wrong >= 0
            if dropping:
                release(W, S, first, count, wrong)
                count, changes = count - 1, changes + 1
                continue
        if entering < 0:
            entering = most_violated(W, S, n, SATURATION_ROUNDOFF * whole)
            if entering < 0:
                if count > 0:  # beside multipliers that are huge, rounding may have turned the sign of another
                    scale = settle_stopped(W, S, start, scale, first, count, stop, rate)
                    whole = size(W, S, start, target, scale, count)
                are_right = step_left(S, first, count) <= SATURATION_LOSS * whole
                if are_right or checks == SIGN_CHECKS:
                    return scale, count, stop, changes, are_right
                checks, dropping = checks + 1, True
                continue
            sign = 1.0 if W.low[entering] - S.x[entering] >= S.x[entering] - W.high[entering] else -1.0
            push, crossings = 0.0, 0
        k, changes = entering, changes + 1
        square = look_along(W, S, first, count, k)
        full, largest = np.inf, 1.0
        if square > least * least:
            full = max(W.low[k] - S.x[k] if sign > 0.0 else S.x[k] - W.high[k], 0.0) / square
        for a in range(count):
            largest = max(largest, abs(S.rate[a]))
        length, leaving = first_to_leave(S, count, sign, (SATURATION_ROUNDOFF if full < np.inf else least) * largest)
        if leaving < 0 and full == np.inf:
            out = first_to_cross(S, count, sign, least * largest)
            if out >= 0:
                crossings += 1
                if crossings > n:  # by rounding they go round
                    break
                changes += 1
                stop, push = exchange(W, S, first, count, out, stop), 0.0
                settle(W, S, start, scale, first, count)
                continue
            entering, label, out = -1, -1 if sign > 0.0 else 1, -1
            lower, its_rate = scale_of(W, S, start, first, count, k, label, least)
            if not lower < scale - SATURATION_ROUNDOFF:  # but for rounding it is where the others put it
                S.passed[k] = label
                continue
            largest = LARGEST_RATE
            for a in range(count):
                if abs(S.rate[a]) > largest:
                    out, largest = a, abs(S.rate[a])
            if out >= 0:
                S.passed[k] = label
                k, changes = exchange(W, S, first, count, out, k), changes + 2
                label = S.passed[k]
                look_along(W, S, first, count, k)
                lower, its_rate = scale_of(W, S, start, first, count, k, label, least)
            stop_by(S, count, k, label)
            stop, rate, dropping = k, its_rate, True
            scale = settle_stopped(W, S, start, min(lower, scale), first, count, stop, rate)
            whole = size(W, S, start, target, scale, count)
            continue
        step = sign * min(length, full)
        add(S.x, step, S.along, 0, n)
        add(S.y, -step, S.rate, 0, count)
        push += step
        if length < full:
            S.y[leaving] = 0.0
            release(W, S, first, count, leaving)
            count -= 1
        else:
            saturate(W, S, first, count, k, square)
            S.y[count], S.at_bound[k] = push, -1 if sign > 0.0 else 1
            S.x[k] = bound(W, S, k)
            whole = max(whole, abs(S.x[k]))
            count, entering = count + 1, -1
    return scale, count, stop, changes, False
