"""Kinematics of a few frames for many configurations at once; the last axis of every array is that of lanes.

A search evaluates hundreds of configurations a target. With the lanes last, every operation is one pass over contiguous
numbers, on a CPU and on a GPU. Of the robot, only the joints that carry one of the frames take part.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..execution._platform import cuda_is_default
from ..kinematics._rigid import compose, cross, rotate, rotation_matrix
from ..robot import Robot
from ..robot._tree import HINGE, SLIDE, KinematicTree

# below this the limit 1/12 is exact to 1e-9: the next term of the series is angle^2 / 720
_SMALL_ANGLE_SQUARED = 1e-6


class Layout(NamedTuple):
    """Joints of the chain and their structure; hashable."""

    joints: tuple[int, ...]  # the robot's joints, parents first
    parents: tuple[int, ...]  # index in ``joints`` of the joint before each, one past the last for the world
    hinges: tuple[bool, ...]  # whether each joint turns; the others slide
    entries: tuple[int, ...]  # entry of q that moves each joint, -1 for a locked one
    factors: tuple[float, ...]  # of that entry
    dofs: tuple[int, ...]  # entries of q that move any of the frames, in order: the coordinates of the search
    ends: tuple[int, ...]  # index in ``joints`` of the joint that carries each frame, one past the last for the world
    carries: tuple[tuple[bool, ...], ...]  # whether each joint carries each frame


class Chain(eqx.Module):
    """Geometry of the part of a robot on which the frames depend.

    The pose of a joint's far side in its near side is ``constant + f(angle) first + g(angle) second``, with sine and
    versine of a hinge's angle, or the travel of a slide and 0.
    """

    layout: Layout = eqx.field(static=True)
    constant: Float[Array, "k 3 4"]  # [rotation, position] of each joint, from the frame before; likewise the next two
    first: Float[Array, "k 3 4"]
    second: Float[Array, "k 3 4"]
    offset: Float[Array, " k"]  # added to each joint's coordinate
    axis: Float[Array, "k 3"]  # of each joint, in its own frame
    anchor: Float[Array, "k 3"]  # of each joint, in its own frame [m]
    tip: Float[Array, "frames 3 4"]  # pose of each frame in that of the joint that carries it


def is_plain(tree: KinematicTree, frames: Sequence[str]) -> bool:
    """Return whether only hinges and slides carry the frames, so that a ``Chain`` can be made."""
    joints = {joint for name in frames for joint in _carrying(tree, name)}
    return bool(joints) and all(tree.joint_types[j] in (HINGE, SLIDE) for j in joints)


def _carrying(tree: KinematicTree, frame: str) -> list[int]:
    """Return the joints between the world and a frame, from the world on."""
    body, path = tree.frame_bodies[tree.frame(frame)], []
    while body:
        path.append(body)
        body = tree.body_parents[body]
    return [j for body in reversed(path) for j, owner in enumerate(tree.joint_bodies) if owner == body]


@lru_cache
def chain_layout(tree: KinematicTree, frames: Sequence[str]) -> Layout:
    """Return the structure of the chain to some frames, of which ``is_plain`` holds."""
    paths = [_carrying(tree, name) for name in frames]
    joints = sorted({joint for path in paths for joint in path})
    index_of = {joint: at for at, joint in enumerate(joints)}
    before = {joint: path[at - 1] if at else -1 for path in paths for at, joint in enumerate(path)}
    index, factor = tree.qpos_source
    starts = tree.full_qpos_address
    entries = [int(index[starts[j]]) if factor[starts[j]] else -1 for j in joints]
    return Layout(
        joints=tuple(joints),
        parents=tuple(index_of.get(before[j], len(joints)) for j in joints),
        hinges=tuple(tree.joint_types[j] == HINGE for j in joints),
        entries=tuple(entries),
        factors=tuple(float(factor[starts[j]]) for j in joints),
        dofs=tuple(sorted({entry for entry in entries if entry >= 0})),
        ends=tuple(index_of[path[-1]] if path else len(joints) for path in paths),
        carries=tuple(tuple(j in path for j in joints) for path in paths),
    )


def make_chain(robot: Robot, frames: Sequence[str], layout: Layout) -> Chain:
    """Return the geometry of the chain to some frames; differentiable in the robot's numbers."""
    tree, joints = robot.tree, np.array(layout.joints, int)
    bodies = np.asarray(tree.joint_bodies, int)[joints]
    first_of_body = np.array([tree.joint_bodies.index(int(body)) == j for j, body in zip(joints, bodies, strict=True)])
    position, turn = _before_joints(robot, bodies, first_of_body)
    axis = robot.joint_axis[joints]
    axis = axis / jnp.sqrt(jnp.sum(axis**2, -1, keepdims=True))
    anchor = robot.joint_position[joints]
    constant, first, second = _motions(position, turn, axis, anchor, np.array(layout.hinges))
    address = tree.full_qpos_address[:-1][joints]
    ids = np.array([tree.frame(name) for name in frames], int)
    return Chain(
        layout=layout,
        constant=constant,
        first=first,
        second=second,
        offset=robot.qpos_offset[address] - robot.joint_reference[address],
        axis=axis,
        anchor=anchor,
        tip=jnp.concatenate([robot.frame_rotation[ids], robot.frame_position[ids][..., None]], -1),
    )


