"""Limit that keeps a frame's origin between planes."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..kinematics import Kinematics, frame_jacobian
from ..numerics._arguments import as_bounds, as_scalar, check_bounds, concrete
from ..numerics._guarded import at_most_inverse
from ..numerics._host import on_host, to_jax
from ..robot import Robot
from ._box import Limit
from ._rows import LimitRows


class PositionBarrier(Limit):
    """Limit that keeps a frame's origin p between planes by a control barrier: ``lower <= normals p <= upper``.

    The speed towards a plane falls with the way left to it:

        gain (lower - normals p)  <=  normals J v  <=  gain (upper - normals p)

    A gain of more than ``1 / dt`` counts as that, so that a step from inside ends inside, but for the curvature of the
    path, which is of second order in ``v dt``; from outside p comes back by ``gain`` a second. Without normals the
    planes are a box along the world's axes. One normal and one bound make a half-space.

    Args:
        robot: the robot.
        frame: name of a body, link, site or geom (static).
        lower: bounds on the coordinates [m], one for each normal or a scalar; left out or -inf: none.
        upper: bounds on the coordinates, in the same way.
        normals: directions in the world, (m, 3) or one (3,), of length 1 for bounds in metres; default: x, y and z.
        gain: [1/s], > 0: the share of the way left that a second may take.

    Raises:
        KeyError: no such frame.
        ValueError: a wrong shape, no bound at all, lower > upper, a normal of length 0 or a gain that is not positive.
    """

    frame: str = eqx.field(static=True)
    normals: Float[Array, "m 3"]
    lower: Float[Array, " m"]
    upper: Float[Array, " m"]
    gain: Float[Array, ""]

    def __init__(
        self,
        robot: Robot,
        frame: str,
        *,
        lower: ArrayLike | Array | None = None,
        upper: ArrayLike | Array | None = None,
        normals: ArrayLike | Array | None = None,
        gain: ArrayLike | Array = 10.0,
    ):
        robot.tree.frame(frame)
        self.frame, dtype = frame, robot.q0.dtype
        given = on_host(to_jax(np.eye(3) if normals is None else normals, dtype))
        self.normals = to_jax(given[None] if given.ndim == 1 else given)
        if self.normals.ndim != 2 or self.normals.shape[1] != 3:
            raise OsikValueError(f"normals has shape {given.shape}, expected (m, 3) or (3,)")
        low, high = as_bounds(lower, upper, len(self.normals), dtype)
        if low is None or high is None:
            raise OsikValueError("a PositionBarrier needs lower, upper or both")
        self.lower, self.upper = low, high
        self.gain = as_scalar(gain, "gain", dtype)
        self._check()

    def sought(self, robot: Robot) -> Limit:
        """Return the limit with a gain of 1."""
        del robot
        return self.replace(gain=1.0)

    def rows(
        self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"], dt: Float[Array, ""] | float
    ) -> LimitRows:
        """Return one row for each normal."""
        del q
        # with a gain of 1 / dt one step reaches the plane; more would cross it
        rate = at_most_inverse(self.gain, dt)
        position, _ = kinematics.frame_pose(robot, self.frame)
        value = jnp.matmul(self.normals, position, precision="highest")
        jacobian = jnp.matmul(self.normals, frame_jacobian(robot, kinematics, self.frame)[:3], precision="highest")
        return LimitRows(jacobian, _approach(rate, self.lower, value), _approach(rate, self.upper, value))

    def _check(self) -> None:
        check_bounds(self.lower, self.upper)
        gain, normals = concrete(self.gain), concrete(self.normals)
        if gain is not None and not gain > 0.0:
            raise OsikValueError(f"gain is {gain}; it has to be positive: at 0 the frame could not move")
        if normals is not None and not (np.isfinite(normals).all() and (np.abs(normals).max(1) > 0.0).all()):
            raise OsikValueError(f"normals have to be finite and not 0: {normals}")


def _approach(rate: Float[Array, ""], bound: Float[Array, " m"], value: Float[Array, " m"]) -> Float[Array, " m"]:
    """Return ``rate (bound - value)``; an infinite bound stays infinite, with gradients 0."""
    # rate times infinity has a NaN gradient by the rate
    free = jnp.isinf(bound)
    return jnp.where(free, bound, rate * (jnp.where(free, 0.0, bound) - value))
