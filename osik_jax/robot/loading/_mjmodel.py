"""Reader of a compiled MuJoCo model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from ..._errors import OsikTypeError, OsikValueError, warn
from ...numerics._host import to_jax
from .._load_report import LoadNote, LoadReport
from .._model import RobotModel
from .._ranges import first_of, inside, warn_of_fast_joints
from .._tree import BALL, FREE, HINGE, SLIDE, KinematicTree, ModelHolder, UnreadMesh
from ._followers import (
    Follower,
    as_mapping,
    asked_locks,
    equality_followers,
    free_name,
    match_names,
    number,
    qpos_offset,
    resolve_followers,
)
from ._look import UnreadLook
from ._notes import home_notes, keyframe_names, model_notes
from ._options import LoadOptions, PositionLimits
from ._poses import IDENTITY, Pose, quaternion, rotation_matrix
from ._robots import robot_trees

VELOCITY_LIMIT_PREFIX = "velocity_limit/"
"""A custom numeric of this name and a joint's holds the joint's greatest speed [rad/s or m/s]."""

ACCELERATION_LIMIT_PREFIX = "acceleration_limit/"
"""A custom numeric of this name and a joint's holds the joint's greatest acceleration [rad/s^2 or m/s^2]."""

EQUALITY_END_PREFIX = "equality_end/"
"""A site of this name and a constraint's is an end of that constraint, as ``to_mjcf`` writes it."""

LEAST_INERTIA = 2e-15
"""Mass [kg] and moments [kg m^2] of moving bodies that have none: MuJoCo asks for more than 1e-15."""


INERTIA = "inertia"
"""Element of notes on moments of inertia."""

LEAST_MASS = 1e-14
"""Mass per body [kg] that counts as none: MuJoCo itself demands 1e-15 of every moving body."""

_ONE_VALUE = 1e-10
"""A range that is not wider is a single value [rad or m]; the bound is pink's."""


_NOTES_SHOWN = 8
"""Number of lines of the load report in the warning."""


class Placement(NamedTuple):
    """The moving body (its number in the tree) that a body of the model is fixed to, and the body's pose in it."""

    body: int
    pose: Pose

    def carrying(self, pose: Pose) -> Placement:
        """Return where something with a pose in the body is."""
        return Placement(self.body, self.pose @ pose)


