"""Upper bounds on the curvature of a task's error along the feedback ``gain e``.

A step of dt changes the error by ``dt J v + dt^2/2 (grad^2 e)[v, v] + ...``, and a solver minimises
``1/2 w |J v + gain e|^2`` as if the second term were not there. What it leaves out of the cost is, to first order,

    1/2 dt p . (grad^2 e)[v, v]  <=  1/2 dt c |v|^2,    p = w gain e,    c >= |sum_i p_i grad^2 e_i|,

so a damping ``dt c`` on the velocity makes the model an upper bound of the true cost, as a majoriser or a trust region
does: a step never buys a better model at the price of a worse error. It vanishes with the error, so that convergence
stays fast (J. Fan, Y. Yuan, "On the quadratic convergence of the Levenberg-Marquardt method without nonsingularity
assumption", Computing 74, 2005).

For the position p of a frame and dofs i before j on its chain the second derivative is ``w_i x J_j``, w_i the axis of
dof i and J_j the linear Jacobian's column. The matrix with the entries ``p . (w_i x J_j)`` for all i and j has each of
them twice, and its Frobenius norm costs two 3 x 3 products. Over the root of 2 it is about the symmetric matrix's
greatest eigenvalue, and not far under it (``python -m benchmarks.curvature`` tells how far in random configurations). A
step is stable from half of that eigenvalue on. The norms of single columns of J are too small: the entries off the
diagonal count.

Not all of the bound has to be damped: where a task bends most its frame moves across the pull, and there its own rows
resist the motion (``fraction_to_damp``).
"""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..execution._platform import cuda_is_default
from ..numerics._constants import FARTHEST_ERROR, LEVER_ROUNDOFF, NEAR_ERROR, NEAR_PART, UNHELD_PART
from ..numerics._dense import short_sum
from ..numerics._guarded import largest, positive_root, quotient, safe_norm
from ._rotation import dot


def pose_curvature(
    pull: Float[Array, "3"], torque: Float[Array, "3"], jacobian: Float[Array, "6 nv"]
) -> Float[Array, ""]:
    """Return the bound for a frame with a force and torque at its origin, in the axes of its Jacobian.

    Rows of the Jacobian are [linear; angular]. A position bends by ``w_i x J_j``, an orientation by ``1/2 w_i x w_j``.
    Columns that turn nothing are left out: a base or a carriage that only translates bends no path.
    """
    linear, angular = jacobian[:3], jacobian[3:]
    turns = jnp.any(angular != 0.0, axis=0)
    axes, arms = _gram(angular), _gram(jnp.where(turns, linear, 0.0))
    return (_paired(pull, axes, arms) + 0.5 * _paired(torque, axes, axes)) / math.sqrt(2.0)


def _gram(rows: Float[Array, "3 n"]) -> Float[Array, "3 3"]:
    """Return the Gram matrix of rows; as sums on a GPU, where the library is slow for small sizes."""
    return short_sum(rows[:, None] * rows[None]) if cuda_is_default() else dot(rows, rows.T)


def _paired(pull: Float[Array, "3"], axes: Float[Array, "3 3"], arms: Float[Array, "3 3"]) -> Float[Array, ""]:
    """Return the Frobenius norm of the matrix with the entries ``pull . (axis_i x arm_j)``; its gradient at 0 is 0.

    The square of that norm is the sum of the products of two 3 x 3 matrices, entry by entry: those of
    ``pull x axis_i`` with each other, which are the axes' own between two cross products, and those of the arms.
    """
    size = largest(pull)
    x, y, z = pull / size
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = axes
    turned = {  # a few sums of numbers are one operation, and products of small matrices are several
        (0, 0): y * y * zz - 2.0 * y * z * yz + z * z * yy,
        (1, 1): z * z * xx - 2.0 * z * x * xz + x * x * zz,
        (2, 2): x * x * yy - 2.0 * x * y * xy + y * y * xx,
        (0, 1): y * z * xz - x * y * zz - z * z * xy + x * z * yz,
        (0, 2): x * y * yz - y * y * xz - x * z * yy + y * z * xy,
        (1, 2): x * z * xy - y * z * xx - x * x * yz + x * y * xz,
    }
    squared = sum((1.0 if i == j else 2.0) * entry * arms[i, j] for (i, j), entry in turned.items())
    return size * positive_root(jnp.asarray(squared))


