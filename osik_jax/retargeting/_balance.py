"""The centre of mass over the feet: how far it is from the edge of what stands.

The distance of a point from the edge of a convex hull, positive outside and negative inside, is the most that it is
beyond all of the hull's points along any direction. That direction is square to a line through two of the points, or
goes from one of them to the point itself: no hull has to be made.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics._dense import product
from ..robot import Robot

_SHORTEST = 1e-6
_FIRST, _SECOND = np.array(list(itertools.combinations(range(8), 2))).T
_POINTS = np.arange(8)
"""Numbers of the two corners on each line; of the soles' eight corners by themselves."""


class Overhang(NamedTuple):
    """A point and the edge of what stands.

    Attributes:
        distance: from the edge, positive outside, -inf where nothing stands [m].
        direction: in which that grows, a unit vector. (2,)
        shares: of each corner in the point of the edge that is nearest; the distance is that along the direction. (8,)
        width: of the hull where it is narrowest [m]. A third of it, a point can always be inside.
    """

    distance: Float[Array, ""]
    direction: Float[Array, "2"]
    shares: Float[Array, "8"]
    width: Float[Array, ""]


def overhang(center: Float[Array, "2"], corners: Float[Array, "8 2"], stands: Float[Array, "8"]) -> Overhang:
    """How far a point is beyond the edge of the hull of those corners that stand (1; others 0)."""
    edge, length = _way(corners[_FIRST], corners[_SECOND])
    off, far = _way(corners, jnp.broadcast_to(center, corners.shape))
    across = jnp.stack([edge[:, 1], -edge[:, 0]], -1)
    directions = jnp.concatenate([across, -across, off])
    along = jnp.sum(edge * (center - corners[_FIRST]), -1)
    share = jnp.clip(along / jnp.maximum(length, _SHORTEST), 0.0, 1.0)
    a, b, share = (jnp.concatenate(parts) for parts in ((_FIRST, _FIRST, _POINTS), (_SECOND, _SECOND, _POINTS),
                                                        (share, share, jnp.zeros_like(far))))  # fmt: skip
    there = jnp.concatenate([length, length, far]) > _SHORTEST
    there &= stands[a] * stands[b] > 0.5
    reach = jnp.where(stands > 0.5, product(directions, corners.T), -jnp.inf).max(-1)
    distances = jnp.where(there, directions @ center - reach, -jnp.inf)
    best = jnp.argmax(distances)
    there, both_ways = there[: 2 * len(edge)].reshape(2, -1), reach[: 2 * len(edge)].reshape(2, -1).sum(0)
    width = jnp.where(there[0], both_ways, jnp.inf).min()
    shares = jnp.zeros(8).at[a[best]].add(1.0 - share[best]).at[b[best]].add(share[best])
    return Overhang(distances[best], directions[best], shares, width)


def _way(start: Float[Array, "k 2"], end: Float[Array, "k 2"]) -> tuple[Float[Array, "k 2"], Float[Array, " k"]]:
    """Unit vectors from points to others, and how long the ways are."""
    way = end - start
    square = jnp.sum(way**2, -1)
    length = jnp.sqrt(jnp.where(square > 0.0, square, 1.0)) * (square > 0.0)
    return way / jnp.maximum(length, _SHORTEST)[:, None], length


def mass_shares(robot: Robot) -> Float[Array, "*B nbody"]:
    """Of each body, its share in the robot's mass."""
    return robot.body_mass / robot.body_mass.sum(-1, keepdims=True)
