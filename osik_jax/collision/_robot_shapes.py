"""Collision shapes of a robot: exact convex shapes, the pairs that are kept apart, and covering spheres."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, Literal

import jax
import numpy as np

from .._errors import OsikTypeError, OsikValueError, warn
from ..numerics._remembered import hold_numbers, remembered
from ..robot import Robot
from ..robot._made_for import check_robot
from ..robot._ranges import first_of
from ..robot._size import robot_size
from ..robot.loading._source import read_source
from ..robot.loading._srdf import Srdf, read_srdf, srdf_beside
from ._given_spheres import Spheres, cover_by_given, read_spheres
from ._pairs import Member, members, moves, own_pairs, refuse_without_distance
from ._spheres import cover
from ._table import ConvexShape, CoveringSpheres, RobotShapes, geom_shape, shape_table
from ._touching import SAMPLES, always_touching

Given = str | os.PathLike[str] | Srdf | Literal[True] | None
"""An SRDF: its path, text or content; ``True``: the file beside the URDF; ``None``: no SRDF."""


def robot_shapes(robot: Robot, srdf: Given = None) -> RobotShapes:
    """Return the collision shapes of a robot, and the pairs that are kept apart.

    Shapes are the robot's geoms that collide (``contype`` and ``conaffinity``): all collision shapes of a URDF. Meshes
    are their convex hulls. Kept apart are all pairs but those of one body, of bodies with one joint between them
    (locked joints do not count), those of the model's ``<exclude>``, those that the SRDF allows, and those that touch
    at each of 1001 configurations, of which a warning tells. Pairs that never touch are kept: no sample can prove it.

    The result is kept for the last robots and arguments.

    Args:
        robot: the robot.
        srdf: see ``Given``. Its authors allow what they hold for impossible, so no SRDF is read unless one is named.

    Raises:
        FileNotFoundError: no such file; a mesh is not found.
        TypeError: the robot is traced.
        ValueError: nothing of the robot collides, a mesh cannot be read, or a geom has no distance.

    Warns:
        OsikWarning: pairs touch in every configuration, or the SRDF names links that the robot lacks.
    """
    check_robot(robot, "robot_shapes(robot)")
    if not hold_numbers(robot):
        raise OsikTypeError("a robot that is traced has no shapes: make them outside of jit, from the robot itself")
    if srdf is True:
        srdf = srdf_beside(robot.holder.path)
    if srdf is None or isinstance(srdf, Srdf):
        return _made(robot, srdf)
    is_text = isinstance(srdf, str) and srdf.lstrip("\ufeff \t\r\n").startswith("<")
    return _made(robot, None, srdf=srdf if is_text else _stamped(srdf, "SRDF"))


def covering_spheres(robot: Robot, given: Spheres | str | os.PathLike[str] | None = None) -> CoveringSpheres:
    """Return spheres that contain the collision shapes of a robot; made once, and kept in the cache folder.

    Args:
        robot: the robot.
        given: spheres of your own: a ``.yaml`` of cuRobo, a URDF whose collision shapes are spheres, or
            ``{link: [{"center": (x, y, z), "radius": r}]}`` in the links' axes [m]. They are grown until they are sure
            to cover their shapes.

    Raises:
        FileNotFoundError: no such file; a mesh is not found.
        KeyError: spheres of a link without collision shapes.
        TypeError: the robot is traced, or the spheres are none.
        ValueError: as of ``robot_shapes``; a file without spheres.

    Warns:
        OsikWarning: given spheres were grown, or shapes have none.
    """
    shapes = robot_shapes(robot)
    convex = _solid(robot)[2]
    given = read_spheres(_stamped(given, "spheres")[0]) if isinstance(given, str | os.PathLike) else given
    size = float(robot_size(robot))
    owner, balls = cover(convex, size) if given is None else cover_by_given(robot, given, shapes.links, convex, size)
    return CoveringSpheres(shapes.names, owner, shapes.bodies[owner], *balls)


def _stamped(path: Any, kind: str) -> tuple[str, int]:
    """Return the path of a file and when it was changed, so that it is read once.

    Raises:
        FileNotFoundError: no such file; the message lists those that are there.
        TypeError: no path.
    """
    if not isinstance(path, str | os.PathLike) or not os.path.isfile(path):
        read_source(path, kind)
    return os.fspath(path), os.stat(path).st_mtime_ns


@remembered
@jax.ensure_compile_time_eval()  # the call may stand inside a program that has the robot as a constant
def _made(robot: Robot, rules: Srdf | None, *, srdf: str | tuple[str, int] | None = None) -> RobotShapes:
    rules = rules if srdf is None else read_srdf(srdf if isinstance(srdf, str) else srdf[0])
    found, solid, shapes = _solid(robot)
    parts, number = [found[k] for k in solid], {k: n for n, k in enumerate(solid)}
    possible = [(number[i], number[j]) for i, j in own_pairs(robot, found)]
    kept = _without_allowed(robot, parts, possible, rules)
    touching = always_touching(robot, [part.body for part in parts], shapes, kept)
    if touching:
        _warn_of_touching([f"{parts[i].name}-{parts[j].name}" for i, j in touching])
    kept = [pair for pair in kept if pair not in set(touching)]
    return RobotShapes(
        names=tuple(part.name for part in parts),
        links=tuple(part.aliases[0] for part in parts),
        bodies=np.array([part.body for part in parts], np.int32),
        table=shape_table(shapes),
        pairs=np.array(kept, np.int32).reshape(-1, 2),
        world=np.array(moves(robot, parts), bool),
        touching=tuple((parts[i].name, parts[j].name) for i, j in touching),
    )


@remembered
def _solid(robot: Robot) -> tuple[list[Member], list[int], list[ConvexShape]]:
    """Return all geoms, the numbers of those that collide, and the shapes of these."""
    found = members(robot, {})
    solid = [k for k, member in enumerate(found) if member.solid]
    _check(found, [found[k] for k in solid])
    return found, solid, [_shape(robot, k, found[k]) for k in solid]


def _check(found: Sequence[Member], solid: Sequence[Member]) -> None:
    refuse_without_distance(solid)
    if not solid:
        names = first_of([member.name for member in found]) if found else "none"
        raise OsikValueError(
            "the robot has no collision shape: a URDF needs <collision> elements, an MJCF geoms whose contype and "
            f"conaffinity are not 0. Its geoms: {names}"
        )


def _shape(robot: Robot, number: int, member: Member) -> ConvexShape:
    try:
        return geom_shape(robot, number)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"the collision mesh of {member.label}: {error}") from None
    except ValueError as error:
        raise OsikValueError(f"the collision mesh of {member.label}: {error}") from None


def _without_allowed(
    robot: Robot, parts: Sequence[Member], pairs: Sequence[tuple[int, int]], rules: Srdf | None
) -> list[tuple[int, int]]:
    """Return the pairs whose links the SRDF does not allow to touch; a note tells of its unknown links."""
    if rules is None:
        return list(pairs)
    unknown = sorted(rules.links - {*robot.frame_names})
    if unknown:
        warn(f"the SRDF names {len(unknown)} links that the robot lacks; they are passed over: {first_of(unknown)}")
    return [(i, j) for i, j in pairs if not rules.allows(parts[i].aliases[0], parts[j].aliases[0])]


def _warn_of_touching(pairs: list[str]) -> None:
    warn(
        f"these pairs touch in each of {SAMPLES + 1} configurations, so nothing keeps them apart: "
        f"{first_of(pairs, 8)}. If they are meant to touch, an SRDF or <exclude> says so; otherwise their shapes are "
        "too large"
    )
