"""Arrays of a robot's shapes and of a scene in the order in which ``core/shapes.hpp`` reads them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int

from .._errors import OsikError, OsikValueError
from ..core import _cuda, _library
from ..execution._backends import core_is_here
from ..execution._platform import cuda_is_default
from ..kinematics._kernels import dof_columns, tree_integers
from ..numerics._host import is_traced
from ..numerics._remembered import remembered
from ..robot import Robot
from ..robot._tree import KinematicTree
from ._scene import Scene
from ._table import RobotShapes, ShapeKind, ShapeTable, bounding_ball, table_shapes

_SPREAD = 32
"""Vertices of a hull in all directions, from which the core begins to look for the farthest one."""
_SPACES = {"are_free": "clearances", "near_geometry": "near_rows"}
"""Methods that take the workspace of another."""
_PACK = 4
"""Hulls have a multiple of so many vertices in the core: the last one is repeated."""


class CoreScene(NamedTuple):
    """A scene for the core, with an axis of scenes in front, of length 1 where all targets share one.

    Attributes:
        integers: number of rows; kind, first vertex, number of vertices and carrying body of each; whether it may touch
            each shape of the robot, and each other row. (scenes, 1 + k (4 + shapes + k))
        numbers: size, position and rotation of each row, then the vertices. (scenes, 15 k + 3 v)
    """

    integers: Int[Array, "scenes n"] | np.ndarray
    numbers: Float[Array, "scenes m"] | np.ndarray

    def rows(self, shapes: int) -> int:
        """Return the number of rows, beside a robot with so many shapes."""
        others, length = 4 + shapes, self.integers.shape[-1] - 1
        return (math.isqrt(others**2 + 4 * length) - others) // 2


class CoreRobot(eqx.Module):
    """A robot and its shapes for the core.

    Attributes:
        integers: (n,)
        numbers: (m,)
        sizes: numbers of bodies, dofs and shapes (static).
    """

    integers: Int[Array, "*one n"] | np.ndarray
    numbers: Float[Array, "*one m"] | np.ndarray
    sizes: tuple[int, int, int] = eqx.field(static=True)


def require_core(what: str, *, on_gpu: bool = False) -> None:
    """Raise an error where the compiled core is missing, or does not run on JAX's default device.

    Args:
        what: needs it.
        on_gpu: whether it runs on a GPU too.
    """
    if core_is_here() and (on_gpu or not cuda_is_default()):
        return
    if _library.core().library is None:
        raise OsikError(f"{what} needs the compiled core: {_library.core().reason}")
    if on_gpu and cuda_is_default():
        raise OsikError(f"{what} needs NVRTC, which comes with jax[cuda12] or jax[cuda13], and a GPU of 2020 or newer")
    raise OsikError(f"{what} runs on a CPU: call it under jax.default_device(jax.devices('cpu')[0])")


def call_here(
    method: str, shapes: _library.Shapes, *given: Any, sizes: tuple[int, ...], members: int = 1
) -> list[Array]:
    """Call a method of the core on JAX's default device: ``_library.call``, or ``_cuda.call_lanes`` with ``members``.

    Args:
        method: its name.
        shapes: of the results.
        given: arrays.
        sizes: what ``core/_cuda.py: space_of_lane`` takes.
        members: threads of a lane on a GPU.
    """
    space = _cuda.space_of_lane(_SPACES.get(method, method), *sizes)
    if not cuda_is_default():
        return _library.call(method, shapes, *given, space=space)
    return _cuda.call_lanes(method, shapes, *given, space=space, members=members)


@remembered
def core_robot(
    robot: Robot, shapes: RobotShapes, *, entries: tuple[int, ...] | None = None, posed: tuple[str | None, ...] = ()
) -> CoreRobot:
    """Return the arrays of a robot whose numbers are known.

    Args:
        robot: the robot.
        shapes: its shapes.
        entries: entries of q that a search moves; default: all.
        posed: frames of a search; None for one whose pose is free in some rows.
    """
    tree, table = robot.tree, shapes.table
    first, vertices = _packed_vertices(table)
    count = np.where(first >= 0, -(-np.asarray(table.count) // _PACK) * _PACK, 0)
    moves, groups = _moves(tree, range(tree.nq) if entries is None else entries, posed)
    index, factor = tree.qpos_source
    sizes = [len(tree.body_parents), len(tree.joint_types), len(tree.dof_joint), len(index)]
    sizes += [len(shapes.names), len(shapes.pairs), len(vertices) // 3, tree.nv]
    columns, column_factors = dof_columns(tree)
    integers = [
        sizes,
        tree_integers(tree)[1:],
        moves,
        groups,
        table.kind,
        shapes.bodies,
        np.maximum(first, 0),
        count,
        shapes.world,
        shapes.pairs,
        columns,
        *_neighbours(first, count, vertices),
    ]
    centers, bounds = zip(*map(bounding_ball, table_shapes(table)), strict=True)
    numbers = [factor, robot.qpos_offset, robot.joint_reference, robot.body_position, robot.body_quaternion]
    numbers += [
        robot.joint_position,
        robot.joint_axis,
        table.size,
        table.position,
        table.rotation,
        centers,
        bounds,
        vertices,
        column_factors,
    ]
    with jax.ensure_compile_time_eval():  # on the device once, also if a user's program is traced
        arrays = jnp.asarray(_flat(integers, np.int32)), jnp.asarray(_flat(numbers, np.float64))
        return CoreRobot(*arrays, (sizes[0], sizes[2], sizes[4]))


def _flat(parts: Sequence[Any], kind: Any) -> np.ndarray:
    return np.concatenate([np.asarray(part).ravel() for part in parts]).astype(kind)


def _packed_vertices(table: ShapeTable) -> tuple[np.ndarray, np.ndarray]:
    """Return the first vertex of each hull (-1: no hull), and all vertices: x of a hull, then y, then z."""
    first, parts, end = np.full(len(table.kind), -1), [np.zeros(0)], 0
    for k in np.flatnonzero(np.asarray(table.kind) == ShapeKind.HULL):
        start, count = int(table.first[k]), int(table.count[k])
        own = spread_first(np.asarray(table.vertices[start : start + count]))
        own = np.concatenate([own, own[-1:].repeat(-count % _PACK, 0)])
        first[k], end = end, end + len(own)
        parts.append(own.T.ravel())
    return first, np.concatenate(parts)


def spread_first(vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    """Return the vertices of a hull, those first that are the farthest in directions all around."""
    if len(vertices) <= _SPREAD:
        return vertices
    height = np.linspace(-1.0, 1.0, 2 * _SPREAD + 1)[1::2]  # a spiral of Fibonacci
    around, across = np.pi * (3.0 - 5.0**0.5) * np.arange(_SPREAD), np.sqrt(1.0 - height**2)
    ways = np.stack([across * np.cos(around), across * np.sin(around), height])
    order = dict.fromkeys([*np.argmax(vertices @ ways, 0).tolist(), *range(len(vertices))])
    return vertices[list(order)]


def _neighbours(first: Any, count: Any, packed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the neighbours of each vertex begin, and the neighbours: numbers of vertices in the hull.

    Small hulls have none, nor those whose vertices are not all corners within rounding.
    """
    total = len(packed) // 3
    lists: list[np.ndarray] = [np.zeros(0, int)] * total
    for start, number in zip(first, count, strict=True):
        if number <= 2 * _SPREAD:
            continue
        own = packed[3 * start : 3 * (start + number)].reshape(3, -1).T
        hull = scipy.spatial.ConvexHull(own[: len(np.unique(own, axis=0))])
        edges = np.unique(np.sort(hull.simplices[:, [[0, 1], [0, 2], [1, 2]]].reshape(-1, 2), 1), axis=0)
        both = np.concatenate([edges, edges[:, ::-1]])
        if len(np.unique(both[:, 0])) == len(hull.points):
            ends = np.cumsum(np.bincount(both[:, 0]))
            lists[start : start + len(ends)] = np.split(both[np.argsort(both[:, 0], kind="stable"), 1], ends[:-1])
    starts = np.concatenate([[0], np.cumsum([len(own) for own in lists])])
    return starts, np.concatenate([np.zeros(0, int), *lists])


