"""Reader of MJCF files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from ..._errors import OsikValueError
from .._load_report import LoadNote
from .._model import RobotModel
from ._mjmodel import LEAST_INERTIA, element_names, from_mjmodel
from ._options import LoadOptions
from ._source import Source, check_root, parse_xml, read_source

FLOATING_BASE = "floating_base"


def from_mjcf(mjcf: str | os.PathLike[str], options: LoadOptions) -> RobotModel:
    """Return names and numbers of a robot from an MJCF file or text; see ``Robot.from_mjcf``."""
    options = options.checked()
    source = read_source(mjcf, "MJCF")
    check_root(parse_xml(source), "mujoco", source)
    try:
        model, notes = _model(source, options.floating_base)
    except ValueError as error:
        raise OsikValueError(f"{source.label}: {error}") from None
    fixed = _free_joints(model) if options.floating_base is False else ()
    return from_mjmodel(model, options, fixed=fixed, notes=notes)


def _model(source: Source, floating_base: bool | None) -> tuple[mujoco.MjModel, list[LoadNote]]:
    read = mujoco.MjSpec.from_string if source.path is None else mujoco.MjSpec.from_file
    spec = read(str(source.path or source.content))
    spec.compiler.fusestatic = False  # it would lose the names of the bodies that it fuses
    model, notes = _compile(spec)
    if floating_base and not _free_joints(model):
        _add_base(spec, model)
        return spec.compile(), notes
    return model, notes


def _free_joints(model: mujoco.MjModel) -> list[str]:
    names = element_names(model, "joint")
    free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    return [name for name, is_free in zip(names, free, strict=True) if is_free]


def _compile(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, list[LoadNote]]:
    """Compile the model; if that fails, without assets from files, then with masses that MuJoCo requires."""
    notes: list[LoadNote] = []
    try:
        return spec.compile(), notes
    except ValueError as error:
        if any(_needs_file(asset) for asset in _assets(spec)):
            notes = _strip_files(spec, error)
    try:
        return spec.compile(), notes
    except ValueError:
        spec.compiler.boundmass = max(spec.compiler.boundmass, LEAST_INERTIA)
        spec.compiler.boundinertia = max(spec.compiler.boundinertia, LEAST_INERTIA)
    return spec.compile(), notes


def _assets(spec: mujoco.MjSpec) -> Iterator[Any]:
    yield from spec.meshes
    yield from spec.hfields
    yield from spec.textures
    yield from spec.skins


def _needs_file(asset: Any) -> bool:
    return bool(asset.file) or any(getattr(asset, "cubefiles", ()))


def _strip_files(spec: mujoco.MjSpec, error: ValueError) -> list[LoadNote]:
    """Delete assets that come from files and all that uses them; ``error`` is why they cannot be read.

    The notes name what collides and is gone.
    """
    lost = {kind: {a.name: a.file for a in getattr(spec, kind) if _needs_file(a)} for kind in ("meshes", "hfields")}
    geoms = [g for g in spec.geoms if g.meshname in lost["meshes"] or g.hfieldname in lost["hfields"]]
    for geom in geoms:
        if _gives_mass(spec, geom):
            raise OsikValueError(
                f"body {geom.parent.name!r} takes its mass from the mesh file {lost['meshes'][geom.meshname]!r}, which "
                f"cannot be read ({error}); give the body an <inertial>, or the file"
            )
    files = lost["meshes"] | lost["hfields"]
    notes = [
        LoadNote(
            "geom", geom.name or geom.parent.name, f"left out: {files[geom.meshname or geom.hfieldname]} is not read"
        )
        for geom in geoms
        if geom.contype or geom.conaffinity
    ]
    _delete_references(spec, {geom.name for geom in geoms if geom.name})
    textures = {t.name for t in spec.textures if _needs_file(t)}
    for material in spec.materials:
        material.textures = ["" if name in textures else name for name in material.textures]
    for element in [*geoms, *(asset for asset in _assets(spec) if _needs_file(asset))]:
        spec.delete(element)
    return notes


def _gives_mass(spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> bool:
    """Return whether the geom adds to its body's mass: MuJoCo's rules for bodies without an inertial."""
    first, last = spec.compiler.inertiagrouprange
    from_geoms = spec.compiler.inertiafromgeom
    if from_geoms == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE or geom.parent is spec.worldbody:
        return False
    explicit = geom.parent.explicitinertial and from_geoms != mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    weightless = geom.mass == 0.0 or (np.isnan(geom.mass) and geom.density == 0.0)
    return not explicit and not weightless and first <= geom.group <= last


def _delete_references(spec: mujoco.MjSpec, geoms: set[str]) -> None:
    """Delete contact pairs and sensors that name any of these geoms."""
    for pair in list(spec.pairs):
        if {pair.geomname1, pair.geomname2} & geoms:
            spec.delete(pair)
    for sensor in list(spec.sensors):
        ends = {(sensor.objtype, sensor.objname), (sensor.reftype, sensor.refname)}
        if ends & {(mujoco.mjtObj.mjOBJ_GEOM, name) for name in geoms}:
            spec.delete(sensor)


def _add_base(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Put a free joint on the one body of the world that carries joints, and its pose into the keyframes."""
    owners = {int(model.body_rootid[b]) for b in model.jnt_bodyid}
    names = element_names(model, "body")
    if len(owners) != 1:
        raise OsikValueError(
            "floating_base=True needs one root body with joints below it; "
            f"bodies in the world with joints: {', '.join(names[b] for b in sorted(owners)) or '(none)'}"
        )
    (root,) = owners
    if model.body_jntnum[root]:
        raise OsikValueError(f"floating_base=True, but the root body {names[root]!r} already has a joint of its own")
    body = next(body for body in spec.worldbody.bodies if body.id == root)
    body.add_freejoint(name=FLOATING_BASE)
    pose = np.concatenate([model.body_pos[root], model.body_quat[root]])
    for key in spec.keys:
        if len(key.qpos):
            key.qpos = np.concatenate([pose, key.qpos])
        if len(key.qvel):
            key.qvel = np.concatenate([np.zeros(6), key.qvel])
