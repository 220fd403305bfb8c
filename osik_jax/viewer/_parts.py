"""What a robot looks like: its geoms, or sticks where it has none, placed by MuJoCo's kinematics."""

from __future__ import annotations

import dataclasses
from typing import Literal

import mujoco
import numpy as np
from jaxtyping import Float

from ..robot import Robot
from ._mujoco import model_bodies, mujoco_poses

Style = Literal["auto", "geoms", "sticks"]

_GEOM = mujoco.mjtGeom
_DRAWN = [
    int(kind)
    for kind in (
        _GEOM.mjGEOM_SPHERE,
        _GEOM.mjGEOM_CAPSULE,
        _GEOM.mjGEOM_ELLIPSOID,
        _GEOM.mjGEOM_CYLINDER,
        _GEOM.mjGEOM_BOX,
        _GEOM.mjGEOM_MESH,
    )
]
_PLAIN = np.array([0.80, 0.82, 0.86, 1.0])
_STICK = np.array([0.42, 0.49, 0.60, 1.0])
_JOINT = np.array([0.93, 0.50, 0.13, 1.0])
_MUJOCO_DEFAULT = np.array([0.5, 0.5, 0.5, 1.0])
_HIDDEN_GROUP = 3
"""Groups from here on hold collision shapes by MuJoCo's convention; its own viewer hides them."""


@dataclasses.dataclass(frozen=True)
class Part:
    """One shape of a robot.

    Attributes:
        index: which row of ``RobotParts.poses`` places it.
        kind: MuJoCo's geom type.
        size: MuJoCo's geom sizes [m]. (3,)
        color: red, green, blue, alpha. (4,)
        mesh: vertices (k, 3) [m] and triangles (m, 3) of a mesh.
    """

    index: int
    kind: mujoco.mjtGeom
    size: np.ndarray
    color: np.ndarray
    mesh: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def radius(self) -> float:
        """Of a ball about its origin that holds it [m]."""
        if self.mesh is not None:
            return float(np.linalg.norm(self.mesh[0], axis=-1).max())
        match self.kind:
            case _GEOM.mjGEOM_SPHERE:
                return float(self.size[0])
            case _GEOM.mjGEOM_CAPSULE:
                return float(self.size[0] + self.size[1])
            case _GEOM.mjGEOM_ELLIPSOID:
                return float(self.size.max())
            case _GEOM.mjGEOM_CYLINDER:
                return float(np.hypot(self.size[0], self.size[1]))
            case _:
                return float(np.linalg.norm(self.size))


@dataclasses.dataclass(frozen=True)
class RobotParts:
    """The shapes of a robot.

    Attributes:
        model: the MuJoCo model.
        style: ``"geoms"`` or ``"sticks"``.
        parts: the shapes.
        tips: of sticks: bodies without children, and of each the farthest named point in its frame [m].
    """

    model: mujoco.MjModel
    style: Literal["geoms", "sticks"]
    parts: tuple[Part, ...]
    tips: tuple[np.ndarray, np.ndarray]

    @property
    def radii(self) -> Float[np.ndarray, " parts"]:
        """Of balls about the parts' origins that hold them [m]."""
        return np.array([part.radius for part in self.parts])

    def poses(self, data: mujoco.MjData) -> tuple[Float[np.ndarray, "parts 3"], Float[np.ndarray, "parts 3 3"]]:
        """Positions [m] and rotations of the parts in the world, as ``mj_kinematics`` left them in ``data``."""
        if self.style == "geoms":
            position, rotation = data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3)
        else:
            start, end = _stick_ends(data, self.model.body_parentid, self.tips)
            position = np.concatenate([data.xpos, 0.5 * (start + end)])
            rotation = np.concatenate([data.xmat.reshape(-1, 3, 3), _link_frames(end - start)])
        index = [part.index for part in self.parts]
        return position[index], rotation[index]


def robot_parts(robot: Robot, *, style: Style = "auto") -> RobotParts:
    """The shapes of a robot.

    Args:
        robot: the robot.
        style: ``"geoms"``, ``"sticks"`` (a line from each body to its parent, joints as dots), or ``"auto"``:
            geoms where most of the bodies that move have a visible one.

    Raises:
        ValueError: ``style="geoms"`` of a model that has no visible geom.
    """
    model = robot.mj_model
    geoms = () if style == "sticks" else tuple(_geom_part(model, g) for g in _visible_geoms(model))
    if geoms and (style == "geoms" or _cover(model, geoms)):
        return RobotParts(model, "geoms", geoms, _tips(robot))
    if style == "geoms":
        raise ValueError("the model has no geom to draw; use style='sticks'")
    tips = _tips(robot)
    return RobotParts(model, "sticks", _sticks(robot, tips), tips)


