"""Rows of the nearest pairs of shapes of a robot and of a scene, by the core (``core/near_rows.hpp``)."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..execution._computed import in_shared_lanes
from ..execution._platform import cuda_is_default, on_host
from ..execution._rules import custom_jvp
from ..kinematics import Kinematics
from ..kinematics._forward import home_kinematics
from ..numerics._guarded import at_most_inverse
from ..numerics._remembered import remembered
from ..robot import Robot
from ._clearance import shape_frames
from ._core import CoreScene, call_here, core_robot, core_scene
from ._distance import Nearest, nearest_points
from ._pair_layout import separation_jacobian
from ._scene import Scene
from ._table import RobotShapes

_GEOMETRY = 29
"""Numbers of a pair in ``NearRows::put_geometry``."""

_FEW, _MEMBERS = 4096, 32
"""Robots on a GPU up to which several threads find the rows of each, and how many."""


class KeptShapes:
    """A robot's shapes, and the pairs of them that a limit keeps apart; equal by identity, so that it can be static.

    Args:
        robot: the robot; its numbers are known.
        shapes: its shapes.
        left_out: pairs that are not kept apart. (n, 2)
    """

    def __init__(self, robot: Robot, shapes: RobotShapes, left_out: Int[np.ndarray, "n 2"]) -> None:
        of_left_out = {tuple(pair) for pair in left_out.tolist()}
        kept = [pair for pair in shapes.pairs.tolist() if tuple(pair) not in of_left_out]
        self.left_out = tuple((shapes.names[i], shapes.names[j]) for i, j in left_out)
        self.shapes = shapes._replace(pairs=np.array(kept, np.int32).reshape(-1, 2))
        self.core, self.tree = core_robot(robot, self.shapes), robot.tree


@remembered
def kept_shapes(robot: Robot, shapes: RobotShapes, *, least: float) -> KeptShapes:
    """Return the shapes of a robot without the pairs that are nearer than ``least`` [m] at its ``q0``."""
    every = KeptShapes(robot, shapes, np.zeros((0, 2), np.int32))
    if not np.isfinite(least) or not len(shapes.pairs):
        return every
    with on_host(), jax.ensure_compile_time_eval():  # the limit may be made inside a program
        numbers, home = [least, least, 0.0, 0.0, 1.0], home_kinematics(robot)
        found = _nearest(every, home, Scene({}), numbers, len(shapes.pairs))
        near = np.asarray(found.pair)[np.isfinite(found.distance), 2:]
    return KeptShapes(robot, shapes, near) if len(near) else every


class NearRows(NamedTuple):
    """Rows of the nearest pairs, the nearest one first; those of no pair are zeros without bounds.

    Attributes:
        jacobian: of the distances. (k, nv)
        lower: bounds on their rates [m/s]. (k,)
        distance: [m]; infinite for no pair. (k,)
        pair: bodies of the two shapes, -1 for the world, and their numbers; -1 for no pair. (k, 4)
        geometry: what derivatives are made of: ``NearRows::put_geometry``. (k, 29)
        carried: which shape the normal goes along with, -1: it is that of the nearest points. (k,)
    """

    jacobian: Float[Array, "k nv"]
    lower: Float[Array, " k"]
    distance: Float[Array, " k"]
    pair: Int[Array, "k 4"]
    geometry: Float[Array, "k n"] | None = None
    carried: Int[Array, " k"] | None = None


def near_rows(
    kept: KeptShapes, kinematics: Kinematics, scene: Scene, numbers: Float[Array, "5"], most: int
) -> tuple[Float[Array, "most nv"], Float[Array, " most"]]:
    """Return the Jacobian and the lower bounds of the rows of the ``most`` nearest pairs, with their derivatives.

    Args:
        kept: the robot's shapes.
        kinematics: where the robot is.
        scene: the obstacles.
        numbers: fields of ``AvoidanceNumbers`` in the core.
        most: number of rows (static).
    """
    arrays = core_scene(scene, kept.shapes)
    poses = scene.table.position, scene.table.rotation
    return _rows(kinematics, poses, scene.body, arrays, numbers, kept=kept, most=most)


def all_distances(kept: KeptShapes, kinematics: Kinematics, scene: Scene) -> Float[Array, " pairs"]:
    """Return the distances [m] of all pairs in the order of ``pair_names``; infinite of pairs that may touch."""
    table, names = _pair_table(kept, scene)
    near = _nearest(kept, kinematics, scene, [0.0, np.inf, 0.0, 0.0, 1.0], len(names))
    first, second = near.pair[:, 2], near.pair[:, 3]
    place = jnp.where(first >= 0, jnp.asarray(table)[first, second], len(names))
    return jnp.full(len(names), jnp.inf, near.distance.dtype).at[place].set(near.distance, mode="drop")


def pair_names(kept: KeptShapes, scene: Scene) -> tuple[tuple[str, str], ...]:
    """Return the names of the shapes of all pairs: those of the robot, then each of them with each of the scene."""
    names = (*kept.shapes.names, *scene.names, *["nothing"] * (scene.capacity - len(scene.names)))
    return tuple((names[i], names[j]) for i, j in _pair_table(kept, scene)[1])


def _pair_table(kept: KeptShapes, scene: Scene) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """Return the number of each pair of shapes, and the pairs; a scene's shapes in a hand meet the rest of it."""
    own, rows = len(kept.shapes.names), range(scene.capacity)
    pairs = [(i, j) for i, j in kept.shapes.pairs.tolist()]
    pairs += [(k, own + r) for r in rows for k in np.flatnonzero(kept.shapes.world).tolist()]
    pairs += [(own + r, own + s) for r in rows for s in rows if r != s]
    table = np.full((own + len(rows), own + len(rows)), len(pairs))
    table[tuple(np.array(pairs, int).reshape(-1, 2).T)] = np.arange(len(pairs))
    return table, pairs


