"""From a compiled MuJoCo model to the fields of a Robot."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from .._tree import DOF_WIDTH, FREE, HINGE, SLIDE, KinematicTree, ModelHolder, unknown_name

Follower = tuple[str, str, float, float]
"""(follower, leader, multiplier, offset): q_follower = multiplier * q_leader + offset."""


def from_mjmodel(
    model: mujoco.MjModel,
    *,
    velocity_limits: Mapping[str, float] | None = None,
    locked_joints: Iterable[str] | Mapping[str, float] = (),
    followers: Sequence[Follower] = (),
) -> dict[str, Any]:
    """The fields of a Robot. Linear joint equality constraints of the model add to ``followers``."""
    names = tuple(_name(model, mujoco.mjtObj.mjOBJ_JOINT, j, "joint") for j in range(model.njnt))
    _check(model, names)
    locked = _locked_values(model, names, locked_joints)
    mimic = _resolve_followers(names, [*followers, *_equality_followers(model, names)], locked)
    bodies, body_of, placement = _moving_bodies(model)
    frames = _frames(model, body_of, placement)
    tree = KinematicTree(
        body_names=tuple(_name(model, mujoco.mjtObj.mjOBJ_BODY, b, "body") for b in bodies),
        body_parents=tuple(int(body_of[model.body_parentid[b]]) if b else 0 for b in bodies),
        joint_names=names,
        joint_types=tuple(int(t) for t in model.jnt_type),
        joint_bodies=tuple(int(body_of[b]) for b in model.jnt_bodyid),
        frame_names=tuple(frames),
        frame_bodies=tuple(body for body, _, _ in frames.values()),
        followers=tuple((f, leader, multiplier) for f, leader, multiplier, _ in mimic),
        locked=tuple(sorted(locked)),
    )
    if tree.nv == 0:
        raise ValueError(f"the model has no joint left to move; joints: {', '.join(names)}, all locked")
    mass, com = _body_inertia(model, bodies, body_of, placement)
    offset = np.zeros(model.nq)
    for joint, value in locked.items():
        offset[model.jnt_qposadr[joint] :][: len(value)] = value
    for follower, _, _, value in mimic:
        offset[model.jnt_qposadr[follower]] = value
    lower, upper, speed = _limits(model, names, tree, mimic, velocity_limits or {})
    parent_rotation = [placement[model.body_parentid[b]][1] for b in bodies]
    parent_position = [placement[model.body_parentid[b]][0] for b in bodies]
    position = [p + R @ model.body_pos[b] for b, p, R in zip(bodies, parent_position, parent_rotation, strict=True)]
    quaternion = [
        _quaternion(R @ _matrix(model.body_quat[b])) for b, R in zip(bodies, parent_rotation, strict=True)
    ]
    home = model.key_qpos[0] if model.nkey else model.qpos0
    arrays = dict(
        body_position=position,
        body_quaternion=quaternion,
        body_mass=mass,
        body_com=com,
        joint_position=model.jnt_pos,
        joint_axis=model.jnt_axis,
        joint_reference=model.qpos0,
        frame_position=[p for _, p, _ in frames.values()],
        frame_rotation=[R for _, _, R in frames.values()],
        qpos_offset=offset,
        position_lower=lower,
        position_upper=upper,
        velocity_limit=speed,
        q0=_home(home, tree, lower, upper),
    )
    return dict(tree=tree, holder=ModelHolder(model), **{k: _float_array(v) for k, v in arrays.items()})


def _float_array(value: ArrayLike) -> Any:
    return jnp.asarray(np.asarray(value, float))


def _name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int, prefix: str) -> str:
    return mujoco.mj_id2name(model, kind, index) or f"{prefix}{index}"


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(quaternion, float))
    return out.reshape(3, 3)


def _quaternion(matrix: np.ndarray) -> np.ndarray:
    out = np.zeros(4)
    mujoco.mju_mat2Quat(out, matrix.ravel())
    return out


def _check(model: mujoco.MjModel, names: tuple[str, ...]) -> None:
    if model.njnt == 0:
        bodies = [_name(model, mujoco.mjtObj.mjOBJ_BODY, b, "body") for b in range(model.nbody)]
        raise ValueError(f"the model has no joint, so nothing can move; bodies: {', '.join(bodies)}")
    if not model.body_mass.sum() > 0.0:
        raise ValueError("the model has no mass: give at least one body an inertial with a positive mass")
    for joint, name in enumerate(names):
        low, high = model.jnt_range[joint]
        if model.jnt_limited[joint] and low > high:
            raise ValueError(f"joint {name!r} has limits with lower > upper: [{low}, {high}]")


def match_joints(pattern: str, names: tuple[str, ...]) -> list[int]:
    """Joints whose name is, or matches the glob, ``pattern``; KeyError with the names where none does."""
    found = [j for j, name in enumerate(names) if name == pattern or fnmatch.fnmatchcase(name, pattern)]
    if not found:
        raise unknown_name("joint", pattern, names)
    return found


def _locked_values(
    model: mujoco.MjModel, names: tuple[str, ...], locked: Iterable[str] | Mapping[str, float]
) -> dict[int, np.ndarray]:
    """Joint index to the qpos entries that it is frozen at; without a value, the entries of qpos0."""
    if isinstance(locked, str):
        raise TypeError(f"locked_joints is a sequence of names or a mapping, not one string: use ({locked!r},)")
    given = dict(locked) if isinstance(locked, Mapping) else dict.fromkeys(locked)
    out = {}
    for pattern, value in given.items():
        for joint in match_joints(pattern, names):
            scalar = model.jnt_type[joint] in (HINGE, SLIDE)
            if value is not None and not scalar:
                raise ValueError(f"joint {names[joint]!r} is free or ball: it can only be locked where the model has it")
            start = model.jnt_qposadr[joint]
            width = 1 if scalar else 7 if model.jnt_type[joint] == FREE else 4
            out[joint] = model.qpos0[start : start + width].copy() if value is None else np.array([float(value)])
    return out


def _equality_followers(model: mujoco.MjModel, names: tuple[str, ...]) -> list[Follower]:
    """Mimic relations of the model's joint equality constraints (active, linear, between two joints)."""
    out = []
    for e in range(model.neq):
        if model.eq_type[e] != mujoco.mjtEq.mjEQ_JOINT or not model.eq_active0[e] or model.eq_obj2id[e] < 0:
            continue
        constant, slope, *higher = model.eq_data[e][:5]
        if any(higher):
            continue
        follower, leader = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        y0, x0 = (model.qpos0[model.jnt_qposadr[j]] for j in (follower, leader))
        out.append((names[follower], names[leader], float(slope), float(y0 + constant - slope * x0)))
    return out


