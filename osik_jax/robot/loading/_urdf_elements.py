"""A URDF's links and joints as plain data, checked to form one tree."""

from __future__ import annotations

import dataclasses
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Iterator, Mapping
from typing import TypeVar

import mujoco
import numpy as np

from ..._errors import OsikValueError, unknown_name
from .._load_report import LoadNote
from ._followers import free_name
from ._poses import IDENTITY, Pose, rotation_matrix

JOINT_KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating")
SCALAR = ("revolute", "continuous", "prismatic")
_Color = tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class Shape:
    """A box (full edges), sphere (radius), cylinder or capsule (radius, length) [m], or a mesh (scale of its file).

    ``name`` is empty where the file gives none.
    """

    kind: str
    size: tuple[float, ...]
    pose: Pose
    color: _Color | None
    visual: bool
    file: str = ""
    name: str = ""


@dataclasses.dataclass(frozen=True)
class Link:
    """A link. ``inertial`` has its origin at the centre of mass and the axes that ``inertia`` (3, 3) [kg m^2] is in."""

    name: str
    mass: float
    inertial: Pose
    inertia: np.ndarray
    shapes: tuple[Shape, ...]


@dataclasses.dataclass(frozen=True)
class Mimic:
    """``q = multiplier * q_leader + offset``."""

    leader: str
    multiplier: float
    offset: float


@dataclasses.dataclass(frozen=True)
class Joint:
    """A joint; ``lower``, ``upper``, ``speed`` and ``acceleration`` are infinite where the joint is free."""

    name: str
    kind: str
    parent: str
    child: str
    origin: Pose
    axis: np.ndarray
    lower: float = -math.inf
    upper: float = math.inf
    speed: float = math.inf
    acceleration: float = math.inf
    mimic: Mimic | None = None


@dataclasses.dataclass(frozen=True)
class Urdf:
    """A robot: links by name, joints with parents before children, the link without a parent, notes on the reading."""

    name: str
    links: Mapping[str, Link]
    joints: tuple[Joint, ...]
    root: str
    notes: tuple[LoadNote, ...] = ()


def read_urdf(element: ElementTree.Element) -> Urdf:
    """Return links and joints of a ``<robot>`` element; everything else in it is ignored."""
    _refuse_xacro(element)
    notes: list[LoadNote] = []
    colors = {m.get("name", ""): color for m in element.findall("material") if (color := _rgba(m))}
    taken: set[str] = set()  # names of collision shapes
    links = _by_name("link", (_link(e, colors, taken, notes) for e in element.findall("link")))
    if not links:
        raise OsikValueError("the URDF has no <link>")
    joints = _by_name("joint", (_joint(e) for e in element.findall("joint")))
    root = _root(links, joints)
    _check_mimics(joints)
    return Urdf(element.get("name", ""), links, tuple(_parents_first(root, links, joints)), root, tuple(notes))


def _refuse_xacro(element: ElementTree.Element) -> None:
    for child in element.iter():
        if isinstance(child.tag, str) and "xacro" in child.tag.rpartition("}")[0]:
            name = child.tag.rpartition("}")[2]
            raise OsikValueError(f"the file holds the xacro element <xacro:{name}>: run xacro and load what it writes")


_Named = TypeVar("_Named", Link, Joint)


def _by_name(kind: str, items: Iterable[_Named]) -> dict[str, _Named]:
    out: dict[str, _Named] = {}
    for item in items:
        if item.name in out:
            raise OsikValueError(f"two {kind}s are called {item.name!r}")
        out[item.name] = item
    return out


def _attribute(element: ElementTree.Element | None, name: str, where: str) -> str:
    value = None if element is None else element.get(name)
    if value is None:
        raise OsikValueError(f"{where}: the attribute {name!r} is missing")
    return value


def finite_numbers(text: str, count: int, where: str) -> np.ndarray:
    """Return the finite numbers in a text; raise ValueError unless there are ``count`` of them."""
    values = _floats(text)
    if len(values) != count or not np.isfinite(values).all():
        raise OsikValueError(
            f"{where}: {text!r} is not {'a finite number' if count == 1 else f'{count} finite numbers'}"
        )
    return values


def _floats(text: str) -> np.ndarray:
    """Return the numbers in a text; empty if a word is not a number."""
    try:
        return np.array([float(word) for word in text.split()])
    except ValueError:
        return np.zeros(0)


def _text(element: ElementTree.Element, name: str, default: str) -> str:
    """Return an attribute; one that is empty counts as absent."""
    return element.get(name, "").strip() or default


def _number(element: ElementTree.Element, name: str, where: str, default: str | None = None) -> float:
    text = _attribute(element, name, where) if default is None else _text(element, name, default)
    return float(finite_numbers(text, 1, f"{where}, {name}")[0])


def _bound(element: ElementTree.Element, name: str, where: str) -> float:
    """Return a number that may be infinite; 0 if it is absent."""
    text = _text(element, name, "0")
    values = _floats(text)
    if len(values) != 1 or np.isnan(values[0]):
        raise OsikValueError(f"{where}, {name}: {text!r} is not a finite number, inf or -inf")
    return float(values[0])


