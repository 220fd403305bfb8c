"""Rasteriser of triangle meshes with a depth buffer; faster than rays for many triangles."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import null_space

from ._parts import Part
from ._raycast import Image, RayCaster, light
from ._shapes import part_surface
from ._stage import TO_LAMP, Camera, Stage

_FINE = 2
"""Samples per pixel along each axis; a pixel is their mean."""
_SHADOW_SIZE = 0.6
"""Width of the lamp's depth buffer relative to that of the picture."""
_SLACK = 0.012
"""Distance behind the nearest lit surface, in picture heights, above which a point is in shadow."""
_DETAIL = 10
"""Number of rings of a round shape; a sphere has four times as many meridians."""
_AT_ONCE = 4_000_000
"""Number of pixels in triangles' bounding rectangles drawn at once, at about 100 bytes each."""


class _Buffer(NamedTuple):
    """Depth buffer: for each pixel the inverse depth of the front surface (0 if none) and its triangle (-1 if none)."""

    nearness: Float[np.ndarray, "height width"]
    triangle: Int[np.ndarray, "height width"]


class _Surface(NamedTuple):
    """Triangles of one part in its own frame; of a ``closed`` surface, triangles that face away are not drawn."""

    vertices: Float[np.ndarray, "k 3"]
    faces: Int[np.ndarray, "m 3"]
    closed: bool


class _Lamp(NamedTuple):
    """Depth buffer of the lamp that lights the robots."""

    axes: Float[np.ndarray, "3 3"]
    low: Float[np.ndarray, "2"]
    step: Float[np.ndarray, "2"]
    nearness: Float[np.ndarray, "size size"]


