"""Kinematics by the compiled core (``core/kinematics.hpp``), called from JAX.

``_forward.py`` is the definition, what runs elsewhere, and the derivative. The core computes in double precision.
Arguments have a leading axis of lanes, or one of length 1 where all lanes share them: robots are seldom many.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..execution._computed import side_by_side
from ..robot import Robot
from ..robot._tree import KinematicTree

Call = Callable[..., list[Array]]


def bodies(call: Call, robot: Robot, q: Float[Array, "lanes nq"]) -> tuple[Array, ...]:
    """Return the fields of ``Kinematics``."""
    tree, integers = robot.tree, tree_integers(robot.tree)
    numbers = side_by_side(
        *(tree.qpos_source[1][None], robot.qpos_offset, robot.joint_reference, robot.body_position),
        *(robot.body_quaternion, robot.joint_position, robot.joint_axis),
    )
    lanes, count, full = max(len(q), len(numbers)), len(tree.body_parents), len(tree.dof_joint)
    shapes = (count, 3), (count, 3, 3), (full, 3), (full, 3), (full, 3)
    outputs = [((lanes, *shape), float) for shape in shapes]
    return tuple(call("kinematics", outputs, q, numbers, integers.astype(np.int32)))


def tree_integers(tree: KinematicTree) -> np.ndarray:
    """Return the length of MuJoCo's configuration, then the indices of ``Tree`` in the core and of ``qpos_source``."""
    index, _ = tree.qpos_source
    return np.concatenate([[len(index)], tree.body_parents, tree.joint_types, tree.joint_bodies, index])


def moving_frames(call: Call, robot: Robot, kinematics: Any, ids: Sequence[int]) -> tuple[Array, Array, Array]:
    """Return positions, rotations and Jacobians of frames."""
    tree, chosen = robot.tree, np.asarray(ids, int)
    carriers = np.asarray(tree.frame_bodies, int)[chosen]
    columns, factors = dof_columns(tree)
    integers = np.concatenate([carriers, columns, tree.moves[carriers].ravel()])
    numbers = side_by_side(factors[None], robot.frame_position[:, chosen], robot.frame_rotation[:, chosen])
    given = _arrays(kinematics)
    lanes, k = max(len(a) for a in (*given, numbers)), len(chosen)
    positions, rotations, jacobians = call(
        "moving_frames",
        [((lanes, *shape), float) for shape in ((k, 3), (k, 3, 3), (k, 6, tree.nv))],
        *(*given, numbers, integers.astype(np.int32)),
    )
    return positions, rotations, jacobians


def center_of_mass(call: Call, robot: Robot, kinematics: Any) -> tuple[Array, Array]:
    """Return the centre of the masses of the bodies, and its Jacobian."""
    given, integers, lanes = center_arguments(robot, kinematics)
    outputs = [((lanes, 3), float), ((lanes, 3, robot.tree.nv), float)]
    center, jacobian = call("center_of_mass", outputs, *given, integers, space=4 * len(robot.tree.body_parents))
    return center, jacobian


def center_arguments(robot: Robot, kinematics: Any) -> tuple[tuple[Array, ...], np.ndarray, int]:
    """Return the arguments of the centre-of-mass kernels: arrays, integers, and the number of lanes."""
    tree = robot.tree
    columns, factors = dof_columns(tree)
    integers = np.concatenate([tree.body_parents, tree.dof_body, columns]).astype(np.int32)
    given = *_arrays(kinematics), side_by_side(factors[None], robot.body_mass, robot.body_com)
    return given, integers, max(len(a) for a in given)


def _arrays(kinematics: Any) -> tuple[Array, ...]:
    """Return the fields of the kinematics for a kernel, all with the same number of lanes."""
    fields = jax.tree.leaves(kinematics)
    lanes = max(len(a) for a in fields)
    return tuple(jnp.broadcast_to(a, (lanes, *a.shape[1:])) for a in fields)


def dof_columns(tree: KinematicTree) -> tuple[np.ndarray, np.ndarray]:
    """Return the column of v that each full dof adds to, -1 for none, and the factor with which it does."""
    full = len(tree.dof_joint)
    columns, factors = np.full(full, -1), np.zeros(full)
    for index, coefficient in tree.dof_columns:
        for column in np.flatnonzero(coefficient):
            columns[index[column]], factors[index[column]] = column, coefficient[column]
    return columns, factors