def _origin(element: ElementTree.Element, where: str) -> Pose:
    origin = element.find("origin")
    if origin is None:
        return IDENTITY
    position = finite_numbers(_text(origin, "xyz", "0 0 0"), 3, f"{where}, origin xyz")
    if "quat_xyzw" in origin.attrib:
        quaternion = finite_numbers(origin.attrib["quat_xyzw"], 4, f"{where}, origin quat_xyzw")
        if not quaternion.any():
            raise OsikValueError(f"{where}: the quaternion is zero")
        return Pose(position, rotation_matrix(np.roll(quaternion / np.linalg.norm(quaternion), 1)))
    angles = finite_numbers(_text(origin, "rpy", "0 0 0"), 3, f"{where}, origin rpy")
    turn = np.zeros(4)
    mujoco.mju_euler2Quat(turn, angles, "XYZ")  # about fixed axes
    return Pose(position, rotation_matrix(turn))


def _link(element: ElementTree.Element, colors: Mapping[str, _Color], taken: set[str], notes: list[LoadNote]) -> Link:
    """Return a link.

    Shapes that are broken are left out: no kinematics needs them, and those for collisions are noted.
    """
    name = _attribute(element, "name", "a <link>")
    where = f"link {name!r}"
    shapes = []
    for shape in (e for e in element if e.tag in ("visual", "collision")):
        try:
            shapes.append(_shape(shape, colors, name, taken))
        except OsikValueError as error:
            if shape.tag == "collision":
                notes.append(LoadNote("collision", name, f"the shape is left out: {error}"))
    mass, inertial, inertia = _inertial(element.find("inertial"), where)
    if any(not _text(e, "value", "") for e in element.findall("inertial/mass")):
        notes.append(LoadNote("mass", name, "0, for the file gives no value"))
    return Link(name, mass, inertial, inertia, tuple(shape for shape in shapes if shape is not None))


def _inertial(element: ElementTree.Element | None, where: str) -> tuple[float, Pose, np.ndarray]:
    if element is None:
        return 0.0, IDENTITY, np.zeros((3, 3))
    where = f"{where}, inertial"
    mass_element = element.find("mass")
    mass = 0.0 if mass_element is None else _number(mass_element, "value", f"{where}, mass", "0")
    if mass < 0.0:
        raise OsikValueError(f"{where}: the mass {mass} is negative")
    moments = element.find("inertia")
    inertia = np.zeros((3, 3))
    for row, column in np.ndindex(3, 3):
        key = "i" + "".join("xyz"[k] for k in sorted((row, column)))
        inertia[row, column] = 0.0 if moments is None else _number(moments, key, f"{where}, inertia", "0")
    return mass, _origin(element, where), inertia


def _rgba(material: ElementTree.Element | None) -> _Color | None:
    color = None if material is None else material.find("color")
    if color is None:
        return None
    values = _floats(color.get("rgba", "").replace(",", " "))
    if len(values) not in (3, 4) or not np.isfinite(values).all():
        return None  # colours are for drawing alone
    return (*values[:3].tolist(), values[3] if len(values) == 4 else 1.0)


def _shape(element: ElementTree.Element, colors: Mapping[str, _Color], link: str, taken: set[str]) -> Shape | None:
    """Return a shape, None for one without size; a collision shape whose name is taken gets the link's before it."""
    shapes = [e for e in element.findall("geometry/*") if e.tag in ("box", "sphere", "cylinder", "capsule", "mesh")]
    if not shapes:
        return None
    (shape, *_), where = shapes, f"link {link!r}, {element.tag}"
    size, file = _size(shape, where), ""
    if shape.tag == "mesh":
        file = _attribute(shape, "filename", f"{where}, mesh")
    elif min(size) <= 0.0:
        return None
    material = element.find("material")
    color = _rgba(material) or (None if material is None else colors.get(material.get("name", "")))
    pose, visual, name = _origin(element, where), element.tag == "visual", element.get("name", "")
    if name and not visual:
        name = name if name not in taken else free_name(f"{link}/{name}", taken)
        taken.add(name)
    return Shape(shape.tag, size, pose, color, visual, file, name)


def _size(shape: ElementTree.Element, where: str) -> tuple[float, ...]:
    if shape.tag == "mesh":
        scale = _text(shape, "scale", "1 1 1")
        return tuple(
            finite_numbers(scale if len(scale.split()) > 1 else f"{scale} {scale} {scale}", 3, f"{where}, mesh scale")
        )
    if shape.tag == "box":
        return tuple(finite_numbers(_attribute(shape, "size", where), 3, f"{where}, box size"))
    lengths = ("radius",) if shape.tag == "sphere" else ("radius", "length")
    return tuple(_number(shape, name, f"{where}, {shape.tag}") for name in lengths)


