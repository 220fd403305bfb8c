"""Steps of searches for poses by the compiled core (``core/chain_search.hpp``); on a GPU, one thread for each search.

``ChainSearch.advance_plain`` is the definition.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..execution._computed import side_by_side
from ..kinematics._kernels import Call
from ._pool import Errors


def advanced(
    call: Call, search: Any, x: Float[Array, "lanes n"], goal: Any, *, steps: int, damping: tuple[float, float]
) -> tuple[Array, Array, Errors]:
    """Return the state after some steps: start and end of the last one, and the errors at its start.

    Args:
        call: calls a method of the core.
        search: the ``ChainSearch``; arrays that all lanes share have an axis of length 1.
        x: coordinates.
        goal: the ``Goal``.
        steps: their number.
        damping: its share of the squared error, and the least one relative to the squared length of a radian.
    """
    chain, layout, kind = search.chain, search.chain.layout, x.dtype
    goals = jnp.concatenate([goal.position[..., None, :], goal.rotation], -2)
    factors, damped = (np.array([a], kind) for a in (layout.factors, damping))
    numbers = side_by_side(
        *(chain.constant, chain.first, chain.second, chain.offset, chain.axis, chain.anchor, chain.tip, factors),
        *(search.lower, search.upper, search.first, search.length, search.tolerance, search.enough, damped),
    )
    coordinates = [layout.dofs.index(entry) if entry >= 0 else -1 for entry in layout.entries]
    kept = np.array(search.rows).ravel()
    parts = [[steps, len(layout.joints), kept.sum(), search.near], layout.parents, layout.hinges, coordinates]
    parts += [layout.ends, layout.carries, np.where(kept, np.cumsum(kept) - 1, -1)]
    lanes = max(len(a) for a in (x, goals, numbers))
    shapes = [((lanes, x.shape[1]), float)] * 2 + [((lanes, 4), float)]
    integers = np.concatenate([np.ravel(part) for part in parts]).astype(np.int32)
    n, rows = x.shape[1], 6 * len(layout.ends)
    space = 18 * len(layout.joints) + 3 * len(layout.ends) + 2 * n + rows * (rows + n + 1)  # as ChainSearch takes it
    given = x, goals.reshape(len(goals), -1, 12), numbers, integers
    here, there, errors = call("chain_steps", shapes, *given, space=space)
    return here, there, Errors(*errors.T)
