"""Kernel of ``solvers/null_space/_saturation.py``: all levels of one problem after another, in coordinates.

The problem is the one that file states. The motion of a level is found in the coordinates of ``_projection.py``; then
joints are put on their bounds (``_saturation_search.py``), and those that stop the level are taken off the coordinates,
as the rows of a level are. The joints that cannot move at all are the first that are taken off.
"""

from __future__ import annotations

import numpy as np

from ...numerics._constants import (
    BLOCKING_RANK,
    BOUND_DISTANCE,
    FULL_STEP,
    MAX_SATURATION_CHANGES,
    NEGLIGIBLE_ENTRY,
    NEGLIGIBLE_STEP,
    PART,
    PATH_END,
    PATH_SEARCHES,
    PATH_STEP,
    SATURATION_LOSS,
    SATURATION_RANK,
    SATURATION_RESIDUAL,
    SOFT_COMPLIANCE,
    SOFT_SATURATION_RANK,
    STIFFER_SOFT_COMPLIANCE,
    STRAIGHT,
    WHOLE,
)
from ._dense import fill
from ._frame import arguments, data, dimension, is_call, lean, matrix, results, vector, whole_numbers
from ._projection import (
    Level,
    counts,
    find_motion,
    level_damping,
    load,
    look,
    narrow,
)
from ._row_space import set_beside, take_row_space
from ._row_space_workspace import work_at, work_size
from ._saturation_search import Search, begin_search, bound, search, settle, size
from ._vectors import add, dot


@lean
def given_rows(A, lower, upper, equal, m, n):
    """Return how many rows there are before those that only fill up."""
    while m > 0:
        row = A[m - 1]
        if equal[m - 1] != 0 or dot(row, row, 0, n) > 0.0 or lower[m - 1] > -np.inf or upper[m - 1] < np.inf:
            break
        m -= 1
    return m


@lean
def damping_of(W, S, level, x, first, longest):
    """Return the damping of the level, which is found at what of x the null space can not move."""
    n = len(x)
    if level.unmet != 0.0:
        for i in range(n):
            S.x[i] = x[i]
        for j in range(first, n):
            add(S.x, -dot(W.turned[j], x, 0, n), W.turned[j], 0, n)
        look(W, level, S.x)
    return level_damping(W, level, first, longest)


@lean
def damped_part(W, S, level, x, damping):
    """Return the part of the step from x to where the search ended at which the damped cost of the level is least."""
    m, n = level.A.shape
    if not damping > 0.0:
        return 1.0
    gain, cost, size, square = 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        S.along[i] = S.x[i] - x[i]
        square += S.along[i] * S.along[i]
        size += x[i] * x[i]
    if not square > NEGLIGIBLE_STEP * NEGLIGIBLE_STEP * size:
        return 1.0
    cost = damping * square
    for i in range(m):
        if counts(W, level, i):
            moved = dot(level.A[i], S.along, 0, n)
            gain, cost = gain + moved * W.wanted[i], cost + moved * moved
    part = gain / (cost if cost > 0.0 else 1.0)
    return max(part, 0.0) if cost > 0.0 and part < FULL_STEP else 1.0


@lean
def put_on_bounds(W, S, count, stop):
    """Put joints on their bounds, where they are up to roundoff; return that roundoff, infinite where x is NaN."""
    n, off = len(S.x), 0.0
    for i in range(n):
        before = S.x[i]
        if S.at_bound[i] != 0:
            S.x[i] = bound(W, S, i)
        elif i == stop:
            S.x[i] = W.low[i] if S.passed[i] < 0 else W.high[i]
        S.x[i] = min(max(S.x[i], W.low[i]), W.high[i])
        moved = abs(S.x[i] - before)
        off = max(off, moved if moved < np.inf else np.inf)
    return off