def _moves(tree: KinematicTree, entries: Sequence[int], posed: Sequence[str | None]) -> tuple[np.ndarray, np.ndarray]:
    """Return for each body 0 if no search moves it, 2 + f if it goes along with posed frame f, else 1; and its group.

    No search moves bodies of one group relative to each other; group 0 stands still.
    """
    (index, factor), starts = tree.qpos_source, tree.full_qpos_address
    own = np.zeros(len(tree.body_parents), bool)
    for joint, body in enumerate(tree.joint_bodies):
        own[body] |= bool(factor[starts[joint]]) and int(index[starts[joint]]) in entries
    groups = np.zeros(len(own), int)
    for body in range(1, len(own)):
        groups[body] = body if own[body] else groups[tree.body_parents[body]]
    moves = np.minimum(groups, 1)
    for f, name in enumerate(posed):
        if name is None:
            continue
        carried = {tree.frame_bodies[tree.frame(name)]}
        for body in range(1, len(own)):
            if not own[body] and tree.body_parents[body] in carried:
                carried.add(body)
        moves[[body for body in carried if moves[body]]] = 2 + f
    return moves, groups


@remembered
def core_scene(scene: Scene, shapes: RobotShapes) -> CoreScene:
    """Return the arrays of a scene, by NumPy unless traced."""
    numbers = jnp if is_traced(scene) else np
    table, lead = scene.table, scene.table.kind.shape[:-1]
    rows = np.full((*lead, 1), scene.capacity, np.int32)
    integers = rows, table.kind, table.first, table.count, scene.body, scene.contacts(shapes), scene.among
    floats = table.size, table.position, table.rotation, table.vertices

    def together(arrays: Sequence[Any], kind: Any) -> Any:
        flat = [numbers.asarray(a).reshape(*(lead or (1,)), -1) for a in arrays]
        return numbers.concatenate([a.astype(kind) for a in flat], -1)

    return CoreScene(together(integers, np.int32), together(floats, table.size.dtype))


