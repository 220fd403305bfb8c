"""Appearance of a URDF's links: visual shapes and mesh files, which are not read before the robot is drawn."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from ._collada import Triangles
from ._meshes import read_mesh
from ._packages import Packages
from ._urdf_elements import Link, Shape, Urdf

GEOMS = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
}
_NEAR = 3
"""Number of folders above a URDF that are searched for a mesh whose package has another name there."""
_Y_TO_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclasses.dataclass(frozen=True)
class LinkShape:
    """A shape of a link, in the link's frame."""

    link: str  # name of the link
    kind: mujoco.mjtGeom  # MuJoCo's geom type
    size: Float[np.ndarray, "3"]  # MuJoCo's geom sizes [m]
    # centre of a simple shape [m]; 0 for a mesh, whose vertices are in the link's frame
    position: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]  # rotation of a simple shape in the link's frame
    color: tuple[float, ...] | None  # red, green, blue, alpha, 0 to 1; ``None``: the URDF gives none
    mesh: tuple[np.ndarray, np.ndarray] | None = None  # vertices (k, 3) [m] and triangles (m, 3) of a mesh


@dataclasses.dataclass(frozen=True)
class Look:
    """Visual shapes of a robot's links."""

    shapes: tuple[LinkShape, ...]
    missing: tuple[str, ...]  # addresses of mesh files that were not found or could not be read


def geom_size(shape: Shape) -> list[float]:
    """Return MuJoCo's sizes: radius first, then half lengths."""
    if shape.kind == "box":
        return [edge / 2.0 for edge in shape.size]
    radius, *length = shape.size
    return [radius, *(value / 2.0 for value in length), 0.0, 0.0][:3]


class UnreadLook:
    """Visual shapes of a URDF and their meshes (DAE, STL, OBJ, MSH), whose files are read at most once, when asked for.

    Some programs turn COLLADA files whose ``up_axis`` is y, others (RViz) do not, and URDFs are made for either. Of
    both ways that one is taken that puts the meshes nearer to the joints of their links.

    Of a link whose visual meshes cannot be read, and of all links where the URDF has no visual shape, the collision
    shapes are taken. Last of all, the rest of a ``package://`` address is looked for in the folders above the file,
    whatever the package is called there. ``beside`` is the path of the URDF; None if it was given as text.
    """

    def __init__(self, urdf: Urdf, packages: Packages, beside: Path | None) -> None:
        self._urdf, self._packages, self._beside = urdf, packages, beside
        self._parts: dict[str, list[Triangles]] = {}
        self._turned = False

    @cached_property
    def read(self) -> Look:
        """Return the shapes."""
        visible = any(shape.visual for link in self._urdf.links.values() for shape in link.shapes)
        shapes = self._shapes(visual=visible, turned=False)
        if any(part.y_up for parts in self._parts.values() for part in parts):
            shapes = min(shapes, self._shapes(visual=visible, turned=True), key=self._from_joints)
        return Look(shapes, tuple(address for address, parts in self._parts.items() if not parts))

    def _shapes(self, *, visual: bool, turned: bool) -> tuple[LinkShape, ...]:
        self._turned = turned
        return tuple(shape for link in self._urdf.links.values() for shape in self._link(link, visual=visual))

    def _from_joints(self, shapes: tuple[LinkShape, ...]) -> float:
        """Return the sum of the distances [m] from the links' joints to the bounding boxes of the links' meshes."""
        ends: dict[str, list[np.ndarray]] = {link: [np.zeros(3)] for link in self._urdf.links}
        for joint in self._urdf.joints:
            ends[joint.parent].append(joint.origin.position)
        points: dict[str, list[np.ndarray]] = {}
        for shape in shapes:
            if shape.mesh is not None:
                points.setdefault(shape.link, []).append(shape.mesh[0])
        total = 0.0
        for link, groups in points.items():
            low, high = np.min([g.min(0) for g in groups], 0), np.max([g.max(0) for g in groups], 0)
            places = np.array(ends[link])
            total += float(np.linalg.norm(places - np.clip(places, low, high), axis=-1).sum())
        return total

    def _link(self, link: Link, *, visual: bool) -> list[LinkShape]:
        """Return a link's visual shapes, or its collision shapes if a visual shape cannot be read."""
        opaque = [shape for shape in link.shapes if shape.color is None or shape.color[3] > 0.0]
        wanted = [shape for shape in opaque if shape.visual == visual]
        readable = all(shape.kind != "mesh" or self._triangles(shape) for shape in wanted)
        if readable or not visual:
            return [part for shape in wanted for part in self._shape(link.name, shape)]
        simpler = [part for shape in link.shapes if not shape.visual for part in self._shape(link.name, shape)]
        return simpler or [part for shape in wanted for part in self._shape(link.name, shape)]

    def _shape(self, link: str, shape: Shape) -> Iterator[LinkShape]:
        position, rotation = shape.pose
        if shape.kind != "mesh":
            yield LinkShape(link, GEOMS[shape.kind], np.array(geom_size(shape)), position, rotation, shape.color)
            return
        scale = np.array(shape.size)
        for part in self._triangles(shape):
            own = part.vertices @ _Y_TO_Z.T if part.y_up and self._turned else part.vertices
            vertices = (own * scale) @ rotation.T + position
            faces = part.faces[:, ::-1] if np.prod(scale) < 0.0 else part.faces
            yield LinkShape(
                link, mujoco.mjtGeom.mjGEOM_MESH, np.zeros(3), np.zeros(3), np.eye(3),
                part.color or shape.color, (vertices, faces),
            )  # fmt: skip

    def _triangles(self, shape: Shape) -> list[Triangles]:
        """Return the triangles of a mesh file; empty if the file cannot be read."""
        if shape.file not in self._parts:
            try:
                self._parts[shape.file] = read_mesh(self._path(shape.file))
            except (OSError, ValueError):
                self._parts[shape.file] = []
        return self._parts[shape.file]

    def _path(self, address: str) -> Path:
        try:
            return self._packages.path(address, beside=self._beside)
        except FileNotFoundError:
            rest = address.partition("://")[2].lstrip("/").partition("/")[2]
            above = () if self._beside is None or not rest else self._beside.absolute().parents[: _NEAR + 1]
            for folder in above:
                if (folder / rest).is_file():
                    return folder / rest
            raise
