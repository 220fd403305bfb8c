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

OUTSIDE = 1e-6
"""Share of a limit, or of a range [rad or m], by which a state may be outside: rounding."""
_KINDS = "position", "velocity", "acceleration"

State = tuple[Float[ArrayLike, " n"], Float[ArrayLike, " n"], Float[ArrayLike, " n"]]


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
    outside = [(seen[0] < lower - OUTSIDE) | (seen[0] > upper + OUTSIDE)]
    outside += [np.abs(own) > (1.0 + OUTSIDE) * limit for own, limit in zip(seen[1:], most, strict=False)]
    for row, where in enumerate(outside):
        if where.any():
            joint = int(where.argmax())
            allowed = f"{lower[joint]:g} to {upper[joint]:g}" if row == 0 else f"at most {most[row - 1, joint]:g}"
            raise OsikValueError(
                f"{name} has the {_KINDS[row]} {seen[row, joint]:g} of {dof_names(robot)[joint]!r}, whose limit is "
                f"{allowed}: stay within the limits, or give wider ones"
            )
    return state
