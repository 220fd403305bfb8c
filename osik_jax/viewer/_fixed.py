"""Shapes fixed in the world beside a robot: posts, tables, balls."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np

from .._errors import OsikValueError
from ..collision import CollisionShape
from ..collision._geometry import Kind
from ..robot import Robot
from ._parts import Part, RobotParts

_GEOMS = {
    Kind.SEGMENT: mujoco.mjtGeom.mjGEOM_CAPSULE,
    Kind.BOX: mujoco.mjtGeom.mjGEOM_BOX,
    Kind.CYLINDER: mujoco.mjtGeom.mjGEOM_CYLINDER,
}
_COLOR = np.array([0.95, 0.61, 0.22, 1.0])


def fixed_parts(robot: Robot, shapes: Iterable[CollisionShape]) -> RobotParts:
    """Return shapes of the world as parts that the world's body carries.

    Raises:
        ValueError: a shape on a frame of the robot, a half-space or a convex hull.
    """
    shapes = tuple(shapes)
    for shape in shapes:
        if shape.frame is not None or shape.kind not in _GEOMS:
            raise OsikValueError(
                f"a {shape.kind.name.lower()} on frame {shape.frame!r} is not drawn; shapes are spheres, capsules, "
                "boxes and cylinders of the world"
            )
    parts = tuple(Part(k, _kind(shape), np.asarray(shape.size, float), _COLOR) for k, shape in enumerate(shapes))
    positions = np.array([shape.position for shape in shapes], float).reshape(-1, 3)
    rotations = np.array([shape.rotation for shape in shapes], float).reshape(-1, 3, 3)
    return RobotParts(robot.mj_model, "look", parts, np.zeros(len(parts), int), (positions, rotations))


def _kind(shape: CollisionShape) -> mujoco.mjtGeom:
    """Return MuJoCo's geom type; a segment of length 0 is a sphere."""
    is_sphere = shape.kind is Kind.SEGMENT and float(shape.size[1]) == 0.0
    return mujoco.mjtGeom.mjGEOM_SPHERE if is_sphere else _GEOMS[shape.kind]
