"""Candidates for hierarchies from the kernel for CPUs (``solvers/kernels/numba/_hierarchy.py``)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ..kernels.numba import _target
from ._cascade import Descent, descent_of
from ._problem import Tolerances, WorkingSet
from ._stack import Layout, Stack


def solve(
    layout: Layout, stack: Stack, tolerances: Tolerances, warm: WorkingSet | None, max_iterations: int
) -> Descent:
    """Candidates for a batch of hierarchies; all levels, the last one too."""
    lanes, count, m, n = stack.levels.matrix.shape
    h = stack.hard.shape[1]
    zeros = WorkingSet(jnp.zeros((lanes, count, h), int), jnp.zeros((lanes, count, m), int))
    guess = zeros if warm is None else warm
    row_of_hard = [layout.place_of_row[layout.level_of_hard[q]].index(q) for q in range(n, h)]
    floats = dict(x=(n,), multipliers=(count, h), reached=(count,), strengths=(count,), residual=())
    ints = dict(box=(n,), sides=(count, h), tight=(count, h), missed=(count, m), own=(count, m))
    ints |= dict(ranks=(count,), report=(3,))
    found = _target.call(
        "_hierarchy",
        [((lanes, *shape), kind) for kind, shapes in ((float, floats), (int, ints)) for shape in shapes.values()],
        *(stack.levels.matrix, stack.levels.lower, stack.levels.upper, stack.hard[:, n:]),
        *(stack.hard_lower, stack.hard_upper, jnp.stack(stack.damping[:3], -1), stack.damping.bends),
        *(jnp.stack(tolerances, -1), stack.equal, stack.hard_equal, *guess),
        *(np.array(a, np.int32) for a in (layout.counts, layout.level_of_hard, row_of_hard, [max_iterations])),
    )
    names = (*floats, *ints)
    return descent_of(**dict(zip(names, found, strict=True)))
