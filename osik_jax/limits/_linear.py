"""Limit on linear functions of the velocity."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..kinematics import Kinematics
from ..numerics._arguments import as_bounds, check_bounds, concrete
from ..numerics._host import to_jax
from ..robot import Robot
from ._box import Limit
from ._rows import LimitRows


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

    def rows(
        self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"], dt: Float[Array, ""] | float
    ) -> LimitRows:
        """Return the given rows."""
        del robot, kinematics, q, dt
        return LimitRows(self.matrix, self.lower, self.upper)

    def _check(self) -> None:
        check_bounds(self.lower, self.upper)
        seen = concrete(self.matrix)
        if seen is not None and not np.isfinite(seen).all():
            raise OsikValueError(f"matrix is not finite in rows {np.flatnonzero(~np.isfinite(seen).all(1)).tolist()}")