def from_mjmodel(
    model: mujoco.MjModel,
    options: LoadOptions,
    *,
    fixed: Iterable[str] = (),
    notes: Iterable[LoadNote] = (),
    meshes: Sequence[UnreadMesh] = (),
    look: UnreadLook | None = None,
    path: Path | None = None,
) -> RobotModel:
    """Return names and numbers of a robot from a MuJoCo model; see ``Robot.from_mjmodel``.

    The model has its floating base already. ``fixed`` names free joints that are locked where the model has them,
    unless ``options`` lock them too. ``notes`` are on elements of the file that the model lacks. ``meshes``, which the
    model does not hold, become the last of the robot's geoms. ``look`` and ``path`` are those of a URDF.
    """
    if not isinstance(model, mujoco.MjModel):
        raise OsikTypeError(f"model is {model!r}; it is a mujoco.MjModel: for files there are from_mjcf and from_urdf")
    names = element_names(model, "joint")
    body_names = element_names(model, "body")
    _check(model, names, body_names)
    asked = asked_locks(model, names, {**dict.fromkeys(fixed), **as_mapping(options.locked_joints)})
    followers, locked = resolve_followers(names, *equality_followers(model), asked)
    bodies, placement = _moving_bodies(model)
    frames = _frames(model, body_names, placement)
    mesh_places = [
        placement[body_names.index(mesh.link)].carrying(Pose(np.array(mesh.position), np.array(mesh.rotation)))
        for mesh in meshes
    ]
    tree = KinematicTree(
        body_names=tuple(body_names[b] for b in bodies),
        body_parents=tuple(placement[model.body_parentid[b]].body for b in bodies),
        joint_names=names,
        joint_types=tuple(int(t) for t in model.jnt_type),
        joint_bodies=tuple(placement[b].body for b in model.jnt_bodyid),
        frame_names=tuple(frames),
        frame_bodies=tuple(frame.body for frame in frames.values()),
        geom_names=_geom_names(model, body_names, meshes),
        geom_types=(*map(int, model.geom_type), *[int(mujoco.mjtGeom.mjGEOM_MESH)] * len(meshes)),
        geom_bodies=(*(placement[b].body for b in model.geom_bodyid), *(place.body for place in mesh_places)),
        followers=tuple(follower[:3] for follower in followers),
        locked=tuple(sorted(locked)),
        robots=_robots(model, body_names, placement, locked, options.root),
    )
    if tree.nv == 0:
        raise OsikValueError(f"the model has no joint left to move; joints: {', '.join(names)}, all locked")
    ranges = options.position_limits or {}
    low, high = _ranges(model, names, ranges)
    speeds = _rates(model, names, VELOCITY_LIMIT_PREFIX, "velocity", options.velocity_limits or {})
    own_speeds = _rates(model, names, VELOCITY_LIMIT_PREFIX, "velocity", {})
    warn_of_fast_joints(names, speeds, own_speeds, "velocity_limits")
    accelerations = _rates(model, names, ACCELERATION_LIMIT_PREFIX, "acceleration", {})
    lower, upper = _position_limits(tree, followers, low, high)
    _warn_of_frozen(tree, lower, upper, ranges)
    home = (model.key_qpos[0] if model.nkey else model.qpos0)[tree.own_qpos]
    found = [*notes, *_mass_notes(model, body_names), *model_notes(model, names)]
    if model.nkey and not options.has_home:
        found += home_notes(tree, keyframe_names(model)[0], home, lower, upper)
    report = LoadReport(note for note in found if note.name not in {names[j] for j in locked})
    _warn_of_report(report)
    arrays = dict(
        **moving_arrays(model),
        frame_position=[frame.pose.position for frame in frames.values()],
        frame_rotation=[frame.pose.rotation for frame in frames.values()],
        **_geom_arrays(model, placement, mesh_places),
        qpos_offset=qpos_offset(model, followers, locked),
        position_lower=lower,
        position_upper=upper,
        velocity_limit=_rate_limits(tree, followers, speeds),
        acceleration_limit=_rate_limits(tree, followers, accelerations),
        q0=inside(tree, home, lower, upper),
    )
    holder = ModelHolder(model, report, tuple(meshes), look, path)
    return RobotModel(tree=tree, holder=holder, **{k: to_jax(v, float) for k, v in arrays.items()})


def moving_arrays(model: mujoco.MjModel) -> dict[str, ArrayLike]:
    """Return the numbers of the moving bodies and of all joints, by field of ``RobotModel``."""
    joints = dict(joint_position=model.jnt_pos, joint_axis=model.jnt_axis, joint_reference=model.qpos0)
    return {**_body_arrays(model, *_moving_bodies(model)), **joints, "dof_armature": model.dof_armature}


def element_names(model: mujoco.MjModel, kind: Literal["body", "joint", "equality"]) -> tuple[str, ...]:
    """Return the names of a model's elements; one without a name is called by its kind and number."""
    count = dict(body=model.nbody, joint=model.njnt, equality=model.neq)[kind]
    given = [mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), k) for k in range(count)]
    return tuple(name or free_name(f"{kind}{k}", given) for k, name in enumerate(given))


def equality_end_sites(model: mujoco.MjModel) -> set[int]:
    """Return the sites that ``to_mjcf`` added as ends of constraints; they are no frames of the robot."""
    names = element_names(model, "equality")
    found: set[int] = set()
    for e in np.flatnonzero(model.eq_objtype == int(mujoco.mjtObj.mjOBJ_SITE)):
        ends = {int(model.eq_obj1id[e]), int(model.eq_obj2id[e])}
        if all(model.site(site).name.startswith(f"{EQUALITY_END_PREFIX}{names[e]}/") for site in ends):
            found |= ends
    return found


def _check(model: mujoco.MjModel, names: tuple[str, ...], body_names: tuple[str, ...]) -> None:
    if model.njnt == 0:
        raise OsikValueError(f"the model has no joint, so nothing can move; bodies: {', '.join(body_names)}")
    for joint, name in enumerate(names):
        low, high = model.jnt_range[joint]
        if low > high:  # which MuJoCo may take for "no limit"
            raise OsikValueError(f"joint {name!r} has limits with lower > upper: [{low}, {high}]")


