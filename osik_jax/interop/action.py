"""Action spaces of reinforcement learning: from an action of a policy to joint targets, as a pure function."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from .._errors import OsikTypeError, OsikValueError, unknown_name
from ..control import solve
from ..control._checks import check_setting, check_tasks, checked_limits
from ..control._rollout import move
from ..kinematics import forward_kinematics
from ..limits import Limit, Limits
from ..numerics._arguments import as_array
from ..robot import Robot
from ..robot._joint_selection import is_scalar, select_joints
from ..schemes import Scheme
from ..tasks import FrameTask, Task


class _JointTargets(NamedTuple):
    """Joint targets; ``TaskSpaceAction`` says what the fields are."""

    position: Float[Array, " n"]
    q: Float[Array, " nq"]
    velocity: Float[Array, " nv"]
    status: Int[Array, ""]


class TaskSpaceAction(eqx.Module):
    """Action space of poses of frames: an action in [-1, 1] becomes joint targets within the robot's limits.

    ``action(q, raw)`` moves the target of each commanded task, solves one step of ``dt`` and returns

    - ``position``: targets of the joints named in ``joints``, in their order [rad or m]. (n,)
    - ``q``: the whole configuration after the step. (nq,)
    - ``velocity``: of the step [rad/s or m/s]. (nv,)
    - ``status``: a ``Status`` code. With NUMERICAL_ERROR (a NaN in q or the action) the robot holds its configuration.

    It is pure: use it in ``jit``, ``vmap`` and ``grad``, in an MJX environment, and by ``interop.torch.wrap`` in
    PyTorch. The joints stay within their ranges and speed limits whatever the action is (``WeightedQP`` and
    ``HierarchicalQP``).

    The entries of an action are, for each commanded task in the order of ``commanded``: x, y, z of the position if it
    has position rows, then a rotation vector if it has orientation rows, in world axes. An entry is cut at -1 and 1 and
    multiplied by its scale.

    The target is the frame's pose at q, moved by the scaled action.

    A task of gain ``1 / dt`` asks for all of its error in one step. Limits, other tasks and the damping of the scheme
    leave a part of it; ``WeightedQP(curvature_damping=0.0)`` follows small actions exactly, and is less calm where a
    target is out of reach. With the default gain of 10/s a step takes the share ``10 dt``.

    Args:
        robot: the robot.
        tasks: by name, as ``solve`` takes them.
        commanded: names of the ``FrameTask`` that the action moves. Default: every ``FrameTask``.
        position_scale: largest motion of a position [m].
        rotation_scale: largest rotation [rad].
        joints: names of the joints whose targets are returned, hinges and slides, such as those of the actuators in
            their order. Default: all independent ones, in the order of q.
        scheme: as in ``solve``.
        limits: as in ``solve``; limits that remember the last velocity take it as 0.
        dt: time of a step [s]: the period of the policy.

    Attributes:
        size: number of entries of an action.
        names: of the entries: ``"hand.x"``, ..., ``"hand.rz"``.
        joints: names of the joints of ``position``.

    Raises:
        KeyError: a task or joint that does not exist.
        TypeError: a commanded task that is no ``FrameTask``.
        ValueError: as in ``solve``; a scale that is not positive, a joint of several entries.
    """

    robot: Robot
    tasks: dict[str, Task]
    scale: Float[Array, " size"]
    scheme: Scheme | None
    limits: tuple[Limit, ...] | None
    dt: Float[Array, ""]
    commanded: tuple[str, ...] = eqx.field(static=True)
    joints: tuple[str, ...] = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        robot: Robot,
        tasks: Mapping[str, Task],
        *,
        commanded: Sequence[str] | None = None,
        position_scale: float = 0.05,
        rotation_scale: float = 0.2,
        joints: Sequence[str] | None = None,
        scheme: Scheme | None = None,
        limits: Limits | None = None,
        dt: float = 0.02,
    ):
        check_setting("TaskSpaceAction(robot, tasks)", robot, scheme, dt)
        check_tasks(tasks, robot)
        for what, scale in (("position_scale", position_scale), ("rotation_scale", rotation_scale)):
            if isinstance(scale, Mapping) or not (np.ndim(scale) == 0 and 0.0 < scale < np.inf):
                raise OsikValueError(f"{what} is {scale!r}; it is a positive number")
        self.robot, self.tasks = robot, dict(tasks)
        self.scheme, self.limits = scheme, checked_limits(robot, limits)
        self.dt = jnp.asarray(dt, robot.q0.dtype)
        self.commanded = _commanded(tasks, commanded)
        scales = [
            scale
            for name in self.commanded
            for scale, moved in zip((position_scale, rotation_scale), _moves(tasks[name]), strict=True)
            for _ in range(3 * moved)
        ]
        self.scale = jnp.asarray(scales, robot.q0.dtype)
        self.joints, self.places = _joints(robot, joints)

    @property
    def size(self) -> int:
        """Return the number of entries of an action."""
        return self.scale.shape[-1]

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of an action's entries: the task, then x, y, z (position), rx, ry, rz (rotation)."""
        return tuple(
            f"{name}.{entry}"
            for name in self.commanded
            for axes, moved in zip(("x y z", "rx ry rz"), _moves(self.tasks[name]), strict=True)
            for entry in axes.split() * moved
        )

    def __call__(self, q: Float[ArrayLike, " nq"], action: Float[ArrayLike, " size"]) -> _JointTargets:
        """Return joint targets for an action at a configuration: ``position``, ``q``, ``velocity`` and ``status``.

        Args:
            q: configuration (nq,): the measured one, or the ``q`` of the last result. From the last result, gravity and
                servo errors do not move a relative target.
            action: (size,); entries beyond -1 and 1 are cut.

        Raises:
            ValueError: a wrong shape.
        """
        q = jnp.asarray(q)
        raw = as_array(action, "action", self.scale.dtype) if not isinstance(action, jax.Array) else action
        if raw.shape != (self.size,):
            raise OsikValueError(
                f"action has shape {raw.shape}, expected ({self.size},): {', '.join(self.names)}. Batch with jax.vmap."
            )
        targets = self.targets(q, raw)
        answer = solve(self.robot, q, self.tasks, scheme=self.scheme, limits=self.limits, dt=self.dt, targets=targets)
        after = move(self.robot, q, answer.velocity, self.dt)
        return _JointTargets(after[np.array(self.places, int)], after, answer.velocity, answer.status)

    def __hash__(self) -> int:
        """Return a hash by identity: ``jax.jit(action)`` keeps the numbers as constants."""
        return id(self)

    def __eq__(self, other: object) -> bool:
        """Return whether it is the same object."""
        return self is other

    def targets(self, q: Float[Array, " nq"], action: Float[Array, " size"]) -> dict[str, tuple[Array, Array]]:
        """Return the pose (position (3,), rotation (3, 3)) that an action asks of each commanded frame."""
        motion = jnp.clip(action, -1.0, 1.0) * self.scale
        kinematics = forward_kinematics(self.robot, q)
        out, first = {}, 0
        for name in self.commanded:
            task = self.tasks[name]
            assert isinstance(task, FrameTask)
            p, R = kinematics.frame_pose(self.robot, task.frame)
            moves_position, moves_rotation = _moves(task)
            if moves_position:
                p, first = p + motion[first : first + 3], first + 3
            if moves_rotation:
                R, first = jaxlie.SO3.exp(motion[first : first + 3]).as_matrix() @ R, first + 3
            out[name] = (p, R)
        return out


