"""Readers of scenes: MuJoCo XML and URDF."""

from __future__ import annotations

import os
from pathlib import Path

import mujoco
import numpy as np

from .._errors import OsikValueError, warn
from ..robot.loading._mjmodel import element_names
from ..robot.loading._packages import Packages
from ..robot.loading._source import check_root, parse_xml, read_source
from ..robot.loading._urdf import compiled_with_meshes
from ..robot.loading._urdf_elements import read_urdf
from ._convex import ConvexShape, model_shape


def read_scene(path: str | os.PathLike[str]) -> dict[str, list[ConvexShape]]:
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
            model, notes = compiled_with_meshes(read_urdf(root), Packages(), source.path)
            for note in notes:
                warn(f"{source.label}: {note}")
        else:
            model = mujoco.MjModel.from_xml_path(str(path))
        return _objects(model)
    except ValueError as error:
        raise OsikValueError(f"{source.label}: {error}") from None


def _objects(model: mujoco.MjModel) -> dict[str, list[ConvexShape]]:
    """Return the shapes of a model that collide, by link or body; those of the world by their own names."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    bodies, objects = element_names(model, "body"), {}
    for geom in np.flatnonzero((model.geom_contype | model.geom_conaffinity) != 0):
        body, name = model.geom_bodyid[geom], mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom)
        shape = model_shape(model, data, int(geom))
        objects.setdefault(bodies[body] if body or not name else name, []).append(shape)
    return objects
