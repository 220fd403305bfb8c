"""Convex shapes one by one, and as the table of arrays that the core reads of a robot and of a scene."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Array, Float, Int

from .._errors import OsikValueError
from ..robot import Robot
from ..robot.loading._meshes import thickened, unread_points
from ._geometry import qhull, round_polyhedron


class ShapeKind(enum.IntEnum):
    """Kinds of shapes, with the numbers that the core knows them by."""

    ABSENT = 0
    SPHERE = 1
    CAPSULE = 2
    CYLINDER = 3
    BOX = 4
    HALF_SPACE = 5
    HULL = 6


class ShapeTable(NamedTuple):
    """Shapes, each with a pose in its body (a robot's shapes) or in the world (a scene's).

    Attributes:
        kind: ``ShapeKind`` of each; ``ABSENT`` rows are skipped. (k,)
        size: sphere ``(radius, 0, 0)``; capsule, cylinder ``(radius, half length, 0)``, along z; box, half its edges;
            hull ``(radius, 0, 0)``: it is all points within ``radius`` of the hull of its vertices [m]. (k, 3)
        position: of the centre; of a half space, any point of its surface [m]. (k, 3)
        rotation: from the shape's axes to the body's or the world's; z points out of a half space. (k, 3, 3)
        first: row of ``vertices`` where a hull's begin. (k,)
        count: number of a hull's vertices; 0 for other kinds. (k,)
        vertices: of all hulls, each in its shape's axes [m]. (v, 3)
    """

    kind: Int[Array, "*n k"] | np.ndarray
    size: Float[Array, "*n k 3"] | np.ndarray
    position: Float[Array, "*n k 3"] | np.ndarray
    rotation: Float[Array, "*n k 3 3"] | np.ndarray
    first: Int[Array, "*n k"] | np.ndarray
    count: Int[Array, "*n k"] | np.ndarray
    vertices: Float[Array, "*n v 3"] | np.ndarray


class RobotShapes(NamedTuple):
    """Collision shapes of a robot, and the pairs that may touch.

    Attributes:
        names: of the shapes, such as ``"forearm_link:0"``; all different.
        links: name of each shape's link.
        bodies: moving body (``robot.tree.body_names``) that each shape is fixed to. (k,)
        table: the shapes; poses are in the moving body.
        pairs: shapes of the robot that are kept apart from each other: first < second. (p, 2)
        world: whether each shape is kept off the scene. (k,)
        touching: names of the pairs that are not kept apart because they touch in every configuration.
    """

    names: tuple[str, ...]
    links: tuple[str, ...]
    bodies: Int[np.ndarray, " k"]
    table: ShapeTable
    pairs: Int[np.ndarray, "p 2"]
    world: np.ndarray
    touching: tuple[tuple[str, str], ...] = ()


class CoveringSpheres(NamedTuple):
    """Spheres that contain the collision shapes of a robot.

    Attributes:
        names: of the shapes, as in ``RobotShapes``.
        shape: shape that each sphere belongs to. (s,)
        body: moving body that it is fixed to. (s,)
        center: in the axes of that body [m]. (s, 3)
        radius: [m]. Together the spheres of a shape contain it. (s,)
        overshoot: how far each sphere sticks out of its shape at most [m]. (s,)
    """

    names: tuple[str, ...]
    shape: Int[np.ndarray, " s"]
    body: Int[np.ndarray, " s"]
    center: Float[np.ndarray, "s 3"]
    radius: Float[np.ndarray, " s"]
    overshoot: Float[np.ndarray, " s"]


NO_VERTICES = np.zeros((0, 3))

_HALVINGS = 3
"""Halvings of the edges of an icosahedron: its 642 corners around an ellipsoid stick out by 0.5 %."""

_KINDS = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): ShapeKind.HALF_SPACE,
    int(mujoco.mjtGeom.mjGEOM_SPHERE): ShapeKind.SPHERE,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): ShapeKind.CAPSULE,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): ShapeKind.CYLINDER,
    int(mujoco.mjtGeom.mjGEOM_BOX): ShapeKind.BOX,
}


class ConvexShape(NamedTuple):
    """One row of a ``ShapeTable``, with its own vertices.

    Attributes:
        kind: what it is.
        size: [m], as in ``ShapeTable``. (3,)
        position: [m]. (3,)
        rotation: from the shape's axes to those of its body or of the world. (3, 3)
        vertices: of a hull [m]. (v, 3)
    """

    kind: ShapeKind
    size: Float[np.ndarray, "3"]
    position: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]
    vertices: Float[np.ndarray, "v 3"] = NO_VERTICES


def shape_table(shapes: Sequence[ConvexShape]) -> ShapeTable:
    """Return the table of some shapes, with the vertices of their hulls in one array."""
    counts = np.array([len(shape.vertices) for shape in shapes], np.int32)
    return ShapeTable(
        kind=np.array([shape.kind for shape in shapes], np.int32),
        size=np.array([shape.size for shape in shapes], float).reshape(-1, 3),
        position=np.array([shape.position for shape in shapes], float).reshape(-1, 3),
        rotation=np.array([shape.rotation for shape in shapes], float).reshape(-1, 3, 3),
        first=(np.cumsum(counts) - counts).astype(np.int32),
        count=counts,
        vertices=np.concatenate([NO_VERTICES, *(shape.vertices for shape in shapes)]),
    )


def table_shapes(table: ShapeTable) -> list[ConvexShape]:
    """Return the rows of a table of numbers that are known."""
    kind, size, position, rotation, first, count, vertices = map(np.asarray, table)
    own = [vertices[start : start + number] for start, number in zip(first, count, strict=True)]
    return [*map(ConvexShape, map(ShapeKind, kind), size, position, rotation, own)]


def geom_shape(robot: Robot, number: int) -> ConvexShape:
    """Return a geom of a robot in its moving body; a mesh is its convex hull, an ellipsoid a polyhedron around it.

    Raises:
        FileNotFoundError, ValueError: the file of a mesh cannot be read.
    """
    leaves = robot.geom_size, robot.geom_position, robot.geom_rotation
    size, position, rotation = (np.asarray(leaf, float)[number] for leaf in leaves)
    kind = robot.tree.geom_types[number]
    if kind != mujoco.mjtGeom.mjGEOM_MESH:
        return _simple(kind, size, position, rotation)
    return ConvexShape(ShapeKind.HULL, np.zeros(3), position, rotation, geom_hull(robot, number) * size)


def geom_hull(robot: Robot, number: int) -> Float[np.ndarray, "v 3"]:
    """Return the corners of the convex hull of a robot's mesh geom [m], in the geom's axes.

    Raises:
        FileNotFoundError, ValueError: the file of the mesh cannot be read.
    """
    model = robot.mj_model
    unread = number >= model.ngeom
    points = unread_points(robot.holder.meshes[number - model.ngeom]) if unread else _model_points(model, number)
    return hull_vertices(points)


def model_shape(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> ConvexShape:
    """Return a geom of a MuJoCo model in the world; a mesh is its convex hull.

    Raises:
        ValueError: the mesh has no hull.
    """
    position, rotation = data.geom_xpos[geom].copy(), data.geom_xmat[geom].reshape(3, 3).copy()
    if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_MESH:
        return _simple(int(model.geom_type[geom]), model.geom_size[geom].copy(), position, rotation)
    return ConvexShape(ShapeKind.HULL, np.zeros(3), position, rotation, hull_vertices(_model_points(model, geom)))


def _simple(
    kind: int, size: Float[np.ndarray, "3"], position: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "3 3"]
) -> ConvexShape:
    """Return a shape of one of MuJoCo's kinds that is no mesh."""
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return ConvexShape(ShapeKind.HULL, np.zeros(3), position, rotation, round_polyhedron(_HALVINGS) * size)
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        size = np.zeros(3)  # MuJoCo's is that of its picture
    return ConvexShape(_KINDS[kind], size, position, rotation)


