"""Size of a robot: the length of its longest chain of links."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics._host import is_traced, module_of
from ._model import RobotModel
from ._tree import KinematicTree


def robot_size(robot: RobotModel) -> Float[Array, ""] | float:
    """Return the longest way along the links between two points of a robot [m]: joints, and origins of frames.

    For an arm it is its reach, stretched. Links that no joint moves do not count. Works on traced robots, too.
    """
    tree = robot.tree
    names = ("body_position", "body_quaternion", "joint_position", "frame_position")
    leaves = [getattr(robot, name) for name in names]
    xp: Any = jnp if is_traced(leaves) else np
    position, quaternion, anchors, frames = map(xp.asarray, leaves)
    bodies = list(tree.joint_bodies)
    first = np.array([bodies.index(body) if body in bodies else -1 for body in range(len(tree.body_names))])
    anchor = xp.where((first >= 0)[:, None], anchors[np.maximum(first, 0)], 0.0) if bodies else 0.0 * position
    parents, carriers = np.array(tree.body_parents), np.array(tree.frame_bodies, int)
    links = _length(position + _rotated(xp, quaternion, anchor) - anchor[parents])
    size = _longest_way(tree, links, _length(frames - anchor[carriers]), xp.maximum)
    return float(size) if xp is np else size


def _longest_way(tree: KinematicTree, links: Any, tips: Any, larger: Any) -> Any:
    """Return the longest way between two leaves of the tree, from the lengths of its links and tips."""
    parents, moves = tree.body_parents, np.any(tree.moves, 1)
    below: list[Any] = [0.0] * len(parents)  # from a body's joint to the farthest point below it
    for frame, body in enumerate(tree.frame_bodies):
        below[body] = larger(below[body], tips[frame])
    longest: Any = 0.0
    for body in range(len(parents) - 1, 0, -1):
        longest = larger(longest, below[body]) if moves[body] else longest
        parent = parents[body]
        if moves[parent]:
            way = links[body] + below[body]
            longest, below[parent] = larger(longest, way + below[parent]), larger(below[parent], way)
    return longest


def _rotated(xp: Any, quaternion: Any, vector: Any) -> Any:
    """Return vectors (n, 3) turned by quaternions w x y z (n, 4)."""
    real, axis = quaternion[:, :1], quaternion[:, 1:]
    twice = 2.0 * xp.cross(axis, vector)
    return vector + real * twice + xp.cross(axis, twice)


def _length(vectors: Any) -> Any:
    """Return the lengths of vectors (n, 3); at 0 the derivative is 0."""
    xp, squared = module_of(vectors), (vectors**2).sum(-1)
    return xp.where(squared > 0.0, xp.sqrt(xp.where(squared > 0.0, squared, 1.0)), 0.0)
