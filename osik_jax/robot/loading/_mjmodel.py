"""From a compiled MuJoCo model to the names and numbers of a robot."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from ..._errors import OsikTypeError, OsikValueError, warn
from .._model import RobotModel
from .._tree import DOF_WIDTH, HINGE, QPOS_WIDTH, SLIDE, KinematicTree, ModelHolder
from ._followers import (
    Follower,
    as_mapping,
    asked_locks,
    equality_followers,
    match_joints,
    qpos_offset,
    resolve_followers,
)
from ._options import LoadOptions, PositionLimits

VELOCITY_LIMIT_PREFIX = "velocity_limit/"
"""A custom numeric of this name and a joint's holds the joint's greatest speed [rad/s or m/s]."""

LEAST_INERTIA = 2e-15
"""Mass [kg] and moments [kg m^2] of moving bodies that have none: MuJoCo asks for more than 1e-15."""

_MASSLESS = 1e-14
"""Mass per body [kg] that counts as none: MuJoCo itself demands 1e-15 of every moving body."""

_ONE_VALUE = 1e-10
"""A range that is not wider is a single value [rad or m]; the bound is pink's."""


class Placement(NamedTuple):
    """The moving body (its number in the tree) that a body of the model is fixed to, and the body's pose in it."""

    body: int
    position: np.ndarray
    rotation: np.ndarray


def from_mjmodel(model: mujoco.MjModel, options: LoadOptions, *, fixed: Iterable[str] = ()) -> RobotModel:
    """Names and numbers of a robot from a MuJoCo model; see ``Robot.from_mjmodel``.

    Args:
        model: the model, with the floating base that it is to have.
        options: of which limits and locked joints are honoured here.
        fixed: names of free joints that are locked where the model has them, unless ``options`` lock them too.
    """
    if not isinstance(model, mujoco.MjModel):
        raise OsikTypeError(f"model is {model!r}; it is a mujoco.MjModel: for files there are from_mjcf and from_urdf")
    names = element_names(model, mujoco.mjtObj.mjOBJ_JOINT, "joint", model.njnt)
    body_names = element_names(model, mujoco.mjtObj.mjOBJ_BODY, "body", model.nbody)
    _check(model, names, body_names)
    asked = asked_locks(model, names, {**dict.fromkeys(fixed), **as_mapping(options.locked_joints)})
    followers, locked = resolve_followers(names, *equality_followers(model), asked)
    bodies, placement = _moving_bodies(model)
    frames = _frames(model, body_names, placement)
    tree = KinematicTree(
        body_names=tuple(body_names[b] for b in bodies),
        body_parents=tuple(placement[model.body_parentid[b]].body for b in bodies),
        joint_names=names,
        joint_types=tuple(int(t) for t in model.jnt_type),
        joint_bodies=tuple(placement[b].body for b in model.jnt_bodyid),
        frame_names=tuple(frames),
        frame_bodies=tuple(frame.body for frame in frames.values()),
        geom_names=element_names(model, mujoco.mjtObj.mjOBJ_GEOM, "geom", model.ngeom),
        geom_types=tuple(int(t) for t in model.geom_type),
        geom_bodies=tuple(placement[b].body for b in model.geom_bodyid),
        followers=tuple(follower[:3] for follower in followers),
        locked=tuple(sorted(locked)),
    )
    if tree.nv == 0:
        raise OsikValueError(f"the model has no joint left to move; joints: {', '.join(names)}, all locked")
    ranges = options.position_limits or {}
    low, high = _ranges(model, names, ranges)
    lower, upper, speed = _limits(tree, followers, low, high, _speeds(model, names, options.velocity_limits or {}))
    _warn_of_frozen(tree, lower, upper, ranges)
    home = model.key_qpos[0] if model.nkey else model.qpos0
    arrays = dict(
        **_body_arrays(model, bodies, placement),
        joint_position=model.jnt_pos,
        joint_axis=model.jnt_axis,
        dof_armature=model.dof_armature,
        joint_reference=model.qpos0,
        frame_position=[frame.position for frame in frames.values()],
        frame_rotation=[frame.rotation for frame in frames.values()],
        **_geom_arrays(model, placement),
        qpos_offset=qpos_offset(model, followers, locked),
        position_lower=lower,
        position_upper=upper,
        velocity_limit=speed,
        q0=_home(home, tree, lower, upper),
    )
    return RobotModel(tree=tree, holder=ModelHolder(model), **{k: _float_array(v) for k, v in arrays.items()})


