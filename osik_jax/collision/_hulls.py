"""Convex hulls of the shapes of a collision limit: of added shapes, of the model's meshes, and of mesh files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from .._errors import OsikError, OsikValueError, warn
from ..robot import Robot
from ..robot.loading._meshes import unread_points
from ..robot.loading._urdf_meshes import thickened
from ._geometry import Kind, UnitCore, convex_hull, mesh_hull
from ._pairs import Member
from ._shape import CollisionShape

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
            hulls[k] = _hull(robot, k, shapes.get(scene[k].name))
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


def _hull(robot: Robot, number: int, shape: CollisionShape | None) -> UnitCore:
    """Return the hull of an added shape, or of one of the robot's geoms."""
    if shape is not None and shape.hull is not None:
        return shape.hull
    model = robot.mj_model
    if number < model.ngeom:
        return mesh_hull(model, number)
    points = unread_points(robot.holder.meshes[number - model.ngeom])
    try:
        return convex_hull(points)
    except OsikValueError:  # flat
        return convex_hull(thickened(points))