def hull_vertices(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "v 3"]:
    """Return the corners of the convex hull of points [m]; points in a plane are thickened.

    Raises:
        ValueError: the points lie on a line, or are not finite.
    """
    try:
        hull = qhull(points)
    except OsikValueError:
        hull = qhull(thickened(points))
    return hull.points[hull.vertices]


def _model_points(model: mujoco.MjModel, geom: int) -> Float[np.ndarray, "n 3"]:
    """Return all vertices of a mesh geom [m]; those of the model's own hull may be fewer (``maxhullvert``)."""
    mesh = model.geom_dataid[geom]
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    return np.asarray(model.mesh_vert[start : start + count], float)


def bounding_ball(shape: ConvexShape) -> tuple[Float[np.ndarray, "3"], float]:
    """Return centre (as ``position``) and radius [m] of a ball around a shape; infinite for a half space."""
    radius, second, _ = shape.size
    if shape.kind is ShapeKind.HULL:
        middle = 0.5 * (shape.vertices.min(0) + shape.vertices.max(0))
        reach = np.linalg.norm(shape.vertices - middle, axis=1).max()
        return shape.position + shape.rotation @ middle, float(reach + radius)
    reach = {
        ShapeKind.SPHERE: radius,
        ShapeKind.CAPSULE: radius + second,
        ShapeKind.CYLINDER: np.hypot(radius, second),
        ShapeKind.BOX: np.linalg.norm(shape.size),
    }
    return shape.position, float(reach.get(shape.kind, np.inf))
