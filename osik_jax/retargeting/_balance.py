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
        coefficients: of the corners in the nearest point of the edge, which is their convex combination. The distance
            is from that point, along the direction. (8,)
        width: of the hull where it is narrowest [m]. A third of it, a point can always be inside.
    """

    distance: Float[Array, ""]
    direction: Float[Array, "2"]
    coefficients: Float[Array, "8"]
    width: Float[Array, ""]


def overhang(center: Float[Array, "2"], corners: Float[Array, "8 2"], stands: Float[Array, "8"]) -> Overhang:
    """Return how far a point is beyond the edge of the hull of those corners that stand (1; others 0)."""
    edge, length = _unit_and_length(corners[_SECOND] - corners[_FIRST])
    from_corner, distance = _unit_and_length(center - corners)
    normal = jnp.stack([edge[:, 1], -edge[:, 0]], -1)
    directions = jnp.concatenate([normal, -normal, from_corner])
    # where on each line its nearest point is: 0 at the first corner, 1 at the second
    along = jnp.sum(edge * (center - corners[_FIRST]), -1)
    on_line = jnp.clip(along / jnp.maximum(length, _SHORTEST), 0.0, 1.0)
    first = jnp.concatenate([_FIRST, _FIRST, _POINTS])
    second = jnp.concatenate([_SECOND, _SECOND, _POINTS])
    ratio = jnp.concatenate([on_line, on_line, jnp.zeros_like(distance)])
    exists = jnp.concatenate([length, length, distance]) > _SHORTEST
    exists &= stands[first] * stands[second] > 0.5
    # the support function of the hull, in each direction
    support = jnp.where(stands > 0.5, product(directions, corners.T), -jnp.inf).max(-1)
    distances = jnp.where(exists, directions @ center - support, -jnp.inf)
    best = jnp.argmax(distances)
    # along a normal the hull is as wide as its support there and in the opposite direction together
    lines = len(edge)
    width = jnp.where(exists[:lines], support[:lines] + support[lines : 2 * lines], jnp.inf).min()
    coefficients = jnp.zeros(8).at[first[best]].add(1.0 - ratio[best]).at[second[best]].add(ratio[best])
    return Overhang(distances[best], directions[best], coefficients, width)


def _unit_and_length(vectors: Float[Array, "k 2"]) -> tuple[Float[Array, "k 2"], Float[Array, " k"]]:
    """Return vectors at unit length, and their lengths [m]; with derivatives at 0 too."""
    square = jnp.sum(vectors**2, -1)
    length = jnp.sqrt(jnp.where(square > 0.0, square, 1.0)) * (square > 0.0)
    return vectors / jnp.maximum(length, _SHORTEST)[:, None], length


def mass_fractions(robot: Robot) -> Float[Array, "*B nbody"]:
    """Return the fraction of the robot's mass that each body has."""
    own = jnp.where(robot.tree.is_own, robot.body_mass, 0.0)
    return own / own.sum(-1, keepdims=True)
