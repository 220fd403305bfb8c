"""Convex hulls of the shapes of a collision limit: of added shapes, of the model's meshes, and of mesh files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from .._errors import OsikError, OsikValueError, warn
from ..robot import Robot
from ._convex import geom_hull
from ._geometry import Kind, UnitCore, convex_hull
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
