"""Shapes of a robot for pictures (visual shapes of its URDF, its geoms, or sticks), posed by MuJoCo's kinematics."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterable
from typing import Literal

import mujoco
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, QhullError

from .._errors import OsikValueError
from ..collision import CollisionShape
from ..collision._geometry import Kind
from ..robot import Robot
from ..robot._mujoco import home_poses, model_bodies
from ..robot.loading._look import Look
from ..robot.loading._poses import rotation_matrix

_GEOM = mujoco.mjtGeom
_DRAWN = range(int(_GEOM.mjGEOM_SPHERE), int(_GEOM.mjGEOM_MESH) + 1)
"""Geom types that are drawn: sphere, capsule, ellipsoid, cylinder, box and mesh."""
_PLAIN = np.array([0.80, 0.82, 0.86, 1.0])
_STICK = np.array([0.42, 0.49, 0.60, 1.0])
_JOINT = np.array([0.93, 0.50, 0.13, 1.0])
_KINDS = {
    Kind.SEGMENT: _GEOM.mjGEOM_CAPSULE,
    Kind.BOX: _GEOM.mjGEOM_BOX,
    Kind.CYLINDER: _GEOM.mjGEOM_CYLINDER,
}
_ORANGE = np.array([0.95, 0.61, 0.22, 1.0])
_MUJOCO_DEFAULT = np.array([0.5, 0.5, 0.5, 1.0])
_HIDDEN_GROUP = 3
"""First geom group of collision shapes by MuJoCo's convention; its viewer hides these groups."""


@dataclasses.dataclass(frozen=True)
class Part:
    """One shape of a robot."""

    kind: mujoco.mjtGeom  # MuJoCo's geom type
    size: np.ndarray  # MuJoCo's geom sizes [m]. (3,)
    color: np.ndarray  # red, green, blue, alpha. (4,)
    mesh: tuple[np.ndarray, np.ndarray] | None = None  # vertices (k, 3) [m] and triangles (m, 3) of a mesh

    @functools.cached_property
    def corners(self) -> Float[np.ndarray, "8 3"]:
        """Return the corners of the part's bounding box, in the part's frame [m]."""
        ends = [(-self.reach(-axis), self.reach(axis)) for axis in np.eye(3)]
        return np.array(list(itertools.product(*ends)))

    @functools.cached_property
    def hull(self) -> Float[np.ndarray, "k 3"]:
        """Return the vertices of a mesh's convex hull, in the part's frame [m]."""
        vertices = np.zeros((0, 3)) if self.mesh is None else self.mesh[0]
        try:
            return vertices[ConvexHull(vertices).vertices]
        except (QhullError, ValueError):  # flat, or hardly any points
            return vertices

    def reach(self, way: Float[np.ndarray, "3"]) -> float:
        """Return the largest coordinate of the part along a unit vector, from the part's origin [m]."""
        if self.mesh is not None:
            return float((self.hull @ way).max())
        radius, length, _ = self.size
        match self.kind:
            case _GEOM.mjGEOM_SPHERE:
                return float(radius)
            case _GEOM.mjGEOM_CAPSULE:
                return float(radius + length * abs(way[2]))
            case _GEOM.mjGEOM_CYLINDER:
                return float(radius * np.hypot(way[0], way[1]) + length * abs(way[2]))
            case _GEOM.mjGEOM_ELLIPSOID:
                return float(np.linalg.norm(self.size * way))
            case _:
                return float(np.abs(way) @ self.size)


@dataclasses.dataclass(frozen=True)
class RobotParts:
    """Shapes of a robot for pictures."""

    model: mujoco.MjModel  # the MuJoCo model
    style: Literal["look", "geoms", "sticks"]  # visual shapes of a URDF, geoms of the model, or sticks
    parts: tuple[Part, ...]  # the shapes
    bodies: Int[np.ndarray, " parts"]  # MuJoCo's index of the body that carries each part
    # position [m] and rotation of each part in its body; of sticks, which change with the configuration, the bodies
    # without children, and of each the farthest named point in its frame [m]
    anchors: tuple[np.ndarray, np.ndarray]
    rows: Int[np.ndarray, " parts"] | None = None  # of sticks: a dot's body, or the bodies' number and a line's number

    def corners(self, data: mujoco.MjData) -> Float[np.ndarray, "points 3"]:
        """Return the corners of the parts' bounding boxes in the world [m], which a camera must show."""
        position, rotation = self.poses(data)
        own = np.array([part.corners for part in self.parts]).reshape(-1, 8, 3)
        return (np.einsum("pij,pkj->pki", rotation, own) + position[:, None]).reshape(-1, 3)

    def poses(self, data: mujoco.MjData) -> tuple[Float[np.ndarray, "parts 3"], Float[np.ndarray, "parts 3 3"]]:
        """Return positions [m] and rotations of the parts in the world, from ``data`` after ``mj_kinematics``."""
        frames = data.xmat.reshape(-1, 3, 3)
        if self.rows is not None:
            start, end = _stick_ends(data, self.model.body_parentid, self.anchors)
            position = np.concatenate([data.xpos, 0.5 * (start + end)])
            return position[self.rows], np.concatenate([frames, _link_frames(end - start)])[self.rows]
        (shift, turn), frames = self.anchors, frames[self.bodies]
        return data.xpos[self.bodies] + np.einsum("pij,pj->pi", frames, shift), frames @ turn


