"""Names of pairs of shapes, and hulls of coal."""

from __future__ import annotations

import coal
import numpy as np

import osik_jax as osik


def named(limit: osik.CollisionAvoidanceLimit) -> set[frozenset[str]]:
    """The pairs of a limit."""
    return {frozenset(pair) for pair in limit.pairs}


def pair_set(*pairs: str) -> set[frozenset[str]]:
    """Pairs given as texts of two names."""
    return {frozenset(pair.split()) for pair in pairs}


def coal_hull(points: np.ndarray) -> coal.ConvexBase:
    listed = coal.StdVec_Vec3s()
    for point in np.asarray(points, float):
        listed.append(point)
    return coal.Convex.convexHull(listed, True, "")
