"""Signed distance of the centre of mass from the edge of the support polygon.

For a point p and a convex hull, this distance (positive outside) is the maximum over unit directions n of ``n . p``
minus the hull's support function. The maximum is at the normal of a line through two hull points, or at the direction
from one hull point to p. So the hull itself is not constructed.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics._dense import product
from ..robot import Robot

# Guard of divisions: a line between corners shorter than this [m] counts as a point.
_SHORTEST = 1e-6
_FIRST, _SECOND = np.array(list(itertools.combinations(range(8), 2))).T
_POINTS = np.arange(8)
"""Corner indices: the two corners of each line through two corners, and each of the eight sole corners alone."""


class Overhang(NamedTuple):
    """Position of a point relative to the edge of the support polygon."""

    distance: Float[Array, ""]  # signed distance from the edge, positive outside, -inf without contacts [m]
    direction: Float[Array, "2"]  # unit vector along which the distance grows
    coefficients: Float[Array, "8"]  # weights of the corners whose convex combination is the nearest point of the edge
    width: Float[Array, ""]  # least width of the hull [m]; a margin of a third of it can always be met


def overhang(center: Float[Array, "2"], corners: Float[Array, "8 2"], stands: Float[Array, "8"]) -> Overhang:
    """Return the signed distance of a point from the convex hull of the corners in contact.

    ``center``: the point in the floor plane [m]. ``corners``: the soles' corners [m]. ``stands``: 1 for a corner in
    contact, else 0.
    """
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
    # lines between corners that do not stand have no width
    width = jnp.where(exists[:lines], support[:lines] + support[lines : 2 * lines], jnp.inf).min()
    coefficients = jnp.zeros(8).at[first[best]].add(1.0 - ratio[best]).at[second[best]].add(ratio[best])
    return Overhang(distances[best], directions[best], coefficients, width)


def _unit_and_length(vectors: Float[Array, "k 2"]) -> tuple[Float[Array, "k 2"], Float[Array, " k"]]:
    """Return vectors scaled to unit length, and their lengths [m]; both have finite derivatives at 0."""
    square = jnp.sum(vectors**2, -1)
    length = jnp.sqrt(jnp.where(square > 0.0, square, 1.0)) * (square > 0.0)
    return vectors / jnp.maximum(length, _SHORTEST)[:, None], length


def mass_fractions(robot: Robot) -> Float[Array, "*B nbody"]:
    """Return each body's fraction of the robot's total mass. (nbody,)."""
    own = jnp.where(robot.tree.is_own, robot.body_mass, 0.0)
    return own / own.sum(-1, keepdims=True)