def _joint(element: ElementTree.Element) -> Joint:
    name = _attribute(element, "name", "a <joint>")
    where = f"joint {name!r}"
    kind = _attribute(element, "type", where)
    if kind not in JOINT_KINDS:
        advice = "; write it as two prismatic joints and a continuous one" if kind == "planar" else ""
        raise OsikValueError(
            f"{where} has the type {kind!r}, which is not supported{advice}. Types: {', '.join(JOINT_KINDS)}"
        )
    return Joint(
        name=name,
        kind=kind,
        parent=_attribute(element.find("parent"), "link", f"{where}, parent"),
        child=_attribute(element.find("child"), "link", f"{where}, child"),
        origin=_origin(element, where),
        axis=_axis(element.find("axis"), where) if kind in SCALAR else np.array([1.0, 0.0, 0.0]),
        mimic=_mimic(element.find("mimic"), where) if kind in SCALAR else None,
        **_joint_limits(element.find("limit"), kind, where),
    )


def _axis(element: ElementTree.Element | None, where: str) -> np.ndarray:
    axis = np.array([1.0, 0.0, 0.0])
    if element is not None:
        axis = finite_numbers(_text(element, "xyz", "1 0 0"), 3, f"{where}, axis")
    length = np.linalg.norm(axis)
    if length == 0.0:
        raise OsikValueError(f"{where}: the axis is zero")
    return axis / length


def _joint_limits(element: ElementTree.Element | None, kind: str, where: str) -> dict[str, float]:
    """Return the limits of a ``Joint`` by field; a speed of 0 counts as unknown.

    URDF 1.2 has an acceleration and a deceleration; the lesser holds for both.
    """
    if element is None or kind not in SCALAR:
        return {}
    where = f"{where}, limit"
    rates = {name: _bound(element, name, where) for name in ("velocity", "acceleration", "deceleration")}
    for name, rate in rates.items():
        if rate < 0.0:
            raise OsikValueError(f"{where}: the {name} {rate} is negative")
    speed, *accelerations = (rate or math.inf for rate in rates.values())
    limits = dict(speed=speed, acceleration=min(accelerations))
    if kind == "continuous":
        return limits
    lower, upper = (_bound(element, name, where) for name in ("lower", "upper"))
    if lower > upper or lower == math.inf or upper == -math.inf:
        raise OsikValueError(f"{where}: lower {lower} > upper {upper}")
    return limits | dict(lower=lower, upper=upper)


def _mimic(element: ElementTree.Element | None, where: str) -> Mimic | None:
    if element is None:
        return None
    where = f"{where}, mimic"
    leader = _attribute(element, "joint", where)
    return Mimic(leader, _number(element, "multiplier", where, "1"), _number(element, "offset", where, "0"))


def _root(links: Mapping[str, Link], joints: Mapping[str, Joint]) -> str:
    """Return the one link without a parent."""
    parent_joint: dict[str, str] = {}
    for joint in joints.values():
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in links:
                raise OsikValueError(f"joint {joint.name!r}: {unknown_name('link', link, tuple(links))} (its {role})")
        if joint.child in parent_joint:
            raise OsikValueError(
                f"link {joint.child!r} is the child of two joints, {parent_joint[joint.child]!r} and {joint.name!r}: "
                "a URDF is a tree, and closed loops cannot be written in it"
            )
        parent_joint[joint.child] = joint.name
    roots = [name for name in links if name not in parent_joint]
    if not roots:
        raise OsikValueError(
            f"the joints form a loop: every link has a parent, so there is no root. links: {', '.join(links)}"
        )
    if len(roots) > 1:
        raise OsikValueError(f"{len(roots)} links have no parent, one has to be the root: {', '.join(roots)}")
    return roots[0]


def _parents_first(root: str, links: Mapping[str, Link], joints: Mapping[str, Joint]) -> Iterator[Joint]:
    """Yield joints from the root outwards; raise ValueError with the links that cannot be reached."""
    below: dict[str, list[Joint]] = {name: [] for name in links}
    for joint in joints.values():
        below[joint.parent].append(joint)
    queue, reached = [root], {root}
    for link in queue:
        for joint in below[link]:
            queue.append(joint.child)
            reached.add(joint.child)
            yield joint
    if len(reached) < len(links):
        lost = ", ".join(name for name in links if name not in reached)
        raise OsikValueError(f"the joints form a loop that the root {root!r} does not reach: {lost}")


def _check_mimics(joints: Mapping[str, Joint]) -> None:
    """Raise ValueError unless each chain of followers ends at a joint that follows none."""
    for name in joints:
        chain = [name]
        while (mimic := joints[chain[-1]].mimic) is not None:
            leader = joints.get(mimic.leader)
            if leader is None:
                missing = unknown_name("joint", mimic.leader, tuple(joints))
                raise OsikValueError(f"joint {chain[-1]!r} mimics what is not there: {missing}")
            if leader.kind not in SCALAR:
                raise OsikValueError(f"joint {chain[-1]!r} mimics {leader.name!r}, which is {leader.kind}")
            if leader.name in chain:
                circle = " -> ".join([*chain, leader.name])
                raise OsikValueError(f"mimic joints follow each other in a circle: {circle}")
            chain.append(leader.name)
