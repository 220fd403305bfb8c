"""Readers of scenes: MuJoCo XML, URDF, and MoveIt's two formats."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from .._errors import OsikValueError, missing_extra, warn
from ..robot.loading._meshes import unread_points
from ..robot.loading._mjmodel import element_names
from ..robot.loading._packages import Packages
from ..robot.loading._poses import IDENTITY, Pose, rotation_matrix
from ..robot.loading._source import Source, check_root, parse_xml, read_source
from ..robot.loading._urdf import unread_meshes, urdf_spec
from ..robot.loading._urdf_elements import read_urdf
from ._mesh_parts import convex_parts
from ._table import ConvexShape, ShapeKind, hull_vertices, model_shape

Objects = dict[str, list[ConvexShape]]
"""Shapes of each object in the world."""

_CONE_SIDES = 32
_PRIMITIVES = {1: "box", 2: "sphere", 3: "cylinder", 4: "cone"}
"""Numbers of shape_msgs/SolidPrimitive."""
_NUMBERS = {"sphere": 1, "box": 3, "cylinder": 2, "cone": 2, "plane": 4}


class SceneFile(NamedTuple):
    """Contents of a file.

    Attributes:
        objects: shapes of each object.
        allowed: pairs of an object and a link or another object that may touch.
    """

    objects: Objects
    allowed: tuple[tuple[str, str], ...] = ()


def read_scene(path: str | os.PathLike[str]) -> SceneFile:
    """Return the contents of a scene's file; see ``Scene.from_file``."""
    kinds: dict[str, Callable[[Path], SceneFile]] = {".yaml": _yaml, ".yml": _yaml, ".scene": _text}
    suffix = Path(path).suffix.lower()
    read = kinds.get(suffix, _xml)
    if read is _xml and suffix not in (".xml", ".urdf", ".mjcf"):
        raise OsikValueError(f"{os.fspath(path)!r} is no scene: there are .xml, .mjcf, .urdf, .yaml, .yml and .scene")
    if not Path(path).is_file():
        raise FileNotFoundError(f"no scene file {os.fspath(path)!r}")
    try:
        return read(Path(path))
    except (ValueError, KeyError, IndexError, TypeError) as error:
        if isinstance(error, OsikValueError) and str(error).startswith(str(path)):
            raise
        reason = f"{error} is missing" if type(error) is KeyError else error
        raise OsikValueError(f"{os.fspath(path)}: {reason}") from None


def _xml(path: Path) -> SceneFile:
    """Return the shapes of a MuJoCo XML or a URDF that collide."""
    source = read_source(path, "scene")
    root = parse_xml(source)
    if root.tag == "robot":
        return SceneFile(_urdf_objects(root, source))
    check_root(root, "mujoco", source)
    return SceneFile(_objects(mujoco.MjModel.from_xml_path(str(path))))


def _urdf_objects(root: ElementTree.Element, source: Source) -> Objects:
    """Return the collision shapes of a URDF; meshes are their convex hulls."""
    urdf = read_urdf(root)
    model = urdf_spec(urdf).compile()
    data, objects = mujoco.MjData(model), _objects(model)
    mujoco.mj_kinematics(model, data)
    for mesh in unread_meshes(urdf, Packages(), source.path):
        is_root = mesh.link == urdf.root
        body = 0 if is_root else model.body(mesh.link).id
        carrier = Pose(data.xpos[body], data.xmat[body].reshape(3, 3))
        pose = carrier @ Pose(np.array(mesh.position), np.array(mesh.rotation))
        shape = ConvexShape(ShapeKind.HULL, np.zeros(3), *pose, hull_vertices(unread_points(mesh)))
        objects.setdefault(mesh.name or "world" if is_root else mesh.link, []).append(shape)
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


