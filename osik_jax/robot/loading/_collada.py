"""Reader of COLLADA files (.dae), which MuJoCo cannot read: triangles with colours."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy  # loads its parts when they are used
from jaxtyping import Float, Int

from ..._errors import OsikValueError

_Element = ElementTree.Element
_Color = tuple[float, float, float, float]


class Triangles(NamedTuple):
    """Part of a mesh that has one colour."""

    vertices: Float[np.ndarray, "k 3"]  # [m]
    faces: Int[np.ndarray, "m 3"]  # counter-clockwise seen from outside
    color: _Color | None  # red, green, blue, alpha; ``None`` where the file has none
    y_up: bool = False  # whether the file says that its y axis points up; its numbers are left as they are


def read_collada(path: Path) -> list[Triangles]:
    """Return the triangles and polygons of the scene in metres, in the file's axes; ``up_axis`` is ignored.

    Skins, splines and lines are left out; of a texture, the mean colour is taken.
    """
    try:
        root = _without_namespaces(ElementTree.parse(path).getroot())
    except ElementTree.ParseError as error:
        raise OsikValueError(f"{path}: broken XML: {error}") from error
    if root.tag != "COLLADA":
        raise OsikValueError(f"{path}: the root element is <{root.tag}>, not <COLLADA>")
    try:
        parts = _Document(root, path).parts()
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise OsikValueError(f"{path}: broken COLLADA: {error!r}") from error
    if not parts:
        raise OsikValueError(f"{path}: no triangles in the scene")
    return parts


def _without_namespaces(root: _Element) -> _Element:
    for element in root.iter():
        if isinstance(element.tag, str):
            element.tag = element.tag.rpartition("}")[2]
    return root


class _Document:
    """Elements of a file by their ids."""

    def __init__(self, root: _Element, path: Path) -> None:
        self._root, self._path = root, path
        self._y_up = root.findtext("asset/up_axis", "Y_UP").strip() == "Y_UP"
        self._ids = {element.get("id", ""): element for element in root.iter() if element.get("id")}

    def parts(self) -> list[Triangles]:
        """Return everything that the scene shows."""
        unit = self._root.find("asset/unit")
        scale = np.diag([float("1" if unit is None else unit.get("meter", "1"))] * 3 + [1.0])
        shown = self._root.find("scene/instance_visual_scene")
        scene = self._root.find("library_visual_scenes/visual_scene") if shown is None else self._linked(shown)
        return [] if scene is None else [part for node in scene.findall("node") for part in self._node(node, scale)]

    def _linked(self, element: _Element, key: str = "url") -> _Element:
        return self._ids[element.attrib[key].lstrip("#")]

    def _node(self, node: _Element, above: Float[np.ndarray, "4 4"]) -> Iterator[Triangles]:
        """Yield the geometries below a node, in the world."""
        placed = above @ _transform(node)
        for instance in node.findall("instance_geometry"):
            yield from self._geometry(instance, placed)
        for child in (*node.findall("node"), *map(self._linked, node.findall("instance_node"))):
            yield from self._node(child, placed)

    def _geometry(self, instance: _Element, placed: Float[np.ndarray, "4 4"]) -> Iterator[Triangles]:
        mesh = self._linked(instance).find("mesh")
        bound = {e.attrib["symbol"]: self._linked(e, "target") for e in instance.iter("instance_material")}
        for group in () if mesh is None else mesh:
            faces = _faces(group)
            if len(faces):
                points = self._positions(group) @ placed[:3, :3].T + placed[:3, 3]
                used, index = np.unique(faces, return_inverse=True)
                index = index.reshape(-1, 3)
                turned = index[:, ::-1] if np.linalg.det(placed[:3, :3]) < 0.0 else index
                yield Triangles(points[used], turned, self._color(bound.get(group.get("material", ""))), self._y_up)

    def _positions(self, group: _Element) -> Float[np.ndarray, "k 3"]:
        vertices = self._linked(_input(group, "VERTEX"), "source")
        source = self._linked(_input(vertices, "POSITION"), "source")
        accessor = source.find("technique_common/accessor")
        stride = 3 if accessor is None else int(accessor.get("stride", "3"))
        return _numbers(source.findtext("float_array")).reshape(-1, stride)[:, :3]

    def _color(self, material: _Element | None) -> _Color | None:
        """Return the diffuse colour of a material; of a texture, the mean."""
        effect = None if material is None else material.find("instance_effect")
        diffuse = None if effect is None else next(self._linked(effect).iter("diffuse"), None)
        if diffuse is None:
            return None
        color, texture = diffuse.find("color"), diffuse.find("texture")
        if color is not None:
            red, green, blue, *_ = _numbers(color.text)
            return float(red), float(green), float(blue), 1.0
        return None if texture is None or effect is None else self._mean_color(self._linked(effect), texture)

    def _mean_color(self, effect: _Element, texture: _Element) -> _Color | None:
        """Return a texture's mean colour: its sampler names a surface, an image and at last a file."""
        parameters = {e.attrib["sid"]: e for e in effect.iter("newparam")}
        name = texture.attrib["texture"]
        for kind in ("sampler2D/source", "surface/init_from"):
            found = parameters[name].findtext(kind) if name in parameters else None
            name = name if found is None else found.strip()
        image = self._ids.get(name)
        file = None if image is None else image.findtext("init_from")
        beside = None if file is None else self._path.parent / file.strip().removeprefix("file://")
        if beside is None or not beside.is_file():
            return None
        from PIL import Image  # not at the top: a robot without textures needs no picture library

        try:
            with Image.open(beside) as picture:
                pixels = np.asarray(picture.convert("RGB").resize((16, 16)))
        except OSError:  # no picture that can be read
            return None
        red, green, blue = pixels.reshape(-1, 3).mean(0) / 255.0
        return float(red), float(green), float(blue), 1.0


