"""For the kernel of ``retargeting/_plan.py``: what the frames of a clip ask for, one after another.

Rows that weigh nothing are left out, which are most of those of bounds; the others are scaled by the roots of their
weights, with their residuals in the column behind the last, so that one product gives matrix and gradient. Standing
points are tied to those of the frame before: a frame is finished when the next one's are known.
"""

from __future__ import annotations

import numpy as np

from ._capsules import across, inner, nearest, times
from ._clip_balance import ask_balance
from ._clip_rows import add_point, add_rates, place, put_row, unit
from ._clip_workspace import (
    APART,
    BENDS,
    CAPSULES,
    CLEARANCE,
    FOOT,
    KEYS,
    LIMB,
    LIMBS,
    LIMIT,
    MARGIN,
    MOST_PAIRS,
    PAIRS,
    PELVIS,
    POINTS,
    POSTURE,
    ROOT,
    ROOT_X,
    SHORTEST,
    STANCE,
    STIFFNESS,
    SWINGING,
    TORSO,
)
from ._dense import any_number, fill
from ._frame import lean
from ._rigid import composed, cross, logarithm, minus, nine, plus, put, three, transposed, triple, turning
from ._tiles import take_square
from ._vectors import WIDTH


@lean
def ask_limbs(K, V, W, J, row, wanted, n):
    """Put rows of directions; return the next row, and half the weighted sum of squares.

    What a direction d changes by is across it, ``(I - d d') / length`` times what the segment changes by: two rows do
    for the three. A limb that is shorter than what counts as a length has none.
    """
    weight, cost = V.wishes[LIMB], 0.0
    root = np.sqrt(weight)
    for limb in range(K.counts[LIMBS] - 1):
        a, b = K.limbs[2 * limb], K.limbs[2 * limb + 1]
        segment = minus(triple(W.points, b), triple(W.points, a))
        length = np.sqrt(inner(segment, segment))
        inverse = 1.0 / max(length, V.wishes[SHORTEST])
        d = times(inverse, segment)
        off = minus(d, three(wanted, 3 * limb))
        cost += 0.5 * weight * inner(off, off)
        if length < V.wishes[SHORTEST]:
            continue
        first = across(segment, segment, segment)
        second = cross(d, first)
        for i in range(2):
            side = first if i == 0 else second
            add_point(K, W, b, times(inverse, side))
            add_point(K, W, a, times(-inverse, side))
            put_row(K, V, W, J, row, root, inner(side, off), n)
            row += 1
    return row, cost


@lean
def ask_turn(K, V, W, J, row, i, wanted, weight, n):
    """Rows of a turn, of pelvis, torso or a foot."""
    goal = composed(wanted, turning(V.home, i))
    off, root = logarithm(composed(turning(W.turned, i), transposed(goal))), np.sqrt(weight)
    mask = W.masks[K.places[K.counts[KEYS] + i]]
    for k in range(3):
        add_rates(W.line, mask, W.motion, (0.0, 0.0, 0.0), unit(k))
        put_row(K, V, W, J, row, root, off[k], n)
        row += 1
    return row, 0.5 * weight * inner(off, off)


@lean
def ask_root(K, V, W, J, row, wanted, n):
    """Rows of the midpoint of the hips."""
    left, right = K.limbs[len(K.limbs) - 2], K.limbs[len(K.limbs) - 1]
    off = minus(times(0.5, plus(triple(W.points, left), triple(W.points, right))), wanted)
    cost = 0.0
    for i in range(3):
        weight = V.wishes[ROOT_X + i]
        add_point(K, W, left, times(0.5, unit(i)))
        add_point(K, W, right, times(0.5, unit(i)))
        put_row(K, V, W, J, row, np.sqrt(weight), off[i], n)
        cost += 0.5 * weight * off[i] * off[i]
        row += 1
    return row, cost


@lean
def ask_height(K, V, W, J, row, k, gap, weight, n):
    """Return the row of a place's height above what it should have."""
    if weight == 0.0:
        return row, 0.0
    add_point(K, W, k, (0.0, 0.0, 1.0))
    put_row(K, V, W, J, row, np.sqrt(V.wishes[STIFFNESS] * weight), gap, n)
    return row + 1, 0.5 * weight * gap * gap


