"""Pictures by MuJoCo's ray casting on the CPU: exact surfaces and shadows without GL."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from ._stage import TO_LAMP, Camera, Stage

Image = Float[np.ndarray, "height width 3"]
"""Picture with red, green and blue from 0 to 1. (height, width, 3)."""

_TILES = np.array([[0.925, 0.937, 0.952], [0.968, 0.975, 0.985]])
_SHADOW_MAP = 112
_CORNERS = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), -1).reshape(8, 3)
_SUBPIXELS = np.array([[0.125, 0.625], [0.375, 0.125], [0.625, 0.875], [0.875, 0.375]])


class _Hits(NamedTuple):
    geom: np.ndarray
    distance: np.ndarray
    normal: np.ndarray


class RayCaster:
    """Ray-casting renderer of a stage with a fixed camera.

    Attributes:
        camera: the camera.
        size: width and height of the pictures [pixels].
    """

    def __init__(self, stage: Stage, camera: Camera, size: tuple[int, int], *, floor: float) -> None:
        """Draw the empty floor at height ``floor`` [m], once for all pictures."""
        self.stage, self.camera, self.size, self._floor = stage, camera, size, floor
        # far enough for nearly parallel light
        self._lamp = np.asarray(camera.center) + 6.0 * camera.height * TO_LAMP
        self._background, self._ground = self._empty_floor()

    def image(self, data: mujoco.MjData, under: Float[np.ndarray, "height width 4"] | None = None) -> Image:
        """Return a picture of the stage, posed by ``Stage.pose``.

        ``under`` is painted on the floor with shadows, behind the robots: red, green, blue and alpha from 0 to 1, alpha
        not multiplied in.
        """
        picture = self._background * self._shadow(data)[..., None]
        if under is not None:
            picture += under[..., 3:] * (under[..., :3] - picture)
        rows, columns = np.nonzero(self._near_robots(data))
        color, cover = self._robots(data, rows, columns)
        picture[rows, columns] = (1.0 - cover[:, None]) * picture[rows, columns] + color
        return picture

    def _robots(self, data: mujoco.MjData, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the robots' colours times coverage, and their coverage, in some pixels.

        Pixels at edges get four rays.
        """
        corners = np.stack([columns, rows], -1).astype(float)
        rays = self.camera.rays(corners + 0.5, self.size)
        hits = self._cast(data, self.camera.eye, rays)
        color = self._shade(data, rays, hits)
        cover = (hits.geom >= 0).astype(float)
        edge = np.flatnonzero(self._edges(rows, columns, hits))
        fine = self.camera.rays((corners[edge, None] + _SUBPIXELS).reshape(-1, 2), self.size)
        fine_hits = self._cast(data, self.camera.eye, fine)
        color[edge] = self._shade(data, fine, fine_hits).reshape(-1, len(_SUBPIXELS), 3).mean(1)
        cover[edge] = (fine_hits.geom >= 0).reshape(-1, len(_SUBPIXELS)).mean(1)
        return color, cover

    def _edges(self, rows: np.ndarray, columns: np.ndarray, hits: _Hits) -> np.ndarray:
        """Return whether each pixel touches a pixel of another geom or of a face with another normal."""
        if not len(rows):
            return np.zeros(0, bool)
        y, x = rows - rows.min(), columns - columns.min()
        shape = (y.max() + 1, x.max() + 1)
        geom, normal = np.full(shape, -1, np.int32), np.zeros((*shape, 3))
        geom[y, x], normal[y, x] = hits.geom, hits.normal
        return _edges(geom, normal)[y, x]

    def _near_robots(self, data: mujoco.MjData) -> np.ndarray:
        """Return the pixels that the geoms' bounding boxes may cover. (height, width)."""
        boxes, turns = self.stage.model.geom_aabb, data.geom_xmat.reshape(-1, 3, 3)
        corners = boxes[:, None, :3] + boxes[:, None, 3:] * _CORNERS
        places = self.camera.project(data.geom_xpos[:, None] + corners @ turns.mT, self.size)
        first = np.maximum(np.floor(places.min(1)).astype(int), 0)
        last = np.ceil(places.max(1)).astype(int)
        inside = np.zeros((self.size[1], self.size[0]), bool)
        for (left, top), (right, bottom) in zip(first, last, strict=True):
            inside[top : max(bottom, 0), left : max(right, 0)] = True
        return inside

    def _cast(self, data: mujoco.MjData, origin: np.ndarray, rays: Float[np.ndarray, "n 3"]) -> _Hits:
        n = len(rays)
        geom, distance, normal = np.full(n, -1, np.int32), np.zeros(n), np.zeros(3 * n)
        flat = np.ascontiguousarray(rays).ravel()
        mujoco.mj_multiRay(
            self.stage.model, data, origin, flat, None, 1, -1, geom, distance, normal, n, mujoco.mjMAXVAL
        )
        return _Hits(geom, distance, normal.reshape(n, 3))

    def _shade(self, data: mujoco.MjData, rays: Float[np.ndarray, "n 3"], hits: _Hits) -> Float[np.ndarray, "n 3"]:
        """Return the colours of hit points under a sky and a lamp with shadows; 0 for rays that hit nothing."""
        color = np.zeros((len(rays), 3))
        seen = np.flatnonzero(hits.geom >= 0)
        if not len(seen):
            return color
        n, ray = hits.normal[seen], rays[seen]
        n = n * np.where(np.sum(n * ray, -1, keepdims=True) > 0.0, -1.0, 1.0)  # meshes may be turned inside out
        point = self.camera.eye + hits.distance[seen, None] * ray
        lit = np.zeros(len(seen))
        turned = np.flatnonzero(n @ TO_LAMP > 0.0)  # only these faces can be in another part's shadow
        # lifted off the surface, or rounding would put points in their own shadow
        lit[turned] = self._lit(data, (point + 1e-3 * self.camera.height * n)[turned])
        color[seen] = light(self.stage.colors[hits.geom[seen]], n, ray, lit)
        return color

    def _lit(self, data: mujoco.MjData, points: Float[np.ndarray, "n 3"]) -> np.ndarray:
        """Return whether the lamp lights each point."""
        way = points - self._lamp
        length = np.linalg.norm(way, axis=-1)
        hits = self._cast(data, self._lamp, way / length[:, None])
        return (hits.geom < 0) | (hits.distance > length)

    def _shadow(self, data: mujoco.MjData) -> Float[np.ndarray, "height width"]:
        """Return the fraction of the light that each pixel of the floor receives; shadows have soft edges."""
        center, radius = data.geom_xpos, self.stage.model.geom_rbound[:, None]
        way = center - self._lamp
        foot = self._lamp + way * ((self._floor - self._lamp[2]) / way[:, 2:])
        # a slanted lamp stretches the shadow of a sphere along the floor
        low, high = (foot[:, :2] - 2.5 * radius).min(0), (foot[:, :2] + 2.5 * radius).max(0)
        step = (high - low) / (_SHADOW_MAP - 1)
        i, j = np.mgrid[:_SHADOW_MAP, :_SHADOW_MAP]
        grid = np.stack([low[0] + i * step[0], low[1] + j * step[1], np.full(i.shape, self._floor)], -1)
        dark = 1.0 - self._lit(data, grid.reshape(-1, 3)).reshape(i.shape)
        # blurred by the same length in the world along both axes of the map
        soft = ndimage.gaussian_filter(dark, 0.012 * self.camera.height / step)
        place = np.moveaxis((self._ground - low) / step, -1, 0)
        keep = np.ones(self._ground.shape[:2], np.float32)
        under = ((place > 0.0) & (place < _SHADOW_MAP - 1.0)).all(0)
        keep[under] -= 0.30 * ndimage.map_coordinates(soft, place[:, under], order=1)
        return keep

    def _empty_floor(self) -> tuple[Image, Float[np.ndarray, "height width 2"]]:
        """Return a chequered floor that fades into white, and each pixel's floor point [m] (far away for the sky)."""
        y, x = np.mgrid[: self.size[1], : self.size[0]]
        pixels = np.stack([x, y], -1).reshape(-1, 2).astype(float)
        samples = [self._floor_color(self._floor_point(pixels + shift)) for shift in _SUBPIXELS]
        shape = (self.size[1], self.size[0])
        ground = self._floor_point(pixels + 0.5)
        return np.mean(samples, 0).reshape(*shape, 3).astype(np.float32), ground.reshape(*shape, 2)

    def _floor_point(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        rays = self.camera.rays(pixels, self.size)
        # rays towards the sky never meet the floor: the guard keeps the quotient finite
        down = np.minimum(rays[:, 2:], -1e-6)
        far = 1e3 * self.camera.height
        reach = np.where(rays[:, 2:] < 0.0, (self._floor - self.camera.eye[2]) / down, far)
        return self.camera.eye[:2] + np.minimum(reach, far) * rays[:, :2]

    def _floor_color(self, point: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        tile = np.floor(point / _round_length(0.2 * self.camera.height)).astype(int).sum(-1) % 2
        distance = np.linalg.norm(point - np.asarray(self.camera.center[:2]), axis=-1) / self.camera.height
        fade = np.clip(distance / 2.2, 0.0, 1.0)[:, None]
        return _TILES[tile] + fade * (1.0 - _TILES[tile])


def light(
    colors: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    rays: Float[np.ndarray, "n 3"],
    lit: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3"]:
    """Return the colours of points under a bright sky and one lamp.

    Normals point towards the camera, rays away from it, both of unit length. ``lit`` is the share of the lamp that each
    point sees, 0 (in shadow) to 1.
    """
    lamp = lit * np.clip(normals @ TO_LAMP, 0.0, 1.0)
    half = TO_LAMP - rays
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    shine = np.clip(np.sum(normals * half, -1), 0.0, 1.0) ** 40 * (lamp > 0.0)
    facing = np.clip(-np.sum(normals * rays, -1), 0.0, 1.0)
    # ambient light, light from the sky, the lamp, and a weak light from the camera
    shades = 0.40 + 0.13 * normals[:, 2] + 0.40 * lamp + 0.14 * facing
    return np.clip(colors * shades[:, None] + 0.16 * shine[:, None], 0.0, 1.0)


def _round_length(value: float) -> float:
    """Return the largest of ..., 0.1, 0.2, 0.5, 1, ... that does not exceed a length, as the size of a floor tile."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(m for m in (1.0, 2.0, 5.0) if m * power <= value * (1.0 + 1e-9)))


def _edges(geom: np.ndarray, normal: Float[np.ndarray, "h w 3"]) -> np.ndarray:
    """Return the pixels beside another geom or beside a face with another normal."""
    edge = np.zeros(geom.shape, bool)
    halves = (np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])
    for first, second in halves:
        # faces that meet at more than 60 degrees
        crease = np.einsum("ijk,ijk->ij", normal[first], normal[second]) < 0.5
        differs = (geom[first] != geom[second]) | (crease & (geom[first] >= 0))
        edge[first] |= differs
        edge[second] |= differs
    return edge