@lean
def scale_left(W, S, first, stop, size):
    """Return how much larger the scale may be: what is left of the combination that stops the motion, or wrong in it.

    By as much of the combination as the null space changes, other joints may make room, each by about ``size``; so do
    those whose bound is not the one at which the combination is largest.
    """
    n, square, wrong = len(S.x), 0.0, 0.0
    for j in range(first, n):
        along = dot(W.turned[j], S.normal, 0, n)
        square += along * along
    rate = dot(S.normal, W.motion, 0, n)
    for i in range(n):
        label = S.passed[i] if i == stop else S.at_bound[i]
        wrong += max(-label * S.normal[i] * (1.0 if rate > 0.0 else -1.0), 0.0)
    return (np.sqrt(square) + wrong) * size / abs(rate) if rate != 0.0 else np.inf


@lean
def holds(W, S, first, count, stop, size):
    """Return whether joints are in their box, and no larger scale is possible."""
    if not put_on_bounds(W, S, count, stop) <= SATURATION_RESIDUAL * size:
        return False
    return stop < 0 or scale_left(W, S, first, stop, size) <= SATURATION_LOSS


@lean
def add_missing_part(W, S, x, first, compliance):
    """Make what is missing of the motion a short coordinate, before the others: moves along these cost less."""
    square = dot(W.motion, W.motion, 0, len(x))
    root = np.sqrt(compliance / square) if square > 0.0 else 0.0
    for i in range(len(x)):
        W.turned[first - 1, i] = root * W.motion[i]


@lean
def find_stop(W, S, x, count):
    """Return the scale at which a search with that coordinate ended, and the joint that stops the motion; -1 for none.

    The multipliers are then the combination of joints that stops it: what is missing pulls at it with nearly all.
    """
    n, moved, square, largest, stop = len(x), 0.0, 0.0, 0.0, -1
    for i in range(n):
        moved += W.motion[i] * (S.x[i] - x[i] - S.target_part[i])
        square += W.motion[i] * W.motion[i]
    scale = min(max(moved / square, 0.0), 1.0) if square > 0.0 else 1.0
    fill(S.normal, 0.0)
    if scale >= 1.0 - PATH_STEP:
        return scale, -1
    for a in range(count):
        if abs(S.y[a]) > largest:
            largest, stop = abs(S.y[a]), S.who[a]
    for a in range(count):
        S.normal[S.who[a]] = S.y[a] / largest
    if stop >= 0:
        S.passed[stop] = S.at_bound[stop]
    return scale, stop


@lean
def put_back(W, S, start):
    """Put the coordinates back, as they were before the search."""
    for j in range(start, len(S.x)):
        for i in range(len(S.x)):
            W.turned[j, i] = S.before[j, i]


@lean
def attempt(W, S, x, target, first, scale, most, least, compliance, count):
    """Search, and accept where the answer holds; where it does not, put the coordinates back.

    Where ``count`` joints are saturated already, by the attempt before at another scale, it goes on from these.

    With a compliance the motion may be missed in part, so that at any scale there is an answer, and joints that nearly
    depend on each other need no decision. That coordinate takes the place of one which is taken.

    The scale, how many joints are saturated, the one that stops the motion, changes, and whether the answer holds.
    """
    n, start = len(x), first - (1 if compliance > 0.0 else 0)
    if count == 0:
        for j in range(start, n):
            for i in range(n):
                S.before[j, i] = W.turned[j, i]
        begin_search(W, S, x, target, first)
    if start < first:
        add_missing_part(W, S, x, first, compliance)
    scale, count, stop, changes, done = search(W, S, x, target, start, scale, most, least, count)
    whole = size(W, S, x, target, scale, count)
    if start < first:
        done = done and stop < 0
        scale, stop = find_stop(W, S, x, count)
        put_back(W, S, start)
    done = done and holds(W, S, first, count, stop, whole)
    for i in range(n):
        if abs(S.normal[i]) <= NEGLIGIBLE_ENTRY and start < first:
            S.normal[i] = 0.0
    if not done and start == first:
        put_back(W, S, start)
    return scale, count, stop, changes, done


