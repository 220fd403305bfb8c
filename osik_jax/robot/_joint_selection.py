"""Selection of entries of q and v by joint names and globs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._errors import OsikTypeError, OsikValueError
from ..numerics._arguments import as_array
from ..numerics._host import on_host, replaced_at, to_jax
from ._robot import Robot
from ._tree import DOF_WIDTH, FREE, HINGE, SLIDE
from .loading._followers import match_names


def select_joints(robot: Robot, pattern: str) -> list[int]:
    """Return the independent joints named ``pattern``, else those (except free joints) that match it as a glob."""
    names, kinds = robot.tree.joint_names, robot.tree.joint_types
    own = [j for j in robot.tree.independent if kinds[j] != FREE or names[j] == pattern]
    return [own[k] for k in match_names("joint", pattern, tuple(names[j] for j in own))]


def select_all(robot: Robot, patterns: Iterable[str] | None) -> list[int]:
    """Return the independent joints that match any pattern, in the order of v; ``None``: all but the free joints."""
    if patterns is None:
        return [j for j in robot.tree.independent if robot.tree.joint_types[j] != FREE]
    if isinstance(patterns, str):
        raise OsikTypeError(f"joints is a sequence of names and globs, not one string: use ({patterns!r},)")
    if not isinstance(patterns, Iterable):
        raise OsikTypeError(f"joints is {patterns!r}; it is a sequence of names and globs")
    found = sorted({joint for pattern in patterns for joint in select_joints(robot, pattern)})
    if not found:
        raise OsikValueError(f"joints is empty; name at least one joint, or None for all of {robot.tree.dof_owners}")
    return found


def dofs_of(robot: Robot, joints: Sequence[int]) -> list[int]:
    """Return the entries of v that belong to some independent joints, joint by joint."""
    tree = robot.tree
    return [tree.dof_address[j] + i for j in joints for i in range(DOF_WIDTH[tree.joint_types[j]])]


def is_scalar(robot: Robot, joint: int) -> bool:
    """Return whether a joint is a hinge or a slide: one entry in q, one in v."""
    return robot.tree.joint_types[joint] in (HINGE, SLIDE)


def check_scalar_joints(robot: Robot, what: str) -> None:
    """Raise ValueError if the robot has ball or free joints; ``what`` begins the message, such as "a move"."""
    others = [robot.tree.joint_names[j] for j in robot.tree.independent if not is_scalar(robot, j)]
    if others:
        raise OsikValueError(
            f"{what} is for hinges and slides alone, and the robot has other joints: {', '.join(others)}; lock them "
            "(locked_joints=), or fix the base (floating_base=False)"
        )


def scalar_layout(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Return which dofs are hinges or slides, and the index of each in q (0 for other dofs). (nv,) each."""
    mask, index = np.zeros(robot.nv, bool), np.zeros(robot.nv, int)
    for joint, dof in robot.tree.dof_address.items():
        if is_scalar(robot, joint):
            mask[dof], index[dof] = True, robot.tree.qpos_address[joint]
    return mask, index


def dof_of_entries(robot: Robot) -> np.ndarray:
    """Return the entry of v of each entry of q that is a hinge or a slide; -1 for other entries. (nq,)."""
    scalar, index = scalar_layout(robot)
    out = np.full(robot.nq, -1)
    out[index[scalar]] = np.flatnonzero(scalar)
    return out


def dof_names(robot: Robot) -> list[str]:
    """Return the joint name of each entry of v, for messages. (nv,)."""
    return [robot.tree.joint_names[j] for j in robot.tree.dof_joint[robot.tree.own_dofs]]


def dof_values(robot: Robot, given: Any, default: Float[ArrayLike, " nv"], what: str) -> Float[Array, " nv"]:
    """Return an array over v from a user's input: None, an array (nv,), or a mapping from names or globs to values."""
    dtype = robot.q0.dtype
    if given is None:
        return to_jax(default, dtype)
    if isinstance(given, Mapping):
        values = on_host(to_jax(default, dtype))
        for pattern, value in given.items():
            for joint in select_joints(robot, pattern):
                values = replaced_at(values, robot.tree.dofs(joint), as_array(value, f"{what}[{pattern!r}]", dtype))
        return to_jax(values)
    values = as_array(given, what, dtype)
    if values.shape != (robot.nv,):
        raise OsikValueError(
            f"{what} has shape {values.shape}, expected ({robot.nv},), one entry for each of "
            f"{', '.join(dof_names(robot))}; or give a mapping from joint names to values"
        )
    return values
