"""Candidates for hierarchies from the compiled core (``core/hierarchy.hpp``)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ...core import _library
from ._cascade import CascadeResult, KernelAnswers, first_working_sets, result_of_kernel
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
    batch, count, m, n = hierarchy.levels.matrix.shape
    h = hierarchy.hard.shape[1]
    guess = first_working_sets(hierarchy, warm_start)
    floats = dict(x=(n,), multipliers=(count, h), slack_norms=(count,), dampings=(count,), residual=())
    ints = dict(active_bounds=(n,), active=(count, h), frozen=(count, h), in_cost=(count, m), own=(count, m))
    ints |= dict(ranks=(count,), report=(3,))
    results = _library.call(
        "hierarchy",
        [((batch, *shape), kind) for kind, shapes in ((float, floats), (int, ints)) for shape in shapes.values()],
        *(hierarchy.levels.matrix, hierarchy.levels.lower, hierarchy.levels.upper, hierarchy.hard[:, n:]),
        *(hierarchy.hard_lower, hierarchy.hard_upper),
        *(jnp.stack(hierarchy.damping[:3], -1), hierarchy.damping.bends),
        *(jnp.stack(tolerances, -1), hierarchy.is_equality, hierarchy.hard_is_equality, *guess),
        *(np.array(a, np.int32) for a in (layout.row_counts, layout.level_of_hard, layout.row_of_hard)),
        np.array([max_iterations], np.int32),
    )
    return result_of_kernel(KernelAnswers(**dict(zip((*floats, *ints), results, strict=True))))
