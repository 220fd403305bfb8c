"""Mimic joints and locked joints of a MuJoCo model."""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from ..._errors import OsikTypeError, OsikValueError, unknown_name
from .._tree import BALL, FREE, QPOS_WIDTH

_LOCK_TOLERANCE = 1e-9
"""Tolerance between the value asked of a locked follower and the value its leader implies [rad or m]."""


class Follower(NamedTuple):
    """A follower and its leader, by joint index: ``q_joint = multiplier * q_leader + offset``."""

    joint: int
    leader: int
    multiplier: float
    offset: float


class Lock(NamedTuple):
    """Entries of qpos at which a joint is locked, and whether the user gave them."""

    value: np.ndarray
    given: bool


def as_mapping(locked: Any) -> dict[str, Any]:
    """Return the names or globs of joints to lock, with their values or None."""
    if isinstance(locked, str):
        raise OsikTypeError(f"locked_joints is a sequence of names or a mapping, not one string: use ({locked!r},)")
    if not isinstance(locked, Iterable):
        raise OsikTypeError(f"locked_joints is {locked!r}; it is a sequence of names or a mapping from names to values")
    return dict(locked) if isinstance(locked, Mapping) else dict.fromkeys(locked)


def number(value: Any, what: str) -> float:
    """Return the value as a number; raise TypeError if it is none."""
    try:
        return float(value)
    except (TypeError, ValueError):
        raise OsikTypeError(f"{what} is {value!r}; it is a number") from None


def match_names(kind: str, pattern: str, names: tuple[str, ...]) -> list[int]:
    """Return the places of a name, else of those that match it as a glob; raise KeyError if there are none."""
    if pattern in names:
        return [names.index(pattern)]
    found = [k for k, name in enumerate(names) if fnmatch.fnmatchcase(name, str(pattern))]
    if not found:
        raise unknown_name(kind, pattern, names)
    return found


def free_name(name: str, taken: Collection[str | None]) -> str:
    """Return the name, followed by as many underscores as make it differ from those taken."""
    while name in taken:
        name += "_"
    return name


def asked_locks(model: mujoco.MjModel, names: tuple[str, ...], asked: Mapping[str, Any]) -> dict[int, Lock]:
    """Return the requested value of each locked joint, by joint index; the default is its value in qpos0."""
    out: dict[int, Lock] = {}
    for pattern, value in asked.items():
        for joint in match_names("joint", pattern, names):
            start, kind = model.jnt_qposadr[joint], int(model.jnt_type[joint])
            if value is None:
                out[joint] = Lock(model.qpos0[start : start + QPOS_WIDTH[kind]].copy(), given=False)
            elif kind in (FREE, BALL):
                raise OsikValueError(
                    f"joint {names[joint]!r} is free or ball: it can only be locked where the model has it"
                )
            elif not math.isfinite(at := number(value, f"the value at which joint {names[joint]!r} is locked")):
                raise OsikValueError(f"joint {names[joint]!r} cannot be locked at {value}")
            else:
                out[joint] = Lock(np.array([at]), given=True)
    return out


def equality_followers(model: mujoco.MjModel) -> tuple[list[Follower], dict[int, np.ndarray]]:
    """Return the followers, linear in another joint, and the constant joints of the active joint equality constraints.

    Those of a higher degree are left out.
    """
    followers: list[Follower] = []
    constants: dict[int, np.ndarray] = {}
    for e in np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & model.eq_active0.astype(bool)):
        joint, leader = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        constant, multiplier, *higher = (float(x) for x in model.eq_data[e][:5])
        reference = float(model.qpos0[model.jnt_qposadr[joint]])
        if leader < 0 or not (multiplier or any(higher)):
            value = np.array([reference + constant])
            if abs(constants.setdefault(joint, value) - value).max() > _LOCK_TOLERANCE:
                name, (first,), (second,) = model.joint(joint).name, constants[joint], value
                raise OsikValueError(f"joint {name!r} is held at {first:g} and at {second:g} by two joint equalities")
        elif not any(higher):
            start = float(model.qpos0[model.jnt_qposadr[leader]])
            followers.append(Follower(joint, leader, multiplier, reference + constant - multiplier * start))
    return followers, constants


