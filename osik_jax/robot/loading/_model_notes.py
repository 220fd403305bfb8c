"""Report of the motion properties of a MuJoCo model that a robot does not keep.

Springs, damping, other forces and the ranges of actuators are no part of it.
"""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from .._load_report import LoadNote


def model_notes(model: mujoco.MjModel, joints: tuple[str, ...]) -> Iterator[LoadNote]:
    """Yield notes on a model, given the names of its joints."""
    yield from _equality_notes(model)
    yield from _tendon_notes(model, joints)


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
