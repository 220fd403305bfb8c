"""MuJoCo model of a robot on a floor, with contact at its feet and a position servo on every joint."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from .._errors import OsikTypeError, OsikValueError
from ..kinematics._forward import body_masses
from ..robot import Robot
from ..robot._guesses import with_corners
from ..robot._mujoco import home_poses, model_bodies, mujoco_frame_pose
from ..robot._tree import BALL, FREE
from ..robot.loading._equalities import KINDS, is_in_tree
from ..robot.loading._mjmodel import element_names, moving_arrays
from ._servo import Servo, add_servo, choose_servos

Feet = Mapping[str, ArrayLike] | Sequence[str]
"""Frames that touch the floor: names with their contact points in the frame [m], or names alone (see ``build_world``).
"""

CONTACT_RADIUS = 0.004
"""Radius of the contact spheres [m]; each is placed so that it touches the floor at its contact point."""

_COPIED = (
    *("body_gravcomp", "dof_armature", "dof_damping", "dof_frictionloss", "dof_solref", "dof_solimp"),
    *("jnt_stiffness", "jnt_solref", "jnt_solimp", "jnt_margin", "qpos_spring"),
)
"""Numbers of the robot's own model that the world takes over as they are: both have the same bodies and joints."""

_GEARED = dict(solref=(0.004, 1.0), solimp=(0.99, 0.999, 0.001, 0.5, 2.0))
"""One motor that turns two joints is stiffer than MuJoCo's default for an equality."""
_SHAPES = range(int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_BOX) + 1)
"""Geom types that a world shows: sphere, capsule, ellipsoid, cylinder and box."""


@dataclasses.dataclass(frozen=True)
class World:
    """A robot on a floor, ready for MuJoCo; ``build_world`` says what the fields are."""

    robot: Robot
    model: mujoco.MjModel
    servos: Mapping[str, Servo]
    feet: Mapping[str, Float[np.ndarray, "k 3"]]
    floor: float

    def contact_geoms(self, foot: str) -> list[int]:
        """Return the spheres of a foot, by their number in the model."""
        return [self.model.geom(_geom_name(foot, k)).id for k in range(len(self.feet[foot]))]


def build_world(
    robot: Robot,
    *,
    feet: Feet | None = None,
    servos: Mapping[str, Servo] | None = None,
    friction: float = 0.9,
    floor: float | None = None,
    timestep: float = 0.001,
) -> World:
    """Return a world with the robot on a floor.

    Masses, inertias, joint damping, armature and friction are those of ``robot.mj_model``, as MuJoCo compiled them; no
    geometry of it collides. A follower of a mimic joint is geared to its leader, a locked joint held where it is, and
    closed loops are kept. Tendons are not.

    Args:
        robot: the robot.
        feet: frames that touch the floor, with contact points in the frame [m], (k, 3). Without points: the lower
            corners of the boxes that collide on the frame's body, else the sites ``NAME_corner_0``, ``NAME_corner_1``
            and so on. Default: all frames that have such sites. A robot that is bolted down needs none.
        servos: joint name or glob to its servo. Joints that are left out keep the position actuator of
            ``robot.mj_model``, its gear included: the embedded robots have one on every joint.
        friction: sliding friction between feet and floor.
        floor: its height [m]; default: that of the lowest contact point at ``robot.q0``.
        timestep: of the simulation [s].

    Returns:
        The world.

        - ``robot``: the robot.
        - ``model``: the compiled world: bodies and joints of ``robot.mj_model`` in its order, a floor, spheres that
            touch it at the contact points, an actuator a servo. Its timestep is that of the simulation.
        - ``servos``: by joint; the actuators have the same names and order.
        - ``feet``: frame to its contact points in the frame [m]. Each (k, 3)
        - ``floor``: height of the floor [m].

    Raises:
        KeyError: no such frame or joint; the message lists those that exist.
        ValueError: a floating robot without contact points, a joint without a servo, a joint that no servo can turn
            (ball), a locked joint that is free or ball, a robot without masses, or with other numbers than
            ``robot.mj_model``, or a number out of range.
    """
    if not (0.0 < timestep < math.inf and 0.0 <= friction < math.inf and math.isfinite(floor or 0.0)):
        raise OsikValueError(
            f"timestep is {timestep}, friction {friction}, floor {floor}; the first has to be positive, all finite"
        )
    body_masses(robot)  # raises if there is no mass
    _check_unedited(robot)
    points = _contact_points(robot, feet)
    drives = choose_servos(robot, servos or {})
    home = home_poses(robot)
    poses = {foot: mujoco_frame_pose(robot, home, foot) for foot in points}
    lowest = [float((p + points[foot] @ R.T)[:, 2].min()) for foot, (p, R) in poses.items()]
    height = (min(lowest) if lowest else 0.0) if floor is None else float(floor)
    spec = mujoco.MjSpec()
    _set_options(spec, timestep, robot.mj_model)
    bodies = _add_bodies(spec, robot.mj_model)
    _add_floor(spec, height, friction)
    for foot, (_, rotation) in poses.items():
        _add_contacts(spec, bodies, robot, foot, points[foot], rotation, friction)
    _add_ties(spec, robot)
    _add_constraints(spec, bodies, robot.mj_model)
    for joint, servo in drives.items():
        add_servo(spec, joint, servo)
    return World(robot, _compiled(spec, robot.mj_model), drives, points, height)