def _moving_bodies(model: mujoco.MjModel) -> tuple[list[int], list[Placement]]:
    """Return the world and the bodies with joints, and on which of these each body of the model sits, and where."""
    bodies, placement = [0], [Placement(0, IDENTITY)]
    for b in range(1, model.nbody):
        if model.body_jntnum[b]:
            placement.append(Placement(len(bodies), IDENTITY))
            bodies.append(b)
        else:
            placement.append(placement[model.body_parentid[b]].carrying(_pose(model.body_pos[b], model.body_quat[b])))
    return bodies, placement


def _robots(
    model: mujoco.MjModel,
    names: Sequence[str],
    placement: list[Placement],
    locked: Iterable[int],
    root: str | Sequence[str] | None,
) -> tuple[tuple[int, ...], ...]:
    """Return the topmost moving bodies of each robot that the model may show; empty if the model is one tree."""
    found = robot_trees(model, names, locked, root)
    topmost = [b for b in range(1, model.nbody) if model.body_jntnum[b] and not placement[model.body_parentid[b]].body]
    if {model.body_rootid[b] for b in topmost} == {tree for trees in found for tree in trees} and len(found) == 1:
        return ()
    return tuple(tuple(placement[b].body for b in topmost if model.body_rootid[b] in trees) for trees in found)


def _pose(position: np.ndarray, quaternion: np.ndarray) -> Pose:
    return Pose(position, rotation_matrix(quaternion))


def _frames(model: mujoco.MjModel, body_names: tuple[str, ...], placement: list[Placement]) -> dict[str, Placement]:
    """Return bodies, named sites and named geoms.

    A site or geom called like what came before gets its kind as a prefix.
    """
    out = dict(zip(body_names, placement, strict=True))

    def add(kind: str, name: str | None, body: int, position: np.ndarray, quaternion: np.ndarray) -> None:
        if name:
            out[name if name not in out else f"{kind}:{name}"] = placement[body].carrying(_pose(position, quaternion))

    for s in sorted(set(range(model.nsite)) - equality_end_sites(model)):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_SITE, s)
        add("site", name, model.site_bodyid[s], model.site_pos[s], model.site_quat[s])
    for g in range(model.ngeom):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, g)
        add("geom", name, model.geom_bodyid[g], model.geom_pos[g], model.geom_quat[g])
    return out


def _body_arrays(model: mujoco.MjModel, bodies: list[int], placement: list[Placement]) -> dict[str, ArrayLike]:
    """Return the poses of moving bodies in their parents, and their inertial properties with all fixed to them."""
    mass, moment, inertia = np.zeros(len(bodies)), np.zeros((len(bodies), 3)), np.zeros((len(bodies), 3, 3))
    parts = [
        (b, place, place.pose.position + place.pose.rotation @ model.body_ipos[b]) for b, place in enumerate(placement)
    ]
    parts = [part for part in parts if part[1].body]  # what is fixed to the world is no part of what moves
    for b, place, center in parts:
        mass[place.body] += model.body_mass[b]
        moment[place.body] += model.body_mass[b] * center
    centers = moment / np.where(mass > 0.0, mass, 1.0)[:, None]
    for b, place, center in parts:
        axes, arm = place.pose.rotation @ rotation_matrix(model.body_iquat[b]), center - centers[place.body]
        inertia[place.body] += axes * model.body_inertia[b] @ axes.T
        inertia[place.body] += model.body_mass[b] * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    poses = [placement[model.body_parentid[b]].carrying(_pose(model.body_pos[b], model.body_quat[b])) for b in bodies]
    return dict(
        body_position=[place.pose.position for place in poses],
        body_quaternion=[quaternion(place.pose.rotation) for place in poses],
        body_mass=mass,
        body_com=centers,
        body_inertia=inertia,
    )


