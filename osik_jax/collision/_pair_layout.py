"""Distances of all pairs of shapes: grouped by kind, with one vectorised computation for each group."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._errors import OsikError, OsikValueError, warn
from ..kinematics import Kinematics
from ..kinematics._forward import independent_columns
from ..kinematics._rigid import compose_poses, cross
from ..robot import Robot
from ..robot._tree import KinematicTree, cached_arrays
from ._distance import Core, Nearest, between_polytopes, between_segments, from_plane
from ._geometry import Kind, UnitCore, convex_hull, padded, unit_core, world_cores
from ._pairs import Member
from ._shape import CollisionShape
from ._table import geom_hull

_ROUNDS = 4
"""Searches for the depth of an overlap of shapes whose edges are not all known."""


class Group(NamedTuple):
    """Pairs of one vectorised computation; ``first`` and ``second`` are indices of the scene's shapes."""

    first: tuple[int, ...]
    second: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class PairLayout:
    """Static structure: the shapes, and the pairs that are kept apart.

    Attributes:
        names: name of each shape.
        kinds: kind of each shape.
        bodies: index of the moving body that each shape is fixed to.
        geoms: index of the geom of each shape of the robot; these shapes come first.
        frames: index of the frame that each added shape is fixed to.
        hulls: index of each shape among the convex hulls; 0 if it is not a hull.
        groups: the pairs.
    """

    names: tuple[str, ...]
    kinds: tuple[Kind, ...]
    bodies: tuple[int, ...]
    geoms: tuple[int, ...]
    frames: tuple[int, ...]
    hulls: tuple[int, ...]
    groups: tuple[Group, ...]

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        """Return the hash, computed once because every call of a jitted function asks for it."""
        return hash(tuple(getattr(self, field.name) for field in dataclasses.fields(self)))

    @cached_arrays
    def pairs(self) -> np.ndarray:
        """Return the shapes of each pair, in the order of the distances. (pairs, 2), int."""
        return np.concatenate([np.array([group.first, group.second]).T for group in self.groups])

    @cached_arrays
    def pair_bodies(self) -> np.ndarray:
        """Return moving bodies of each pair. (pairs, 2), int."""
        return np.asarray(self.bodies, int)[self.pairs]

    @cached_property
    def pair_names(self) -> tuple[tuple[str, str], ...]:
        """Return the names of each pair's shapes."""
        return tuple((self.names[i], self.names[j]) for i, j in self.pairs)


_RANKS = {Kind.PLANE: 0, Kind.SEGMENT: 1, Kind.BOX: 2, Kind.CYLINDER: 2, Kind.ELLIPSOID: 3, Kind.HULL: 3}
"""Kinds of one rank share a computation, padded to the largest of them; of a pair the lower rank comes first."""


def grouped(kinds: Sequence[Kind], pairs: Sequence[tuple[int, int]]) -> tuple[Group, ...]:
    """Return the pairs grouped by their computation; there are few groups, because each is compiled separately."""
    found: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for pair in pairs:
        i, j = sorted(pair, key=lambda k: (_RANKS[kinds[k]], k))
        low, high = _RANKS[kinds[i]], _RANKS[kinds[j]]
        computation = (low, 0) if low == 0 else (0, high) if high == 3 else (low, high)
        found.setdefault(computation, []).append((i, j))
    return tuple(Group(*map(tuple, zip(*found[key], strict=True))) for key in sorted(found))


class Placed(eqx.Module):
    """Shapes in the world.

    Attributes:
        position: [m]. (k, 3)
        rotation: from each shape's axes to the world's. (k, 3, 3)
        size: MuJoCo's [m]. (k, 3)
    """

    position: Float[Array, "k 3"]
    rotation: Float[Array, "k 3 3"]
    size: Float[Array, "k 3"]


def place(scene: PairLayout, robot: Robot, kinematics: Kinematics, added: Placed) -> Placed:
    """Return the scene's shapes in the world; ``added`` has the poses of the added shapes, each in its frame."""
    own, frames = np.asarray(scene.geoms, int), np.asarray(scene.frames, int)
    robots = Placed(robot.geom_position[own], robot.geom_rotation[own], robot.geom_size[own])
    in_frames = robot.frame_position[frames], robot.frame_rotation[frames]
    others = Placed(*compose_poses(in_frames, (added.position, added.rotation)), added.size)
    local = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), robots, others)
    bodies = np.asarray(scene.bodies, int)
    placed = kinematics.body_position[bodies], kinematics.body_rotation[bodies]
    return Placed(*compose_poses(placed, (local.position, local.rotation)), local.size)