def element_names(model: mujoco.MjModel, kind: mujoco.mjtObj, prefix: str, count: int) -> tuple[str, ...]:
    """Names of a model's bodies, joints or geoms; one without a name is called by its kind and number."""
    given = [mujoco.mj_id2name(model, kind, k) for k in range(count)]
    out = []
    for k, name in enumerate(given):
        free = f"{prefix}{k}"
        while free in given:
            free += "_"
        out.append(name or free)
    return tuple(out)


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion (w, x, y, z) of a rotation matrix."""
    out = np.zeros(4)
    mujoco.mju_mat2Quat(out, np.asarray(rotation, float).ravel())
    return out


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) of a unit quaternion (w, x, y, z)."""
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(quaternion, float))
    return out.reshape(3, 3)


def _float_array(value: ArrayLike) -> Any:
    return jnp.asarray(np.asarray(value, float))


def _check(model: mujoco.MjModel, names: tuple[str, ...], body_names: tuple[str, ...]) -> None:
    if model.njnt == 0:
        raise OsikValueError(f"the model has no joint, so nothing can move; bodies: {', '.join(body_names)}")
    moving = model.body_weldid != 0
    if not model.body_mass[moving].sum() > _MASSLESS * model.nbody:
        moving_names = (name for name, moves in zip(body_names, moving, strict=True) if moves)
        raise OsikValueError(f"nothing that moves has a mass; give one of these an inertial: {', '.join(moving_names)}")
    for joint, name in enumerate(names):
        low, high = model.jnt_range[joint]
        if low > high:  # which MuJoCo may take for "no limit"
            raise OsikValueError(f"joint {name!r} has limits with lower > upper: [{low}, {high}]")


def _moving_bodies(model: mujoco.MjModel) -> tuple[list[int], list[Placement]]:
    """The world and the bodies with joints; where each body of the model sits on them."""
    bodies, placement = [0], [Placement(0, np.zeros(3), np.eye(3))]
    for b in range(1, model.nbody):
        if model.body_jntnum[b]:
            placement.append(Placement(len(bodies), np.zeros(3), np.eye(3)))
            bodies.append(b)
        else:
            placement.append(_placed(placement[model.body_parentid[b]], model.body_pos[b], model.body_quat[b]))
    return bodies, placement


def _placed(on: Placement, position: np.ndarray, quaternion: np.ndarray) -> Placement:
    return Placement(on.body, on.position + on.rotation @ position, on.rotation @ rotation_matrix(quaternion))


def _frames(model: mujoco.MjModel, body_names: tuple[str, ...], placement: list[Placement]) -> dict[str, Placement]:
    """Bodies, named sites and named geoms. A site or geom called like what came before gets its kind as a prefix."""
    out = dict(zip(body_names, placement, strict=True))

    def add(kind: str, name: str | None, body: int, position: np.ndarray, quaternion: np.ndarray) -> None:
        if name:
            out[name if name not in out else f"{kind}:{name}"] = _placed(placement[body], position, quaternion)

    for s in range(model.nsite):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_SITE, s)
        add("site", name, model.site_bodyid[s], model.site_pos[s], model.site_quat[s])
    for g in range(model.ngeom):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, g)
        add("geom", name, model.geom_bodyid[g], model.geom_pos[g], model.geom_quat[g])
    return out


def _body_arrays(model: mujoco.MjModel, bodies: list[int], placement: list[Placement]) -> dict[str, ArrayLike]:
    """Poses of the moving bodies in their parents; their inertial properties with all that is fixed to them."""
    mass, moment, inertia = np.zeros(len(bodies)), np.zeros((len(bodies), 3)), np.zeros((len(bodies), 3, 3))
    parts = [(b, place, place.position + place.rotation @ model.body_ipos[b]) for b, place in enumerate(placement)]
    parts = [part for part in parts if part[1].body]  # what is fixed to the world is no part of what moves
    for b, place, center in parts:
        mass[place.body] += model.body_mass[b]
        moment[place.body] += model.body_mass[b] * center
    centers = moment / np.where(mass > 0.0, mass, 1.0)[:, None]
    for b, place, center in parts:
        axes, arm = place.rotation @ rotation_matrix(model.body_iquat[b]), center - centers[place.body]
        inertia[place.body] += axes * model.body_inertia[b] @ axes.T
        inertia[place.body] += model.body_mass[b] * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    poses = [_placed(placement[model.body_parentid[b]], model.body_pos[b], model.body_quat[b]) for b in bodies]
    return dict(
        body_position=[pose.position for pose in poses],
        body_quaternion=[quaternion(pose.rotation) for pose in poses],
        body_mass=mass,
        body_com=centers,
        body_inertia=inertia,
    )


def _geom_arrays(model: mujoco.MjModel, placement: list[Placement]) -> dict[str, ArrayLike]:
    """Poses of the geoms in the moving bodies, and their sizes."""
    described = zip(model.geom_bodyid, model.geom_pos, model.geom_quat, strict=True)
    poses = [_placed(placement[body], position, quaternion) for body, position, quaternion in described]
    meshes = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    return dict(
        geom_position=np.array([pose.position for pose in poses]).reshape(-1, 3),
        geom_rotation=np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3),
        geom_size=np.where(meshes[:, None], 1.0, model.geom_size),
    )