@lean
def best_scale(W, S, level, x, damping, first, count):
    """Return the scale at which the damped cost of the level is least, with the saturated joints on their bounds."""
    m, n = level.A.shape
    settle(W, S, x, 0.0, first, count)
    for i in range(n):
        S.begin[i] = S.x[i]
    settle(W, S, x, 1.0, first, count)
    gain, cost = 0.0, 0.0
    for i in range(n):
        along = S.x[i] - S.begin[i]
        gain -= damping * (S.begin[i] * along - x[i] * W.motion[i])
        cost += damping * along * along
    for i in range(m):
        if counts(W, level, i):
            moved = dot(level.A[i], W.motion, 0, n)
            gain, cost = gain + moved * W.wanted[i], cost + moved * moved
    return gain / cost if cost > 0.0 else 1.0


@lean
def label_joints(S, stop, at_bound, blocking):
    """Return the joints on their bounds, those that stop the motion, and which of them the others say most about."""
    n, blocker, most = len(at_bound), 0, 0.0
    for i in range(n):
        at_bound[i], blocking[i] = S.at_bound[i], 0
    if stop >= 0:
        for i in range(n):
            if S.normal[i] != 0.0:
                blocking[i] = S.passed[i] if i == stop else S.at_bound[i]
            if abs(S.normal[i]) > most:
                blocker, most = i, abs(S.normal[i])
        at_bound[stop] = S.passed[stop]
        at_bound[blocker] = 0
    return blocker


@lean
def go_along(W, S, level, x, target, damping, first, most, at_bound, blocking):
    """Find the end of the level's motion, or what comes before it where that has the least damped cost.

    The latter as ``solvers/null_space/_scale_path.py`` has it: a search for each scale that is tried, from a part of
    the straight way to the end on. A search for the end has up to three attempts, the second and the
    third with a compliance. All attempts are one call, for there is much to compile in it.

    Returns:
        The scale, the blocker, changes of the active set, and what ``solve_level`` says of the end. ``S.kept`` is where
        joints are.
    """
    n, at, number, low, high, scale = len(x), 1.0, 0, 0.0, 1.0, 0.0
    blocker, changes, ended, searches, whole, part, count = 0, 0, 0, 0, 1.0, 1.0, 0
    while searches <= PATH_SEARCHES and changes < most:
        least, compliance, limit = SATURATION_RANK, 0.0, min(most - changes, MAX_SATURATION_CHANGES * n)
        if number > 0:
            least, limit = SOFT_SATURATION_RANK, most - changes
            compliance = SOFT_COMPLIANCE if number == 1 else STIFFER_SOFT_COMPLIANCE
        begun = count
        its_scale, count, stop, more, done = attempt(W, S, x, target, first, at, limit, least, compliance, begun)
        changes += more
        if not done or number > 0:  # the next begins anew
            count = 0
        if not done and begun > 0:
            continue
        if not done and number < 2 and at == 1.0 and first > 0:
            number += 1
            continue
        number = 0
        if ended == 0:  # the end of the path
            if not done:
                break
            blocker, ended = label_joints(S, stop, at_bound, blocking), STRAIGHT
            part = damped_part(W, S, level, x, damping)
            scale, whole, high, at = part * its_scale, its_scale, its_scale, part * its_scale
            for i in range(n):
                S.kept[i] = S.x[i] if part == 1.0 else x[i] + part * (S.x[i] - x[i])
            if part == 1.0 or not at > 0.0:
                break
            continue
        searches += 1
        if at == 1.0:  # the end once more
            if done:
                blocker, ended, scale = label_joints(S, stop, at_bound, blocking), WHOLE, its_scale
                for i in range(n):
                    S.kept[i] = S.x[i]
            break
        if not done or stop >= 0:
            break
        for i in range(n):
            S.along[i] = S.x[i]
        best = best_scale(W, S, level, x, damping, first, count)
        if ended == STRAIGHT or best >= at * (1.0 - PATH_STEP):  # beyond the least cost the path gets dear
            ended, scale = PART, its_scale
            for i in range(n):
                S.kept[i], at_bound[i] = S.along[i], S.at_bound[i]
        if best >= whole * (1.0 - PATH_STEP) and high == whole:
            at, low = 1.0 if at > whole * (1.0 - PATH_END) else whole * (1.0 - 0.5 * PATH_END), at
            continue
        if abs(best - at) <= PATH_STEP * at:
            break
        if best > at:
            low = at
        else:
            high = at
        at = best if low < best < high else 0.5 * (low + high)
    return scale, blocker, changes, ended


