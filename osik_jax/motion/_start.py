"""States of joints to start from and to end in, checked to be within limits."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._errors import OsikValueError
from ..inverse._inverse_kinematics import joint_box
from ..numerics._arguments import as_floats, check_finite, concrete
from ..robot import Robot
from ..robot._joint_selection import dof_names

_OUTSIDE = {"float64": (1e-6, 1e-6), "float32": (1e-5, 2e-3)}
"""By how much a position may be outside of its range [rad or m], and a rate outside of its limit, as a share of that.

Rates are differences of positions over a few hundredths of a second, so they have few digits in single precision.
"""
_KINDS = "position", "velocity", "acceleration"

State = tuple[Float[ArrayLike, " n"], Float[ArrayLike, " n"], Float[ArrayLike, " n"]]


def rounding(numbers: Array | np.ndarray) -> tuple[float, float]:
    """Return by how much positions of this precision may be outside [rad or m], and rates by a share of limits."""
    return _OUTSIDE[str(numbers.dtype)]


def checked_state(robot: Robot, given: Any, limits: Array, name: str = "start", kinds: int = 3) -> Float[Array, "k n"]:
    """Return a state, checked to be within limits where its numbers are known.

    Args:
        robot: the robot.
        given: positions, velocities and accelerations, or the first ``kinds`` of them. (n,) each
        limits: of speed, acceleration and jerk. (3, n)
        name: of the argument, for messages.
        kinds: number of arrays of the state.
    """
    if not isinstance(given, tuple | list) or len(given) != kinds or any(np.shape(a) != (robot.nv,) for a in given):
        raise OsikValueError(f"{name} is ({', '.join(_KINDS[:kinds])}), of {robot.nv} joints each")
    state = jnp.stack([as_floats(one) for one in given])
    check_finite(state, name)
    seen, most = concrete(state), concrete(limits)
    if seen is None or most is None:
        return state
    lower, upper = (np.asarray(end) for end in joint_box(robot, None))
    place, rate = rounding(state)
    outside = [(seen[0] < lower - place) | (seen[0] > upper + place)]
    outside += [np.abs(own) > (1.0 + rate) * limit for own, limit in zip(seen[1:], most, strict=False)]
    for row, where in enumerate(outside):
        if where.any():
            joint = int(where.argmax())
            allowed = f"{lower[joint]:g} to {upper[joint]:g}" if row == 0 else f"at most {most[row - 1, joint]:g}"
            raise OsikValueError(
                f"{name} has the {_KINDS[row]} {seen[row, joint]:g} of {dof_names(robot)[joint]!r}, whose limit is "
                f"{allowed}: stay within the limits, or give wider ones"
            )
    return state
