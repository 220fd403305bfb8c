"""Bounds on where the links of a chain bring its frames."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._chain import Chain, chain_kinematics

ROUNDOFF = 64.0
"""Machine epsilons, of the robot's size, by which computed errors may be off."""
_SWEEPS = 4
"""Passes over the slides for the nearest point of what they reach; one is exact where they are at right angles."""


class Reach(NamedTuple):
    """Bound on where a chain of links brings a frame: within ``length`` of ``root``, which slides move."""

    root: Float[Array, "3"]  # the first hinge's position with the slides before it in the middle of their ranges [m]
    slides: Float[Array, "k 3"]  # half the travel of each of these slides, along its direction in the world [m]
    length: Float[Array, ""]  # of the links from there to the frame, with the slides among them drawn out [m]


def reaches(chain: Chain, lower: Array, upper: Array) -> list[Reach]:
    """Return the reach of each frame within limits of the coordinates, infinite where free. (n,) each."""
    x = jnp.zeros_like(lower)  # any configuration has the same reach
    kinematics, layout = chain_kinematics(chain, x[:, None]), chain.layout
    axis, anchor = kinematics.axis[..., 0], kinematics.anchor[..., 0]
    middle, half = 0.5 * (lower + upper) - x, 0.5 * (upper - lower)
    found = []
    for at, carried in enumerate(layout.carries):
        path = np.flatnonzero(carried).tolist()
        hinges = [j for j in path if layout.hinges[j]]
        points = [*(anchor[j] for j in hinges), kinematics.position[at, :, 0]]
        before = [points[0], *(after - here for here, after in pairwise(points))]
        travels: list[list[Array]] = [[] for _ in before]
        for j in path:
            if not layout.hinges[j] and layout.entries[j] >= 0:
                segment, entry = sum(hinge < j for hinge in hinges), layout.dofs.index(layout.entries[j])
                before[segment] = before[segment] + layout.factors[j] * middle[entry] * axis[j]
                travels[segment].append(abs(layout.factors[j]) * half[entry] * axis[j])
        links = [norm(own) for own in before[1:]] + [norm(own) for travel in travels[1:] for own in travel]
        slides = jnp.array(travels[0], x.dtype).reshape(-1, 3)
        found.append(Reach(before[0], slides, sum(links, jnp.zeros((), x.dtype))))
    return found


def norm(vector: Float[Array, "... 3"]) -> Float[Array, "..."]:
    return jnp.sqrt(jnp.sum(vector**2, -1))


def beyond(
    reaches: Sequence[Reach], position: Float[Array, "targets frames 3"], asked: np.ndarray
) -> Float[Array, " targets"]:
    """Return a lower bound on the distance from each target to the workspace [m]; 0 where it may be inside.

    ``asked``: whether the whole position of each frame counts. (frames,)
    """
    away = jnp.stack([_outside(reach, position[:, at]) for at, reach in enumerate(reaches)], -1)
    return jnp.maximum(jnp.max(jnp.where(jnp.isfinite(away) & asked, away, 0.0), -1), 0.0)


def _outside(reach: Reach, position: Float[Array, "targets 3"]) -> Float[Array, " targets"]:
    """Return a lower bound on the distance from each position to all that is within reach; not finite for none.

    The root moves in a convex set. In any direction a position is away from that set by at least as much as it is
    further than the set's furthest point.
    """
    way = position - reach.root
    shares = [jnp.zeros_like(way[:, 0])] * len(reach.slides)
    for _ in range(_SWEEPS):
        for at, slide in enumerate(reach.slides):
            left = _left(way, reach.slides, shares) + shares[at][:, None] * slide
            square = jnp.sum(slide**2)
            nearest = jnp.sum(left * slide, -1) / jnp.where(square > 0.0, square, 1.0)
            shares[at] = jnp.clip(nearest, -1.0, 1.0)
    left = _left(way, reach.slides, shares)
    distance = norm(left)
    direction = left / jnp.where(distance > 0.0, distance, 1.0)[:, None]
    furthest = sum((jnp.abs(jnp.sum(direction * slide, -1)) for slide in reach.slides), reach.length)
    # rounded up, so that a target on the boundary is never called out of reach; positions round by their own size
    rounding = ROUNDOFF * float(jnp.finfo(way.dtype).eps) * (furthest + jnp.max(jnp.abs(reach.root), -1))
    return jnp.sum(direction * way, -1) - (furthest + rounding)


def _left(way: Float[Array, "targets 3"], slides: Array, shares: list[Array]) -> Float[Array, "targets 3"]:
    """Return the way that is left after a share of each slide's travel."""
    return way - sum((share[:, None] * slide for share, slide in zip(shares, slides, strict=True)), jnp.zeros_like(way))
