"""Support functions of shapes: of tables of this package, and of Pinocchio's collision models."""

from __future__ import annotations

from pathlib import Path

import coal
import numpy as np
import pinocchio as pin

import osik_jax as osik
from osik_jax.collision._table import RobotShapes, ShapeKind, ShapeTable


def directions(count: int = 200) -> np.ndarray:
    """Random unit vectors. (count, 3)"""
    out = np.random.default_rng(0).standard_normal((count, 3))
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def table_support(table: ShapeTable, row: int, ways: np.ndarray) -> np.ndarray:
    """Greatest coordinate [m] of a shape along each direction, in the axes that its pose is in."""
    own = ways @ table.rotation[row]
    a, b, c = table.size[row]
    round_part = np.linalg.norm(own[:, :2], axis=1)
    vertices = table.vertices[table.first[row] : table.first[row] + table.count[row]]
    reach = {
        ShapeKind.SPHERE: lambda: np.full(len(own), a),
        ShapeKind.CAPSULE: lambda: a + b * abs(own[:, 2]),
        ShapeKind.CYLINDER: lambda: a * round_part + b * abs(own[:, 2]),
        ShapeKind.BOX: lambda: abs(own) @ np.array([a, b, c]),
        ShapeKind.HULL: lambda: a + (own @ vertices.T).max(1),
    }
    return ways @ table.position[row] + reach[ShapeKind(int(table.kind[row]))]()


def pinocchio_geometry(urdf: Path) -> tuple[pin.Model, pin.GeometryModel]:
    """Pinocchio's model of a URDF of example-robot-data, its base fixed, and its collision shapes."""
    model = pin.buildModelFromUrdf(str(urdf))
    folder = next(up for up in urdf.parents if up.name == "example-robot-data").parent
    return model, pin.buildGeomFromUrdf(model, str(urdf), pin.GeometryType.COLLISION, package_dirs=[str(folder)])


def coal_support(geometry: coal.CollisionGeometry, pose: pin.SE3, ways: np.ndarray) -> np.ndarray:
    """Greatest coordinate [m] of a shape of coal along each direction."""
    own = ways @ pose.rotation
    if isinstance(geometry, coal.Box):
        reach = abs(own) @ np.asarray(geometry.halfSide).ravel()
    elif isinstance(geometry, coal.Cylinder):
        reach = geometry.radius * np.linalg.norm(own[:, :2], axis=1) + geometry.halfLength * abs(own[:, 2])
    elif isinstance(geometry, coal.Sphere):
        reach = np.full(len(own), geometry.radius)
    else:
        reach = (own @ mesh_vertices(geometry).T).max(1)
    return ways @ pose.translation + reach


def mesh_vertices(geometry: coal.BVHModelBase) -> np.ndarray:
    return np.array([geometry.vertex(k) for k in range(geometry.num_vertices)])


def beside_pinocchio(robot: osik.Robot, shapes: RobotShapes, urdf: Path) -> tuple[int, float]:
    """How many shapes Pinocchio has, and the largest difference [m] of the support functions of equal ones.

    Each shape of Pinocchio's is compared with the most similar one of the same link, in the link's frame.
    """
    model, geometry = pinocchio_geometry(urdf)
    ways, left, worst = directions(), set(range(len(shapes.names))), 0.0
    for thing in geometry.geometryObjects:
        frame = model.frames[thing.parentFrame]
        theirs = coal_support(thing.geometry, frame.placement.inverse() * thing.placement, ways)
        differences = {}
        for row in (row for row in left if shapes.links[row] == frame.name):
            at = robot.frame_names.index(frame.name)
            turn = np.asarray(robot.frame_rotation[at], float)
            place = np.asarray(robot.frame_position[at], float)
            ours = table_support(shapes.table, row, ways @ turn.T) - ways @ turn.T @ place
            differences[row] = abs(ours - theirs).max()
        nearest = min(differences, key=lambda row: differences[row])
        left.remove(nearest)
        worst = max(worst, differences[nearest])
    return len(geometry.geometryObjects), worst
