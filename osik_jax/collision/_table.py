"""Convex shapes as arrays: what the core reads of a robot and of a scene."""

from __future__ import annotations

import enum
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int


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
