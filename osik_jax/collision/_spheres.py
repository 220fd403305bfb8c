"""Balls that cover convex shapes, with a bound on how far they stick out.

A polytope is cut by planes into convex cells. A ball that holds the corners of a cell holds the cell, so the balls
together hold the polytope: no sample is needed. The ball with centre c and radius r sticks out of a convex shape by at
most ``r - depth(c)``, the depth being the least distance of c to the planes of the faces. The centre of a cell's ball
is sought where this bound, a convex function of c, is least. The cell with the worst ball is cut next, across the axis
that leaves the best two cells.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy  # loads its parts when they are used
from jaxtyping import Float, Int

from .._npz import open_npz
from .._whole_file import whole_file
from ..core._cuda import cache_folder
from ._geometry import prism, qhull, reach_outside, thinned
from ._table import ConvexShape, ShapeKind

LEAST = 0.008
"""Overshoot that is small enough for any shape, as a share of the robot's size."""

SHARE = 0.25
"""Overshoot that is aimed at, as a share of the radius of the largest ball inside the shape."""

MOST = 16
"""Largest number of balls of a shape; a thin plate gets balls that stick out farther instead."""

_VERTICES = 48
"""A hull with more vertices is replaced by one of so many of them, with a radius that covers the others."""

_EXTENT = 0.2
"""Weight of a cell's extent beside its overshoot where a cut is chosen."""

_CELLS, _THIN = 120, 1e-5
"""Number of cells that a user's balls have to hold, and the radius [m] of the prism along a capsule's axis."""

_STEPS = 40
"""Number of subgradient steps towards a ball's best centre."""


class Balls(NamedTuple):
    """Balls that together contain a shape.

    Attributes:
        center: in the axes of the shape's position [m]. (s, 3)
        radius: [m]. (s,)
        overshoot: how far each sticks out of the shape at most [m]. (s,)
    """

    center: Float[np.ndarray, "s 3"]
    radius: Float[np.ndarray, " s"]
    overshoot: Float[np.ndarray, " s"]


class _Polytope(NamedTuple):
    """Polytope whose balls become those of a shape.

    Attributes:
        corners: [m]. (v, 3)
        normals: of the faces, ``normals @ x <= heights`` inside. (f, 3)
        heights: [m]. (f,)
        around: radius that contains the shape if it is put around the polytope [m].
        excess: how far that sticks out of the shape at most [m].
    """

    corners: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "f 3"]
    heights: Float[np.ndarray, " f"]
    around: float
    excess: float


class _Cell(NamedTuple):
    """Corners of a convex cell, and centre, radius and overshoot of a ball that holds it [m]."""

    corners: Float[np.ndarray, "n 3"]
    center: Float[np.ndarray, "3"]
    radius: float
    overshoot: float


def cover(shapes: Sequence[ConvexShape], size: float) -> tuple[Int[np.ndarray, " s"], Balls]:
    """Return the shape that each ball belongs to, and the balls of all shapes; read from the cache if they are in it.

    Args:
        shapes: the shapes.
        size: of the robot [m]. An overshoot of ``LEAST`` of it is small enough.
    """
    path = _cache_path(shapes, size)
    if path is not None and path.is_file():
        with contextlib.suppress(OSError, ValueError, KeyError), open_npz(path) as file:
            return file["shape"], Balls(file["center"], file["radius"], file["overshoot"])
    balls = [covering_balls(shape, size) for shape in shapes]
    owner = np.repeat(np.arange(len(shapes), dtype=np.int32), [len(one.radius) for one in balls])
    center, radius, overshoot = (np.concatenate(column) for column in zip(*balls, strict=True))
    together = Balls(center, radius, overshoot)
    if path is not None:
        with contextlib.suppress(OSError), whole_file(path) as file:
            np.savez(file, shape=owner, **together._asdict())
    return owner, together


def _cache_path(shapes: Sequence[ConvexShape], size: float) -> Path | None:
    """Return the file of the balls of these shapes; None if there is no folder to write in."""
    folder = cache_folder()
    text = Path(__file__).read_bytes()  # other balls after a change of this file
    numbers = [np.asarray(part, float).tobytes() for shape in shapes for part in shape]
    digest = hashlib.blake2b(b"|".join([text, str(size).encode(), *numbers]), digest_size=12).hexdigest()
    return Path(folder) / f"spheres_{digest}.npz" if folder else None