def _geom_names(model: mujoco.MjModel, body_names: Sequence[str], meshes: Sequence[UnreadMesh]) -> tuple[str, ...]:
    """Return the names of the geoms, then of the collision meshes that the model does not hold.

    One without a name is called by its link and its number among the link's shapes, of which those that collide come
    first: ``forearm_link:0``.
    """
    given = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, g) for g in range(model.ngeom)]
    given += [mesh.name for mesh in meshes]
    links = [*(body_names[b] for b in model.geom_bodyid), *(mesh.link for mesh in meshes)]
    collides = [*((model.geom_contype | model.geom_conaffinity) != 0), *[True] * len(meshes)]
    order = sorted(range(len(links)), key=lambda k: not collides[k])
    numbers = [[links[m] for m in order[: order.index(k)]].count(link) for k, link in enumerate(links)]
    out: list[str] = []
    for name, link, index in zip(given, links, numbers, strict=True):
        taken = out if name else [*given, *out]
        out.append(free_name(name or f"{link}:{index}", taken))
    return tuple(out)


def _geom_arrays(
    model: mujoco.MjModel, placement: list[Placement], meshes: Sequence[Placement]
) -> dict[str, ArrayLike]:
    """Return the poses of the geoms in the moving bodies, and their sizes; meshes that the model does not hold last."""
    described = zip(model.geom_bodyid, model.geom_pos, model.geom_quat, strict=True)
    poses = [
        *(placement[body].carrying(_pose(position, quaternion)) for body, position, quaternion in described),
        *meshes,
    ]
    size = np.where(model.geom_type[:, None] == mujoco.mjtGeom.mjGEOM_MESH, 1.0, model.geom_size)
    return dict(
        geom_position=np.array([place.pose.position for place in poses]).reshape(-1, 3),
        geom_rotation=np.array([place.pose.rotation for place in poses]).reshape(-1, 3, 3),
        geom_size=np.concatenate([size, np.ones((len(meshes), 3))]),
    )


def _rates(
    model: mujoco.MjModel, names: tuple[str, ...], prefix: str, what: str, given: Mapping[str, float]
) -> np.ndarray:
    """Return greatest speed or acceleration of each joint: from the model's custom numerics, then from ``given``."""
    numerics = [model.numeric(n) for n in range(model.nnumeric)]
    own = {one.name.removeprefix(prefix): float(one.data[0]) for one in numerics if one.name.startswith(prefix)}
    out = np.full(len(names), np.inf)
    if not isinstance(given, Mapping):
        raise OsikTypeError(f"{what}_limits is {given!r}; it maps joint names or globs to numbers")
    for pattern, value in (*own.items(), *given.items()):  # a robot's own 0 holds the joint; a given one is a mistake
        for joint in match_names("joint", pattern, names):
            limit = number(value, f"the {what} limit of joint {names[joint]!r}")
            if not (limit > 0.0 or limit == 0.0 == own.get(names[joint])):
                raise OsikValueError(f"the {what} limit of joint {names[joint]!r} is {value}; it has to be positive")
            out[joint] = limit
    return out