def _nearest(kept: KeptShapes, kinematics: Kinematics, scene: Scene, numbers: Any, most: int) -> NearRows:
    arrays, given = core_scene(scene, kept.shapes), jnp.asarray(numbers, kinematics.body_position.dtype)
    return _found(*jax.lax.stop_gradient((kinematics, arrays, given)), kept=kept, most=most, with_geometry=False)


@custom_jvp
def _rows(
    kinematics: Kinematics,
    poses: tuple[Array, Array],
    body: Int[Array, " rows"],
    arrays: CoreScene,
    numbers: Array,
    *,
    kept: KeptShapes,
    most: int,
) -> tuple[Array, Array]:
    del poses, body  # for derivatives
    near = _found(kinematics, arrays, numbers, kept=kept, most=most, with_geometry=False)
    return near.jacobian, near.lower


@_rows.defjvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...], *, kept: KeptShapes, most: int) -> tuple[Any, Any]:
    kinematics, poses, body, arrays, numbers = primals
    fixed = jax.lax.stop_gradient((kinematics, arrays, numbers))
    near = _found(*fixed, kept=kept, most=most, with_geometry=True)
    moving = partial(_rows_of, kept, near, body)
    _, rates = jax.jvp(moving, (kinematics, poses, numbers), (tangents[0], tangents[1], tangents[4]))
    return _rows(*primals, kept=kept, most=most), rates


def _found(
    kinematics: Kinematics, arrays: CoreScene, numbers: Array, *, kept: KeptShapes, most: int, with_geometry: bool
) -> NearRows:
    one = in_shared_lanes(partial(_by_core, kept, most, with_geometry))
    parts = jax.tree.leaves(kinematics), *(jnp.asarray(part) for part in _flat(arrays)), numbers
    return one(*parts)


def _flat(arrays: CoreScene) -> tuple[Any, Any]:
    return arrays.integers[0], arrays.numbers[0]


def _by_core(
    kept: KeptShapes,
    most: int,
    with_geometry: bool,
    kinematics: list[Array],
    integers: Array,
    numbers: Array,
    limit: Array,
) -> NearRows:
    """Return the rows of all lanes; arrays have a leading axis, of the lanes or of length 1."""
    own = (a.reshape(1, -1) for a in (kept.core.integers, kept.core.numbers))
    given = *kinematics, *own, integers, numbers, limit
    lanes = max(len(a) for a in (*kinematics, integers, numbers, limit))
    shapes: Any = [((lanes, most, kept.tree.nv), float), ((lanes, most), float), ((lanes, most), float)]
    shapes += [((lanes, most, 4), int)]
    if with_geometry:
        shapes += [((lanes, most, _GEOMETRY), float), ((lanes, most), int)]
    count = kept.core.sizes[2]
    members = _MEMBERS if lanes <= _FEW and cuda_is_default() else 1
    sizes = *kept.core.sizes, CoreScene(integers, numbers).rows(count), most, members
    method = "near_geometry" if with_geometry else "near_rows"
    return NearRows(*call_here(method, shapes, *given, np.full(1, members), sizes=sizes, members=members))


def _rows_of(
    kept: KeptShapes,
    near: NearRows,
    body: Int[Array, " rows"],
    kinematics: Kinematics,
    poses: tuple[Array, Array],
    numbers: Float[Array, "5"],
) -> tuple[Array, Array]:
    """Return the same rows as a function of where shapes are: to first order the points of their cores go along."""
    assert near.geometry is not None and near.carried is not None
    frames = partial(shape_frames, kinematics, jnp.asarray(kept.shapes.bodies), *poses, body)
    here = jax.vmap(lambda *of_pair: _separation(*frames(of_pair[0]), *of_pair[1:]))(
        near.pair[:, 2:], near.geometry, near.carried
    )
    jacobian = separation_jacobian(kept.tree, kinematics, here, jnp.maximum(near.pair[:, :2], 0))
    lower = jnp.minimum(-at_most_inverse(numbers[2], numbers[4]) * (here.distance - numbers[0]), numbers[3])
    is_pair = near.pair[:, 2] >= 0
    return jnp.where(is_pair[:, None], jacobian, 0.0), jnp.where(is_pair, lower, -jnp.inf)


def _separation(
    turn: Float[Array, "2 3 3"],
    at: Float[Array, "2 3"],
    geometry: Float[Array, " n"],
    carried: Int[Array, ""],
) -> Nearest:
    """Return the separation of a pair from points of its cores, and perhaps a normal, that go along with its shapes."""
    fixed = jax.lax.stop_gradient((turn, at))
    points, normal = geometry[:24].reshape(2, 4, 3), geometry[24:27]
    local = jnp.einsum("pji,pkj->pki", fixed[0], points - fixed[1][:, None])
    here = at[:, None] + jnp.einsum("pij,pkj->pki", turn, local)
    found = nearest_points(here[0], here[1], geometry[27:], normal)
    shape = jnp.maximum(carried, 0)
    normal = turn[shape] @ (fixed[0][shape].T @ normal)
    going_along = Nearest(jnp.dot(normal, here[1, 0] - here[0, 0]), here[0, 0], here[1, 0], normal)
    return jax.tree.map(lambda own, other: jnp.where(carried < 0, own, other), found, going_along)
