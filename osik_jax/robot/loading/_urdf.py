"""Reader of URDF files, by way of a MuJoCo model with the same kinematics."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

import mujoco
import numpy as np

from ..._errors import OsikValueError, warn
from .._guesses import find_feet
from .._load_report import LoadNote
from .._model import RobotModel
from .._tree import UnreadMesh
from ._followers import free_name
from ._look import GEOMS, UnreadLook, geom_size
from ._mjmodel import ACCELERATION_LIMIT_PREFIX, INERTIA, LEAST_INERTIA, VELOCITY_LIMIT_PREFIX, from_mjmodel
from ._notes import urdf_notes
from ._options import LoadOptions
from ._packages import Packages, is_uri
from ._poses import IDENTITY, Pose, quaternion
from ._source import check_root, parse_xml, read_source
from ._urdf_elements import Joint, Link, Urdf, read_urdf

WORLD = "world"
FLOATING_BASE = "floating_base"

_VISUAL_GROUP, _COLLISION_GROUP = 2, 3
_BALANCED = 1e-6
"""Relative change of a link's moments of inertia from which a note tells of it: less is roundoff."""


def from_urdf(urdf: str | os.PathLike[str], options: LoadOptions) -> RobotModel:
    """Return names and numbers of a robot from a URDF file or text; see ``Robot.from_urdf``."""
    options = options.checked()
    packages = Packages(options.package_dirs)
    source = read_source(packages.path(urdf) if is_uri(urdf) else urdf, "URDF")
    root = parse_xml(source)
    check_root(root, "robot", source)
    try:
        read = read_urdf(root)
        description = _with_base(read, options.floating_base, source.label)
        model = urdf_spec(description).compile()
    except ValueError as error:
        raise OsikValueError(f"{source.label}: {error}") from None
    notes = [*urdf_notes(root, {joint.name: joint for joint in read.joints}), *read.notes]
    notes += _inertia_notes(description, model)
    floating = [joint.name for joint in description.joints if joint.kind == "floating"]
    one_sided = {
        joint.name: (joint.lower, joint.upper)
        for joint in description.joints
        if math.isfinite(joint.lower) != math.isfinite(joint.upper)
    }
    options = options._replace(position_limits={**one_sided, **(options.position_limits or {})})
    fixed = floating if options.floating_base is False else ()
    look = UnreadLook(description, packages, source.path)
    unread = tuple(unread_meshes(description, packages, source.path))
    return from_mjmodel(model, options, fixed=fixed, notes=notes, meshes=unread, look=look, path=source.path)


def _inertia_notes(urdf: Urdf, model: mujoco.MjModel) -> Iterator[LoadNote]:
    """Yield notes on the links that move and whose moments of inertia MuJoCo has balanced."""
    for name, link in urdf.links.items():
        moments, used = np.linalg.eigvalsh(link.inertia), np.sort(model.body(name).inertia)
        change = np.abs(used - moments).max()
        if model.body_weldid[model.body(name).id] and change > _BALANCED * max(moments[-1], LEAST_INERTIA / _BALANCED):
            shown, now = (" ".join(f"{value:.4g}" for value in own) for own in (moments, used))
            done = (
                f"the moments {shown} kg m^2 are those of no body, the largest being more than the sum of the others: "
                f"{now} are used, {change:.2g} kg m^2 away at most; masses are kept"
            )
            yield LoadNote(INERTIA, name, done)


def _with_base(urdf: Urdf, floating_base: bool | None, label: str) -> Urdf:
    """Add the floating base, a joint from the world to the root link, if there should be one."""
    has_one = any(joint.kind == "floating" for joint in urdf.joints)
    wanted = _guess_floats(urdf, has_one, label) if floating_base is None else floating_base
    if urdf.root == WORLD:
        return _freed_from_world(urdf) if wanted and not has_one else urdf
    kind = "floating" if wanted and not has_one else "fixed"
    base = Joint(_base_name(urdf), kind, WORLD, urdf.root, IDENTITY, np.zeros(3))
    if WORLD in urdf.links:
        raise OsikValueError(f"only the root link may be called {WORLD!r}, and the root link is {urdf.root!r}")
    world = Link(WORLD, 0.0, IDENTITY, np.zeros((3, 3)), ())
    links, joints = {WORLD: world, **urdf.links}, (base, *urdf.joints)
    return dataclasses.replace(urdf, links=links, joints=joints, root=WORLD)


def _guess_floats(urdf: Urdf, has_free_joint: bool, label: str) -> bool:
    """Return whether the base floats if the user does not say so: it does if the robot has feet.

    Where it does not, a warning is given.
    """
    if urdf.root == WORLD or has_free_joint:
        return False
    bodies = {urdf.root: 0}
    parents = [0]
    for joint in urdf.joints:
        if joint.kind == "fixed":
            bodies[joint.child] = bodies[joint.parent]
        else:
            bodies[joint.child] = len(parents)
            parents.append(bodies[joint.parent])
    if find_feet(bodies.items(), parents):
        return True
    warn(
        f"{label}: the URDF does not say whether its base moves, and no two of its outermost links are called like "
        f"feet: the root link {urdf.root!r} is fixed to the world. Say what is meant: floating_base=False, or "
        "floating_base=True"
    )
    return False


