"""Scaling of links: longer or heavier ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._errors import OsikValueError
from ..numerics._arguments import as_array, check_not_negative, concrete
from ._model import RobotModel
from ._tree import KinematicTree
from .loading._followers import match_names

Factors = Mapping[str, Float[Array, ""] | float] | Float[Array, ""] | float


def scaled_leaves(robot: RobotModel, length: Factors, mass: Factors) -> dict[str, Array]:
    """Return the leaves of a robot with scaled lengths and masses, by field."""
    tree, dtype = robot.tree, robot.body_position.dtype
    longer, heavier = _factors(tree, length, "length", dtype), _factors(tree, mass, "mass", dtype)
    parent, carrier = np.asarray(tree.body_parents, int), np.asarray(tree.frame_bodies, int)
    owner, wearer = np.asarray(tree.joint_bodies, int), np.asarray(tree.geom_bodies, int)
    return {
        "body_position": robot.body_position * longer[parent, None],
        "body_com": robot.body_com * longer[:, None],
        "joint_position": robot.joint_position * longer[owner, None],
        "frame_position": robot.frame_position * longer[carrier, None],
        "geom_position": robot.geom_position * longer[wearer, None],
        "geom_size": robot.geom_size * longer[wearer, None],
        "body_mass": robot.body_mass * heavier,
        "body_inertia": robot.body_inertia * (heavier * longer**2)[:, None, None],
    }


def _factors(tree: KinematicTree, given: Factors, what: str, dtype: np.dtype) -> Float[Array, " nbody"]:
    """Return one factor for each body; the world keeps 1."""
    factors = jnp.ones(len(tree.body_names), dtype)
    if not isinstance(given, Mapping):
        return factors.at[1:].set(_factor(given, what, dtype))
    seen: dict[int, str] = {}
    for pattern, factor in given.items():
        for body in (1 + k for k in match_names("body", pattern, tree.body_names[1:])):
            if body in seen:
                raise OsikValueError(
                    f"{what} gives {tree.body_names[body]!r} twice, by {seen[body]!r} and by {pattern!r}"
                )
            seen[body] = pattern
            factors = factors.at[body].set(_factor(factor, f"{what}[{pattern!r}]", dtype))
    return factors


def _factor(value: Any, what: str, dtype: np.dtype) -> Array:
    """Return a factor; raise ValueError unless it is finite and, for a length, positive, for a mass, not negative."""
    factor = as_array(value, what, dtype)
    check_not_negative(factor, what)
    seen = concrete(factor)
    if what.startswith("length") and seen is not None and not seen.all():
        raise OsikValueError(f"{what} is {value}; a length is scaled by a positive factor")
    return factor