def covering_balls(shape: ConvexShape, size: float) -> Balls:
    """Return balls that contain a shape of a robot of some size [m]; none for a half space."""
    least = LEAST * size
    if shape.kind is ShapeKind.HALF_SPACE:
        return Balls(np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    if shape.kind in (ShapeKind.SPHERE, ShapeKind.CAPSULE):
        found = _along_axis(float(shape.size[0]), float(shape.size[1]), least)
    else:
        found = _in_cells(_polytope(shape), least)
    return found._replace(center=shape.position + found.center @ shape.rotation.T)


def needed_radii(
    shape: ConvexShape, centers: Float[np.ndarray, "s 3"], radii: Float[np.ndarray, " s"]
) -> Float[np.ndarray, " s"]:
    """Return radii [m] with which balls contain a shape: each cell of a partition goes to the ball that grows least.

    A ball without a cell needs 0.
    """
    polytope = _polytope(shape)
    cells = _partition(polytope.corners)
    own = (centers - shape.position) @ shape.rotation
    needed = np.array([np.linalg.norm(cell[:, None] - own, axis=2).max(0) for cell in cells]) + polytope.around
    holder = (needed - radii).argmin(1)
    return np.array([needed[holder == ball, ball].max(initial=0.0) for ball in range(len(centers))])


def overshoots(
    shape: ConvexShape, centers: Float[np.ndarray, "s 3"], radii: Float[np.ndarray, " s"]
) -> Float[np.ndarray, " s"]:
    """Return how far balls with centres inside of a shape stick out of it at most [m]."""
    polytope = _polytope(shape)
    depths = (polytope.heights - (centers - shape.position) @ shape.rotation @ polytope.normals.T).min(1)
    return radii - polytope.around + polytope.excess - depths


def _partition(corners: Float[np.ndarray, "v 3"]) -> list[Float[np.ndarray, "n 3"]]:
    """Return the corners of ``_CELLS`` convex cells of a polytope; the longest one is cut in its middle."""
    axes = np.linalg.svd(corners - corners.mean(0), full_matrices=False)[2]
    extents = [np.ptp(corners @ axes.T, axis=0)]
    cells = [corners]
    while len(cells) < _CELLS:
        place = max(range(len(cells)), key=lambda k: extents[k].max())
        halves = _halves(cells.pop(place), axes[extents.pop(place).argmax()])
        cells += halves
        extents += [np.ptp(half @ axes.T, axis=0) for half in halves]
    return cells


def _along_axis(radius: float, half_length: float, least: float) -> Balls:
    """Return the balls of a capsule: centres at both ends and evenly between them."""
    aim = radius + max(least, SHARE * radius)
    apart = 2.0 * np.sqrt(aim**2 - radius**2)
    count = min(int(np.ceil(2.0 * half_length / apart)) + 1, MOST)
    along = np.linspace(-half_length, half_length, count) if count > 1 else np.zeros(1)
    half_gap = half_length / max(count - 1, 1)
    radii = np.full(count, np.hypot(radius, half_gap))  # two neighbours hold the part of the cylinder between them
    return Balls(along[:, None] * np.array([0.0, 0.0, 1.0]), radii, radii - radius)


def _polytope(shape: ConvexShape) -> _Polytope:
    """Return a polytope around a box or cylinder, or near a hull; in the shape's axes."""
    around, excess = float(shape.size[0]) if shape.kind is ShapeKind.HULL else 0.0, 0.0
    if shape.kind in (ShapeKind.SPHERE, ShapeKind.CAPSULE):
        half = float(shape.size[1])  # its axis, as a prism so thin that it has faces
        points, around = prism() * (_THIN, _THIN, half + _THIN), float(shape.size[0])
        excess = 2.0 * _THIN
    elif shape.kind is ShapeKind.BOX:
        points = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), -1).reshape(-1, 3) * shape.size
    elif shape.kind is ShapeKind.CYLINDER:
        points = prism() * shape.size[[0, 0, 1]]
        excess = float(np.linalg.norm(points[0, :2]) - shape.size[0])
    else:
        points = shape.vertices
    hull = qhull(points)
    outermost = hull.points[hull.vertices]
    if len(outermost) > _VERTICES:
        hull = thinned(outermost, _VERTICES)
        excess = reach_outside(outermost, hull)
        around += excess
    planes = np.unique(np.round(hull.equations, 9), axis=0)
    planes[:, 3] = -(hull.points[hull.vertices] @ planes[:, :3].T).max(0)  # planes are rounded, so no corner is outside
    return _Polytope(hull.points[hull.vertices], planes[:, :3], -planes[:, 3], around, excess)