def robot_parts(robot: Robot) -> RobotParts:
    """Return the shapes of a robot for pictures.

    They are the visual shapes of its URDF, else its geoms, if most moving bodies have a visible one. Else they are
    sticks: a line from each body to its parent, joints as dots.
    """
    model, unread = robot.mj_model, robot.holder.look
    if unread is not None:
        look = unread.read
        bodies = [model.body(shape.link).id for shape in look.shapes]
        if _cover(model, bodies):
            return _look_parts(model, look, bodies)
    geoms = _visible_geoms(model)
    if not _cover(model, model.geom_bodyid[geoms]):
        return _sticks(robot)
    turns = np.array([rotation_matrix(model.geom_quat[geom]) for geom in geoms])
    parts = tuple(_geom_part(model, geom) for geom in geoms)
    return RobotParts(model, "geoms", parts, model.geom_bodyid[geoms], (model.geom_pos[geoms], turns))


def _look_parts(model: mujoco.MjModel, look: Look, bodies: list[int]) -> RobotParts:
    parts = tuple(
        Part(shape.kind, shape.size, _PLAIN if shape.color is None else np.asarray(shape.color), shape.mesh)
        for shape in look.shapes
    )
    places = np.array([s.position for s in look.shapes]), np.array([s.rotation for s in look.shapes])
    return RobotParts(model, "look", parts, np.array(bodies), places)


def _cover(model: mujoco.MjModel, bodies: Iterable[int]) -> bool:
    """Return whether two thirds of the moving bodies carry a shape, themselves or through a fixed body.

    A body that only joins another to its own place, such as one of three that make a ball joint, does not count.
    """
    drawn = {int(model.body_weldid[body]) for body in bodies}
    children = [np.flatnonzero(model.body_parentid == body) for body in range(model.nbody)]
    apart = [not len(below) or np.any(model.body_pos[below]) for below in children]
    moving = {int(body) for body in np.flatnonzero(model.body_jntnum) if apart[body]}
    return 3 * len(drawn & moving) >= 2 * len(moving)


def _visible_geoms(model: mujoco.MjModel) -> list[int]:
    """Return the geoms of the groups that MuJoCo's viewer shows, or all geoms if these groups are empty."""
    solid = [g for g in range(model.ngeom) if model.geom_type[g] in _DRAWN and _geom_color(model, g)[3] > 0.0]
    return [g for g in solid if model.geom_group[g] < _HIDDEN_GROUP] or solid


def _geom_part(model: mujoco.MjModel, geom: int) -> Part:
    kind = _GEOM(model.geom_type[geom])
    mesh = _mesh(model, int(model.geom_dataid[geom])) if kind == _GEOM.mjGEOM_MESH else None
    return Part(kind, model.geom_size[geom].copy(), _geom_color(model, geom), mesh)


def _mesh(model: mujoco.MjModel, index: int) -> tuple[np.ndarray, np.ndarray]:
    vertex, face = model.mesh_vertadr[index], model.mesh_faceadr[index]
    vertices = model.mesh_vert[vertex : vertex + model.mesh_vertnum[index]]
    return np.asarray(vertices, float), model.mesh_face[face : face + model.mesh_facenum[index]].copy()


def _geom_color(model: mujoco.MjModel, geom: int) -> np.ndarray:
    material = model.geom_matid[geom]
    color = np.asarray(model.geom_rgba[geom] if material < 0 else model.mat_rgba[material], float)
    return _PLAIN if np.allclose(color, _MUJOCO_DEFAULT) else color