@lean
def take_off_stops(W, first, blocking):
    """Take the joints that stop the level off the coordinates that are left; return how many coordinates go."""
    n, count = len(blocking), 0
    for i in range(n):
        if blocking[i] != 0:
            for j in range(first, n):
                W.beside[j, count] = W.turned[j, i]
            count += 1
    if count == 0:
        return 0
    rank = take_row_space(W, count, n, first, BLOCKING_RANK, False)
    for i in range(n):
        if blocking[i] != 0:
            for j in range(first + rank, n):
                W.turned[j, i] = 0.0
    return rank


@lean
def solve_level(W, S, level, x, target, first, plain, rank_tolerance, most, at_bound, blocking):
    """Move x as the level asks.

    Returns:
        The coordinates that it takes, its scale, the blocker, changes of the active set, and how it ended
        (``STRAIGHT``, ``PART``, ``WHOLE``; 0 where the search has not).
    """
    n = len(x)
    load(W, level)
    set_beside(W, len(level.A), n, first, plain)
    longest, whole = look(W, level, x)
    damping = damping_of(W, S, level, x, first, longest)
    look(W, level, x)
    rank = find_motion(W, level, first, damping, rank_tolerance, plain)
    scale, blocker, changes, ended = go_along(W, S, level, x, target, damping, first + rank, most, at_bound, blocking)
    if ended == 0:
        fill(at_bound, 0)
        fill(blocking, 0)
        narrow(W, level, x, longest, whole)
        return rank, 0.0, blocker, changes, 0
    for i in range(n):
        x[i] = S.kept[i]
    narrow(W, level, x, longest, whole)
    return rank + take_off_stops(W, first + rank, blocking), scale, blocker, changes, ended


@lean
def begin(W, x, low, high, fixed):
    """Return the point of the box that is nearest to 0, and the joints that can move in coordinates of their own."""
    n, first, last = len(x), np.int64(0), 0
    for i in range(n):
        W.low[i], W.high[i], W.bent[i] = low[i], high[i], 0.0
        x[i] = min(max(0.0, low[i]), high[i])
        fixed[i] = 2 if low[i] == high[i] else 0
        last += low[i] == high[i]
        fill(W.turned[i], 0.0)
    for i in range(n):
        if fixed[i] != 0:
            W.turned[first, i] = 1.0
            first += 1
        else:
            W.turned[last, i] = 1.0
            last += 1
    return first


