"""A task that keeps the equality constraints of an MJCF model: closed loops and coupled joints."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import mujoco
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikTypeError, OsikValueError, unknown_name
from ..kinematics import Kinematics, frame_jacobian
from ..kinematics._forward import independent_columns
from ..kinematics._rigid import compose, cross, rotate
from ..numerics._host import to_jax
from ..robot import Robot
from ..robot._joint_selection import dofs_of
from ..robot._tree import KinematicTree
from ..robot.loading._equalities import KINDS, constraint_ends, is_in_tree
from ..robot.loading._mjmodel import element_names
from ._curvature import jacobian_curvature
from ._gain import AdaptiveGain
from ._rotation import cross_matrix
from ._task import DEFAULT_GAIN, Task, TaskRows

_Rows = tuple[Float[Array, " m"], Float[Array, "m nv"]]


class Constraint(NamedTuple):
    """Static structure of one constraint."""

    name: str
    kind: str  # "connect", "weld" or "joint"
    ends: tuple[str, ...]  # two frames, or one or two joints


class EqualityConstraintTask(Task):
    """Task that keeps equality constraints of the robot's MJCF model: ``connect``, ``weld`` and ``joint``.

    A kinematic tree cannot have loops: linkages that close are cut somewhere, and a constraint holds the ends together.
    The error is MuJoCo's residual (``efc_pos``), asked to follow ``e' = -gain e``; use ``hard=True`` or the first
    priority. With p, R the points and axes of the two ends:

    - connect: ``p_1 - p_2``, 3 rows [m];
    - weld: that, and ``torque_scale`` times the vector part of the quaternion of ``R_2' R_1 relative``, about half the
      angle [rad] between the two, which go the short way round; 6 rows;
    - joint: ``q_1 - r_1 - polynomial(q_2 - r_2)`` with r the values at MuJoCo's ``qpos0``; 1 row [rad or m].

    Rows are in the order of the model's constraints. Anchors stay in their bodies' axes: they do not follow
    ``Robot.scaled``. Other constraints (tendons, flexes) cannot be kept by this task.

    Args:
        robot: the robot, from MJCF or a MuJoCo model.
        constraints: names of constraints; one without a name is called by its number, ``"equality0"``. Default: all
            active ones of the three kinds, but for joint constraints that the robot already has as mimic or locked
            joints.
        weight: of each squared row: a scalar, or one for each constraint.
        gain: [1/s], a number or an ``AdaptiveGain``.

    Raises:
        KeyError: no such constraint.
        TypeError: one string instead of a sequence of them.
        ValueError: there is none to keep, one is of another kind, or the robot has it as a mimic or locked joint.
    """

    is_goal: ClassVar[bool] = True
    ties_joints: ClassVar[bool] = True
    constraints: tuple[Constraint, ...] = eqx.field(static=True)
    anchors: Float[Array, "k 2 3"]
    """Points that must coincide, in both frames of each connect and weld [m]."""
    relative: Float[Array, "w 3 3"]
    """Rotation between the wanted axes of each weld's second end and its first end."""
    torque_scale: Float[Array, " w"]
    """Factor on each weld's rotation rows [m]."""
    coefficients: Float[Array, "j 5"]
    """Polynomial coefficients of each joint constraint, constant term first."""

    def __init__(
        self,
        robot: Robot,
        *,
        constraints: Iterable[str] | None = None,
        weight: ArrayLike | Array = 1.0,
        gain: ArrayLike | Array | AdaptiveGain = DEFAULT_GAIN,
        priority: int = 1,
        hard: bool = False,
    ):
        chosen = _selected(robot, constraints)
        self.constraints = tuple(_structure(robot, e) for e in chosen)
        dtype = self._set_up(robot, weight, priority, hard, gain)
        model = robot.mj_model
        kinds = [constraint.kind for constraint in self.constraints]
        spatial = [e for e, kind in zip(chosen, kinds, strict=True) if kind != "joint"]
        welds = [e for e, kind in zip(chosen, kinds, strict=True) if kind == "weld"]
        joints = [e for e, kind in zip(chosen, kinds, strict=True) if kind == "joint"]
        ends = {e: constraint_ends(model, robot.frame_names, e) for e in spatial}
        self.anchors = to_jax(np.reshape([own.anchors for own in ends.values()], (-1, 2, 3)), dtype)
        self.relative = to_jax(np.reshape([ends[e].relative for e in welds], (-1, 3, 3)), dtype)
        self.torque_scale = to_jax([model.eq_data[e, 10] for e in welds], dtype)
        self.coefficients = to_jax(np.reshape([model.eq_data[e, :5] for e in joints], (-1, 5)), dtype)

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return 3, 6 or 1 rows per connect, weld or joint constraint."""
        joints, spatial = iter(self._joint_rows(robot, q)), iter(self._spatial_rows(robot, kinematics))
        parts = [next(joints if constraint.kind == "joint" else spatial) for constraint in self.constraints]
        error, jacobian = (jnp.concatenate(arrays) for arrays in zip(*parts, strict=True))
        counts = np.array([len(own) for own, _ in parts])
        # one weight for each constraint, which its 3, 6 or 1 rows share
        weight = jnp.broadcast_to(self.weight, counts.shape)[np.repeat(np.arange(len(counts)), counts)]
        bound = partial(jacobian_curvature, jacobian=jnp.where(robot.tree.turning, jacobian, 0.0))
        rows = TaskRows.of(error, jacobian, gain=self.gain, weight=weight, curvature=bound)
        return replace(rows, closes_loop=True)

    def counted_dofs(self, robot: Robot) -> tuple[int, ...]:
        """Return the entries of v of the joints in joint constraints."""
        ends = [joint for constraint in self.constraints if constraint.kind == "joint" for joint in constraint.ends]
        return tuple(dofs_of(robot, [robot.tree.joint_names.index(name) for name in ends]))

    @property
    def _weight_rows(self) -> int:
        return len(self.constraints)

    def _spatial_rows(self, robot: Robot, kinematics: Kinematics) -> list[_Rows]:
        """Return the rows of each connect and weld."""
        spatial = [constraint for constraint in self.constraints if constraint.kind != "joint"]
        if not spatial:
            return []
        frames = [frame for constraint in spatial for frame in constraint.ends]
        origins, turns = kinematics.frame_poses(robot, frames)
        arms = rotate(turns, self.anchors.reshape(-1, 3))
        jacobians = frame_jacobian(robot, kinematics, frames)
        linear = jacobians[:, :3] + cross(jacobians[:, 3:], arms[:, :, None], along=-2)
        points, linear, angular, turns = (
            a.reshape(len(spatial), 2, *a.shape[1:]) for a in (origins + arms, linear, jacobians[:, 3:], turns)
        )
        rows = list(zip(points[:, 0] - points[:, 1], linear[:, 0] - linear[:, 1], strict=True))
        welds = [place for place, constraint in enumerate(spatial) if constraint.kind == "weld"]
        for weld, place in enumerate(welds):
            turned = self._turned(weld, turns[place], angular[place])
            rows[place] = jnp.concatenate([rows[place][0], turned[0]]), jnp.concatenate([rows[place][1], turned[1]])
        return rows

    def _turned(self, weld: int, turns: Float[Array, "2 3 3"], angular: Float[Array, "2 3 nv"]) -> _Rows:
        """Return the rotation rows of a weld."""
        first, second = turns
        wxyz = jaxlie.SO3.from_matrix(compose(second.T, compose(first, self.relative[weld]))).wxyz
        # q and -q are one rotation; w >= 0 goes the short way round
        wxyz = jnp.where(wxyz[0] < 0.0, -wxyz, wxyz)
        rate = 0.5 * (wxyz[0] * jnp.eye(3, dtype=wxyz.dtype) - cross_matrix(wxyz[1:]))
        spin = jnp.matmul(compose(rate, second.T), angular[0] - angular[1], precision="highest")
        return self.torque_scale[weld] * wxyz[1:], self.torque_scale[weld] * spin

    def _joint_rows(self, robot: Robot, q: Float[Array, " nq"]) -> list[_Rows]:
        joints = [constraint.ends for constraint in self.constraints if constraint.kind == "joint"]
        qpos, tree = robot.mujoco_qpos(q) - robot.joint_reference, robot.tree
        rows = []
        for (name, *leader), (constant, *higher) in zip(joints, self.coefficients, strict=True):
            error, jacobian = qpos[_qpos(tree, name)] - constant, _column(tree, name, q.dtype)
            for other in leader:
                x = qpos[_qpos(tree, other)]
                # MuJoCo's sign: first joint minus the polynomial of the second
                error = error - sum(c * x ** (k + 1) for k, c in enumerate(higher))
                derivative = sum((k + 1) * c * x**k for k, c in enumerate(higher))
                jacobian = jacobian - derivative * _column(tree, other, q.dtype)
            rows.append((error[None], independent_columns(tree, jacobian)[None]))
        return rows


def _qpos(tree: KinematicTree, joint: str) -> int:
    return int(tree.full_qpos_address[tree.joint(joint)])


def _column(tree: KinematicTree, joint: str, dtype: Any) -> Float[Array, " nvfull"]:
    """Return a row with 1 at the joint's own dof and 0 elsewhere. (nv,)."""
    return jnp.asarray(np.arange(len(tree.dof_joint)) == tree.full_dof_address[tree.joint(joint)], dtype)