def _resolve_followers(
    names: tuple[str, ...], followers: Sequence[Follower], locked: dict[int, np.ndarray]
) -> list[tuple[int, int, float, float]]:
    """Followers by index, chains followed to their end; those that follow a locked joint become locked themselves."""
    table = {}
    for follower, leader, multiplier, offset in followers:
        for name in (follower, leader):
            if name not in names:
                raise unknown_name("joint", name, names)
        table[names.index(follower)] = (names.index(leader), multiplier, offset)
    out = []
    for follower in sorted(set(table) - set(locked)):
        leader, multiplier, offset = table[follower]
        seen = {follower}
        while leader in table and leader not in locked:
            if leader in seen:
                raise ValueError(f"mimic joints follow each other in a circle: {', '.join(names[j] for j in seen)}")
            seen.add(leader)
            leader, m, o = table[leader]
            multiplier, offset = multiplier * m, multiplier * o + offset
        if leader == follower:
            raise ValueError(f"joint {names[follower]!r} mimics itself")
        if leader in locked:
            locked[follower] = multiplier * locked[leader] + offset
        elif multiplier == 0.0:
            locked[follower] = np.array([offset])
        else:
            out.append((follower, leader, multiplier, offset))
    return out


def _moving_bodies(model: mujoco.MjModel) -> tuple[list[int], np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    """The world and the bodies with joints; for each body the moving body it is fixed to, and its pose there."""
    bodies, body_of = [0], np.zeros(model.nbody, int)
    placement = [(np.zeros(3), np.eye(3))]
    for b in range(1, model.nbody):
        if model.body_jntnum[b]:
            body_of[b] = len(bodies)
            bodies.append(b)
            placement.append((np.zeros(3), np.eye(3)))
        else:
            parent = model.body_parentid[b]
            body_of[b] = body_of[parent]
            p, R = placement[parent]
            placement.append((p + R @ model.body_pos[b], R @ _matrix(model.body_quat[b])))
    return bodies, body_of, placement


def _frames(
    model: mujoco.MjModel, body_of: np.ndarray, placement: list[tuple[np.ndarray, np.ndarray]]
) -> dict[str, tuple[int, np.ndarray, np.ndarray]]:
    """Name to (moving body, position, rotation). A site or geom that shares a name with another kind gets a prefix."""
    out = {}

    def add(name: str, prefix: str, body: int, position: np.ndarray, quaternion: np.ndarray) -> None:
        p, R = placement[body]
        key = name if name not in out else f"{prefix}:{name}"
        out[key] = (int(body_of[body]), p + R @ position, R @ _matrix(quaternion))

    for b in range(model.nbody):
        add(_name(model, mujoco.mjtObj.mjOBJ_BODY, b, "body"), "body", b, np.zeros(3), np.array([1.0, 0, 0, 0]))
    for s in range(model.nsite):
        name = _name(model, mujoco.mjtObj.mjOBJ_SITE, s, "site")
        add(name, "site", model.site_bodyid[s], model.site_pos[s], model.site_quat[s])
    for g in range(model.ngeom):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, g)
        if name:
            add(name, "geom", model.geom_bodyid[g], model.geom_pos[g], model.geom_quat[g])
    return out


