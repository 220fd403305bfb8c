"""Report of the motion properties of a URDF that a robot does not keep.

Forces are no part of it: efforts, damping, friction and calibration do not bound where a robot may go. The numbers that
are kept are read by ``_urdf_elements``; what neither reads nor knows is named here, so that nothing is dropped unseen.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping

from .._load_report import LoadNote
from ._urdf_elements import SCALAR, Joint

_OF_ROBOT = frozenset(
    ("link", "joint", "material", "gazebo", "transmission", "ros2_control", "sensor", "mujoco", "group", "version")
)
_READ = ("origin", "parent", "child", "axis", "limit", "mimic", "safety_controller")
_OF_JOINT = frozenset((*_READ, "dynamics", "calibration", "hardwareInterface", "joint_properties"))
_CLOSES = "a URDF is a tree: the loop stays open"
_UNREAD = 100.0
"""Ranges of continuous joints from here on [rad] are placeholders for none."""


def urdf_notes(root: ElementTree.Element, joints: Mapping[str, Joint]) -> Iterator[LoadNote]:
    """Yield notes on a ``<robot>`` element whose joints were read."""
    for element in root:
        kind = _tag(element)
        if kind == "joint":
            yield from _joint_notes(element, joints[element.get("name", "")])
        elif kind == "gazebo":
            yield from _gazebo_notes(element, joints)
        elif kind == "transmission":
            yield from _transmission_notes(element)
        elif kind == "ros2_control":
            yield from _control_notes(element, joints)
        elif "loop" in kind:
            yield LoadNote(kind, element.get("name", ""), _CLOSES)
        elif kind not in _OF_ROBOT and "xacro" not in element.tag:
            yield LoadNote(kind, element.get("name", ""), "not known here, so left out")


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""


def _joint_notes(element: ElementTree.Element, joint: Joint) -> Iterator[LoadNote]:
    if joint.kind not in SCALAR:
        if element.find("mimic") is not None:
            yield LoadNote("mimic", joint.name, f"a {joint.kind} joint follows none")
    else:
        yield from _limit_notes(element.find("limit"), joint)
        yield from _safety_notes(element.find("safety_controller"), joint)
    for part in element:
        if _tag(part) not in _OF_JOINT:
            yield LoadNote(_tag(part), joint.name, "not known here, so left out")


def _limit_notes(limit: ElementTree.Element | None, joint: Joint) -> Iterator[LoadNote]:
    if limit is None:
        return
    if number_of(limit.get("jerk")):
        yield LoadNote("limit jerk", joint.name, "not kept: no limit bounds jerks")
    up, down = number_of(limit.get("acceleration")), number_of(limit.get("deceleration"))
    if down and down != up:
        yield LoadNote(
            "limit deceleration", joint.name, f"{joint.acceleration:g}, the lesser of the two, holds for both"
        )
    ends = [number_of(limit.get(name)) or 0.0 for name in ("lower", "upper")]
    if joint.kind == "continuous" and ends[0] < ends[1] and max(map(abs, ends)) < _UNREAD:
        yield LoadNote("limit", joint.name, f"a continuous joint has no range: [{ends[0]:g}, {ends[1]:g}] is not kept")


def _safety_notes(safety: ElementTree.Element | None, joint: Joint) -> Iterator[LoadNote]:
    if safety is None:
        return
    soft = [number_of(safety.get(f"soft_{name}_limit")) for name in ("lower", "upper")]
    if (soft[0] is not None and soft[0] > joint.lower) or (soft[1] is not None and soft[1] < joint.upper):
        shown = ", ".join("-" if value is None else f"{value:g}" for value in soft)
        yield LoadNote("safety_controller", joint.name, f"the range of <limit> holds, and not the soft one [{shown}]")


def number_of(text: str | None) -> float | None:
    """Return the finite number that a text holds, else None."""
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _gazebo_notes(element: ElementTree.Element, joints: Mapping[str, Joint]) -> Iterator[LoadNote]:
    where = element.get("reference", "")
    for part in element.iter():
        kind = _tag(part)
        if kind == "joint" and part.get("type"):
            yield LoadNote("gazebo joint", part.get("name", where), _CLOSES)
        elif kind in ("mimicJoint", "mimic_joint"):
            name = (part.text or where).strip()
            if name in joints and joints[name].mimic is None:
                yield LoadNote("gazebo mimic", name, "only <mimic> in a <joint> makes a follower")
        elif kind in ("springStiffness", "spring_stiffness") and (part.text or "0").strip() not in ("0", "0.0"):
            yield LoadNote("gazebo spring", where, "the spring is left out: it moves freely")
        elif kind == "static" and (part.text or "").strip() in ("true", "1"):
            yield LoadNote("gazebo static", where, "floating_base says whether the base moves")


def _transmission_notes(element: ElementTree.Element) -> Iterator[LoadNote]:
    for part in element.iter():
        if _tag(part) in ("passive_joint", "gap_joint", "use_simulated_gripper_joint"):
            name = part.get("name", element.get("name", ""))
            yield LoadNote(f"transmission {_tag(part)}", name, "what it ties to others moves freely")


def _control_notes(element: ElementTree.Element, joints: Mapping[str, Joint]) -> Iterator[LoadNote]:
    """Yield notes on limits and couplings of joints that ros2_control has."""
    for part in element.iter("joint"):
        joint = joints.get(part.get("name", ""))
        if joint is None or joint.kind not in SCALAR:
            continue
        if joint.mimic is None and any(p.get("name") == "mimic" for p in part.iter("param")):
            yield LoadNote("ros2_control mimic", joint.name, "only <mimic> in a <joint> makes a follower")
        for interface in part.iter("command_interface"):
            ends = {p.get("name"): number_of(p.text) for p in interface.iter("param")}
            least, most = ends.get("min"), ends.get("max")
            own = {"position": (joint.lower, joint.upper), "velocity": (-joint.speed, joint.speed)}
            lower, upper = own.get(interface.get("name", ""), (math.inf, -math.inf))
            if (least is not None and least > lower) or (most is not None and most < upper):
                kind = f"ros2_control {interface.get('name')}"
                yield LoadNote(kind, joint.name, f"<limit> holds, and not min {least}, max {most}")