def _yaml(path: Path) -> SceneFile:
    """Return the collision objects of a planning scene (moveit_msgs/PlanningScene)."""
    try:
        import yaml
    except ImportError as missing:
        raise missing_extra("reading a .yaml scene", "PyYAML", "scenes") from missing
    try:
        scene = yaml.load(path.read_text(encoding="utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except yaml.YAMLError as error:
        raise OsikValueError(" ".join(str(error).split())) from None
    if not isinstance(scene, Mapping) or "world" not in scene:
        raise OsikValueError("it has no 'world', as a planning scene of MoveIt has")
    objects = {one["id"]: list(_object_shapes(one, path)) for one in scene["world"].get("collision_objects") or ()}
    held = (scene.get("robot_state") or {}).get("attached_collision_objects")
    if held:
        names = ", ".join(one["object"]["id"] for one in held)
        warn(f"{path}: objects attached to a robot are left out; use Scene.attach: {names}")
    return SceneFile(objects, tuple(_allowed(scene.get("allowed_collision_matrix") or {}, objects)))


def _object_shapes(thing: Mapping[str, Any], path: Path) -> Iterator[ConvexShape]:
    """Yield the shapes of a moveit_msgs/CollisionObject."""
    place = _pose(thing["pose"]) if "pose" in thing else IDENTITY
    for given, pose in zip(*_lists(thing, "primitives", "primitive_poses"), strict=True):
        kind = str(_PRIMITIVES.get(given["type"], given["type"]))
        numbers = [float(size) for size in given["dimensions"]]
        yield _shape(kind, numbers[::-1] if kind in ("cylinder", "cone") else numbers, place @ _pose(pose))
    for given, pose in zip(*_lists(thing, "planes", "plane_poses"), strict=True):
        yield _shape("plane", [float(number) for number in given["coef"]], place @ _pose(pose))
    for given, pose in zip(*_lists(thing, "meshes", "mesh_poses"), strict=True):
        vertices = np.array([_numbers(point, "xyz") for point in given["vertices"]])
        faces = np.array([face["vertex_indices"] if isinstance(face, Mapping) else face for face in given["triangles"]])
        yield from _mesh(vertices, faces, place @ _pose(pose))


def _lists(given: Mapping[str, Any], *keys: str) -> list[list[Any]]:
    return [list(given.get(key) or []) for key in keys]


def _allowed(matrix: Mapping[str, Any], objects: Objects) -> Iterator[tuple[str, str]]:
    """Yield the pairs that a matrix allows and that have an object."""
    names, rows = _lists(matrix, "entry_names", "entry_values")
    for first, row in zip(names, rows, strict=True):
        for second, allowed in zip(names, row["enabled"] if isinstance(row, Mapping) else row, strict=True):
            if allowed and first in objects and first != second:
                yield first, second


def _pose(given: Mapping[str, Any]) -> Pose:
    """Return a pose of geometry_msgs, or of lists; its quaternion has w last."""
    x, y, z, w = _numbers(given["orientation"], "xyzw")
    return _made_pose(_numbers(given["position"], "xyz"), np.array([w, x, y, z]))


def _made_pose(position: np.ndarray, quaternion: np.ndarray) -> Pose:
    length = np.linalg.norm(quaternion)
    if not (np.isfinite(position).all() and 0.0 < length < np.inf):
        raise OsikValueError(f"no pose: position {position}, quaternion w x y z {quaternion}")
    return Pose(position, rotation_matrix(quaternion / length))


def _numbers(given: Any, fields: str) -> np.ndarray:
    parts = [given[field] for field in fields] if isinstance(given, Mapping) else given
    numbers = np.array(parts, float)
    if numbers.shape != (len(fields),):
        raise OsikValueError(f"{given!r} has not the {len(fields)} numbers {' '.join(fields)}")
    return numbers


def _text(path: Path) -> SceneFile:
    """Return the objects of MoveIt's text format, in which an object's own pose came later (its line has spaces)."""
    name, *lines = path.read_text(encoding="utf-8").splitlines()
    del name
    starts = [k for k, line in enumerate(lines) if line.startswith("*")]
    ends = [*starts[1:], next((k for k, line in enumerate(lines) if line.strip() == "."), len(lines))]
    objects: Objects = {}
    for start, end in zip(starts, ends, strict=True):
        words = iter(" ".join(lines[start + 1 : end]).split())
        place = _next_pose(words) if len(lines[start + 1].split()) > 1 else IDENTITY
        shapes = objects.setdefault(lines[start][1:].strip(), [])
        for _ in range(int(next(words))):
            shapes += _next_shape(words, place)
            _next_numbers(words, 4)  # its colour
    return SceneFile(objects)


def _next_shape(words: Iterator[str], place: Pose) -> list[ConvexShape]:
    kind = next(words)
    if kind != "mesh":
        numbers = _next_numbers(words, _NUMBERS.get(kind, 0))
        return [_shape(kind, numbers, place @ _next_pose(words))]
    counts = int(next(words)), int(next(words))
    vertices, faces = (np.array(_next_numbers(words, 3 * count)).reshape(-1, 3) for count in counts)
    return _mesh(vertices, faces.astype(int), place @ _next_pose(words))


def _next_pose(words: Iterator[str]) -> Pose:
    numbers = np.array(_next_numbers(words, 7))
    return _made_pose(numbers[:3], np.roll(numbers[3:], 1))


def _next_numbers(words: Iterator[str], count: int) -> list[float]:
    numbers = [float(word) for _, word in zip(range(count), words, strict=False)]
    if len(numbers) < count:
        raise OsikValueError("an object ends too early")
    return numbers


def _shape(kind: str, numbers: Iterable[float], pose: Pose) -> ConvexShape:
    """Return a simple shape.

    Args:
        kind: one of ``_NUMBERS``.
        numbers: a sphere's radius, a box's edges, radius and length of a cylinder or cone [m], or the coefficients
            a, b, c, d of a plane ax + by + cz + d = 0.
        pose: in the world.
    """
    sizes = np.array([*numbers])
    if kind not in _NUMBERS:
        raise OsikValueError(f"{kind!r} is no shape of MoveIt: there are {', '.join(_NUMBERS)} and mesh")
    if len(sizes) != _NUMBERS[kind] or not np.isfinite(sizes).all() or (kind != "plane" and not sizes.min() > 0.0):
        raise OsikValueError(f"the sizes of a {kind} are {sizes}; they are {_NUMBERS[kind]} positive numbers")
    if kind == "plane":
        return _half_space(sizes, pose)
    if kind == "cone":
        return ConvexShape(ShapeKind.HULL, np.zeros(3), *pose, _cone(*sizes))
    radius_first, numbers = kind != "box", np.pad(sizes, (0, 3 - len(sizes)))
    halved = numbers * (1.0 if radius_first else 0.5, 0.5, 0.5)
    return ConvexShape(ShapeKind[kind.upper()], halved, *pose)


def _half_space(coefficients: Float[np.ndarray, "4"], pose: Pose) -> ConvexShape:
    """Return the half space behind a plane; the plane's normal points to the free side."""
    normal, length = coefficients[:3], np.linalg.norm(coefficients[:3])
    if length == 0.0:
        raise OsikValueError("the normal of a plane is 0")
    quaternion = np.zeros(4)
    mujoco.mju_quatZ2Vec(quaternion, normal / length)
    local = Pose(-coefficients[3] / length**2 * normal, rotation_matrix(quaternion))
    return ConvexShape(ShapeKind.HALF_SPACE, np.zeros(3), *(pose @ local))


def _cone(radius: float, length: float) -> Float[np.ndarray, "n 3"]:
    """Return the corners of a pyramid around a cone, whose tip points along z."""
    angle = 2.0 * np.pi * np.arange(_CONE_SIDES) / _CONE_SIDES
    ring = radius / np.cos(np.pi / _CONE_SIDES) * np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.concatenate([np.insert(ring, 2, -0.5 * length, axis=1), [[0.0, 0.0, 0.5 * length]]])


def _mesh(vertices: np.ndarray, faces: np.ndarray, pose: Pose) -> list[ConvexShape]:
    return [ConvexShape(ShapeKind.HULL, np.zeros(3), *pose, part) for part in convex_parts(vertices, faces)]