def jacobian_curvature(pull: Float[Array, " m"], jacobian: Float[Array, "k nv"]) -> Float[Array, ""]:
    """Return a bound for any rows: the length of the pull times the Frobenius norm of a Jacobian.

    The Jacobian is that of the rows, or that of the quantities which the rows combine (such as a frame's position).
    """
    return safe_norm(pull) * positive_root(jnp.sum(jacobian**2))


def share_of_far(distance: Float[Array, " k"]) -> Float[Array, " k"]:
    """Return 0 for a task at its target, rising to 1 for a task whose error is many lever arms. (k,).

    The distances are errors in lever arms: times their weighted pulls, over the curvatures.
    """
    ratio = jnp.clip(distance / NEAR_ERROR, 0.0, FARTHEST_ERROR)
    return ratio**2 / (1.0 + ratio**2)


def near_part(far: Float[Array, ""]) -> Float[Array, ""]:
    """Return the factor on the curvature bounds: ``NEAR_PART`` if all tasks are at their targets, 1 if one is far.

    Near the target, directions that the rows hardly resist have a quarter of the greatest eigenvalue at most, and half
    of it as damping keeps a step stable. More damping makes a frame lag behind a moving target. ``far`` is
    ``share_of_far`` of the farthest task.
    """
    return NEAR_PART + (1.0 - NEAR_PART) * far


def fraction_to_damp(
    bound: Float[Array, " k"], far: Float[Array, " k"], stiffness: Float[Array, " k"]
) -> Float[Array, " k"]:
    """Return the fraction of each task's curvature bound to damp; the task's own rows resist the rest.

    Rows resist a motion v with ``1/2 v'J'W J v`` and leave out ``1/2 dt p . (grad^2 e)[v, v]``, which is large where
    the frame moves across p. There it is up to b, the resistance up to g, and b / (b + 2 g) of the bound is enough.
    What bends elsewhere is a small part of it (docs/dev/derivations.md, "Curvature damping"). ``bound`` is b: dt times
    the curvature; ``far`` is ``share_of_far`` of the tasks; ``stiffness`` is g, the squared Frobenius norm of the
    Jacobian with its weights' roots multiplied in.
    """
    total = 0.5 * bound + stiffness
    resisted = quotient(stiffness, jnp.where(total > 0.0, total, 1.0))
    return 1.0 - (1.0 - UNHELD_PART) * far * resisted


def no_curvature(pull: Float[Array, " m"]) -> Float[Array, ""]:
    """Return 0: rows that are linear in the joints have no curvature, whatever their weighted pull."""
    return jnp.zeros((), pull.dtype)


def levers(weight: Float[Array, " m"], jacobian: Float[Array, "m nv"]) -> Float[Array, " nv"]:
    """Return the length of each dof's weighted column: how much the dof moves the rows; gradient 0 at 0. (nv,)."""
    squared = jnp.sum(weight[:, None] * jacobian**2, axis=0)
    return positive_root(squared)


def row_sums(levers: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """Return a bound on the absolute row sums of the second derivative along a unit pull, per dof. (nv,).

    The entry of dofs i and j is at most the lever of the one that is farther from the root, and dofs stand in the order
    of the tree. So a motion d costs at most ``1/2 sum_j row_sums_j d_j^2`` at second order.
    """
    moves = levers > LEVER_ROUNDOFF * jnp.max(levers, initial=0.0)
    counted = jnp.where(moves, levers, 0.0)
    before = jnp.cumsum(moves) - moves
    return jnp.where(moves, jnp.cumsum(counted[::-1])[::-1], 0.0) + counted * before