def _sticks(robot: Robot) -> RobotParts:
    """Return dots on bodies with joints, and lines from each body to its parent and to its tip."""
    model, tips, data = robot.mj_model, _tips(robot), home_poses(robot)
    start, end = _stick_ends(data, model.body_parentid, tips)
    length = np.linalg.norm(end - start, axis=-1)
    length[: model.nbody][model.body_parentid == 0] = 0.0
    extent = float(np.linalg.norm(np.ptp(np.concatenate([start, end]), axis=0)))
    # thin beside typical links and beside the whole robot, also if one of both sizes is unusual
    radius = min(0.13 * float(np.median(length[length > 1e-6])), 0.02 * extent) if np.any(length > 1e-6) else 0.02
    dots, lines = np.flatnonzero(model.body_jntnum), np.flatnonzero(length > 1e-6)
    parts = (
        *(Part(_GEOM.mjGEOM_SPHERE, np.array([radius, 0.0, 0.0]), _JOINT) for _ in dots),
        *(Part(_GEOM.mjGEOM_CAPSULE, np.array([0.55 * radius, 0.5 * along, 0.0]), _STICK) for along in length[lines]),
    )
    ends = np.concatenate([np.arange(model.nbody), model.body_parentid, tips[0]])
    rows = np.concatenate([dots, model.nbody + lines])
    return RobotParts(model, "sticks", parts, ends[rows], tips, rows)


def _tips(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Return the bodies without children by MuJoCo's index, and the farthest named point of each in its frame [m]."""
    tree, bodies_of = robot.tree, model_bodies(robot)
    frame_bodies, points = np.asarray(tree.frame_bodies), np.asarray(robot.frame_position)
    bodies, tips = [], []
    for body in sorted(set(range(1, len(tree.body_names))) - set(tree.body_parents)):
        own = points[frame_bodies == body]
        bodies.append(bodies_of[body])
        tips.append(own[np.argmax(np.linalg.norm(own, axis=-1))])
    return np.array(bodies, int), np.array(tips).reshape(-1, 3)


def _stick_ends(
    data: mujoco.MjData, parents: np.ndarray, tips: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return start and end of each stick [m]: parent to body for each body, then last bodies to their tips."""
    bodies, points = tips
    reach = data.xpos[bodies] + np.einsum("bij,bj->bi", data.xmat.reshape(-1, 3, 3)[bodies], points)
    return np.concatenate([data.xpos[parents], data.xpos[bodies]]), np.concatenate([data.xpos, reach])


def _link_frames(along: Float[np.ndarray, "links 3"]) -> Float[np.ndarray, "links 3 3"]:
    """Return rotations whose z axis points along each link. (k, 3, 3)."""
    frames, quaternion = np.empty((len(along), 9)), np.empty(4)
    for frame, way in zip(frames, along, strict=True):
        mujoco.mju_quatZ2Vec(quaternion, way)
        mujoco.mju_quat2Mat(frame, quaternion)
    return frames.reshape(-1, 3, 3)


def fixed_parts(robot: Robot, shapes: Iterable[CollisionShape]) -> RobotParts:
    """Return shapes of the world as parts that the world's body carries."""
    shapes = tuple(shapes)
    for shape in shapes:
        if shape.frame is not None or shape.kind not in _KINDS:
            raise OsikValueError(
                f"a {shape.kind.name.lower()} on frame {shape.frame!r} is not drawn; shapes are spheres, capsules, "
                "boxes and cylinders of the world"
            )
    parts = tuple(Part(_geom_type(shape), np.asarray(shape.size, float), _ORANGE) for shape in shapes)
    positions = np.array([shape.position for shape in shapes], float).reshape(-1, 3)
    rotations = np.array([shape.rotation for shape in shapes], float).reshape(-1, 3, 3)
    return RobotParts(robot.mj_model, "look", parts, np.zeros(len(parts), int), (positions, rotations))


def _geom_type(shape: CollisionShape) -> mujoco.mjtGeom:
    """Return MuJoCo's geom type; a segment of length 0 is a sphere."""
    is_sphere = shape.kind is Kind.SEGMENT and float(shape.size[1]) == 0.0
    return _GEOM.mjGEOM_SPHERE if is_sphere else _KINDS[shape.kind]


def lowest_points(shape: RobotParts, data: mujoco.MjData) -> Float[np.ndarray, " parts"]:
    """Return the height of each part's lowest point in the world [m]; exact for meshes, boxes and round shapes."""
    position, rotation = shape.poses(data)
    down = -rotation[:, 2]  # in each part's frame
    return position[:, 2] - np.array([part.reach(way) for part, way in zip(shape.parts, down, strict=True)])


def base_height(shape: RobotParts, heights: Float[np.ndarray, " parts"]) -> float:
    """Return the height of the lowest point of what is fixed to the world [m]; 0 where nothing of that is drawn."""
    base = heights[shape.model.body_weldid[shape.bodies] == 0]
    return float(base.min()) if len(base) else 0.0


def floor_height(robot: Robot, shape: RobotParts, poses: Iterable[mujoco.MjData]) -> float:
    """Return the floor's height [m]: a floating robot's lowest point in the first frame, or its base's height.

    Where a robot that is bolted down reaches below its base, the floor is under the lowest point of all poses.
    """
    first, *others = (lowest_points(shape, data) for data in poses)
    if robot.floating_base:
        return float(first.min())
    return min(base_height(shape, first), *(float(heights.min()) for heights in (first, *others)))
