"""Classical projection (eqs. 6 and 7): from the highest level down, each in the null space of the higher ones.

    v_k = v_{k-1} + (J_k P_{k-1})^+ (b_k - J_k v_{k-1}),    P_k = P_{k-1} - (J_k P_{k-1})^+ (J_k P_{k-1})

with the Moore-Penrose inverse (Y. Nakamura, H. Hanafusa, T. Yoshikawa, "Task-priority based redundancy control of robot
manipulators", 1987; B. Siciliano, J.-J. Slotine, 1991); rows that depend on others up to the rank tolerance are left
out. Damping acts on the motion alone; in the projector it would break idempotency, and lower levels would disturb
higher ones.

When not to use it: where bounds have to hold (``_saturation.py``), or inequalities (``solve_hqp``): an inequality row
takes part only while the levels above it leave it violated, and nothing keeps lower levels from violating it again.
Where a level loses rank against those above it, the levels below jump.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...core import _library
from ...execution._backends import Backend, on_platforms, takes
from ...execution._lanes import in_lanes
from ...execution._rules import custom_jvp
from ...numerics._constants import FULL_STEP, NEGLIGIBLE_STEP
from ...numerics._dense import apply, product
from ...numerics._guarded import greatest, quotient
from .._damping import Damping, level_damping, narrow_box
from .._inverses import row_space_and_motion
from .._level import Level, PaddedLevel
from . import _cuda
from ._padding import ActiveTask

Answer = tuple[Float[Array, " n"], Float[Array, "n n"]]
"""Answer x, and the projector onto the null space of all levels."""


def project(
    levels: Sequence[Level], secondary: Float[Array, " n"], damping: Damping, rank_tol: Array | float, backend: Backend
) -> Answer:
    """Return the result of ``solve_forward``, by the core if it is there, which computes in double precision."""
    rank_tol = jnp.asarray(rank_tol, secondary.dtype)
    if takes(backend, "core", fits=True):
        return _by_kernel(list(levels), secondary, damping, rank_tol, backend=backend)
    return solve_forward(list(levels), secondary, damping, rank_tol, backend=backend)


@custom_jvp
def _by_kernel(levels: list[Level], secondary: Array, damping: Damping, rank_tol: Array, *, backend: Backend) -> Answer:
    return _on_platform(backend)(levels, secondary, damping, rank_tol)


@_by_kernel.defjvp
def _by_kernel_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...], *, backend: Backend) -> tuple[Answer, Answer]:
    return jax.jvp(partial(solve_forward, backend=backend), primals, tangents)


@cache
def _on_platform(backend: Backend) -> Callable[[list[Level], Array, Damping, Array], Answer]:
    """Return the function that solves one problem on the current platform."""
    plain = jax.vmap(partial(solve_forward, backend=backend))

    def solve(levels: list[Level], secondary: Float[Array, "B n"], *rest: Any) -> Any:
        kernels: dict[str, Callable[..., Any]] = dict(core=partial(_by_core, _library.call))
        rows = tuple(level.matrix.shape[1] for level in levels)
        if takes(backend, "core-cuda", fits=_cuda.fits(secondary.shape[1], rows)):
            kernels["core-cuda"] = partial(_by_core, _cuda.project)
        return on_platforms(kernels, plain, levels, secondary, *rest)

    return in_lanes(solve)


def _by_core(
    call: Callable[..., list[Array]],
    levels: list[Level],
    secondary: Float[Array, "B n"],
    damping: Damping,
    rank_tol: Float[Array, " B"],
) -> tuple[Float[Array, "B n"], Float[Array, "B n n"]]:
    batch, n = secondary.shape
    equal = [jax.vmap(lambda one: one.equal)(level) for level in levels]
    rows = [a for level, e in zip(levels, equal, strict=True) for a in (level.matrix, level.lower, level.upper, e)]
    outputs = [((batch, n), float), ((batch, n, n), float)]
    x, projector = call("projection", outputs, secondary, *damping, rank_tol, *rows)
    return x, projector


def solve_forward(
    levels: Sequence[Level],
    secondary: Float[Array, " n"],
    damping: Damping,
    rank_tol: Array | float,
    backend: Backend = "jax",
) -> Answer:
    """Return the answer, and the projector onto the null space of all levels.

    The arguments are those of ``pad_levels``; the secondary motion is projected onto what all levels leave free.
    """
    x, projector = jnp.zeros_like(secondary), jnp.eye(len(secondary), dtype=secondary.dtype)
    curvature = jnp.zeros_like(x)
    lower, upper = jnp.full_like(x, -jnp.inf), jnp.full_like(x, jnp.inf)
    for level, *parts in zip(levels, *damping, strict=True):
        one = Damping(*parts)
        # eq. 7: x_k = x_{k-1} + (J_k P_{k-1})^+ (b_k - J_k x_{k-1}), and P_k
        motion, projector, _ = level_motion(level, x, projector, one, rank_tol, backend)
        x = x + _step_length(x, motion, lower, upper) * motion
        lower, upper, curvature = narrow_box(one, level, curvature, x, lower, upper)
    # the secondary motion in the null space of all levels, inside the same box
    motion = apply(projector, secondary)
    return x + _step_length(x, motion, lower, upper) * motion, projector


def _step_length(
    x: Float[Array, " n"], motion: Float[Array, " n"], lower: Float[Array, " n"], upper: Float[Array, " n"]
) -> Float[Array, ""]:
    """Return the largest step length up to 1 within the box that levels beyond reach leave to lower ones."""
    gap = jnp.where(motion > 0.0, upper - x, x - lower)
    stops = gap < jnp.abs(motion)
    # the double where keeps quotients by tiny numbers, whose derivatives are infinite, out of the derivative
    lengths = jnp.where(stops, quotient(jnp.where(stops, gap, 1.0), jnp.where(stops, jnp.abs(motion), 1.0)), 1.0)
    return -greatest(-lengths)


def level_motion(
    level: Level | PaddedLevel,
    x: Float[Array, " n"],
    projector: Float[Array, "n n"],
    damping: Damping,
    rank_tol: Array | float,
    backend: Backend = "jax",
) -> tuple[Float[Array, " n"], Float[Array, "n n"], Float[Array, ""]]:
    """Return the motion of one level from x, the projector for the next level, and the level's damping.

    Rows inside their interval at x take no part. ``projector`` is P_{k-1}, onto the null space of the levels above; the
    motion stays in it. Rows that stand out of the span of the others by less than ``rank_tol``, relative to the norm of
    all that take part, count as dependent.
    """
    if not level.matrix.shape[0]:
        return jnp.zeros_like(x), projector, jnp.zeros_like(x[0])
    task = ActiveTask.at(level, x, rank_tol)
    unbounded = jnp.full_like(x, jnp.inf)
    total = level_damping(damping, level, x, projector, -unbounded, unbounded)
    # with P = P_{k-1}: the rows J_k P, and the motion P J_k' (J_k P J_k' + damping I)^-1 error
    restricted = product(task.rows, projector)
    space, motion = row_space_and_motion(restricted, task.error, task.cutoff, total, None, backend=backend)
    # roundoff over small singular values has components outside the projector's range, so the motion is projected
    return apply(projector, motion), projector - product(projector, product(space, projector)), total


def damped_step_length(
    level: Level | PaddedLevel,
    start: Float[Array, " n"],
    step: Float[Array, " n"],
    damping: Float[Array, ""],
    rank_tol: Array | float,
) -> Float[Array, ""]:
    """Return the length of a step from start, 1 at most, that minimises the damped cost of a level.

    Without bounds, the motion of a level is the damped optimum. Where bounds stop some joints, the others may need far
    larger motions for the same rows, which cost more than they gain; so only a part t of the step d is taken. Its cost,
    ``1/2 |t A d - error|^2 + 1/2 damping t^2 |d|^2``, is least at ``t = error'A d / (|A d|^2 + damping |d|^2)``. A are
    the rows of the level that take part at ``start``; the damping is in squared singular values.
    """
    task = ActiveTask.at(level, start, rank_tol)
    change = apply(task.rows, step)
    square = jnp.sum(step**2)
    cost = jnp.sum(change**2) + damping * square
    is_damped = (damping > 0.0) & (cost > 0.0) & (square > NEGLIGIBLE_STEP**2 * jnp.sum(start**2))
    length = quotient(jnp.sum(change * task.error), jnp.where(is_damped, cost, 1.0))
    return jnp.where(is_damped & (length < FULL_STEP), jnp.maximum(length, 0.0), 1.0)