def _check_unedited(robot: Robot) -> None:
    """Raise ValueError for a robot whose bodies or joints are not those of its model."""
    for field, values in moving_arrays(robot.mj_model).items():
        own = np.asarray(values)
        if not np.allclose(getattr(robot, field), own, rtol=1e-5, atol=1e-6 * np.abs(own).max()):
            raise OsikValueError(
                f"{field} of the robot is not that of robot.mj_model, which is what is simulated: take "
                "Robot.from_mjcf(robot.to_mjcf()), and give servos=, for that keeps no actuators"
            )


def _contact_points(robot: Robot, feet: Feet | None) -> dict[str, Float[np.ndarray, "k 3"]]:
    """Return the names of frames with their contact points."""
    feet = with_corners(robot.frame_names) if feet is None else feet
    if isinstance(feet, str):
        raise OsikTypeError(f"feet is a sequence of names or a mapping, not one string: use ({feet!r},)")
    given = dict(feet) if isinstance(feet, Mapping) else {name: sole_points(robot, name) for name in feet}
    out = {name: np.atleast_2d(np.asarray(points, float)) for name, points in given.items()}
    for name, points in out.items():
        robot.tree.frame(name)
        if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
            raise OsikValueError(
                f"foot {name!r} has no contact points: give feet={{{name!r}: points}}, finite and (k, 3) in the frame "
                f"[m]; or its model sites {name}_corner_0, {name}_corner_1, ..., or a box that collides"
            )
    if robot.floating_base and not out:
        raise OsikValueError("a floating robot needs feet={frame: contact points (k, 3)} to stand on")
    return out


def contact_corners(robot: Robot, frame: str) -> Float[np.ndarray, "k 3"]:
    """Return the frames ``NAME_corner_0``, ``..._1`` and so on, as points in the frame [m]; none: (0, 3)."""
    tree = robot.tree
    names = [f"{frame}_corner_{k}" for k in range(len(tree.frame_names))]
    found = [tree.frame(name) for name in names if name in tree.frame_names]
    return _in_frame(robot, frame, np.asarray(robot.frame_position)[np.array(found, int)])


