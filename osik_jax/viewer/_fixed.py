"""Shapes fixed in the world beside a robot: posts, tables, balls."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import mujoco
import numpy as np
from jaxtyping import Float

from .._errors import OsikValueError
from ..collision import CollisionShape
from ..collision._geometry import Kind
from ._parts import Part

_GEOMS = {
    Kind.SEGMENT: mujoco.mjtGeom.mjGEOM_CAPSULE,
    Kind.BOX: mujoco.mjtGeom.mjGEOM_BOX,
    Kind.CYLINDER: mujoco.mjtGeom.mjGEOM_CYLINDER,
}
_COLOR = np.array([0.95, 0.61, 0.22, 1.0])


@dataclasses.dataclass(frozen=True)
class FixedParts:
    """Shapes fixed to the world, with the part of ``RobotParts``' interface that a ``Stage`` uses.

    Attributes:
        parts: the shapes.
        positions: of their centres in the world [m]. (parts, 3)
        rotations: from their axes to the world's. (parts, 3, 3)
    """

    parts: tuple[Part, ...]
    positions: Float[np.ndarray, "parts 3"]
    rotations: Float[np.ndarray, "parts 3 3"]

    def poses(self, data: mujoco.MjData) -> tuple[Float[np.ndarray, "parts 3"], Float[np.ndarray, "parts 3 3"]]:
        """Return positions [m] and rotations in the world; they do not depend on ``data``."""
        return self.positions, self.rotations

    def corners(self) -> Float[np.ndarray, "points 3"]:
        """Return the corners of boxes about the shapes, in the world [m]."""
        own = np.array([part.corners for part in self.parts]).reshape(-1, 8, 3)
        return (np.einsum("pij,pkj->pki", self.rotations, own) + self.positions[:, None]).reshape(-1, 3)


def fixed_parts(shapes: Iterable[CollisionShape]) -> FixedParts:
    """Return the drawable parts of shapes of the world.

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
    return FixedParts(
        tuple(Part(k, _kind(shape), np.asarray(shape.size, float), _COLOR) for k, shape in enumerate(shapes)),
        np.array([shape.position for shape in shapes], float).reshape(-1, 3),
        np.array([shape.rotation for shape in shapes], float).reshape(-1, 3, 3),
    )


def _kind(shape: CollisionShape) -> mujoco.mjtGeom:
    """Return MuJoCo's geom type; a segment of length 0 is a sphere."""
    is_sphere = shape.kind is Kind.SEGMENT and float(shape.size[1]) == 0.0
    return mujoco.mjtGeom.mjGEOM_SPHERE if is_sphere else _GEOMS[shape.kind]