def _selected(robot: Robot, names: Iterable[str] | None) -> list[int]:
    """Return the indices of the selected constraints of the model, in its order."""
    model = robot.mj_model
    available = element_names(model, "equality")
    if names is None:
        active = np.flatnonzero(model.eq_active0)
        found = [int(e) for e in active if int(model.eq_type[e]) in KINDS and not is_in_tree(model, int(e))]
        if not found:
            raise OsikValueError(
                "the model has no active connect, weld or joint constraint that is not a mimic or locked joint; "
                f"constraints: {', '.join(available) or '(none)'}"
            )
        return found
    if isinstance(names, str):
        raise OsikTypeError(f"constraints is a sequence of names, not one string: use ({names!r},)")
    numbers = set()
    for name in names:
        if name not in available:
            raise unknown_name("constraint", name, available)
        numbers.add(available.index(name))
        _check_kind(robot, available.index(name), name)
    if not numbers:
        raise OsikValueError(f"there is no constraint to keep; constraints: {', '.join(available)}")
    return sorted(numbers)


def _check_kind(robot: Robot, e: int, name: str) -> None:
    if int(robot.mj_model.eq_type[e]) not in KINDS:
        kind = mujoco.mjtEq(int(robot.mj_model.eq_type[e])).name
        raise OsikValueError(f"constraint {name!r} is of kind {kind}; it can be connect, weld or joint")
    if is_in_tree(robot.mj_model, e):
        raise OsikValueError(f"constraint {name!r} holds already: its joint is a mimic joint of the robot, or locked")


def _structure(robot: Robot, e: int) -> Constraint:
    model = robot.mj_model
    name, kind = element_names(model, "equality")[e], KINDS[int(model.eq_type[e])]
    if kind != "joint":
        return Constraint(name, kind, constraint_ends(model, robot.frame_names, e).frames)
    joints = [int(i) for i in (model.eq_obj1id[e], model.eq_obj2id[e])]
    return Constraint(name, kind, tuple(robot.tree.joint_names[i] for i in joints if i >= 0))