def _cover(model: mujoco.MjModel, geoms: tuple[Part, ...]) -> bool:
    """Whether two thirds of the bodies with joints have a geom, on themselves or on what is fixed to them."""
    drawn = {int(model.body_weldid[model.geom_bodyid[part.index]]) for part in geoms}
    moving = {int(body) for body in np.flatnonzero(model.body_jntnum)}
    return 3 * len(drawn & moving) >= 2 * len(moving)


def _visible_geoms(model: mujoco.MjModel) -> list[int]:
    """Geoms of the groups that MuJoCo's viewer shows, of any group where those hold none."""
    solid = [g for g in range(model.ngeom) if model.geom_type[g] in _DRAWN and _geom_color(model, g)[3] > 0.0]
    return [g for g in solid if model.geom_group[g] < _HIDDEN_GROUP] or solid


def _geom_part(model: mujoco.MjModel, geom: int) -> Part:
    kind = _GEOM(model.geom_type[geom])
    mesh = _mesh(model, int(model.geom_dataid[geom])) if kind == _GEOM.mjGEOM_MESH else None
    return Part(geom, kind, model.geom_size[geom].copy(), _geom_color(model, geom), mesh)


def _mesh(model: mujoco.MjModel, index: int) -> tuple[np.ndarray, np.ndarray]:
    vertex, face = model.mesh_vertadr[index], model.mesh_faceadr[index]
    vertices = model.mesh_vert[vertex : vertex + model.mesh_vertnum[index]]
    return np.asarray(vertices, float), model.mesh_face[face : face + model.mesh_facenum[index]].copy()


def _geom_color(model: mujoco.MjModel, geom: int) -> np.ndarray:
    material = model.geom_matid[geom]
    color = np.asarray(model.geom_rgba[geom] if material < 0 else model.mat_rgba[material], float)
    return _PLAIN if np.allclose(color, _MUJOCO_DEFAULT) else color


def _sticks(robot: Robot, tips: tuple[np.ndarray, np.ndarray]) -> tuple[Part, ...]:
    """Dots on the bodies with joints; links, as long as at ``q0``, from each body to its parent and from tips on."""
    model, data = robot.mj_model, next(mujoco_poses(robot, np.asarray(robot.q0)))
    start, end = _stick_ends(data, model.body_parentid, tips)
    length = np.linalg.norm(end - start, axis=-1)
    length[: model.nbody][model.body_parentid == 0] = 0.0
    extent = float(np.linalg.norm(np.ptp(np.concatenate([start, end]), axis=0)))
    radius = min(0.13 * float(np.median(length[length > 1e-6])), 0.02 * extent) if np.any(length > 1e-6) else 0.02
    dots = [b for b in range(1, model.nbody) if model.body_jntnum[b]]
    return (
        *(Part(body, _GEOM.mjGEOM_SPHERE, np.array([radius, 0.0, 0.0]), _JOINT) for body in dots),
        *(
            Part(model.nbody + link, _GEOM.mjGEOM_CAPSULE, np.array([0.55 * radius, 0.5 * length[link], 0.0]), _STICK)
            for link in np.flatnonzero(length > 1e-6)
        ),
    )


def _tips(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Bodies without children, by MuJoCo's index, and of each the farthest named point, in the body's frame [m]."""
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
    """Where the links start and end [m]: from each body's parent to it, then from the last bodies to their tips."""
    bodies, points = tips
    reach = data.xpos[bodies] + np.einsum("bij,bj->bi", data.xmat.reshape(-1, 3, 3)[bodies], points)
    return np.concatenate([data.xpos[parents], data.xpos[bodies]]), np.concatenate([data.xpos, reach])


def _link_frames(along: Float[np.ndarray, "links 3"]) -> Float[np.ndarray, "links 3 3"]:
    """Rotations whose z runs along each link."""
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    z = np.where(length > 0.0, along / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])
    x = np.cross(np.where(np.abs(z[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]), z)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], -1)