def _in_cells(polytope: _Polytope, least: float) -> Balls:
    """Return a ball for each cell of a partition, of ``MOST`` cells or with the overshoot that is aimed at."""
    aim = max(least, SHARE * _thickness(polytope))
    axes = np.linalg.svd(polytope.corners - polytope.corners.mean(0), full_matrices=False)[2]
    cells = [_ball_of_cell(polytope, polytope.corners)]
    while len(cells) < MOST and (worst := max(cells, key=lambda cell: cell.overshoot)).overshoot > aim:
        ways = [[_ball_of_cell(polytope, part) for part in _halves(worst.corners, axis)] for axis in axes]
        cells = [cell for cell in cells if cell is not worst]
        cells += min(ways, key=lambda parts: max(map(_badness, parts)))
    radius, overshoot = (np.array(column) for column in zip(*(cell[2:] for cell in cells), strict=True))
    return Balls(np.array([cell.center for cell in cells]), radius + polytope.around, overshoot + polytope.excess)


def _badness(cell: _Cell) -> float:
    """Return what a cut makes small [m]; half a disc has the ball of the whole, and only its extent tells progress."""
    return cell.overshoot + _EXTENT * float(np.linalg.norm(np.ptp(cell.corners, axis=0)))


def _thickness(polytope: _Polytope) -> float:
    """Return the radius of the largest ball inside [m], by a linear program."""
    rows = np.column_stack([polytope.normals, np.ones(len(polytope.normals))])
    bounds = [(None, None)] * 3 + [(0.0, None)]
    found = scipy.optimize.linprog([0.0, 0.0, 0.0, -1.0], A_ub=rows, b_ub=polytope.heights, bounds=bounds)
    return float(found.x[3]) if found.success else 0.0


def _ball_of_cell(polytope: _Polytope, corners: Float[np.ndarray, "n 3"]) -> _Cell:
    """Return a cell with a ball around it; any centre is right, and the search is for one that sticks out little."""
    center = 0.5 * (corners.min(0) + corners.max(0))
    best = _Cell(corners, center, np.inf, np.inf)
    size = np.linalg.norm(np.ptp(corners, axis=0))
    for step in range(_STEPS):
        away = corners - center
        squares = np.einsum("ij,ij->i", away, away)
        farthest = int(squares.argmax())
        radius = float(np.sqrt(squares[farthest]))
        depths = polytope.heights - polytope.normals @ center
        nearest = int(depths.argmin())
        if radius - depths[nearest] < best.overshoot:
            best = _Cell(corners, center, radius, radius - float(depths[nearest]))
        downhill = away[farthest] / max(radius, 1e-300) - polytope.normals[nearest]
        center = center + 0.25 * size / (step + 2.0) * downhill
    return best


def _halves(corners: Float[np.ndarray, "n 3"], axis: Float[np.ndarray, "3"]) -> list[Float[np.ndarray, "m 3"]]:
    """Return the corners of both parts of a convex cell, cut in the middle of its extent along an axis."""
    along = corners @ axis
    heights = along - 0.5 * (along.min() + along.max())
    below, above = heights < 0.0, heights > 0.0
    share = (heights[below][:, None] / (heights[below][:, None] - heights[above]))[..., None]
    # each edge that the plane cuts is among the segments between both sides; all of these are inside the cell
    crossed = _outline((corners[below][:, None] * (1.0 - share) + corners[above] * share).reshape(-1, 3), axis)
    return [np.concatenate([corners[side], crossed]) for side in (~above, ~below)]


def _outline(points: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "m 3"]:
    """Return the points at the corners of the hull of points in a plane; all of them if they are nearly on a line."""
    across = np.linalg.svd(normal[None])[2][1:]
    try:
        return points[scipy.spatial.ConvexHull(points @ across.T).vertices]
    except (scipy.spatial.QhullError, ValueError):
        return points
