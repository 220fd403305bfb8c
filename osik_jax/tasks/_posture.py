"""Task on joint positions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..kinematics import Kinematics, difference
from ..robot import Robot
from ..robot._joint_selection import dofs_of, is_scalar, select_all
from ..robot._tree import BALL, DOF_WIDTH, FREE
from ._curvature import no_curvature
from ._gain import AdaptiveGain
from ._leaves import WeightLike, as_array, as_vector, background_weight, check_finite, joint_weight
from ._rotation import inverse_left_jacobian
from ._task import DEFAULT_GAIN, POSTURE, CoreCard, Task, TaskRows


class PostureTask(Task):
    """Task that brings joints to a configuration, or keeps them within bounds.

    - A target q*: ``e = difference(q*, q)`` on the chosen joints' dofs (hinges and slides: ``q - q*``; ball and free
      joints: the rotation vector ``log(R*' R)``, and the base's position in the world), asked to follow
      ``e' = -gain(e) e``. The Jacobian is rows of the identity, with the inverse right Jacobian of SO(3) on rotations.
    - Bounds: ``gain (lower - q) <= v - q*' <= gain (upper - q)``, on the joint values themselves; hinges and slides.

    Args:
        robot: the robot.
        target: a configuration (nq,); default: ``robot.q0``. Joints that are not chosen do not matter.
        target_velocity: of the target, or of the bounds, one entry for each row [rad/s or m/s] (rotations: angular
            velocity in the target's axes); default 0.
        lower: makes an inequality task: lower bounds on the joint values [rad or m], one for each row, or a scalar.
        upper: upper bounds; one of the two may be left out, infinite entries bound nothing.
        joints: names and globs, e.g. ``("Head*", "LElbowRoll")``; rows are in the order of v whatever the order here.
            Default: all but the free base, which has to be named to take part.
        weight: of each squared row: a scalar, one for each row or for each entry of v, or a mapping from joint names or
            globs to weights, in which a joint that is not named has 0. Default: 1 where joints are named, and for
            bounds; for a target of the whole robot 1e-4, so that other tasks win, and less on a robot whose size s, the
            longest way along its links, is below half a metre: 1e-4 (s / 0.5 m)^2.
        gain: [1/s], a number or an ``AdaptiveGain``.

    Raises:
        KeyError: no such joint, or it is locked or a mimic follower; in ``joints`` or ``weight``.
        TypeError: arguments that exclude each other.
        ValueError: a wrong shape, a negative weight, lower > upper, bounds on a ball or free joint.
    """

    units: ClassVar[Mapping[str, str]] = {
        "": "rad or m",
        "target": "rad or m; quaternion w x y z",
        "target_velocity": "rad/s or m/s",
    }
    joints: tuple[int, ...] = eqx.field(static=True)
    target: Float[Array, " nq"] | None
    target_velocity: Float[Array, " m"]
    lower: Float[Array, " m"] | None
    upper: Float[Array, " m"] | None

    def __init__(
        self,
        robot: Robot,
        *,
        target: ArrayLike | Array | None = None,
        target_velocity: ArrayLike | Array | None = None,
        lower: ArrayLike | Array | None = None,
        upper: ArrayLike | Array | None = None,
        joints: Iterable[str] | None = None,
        weight: WeightLike | None = None,
        gain: ArrayLike | Array | AdaptiveGain = DEFAULT_GAIN,
        priority: int = 1,
        hard: bool = False,
    ):
        self.joints = tuple(select_all(robot, joints))
        dofs, dtype = dofs_of(robot, self.joints), robot.q0.dtype
        rows = len(dofs)
        if weight is None:
            # a whole-body posture settles what goals leave open; named joints and bounds are goals themselves
            weight = background_weight(robot) if joints is None and lower is None and upper is None else 1.0
        velocity = 0.0 if target_velocity is None else target_velocity
        self.target_velocity = as_vector(velocity, (rows,), "target_velocity", dtype)
        self._set_up(robot, joint_weight(robot, weight, dofs), priority, hard, gain)
        self.target = None
        if self._set_bounds(target, lower, upper, rows, dtype):
            self.target = as_array(robot.q0 if target is None else target, "target", dtype)
            robot.check_configuration(self.target, "target")
            return
        turning = [robot.tree.joint_names[j] for j in self.joints if not is_scalar(robot, j)]
        if turning:
            raise OsikValueError(f"bounds are on the values of hinges and slides; leave out {', '.join(turning)}")

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return one row per dof of the chosen joints, in the order of v."""
        del kinematics
        dofs = dofs_of(robot, self.joints)
        jacobian = jnp.asarray(np.eye(robot.nv)[dofs], self.weight.dtype)
        feedforward = self.target_velocity
        if self.target is None:
            error = q[np.array([robot.tree.qpos_address[j] for j in self.joints])]
        else:
            error = self._difference(robot, self.target, q, dofs)
            jacobian, feedforward = self._turn(robot, error, jacobian)
        return TaskRows.of(
            error,
            jacobian,
            gain=self.gain,
            weight=jnp.broadcast_to(self.weight, error.shape),
            lower=self.lower,
            upper=self.upper,
            feedforward=feedforward,
            dofs=tuple(dofs) if self._adds(robot) else None,
            curvature=no_curvature,
        )

    def _card(self, robot: Robot) -> CoreCard | str:
        if not self._adds(robot):
            return "has joints that turn as a ball"
        dofs = dofs_of(robot, self.joints)
        return CoreCard(POSTURE, len(dofs), [*(robot.tree.qpos_address[joint] for joint in self.joints), *dofs])

    def core_leaves(self) -> list[Any]:
        """Return the leaves in the order of the card in ``core/tasks``."""
        bounds = self.lower, self.upper
        return [self.gain, self.weight, self.target_velocity, *bounds, self.target, None, None, None]

    def counted_dofs(self, robot: Robot) -> tuple[int, ...]:
        """Return the entries of v of the chosen joints."""
        return tuple(dofs_of(robot, self.joints))

    @property
    def _weight_rows(self) -> int:
        return len(self.target_velocity)

    def _held(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> dict[str, Any]:
        return super()._held(robot, kinematics, q) if self.target is None else dict(target=q)

    def _adds(self, robot: Robot) -> bool:
        """Return whether all joints are hinges and slides, whose positions are plain numbers."""
        return all(is_scalar(robot, joint) for joint in self.joints)

    def _difference(self, robot: Robot, target: Array, q: Array, dofs: list[int]) -> Float[Array, " m"]:
        """Return ``difference(target, q)`` on the chosen dofs."""
        if self._adds(robot):
            places = np.array([robot.tree.qpos_address[joint] for joint in self.joints])
            return (q - target)[places]
        return difference(robot, target, q)[np.array(dofs)]

    def _turn(self, robot: Robot, error: Array, jacobian: Array) -> tuple[Float[Array, "m nv"], Float[Array, " m"]]:
        """Return Jacobian and feedforward with the blocks of rotations filled in."""
        feedforward, row = self.target_velocity, 0
        for joint in self.joints:
            kind = robot.tree.joint_types[joint]
            width = DOF_WIDTH[kind]
            if kind in (FREE, BALL):
                at, dof = row + width - 3, robot.tree.dof_address[joint] + width - 3
                left = inverse_left_jacobian(error[at : at + 3])
                # e = log(R*' R): its rate is left' w of the joint minus left w* of the target
                jacobian = jacobian.at[at : at + 3, dof : dof + 3].set(left.T)
                turned = jnp.matmul(left, self.target_velocity[at : at + 3], precision="highest")
                feedforward = feedforward.at[at : at + 3].set(turned)
            row += width
        return jacobian, feedforward

    def _convert(self, name: str, value: Any) -> Any:
        if name != "target" or self.target is None:
            return super()._convert(name, value)
        target = as_array(value, name, self.weight.dtype)
        check_finite(target, name)
        if target.shape != self.target.shape:
            raise OsikValueError(f"target has shape {target.shape}, expected {self.target.shape}. Batch with jax.vmap.")
        return target