def _ranges(model: mujoco.MjModel, names: tuple[str, ...], given: PositionLimits) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper limit of each joint: the model's, then those of ``given``.

    For a ball they are minus and plus its largest angle.
    """
    low, high = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    ball = model.jnt_type == BALL
    limited = model.jnt_limited.astype(bool) & np.isin(model.jnt_type, (HINGE, SLIDE))
    low[limited], high[limited] = model.jnt_range[limited].T
    for joint in np.flatnonzero(model.jnt_limited.astype(bool) & ball):
        low[joint], high[joint] = _ball_range((0.0, model.jnt_range[joint].max()), names[joint])
    for pattern, limits in given.items():
        lower, upper = _range(limits, pattern)
        found = [joint for joint in match_names("joint", pattern, names) if model.jnt_type[joint] != FREE]
        if not found and pattern in names:
            raise OsikValueError(f"joint {pattern!r} is free; only hinges, slides and balls have a range")
        scalar = [joint for joint in found if not ball[joint]]
        for joint in scalar or found:  # a glob that matches hinges or slides says nothing of balls
            low[joint], high[joint] = _ball_range((lower, upper), names[joint]) if ball[joint] else (lower, upper)
    return low, high


def _ball_range(limits: tuple[float, float], name: str) -> tuple[float, float]:
    """Return minus and plus the largest angle of a ball joint; infinite from pi on, because no angle exceeds pi."""
    lower, upper = limits
    if not upper > 0.0 or lower not in (0.0, -upper):
        raise OsikValueError(
            f"the range of the ball joint {name!r} is {limits}; it is (0, the greatest angle by which it is turned)"
        )
    return (-upper, upper) if upper < np.pi else (-np.inf, np.inf)


def _range(limits: tuple[float, float], pattern: str) -> tuple[float, float]:
    try:
        lower, upper = (float(value) for value in limits)
    except (TypeError, ValueError):
        raise OsikTypeError(f"position_limits[{pattern!r}] is {limits!r}; it is a pair (lower, upper)") from None
    if not lower <= upper:
        raise OsikValueError(f"position_limits[{pattern!r}] is {limits!r}; lower has to be less than upper")
    if lower == np.inf or upper == -np.inf:
        raise OsikValueError(f"position_limits[{pattern!r}] is {limits!r}: no position is between these")
    return lower, upper


def _position_limits(
    tree: KinematicTree, followers: list[Follower], low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return position limits over v; a leader's are narrowed by those of its followers."""
    low, high = low.copy(), high.copy()
    for joint, leader, multiplier, offset in followers:
        a, b = sorted(((low[joint] - offset) / multiplier, (high[joint] - offset) / multiplier))
        low[leader], high[leader] = max(low[leader], a), min(high[leader], b)
        if low[leader] > high[leader]:
            raise OsikValueError(
                f"joint {tree.joint_names[leader]!r} and its follower {tree.joint_names[joint]!r} have no position "
                f"in common: lower {low[leader]} > upper {high[leader]}"
            )
    return _over_dofs(tree, low), _over_dofs(tree, high)


def _rate_limits(tree: KinematicTree, followers: list[Follower], rates: np.ndarray) -> np.ndarray:
    """Return greatest speeds or accelerations over v; a leader's are narrowed by those of its followers."""
    rates = rates.copy()
    for joint, leader, multiplier, _ in followers:
        rates[leader] = min(rates[leader], rates[joint] / abs(multiplier))
    return _over_dofs(tree, rates)


def _over_dofs(tree: KinematicTree, values: np.ndarray) -> np.ndarray:
    """Return the values of joints, repeated for each entry of v of the independent joints."""
    return values[tree.dof_joint[tree.own_dofs]]


def _warn_of_frozen(tree: KinematicTree, lower: np.ndarray, upper: np.ndarray, given: PositionLimits) -> None:
    """Name the joints whose range is one value, but for those whose range the user gave."""
    stated = {joint for pattern in given for joint in match_names("joint", pattern, tree.joint_names)}
    frozen = [j for j, dof in tree.dof_address.items() if upper[dof] - lower[dof] <= _ONE_VALUE and j not in stated]
    if frozen:
        names = [tree.joint_names[j] for j in frozen]
        shown = ", ".join(f"{tree.joint_names[j]} [{lower[tree.dof_address[j]]:g}]" for j in frozen)
        warn(
            f"these joints cannot move, for their range is a single value: {shown}. Say what is meant: "
            f"locked_joints={names!r} takes them out of q; position_limits={{{names[0]!r}: (-inf, inf)}} frees them, "
            "as pink and MuJoCo do"
        )


def _mass_notes(model: mujoco.MjModel, body_names: tuple[str, ...]) -> Iterator[LoadNote]:
    """Yield a note if no body that moves has a mass."""
    moving = model.body_weldid != 0
    if not model.body_mass[moving].sum() > LEAST_MASS * model.nbody:
        names = [name for name, moves in zip(body_names, moving, strict=True) if moves]
        done = "nothing that moves has a mass: there is no centre of mass, momentum or kinetic energy"
        yield LoadNote("inertial", first_of(names), done)


def _warn_of_report(report: LoadReport) -> None:
    """Give one warning for everything that the file asks for and the robot does not keep."""
    moving = [str(note) for note in report if note.element != INERTIA]  # which changes no motion
    if moving:
        shown = first_of(moving, _NOTES_SHOWN)
        warn(f"the robot does not keep all that its file asks for (print(robot.load_report)): {shown}")