def check_length(scene: CoreScene, targets: int, what: str) -> None:
    """Raise an error unless there is one scene, or one for each target."""
    if len(scene.integers) not in (1, targets):
        raise OsikValueError(
            f"there are {len(scene.integers)} scenes and {targets} {what}; give one scene, or one for each of them"
        )


class Gaps(NamedTuple):
    """Nearest pairs of shapes.

    Attributes:
        distance: signed distance [m]. (lanes,)
        points: nearest points of the two surfaces, world axes [m]. (lanes, 2, 3)
        normal: unit vector from the first to the second. (lanes, 3)
        pair: numbers of the two shapes; those of the robot come first, then the scene's; -1: there is no pair.
            (lanes, 2)
    """

    distance: Float[Array, " lanes"]
    points: Float[Array, "lanes 2 3"]
    normal: Float[Array, "lanes 3"]
    pair: Int[Array, "lanes 2"]


def gaps_at(robot: CoreRobot, q: Float[Array, "lanes nq"], scene: CoreScene) -> Gaps:
    """Return the nearest pair at each configuration."""
    return read_gaps(*nearest_pairs(robot, q, scene))


def nearest_pairs(robot: CoreRobot, q: Float[Array, "lanes nq"], scene: CoreScene) -> list[Array]:
    """Return distance, points and normal (lanes, 10) and the pair (lanes, 2), as the core writes them."""
    lanes = max(map(len, (q, *scene)))
    return _call_at("clearances", [((lanes, 10), float), ((lanes, 2), int)], robot, q, scene)


def read_gaps(numbers: Float[Array, "lanes 10"], pair: Int[Array, "lanes 2"]) -> Gaps:
    """Return gaps from distance, points and normal of each."""
    return Gaps(numbers[:, 0], numbers[:, 1:7].reshape(-1, 2, 3), numbers[:, 7:], pair)