def nearest(scene: PairLayout, placed: Placed, hulls: UnitCore | None) -> Nearest:
    """Return distances, points and normals of all pairs, with a leading axis; the first shape of a pair is ``a``."""
    parts = [_of_group(scene, group, placed, hulls) for group in scene.groups]
    return jax.tree.map(lambda *a: jnp.concatenate(a), *parts)


def _of_group(scene: PairLayout, group: Group, placed: Placed, hulls: UnitCore | None) -> Nearest:
    second = _cores(scene, group.second, placed, hulls)
    if scene.kinds[group.first[0]] is Kind.PLANE:
        planes = np.asarray(group.first, int)
        return jax.vmap(from_plane)(placed.position[planes], placed.rotation[planes, :, 2], second)
    first = _cores(scene, group.first, placed, hulls)
    if scene.kinds[group.second[0]] is Kind.SEGMENT:
        return jax.vmap(between_segments)(first, second)
    complete = first.edges.shape[1] and second.edges.shape[1]
    return jax.vmap(lambda a, b: between_polytopes(a, b, rounds=1 if complete else _ROUNDS))(first, second)


def _cores(scene: PairLayout, ids: tuple[int, ...], placed: Placed, hulls: UnitCore | None) -> Core:
    """Return the cores of some shapes, padded to one size and stacked."""
    index, kinds = np.asarray(ids, int), [scene.kinds[k] for k in ids]
    units = [unit_core(kind) for kind in dict.fromkeys(kinds) if kind is not Kind.HULL]
    start = {kind: k for k, kind in enumerate(kind for kind in dict.fromkeys(kinds) if kind is not Kind.HULL)}
    if hulls is not None and Kind.HULL in kinds:
        units += [UnitCore(*(rows[k] for rows in hulls)) for k in range(len(hulls.vertices))]
    table = padded(units)
    rows = [start.get(scene.kinds[k], len(start) + scene.hulls[k]) for k in ids]
    unit = UnitCore(*(column[np.array(rows)] for column in table))
    return world_cores(kinds, unit, placed.size[index], placed.position[index], placed.rotation[index])


def separation_jacobian(
    tree: KinematicTree, kinematics: Kinematics, near: Nearest, bodies: Int[np.ndarray, "k 2"] | Int[Array, "k 2"]
) -> Float[Array, "k nv"]:
    """Return J with ``d distance / dt = J v`` for pairs whose shapes are fixed to bodies: ``normal' (J_b - J_a)``.

    A point's velocity along the normal is the dof's at the robot's root, and its turning times the arm from there.
    """
    root = kinematics.body_position[tree.reference_body]
    at_root = kinematics.dof_linear + cross(kinematics.dof_anchor - root, kinematics.dof_angular)
    straight = jnp.matmul(near.normal, at_root.T, precision="highest")

    def along(points: Float[Array, "k 3"], moves: Bool[np.ndarray, "k n"] | Bool[Array, "k n"]) -> Float[Array, "k n"]:
        turned = jnp.matmul(cross(points - root, near.normal), kinematics.dof_angular.T, precision="highest")
        return jnp.where(moves, straight + turned, 0.0)

    moves = tree.moves if isinstance(bodies, np.ndarray) else jnp.asarray(tree.moves)
    rate = along(near.point_b, moves[bodies[:, 1]]) - along(near.point_a, moves[bodies[:, 0]])
    return independent_columns(tree, rate)


Hulls = dict[int, UnitCore]
"""Convex hulls of shapes, by the number of the member."""


def read_hulls(
    robot: Robot, scene: Sequence[Member], shapes: Mapping[str, CollisionShape], pairs: Sequence[tuple[int, int]]
) -> tuple[Hulls, list[tuple[int, int]]]:
    """Return the hulls of the members of these pairs, and the pairs without members whose file cannot be read.

    Raises:
        ValueError: no pair is left.

    Warns:
        OsikWarning: collision meshes that cannot be read take no part.
    """
    hulls: Hulls = {}
    lost: dict[int, str] = {}
    for k in sorted({k for pair in pairs for k in pair if scene[k].kind is Kind.HULL}):
        try:
            own = shapes[scene[k].name].hull if scene[k].added else None
            hulls[k] = convex_hull(geom_hull(robot, k)) if own is None else own
        except (OSError, OsikError) as error:
            lost[k] = f"{scene[k].label}: {error}"
    kept = [pair for pair in pairs if not lost.keys() & set(pair)]
    if lost and not kept:
        raise OsikValueError(f"no collision mesh of the robot can be read: {'; '.join(lost.values())}")
    if lost:
        warn(
            f"{len(lost)} collision meshes cannot be read, so nothing keeps away from them: "
            f"{'; '.join(lost.values())}. Name folders of packages in package_dirs, or add shapes for these links"
        )
    return hulls, kept
