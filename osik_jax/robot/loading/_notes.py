"""Elements of MJCF and URDF files that constrain motion, and that a robot does not keep.

Forces, ranges of actuators, and what is there for simulators and drives are no part of it.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping

import mujoco
import numpy as np

from .._load_report import LoadNote
from .._ranges import joints_outside
from .._tree import KinematicTree
from ._urdf_elements import SCALAR, Joint


def model_notes(model: mujoco.MjModel, joints: tuple[str, ...]) -> Iterator[LoadNote]:
    """Yield notes on a model, given the names of its joints."""
    yield from _equality_notes(model)
    yield from _tendon_notes(model, joints)


_KEY_ROUNDING = 1e-3
"""Distance by which a keyframe's joint may be outside its range [rad or m]: files are rounded."""


def home_notes(
    tree: KinematicTree, key: str, q: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> Iterator[LoadNote]:
    """Yield notes on the joints that a keyframe has outside their range."""
    for text in joints_outside(tree, q, lower, upper, _KEY_ROUNDING).values():
        yield LoadNote("keyframe", key, f"{text}: in q0 it is at the end of that")


def keyframe_names(model: mujoco.MjModel) -> list[str]:
    """Return the names of the keyframes; one without a name is called by its number."""
    return [_name(model, mujoco.mjtObj.mjOBJ_KEY, k) for k in range(model.nkey)]


def _name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    return mujoco.mj_id2name(model, kind, index) or str(index)


def _equality_notes(model: mujoco.MjModel) -> Iterator[LoadNote]:
    """Yield notes on active equality constraints, except linear ones between joints, which followers and locks keep."""
    connect, weld, joint, tendon = (
        int(getattr(mujoco.mjtEq, f"mjEQ_{kind}")) for kind in ("CONNECT", "WELD", "JOINT", "TENDON")
    )
    for e in np.flatnonzero(model.eq_active0).tolist():
        kind, name = int(model.eq_type[e]), _name(model, mujoco.mjtObj.mjOBJ_EQUALITY, e)
        label = f"{mujoco.mjtEq(kind).name.removeprefix('mjEQ_').lower()} equality"
        if kind in (connect, weld) or (kind == joint and model.eq_obj2id[e] >= 0 and model.eq_data[e, 2:5].any()):
            yield LoadNote(label, name, "kept only where EqualityConstraintTask(robot) is among the tasks")
        elif kind == tendon:
            yield LoadNote(
                label, name, "not kept: the joints move freely; of a fixed tendon JointCouplingTask keeps it"
            )
        elif kind != joint:
            yield LoadNote(label, name, "not kept")


def _tendon_notes(model: mujoco.MjModel, joints: tuple[str, ...]) -> Iterator[LoadNote]:
    equalities = np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT).tolist()
    tied = {int(j) for e in equalities for j in _ends(model, e)}
    driven: set[int] = set(model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON, 0].tolist())
    for tendon in range(model.ntendon):
        name = _name(model, mujoco.mjtObj.mjOBJ_TENDON, tendon)
        if model.tendon_limited[tendon]:
            done = "not kept; a JointCouplingTask with lower and upper keeps that of a fixed tendon"
            yield LoadNote("tendon range", name, done)
        wraps = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
        along = model.wrap_type[wraps] == mujoco.mjtWrap.mjWRAP_JOINT
        moved: set[int] = set(model.wrap_objid[wraps][along].tolist())
        if tendon in driven and len(moved - tied) > 1:
            names = ", ".join(joints[j] for j in sorted(moved))
            yield LoadNote("tendon actuator", name, f"joints that one actuator moves are independent here: {names}")


def _ends(model: mujoco.MjModel, equality: int) -> tuple[int, ...]:
    return tuple(j for j in (model.eq_obj1id[equality], model.eq_obj2id[equality]) if model.eq_active0[equality])


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
    if _number(limit.get("jerk")):
        yield LoadNote("limit jerk", joint.name, "not kept: no limit bounds jerks")
    up, down = _number(limit.get("acceleration")), _number(limit.get("deceleration"))
    if down and down != up:
        yield LoadNote(
            "limit deceleration", joint.name, f"{joint.acceleration:g}, the lesser of the two, holds for both"
        )
    ends = [_number(limit.get(name)) or 0.0 for name in ("lower", "upper")]
    if joint.kind == "continuous" and ends[0] < ends[1] and max(map(abs, ends)) < _UNREAD:
        yield LoadNote("limit", joint.name, f"a continuous joint has no range: [{ends[0]:g}, {ends[1]:g}] is not kept")


def _safety_notes(safety: ElementTree.Element | None, joint: Joint) -> Iterator[LoadNote]:
    if safety is None:
        return
    soft = [_number(safety.get(f"soft_{name}_limit")) for name in ("lower", "upper")]
    if (soft[0] is not None and soft[0] > joint.lower) or (soft[1] is not None and soft[1] < joint.upper):
        shown = ", ".join("-" if value is None else f"{value:g}" for value in soft)
        yield LoadNote("safety_controller", joint.name, f"the range of <limit> holds, and not the soft one [{shown}]")


def _number(text: str | None) -> float | None:
    """Return the finite number that a text holds, else None."""
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) else None
