"""Task on the manipulability of a frame."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, ClassVar, Literal, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikTypeError, OsikValueError
from ..kinematics import Kinematics, forward_kinematics, frame_jacobian, integrate
from ..numerics._constants import ROW_ROUNDOFF
from ..robot import Robot
from ..robot._joint_selection import select_all
from ..robot._tree import DOF_WIDTH, KinematicTree
from ._gain import AdaptiveGain
from ._leaves import as_vector
from ._pose import option, row_mask
from ._task import DEFAULT_GAIN, Task, TaskRows


class ManipulabilityTask(Task):
    """Task that raises a frame's manipulability, brings it to a value, or keeps it within bounds.

    Yoshikawa's index ``m = sqrt(det(J J'))`` is that of the chosen rows and joints of ``frame_jacobian``: the volume of
    what the frame's velocity can be at joint speeds of norm 1, 0 where it is singular (T. Yoshikawa, "Manipulability of
    robotic mechanisms", International Journal of Robotics Research 4, 1985). With x = m, or ln m for ``log=True``, and
    g its gradient along the tangent:

    - nothing more given: the joints are asked to go up the gradient, ``v = gain g``, with the error -g. One row for
      each dof of the chosen joints that moves the frame; asks for nothing where the index is greatest.
    - a target: ``e = x - x*``, ``g' v = -gain e + x*'``. One row.
    - bounds: ``gain (lower - x) <= g' v - x*' <= gain (upper - x)``. One row.

    At a singular configuration m has a kink, so no gradient: there (to rounding) it counts as 0 with all derivatives 0,
    ln m as that of the smallest number, and the task pushes neither way. A lower bound keeps away from there. The unit
    of m changes with the rows; ``log=True`` makes x free of it but for a constant, and g steep near singularities.

    Args:
        robot: the robot.
        frame: name of a body, link, site or geom.
        target: wanted x.
        target_velocity: of the target, or of the bounds [1/s]; default 0.
        lower: makes an inequality task: lower bound on x.
        upper: upper bound; one of the two may be left out.
        rows: of the Jacobian: ``"pose"``, ``"position"``, ``"orientation"``, or six booleans (x, y, z, rotation about
            x, y, z). A planar arm has ``(True, True, False, False, False, False)``: rows that no joint moves make the
            index 0.
        axes: those of the rows, ``"world"`` or ``"frame"``.
        joints: names and globs of the joints that count. Default: all but the free base, which makes any frame able to
            move anywhere.
        log: whether x is ln m.
        weight: of each squared row.
        gain: [1/s], a number or an ``AdaptiveGain``; without target and bounds, the speed for a gradient of 1.

    Raises:
        KeyError: no such frame or joint.
        TypeError: a target and bounds, or a ``target_velocity`` without either.
        ValueError: fewer dofs than rows, a wrong shape, a negative weight, lower > upper, an unknown option.
    """

    sees_places: ClassVar[bool] = True
    frame: str = eqx.field(static=True)
    kept: tuple[bool, ...] = eqx.field(static=True)
    axes: str = eqx.field(static=True)
    dofs: tuple[int, ...] = eqx.field(static=True)
    log: bool = eqx.field(static=True)
    target: Float[Array, ""] | None
    target_velocity: Float[Array, ""] | None
    lower: Float[Array, "1"] | None
    upper: Float[Array, "1"] | None

    def __init__(
        self,
        robot: Robot,
        frame: str,
        *,
        target: ArrayLike | Array | None = None,
        target_velocity: ArrayLike | Array | None = None,
        lower: ArrayLike | Array | None = None,
        upper: ArrayLike | Array | None = None,
        rows: Literal["pose", "position", "orientation"] | Sequence[bool] = "pose",
        axes: Literal["world", "frame"] = "world",
        joints: Iterable[str] | None = None,
        log: bool = False,
        weight: ArrayLike | Array = 1.0,
        gain: ArrayLike | Array | AdaptiveGain = DEFAULT_GAIN,
        priority: int = 1,
        hard: bool = False,
    ):
        body = robot.tree.frame_bodies[robot.tree.frame(frame)]
        self.frame, self.kept, self.log = frame, row_mask(rows), log
        self.axes = option("axes", axes, ("world", "frame"))
        self.dofs = _moving_dofs(robot.tree, body, select_all(robot, joints))
        if len(self.dofs) < sum(self.kept):
            raise OsikValueError(
                f"{len(self.dofs)} dofs of the chosen joints move {frame!r}, which cannot go {sum(self.kept)} ways: "
                "its manipulability is 0 everywhere. Choose fewer rows or more joints"
            )
        dtype = self._set_up(robot, weight, priority, hard, gain)
        climbs = self._set_bounds(target, lower, upper, 1, dtype) and target is None
        if climbs and target_velocity is not None:
            raise OsikTypeError("a target_velocity is that of a target or of bounds; there are none")
        velocity = 0.0 if target_velocity is None else target_velocity
        self.target = None if target is None else as_vector(target, (), "target", dtype)
        self.target_velocity = None if climbs else as_vector(velocity, (), "target_velocity", dtype)

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return one row; when ascending the gradient, one row per dof that moves the frame."""
        del kinematics
        standing = jnp.zeros(robot.nv, q.dtype)
        value, gradient = jax.value_and_grad(lambda step: self.value(robot, integrate(robot, q, step)))(standing)
        if self.target_velocity is None:
            return self._climb(robot, gradient)
        return TaskRows.of(
            (value if self.target is None else value - self.target)[None],
            gradient[None],
            gain=self.gain,
            weight=self.weight[None],
            lower=self.lower,
            upper=self.upper,
            feedforward=self.target_velocity[None],
        )

    def during(self, dt: Float[Array, ""] | float) -> Self:
        """Return the task for a step of dt [s].

        When ascending the gradient, the gain is kept, because it is not the decay rate of an error.
        """
        return self if self.target_velocity is None else super().during(dt)

    def value(self, robot: Robot, q: Float[Array, " nq"]) -> Float[Array, ""]:
        """Return Yoshikawa's index or its logarithm at configuration q."""
        kinematics = forward_kinematics(robot, q)
        jacobian = frame_jacobian(robot, kinematics, self.frame)[:, np.array(self.dofs)]
        if self.axes == "frame":
            turn = kinematics.frame_pose(robot, self.frame)[1].T
            parts = (jnp.matmul(turn, part, precision="highest") for part in (jacobian[:3], jacobian[3:]))
            jacobian = jnp.concatenate(list(parts))
        return volume(jacobian[np.flatnonzero(self.kept)], log=self.log)

    def _held(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> dict[str, Any]:
        return super()._held(robot, kinematics, q) if self.target is None else dict(target=self.value(robot, q))

    def _climb(self, robot: Robot, gradient: Float[Array, " nv"]) -> TaskRows:
        dofs = np.array(self.dofs)
        # rows ask for -gain * error, so the joints go up where the error is minus the gradient
        error = -gradient[dofs]
        identity = jnp.asarray(np.eye(robot.nv)[dofs], error.dtype)
        weight = jnp.broadcast_to(self.weight, error.shape)
        return TaskRows.of(error, identity, gain=self.gain, weight=weight, dofs=self.dofs)


def _moving_dofs(tree: KinematicTree, body: int, joints: Sequence[int]) -> tuple[int, ...]:
    """Return the joints' entries of v that move the body, directly or by a follower."""
    moves = np.zeros(tree.nv, bool)
    for index, coefficient in tree.dof_columns:
        moves |= tree.moves[body][index] & (coefficient != 0.0)
    chosen = [tree.dof_address[j] + i for j in joints for i in range(DOF_WIDTH[tree.joint_types[j]])]
    return tuple(dof for dof in chosen if moves[dof])


def volume(rows: Float[Array, "m n"], *, log: bool) -> Float[Array, ""]:
    """Return sqrt(det(rows rows')) or its logarithm, for m <= n rows, by successive orthogonalisation.

    By Gram and Schmidt's method, so that small values keep their digits, which determinants of products lose.
    """
    m, n = rows.shape
    roundoff = (ROW_ROUNDOFF * n * jnp.finfo(rows.dtype).eps) ** 2
    squares, singular, product = jnp.sum(rows**2, 1), jnp.asarray(False), jnp.ones((), rows.dtype)
    for k in range(m):
        square = jnp.sum(rows[k] ** 2)
        depends = square <= roundoff * squares[k]
        length = jnp.sqrt(jnp.where(depends, 1.0, square))
        direction = rows[k] / length
        rows = rows - jnp.matmul(rows, direction, precision="highest")[:, None] * direction
        singular, product = singular | depends, product * length
    if log:
        return jnp.where(singular, jnp.log(float(jnp.finfo(rows.dtype).tiny)), jnp.log(product))
    return jnp.where(singular, 0.0, product)