def _body_inertia(
    model: mujoco.MjModel, bodies: list[int], body_of: np.ndarray, placement: list[tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Mass and centre of mass of each moving body with all that is fixed to it; what is fixed to the world counts 0."""
    mass, moment = np.zeros(len(bodies)), np.zeros((len(bodies), 3))
    for b in range(1, model.nbody):
        p, R = placement[b]
        mass[body_of[b]] += model.body_mass[b]
        moment[body_of[b]] += model.body_mass[b] * (p + R @ model.body_ipos[b])
    return mass, moment / np.where(mass > 0, mass, 1.0)[:, None]


def _limits(
    model: mujoco.MjModel,
    names: tuple[str, ...],
    tree: KinematicTree,
    mimic: list[tuple[int, int, float, float]],
    velocity_limits: Mapping[str, float],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position and velocity limits over v; a leader's are narrowed by those of its followers."""
    low, high = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    limited = model.jnt_limited.astype(bool) & np.isin(model.jnt_type, (HINGE, SLIDE))
    low[limited], high[limited] = model.jnt_range[limited].T
    speed = np.full(len(names), np.inf)
    for pattern, value in velocity_limits.items():
        for joint in match_joints(pattern, names):
            if not value > 0.0:
                raise ValueError(f"the velocity limit of joint {names[joint]!r} is {value}; it has to be positive")
            speed[joint] = value
    for follower, leader, multiplier, offset in mimic:
        a, b = sorted(((low[follower] - offset) / multiplier, (high[follower] - offset) / multiplier))
        low[leader], high[leader] = max(low[leader], a), min(high[leader], b)
        speed[leader] = min(speed[leader], speed[follower] / abs(multiplier))
        if low[leader] > high[leader]:
            raise ValueError(
                f"joint {names[leader]!r} and its follower {names[follower]!r} have no position in common: "
                f"lower {low[leader]} > upper {high[leader]}"
            )
    out = np.full(tree.nv, -np.inf), np.full(tree.nv, np.inf), np.full(tree.nv, np.inf)
    for joint, dof in tree.dof_address.items():
        width = DOF_WIDTH[tree.joint_types[joint]]
        for array, value in zip(out, (low, high, speed), strict=True):
            array[dof : dof + width] = value[joint]
    return out


def _home(qpos: np.ndarray, tree: KinematicTree, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """The independent entries of a full qpos, hinges and slides brought inside their limits."""
    q = np.zeros(tree.nq)
    for joint, start in tree.qpos_address.items():
        full = tree.full_qpos_address[joint]
        width = tree.full_qpos_address[joint + 1] - full
        value = qpos[full : full + width]
        if width == 1:
            dof = tree.dof_address[joint]
            value = np.clip(value, lower[dof], upper[dof])
        q[start : start + width] = value
    return q