def _in_frame(robot: Robot, frame: str, points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
    """Return the points of the body that a frame is fixed to, seen from the frame."""
    index = robot.tree.frame(frame)
    return (points - np.asarray(robot.frame_position[index])) @ np.asarray(robot.frame_rotation[index])


def sole_points(robot: Robot, frame: str) -> Float[np.ndarray, "k 3"]:
    """Return the lower corners, at home, of colliding boxes on the frame's body; without boxes, its corner sites."""
    model, data = robot.mj_model, home_poses(robot)
    body = model_bodies(robot)[robot.tree.frame_bodies[robot.tree.frame(frame)]]
    solid = (model.geom_bodyid == body) & ((model.geom_contype != 0) | (model.geom_conaffinity != 0))
    boxes = np.flatnonzero(solid & (model.geom_type == mujoco.mjtGeom.mjGEOM_BOX))
    if not len(boxes):
        return contact_corners(robot, frame)
    origin, rotation = mujoco_frame_pose(robot, data, frame)
    corners = np.concatenate([_lower_corners(model, data, int(g)) for g in boxes])
    return (corners - origin) @ rotation


def _lower_corners(model: mujoco.MjModel, data: mujoco.MjData, box: int) -> Float[np.ndarray, "4 3"]:
    """Return the lower corners, counter-clockwise seen from above, in the world [m]."""
    turn = data.geom_xmat[box].reshape(3, 3) * model.geom_size[box]
    down = int(np.argmax(np.abs(turn[2] / model.geom_size[box])))
    a, b = (turn[:, k] for k in range(3) if k != down)
    face = data.geom_xpos[box] - np.sign(turn[2, down]) * turn[:, down]
    left = b if a[0] * b[1] > a[1] * b[0] else -b
    return np.array([face + a + left, face - a + left, face - a - left, face + a - left])


def _set_options(spec: mujoco.MjSpec, timestep: float, source: mujoco.MjModel) -> None:
    spec.compiler.degree = False
    spec.option.timestep = timestep
    spec.option.gravity = source.opt.gravity
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 100.0  # feet that stick do not creep


def _add_bodies(spec: mujoco.MjSpec, model: mujoco.MjModel) -> list[mujoco.MjsBody]:
    """Return the bodies of a compiled model with their inertias and joints, in the same order."""
    bodies, names, joints = [spec.worldbody], element_names(model, "body"), element_names(model, "joint")
    for b in range(1, model.nbody):
        body = bodies[model.body_parentid[b]].add_body(
            name=names[b],
            pos=model.body_pos[b],
            quat=model.body_quat[b],
            mass=model.body_mass[b],
            ipos=model.body_ipos[b],
            iquat=model.body_iquat[b],
            inertia=model.body_inertia[b],
            explicitinertial=True,
        )
        for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b]):
            body.add_joint(name=joints[j], **_joint(model, j))
        for g in range(model.body_geomadr[b], model.body_geomadr[b] + model.body_geomnum[b]):
            _add_shape(body, model, g)
        bodies.append(body)
    return bodies


def _add_shape(body: mujoco.MjsBody, model: mujoco.MjModel, g: int) -> None:
    """Add a geom for display alone; meshes and height fields are left out."""
    kind = mujoco.mjtGeom(int(model.geom_type[g]))
    if int(kind) in _SHAPES:
        look = dict(type=kind, pos=model.geom_pos[g], quat=model.geom_quat[g], size=model.geom_size[g])
        body.add_geom(**look, rgba=model.geom_rgba[g], group=model.geom_group[g], contype=0, conaffinity=0, mass=0.0)


def _joint(model: mujoco.MjModel, j: int) -> dict[str, Any]:
    kind = mujoco.mjtJoint(int(model.jnt_type[j]))
    out: dict[str, Any] = dict(type=kind, align=mujoco.mjtAlignFree.mjALIGNFREE_FALSE)
    if kind == mujoco.mjtJoint.mjJNT_FREE:
        return out
    limited = mujoco.mjtLimited.mjLIMITED_TRUE if model.jnt_limited[j] else mujoco.mjtLimited.mjLIMITED_FALSE
    out |= dict(pos=model.jnt_pos[j], axis=model.jnt_axis[j], range=model.jnt_range[j], limited=limited)
    if kind != mujoco.mjtJoint.mjJNT_BALL:
        out["ref"] = model.qpos0[model.jnt_qposadr[j]]
    return out


def _add_floor(spec: mujoco.MjSpec, height: float, friction: float) -> None:
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=(0.0, 0.0, height),
        size=(0.0, 0.0, 1.0),
        friction=(friction, 0.005, 0.0001),
        contype=1,
        conaffinity=0,
    )


def _geom_name(foot: str, k: int) -> str:
    return f"{foot}_contact_{k}"