def are_free(
    robot: CoreRobot, q: Float[Array, "lanes nq"], scene: CoreScene, clearance: Float[Array, " 1"]
) -> Bool[Array, " lanes"]:
    """Return whether all pairs keep a distance at each configuration."""
    lanes = max(map(len, (q, *scene, clearance)))
    return _call_at("are_free", [((lanes, 1), int)], robot, q, scene, clearance)[0][:, 0] > 0


def _call_at(
    method: str, shapes: _library.Shapes, robot: CoreRobot, q: Float[Array, "lanes nq"], scene: CoreScene, *more: Any
) -> list[Array]:
    sizes = *robot.sizes, scene.rows(robot.sizes[2])
    own = (a.reshape(1, -1) for a in (robot.integers, robot.numbers))
    return call_here(method, shapes, q, *own, *scene, *more, sizes=sizes)


def gaps_between(first: ShapeTable, second: ShapeTable) -> Gaps:
    """Return the gap of each row of one table to the same row of the other; the pair's numbers are the rows."""
    tables, starts, vertices = (first, second), [], [np.zeros(0)]
    for table in tables:
        start, own = _packed_vertices(table)
        starts.append(np.where(start >= 0, start + sum(map(len, vertices)) // 3, 0))
        vertices.append(own)
    counts = [-(-np.asarray(t.count) // _PACK) * _PACK for t in tables]
    integers = np.stack([np.stack([t.kind, s, c], 1) for t, s, c in zip(tables, starts, counts, strict=True)], 1)
    numbers = np.stack([np.concatenate([t.size, t.position, np.reshape(t.rotation, (-1, 9))], 1) for t in tables], 1)
    out = _library.call("shape_gaps", [((len(integers), 10), float)], *(integers, numbers, np.concatenate(vertices)))[0]
    pair = jnp.arange(len(integers))[:, None].repeat(2, 1)
    return read_gaps(out, pair)


class Ways(NamedTuple):
    """Ways around obstacles; see ``core/way_around.hpp``.

    Attributes:
        vertices: of the lines; the first ones count. (lanes, longest, n)
        radii: length of each line that the round corner at a vertex takes. (lanes, longest)
        labels: status, number of the goal, number of vertices, states that were tried, and the two shapes that touch.
            (lanes, 6)
    """

    vertices: Float[Array, "lanes longest n"]
    radii: Float[Array, "lanes longest"]
    labels: Int[Array, "lanes 6"]


def ways(
    starts: Float[Array, "lanes nq"],
    goals: Float[Array, "lanes goals nq"],
    robot: CoreRobot,
    options: Int[Array, " k"],
    ranges: Float[Array, " m"],
    scene: CoreScene,
    clearance: Float[Array, " 1"],
    *,
    longest: int,
) -> Ways:
    """Return ways between configurations.

    Args:
        starts, goals: configurations; any goal will do.
        robot: its shapes.
        options: number of entries of q that move, states to try, key, and those entries. (3 + n,)
        ranges: lowest and highest value of each of them, and the longest step of a tree by the distance of the two
            corners. (2 n + 1,)
        scene: obstacles, one scene or one for each start.
        clearance: distance that all pairs keep [m].
        longest: number of vertices at most (static).
    """
    lanes, n = len(starts), (len(ranges) - 1) // 2
    shapes = [((lanes, longest, n), float), ((lanes, longest), float), ((lanes, 6), int)]
    given = starts, goals, robot.integers, robot.numbers, options, ranges, *scene, clearance
    return Ways(*_library.call("ways", shapes, *given))


def are_free_curves(
    curves: Float[Array, "lanes 4 nq"],
    robot: CoreRobot,
    options: Int[Array, " k"],
    ranges: Float[Array, " m"],
    scene: CoreScene,
    clearance: Float[Array, " 1"],
) -> Bool[Array, " lanes"]:
    """Return whether all pairs are proven to keep a distance on cubic Bezier curves, given by their control points.

    Other arguments as in ``ways``.
    """
    given = curves[:, 0], curves[:, 1:], robot.integers, robot.numbers, options, ranges, *scene, clearance
    return _library.call("free_curves", [((len(curves),), int)], *given)[0] > 0
