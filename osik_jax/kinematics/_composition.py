"""Composition of poses in parents' frames to poses in the world."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, reduce

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..execution._rules import custom_jvp
from ..numerics._host import Numbers, module_of
from ..robot._tree import KinematicTree
from ._rigid import compose, compose_poses, cross, rotate

Poses = tuple[Float[Numbers, "nbody 3"], Float[Numbers, "nbody 3 3"]]


def world_poses(
    tree: KinematicTree, position: Float[Numbers, "nbody 3"], rotation: Float[Numbers, "nbody 3 3"]
) -> Poses:
    """Return the poses of all bodies in the world from their poses relative to their parents.

    Row 0 is the world: 0 and the identity. Rotations must be exact.

    Each round composes every body with an ancestor twice as far above it, so a tree of depth d takes log2(d) rounds.
    The derivative sums velocities over each body's ancestors, by one product with a constant matrix. It costs the same
    in both modes and for any depth.
    """
    if module_of(position) is np:
        return reduce(_doubled, tree.doublings, (position, rotation))
    return _composer(tree)(position, rotation)


@lru_cache(maxsize=64)
def _composer(tree: KinematicTree) -> Callable[..., Poses]:
    """Return the composition for one tree, with its derivative rule."""

    @custom_jvp
    def poses(position: Array, rotation: Array) -> Poses:
        rounds = jnp.asarray(tree.doublings, np.int32)
        return jax.lax.platform_dependent(position, rotation, rounds, cpu=_in_a_loop, default=_one_by_one)

    @poses.defjvp
    def _(local: tuple[Array, Array], rates: tuple[Array, Array]) -> tuple[Poses, Poses]:
        (_, turned), (moves, turns) = local, rates
        position, rotation = poses(*local)
        frame = rotation[tree.parents]
        angular = rotate(frame, _axis(compose(turns, turned.mT)))
        at = jax.lax.stop_gradient(position[tree.reference_body])  # any point would do; one nearby loses no digits
        linear = rotate(frame, moves) - cross(angular, position - at)  # of what goes along, as it passes there
        below = jnp.asarray(tree.descendants.T, position.dtype)
        total = jnp.matmul(below, jnp.concatenate([linear, angular], -1), precision="highest")
        linear, angular = total[:, :3], total[:, 3:]
        velocity = linear + cross(angular, position - at)
        return (position, rotation), (velocity, cross(angular[:, None, :], rotation.mT).mT)

    return poses


def _in_a_loop(position: Array, rotation: Array, rounds: Array) -> Poses:
    """Return the composed poses by a small loop, which is one operation in XLA's CPU backend."""
    if not len(rounds):
        return position, rotation
    start = position, rotation
    return jax.lax.fori_loop(np.int32(0), np.int32(len(rounds)), lambda i, poses: _doubled(poses, rounds[i]), start)


def _one_by_one(position: Array, rotation: Array, rounds: Array) -> Poses:
    """Return the composed poses with the rounds unrolled, because a GPU launches each round of a loop."""
    poses = position, rotation
    for i in range(len(rounds)):
        poses = _doubled(jax.lax.optimization_barrier(poses), rounds[i])  # or XLA recomputes all rounds before
    return poses


def _doubled(poses: Poses, above: Numbers) -> Poses:
    """Return the poses of one round: each relative to an ancestor twice as far above."""
    position, rotation = poses
    return compose_poses((position[above], rotation[above]), poses)


def _axis(skew: Float[Array, "... 3 3"]) -> Float[Array, "... 3"]:
    """Return the vector of a skew-symmetric matrix."""
    rows = [skew[..., i, j] - skew[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))]
    return 0.5 * jnp.stack(rows, -1)