def _commanded(tasks: Mapping[str, Task], names: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of the tasks that an action moves, checked."""
    if isinstance(names, str):
        raise OsikTypeError(f"commanded is a sequence of names, not one string: use ({names!r},)")
    found = (
        tuple(name for name, task in tasks.items() if isinstance(task, FrameTask)) if names is None else tuple(names)
    )
    if not found:
        raise OsikValueError(f"there is no task to command; a FrameTask is one. Tasks: {', '.join(tasks)}")
    for name in found:
        if name not in tasks:
            raise unknown_name("task", name, tuple(tasks))
        if not isinstance(tasks[name], FrameTask):
            raise OsikTypeError(f"tasks[{name!r}] is a {type(tasks[name]).__name__}; an action moves a FrameTask")
    return found


def _moves(task: Any) -> tuple[bool, bool]:
    """Return whether a frame task has position rows, and orientation rows."""
    return any(task.kept[:3]), any(task.kept[3:])


def _joints(robot: Robot, names: Sequence[str] | None) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Return names and indices in q of the joints whose targets are returned."""
    if isinstance(names, str):
        raise OsikTypeError(f"joints is a sequence of names, not one string: use ({names!r},)")
    if names is None:
        chosen = [joint for joint in robot.tree.independent if is_scalar(robot, joint)]
    else:
        chosen = [joint for name in names for joint in select_joints(robot, name)]
    for joint in chosen:
        if not is_scalar(robot, joint):
            raise OsikValueError(f"joint {robot.tree.joint_names[joint]!r} has several entries; name hinges and slides")
    return tuple(robot.tree.joint_names[j] for j in chosen), tuple(robot.tree.qpos_address[j] for j in chosen)
