"""A map of what a hand reaches that nobody searched for: uneven spacing, and some of each kind of position."""

import numpy as np

import osik_jax as osik
from osik_jax.reachability._grid import spread_rotations
from osik_jax.reachability._map import ReachabilityMap

X, Y, Z = np.array([-0.6, -0.3, 0.2, 0.5, 0.65]), np.array([-0.4, 0.0, 0.3]), np.array([0.1, 0.4, 0.6, 1.0])
ORIENTATIONS = 6
WHOLE = (2, 1, 1)
"""A position that is reached in all of them."""


def made_up_map(arm: osik.Robot) -> ReachabilityMap:
    """Of the hand of arm7; its configurations are random."""
    rng = np.random.default_rng(3)
    shape = len(X), len(Y), len(Z)
    kind = rng.integers(0, 3, shape)  # proven out of reach, none found, some
    reached = (rng.random((*shape, ORIENTATIONS)) < 0.5) & (kind == 2)[..., None]
    reached[WHOLE] = True
    some = reached.any(-1)
    lower, upper = np.asarray(arm.position_lower), np.asarray(arm.position_upper)
    return ReachabilityMap(
        frame="hand",
        x=X,
        y=Y,
        z=Z,
        rotations=spread_rotations(ORIENTATIONS),
        reached=reached,
        beyond_reach=np.where((kind == 0) & ~some, 0.2, 0.0),
        manipulability=np.where(some, rng.random(shape), np.nan),
        q=np.where(some[..., None], lower + (upper - lower) * rng.random((*shape, 7)), np.nan),
        links=np.zeros((2, 3)),
    )
