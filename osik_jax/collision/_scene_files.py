"""Readers of scenes: MuJoCo XML and URDF."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np

from .._errors import OsikValueError
from ..robot.loading._meshes import unread_points
from ..robot.loading._mjmodel import element_names
from ..robot.loading._packages import Packages
from ..robot.loading._poses import Pose
from ..robot.loading._source import Source, check_root, parse_xml, read_source
from ..robot.loading._urdf import unread_meshes, urdf_spec
from ..robot.loading._urdf_elements import read_urdf
from ._convex import ConvexShape, ShapeKind, hull_vertices, model_shape

Objects = dict[str, list[ConvexShape]]


def read_scene(path: str | os.PathLike[str]) -> Objects:
    """Return the shapes of each object of a scene's file; see ``Scene.from_file``."""
    if Path(path).suffix.lower() not in (".xml", ".urdf", ".mjcf"):
        raise OsikValueError(f"{os.fspath(path)!r} is no scene: there are .xml, .mjcf and .urdf")
    if not Path(path).is_file():
        raise FileNotFoundError(f"no scene file {os.fspath(path)!r}")
    source = read_source(path, "scene")
    root = parse_xml(source)
    if root.tag != "robot":
        check_root(root, "mujoco", source)
    try:
        if root.tag == "robot":
            return _urdf_objects(root, source)
        return _objects(mujoco.MjModel.from_xml_path(str(path)))
    except ValueError as error:
        raise OsikValueError(f"{source.label}: {error}") from None


def _urdf_objects(root: ElementTree.Element, source: Source) -> Objects:
    """Return the collision shapes of a URDF; meshes are their convex hulls."""
    urdf = read_urdf(root)
    model = urdf_spec(urdf).compile()
    data, objects = mujoco.MjData(model), _objects(model)
    mujoco.mj_kinematics(model, data)
    for name, mesh in unread_meshes(urdf, Packages(), source.path):
        is_root = mesh.link == urdf.root
        body = 0 if is_root else model.body(mesh.link).id
        carrier = Pose(data.xpos[body], data.xmat[body].reshape(3, 3))
        pose = carrier @ Pose(np.array(mesh.position), np.array(mesh.rotation))
        shape = ConvexShape(ShapeKind.HULL, np.zeros(3), *pose, hull_vertices(unread_points(mesh)))
        objects.setdefault(name or "world" if is_root else mesh.link, []).append(shape)
    return objects


def _objects(model: mujoco.MjModel) -> Objects:
    """Return the shapes of a model that collide, by link or body; those of the world by their own names."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    bodies, objects = element_names(model, "body"), Objects()
    for geom in np.flatnonzero((model.geom_contype | model.geom_conaffinity) != 0):
        body, name = model.geom_bodyid[geom], mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom)
        shape = model_shape(model, data, int(geom))
        objects.setdefault(bodies[body] if body or not name else name, []).append(shape)
    return objects