def _before_joints(
    robot: Robot, bodies: np.ndarray, first_of_body: np.ndarray
) -> tuple[Float[Array, "k 3"], Float[Array, "k 3 3"]]:
    """Return, for each joint, its body's fixed pose relative to the preceding joint's far side.

    Bodies that are fixed to others are one body with them, so that there is a joint on each body of a path.
    """
    turn = rotation_matrix(robot.body_quaternion[bodies])
    return (
        jnp.where(first_of_body[:, None], robot.body_position[bodies], 0.0),
        jnp.where(first_of_body[:, None, None], turn, np.eye(3, dtype=turn.dtype)),
    )


def _motions(
    position: Float[Array, "k 3"],
    turn: Float[Array, "k 3 3"],
    axis: Float[Array, "k 3"],
    anchor: Float[Array, "k 3"],
    hinges: np.ndarray,
) -> tuple[Array, Array, Array]:
    """Return Rodrigues' formula as three matrices per joint: ``R = I + sin K + (1 - cos) K^2``, about the anchor."""
    zero = jnp.zeros_like(axis[:, 0])
    x, y, z = axis.T
    skew = jnp.stack([jnp.stack([zero, -z, y], -1), jnp.stack([z, zero, -x], -1), jnp.stack([-y, x, zero], -1)], -2)
    sine, versine = compose(turn, skew), compose(turn, compose(skew, skew))
    slide = rotate(turn, axis)
    hinge = hinges[:, None]
    constant = jnp.concatenate([turn, position[..., None]], -1)
    moved = jnp.where(hinge, -rotate(sine, anchor), slide)
    first = jnp.concatenate([jnp.where(hinge[..., None], sine, 0.0), moved[..., None]], -1)
    again = jnp.where(hinge, -rotate(versine, anchor), 0.0)
    second = jnp.concatenate([jnp.where(hinge[..., None], versine, 0.0), again[..., None]], -1)
    return constant, first, second


class ChainKinematics(NamedTuple):
    """Axes of the joints and poses of the frames, in world axes."""

    axis: Float[Array, "k 3 lanes"]  # of each joint
    anchor: Float[Array, "k 3 lanes"]  # a point on it [m]
    position: Float[Array, "frames 3 lanes"]  # of each frame [m]
    rotation: Float[Array, "frames 3 3 lanes"]  # of each frame


def chain_kinematics(chain: Chain, x: Float[Array, "n lanes"], *, unrolled: bool = False) -> ChainKinematics:
    """Return forward kinematics of the chain at entries ``layout.dofs`` of configurations.

    ``unrolled``: whether the joints are no loop of the program, for derivatives in reverse.
    """
    layout = chain.layout
    local = _local_poses(chain, x)
    poses = _world_poses(layout, local, unrolled)
    turned = _times(poses[:-1, :, :3], chain.axis[:, :, None, None])[:, :, 0]
    anchor = _times(poses[:-1, :, :3], chain.anchor[:, :, None, None])[:, :, 0] + poses[:-1, :, 3]
    ends = poses[np.array(layout.ends)]
    tips = _times(ends[:, :, :3], chain.tip[..., None])
    return ChainKinematics(turned, anchor, tips[:, :, 3] + ends[:, :, 3], tips[:, :, :3])


