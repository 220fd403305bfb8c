"""Kernel of ``tasks/_pose.py``: the rows of tasks that ask for a pose by its position and its rotation, one by one.

The error of the position p is ``p - p*``, along the world's axes or the frame's; that of the rotation R is the
logarithm e of ``R R*'``, or of ``R*'R``, whose rate is E w: E the inverse left Jacobian of SO(3) at e, w the angular
velocity in the axes on the left. In the frame's axes it is ``E' R' w``.
"""

from __future__ import annotations

import numpy as np

from ...numerics._constants import SMALL_ANGLE_SQUARED, SMALL_SINE_SQUARED
from ._dense import fill
from ._frame import arguments, data, dimension, is_call, lean, matrix, results, vector, whole_numbers
from ._rigid import composed, cross, minus, transposed
from ._rigid import turned as rotated


@lean
def nine(a):
    """Return a rotation from an array of its numbers."""
    return a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8]


@lean
def three(a, first):
    """Return a vector from three numbers of an array."""
    return a[first], a[first + 1], a[first + 2]


@lean
def scaled(by, a):
    """Return a vector times a number."""
    return by * a[0], by * a[1], by * a[2]


@lean
def quaternion_of(m):
    """Return the quaternion of a rotation, by the largest number of four; w is not negative.

    M. Day, "Converting a rotation matrix to a quaternion", 2015.
    """
    if m[8] < 0.0:
        if m[0] > m[4]:
            t = 1.0 + m[0] - m[4] - m[8]
            q = m[7] - m[5], t, m[3] + m[1], m[2] + m[6]
        else:
            t = 1.0 - m[0] + m[4] - m[8]
            q = m[2] - m[6], m[3] + m[1], t, m[7] + m[5]
    elif m[0] < -m[4]:
        t = 1.0 - m[0] - m[4] + m[8]
        q = m[3] - m[1], m[2] + m[6], m[7] + m[5], t
    else:
        t = 1.0 + m[0] + m[4] + m[8]
        q = t, m[7] - m[5], m[2] - m[6], m[3] - m[1]
    factor = 0.5 / np.sqrt(t)
    factor = -factor if q[0] < 0.0 else factor
    return factor * q[0], factor * q[1], factor * q[2], factor * q[3]


@lean
def logarithm(m):
    """Return the rotation vector of a rotation, its angle in [0, pi]."""
    w, x, y, z = quaternion_of(m)
    sine_squared = x * x + y * y + z * z
    if sine_squared < SMALL_SINE_SQUARED:
        tangent_squared = sine_squared / (w * w)
        factor = (2.0 - tangent_squared * (2.0 / 3.0 - tangent_squared * (2.0 / 5.0))) / w
    else:
        sine = np.sqrt(sine_squared)
        factor = 2.0 * np.arctan2(sine, w) / sine
    return factor * x, factor * y, factor * z


@lean
def inverse_left_jacobian(e):
    """Return I - [e]/2 + c [e]^2 with ``c = (1 - (angle/2) cot(angle/2)) / angle^2``."""
    x, y, z = e
    s = x * x + y * y + z * z
    if s < SMALL_ANGLE_SQUARED:
        c = 1 / 12 + s * (1 / 720 + s * (1 / 30240 + s * (1 / 1209600 + s / 47900160)))
    else:
        half = 0.5 * np.sqrt(s)
        c = (1.0 - half * np.cos(half) / np.sin(half)) / s
    hx, hy, hz = 0.5 * x, 0.5 * y, 0.5 * z
    return (
        1.0 + c * (x * x - s),
        c * x * y + hz,
        c * x * z - hy,
        c * x * y - hz,
        1.0 + c * (y * y - s),
        c * y * z + hx,
        c * x * z + hy,
        c * y * z - hx,
        1.0 + c * (z * z - s),
    )


@lean
def write_rows(whole, J, A, first, turning):
    """Write three of the six rows, from ``first`` on: A J for the linear or, with ``turning``, angular half of J."""
    for j in range(J.shape[1]):
        v = rotated(A, (J[turning, j], J[turning + 1, j], J[turning + 2, j]))
        for i in range(3):
            whole[first + i, j] = v[i]


@lean
def pose_rows(p, R, J, p_wanted, R_wanted, rates, in_frame, geometric, whole, error, forward):
    """Write all six rows, their errors and what the target's own velocity adds.

    Args:
        p: position of the frame.
        R: its rotation.
        J: its Jacobian, [linear; angular]. (6, nv)
        p_wanted: the target's position.
        R_wanted: its rotation.
        rates: its velocity, likewise. (6,)
        in_frame: whether rows are along the frame's axes.
        geometric: whether E is left out.
        whole: the rows. (6, nv)
        error: (6,)
        forward: (6,)
    """
    own, linear, angular = transposed(R), three(rates, 0), three(rates, 3)
    identity = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    offset = minus(p, p_wanted)
    if in_frame:
        between = composed(transposed(R_wanted), R)
        turn = logarithm(between)
        E = identity if geometric else inverse_left_jacobian(turn)
        factor = composed(transposed(E), own)
        write_rows(whole, J, own, 0, 0)
        for j in range(J.shape[1]):  # the offset turns with the frame
            v = rotated(own, cross(offset, (J[3, j], J[4, j], J[5, j])))
            for i in range(3):
                whole[i, j] += v[i]
        offset, linear, angular = rotated(own, offset), rotated(own, linear), rotated(factor, angular)
    else:
        between = composed(R, transposed(R_wanted))
        turn = logarithm(between)
        factor = identity if geometric else inverse_left_jacobian(turn)
        write_rows(whole, J, identity, 0, 0)
        angular = rotated(factor, rotated(between, angular))
    write_rows(whole, J, factor, 3, 3)
    for i in range(3):
        error[i], error[3 + i] = offset[i], turn[i]
        forward[i], forward[3 + i] = linear[i], angular[i]


