"""Candidates for hierarchies from the compiled core (``core/hierarchy.hpp``)."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...core import _library
from ._cascade import CascadeResult
from ._implicit_diff import ActiveSets
from ._padding import Layout, PaddedHierarchy
from ._problem import Tolerances, WorkingSet


def solve(
    layout: Layout,
    hierarchy: PaddedHierarchy,
    tolerances: Tolerances,
    warm_start: WorkingSet | None,
    max_iterations: int,
) -> CascadeResult:
    """Return candidates for a batch of hierarchies, for all levels including the last.

    Args:
        layout: sizes and row indices (static).
        hierarchy: the numbers, with a leading axis of problems.
        tolerances: what counts as zero, one of each a problem.
        warm_start: working sets to try first; all zeros in a problem for none.
        max_iterations: limit on the active-set iterations of one level (static).
    """

    def call(shapes: _library.Shapes, numbers: list[Array], integers: list[Array]) -> list[Array]:
        sizes = layout.row_counts, layout.level_of_hard, layout.row_of_hard, [max_iterations]
        return _library.call("hierarchy", shapes, *numbers, *integers, *(np.array(a, np.int32) for a in sizes))

    return answers(call, hierarchy, tolerances, warm_start)


def answers(
    call: Callable[[_library.Shapes, list[Array], list[Array]], list[Array]],
    hierarchy: PaddedHierarchy,
    tolerances: Tolerances,
    warm_start: WorkingSet | None,
) -> CascadeResult:
    """Return a kernel's uncertified answers in the form of the search's.

    ``call`` is given the shapes of the results, in the order of ``Answer`` in ``core/hierarchy.hpp``, and the numbers
    and the integers of ``Problem``.
    """
    batch, count, m, n = hierarchy.levels.matrix.shape
    h = hierarchy.hard.shape[1]
    levels, damping = hierarchy.levels, hierarchy.damping
    numbers = [levels.matrix, levels.lower, levels.upper, hierarchy.hard[:, n:], hierarchy.hard_lower]
    numbers += [hierarchy.hard_upper, jnp.stack(damping[:3], -1), damping.bends, jnp.stack(tolerances, -1)]
    guess = warm_start or (jnp.zeros((batch, count, h), int), jnp.zeros((batch, count, m), int))
    labels = (n,), (count, h), (count, h), (count, m), (count, m), (count,), (3,)
    shapes = _library.shapes_of(batch, ((n,), (count, h), (count,), (count,), ()), labels)
    integers = [levels.equal, hierarchy.hard_is_equality, *guess]
    x, multipliers, slack_norms, dampings, residual, *others = call(shapes, numbers, integers)
    active_bounds, active, frozen, in_cost, own, ranks, report = others
    # the derivative keeps rows that a damped level has at their bounds, frozen or not
    kept = jnp.where(dampings[:, :, None] > 0.0, active, frozen)
    sets = active_bounds, ActiveSets(kept, frozen, in_cost, ranks), WorkingSet(active, own)
    ended, iterations, factorizations = (report[:, k] for k in range(3))
    return CascadeResult(x, *sets, multipliers, slack_norms, residual, iterations, factorizations, ended != 0)