def _local_poses(chain: Chain, x: Float[Array, "n lanes"]) -> Float[Array, "k 3 4 lanes"]:
    layout = chain.layout
    coordinate = np.array([layout.dofs.index(entry) if entry >= 0 else 0 for entry in layout.entries])
    factor = np.array(layout.factors)
    angle = x[coordinate] * jnp.asarray(factor, x.dtype)[:, None] + chain.offset[:, None]
    hinge = np.array(layout.hinges)[:, None]
    half = jnp.sin(0.5 * angle)
    first, second = jnp.where(hinge, jnp.sin(angle), angle), jnp.where(hinge, 2.0 * half**2, 0.0)
    # A library call, or XLA's CPU backend computes each sine again for every entry of the matrices that it is in.
    parts = jnp.stack([chain.constant, chain.first, chain.second], -1).reshape(-1, 12, 3)
    coefficients = jnp.stack([jnp.ones_like(first), first, second], 1)
    return jnp.matmul(parts, coefficients, precision="highest").reshape(-1, 3, 4, x.shape[-1])


def _world_poses(layout: Layout, local: Float[Array, "k 3 4 lanes"], unrolled: bool) -> Float[Array, "k_1 3 4 lanes"]:
    """Return the pose of each joint's far side in the world, then the world's own."""
    world = jnp.concatenate([jnp.eye(3, dtype=local.dtype), jnp.zeros((3, 1), local.dtype)], -1)
    world = jnp.broadcast_to(world[..., None], local.shape[1:])
    if unrolled:
        each: list[Array] = []
        for own, parent in zip(local, layout.parents, strict=True):
            each.append(_joined(each[parent] if parent < len(layout.joints) else world, own))
        return jnp.stack([*each, world])
    # a serial chain carries one pose; a tree has to index the poses of its parents, which is slower
    serial = layout.parents == (len(layout.joints), *range(len(layout.joints) - 1))
    if serial:

        def along(pose: Array, own: Array) -> tuple[Array, Array]:
            pose = _joined(pose, own)
            return pose, pose

        # on a GPU each operation of a loop is launched anew
        _, poses = jax.lax.scan(along, world, local, unroll=cuda_is_default())
        return jnp.concatenate([poses, world[None]])

    def after(poses: Array, step: tuple[Array, Array, Array]) -> tuple[Array, None]:
        at, parent, own = step
        before = jax.lax.dynamic_index_in_dim(poses, parent, 0, keepdims=False)
        return jax.lax.dynamic_update_index_in_dim(poses, _joined(before, own), at, 0), None

    poses = jnp.concatenate([jnp.zeros_like(local), world[None]])
    order = jnp.arange(len(layout.joints)), jnp.asarray(layout.parents)
    return jax.lax.scan(after, poses, (*order, local))[0]


def _joined(pose: Float[Array, "3 4 lanes"], own: Float[Array, "3 4 lanes"]) -> Float[Array, "3 4 lanes"]:
    moved = _times(pose[:, :3], own)
    return jnp.concatenate([moved[:, :3], (moved[:, 3] + pose[:, 3])[:, None]], 1)


def _times(a: Float[Array, "*k m 3 lanes"], b: Float[Array, "*k 3 n lanes"]) -> Float[Array, "*k m n lanes"]:
    """Return the matrix product of each lane, as three products of arrays."""
    first, second, third = (a[..., :, i, None, :] * b[..., i, None, :, :] for i in range(3))
    return first + second + third


def jacobian(chain: Chain, kinematics: ChainKinematics) -> Float[Array, "frames 6 n lanes"]:
    """Return each frame's Jacobian over the chain's coordinates: rows [linear; angular], world axes, at its origin."""
    own, layout = _joint_columns(chain, kinematics), chain.layout
    return jnp.stack([_column(layout, own, dof) for dof in layout.dofs], 2)


