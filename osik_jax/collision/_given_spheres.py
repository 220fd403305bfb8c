"""Spheres of a user: cuRobo's YAML, a spherized URDF or a dictionary; grown until they cover the shapes."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from .._errors import OsikTypeError, OsikValueError, missing_extra, unknown_name, warn
from ..robot import Robot
from ..robot._ranges import first_of
from ..robot.loading._source import check_root, parse_xml, read_source
from ..robot.loading._urdf_elements import read_urdf
from ._spheres import Balls, covering_balls, needed_radii, overshoots
from ._table import ConvexShape

Spheres = Mapping[str, Sequence[Mapping[str, Any]]]
"""``{link: [{"center": (x, y, z), "radius": r}, ...]}`` in the axes of the link [m], as in cuRobo's files."""

_TOLERANCE = 1e-4
"""Growth that is not worth a warning [m]."""


def read_spheres(path: str | os.PathLike[str]) -> Spheres:
    """Return the spheres of a ``.yaml`` file of cuRobo or of a URDF whose collision shapes are spheres.

    Raises:
        FileNotFoundError: no such file.
        ImportError: a ``.yaml`` file without PyYAML (the extra ``scenes``).
        ValueError: a file without spheres.
    """
    if Path(path).suffix.lower() in (".yaml", ".yml"):
        return _yaml_spheres(Path(path))
    source = read_source(path, "URDF")
    root = parse_xml(source)
    check_root(root, "robot", source)
    found = {
        link.name: [
            {"center": shape.pose.position, "radius": shape.size[0]}
            for shape in link.shapes
            if shape.kind == "sphere" and not shape.visual
        ]
        for link in read_urdf(root).links.values()
    }
    found = {name: spheres for name, spheres in found.items() if spheres}
    if not found:
        raise OsikValueError(f"{source.label}: none of the collision shapes is a sphere")
    return found


def _yaml_spheres(path: Path) -> Spheres:
    try:
        import yaml
    except ImportError as missing:
        raise missing_extra("reading a .yaml of spheres", "PyYAML", "scenes") from missing
    found = yaml.safe_load(path.read_text(encoding="utf-8"))
    for key in ("robot_cfg", "kinematics"):
        found = found.get(key, found) if isinstance(found, Mapping) else found
    spheres = found.get("collision_spheres") if isinstance(found, Mapping) else None
    if isinstance(spheres, str):
        return _yaml_spheres(path.parent / spheres)
    if not isinstance(spheres, Mapping):
        raise OsikValueError(f"{path}: it has no collision_spheres, as a robot of cuRobo has")
    return spheres


def cover_by_given(
    robot: Robot, spheres: Spheres, links: Sequence[str], shapes: Sequence[ConvexShape], size: float
) -> tuple[Int[np.ndarray, " s"], Balls]:
    """Return the shape that each ball belongs to, and the balls: the given ones, each grown until no shape is outside.

    A ball belongs to the shape of its link that its centre is deepest in. A shape without balls gets its own.

    Args:
        robot: the robot.
        spheres: of the user.
        links: name of each shape's link.
        shapes: in the axes of the moving bodies.
        size: of the robot [m]; see ``cover``.

    Raises:
        KeyError: a link that has no collision shape.
        TypeError, ValueError: not spheres.

    Warns:
        OsikWarning: balls were grown, or shapes have none.
    """
    given = {link: _in_body(robot, link, some) for link, some in _checked(spheres, links).items()}
    owners: dict[int, list[int]] = {}
    for link, (centers, _) in given.items():
        rows = [k for k, name in enumerate(links) if name == link]
        depths = np.array([-overshoots(shapes[k], centers, np.zeros(len(centers))) for k in rows])
        for ball, row in enumerate(depths.argmax(0)):
            owners.setdefault(rows[row], []).append(ball)
    made, grown, bare = [], [], []
    for k, shape in enumerate(shapes):
        if k not in owners:
            made.append(covering_balls(shape, size))
            bare += [links[k]] if len(made[-1].radius) else []
            continue
        centers, radii = (part[owners[k]] for part in given[links[k]])
        larger = np.maximum(radii, needed_radii(shape, centers, radii))
        grown += [(float((larger - radii).max()), links[k])]
        made.append(Balls(centers, larger, overshoots(shape, centers, larger)))
    _tell(grown, bare)
    owner = np.repeat(np.arange(len(shapes), dtype=np.int32), [len(one.radius) for one in made])
    center, radius, overshoot = (np.concatenate(column) for column in zip(*made, strict=True))
    return owner, Balls(center, radius, overshoot)


def _checked(spheres: Any, links: Sequence[str]) -> Spheres:
    if not isinstance(spheres, Mapping):
        raise OsikTypeError(
            f"spheres is {type(spheres).__name__}; it is a path, or {{link: [{{'center': (x, y, z), 'radius': r}}]}}"
        )
    for link in spheres:
        if link not in links:
            raise unknown_name("link with a collision shape", link, tuple(dict.fromkeys(links)))
    return {link: some for link, some in spheres.items() if len(some)}


def _in_body(
    robot: Robot, link: str, spheres: Sequence[Mapping[str, Any]]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Return centres in the axes of the link's moving body, and radii [m]; cuRobo's negative radii count as 0."""
    try:
        centers = np.array([one["center"] for one in spheres], float).reshape(-1, 3)
        radii = np.maximum([float(one["radius"]) for one in spheres], 0.0)
    except (TypeError, ValueError, KeyError) as error:
        raise OsikValueError(
            f"the spheres of {link!r} are not [{{'center': (x, y, z), 'radius': r}}]: {error}"
        ) from None
    if not (np.isfinite(centers).all() and np.isfinite(radii).all()):
        raise OsikValueError(f"the spheres of {link!r} have numbers that are not finite")
    at = robot.tree.frame(link)
    position, rotation = np.asarray(robot.frame_position[at], float), np.asarray(robot.frame_rotation[at], float)
    return position + centers @ rotation.T, radii


def _tell(grown: Sequence[tuple[float, str]], bare: Sequence[str]) -> None:
    told = [f"{link} by {1e3 * growth:.3g} mm" for growth, link in sorted(grown, reverse=True) if growth > _TOLERANCE]
    if told:
        warn(f"the given spheres are grown until they are sure to cover their shapes: {first_of(told)}")
    if bare:
        warn(f"shapes without a given sphere get spheres of their own: {first_of(list(dict.fromkeys(bare)))}")