class Rasterizer(RayCaster):
    """Variant of ``RayCaster`` that rasterises robots and shadows triangle by triangle."""

    def __init__(self, stage: Stage, camera: Camera, size: tuple[int, int], *, floor: float) -> None:
        """Collect the triangles of the stage."""
        super().__init__(stage, camera, size, floor=floor)
        self._shadow_size = round(_SHADOW_SIZE * max(size))
        self._surfaces = [_surface(part) for part in stage.parts]
        counts = [len(surface.faces) for surface in self._surfaces]
        self._colors = np.repeat(stage.colors, counts, axis=0)
        self._closed = np.repeat([surface.closed for surface in self._surfaces], counts)
        starts = np.cumsum([0, *(len(surface.vertices) for surface in self._surfaces)])
        self._faces = np.concatenate([s.faces + start for s, start in zip(self._surfaces, starts, strict=False)])

    def image(self, data: mujoco.MjData, under: Float[np.ndarray, "height width 4"] | None = None) -> Image:
        """Return a picture of the stage; ``under`` is painted on the floor with shadows, behind the robots."""
        corners = self._corners(data)
        lamp = self._look_from_lamp(corners)
        picture = self._background * self._shadow(data, lambda points: self._unshaded(lamp, points))[..., None]
        if under is not None:
            picture += under[..., 3:] * (under[..., :3] - picture)
        color, cover = self._triangles(corners, lamp)
        return (1.0 - cover[..., None]) * picture + color

    def _corners(self, data: mujoco.MjData) -> Float[np.ndarray, "triangles 3 3"]:
        """Return the corners of all triangles in the world [m]; part k belongs to body k + 1."""
        turns = data.xmat.reshape(-1, 3, 3)[1:]
        placed = [s.vertices @ R.T + p for s, p, R in zip(self._surfaces, data.xpos[1:], turns, strict=True)]
        return np.concatenate(placed)[self._faces]

    def _triangles(self, corners: np.ndarray, lamp: _Lamp) -> tuple[Image, Float[np.ndarray, "height width"]]:
        """Return the robots' colours times coverage, and their coverage."""
        width, height = (_FINE * n for n in self.size)
        eye, axes = self.camera.eye, self.camera.axes
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        away = np.sum(normals * (corners[:, 0] - eye), -1) > 0.0
        shown = np.flatnonzero(~(away & self._closed))
        places = self.camera.project(corners[shown], (width, height))
        buffer = draw_triangles(places, 1.0 / ((corners[shown] - eye) @ axes[2]), (width, height))
        rows, columns = np.nonzero(buffer.triangle >= 0)
        seen = shown[buffer.triangle[rows, columns]]
        rays = self.camera.rays(np.stack([columns, rows], -1) + 0.5, (width, height))
        depth = 1.0 / buffer.nearness[rows, columns] / (rays @ axes[2])
        n = normals[seen] / np.maximum(np.linalg.norm(normals[seen], axis=-1, keepdims=True), 1e-300)
        n *= np.where(away[seen], -1.0, 1.0)[:, None]
        points = eye + depth[:, None] * rays
        # lifted off the surface, or rounding would put points in their own shadow
        lit = self._unshaded(lamp, points + 1e-3 * self.camera.height * n)
        color, cover = np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32)
        color[rows, columns], cover[rows, columns] = light(self._colors[seen], n, rays, lit), 1.0
        blocks = (self.size[1], _FINE, self.size[0], _FINE)
        return color.reshape(*blocks, 3).mean((1, 3)), cover.reshape(blocks).mean((1, 3))

    def _look_from_lamp(self, corners: np.ndarray) -> _Lamp:
        """Return the depth buffer of the lamp."""
        axes = np.concatenate([null_space(TO_LAMP[None]).T, -TO_LAMP[None]])
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        away = np.sum(normals * (corners[:, 0] - self._lamp), -1) > 0.0
        right, up, depth = np.moveaxis((corners[~(away & self._closed)] - self._lamp) @ axes.T, -1, 0)
        places = np.stack([right, up], -1) / depth[..., None]
        low, high = places.min((0, 1)), places.max((0, 1))
        step = np.maximum(high - low, 1e-12) / (self._shadow_size - 2)
        low = low - step  # a margin that stays empty
        buffer = draw_triangles((places - low) / step, 1.0 / depth, (self._shadow_size, self._shadow_size))
        return _Lamp(axes, low, step, buffer.nearness)

    def _unshaded(self, lamp: _Lamp, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return the fraction of the lamp that each point sees, 0 to 1."""
        right, up, depth = ((points - self._lamp) @ lamp.axes.T).T
        place = (np.stack([right, up], -1) / depth[:, None] - lamp.low) / lamp.step - 0.5
        corner, hidden = np.floor(place).astype(int), np.zeros(len(points))
        part = place - corner
        # bilinear mean of four shadow tests, which softens the steps of the depth buffer
        for shift in ((0, 0), (0, 1), (1, 0), (1, 1)):
            column, row = np.clip(corner + shift, 0, self._shadow_size - 1).T
            near = lamp.nearness[row, column]
            behind = depth * near > 1.0 + _SLACK * self.camera.height * near
            inside = ((corner + shift >= 0) & (corner + shift < self._shadow_size)).all(-1)
            hidden += np.prod(np.where(shift, part, 1.0 - part), -1) * (behind & inside)
        return 1.0 - hidden


def _surface(part: Part) -> _Surface:
    """Return the triangles of one part; normals point outwards if the mesh is closed."""
    if part.mesh is None:
        quads = part_surface(part, _DETAIL)
        vertices = quads.reshape(-1, 3)
        first = 4 * np.arange(len(quads))[:, None]
        faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    else:
        vertices, faces = part.mesh
    a, b, c = np.moveaxis(vertices[faces] - vertices.mean(0), 1, 0)
    areas = np.cross(b - a, c - a)
    # the area vectors of a closed surface add up to 0 (divergence theorem)
    closed = np.linalg.norm(areas.sum(0)) < 1e-3 * np.linalg.norm(areas, axis=-1).sum()
    # six times the enclosed volume, which is negative if the faces are turned inwards
    inside_out = np.sum(a * areas) < 0.0
    return _Surface(vertices, faces[:, ::-1] if closed and inside_out else faces, bool(closed))


def draw_triangles(
    places: Float[np.ndarray, "triangles 3 2"], nearness: Float[np.ndarray, "triangles 3"], size: tuple[int, int]
) -> _Buffer:
    """Draw triangles into an empty depth buffer.

    Args:
        places: their corners in a picture, x to the right and y down [pixels]; a pixel is drawn where its middle is
            inside.
        nearness: the inverse of each corner's depth, which is linear over the picture.
        size: width and height [pixels].
    """
    width, height = size
    front, owner = np.zeros(width * height), np.full(width * height, -1)
    first = np.clip(np.ceil(places.min(1) - 0.5), 0, size).astype(int)
    last = np.clip(np.floor(places.max(1) - 0.5), -1, np.array(size) - 1).astype(int)
    index = np.flatnonzero((last >= first).all(-1))
    for part in np.split(index, _cuts((last - first + 1)[index].prod(-1))):
        rows = _rows(places, nearness, first, last, part)
        owners, pixels, values = _fragments(rows, width)
        np.maximum.at(front, pixels, values)
        winners = values == front[pixels]
        owner[pixels[winners]] = owners[winners]
    return _Buffer(front.reshape(height, width), owner.reshape(height, width))


def _cuts(counts: Int[np.ndarray, " n"]) -> np.ndarray:
    """Return the indices that cut a list into pieces of about ``_AT_ONCE`` items in all."""
    return np.flatnonzero(np.diff(np.cumsum(counts) // _AT_ONCE)) + 1


class _Rows(NamedTuple):
    """Horizontal runs of pixels covered by triangles: first and last x, y, and the inverse depth, linear in x."""

    triangle: np.ndarray
    first: np.ndarray
    count: np.ndarray
    y: np.ndarray
    nearness: np.ndarray
    slope: np.ndarray


def _rows(places: np.ndarray, nearness: np.ndarray, first: np.ndarray, last: np.ndarray, index: np.ndarray) -> _Rows:
    """Return the horizontal runs of pixels that the given triangles cover, one run for each triangle and pixel row."""
    heights = last[index, 1] - first[index, 1] + 1
    place = np.repeat(np.arange(len(index)), heights)
    triangle = index[place]
    y = first[triangle, 1] + np.arange(len(place)) - np.repeat(np.cumsum(heights) - heights, heights)
    a, b, c = np.moveaxis(places[index], 1, 0)
    (bx, by), (cx, cy) = (b - a).T, (c - a).T
    area = np.where(bx * cy == by * cx, np.inf, bx * cy - by * cx)
    near_a, near_b, near_c = nearness[index].T
    # The weights u, v, w of the corners b, c, a are linear over the picture, and so is the nearness. At x = 0 of a row:
    down = y + 0.5 - a[place, 1]
    slopes_u, slopes_v = np.stack([cy, -cx]) / area, np.stack([-by, bx]) / area
    u = slopes_u[1, place] * down - slopes_u[0, place] * (a[place, 0] - 0.5)
    v = slopes_v[1, place] * down - slopes_v[0, place] * (a[place, 0] - 0.5)
    low, high = first[triangle, 0].astype(float), last[triangle, 0].astype(float)
    sides = (u, slopes_u[0, place]), (v, slopes_v[0, place]), (1.0 - u - v, -(slopes_u[0] + slopes_v[0])[place])
    for value, slope in sides:
        with np.errstate(divide="ignore", invalid="ignore"):
            root = -value / slope
        low = np.where(slope > 0.0, np.maximum(low, root), low)
        high = np.where(slope < 0.0, np.minimum(high, root), high)
        high = np.where((slope == 0.0) & (value < 0.0), -1.0, high)
    # pixels whose centre lies on an edge up to rounding belong to both triangles: no gaps
    start = np.ceil(low - 1e-9).astype(int)
    count = np.maximum(np.floor(high + 1e-9).astype(int) - start + 1, 0)
    count[np.isinf(area)[place]] = 0
    rise_b, rise_c = (near_b - near_a)[place], (near_c - near_a)[place]
    slope = slopes_u[0, place] * rise_b + slopes_v[0, place] * rise_c
    return _Rows(triangle, start, count, y, near_a[place] + u * rise_b + v * rise_c, slope)


def _fragments(rows: _Rows, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return triangle, pixel index (row by row) and inverse depth of each pixel in the given runs."""
    kept = np.flatnonzero(rows.count)
    count = rows.count[kept]
    row = np.repeat(kept, count)
    x = np.arange(len(row)) + np.repeat(rows.first[kept] - np.cumsum(count) + count, count)
    return rows.triangle[row], rows.y[row] * width + x, rows.nearness[row] + rows.slope[row] * x