def _add_contacts(
    spec: mujoco.MjSpec,
    bodies: Sequence[mujoco.MjsBody],
    robot: Robot,
    foot: str,
    points: Float[np.ndarray, "k 3"],
    rotation: Float[np.ndarray, "3 3"],
    friction: float,
) -> None:
    """Add a massless sphere on each contact point, placed up along the floor's normal as the foot stands at home."""
    index = robot.tree.frame(foot)
    body = bodies[model_bodies(robot)[robot.tree.frame_bodies[index]]]
    up = rotation.T @ np.array([0.0, 0.0, CONTACT_RADIUS])
    centers = np.asarray(robot.frame_position[index]) + (points + up) @ np.asarray(robot.frame_rotation[index]).T
    for k, center in enumerate(centers):
        body.add_geom(
            name=_geom_name(foot, k),
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=center,
            size=(CONTACT_RADIUS, 0.0, 0.0),
            mass=0.0,
            friction=(friction, 0.005, 0.0001),
            contype=0,
            conaffinity=1,
        )


def _add_ties(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Add equalities that gear followers to their leaders and hold locked hinges and slides."""
    tree, model = robot.tree, robot.mj_model
    offset, reference = np.asarray(robot.qpos_offset), model.qpos0
    for follower, leader, multiplier in tree.followers:
        f, m = (reference[tree.full_qpos_address[j]] for j in (follower, leader))
        constant = offset[tree.full_qpos_address[follower]] - f + multiplier * m
        _tie(spec, tree.joint_names[follower], tree.joint_names[leader], constant, multiplier)
    for joint in tree.locked:
        if tree.joint_types[joint] in (FREE, BALL):
            raise OsikValueError(f"joint {tree.joint_names[joint]!r} is locked, and free or ball: nothing can hold it")
        at = tree.full_qpos_address[joint]
        _tie(spec, tree.joint_names[joint], "", offset[at] - reference[at], 0.0)


def _tie(spec: mujoco.MjSpec, joint: str, leader: str, constant: float, multiplier: float) -> None:
    tie = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=joint, name2=leader, **_GEARED)
    tie.objtype = mujoco.mjtObj.mjOBJ_JOINT
    tie.data[:5] = (constant, multiplier, 0.0, 0.0, 0.0)


def _add_constraints(spec: mujoco.MjSpec, bodies: Sequence[mujoco.MjsBody], model: mujoco.MjModel) -> None:
    """Add the model's equalities that are not in the robot's tree: closed loops, and joints coupled by polynomials."""
    names = {kind: element_names(model, kind) for kind in ("body", "joint", "equality")}
    kept = [e for e in range(model.neq) if int(model.eq_type[e]) in KINDS and not is_in_tree(model, e)]
    on_sites = [e for e in kept if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE]
    for s in {int(s) for e in on_sites for s in (model.eq_obj1id[e], model.eq_obj2id[e])}:
        bodies[model.site_bodyid[s]].add_site(name=f"site{s}", pos=model.site_pos[s], quat=model.site_quat[s])
    for e in kept:
        kind, of = mujoco.mjtEq(int(model.eq_type[e])), mujoco.mjtObj(int(model.eq_objtype[e]))
        ends = [int(i) for i in (model.eq_obj1id[e], model.eq_obj2id[e])]
        on = names["joint" if KINDS[int(kind)] == "joint" else "body"]
        first, second = (f"site{i}" if e in on_sites else on[i] if i >= 0 else "" for i in ends)
        equality = spec.add_equality(name=names["equality"][e], type=kind, name1=first, name2=second)
        equality.objtype, equality.active = of, bool(model.eq_active0[e])
        equality.data[:], equality.solref[:] = model.eq_data[e], model.eq_solref[e]
        equality.solimp[:] = model.eq_solimp[e]


def _compiled(spec: mujoco.MjSpec, source: mujoco.MjModel) -> mujoco.MjModel:
    """Return the compiled model, with numbers of the robot's model that ``MjSpec`` does not set in all versions."""
    model = spec.compile()
    for name in _COPIED:
        getattr(model, name)[:] = getattr(source, name)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model