def _freed_from_world(urdf: Urdf) -> Urdf:
    """Turn the one fixed joint below a root link called world into the floating base."""
    first, *others = [joint for joint in urdf.joints if joint.parent == WORLD] or [None]
    if first is None or others or first.kind != "fixed":
        raise OsikValueError(
            f"floating_base=True, but the root link is {WORLD!r}: one fixed joint has to hang from it, to be freed. "
            f"Joints there: {', '.join(j.name for j in (first, *others) if j) or '(none)'}"
        )
    free = dataclasses.replace(first, name=_base_name(urdf), kind="floating")
    return dataclasses.replace(urdf, joints=tuple(free if joint is first else joint for joint in urdf.joints))


def _base_name(urdf: Urdf) -> str:
    return free_name(FLOATING_BASE, [joint.name for joint in urdf.joints])


def urdf_spec(urdf: Urdf) -> mujoco.MjSpec:
    """Return the MuJoCo model: a body for every link but the root, which is the world.

    Mimic joints are joint equality constraints; limits of speeds and accelerations are custom numerics, which
    ``from_mjmodel`` reads. A joint that is limited on one side has no range here, for MJCF has both limits or none.
    Moving links without mass or inertia get 2e-15 kg and kg m^2. Shapes have no mass. Collision shapes have MuJoCo's
    default masks, so that all of them meet; visual shapes meet nothing.
    """
    spec = mujoco.MjSpec()
    spec.modelname = urdf.name
    spec.compiler.degree = False
    spec.compiler.balanceinertia = True
    _add_shapes(spec.worldbody, urdf.links[urdf.root])
    bodies = {urdf.root: spec.worldbody}
    fixed_at = {urdf.root: IDENTITY}
    for joint in urdf.joints:
        parent, pose = bodies[joint.parent], joint.origin
        if joint.kind == "fixed" and joint.parent in fixed_at:
            fixed_at[joint.child] = fixed_at[joint.parent] @ pose
        if joint.kind == "floating":
            parent, pose = spec.worldbody, _free_pose(joint, fixed_at)
        bodies[joint.child] = _add_body(parent, pose, urdf.links[joint.child], moving=joint.kind != "fixed")
        _add_joint(spec, bodies[joint.child], joint)
    for joint in urdf.joints:
        if joint.mimic is not None:
            equality = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=joint.name, name2=joint.mimic.leader)
            equality.data[:5] = joint.mimic.offset, joint.mimic.multiplier, 0.0, 0.0, 0.0
    return spec


def _free_pose(joint: Joint, fixed_at: Mapping[str, Pose]) -> Pose:
    if joint.parent not in fixed_at:
        raise OsikValueError(
            f"floating joint {joint.name!r} hangs from {joint.parent!r}, which moves: it has to be fixed"
        )
    return fixed_at[joint.parent] @ joint.origin


def _add_body(parent: mujoco.MjsBody, pose: Pose, link: Link, *, moving: bool) -> mujoco.MjsBody:
    moments, axes = np.linalg.eigh(link.inertia)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    least = LEAST_INERTIA if moving else 0.0
    body = parent.add_body(
        name=link.name,
        pos=pose.position,
        quat=quaternion(pose.rotation),
        mass=max(link.mass, least),
        ipos=link.inertial.position,
        iquat=quaternion(link.inertial.rotation @ axes),
        inertia=np.maximum(moments, least),
        explicitinertial=True,
    )
    _add_shapes(body, link)
    return body


def _add_shapes(body: mujoco.MjsBody, link: Link) -> None:
    for shape in link.shapes:
        if shape.kind not in GEOMS:
            continue
        color = {} if shape.color is None else {"rgba": shape.color}
        meets = 0 if shape.visual else 1
        body.add_geom(
            name="" if shape.visual else shape.name,
            type=GEOMS[shape.kind],
            size=geom_size(shape),
            pos=shape.pose.position,
            quat=quaternion(shape.pose.rotation),
            group=_VISUAL_GROUP if shape.visual else _COLLISION_GROUP,
            contype=meets,
            conaffinity=meets,
            mass=0.0,
            **color,
        )


def unread_meshes(urdf: Urdf, packages: Packages, beside: Path | None) -> Iterator[UnreadMesh]:
    """Yield the collision shapes that are meshes, without a look at their files."""
    urdf_path, folders = None if beside is None else str(beside.absolute()), tuple(map(str, packages.folders))
    for link in urdf.links.values():
        for shape in (shape for shape in link.shapes if shape.kind == "mesh" and not shape.visual):
            position, rotation = tuple(shape.pose.position.tolist()), tuple(map(tuple, shape.pose.rotation.tolist()))
            yield UnreadMesh(shape.name, link.name, shape.file, shape.size, position, rotation, urdf_path, folders)


def _add_joint(spec: mujoco.MjSpec, body: mujoco.MjsBody, joint: Joint) -> None:
    if joint.kind == "floating":
        body.add_freejoint(name=joint.name)
    elif joint.kind != "fixed":
        slides = joint.kind == "prismatic"
        limits = {}
        if math.isfinite(joint.lower) and math.isfinite(joint.upper):
            # MuJoCo asks for lower < upper: equal limits are one unit in the last place apart.
            limits["range"] = [joint.lower, max(joint.upper, np.nextafter(joint.lower, math.inf))]
        body.add_joint(
            name=joint.name,
            type=mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE,
            axis=joint.axis,
            limited=mujoco.mjtLimited.mjLIMITED_TRUE if limits else mujoco.mjtLimited.mjLIMITED_FALSE,
            **limits,
        )
        rates = {VELOCITY_LIMIT_PREFIX: joint.speed, ACCELERATION_LIMIT_PREFIX: joint.acceleration}
        for prefix, rate in rates.items():
            if math.isfinite(rate):
                spec.add_numeric(name=prefix + joint.name, data=[rate], size=1)