def _numbers(text: str | None, kind: type = float) -> np.ndarray:
    return np.array((text or "").split(), kind)


def _input(element: _Element, semantic: str) -> _Element:
    return next(e for e in element.findall("input") if e.get("semantic") == semantic)


def _faces(group: _Element) -> Int[np.ndarray, "m 3"]:
    """Return the indices of positions, polygons cut into fans; none of an element that has no faces."""
    if group.tag not in ("triangles", "polylist", "polygons"):
        return np.zeros((0, 3), int)
    stride = 1 + max(int(e.get("offset", "0")) for e in group.findall("input"))
    offset = int(_input(group, "VERTEX").get("offset", "0"))
    lists = [_numbers(p.text, int).reshape(-1, stride)[:, offset] for p in group.findall("p")]
    corners = np.concatenate([np.zeros(0, int), *lists])
    if group.tag == "triangles":
        return corners.reshape(-1, 3)
    if group.tag == "polygons":  # each in a <p> of its own
        return _fans(corners, np.array([len(own) for own in lists], int))
    return _fans(corners, _numbers(group.findtext("vcount"), int))


def _fans(corners: Int[np.ndarray, " k"], counts: Int[np.ndarray, " polygons"]) -> Int[np.ndarray, "m 3"]:
    """Return triangles about the first corner of each polygon."""
    start = np.repeat(np.cumsum(counts) - counts, np.maximum(counts - 2, 0))
    step = np.concatenate([np.zeros(0, int), *(np.arange(1, count - 1) for count in counts)])
    return np.stack([corners[start], corners[start + step], corners[start + step + 1]], -1)


def _transform(node: _Element) -> Float[np.ndarray, "4 4"]:
    """Return the product of a node's transforms, in the order of the file."""
    out = np.eye(4)
    for element in node:
        if element.tag in _TRANSFORMS:
            out = out @ _TRANSFORMS[element.tag](_numbers(element.text))
    return out


def _translation(shift: np.ndarray) -> Float[np.ndarray, "4 4"]:
    out = np.eye(4)
    out[:3, 3] = shift
    return out


def _rotation(axis_angle: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """Return the rotation about an axis by an angle [deg]."""
    axis, out = axis_angle[:3] / np.linalg.norm(axis_angle[:3]), np.eye(4)
    out[:3, :3] = scipy.spatial.transform.Rotation.from_rotvec(axis_angle[3] * axis, degrees=True).as_matrix()
    return out


_TRANSFORMS: Mapping = {
    "matrix": lambda numbers: numbers.reshape(4, 4),
    "translate": _translation,
    "rotate": _rotation,
    "scale": lambda numbers: np.diag([*numbers, 1.0]),
}
