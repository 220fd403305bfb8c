"""Limits with rows: planes that a frame keeps to, and linear functions of the velocity."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..kinematics import Kinematics, frame_jacobian
from ..numerics._arguments import as_bounds, as_scalar, check_bounds, concrete
from ..numerics._guarded import approach, at_most_inverse
from ..numerics._host import on_host, to_jax
from ..robot import Robot
from ._box import Limit, LimitRows, Time


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

    sees_places: ClassVar[bool] = True
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

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"], dt: Time) -> LimitRows:
        """Return one row for each normal."""
        del q
        # with a gain of 1 / dt one step reaches the plane; more would cross it
        rate = at_most_inverse(self.gain, dt)
        position, _ = kinematics.frame_pose(robot, self.frame)
        value = jnp.matmul(self.normals, position, precision="highest")
        jacobian = jnp.matmul(self.normals, frame_jacobian(robot, kinematics, self.frame)[:3], precision="highest")
        return LimitRows(jacobian, approach(rate, self.lower, value), approach(rate, self.upper, value))

    def _check(self) -> None:
        check_bounds(self.lower, self.upper)
        gain, normals = concrete(self.gain), concrete(self.normals)
        if gain is not None and not gain > 0.0:
            raise OsikValueError(f"gain is {gain}; it has to be positive: at 0 the frame could not move")
        if normals is not None and not (np.isfinite(normals).all() and (np.abs(normals).max(1) > 0.0).all()):
            raise OsikValueError(f"normals have to be finite and not 0: {normals}")


class LinearLimit(Limit):
    """``lower <= matrix @ v <= upper``, rows that do not depend on the configuration.

    Args:
        robot: the robot.
        matrix: one row for each bounded function of v. (m, nv)
        lower: bounds on the rows, (m,) or a scalar; left out or -inf: none.
        upper: bounds on the rows, in the same way; equal to ``lower`` for an equality.

    Raises:
        ValueError: a wrong shape, no bound at all, lower > upper, or a matrix that is not finite.
    """

    matrix: Float[Array, "m nv"]
    lower: Float[Array, " m"]
    upper: Float[Array, " m"]

    def __init__(
        self,
        robot: Robot,
        matrix: ArrayLike | Array,
        lower: ArrayLike | Array | None = None,
        upper: ArrayLike | Array | None = None,
    ):
        dtype = robot.q0.dtype
        self.matrix = to_jax(matrix, dtype)
        if self.matrix.ndim != 2 or self.matrix.shape[1] != robot.nv:
            raise OsikValueError(f"matrix has shape {self.matrix.shape}, expected (m, {robot.nv}): a row acts on v")
        low, high = as_bounds(lower, upper, len(self.matrix), dtype)
        if low is None or high is None:
            raise OsikValueError("a LinearLimit needs lower, upper or both")
        self.lower, self.upper = low, high
        self._check()

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"], dt: Time) -> LimitRows:
        """Return the given rows."""
        del robot, kinematics, q, dt
        return LimitRows(self.matrix, self.lower, self.upper)

    def _check(self) -> None:
        check_bounds(self.lower, self.upper)
        seen = concrete(self.matrix)
        if seen is not None and not np.isfinite(seen).all():
            raise OsikValueError(f"matrix is not finite in rows {np.flatnonzero(~np.isfinite(seen).all(1)).tolist()}")