def handle(frame):
    """Answer a call of XLA: arguments as in ``null_space/_saturation.py``, a leading axis of lanes on each."""
    if not is_call(frame):
        return 0
    given, found = arguments(frame), results(frame)  # pointers to buffers, eight bytes each
    lanes, levels, M, n = dimension(given, 0), dimension(given, 8), dimension(given, 16), dimension(given, 24)
    A, below, above, equal = data(given), data(given + 8), data(given + 16), data(given + 24)
    constant, unmet, demand = data(given + 32), data(given + 40), data(given + 48)
    bends, targets, lower, upper = data(given + 56), data(given + 64), data(given + 72), data(given + 80)
    rank, most = data(given + 88), whole_numbers(data(given + 96), 1)[0]
    solution, projector, scales = data(found), data(found + 8), data(found + 16)
    dones, at_bounds, blockings = data(found + 24), data(found + 32), data(found + 40)
    blockers, actives, reports = data(found + 48), data(found + 56), data(found + 64)
    space, marks = data(found + 72), data(found + 80)
    width = max(M, n)
    W = work_at(space, n, width)
    at = space + 8 * work_size(n, width)
    duals, before, at, line = matrix(at, n, n), matrix(at + 8 * n * n, n, n), at + 16 * n * n, 8 * n
    S = Search(
        duals, before, vector(at, n), vector(at + line, n), vector(at + 2 * line, n), vector(at + 3 * line, n),
        vector(at + 4 * line, n), vector(at + 5 * line, n), vector(at + 6 * line, n), vector(at + 7 * line, n),
        vector(at + 8 * line, n), vector(at + 9 * line, n),
        whole_numbers(marks, n), whole_numbers(marks + 4 * n, n),
        whole_numbers(marks + 8 * n, n), whole_numbers(marks + 12 * n, n),
    )  # fmt: skip
    fixed = whole_numbers(marks + 16 * n, n)
    for lane in range(lanes):
        x, low, high = (
            vector(solution + 8 * n * lane, n), vector(lower + 8 * n * lane, n), vector(upper + 8 * n * lane, n)
        )  # fmt: skip
        first = begin(W, x, low, high, fixed)
        plain, active = first == 0, whole_numbers(actives + 4 * n * lane, n)
        for i in range(n):
            active[i] = fixed[i]
        report = whole_numbers(reports + 8 * lane, 2)
        report[0], report[1] = 1, 0
        for k in range(levels):
            each = levels * lane + k
            m = given_rows(
                matrix(A + 8 * M * n * each, M, n), vector(below + 8 * M * each, M), vector(above + 8 * M * each, M),
                whole_numbers(equal + 4 * M * each, M), M, n,
            )  # fmt: skip
            level = Level(
                matrix(A + 8 * M * n * each, m, n), vector(below + 8 * M * each, m), vector(above + 8 * M * each, m),
                whole_numbers(equal + 4 * M * each, m), vector(constant, lanes * levels)[each],
                vector(unmet, lanes * levels)[each], vector(demand, lanes * levels)[each],
                vector(bends + 8 * n * each, n),
            )  # fmt: skip
            at_bound, blocking = whole_numbers(at_bounds + 4 * n * each, n), whole_numbers(blockings + 4 * n * each, n)
            target = vector(targets + 8 * n * each, n)
            taken, scale, blocker, changes, done = solve_level(
                W, S, level, x, target, first, plain, vector(rank, lanes)[lane], most, at_bound, blocking
            )
            plain, first = plain and taken == 0 and changes == 0, first + taken
            vector(scales, lanes * levels)[each] = scale
            whole_numbers(dones, lanes * levels)[each] = done
            whole_numbers(blockers, lanes * levels)[each] = blocker
            for i in range(n):
                fixed[i] = blocking[i] if fixed[i] == 0 else fixed[i]
                active[i] = fixed[i] if fixed[i] != 0 else at_bound[i]
            report[0], report[1] = report[0] != 0 and done != 0, report[1] + changes
        for i in range(n):
            its_bound = low[i] if active[i] < 0 else high[i]
            if abs(active[i]) == 1 and abs(x[i] - its_bound) > BOUND_DISTANCE * (1.0 + abs(its_bound)):
                active[i] = 0
        own = matrix(projector + 8 * n * n * lane, n, n)
        fill(own.reshape(-1), 0.0)
        for j in range(first, n):
            row = W.turned[j]
            for i in range(n):
                if row[i] != 0.0:
                    add(own[i], row[i], row, 0, n)
    return 0
