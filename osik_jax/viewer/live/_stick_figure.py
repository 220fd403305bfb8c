"""Stick figure of a person in a page that plays a retargeted motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from .._parts import Part
from ._surfaces import part_triangles

if TYPE_CHECKING:
    from viser import SceneApi

_BONE, _STANDS = (96, 107, 120), (42, 157, 98)
_THICK, _BALL = 0.012, 0.022
"""Radii of bones and of contact points, as shares of the person's size."""


class StickFigure(NamedTuple):
    """Joints of a person over time."""

    points: Float[np.ndarray, "F J 3"]  # positions [m]
    bones: tuple[tuple[int, int], ...]  # pairs of joints
    standing: tuple[int, ...]  # the points that may touch the floor. (4,) or ()
    contact: Bool[np.ndarray, "F 4"]  # whether each of these stands

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> StickFigure | None:
        """Return the person in a ``motion.npz`` of retargeting, or None if the file has none."""
        if not {"human", "human_bones", "human_standing", "contact"} <= arrays.keys():
            return None
        bones = tuple((int(a), int(b)) for a, b in arrays["human_bones"])
        standing = tuple(int(k) for k in arrays["human_standing"])
        return cls(np.asarray(arrays["human"], float), bones, standing, np.asarray(arrays["contact"], bool))

    def sized(self, like: Float[np.ndarray, "k 3"], path: Float[np.ndarray, "T 3"], floor: float) -> StickFigure:
        """Return the figure as large as a robot, standing on a floor.

        The last point is the root. Its path is scaled with the figure, if it is not the robot's already. ``like`` are
        points of the robot in its first frame, ``path`` is that of its base, ``floor`` a height, all in metres.
        """
        size, own = (float(np.linalg.norm(np.ptp(points, axis=0))) for points in (like, self.points[0]))
        scale, root = size / max(own, 1e-9), self.points[:, -1:]
        far, there = (float(np.linalg.norm(np.ptp(track[:, :2], axis=0))) for track in (path, root[:, 0]))
        along = 1.0 if abs(far - there) < abs(far - scale * there) else scale
        points = scale * (self.points - root) + root * [along, along, scale]
        points[..., 2] += floor - points[0, :, 2].min()
        return self._replace(points=points)


class StickNodes:
    """Scene nodes of a stick figure: a capsule per bone, and a ball at each point that stands."""

    def __init__(self, scene: SceneApi, figure: StickFigure, offset: Float[np.ndarray, "3"]) -> None:
        """Add the figure, moved by an offset [m], as it is in the first frame."""
        self._figure = figure
        size = float(np.linalg.norm(np.ptp(figure.points[0], axis=0)))
        scene.add_frame("/person", show_axes=False, position=offset)
        first, second = (figure.points[:, [bone[k] for bone in figure.bones]] for k in range(2))
        lengths = np.median(np.linalg.norm(second - first, axis=-1), axis=0)
        self._bones = []
        for k, length in enumerate(lengths):
            shape = np.array([_THICK * size, 0.5 * length, 0.0])
            surface = part_triangles(Part(mujoco.mjtGeom.mjGEOM_CAPSULE, shape, np.ones(4), None))
            self._bones.append(scene.add_mesh_simple(f"/person/{k}", surface.vertices, surface.faces, color=_BONE))
        self._standing = [
            scene.add_icosphere(f"/person/stands {k}", radius=_BALL * size, color=_STANDS, visible=False)
            for k in figure.standing
        ]
        self.place(0)

    def place(self, frame: int) -> None:
        """Move the figure to a frame."""
        points, turn = self._figure.points[frame], np.zeros(4)
        for node, (a, b) in zip(self._bones, self._figure.bones, strict=True):
            mujoco.mju_quatZ2Vec(turn, points[b] - points[a])
            node.position, node.wxyz = 0.5 * (points[a] + points[b]), turn.copy()
        for node, at, stands in zip(self._standing, self._figure.standing, self._figure.contact[frame], strict=False):
            node.position = points[at]
            if node.visible != stands:
                node.visible = bool(stands)