def resolve_followers(
    names: tuple[str, ...],
    relations: Sequence[Follower],
    constants: Mapping[int, np.ndarray],
    asked: Mapping[int, Lock],
) -> tuple[list[Follower], dict[int, np.ndarray]]:
    """Return the followers of independent joints, chains followed to their end, and the values of all locked joints.

    A follower whose leader is locked is locked where the leader puts it.
    """
    table, constants = _independent(names, relations, constants)
    locked = {joint: lock.value for joint, lock in asked.items() if joint not in table} | dict(constants)
    followers = []
    for joint in sorted(table):
        follower = _end_of_chain(table, joint)
        if follower.leader in locked:
            locked[joint] = follower.multiplier * locked[follower.leader] + follower.offset
            _check_lock(names, follower, asked.get(joint), locked[joint])
        elif joint in asked:
            raise OsikValueError(
                f"joint {names[joint]!r} cannot be locked alone: it mimics {names[follower.leader]!r}, lock that one"
            )
        else:
            followers.append(follower)
    return followers, locked


def _independent(
    names: tuple[str, ...], relations: Sequence[Follower], constants: Mapping[int, np.ndarray]
) -> tuple[dict[int, Follower], dict[int, np.ndarray]]:
    """Return followers without circles, at most one for each joint, and all constant joints.

    A joint with several relations ties their leaders to each other.
    """
    table: dict[int, Follower] = {}
    held = dict(constants)
    for relation in relations:
        own, other = _end_of_chain(table, relation.joint), _end_of_chain(table, relation.leader)
        multiplier = relation.multiplier * other.multiplier / own.multiplier
        offset = (relation.multiplier * other.offset + relation.offset - own.offset) / own.multiplier
        if own.leader != other.leader and own.leader not in held:
            table[own.leader] = Follower(own.leader, other.leader, multiplier, offset)
        elif own.leader != other.leader and other.leader not in held:
            held[other.leader] = (held[own.leader] - offset) / multiplier
        elif not _agrees(held, own.leader, other.leader, multiplier, offset):
            raise OsikValueError(
                f"joint equalities contradict each other: one says {names[relation.joint]} = {relation.multiplier:g} "
                f"{names[relation.leader]} {relation.offset:+g}, which the others do not allow; deactivate one"
            )
    return table, held


def _agrees(held: Mapping[int, np.ndarray], joint: int, leader: int, multiplier: float, offset: float) -> bool:
    """Return whether ``q_joint = multiplier * q_leader + offset`` holds already."""
    if joint == leader and joint not in held:
        return max(abs(multiplier - 1.0), abs(offset)) <= _LOCK_TOLERANCE
    return abs(float(held[joint][0] - multiplier * held[leader][0]) - offset) <= _LOCK_TOLERANCE


def _end_of_chain(table: Mapping[int, Follower], joint: int) -> Follower:
    """Return the joint in terms of an independent leader: itself, if it follows none."""
    leader, multiplier, offset = joint, 1.0, 0.0
    while leader in table:
        _, leader, m, o = table[leader]
        multiplier, offset = multiplier * m, multiplier * o + offset
    return Follower(joint, leader, multiplier, offset)


def _check_lock(names: tuple[str, ...], follower: Follower, asked: Lock | None, value: np.ndarray) -> None:
    if asked is not None and asked.given and abs(asked.value - value).max() > _LOCK_TOLERANCE:
        raise OsikValueError(
            f"joint {names[follower.joint]!r} cannot be locked at {asked.value[0]}: it mimics "
            f"{names[follower.leader]!r}, which puts it at {value[0]}"
        )


def qpos_offset(model: mujoco.MjModel, followers: list[Follower], locked: Mapping[int, np.ndarray]) -> np.ndarray:
    """Return the values of locked joints and offsets of followers in the model's qpos, 0 elsewhere."""
    out = np.zeros(model.nq)
    for joint, value in locked.items():
        out[model.jnt_qposadr[joint] :][: len(value)] = value
    for follower in followers:
        out[model.jnt_qposadr[follower.joint]] = follower.offset
    return out
