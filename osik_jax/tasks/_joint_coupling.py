"""A task on a linear combination of joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikTypeError, OsikValueError
from ..kinematics import Kinematics
from ..numerics._arguments import concrete
from ..numerics._host import to_jax
from ..robot import Robot
from ..robot._joint_selection import dofs_of, is_scalar, select_joints
from ._curvature import no_curvature
from ._gain import AdaptiveGain
from ._leaves import as_vector
from ._rotation import dot
from ._task import DEFAULT_GAIN, Task, TaskRows


class JointCouplingTask(Task):
    """Task that couples joints like gears: ``sum_i ratio_i q_i`` at a value or within bounds.

    One row. A target: ``e = ratios q - target``, ``e' = ratios v - target'``, asked to be ``-gain(e) e``; bounds:
    ``gain (lower - ratios q) <= ratios v <= gain (upper - ratios q)``. ``{"a": 1.0, "b": -1.0}`` keeps two joints
    equal, ``{"waist": 1.0, "hip": 1.0, "knee": 1.0}`` the sum of three. A ``<mimic>`` joint needs none: it is no
    coordinate of its own.

    Args:
        robot: the robot.
        ratios: from joint names to factors; hinges and slides. Kept in the order of v, for ``replace(ratios=...)`` too.
        target: of the sum [rad or m, times the ratios' units]; default 0, also where q0 has another value.
        target_velocity: of the target, or of the bounds; default 0.
        lower: makes an inequality task: lower bound on the sum.
        upper: upper bound; one of the two may be left out.
        weight: of the squared row.
        gain: [1/s], a number or an ``AdaptiveGain``.

    Raises:
        KeyError: no such joint, or it is locked or a mimic follower.
        TypeError: a target and bounds, or ratios that are no mapping.
        ValueError: no ratio that is not 0, a ball or free joint, a wrong shape, a negative weight, lower > upper.
    """

    is_goal: ClassVar[bool] = True
    ties_joints: ClassVar[bool] = True
    joints: tuple[int, ...] = eqx.field(static=True)
    ratios: Float[Array, " k"]
    target: Float[Array, "1"] | None
    target_velocity: Float[Array, "1"]
    lower: Float[Array, "1"] | None
    upper: Float[Array, "1"] | None

    def __init__(
        self,
        robot: Robot,
        ratios: Mapping[str, float],
        *,
        target: ArrayLike | Array | None = None,
        target_velocity: ArrayLike | Array | None = None,
        lower: ArrayLike | Array | None = None,
        upper: ArrayLike | Array | None = None,
        weight: ArrayLike | Array = 1.0,
        gain: ArrayLike | Array | AdaptiveGain = DEFAULT_GAIN,
        priority: int = 1,
        hard: bool = False,
    ):
        by_joint = _by_joint(robot, ratios)
        self.joints = tuple(by_joint)
        dtype = self._set_up(robot, weight, priority, hard, gain)
        self.ratios = to_jax(list(by_joint.values()), dtype)
        velocity = 0.0 if target_velocity is None else target_velocity
        self.target_velocity = as_vector(velocity, (1,), "target_velocity", dtype)
        self.target = None
        if self._set_bounds(target, lower, upper, 1, dtype):
            self.target = as_vector(0.0 if target is None else target, (1,), "target", dtype)

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return one row: the error of the coupling, with the ratios at the joints' entries of v."""
        del kinematics
        dofs = np.array([robot.tree.dof_address[joint] for joint in self.joints])
        value = self._value(robot, q)
        return TaskRows.of(
            # linear in q: the ratios are the Jacobian of value - target, and nothing bends
            value if self.target is None else value - self.target,
            jnp.zeros((1, robot.nv), self.ratios.dtype).at[0, dofs].set(self.ratios),
            gain=self.gain,
            weight=self.weight[None],
            lower=self.lower,
            upper=self.upper,
            feedforward=self.target_velocity,
            curvature=no_curvature,
        )

    def counted_dofs(self, robot: Robot) -> tuple[int, ...]:
        """Return the entries of v of the coupled joints."""
        return tuple(dofs_of(robot, self.joints))

    def _held(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> dict[str, Any]:
        if self.target is None:
            return super()._held(robot, kinematics, q)
        return dict(target=self._value(robot, q))

    def _value(self, robot: Robot, q: Float[Array, " nq"]) -> Float[Array, "1"]:
        """Return the weighted sum of joint positions [rad or m]."""
        return dot(self.ratios, q[np.array([robot.tree.qpos_address[joint] for joint in self.joints])])[None]


def _by_joint(robot: Robot, ratios: Mapping[str, float]) -> dict[int, float]:
    """Return the ratios of the joints in the order of v."""
    if not isinstance(ratios, Mapping):
        raise OsikTypeError(f"ratios is a {type(ratios).__name__}; it is a mapping from joint names to factors")
    found = {joint: value for name, value in ratios.items() for joint in select_joints(robot, name)}
    seen = [concrete(value) for value in found.values()]
    if not found or all(value is not None and not value.any() for value in seen):
        raise OsikValueError(f"ratios is {dict(ratios)}; at least one joint has a ratio that is not 0")
    turning = [robot.tree.joint_names[j] for j in found if not is_scalar(robot, j)]
    if turning:
        raise OsikValueError(f"ratios are of the values of hinges and slides; leave out {', '.join(turning)}")
    return {joint: found[joint] for joint in sorted(found)}