def _joint_columns(chain: Chain, kinematics: ChainKinematics) -> Float[Array, "frames k 6 lanes"]:
    """Return the Jacobian columns of ``_body_columns``, over the chain's joints."""
    layout = chain.layout
    hinge = np.array(layout.hinges)[:, None, None]
    columns = []
    for at, carried in enumerate(layout.carries):
        arm = kinematics.position[at] - kinematics.anchor
        linear = jnp.where(hinge, cross(kinematics.axis, arm, along=-2), kinematics.axis)
        both = jnp.concatenate([linear, jnp.where(hinge, kinematics.axis, 0.0)], 1)
        columns.append(jnp.where(np.array(carried)[:, None, None], both, 0.0))
    return jnp.stack(columns)


def curvature(
    chain: Chain,
    kinematics: ChainKinematics,
    linear: Float[Array, "frames 3 lanes"],
    angular: Float[Array, "frames 3 lanes"],
    radian: Float[Array, ""],
) -> Float[Array, "n n lanes"]:
    """Return the Hessian of half the squared errors less J'J, with J as in ``jacobian``.

    Where joint a comes before joint b, ``d^2 p / da db = w_a x (dp / db)``, w_a being the axis of a hinge and 0 for a
    slide. The derivative of the angular error is ``I - K / 2 + c K^2`` times the angular velocity, K being its cross
    matrix and ``c = (1 - (t / 2) cot(t / 2)) / t^2`` for an angle t.

    Args:
        linear: position error of each frame [m].
        angular: orientation error of each frame, axis times angle [rad]; 0 where the orientation is free.
        radian: what a radian of it counts as [m].
    """
    first = np.triu(np.ones((len(chain.layout.joints),) * 2, bool))[..., None]
    parts = []
    for at, own in enumerate(_joint_columns(chain, kinematics)):
        turn = own[:, 3:]
        lever = cross(own[:, :3], linear[at][None], along=-2)
        lever = lever + 0.5 * radian**2 * cross(turn, angular[at][None], along=-2)
        pairs = jnp.sum(turn[:, None] * lever[None], 2)
        aside = cross(turn, angular[at][None], along=-2)
        squares = radian**2 * _log_curvature(angular[at]) * jnp.sum(aside[:, None] * aside[None], 2)
        parts.append(jnp.where(first, pairs, jnp.swapaxes(pairs, 0, 1)) - squares)
    moved = jnp.asarray(_entry_factors(chain.layout), linear.dtype)
    return jnp.einsum("ai,ijl,bj->abl", moved, sum(parts[1:], parts[0]), moved, precision="highest")


def _log_curvature(angular: Float[Array, "3 lanes"]) -> Float[Array, " lanes"]:
    squared = jnp.sum(angular**2, 0)
    small = squared < _SMALL_ANGLE_SQUARED
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))
    # the inner where keeps tan and the quotient finite, so that gradients at angle 0 are too
    return jnp.where(small, 1.0 / 12.0, (1.0 - 0.5 * angle / jnp.tan(0.5 * angle)) / angle**2)


def _entry_factors(layout: Layout) -> Float[np.ndarray, "n k"]:
    """Return the factor by which each coordinate moves each joint."""
    out = np.zeros((len(layout.dofs), len(layout.joints)))
    for at, entry in enumerate(layout.entries):
        if entry >= 0:
            out[layout.dofs.index(entry), at] = layout.factors[at]
    return out


def _column(layout: Layout, own: Float[Array, "frames k 6 lanes"], dof: int) -> Float[Array, "frames 6 lanes"]:
    """Return the Jacobian column of one coordinate: the sum over its joint and the joints that follow it."""
    moved = [at for at, entry in enumerate(layout.entries) if entry == dof]
    parts = [own[:, at] if layout.factors[at] == 1.0 else own[:, at] * layout.factors[at] for at in moved]
    return sum(parts[1:], parts[0])
