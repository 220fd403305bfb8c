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
        damping: its share of the squared error, and the least one relative to the squared length of a radian.
    """
    goals = jnp.concatenate([goal.position[..., None, :], goal.rotation], -2)
    numbers = side_by_side(*numbers_of(search, damping))
    lanes = max(len(a) for a in (x, goals, numbers))
    shapes = [((lanes, x.shape[1]), float)] * 2 + [((lanes, 4), float)]
    n, rows = x.shape[1], 6 * goals.shape[1]
    space = 18 * len(search.chain.layout.joints) + rows // 2 + 2 * n + rows * (rows + n + 1)  # as ChainSearch takes it
    given = x, goals.reshape(len(goals), -1, 12), numbers, integers_of(search, steps)
    here, there, errors = call("chain_steps", shapes, *given, space=space)
    return here, there, Errors(*errors.T)


def numbers_of(search: Any, damping: tuple[float, float]) -> tuple[Any, ...]:
    """Return what ``ChainSearch::read`` takes, in its order."""
    chain, kind = search.chain, search.first.dtype
    factors, damped = (np.array([a], kind) for a in (chain.layout.factors, damping))
    return (
        *(chain.constant, chain.first, chain.second, chain.offset, chain.axis, chain.anchor, chain.tip, factors),
        *(search.lower, search.upper, search.first, search.length, search.tolerance, search.enough, damped),
    )


def integers_of(search: Any, steps: int) -> np.ndarray:
    """Return the steps, then what the constructor of ``ChainSearch`` takes."""
    layout = search.chain.layout
    coordinates = [layout.dofs.index(entry) if entry >= 0 else -1 for entry in layout.entries]
    kept = np.array(search.rows).ravel()
    parts = [[steps, len(layout.joints), kept.sum(), search.near], layout.parents, layout.hinges, coordinates]
    parts += [layout.ends, layout.carries, np.where(kept, np.cumsum(kept) - 1, -1)]
    return np.concatenate([np.ravel(part) for part in parts]).astype(np.int32)
