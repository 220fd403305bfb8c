"""Tasks on joint velocities, independent of the configuration."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..kinematics import Kinematics
from ..robot import Robot
from ..robot._joint_selection import dofs_of, select_all
from ._bases import MotionTask
from ._leaves import WeightLike, as_vector, background_weight, joint_weight
from ._task import TaskRows


class VelocityTask(MotionTask):
    """Base of tasks on the velocity of dofs: rows of the identity, ``v_i = wanted_i``.

    There is no error that could decay: it is 0, and there is no gain.
    """

    units: ClassVar[Mapping[str, str]] = {"": "rad/s or m/s"}
    joints: tuple[int, ...] = eqx.field(static=True)
    row_count: int = eqx.field(static=True)

    def __init__(
        self,
        robot: Robot,
        *,
        joints: Iterable[str] | None = None,
        weight: WeightLike | None = None,
        priority: int = 1,
        hard: bool = False,
    ):
        # by default far below a goal's weight: at the same weight calm would be bought with errors of the goals
        weight = background_weight(robot) if weight is None else weight
        self.joints = tuple(select_all(robot, joints))
        dofs = dofs_of(robot, self.joints)
        self.row_count = len(dofs)
        self._set_up(robot, joint_weight(robot, weight, dofs), priority, hard)

    def wanted(self, dofs: list[int]) -> Float[Array, " m"]:
        """Return the wanted velocities of the chosen dofs [rad/s or m/s]: 0 unless a subclass says otherwise."""
        return jnp.zeros(len(dofs), self.weight.dtype)

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return one row per dof of the chosen joints, in the order of v."""
        del kinematics, q
        dofs = dofs_of(robot, self.joints)
        wanted = self.wanted(dofs)
        return TaskRows(
            # no error of the configuration and no gain: the rows ask for the velocity itself
            error=jnp.zeros_like(wanted),
            jacobian=jnp.asarray(np.eye(robot.nv)[dofs], wanted.dtype),
            lower=wanted,
            upper=wanted,
            weight=jnp.broadcast_to(self.weight, wanted.shape),
            dofs=tuple(dofs),
            is_equality=True,
        )

    def counted_dofs(self, robot: Robot) -> tuple[int, ...]:
        """Return the entries of v of the chosen joints."""
        return tuple(dofs_of(robot, self.joints))

    @property
    def _weight_rows(self) -> int:
        return self.row_count


class DampingTask(VelocityTask):
    """Task for small joint velocities at a low weight: among motions that serve other tasks, it prefers slow ones.

    ``v_i = 0``. It calms near singularities and settles what the other tasks leave open. Each scheme has a damping of
    all dofs of its own; this one has a weight and a priority, and can choose joints.

    Args:
        robot: the robot.
        joints: names and globs, as of a ``PostureTask``; default: all but the free base.
        weight: of each squared row, in the forms and with the default of a ``PostureTask``'s.

    Raises:
        KeyError: no such joint, or it is locked or a mimic follower.
        ValueError: a negative weight.
    """

    calms: ClassVar[bool] = True

    def __init__(
        self,
        robot: Robot,
        *,
        joints: Iterable[str] | None = None,
        weight: WeightLike | None = None,
        priority: int = 1,
        hard: bool = False,
    ):
        super().__init__(robot, joints=joints, weight=weight, priority=priority, hard=hard)


class FreezeTask(VelocityTask):
    """Task that keeps joints at rest while the rest of the robot moves: ``v_i = 0``.

    Meant as a constraint (``hard=True``) or at priority 1; to leave joints out of the problem altogether, load the
    robot with ``locked_joints``. ``inverse_kinematics`` has to meet it: the joints stay where they are at ``q0``.

    Args:
        robot: the robot.
        joints: names and globs, e.g. ``("Head*", "LElbowRoll")``; the free base by its name.
        weight: of each squared row, in the forms of a ``PostureTask``'s; default 1.

    Raises:
        KeyError: no such joint, or it is locked or a mimic follower.
        ValueError: no joints, a negative weight.
    """

    is_goal: ClassVar[bool] = True

    def __init__(
        self,
        robot: Robot,
        joints: Iterable[str],
        *,
        weight: WeightLike = 1.0,
        priority: int = 1,
        hard: bool = False,
    ):
        super().__init__(robot, joints=joints, weight=weight, priority=priority, hard=hard)
        if not self.joints:
            raise OsikValueError("a FreezeTask needs at least one joint")


class JointVelocityTask(VelocityTask):
    """Task that moves joints at given velocities: ``v_i = target_i``.

    Args:
        robot: the robot.
        target: the velocities [rad/s or m/s], one for each row, or a scalar. Rows are in the order of v; ball joints
            have angular velocities in their own axes, a free base linear ones in the world's and angular ones in its
            own.
        joints: names and globs, as of a ``PostureTask``; default: all but the free base.
        weight: of each squared row, in the forms of a ``PostureTask``'s; default 1.

    Raises:
        KeyError: no such joint, or it is locked or a mimic follower.
        ValueError: a wrong shape, a negative weight.
    """

    target: Float[Array, " m"]

    def __init__(
        self,
        robot: Robot,
        target: ArrayLike | Array,
        *,
        joints: Iterable[str] | None = None,
        weight: WeightLike = 1.0,
        priority: int = 1,
        hard: bool = False,
    ):
        super().__init__(robot, joints=joints, weight=weight, priority=priority, hard=hard)
        self.target = as_vector(target, (self.row_count,), "target", robot.q0.dtype)

    def wanted(self, dofs: list[int]) -> Float[Array, " m"]:
        """Return the target velocities [rad/s or m/s]."""
        del dofs
        return self.target


class LowAccelerationTask(VelocityTask):
    """Task that keeps the joint velocities of the step before: ``v_i = velocity_i``.

    At a low weight it makes joint velocities change less from step to step. Noise in targets then moves the joints more
    slowly, and joints that the other tasks leave free as far or farther: a lower gain is what helps against noise.
    It does not slow a motion down, so add a ``PostureTask`` or a ``DampingTask``. Beneath tasks that leave its joints
    no freedom it does nothing, and ``solve`` and ``rollout`` warn. ``rollout`` passes the velocity from step to step;
    with ``solve``, write ``task = task.after(solution.velocity)``.

    Args:
        robot: the robot.
        velocity: that of the step before (nv,) [rad/s or m/s], or a scalar; default 0, a robot at rest.
        joints: names and globs, as of a ``PostureTask``; default: all but the free base.
        weight: of each squared row, in the forms and with the default of a ``PostureTask``'s.

    Raises:
        KeyError: no such joint, or it is locked or a mimic follower.
        ValueError: a wrong shape, a negative weight.
    """

    velocity: Float[Array, " nv"]

    calms: ClassVar[bool] = True

    def __init__(
        self,
        robot: Robot,
        *,
        velocity: ArrayLike | Array = 0.0,
        joints: Iterable[str] | None = None,
        weight: WeightLike | None = None,
        priority: int = 1,
        hard: bool = False,
    ):
        super().__init__(robot, joints=joints, weight=weight, priority=priority, hard=hard)
        self.velocity = as_vector(velocity, (robot.nv,), "velocity", robot.q0.dtype)

    def wanted(self, dofs: list[int]) -> Float[Array, " m"]:
        """Return the last velocity of the dofs."""
        return self.velocity[np.array(dofs, int)]

    def after(self, velocity: Float[Array, " nv"]) -> Self:
        """Return the task for the next step, given this step's ``velocity`` [rad/s or m/s]."""
        return self.replace(velocity=velocity)
