"""Report of the motion properties of a MuJoCo model that a robot does not keep.

Forces are no part of it: damping, friction, armature, gravity compensation, force ranges and torque motors do not
bound where a robot may go or how fast it may be asked to.
"""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from .._load_report import LoadNote
from .._tree import HINGE, SLIDE

_JOINT_TRANSMISSIONS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_NARROWER = 0.01
"""Share of a range by which that of an actuator may be narrower: figures in files are rounded."""
_FREE = "it moves freely"


def model_notes(
    model: mujoco.MjModel, joints: tuple[str, ...], low: np.ndarray, high: np.ndarray, speed: np.ndarray
) -> Iterator[LoadNote]:
    """Yield notes on a model, given the names and the limits of its joints as they were read. (njnt,) each."""
    yield from _joint_notes(model, joints)
    yield from _equality_notes(model)
    yield from _tendon_notes(model, joints)
    yield from _actuator_notes(model, joints, low, high, speed)
    yield from _contact_notes(model)
    yield from _other_notes(model)


def _name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    return mujoco.mj_id2name(model, kind, index) or str(index)


def _joint_notes(model: mujoco.MjModel, joints: tuple[str, ...]) -> Iterator[LoadNote]:
    for joint, name in enumerate(joints):
        if model.jnt_stiffness[joint] > 0.0:
            yield LoadNote("joint stiffness", name, f"the spring is left out: {_FREE}")
        if model.jnt_limited[joint] and model.jnt_margin[joint] > 0.0:
            margin = float(model.jnt_margin[joint])
            yield LoadNote("joint margin", name, f"the range is used to its ends, and not {margin:g} short of them")


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
        if model.tendon_stiffness[tendon] > 0.0:
            yield LoadNote("tendon stiffness", name, "the spring is left out")
        wraps = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
        along = model.wrap_type[wraps] == mujoco.mjtWrap.mjWRAP_JOINT
        moved: set[int] = set(model.wrap_objid[wraps][along].tolist())
        if tendon in driven and len(moved - tied) > 1:
            names = ", ".join(joints[j] for j in sorted(moved))
            yield LoadNote("tendon actuator", name, f"joints that one actuator moves are independent here: {names}")


def _ends(model: mujoco.MjModel, equality: int) -> tuple[int, ...]:
    return tuple(j for j in (model.eq_obj1id[equality], model.eq_obj2id[equality]) if model.eq_active0[equality])


def _actuator_notes(
    model: mujoco.MjModel, joints: tuple[str, ...], low: np.ndarray, high: np.ndarray, speed: np.ndarray
) -> Iterator[LoadNote]:
    """Yield notes on servos whose setpoints are bounded more tightly than their joints."""
    for actuator in range(model.nu):
        setpoints = _setpoints(model, actuator)
        joint = int(model.actuator_trnid[actuator, 0])
        if setpoints is None or model.jnt_type[joint] not in (HINGE, SLIDE):
            continue
        kind, least, most = setpoints
        name = _name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, actuator)
        if kind == "position":
            span = high[joint] - low[joint]
            room = _NARROWER * (span if np.isfinite(span) else most - least)
            if least > low[joint] + room or most < high[joint] - room:
                text = f"{joints[joint]} keeps its own range, and not the setpoints' [{least:g}, {most:g}]"
                yield LoadNote("actuator range", name, text)
        elif max(-least, most) < speed[joint] * (1.0 - _NARROWER):
            text = f"{joints[joint]} is not held to its setpoints' [{least:g}, {most:g}] per second: velocity_limits"
            yield LoadNote("actuator range", name, text)


def _setpoints(model: mujoco.MjModel, actuator: int) -> tuple[str, float, float] | None:
    """Return the setpoints of a joint's position or velocity servo: kind, least and greatest in the joint's units."""
    servo = (
        int(model.actuator_trntype[actuator]) in _JOINT_TRANSMISSIONS
        and int(model.actuator_gaintype[actuator]) == int(mujoco.mjtGain.mjGAIN_FIXED)
        and int(model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
    )
    gain, gear = float(model.actuator_gainprm[actuator, 0]), float(model.actuator_gear[actuator, 0])
    _, by_length, by_speed = (float(value) for value in model.actuator_biasprm[actuator, :3])
    if not servo or gain <= 0.0 or gear == 0.0:
        return None
    if int(model.actuator_dyntype[actuator]) == int(mujoco.mjtDyn.mjDYN_INTEGRATOR):
        limited, ends = model.actuator_actlimited[actuator], model.actuator_actrange[actuator]
    else:
        limited, ends = model.actuator_ctrllimited[actuator], model.actuator_ctrlrange[actuator]
    rate = -by_length if by_length else -by_speed
    if not limited or rate <= 0.0:
        return None
    least, most = sorted((ends * gain / (rate * gear)).tolist())
    return ("position" if by_length else "velocity"), least, most


def _contact_notes(model: mujoco.MjModel) -> Iterator[LoadNote]:
    """Yield notes on contacts that ``CollisionAvoidanceLimit`` treats in another way than MuJoCo."""
    geom = mujoco.mjtObj.mjOBJ_GEOM
    for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True):
        masks = (model.geom_contype[a] & model.geom_conaffinity[b]) | (
            model.geom_contype[b] & model.geom_conaffinity[a]
        )
        if not masks:
            name = f"{_name(model, geom, a)}, {_name(model, geom, b)}"
            yield LoadNote("contact pair", name, "kept apart only where CollisionAvoidanceLimit(pairs=...) names them")
    for g in np.flatnonzero(model.geom_margin > 0.0).tolist():
        text = f"the margin of {model.geom_margin[g]:g} is not used: CollisionAvoidanceLimit has minimum_distance"
        yield LoadNote("geom margin", _name(model, geom, g), text)


def _other_notes(model: mujoco.MjModel) -> Iterator[LoadNote]:
    for bit, kept in (("LIMIT", "joint ranges"), ("EQUALITY", "joint equalities")):
        if model.opt.disableflags & int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{bit}")):
            yield LoadNote("option flag", bit.lower(), f"{kept} are kept, though the file disables them")
    for flex in range(model.nflex):
        name = _name(model, mujoco.mjtObj.mjOBJ_FLEX, flex)
        yield LoadNote("flex", name, "what is deformable is left out; its bodies move freely")
    for plugin in range(model.nplugin):
        yield LoadNote("plugin", _name(model, mujoco.mjtObj.mjOBJ_PLUGIN, plugin), "left out")