@lean
def paired(pull, axes, arms):
    """Return the Frobenius norm of the matrix with the entries ``pull . (axis_i x arm_j)``.

    Args:
        pull: a vector.
        axes: products of the axes with each other: xx, xy, xz, yy, yz, zz.
        arms: those of the arms.
    """
    size = max(abs(pull[0]), abs(pull[1]), abs(pull[2]))
    if not size > 0.0:
        return 0.0
    x, y, z = scaled(1.0 / size, pull)
    xx, xy, xz, yy, yz, zz = axes
    # products of ``pull x axis_i`` with each other
    txx = y * y * zz - 2.0 * y * z * yz + z * z * yy
    tyy = z * z * xx - 2.0 * z * x * xz + x * x * zz
    tzz = x * x * yy - 2.0 * x * y * xy + y * y * xx
    txy = y * z * xz - x * y * zz - z * z * xy + x * z * yz
    txz = x * y * yz - y * y * xz - x * z * yy + y * z * xy
    tyz = x * z * xy - y * z * xx - x * x * yz + x * y * xz
    xx, xy, xz, yy, yz, zz = arms
    squared = txx * xx + tyy * yy + tzz * zz + 2.0 * (txy * xy + txz * xz + tyz * yz)
    return size * np.sqrt(squared) if squared > 0.0 else 0.0


@lean
def pose_curvature(R, J, weight, pull, kept, in_frame):
    """Return ``tasks/_curvature.py: pose_curvature`` of the weighted pull of the rows that are kept."""
    fx, fy, fz, tx, ty, tz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    row = 0
    for i in range(6):
        if kept[i] == 0:
            continue
        p = weight[row] * pull[row]
        row += 1
        if i == 0:
            fx = p
        elif i == 1:
            fy = p
        elif i == 2:
            fz = p
        elif i == 3:
            tx = p
        elif i == 4:
            ty = p
        else:
            tz = p
    force, torque = (fx, fy, fz), (tx, ty, tz)
    if in_frame:
        force, torque = rotated(R, force), rotated(R, torque)
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    axx, axy, axz, ayy, ayz, azz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(J.shape[1]):
        x, y, z = J[3, j], J[4, j], J[5, j]
        if x == 0.0 and y == 0.0 and z == 0.0:
            continue
        xx, xy, xz, yy, yz, zz = xx + x * x, xy + x * y, xz + x * z, yy + y * y, yz + y * z, zz + z * z
        x, y, z = J[0, j], J[1, j], J[2, j]
        axx, axy, axz, ayy, ayz, azz = axx + x * x, axy + x * y, axz + x * z, ayy + y * y, ayz + y * z, azz + z * z
    axes = (xx, xy, xz, yy, yz, zz)
    return (paired(force, axes, (axx, axy, axz, ayy, ayz, azz)) + 0.5 * paired(torque, axes, axes)) / np.sqrt(2.0)


def handle(frame):
    """Answer a call of XLA: arguments as in ``tasks/_pose.py``, each with a leading axis of lanes, or of 1."""
    if not is_call(frame):
        return 0
    given, found = arguments(frame), results(frame)  # pointers to buffers, eight bytes each
    lanes, m, nv = dimension(found, 0), dimension(found, 8), dimension(found + 8, 16)
    options = whole_numbers(data(given + 32), 8)
    in_frame, geometric, space = options[6] != 0, options[7] != 0, data(found + 48)
    whole = matrix(space, 6, nv)
    wrong, forward = vector(space + 48 * nv, 6), vector(space + 48 * nv + 48, 6)
    # bytes between the lanes of each argument, 0 where all have the same
    at, facing = 24 * (dimension(given, 0) > 1), 72 * (dimension(given + 8, 0) > 1)
    moving, other = 48 * nv * (dimension(given + 16, 0) > 1), 8 * (19 + m) * (dimension(given + 24, 0) > 1)
    for lane in range(lanes):
        R, J = nine(vector(data(given + 8) + facing * lane, 9)), matrix(data(given + 16) + moving * lane, 6, nv)
        p, first = three(vector(data(given) + at * lane, 3), 0), data(given + 24) + other * lane
        rates, weight, gain = vector(first + 96, 6), vector(first + 144, m), vector(first + 144 + 8 * m, 1)[0]
        pose_rows(
            p, R, J, three(vector(first, 3), 0), nine(vector(first + 24, 9)), rates, in_frame, geometric, whole, wrong,
            forward,
        )  # fmt: skip
        error, rows = vector(data(found) + 8 * m * lane, m), matrix(data(found + 8) + 8 * m * nv * lane, m, nv)
        wanted, pull = vector(data(found + 16) + 8 * m * lane, m), vector(data(found + 32) + 8 * m * lane, m)
        levers = vector(data(found + 40) + 8 * nv * lane, nv)
        fill(levers, 0.0)
        row = 0
        for i in range(6):
            if options[i] == 0:
                continue
            error[row], pull[row] = wrong[i], gain * wrong[i]
            wanted[row] = forward[i] - pull[row]
            for j in range(nv):
                rows[row, j] = whole[i, j]
                levers[j] += weight[row] * whole[i, j] * whole[i, j]
            row += 1
        for j in range(nv):
            levers[j] = np.sqrt(levers[j])
        vector(data(found + 24) + 8 * lane, 1)[0] = pose_curvature(R, J, weight, pull, options, in_frame)
    return 0
