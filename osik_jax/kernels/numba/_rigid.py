"""Rotations and quaternions (w, x, y, z) of the kernels, as tuples of numbers, rows of matrices one after another."""

from __future__ import annotations

import numpy as np

from ...numerics._constants import SMALL_SINE_SQUARED
from ._frame import lean


@lean
def triple(a, i):
    """Return row i of an array of threes."""
    return a[i, 0], a[i, 1], a[i, 2]


@lean
def put(a, i, v):
    """Write row i of an array of threes."""
    a[i, 0], a[i, 1], a[i, 2] = v


@lean
def plus(a, b):
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@lean
def minus(a, b):
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@lean
def cross(a, b):
    """Return a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@lean
def turning(R, i):
    """Return row i of an array of rotations."""
    return R[i, 0], R[i, 1], R[i, 2], R[i, 3], R[i, 4], R[i, 5], R[i, 6], R[i, 7], R[i, 8]


@lean
def put_turning(R, i, A):
    """Write row i of an array of rotations."""
    for k in range(9):
        R[i, k] = A[k]


@lean
def turned(R, v):
    """Return R v."""
    return (
        R[0] * v[0] + R[1] * v[1] + R[2] * v[2],
        R[3] * v[0] + R[4] * v[1] + R[5] * v[2],
        R[6] * v[0] + R[7] * v[1] + R[8] * v[2],
    )


@lean
def transposed(R):
    """Return R'."""
    return R[0], R[3], R[6], R[1], R[4], R[7], R[2], R[5], R[8]


@lean
def composed(A, B):
    """Return A B."""
    return (
        A[0] * B[0] + A[1] * B[3] + A[2] * B[6],
        A[0] * B[1] + A[1] * B[4] + A[2] * B[7],
        A[0] * B[2] + A[1] * B[5] + A[2] * B[8],
        A[3] * B[0] + A[4] * B[3] + A[5] * B[6],
        A[3] * B[1] + A[4] * B[4] + A[5] * B[7],
        A[3] * B[2] + A[4] * B[5] + A[5] * B[8],
        A[6] * B[0] + A[7] * B[3] + A[8] * B[6],
        A[6] * B[1] + A[7] * B[4] + A[8] * B[7],
        A[6] * B[2] + A[7] * B[5] + A[8] * B[8],
    )


@lean
def multiplied(p, q):
    """Return the quaternion p q."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@lean
def carried(q, v):
    """Return q v q*: the vector turned, and stretched by the square of the quaternion's length."""
    u = q[1], q[2], q[3]
    along = 2.0 * (u[0] * v[0] + u[1] * v[1] + u[2] * v[2])
    own = q[0] * q[0] - (u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
    side, twice = cross(u, v), 2.0 * q[0]
    return (
        along * u[0] + own * v[0] + twice * side[0],
        along * u[1] + own * v[1] + twice * side[1],
        along * u[2] + own * v[2] + twice * side[2],
    )


@lean
def rotation_of(q):
    """Return the rotation of a quaternion of any length but 0."""
    factor = 2.0 / (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    x, y, z = factor * q[1], factor * q[2], factor * q[3]
    wx, wy, wz = q[0] * x, q[0] * y, q[0] * z
    xx, xy, xz = q[1] * x, q[1] * y, q[1] * z
    yy, yz, zz = q[2] * y, q[2] * z, q[3] * z
    return 1.0 - yy - zz, xy - wz, xz + wy, xy + wz, 1.0 - xx - zz, yz - wx, xz - wy, yz + wx, 1.0 - xx - yy


@lean
def normalized(q):
    """Return the quaternion over its length; one of zeros as MJX has it, finite and of no use."""
    if max(abs(q[0]), abs(q[1]), abs(q[2]), abs(q[3])) <= 1e-8:
        return 1e6, 1e6, 1e6, 1e6
    length = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] / length, q[1] / length, q[2] / length, q[3] / length


@lean
def nine(a):
    """Return a rotation from an array of its numbers."""
    return a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8]


@lean
def three(a, first):
    """Return a vector from three numbers of an array."""
    return a[first], a[first + 1], a[first + 2]


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
