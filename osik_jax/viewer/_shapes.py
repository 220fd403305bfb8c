"""Low-poly surfaces of MuJoCo's primitive geoms: quads, counter-clockwise seen from outside, in the geom's frame."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

from ._parts import Part, RobotParts

Quads = Float[np.ndarray, "faces 4 3"]
"""Corners of quads; a triangle is a quad whose last two corners coincide."""

_GEOM = mujoco.mjtGeom


def revolve(profile: Float[np.ndarray, "k 2"], segments: int) -> Quads:
    """Return the surface swept about the z axis by a profile of (radius, z) with rising z."""
    angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    radius, height = profile[:, 0], profile[:, 1]
    points = np.empty((len(profile), segments + 1, 3))
    points[..., :2] = radius[:, None, None] * ring
    points[..., 2] = height[:, None]
    low, high = points[:-1], points[1:]
    return np.stack([low[:, :-1], low[:, 1:], high[:, 1:], high[:, :-1]], 2).reshape(-1, 4, 3)


def _arc(radius: float, start: float, stop: float, steps: int, shift: float = 0.0) -> np.ndarray:
    """Return points (radius, z) of an arc between two latitudes, shifted along z."""
    latitude = np.linspace(start, stop, steps + 1)
    return np.stack([radius * np.cos(latitude), radius * np.sin(latitude) + shift], -1)


def sphere(radius: float, detail: int) -> Quads:
    """Return a sphere of ``4 * detail`` meridians."""
    return revolve(_arc(radius, -np.pi / 2, np.pi / 2, 2 * detail), 4 * detail)


def capsule(radius: float, half_length: float, detail: int) -> Quads:
    """Return a capsule along z; ``half_length`` is the distance from its middle to each half sphere's centre."""
    bottom = _arc(radius, -np.pi / 2, 0.0, detail, -half_length)
    top = _arc(radius, 0.0, np.pi / 2, detail, half_length)
    return revolve(np.concatenate([bottom, _inner_rings(radius, half_length, detail), top]), 4 * detail)


def cylinder(radius: float, half_length: float, detail: int) -> Quads:
    """Return a closed cylinder along z."""
    ends = np.array([[0.0, half_length]])
    side = _inner_rings(radius, half_length, detail)
    rim = np.array([[radius, half_length]])
    flip = np.array([1.0, -1.0])
    return revolve(np.concatenate([ends * flip, rim * flip, side, rim, ends]), 4 * detail)


def _inner_rings(radius: float, half_length: float, detail: int) -> np.ndarray:
    """Return rings between the ends of a long cylinder, so that no quad is much longer than wide."""
    # rings about as far apart as the surface is wide; the guard is for a radius of 0
    count = min(detail, int(half_length / max(radius, 1e-9)))
    height = np.linspace(-half_length, half_length, count + 2)[1:-1]
    return np.stack([np.full_like(height, radius), height], -1)


def box(half_sizes: Float[np.ndarray, "3"], detail: int) -> Quads:
    """Return a box whose faces are split into a grid of quads."""
    grid = np.linspace(-1.0, 1.0, max(detail, 2))
    u, v = (a.ravel() for a in np.meshgrid(grid[:-1], grid[:-1], indexing="ij"))
    step = grid[1] - grid[0]
    corners = [(u, v), (u + step, v), (u + step, v + step), (u, v + step)]
    top = np.stack([np.stack([a, b, np.ones_like(a)], -1) for a, b in corners], 1)
    faces = []
    for axis in range(3):
        side = np.roll(top, axis + 1, axis=-1)
        faces += [side, -side[:, ::-1]]
    return np.concatenate(faces) * np.asarray(half_sizes)


def part_surface(part: Part, detail: int) -> Quads:
    """Return the surface of a part that is no mesh, in its own frame."""
    size = part.size
    match part.kind:
        case _GEOM.mjGEOM_SPHERE:
            return sphere(size[0], detail)
        case _GEOM.mjGEOM_ELLIPSOID:
            return sphere(1.0, detail) * size
        case _GEOM.mjGEOM_CAPSULE:
            return capsule(size[0], size[1], detail)
        case _GEOM.mjGEOM_CYLINDER:
            return cylinder(size[0], size[1], detail)
        case _GEOM.mjGEOM_BOX:
            return box(size, detail)
        case _:
            return np.zeros((0, 4, 3))


def lowest_points(shape: RobotParts, data: mujoco.MjData) -> Float[np.ndarray, " parts"]:
    """Return the height of each part's lowest point in the world [m]; exact for meshes, boxes and round shapes."""
    position, rotation = shape.poses(data)
    down = -rotation[:, 2]  # in each part's frame
    return position[:, 2] - np.array([part.reach(way) for part, way in zip(shape.parts, down, strict=True)])