@lean
def ask_floor(K, V, W, J, row, contact, n):
    """Rows of soles that stand, and of soles and capsules that are below their clearance."""
    keys, stance, cost = K.counts[KEYS], V.wishes[STANCE], 0.0
    for corner in range(8):
        stands = contact[corner // 2] > 0.5
        gap = W.points[keys + 4 + corner, 2] - (0.0 if stands else V.wishes[CLEARANCE])
        weight = stance if stands else (V.wishes[SWINGING] * stance if gap < 0.0 else 0.0)
        row, more = ask_height(K, V, W, J, row, keys + 4 + corner, gap, weight, n)
        cost += more
    for capsule in K.above:
        for end in range(2):
            k = keys + 12 + 2 * capsule + end
            gap = W.points[k, 2] - V.radii[capsule] - V.wishes[CLEARANCE]
            weight = V.wishes[SWINGING] * stance if gap < 0.0 else 0.0
            row, more = ask_height(K, V, W, J, row, k, gap, weight, n)
            cost += more
    return row, cost


@lean
def capsule(K, V, W, i):
    """Return one end of its axis, the vector to the other, and its radius."""
    k = K.counts[KEYS] + 12 + 2 * i
    start = triple(W.points, k)
    return start, minus(triple(W.points, k + 1), start), V.radii[i]


@lean
def find_near(K, V, W):
    """Return how many pairs of capsules are nearer than the margin: their numbers and distances are in ``W.near``."""
    margin, count, spheres = V.wishes[MARGIN], 0, W.spheres
    for i in range(K.counts[CAPSULES]):
        start, along, radius = capsule(K, V, W, i)
        put(spheres, i, plus(start, times(0.5, along)))
        spheres[i, 3] = 0.5 * np.sqrt(inner(along, along)) + radius + 0.5 * margin
    for p in range(K.counts[PAIRS]):
        a, b = K.pairs[2 * p], K.pairs[2 * p + 1]
        x, y, z = spheres[b, 0] - spheres[a, 0], spheres[b, 1] - spheres[a, 1], spheres[b, 2] - spheres[a, 2]
        radii = spheres[a, 3] + spheres[b, 3]
        if x * x + y * y + z * z < radii * radii:
            start_a, along_a, radius_a = capsule(K, V, W, a)
            start_b, along_b, radius_b = capsule(K, V, W, b)
            distance = nearest(start_a, along_a, radius_a, start_b, along_b, radius_b)[0]
            if distance < margin:
                W.near[2 * count], W.near[2 * count + 1] = p, distance
                count += 1
    return count


@lean
def keep_nearest(near, count, most):
    """Leaves no more than so many pairs, the nearest."""
    while count > most:
        worst = 0
        for i in range(1, count):
            worst = i if near[2 * i + 1] > near[2 * worst + 1] else worst
        count -= 1
        near[2 * worst], near[2 * worst + 1] = near[2 * count], near[2 * count + 1]
    return count


@lean
def ask_apart(K, V, W, J, row, n):
    """Rows of capsules that are too near."""
    weight, cost = V.wishes[APART], 0.0
    root = np.sqrt(V.wishes[STIFFNESS] * weight)
    count = keep_nearest(W.near, find_near(K, V, W), K.counts[MOST_PAIRS])
    origin = triple(W.position, K.counts[ROOT])
    for i in range(count):
        p = int(W.near[2 * i])
        a, b = K.pairs[2 * p], K.pairs[2 * p + 1]
        start_a, along_a, radius_a = capsule(K, V, W, a)
        start_b, along_b, radius_b = capsule(K, V, W, b)
        distance, on_a, on_b, normal = nearest(start_a, along_a, radius_a, start_b, along_b, radius_b)
        first = K.counts[KEYS] + 12
        add_rates(W.line, W.masks[K.places[first + 2 * b]], W.motion, normal, cross(minus(on_b, origin), normal))
        back = times(-1.0, normal)
        add_rates(W.line, W.masks[K.places[first + 2 * a]], W.motion, back, cross(minus(on_a, origin), back))
        gap = distance - V.wishes[MARGIN]
        put_row(K, V, W, J, row, root, gap, n)
        cost += 0.5 * weight * gap * gap
        row += 1
    return row, cost


@lean
def stand(K, V, W, moving, points, n):
    """Where the middles of heels and toes are, x and y in turn, and how dofs move them."""
    first = K.counts[KEYS] + 4
    origin = triple(W.position, K.counts[ROOT])
    for i in range(4):
        at = times(0.5, plus(triple(W.points, first + 2 * i), triple(W.points, first + 2 * i + 1)))
        for k in range(2):
            d = unit(k)
            add_rates(W.line, W.masks[K.places[first + 2 * i]], W.motion, d, cross(minus(at, origin), d))
            put_row(K, V, W, moving, 2 * i + k, 1.0, 0.0, n)
            points[2 * i + k] = at[k]


@lean
def clipped(x, lower, upper):
    """Return x inside its bounds; NaN where one of the three is."""
    if not x >= lower:
        return lower
    return x if x <= upper else upper


@lean
def ask_joints(K, V, q, alone, gradient):
    """Return what joints cost by themselves, wishes and bounds."""
    posture, limit, stiffness = V.wishes[POSTURE], V.wishes[LIMIT], V.wishes[STIFFNESS]
    soft, penalty = 0.0, 0.0
    for j in range(len(alone)):
        alone[j], gradient[j] = 0.0, 0.0
        if K.joints[j] >= 0:
            at = q[K.joints[j]]
            off, outside = at - V.rest[j], at - clipped(at, V.lower[j], V.upper[j])
            weight = limit if outside != 0.0 else 0.0
            alone[j] = posture + stiffness * weight
            gradient[j] = posture * off + stiffness * weight * outside
            soft += 0.5 * posture * off * off
            penalty += 0.5 * weight * outside * outside
    return soft, penalty


@lean
def ask(K, V, W, G, t, J, n):
    """All rows of a frame that weigh something: their number, and what wishes and bounds cost."""
    row, soft = ask_limbs(K, V, W, J, 0, G.directions[t], n)
    row, more = ask_root(K, V, W, J, row, three(G.root[t], 0), n)
    soft += more
    row, more = ask_turn(K, V, W, J, row, 0, nine(G.pelvis[t]), V.wishes[PELVIS], n)
    soft += more
    for i in range(2):
        row, more = ask_turn(K, V, W, J, row, 2 + i, nine(G.feet[t, 9 * i :]), V.wishes[FOOT], n)
        soft += more
    if K.counts[BENDS] != 0:
        row, more = ask_turn(K, V, W, J, row, 1, nine(G.torso[t]), V.wishes[TORSO], n)
        soft += more
    row, penalty = ask_floor(K, V, W, J, row, G.contact[t], n)
    row, more = ask_apart(K, V, W, J, row, n)
    penalty += more
    row, more = ask_balance(K, V, W, J, row, G.contact[t], n)
    return row, soft, penalty + more


@lean
def tie(J, row, moving, weight, move, weight_next, move_next, n):
    """Rows of standing points, that weigh by the frame before and by the next: the number of rows then."""
    for k in range(POINTS):
        both = weight[k] + weight_next[k]
        if both > 0.0:
            root = np.sqrt(both)
            for j in range(n):
                J[row, j] = root * moving[k, j]
            J[row, n] = (weight[k] * move[k] - weight_next[k] * move_next[k]) / root
            row += 1
    return row


@lean
def finish(J, rows, block, gradient, n):
    """Minus a frame's matrix, the upper triangle, and its gradient; what joints ask for is in the gradient already."""
    for i in range(n):
        for j in range(i // WIDTH * WIDTH, block.shape[1]):
            block[i, j] = 0.0
    take_square(block, J, n, block.shape[1], 0, rows)
    for i in range(n):
        gradient[i] -= block[i, n]


@lean
def ask_clip(K, V, W, G, R, q, out):
    """All frames of a clip.

    Args:
        K: structure.
        V: numbers.
        W: memory for a frame.
        G: goals.
        R: memory for rows.
        q: configurations. (F, nq)
        out: its matrices, gradients and so on.

    Returns:
        what wishes cost, and what bounds do.
    """
    frames, n = out.gradient.shape
    soft, penalty = 0.0, 0.0
    for k in range(POINTS):
        R.weight[2, k] = R.move[2, k] = 0.0
    for t in range(frames):
        now, before = t % 2, 1 - t % 2
        there, moving = G.present[t] != 0.0, out.moving[t * POINTS : t * POINTS + POINTS]
        fill(out.alone[t], 0.0)
        fill(out.gradient[t], 0.0)
        R.count[now] = 0
        if there or any_number(G.contact[t]):
            place(K, V, W, q[t])
            stand(K, V, W, moving, R.points[now], n)
        for k in range(POINTS):
            weight = V.wishes[STANCE] * G.contact[t, k // 2] * G.contact[t - 1, k // 2] if t > 0 else 0.0
            move = R.points[now, k] - R.points[before, k] if weight != 0.0 else 0.0
            R.weight[now, k], R.move[now, k] = V.wishes[STIFFNESS] * weight, move
            out.weight[t, k] = R.weight[now, k]
            penalty += 0.5 * weight * move * move
        if t > 0:
            close(R, out, t - 1, now, n)
        if there:
            wishes, bounds = ask_joints(K, V, q[t], out.alone[t], out.gradient[t])
            soft, penalty = soft + wishes, penalty + bounds
            rows = R.rows[now * R.most : now * R.most + R.most]
            R.count[now], wishes, bounds = ask(K, V, W, G, t, rows, n)
            soft, penalty = soft + wishes, penalty + bounds
    close(R, out, frames - 1, 2, n)
    return soft, penalty


@lean
def close(R, out, t, following, n):
    """Finish frame t, of which ``following`` says where the standing points of the next are."""
    own, N = t % 2, out.blocks.shape[1]
    J, moving = R.rows[own * R.most : own * R.most + R.most], out.moving[t * POINTS : t * POINTS + POINTS]
    count = tie(J, R.count[own], moving, R.weight[own], R.move[own], R.weight[following], R.move[following], n)
    finish(J, count, out.blocks[t * N : t * N + N], out.gradient[t], n)