def _speeds(model: mujoco.MjModel, names: tuple[str, ...], given: Mapping[str, float]) -> np.ndarray:
    """Greatest speed of each joint: from the model's custom numerics, then from ``given``."""
    numerics = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_NUMERIC, n) for n in range(model.nnumeric)]
    out = np.full(len(names), np.inf)
    for n, numeric in enumerate(numerics):
        if numeric.startswith(VELOCITY_LIMIT_PREFIX):
            joint = numeric.removeprefix(VELOCITY_LIMIT_PREFIX)
            _set_speed(out, names, joint, float(model.numeric_data[model.numeric_adr[n]]))
    for pattern, value in given.items():
        _set_speed(out, names, pattern, float(value))
    return out


def _set_speed(speeds: np.ndarray, names: tuple[str, ...], pattern: str, value: float) -> None:
    for joint in match_joints(pattern, names):
        if not value > 0.0:
            raise OsikValueError(f"the velocity limit of joint {names[joint]!r} is {value}; it has to be positive")
        speeds[joint] = value


def _ranges(model: mujoco.MjModel, names: tuple[str, ...], given: PositionLimits) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper limit of each joint: from the model, then from ``given``."""
    low, high = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    scalar = np.isin(model.jnt_type, (HINGE, SLIDE))
    limited = model.jnt_limited.astype(bool) & scalar
    low[limited], high[limited] = model.jnt_range[limited].T
    for pattern, limits in given.items():
        joints = [joint for joint in match_joints(pattern, names) if scalar[joint] or names[joint] == pattern]
        lower, upper = _range(limits, pattern)
        for joint in joints:
            if not scalar[joint]:
                raise OsikValueError(f"joint {pattern!r} is free or ball; only hinges and slides have a range")
            low[joint], high[joint] = lower, upper
    return low, high


def _range(limits: tuple[float, float], pattern: str) -> tuple[float, float]:
    try:
        lower, upper = (float(value) for value in limits)
    except (TypeError, ValueError):
        raise OsikTypeError(f"position_limits[{pattern!r}] is {limits!r}; it is a pair (lower, upper)") from None
    if not lower <= upper:
        raise OsikValueError(f"position_limits[{pattern!r}] is {limits!r}; lower has to be less than upper")
    return lower, upper


def _limits(
    tree: KinematicTree, followers: list[Follower], low: np.ndarray, high: np.ndarray, speed: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position and velocity limits over v; a leader's are narrowed by those of its followers."""
    low, high, speed = low.copy(), high.copy(), speed.copy()
    for joint, leader, multiplier, offset in followers:
        a, b = sorted(((low[joint] - offset) / multiplier, (high[joint] - offset) / multiplier))
        low[leader], high[leader] = max(low[leader], a), min(high[leader], b)
        speed[leader] = min(speed[leader], speed[joint] / abs(multiplier))
        if low[leader] > high[leader]:
            raise OsikValueError(
                f"joint {tree.joint_names[leader]!r} and its follower {tree.joint_names[joint]!r} have no position "
                f"in common: lower {low[leader]} > upper {high[leader]}"
            )
    width = [DOF_WIDTH[tree.joint_types[j]] for j in tree.independent]
    lower, upper, velocity = (np.repeat(a[list(tree.independent)], width) for a in (low, high, speed))
    return lower, upper, velocity


def _warn_of_frozen(tree: KinematicTree, lower: np.ndarray, upper: np.ndarray, given: PositionLimits) -> None:
    """Names the joints whose range is one value, but for those whose range the user gave."""
    stated = {joint for pattern in given for joint in match_joints(pattern, tree.joint_names)}
    frozen = [j for j, dof in tree.dof_address.items() if upper[dof] - lower[dof] <= _ONE_VALUE and j not in stated]
    if frozen:
        names = [tree.joint_names[j] for j in frozen]
        shown = ", ".join(f"{tree.joint_names[j]} [{lower[tree.dof_address[j]]:g}]" for j in frozen)
        warn(
            f"these joints cannot move, for their range is a single value: {shown}. Say what is meant: "
            f"locked_joints={names!r} takes them out of q; position_limits={{{names[0]!r}: (-inf, inf)}} frees them, "
            "as pink and MuJoCo do"
        )


def _home(qpos: np.ndarray, tree: KinematicTree, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """The independent entries of a full qpos, hinges and slides brought inside their limits."""
    q = np.zeros(tree.nq)
    for joint, start in tree.qpos_address.items():
        full, width = tree.full_qpos_address[joint], QPOS_WIDTH[tree.joint_types[joint]]
        q[start : start + width] = qpos[full : full + width]
        if width == 1:
            dof = tree.dof_address[joint]
            q[start] = np.clip(q[start], lower[dof], upper[dof])
    return q
