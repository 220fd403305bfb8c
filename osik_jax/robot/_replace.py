"""Replacement of a robot's numbers, by the names of bodies, joints, frames and geoms, and longer or heavier links."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._errors import OsikKeyError, OsikValueError, unknown_name
from ..numerics._arguments import as_array, check_bounds, check_finite, check_not_nan, check_not_negative, concrete
from ..numerics._host import Numbers, module_of, on_host, replaced_at, to_jax
from ..numerics._rotations import exact_quaternion, exact_rotation
from ._configuration import home_configuration
from ._model import RobotModel
from ._tree import DOF_WIDTH, QPOS_WIDTH, KinematicTree
from .loading._followers import match_names

Rows = dict[str, int | slice]
"""Place of each name in an array: a row, or the entries of a joint."""

_LIMITS = "position_lower", "position_upper"
_RATES = "velocity_limit", "acceleration_limit"
_ROUNDING = 1e-6
"""Fraction of a body's greatest moment of inertia by which rounding may break symmetry, or make a moment negative."""
Factors = Mapping[str, Float[Array, ""] | float] | Float[Array, ""] | float


def replaced_leaves(robot: RobotModel, values: Mapping[str, Any]) -> dict[str, Array]:
    """Return the new arrays of a robot by field; see ``Robot.replace``."""
    if np.ndim(robot.body_position) != 2:
        raise OsikValueError(
            f"a stack of robots, body_position {np.shape(robot.body_position)}: use replace in jax.vmap"
        )
    fields = tuple(field.name for field in dataclasses.fields(robot) if not field.metadata.get("static"))
    for field in values:
        if field not in fields:
            raise unknown_name("field", field, fields)
    found = {field: _replaced(robot, field, value) for field, value in values.items()}
    check_bounds(*(found.get(field, getattr(robot, field)) for field in _LIMITS))
    offset = concrete(found.get("qpos_offset", np.zeros(robot.qpos_offset.shape)))
    if offset is not None and offset[robot.tree.own_qpos].any():
        raise OsikValueError(f"qpos_offset is of locked joints and followers; it is 0 for {robot.tree.dof_owners}")
    return found


def _replaced(robot: RobotModel, field: str, value: Any) -> Array:
    """Return one array of the robot with new numbers: all of them, or rows by name."""
    if field == "q0":
        return home_configuration(robot, value)
    old = getattr(robot, field)
    if not isinstance(value, Mapping):
        return to_jax(_checked(field, value, old.shape, old.dtype, field))
    new, rows = on_host(old), _rows_of(robot.tree, field)
    for pattern in value:
        _refuse_frame(robot.tree, field, pattern)
    kind, several = field.split("_")[0].replace("dof", "joint"), {n for n in rows if isinstance(rows[n], slice)}
    matched = _matched(kind, value, field, tuple(rows), several)
    for name, pattern in matched.items():
        row, what = rows[name], f"{field}[{pattern!r}]"
        new = replaced_at(new, row, _checked(field, value[pattern], old[row].shape, old.dtype, what))
    return to_jax(new)


def _matched(
    kind: str, given: Mapping[str, Any], what: str, names: tuple[str, ...], several: Collection[str] = ()
) -> dict[str, str]:
    """Return each matched name with the pattern that matches it; raise ValueError if there are two.

    A number for many joints is not for those with ``several`` numbers: a floating base, a ball.
    """
    found: dict[str, str] = {}
    for pattern, value in given.items():
        matched = [names[number] for number in match_names(kind, pattern, names)]
        if several and np.ndim(value) == 0:
            matched = [name for name in matched if name not in several] or matched
        for name in matched:
            if name in found:
                raise OsikValueError(f"{what} gives {name!r} twice, by {found[name]!r} and by {pattern!r}")
            found[name] = pattern
    return found


def _refuse_frame(tree: KinematicTree, field: str, name: Any) -> None:
    """Raise KeyError for a frame where the array has bodies."""
    if field.startswith("body_") and name in tree.frame_names and name not in tree.body_names[1:]:
        body = tree.body_names[tree.frame_bodies[tree.frame(name)]]
        bodies = ", ".join(tree.body_names[1:])
        raise OsikKeyError(
            f"{name!r} is a frame fixed to the body {body!r}: set frame_position or frame_rotation; bodies: {bodies}"
        )


def _rows_of(tree: KinematicTree, field: str) -> Rows:
    """Return the place of each name in a robot's array."""
    names, joints = tree.joint_names, range(len(tree.joint_names))
    if field.startswith("body_"):
        return {name: row for row, name in enumerate(tree.body_names) if row}
    if field.startswith("frame_"):
        return {name: row for row, name in enumerate(tree.frame_names)}
    if field.startswith("geom_"):
        return {name: row for row, name in enumerate(tree.geom_names) if name}
    if field in ("joint_position", "joint_axis"):
        return {name: row for row, name in enumerate(names)}
    if field in ("joint_reference", "qpos_offset"):
        return {names[j]: _entries(tree.full_qpos_address[j], QPOS_WIDTH[tree.joint_types[j]]) for j in joints}
    if field == "dof_armature":
        return {names[j]: _entries(tree.full_dof_address[j], DOF_WIDTH[tree.joint_types[j]]) for j in joints}
    return {names[j]: _entries(start, DOF_WIDTH[tree.joint_types[j]]) for j, start in tree.dof_address.items()}


def _entries(start: int, width: int) -> int | slice:
    """Return the entries of a joint: an index for a hinge or slide, a slice for a ball or free joint."""
    return int(start) if width == 1 else slice(int(start), int(start) + width)


def _checked(field: str, value: Any, shape: tuple[int, ...], dtype: Any, what: str) -> Numbers:
    """Return numbers for an array or a row of it; raise an error if they cannot be that."""
    new = as_array(value, what, dtype)
    if new.shape != shape:
        raise OsikValueError(f"{what} has shape {new.shape}, expected {shape}. Batch with jax.vmap.")
    _CHECKS.get(field, check_finite)(new, what)
    exact = _EXACT.get(field)
    return on_host(exact(new, what) if exact else new)


def _unit(axes: Numbers, what: str) -> Numbers:
    """Return axes of length 1; raise ValueError if a concrete one is zero."""
    axes = on_host(axes)
    xp = module_of(axes)
    squared = (axes**2).sum(-1, keepdims=True)
    if xp is np and not squared.all():
        raise OsikValueError(f"{what} is an axis of length 0; it is a direction, of any other length")
    return axes / xp.sqrt(squared)


def _check_rate(rate: Array, what: str) -> None:
    check_not_negative(rate, what, finite=False)


def _check_inertia(inertia: Array, what: str) -> None:
    """Raise ValueError unless concrete tensors are finite, symmetric, and have no negative moment."""
    check_finite(inertia, what)
    seen = concrete(inertia)
    if seen is None:
        return
    rounding = _ROUNDING * np.abs(seen).max(axis=(-1, -2), keepdims=True)
    moments = np.linalg.eigvalsh(seen)[..., None]
    if (np.abs(seen - seen.swapaxes(-1, -2)) > rounding).any() or (moments < -rounding).any():
        raise OsikValueError(f"{what} is {seen}; it has to be symmetric, without negative moments of inertia")


_CHECKS = {
    **dict.fromkeys(("body_mass", "dof_armature"), check_not_negative),
    **dict.fromkeys(_LIMITS, check_not_nan),
    **dict.fromkeys(_RATES, _check_rate),
    "body_inertia": _check_inertia,
}
"""Checks of numbers; those of other arrays have to be finite."""

_EXACT = {
    "body_quaternion": exact_quaternion,
    "frame_rotation": exact_rotation,
    "geom_rotation": exact_rotation,
    "joint_axis": _unit,
}
"""Functions that bring directions and rotations to unit length, or raise an error."""


def scaled_leaves(robot: RobotModel, length: Factors, mass: Factors) -> dict[str, Array]:
    """Return the leaves of a robot with scaled lengths and masses, by field."""
    tree, dtype = robot.tree, robot.body_position.dtype
    longer, heavier = _factors(tree, length, "length", dtype), _factors(tree, mass, "mass", dtype)
    parent, carrier = np.asarray(tree.body_parents, int), np.asarray(tree.frame_bodies, int)
    owner, wearer = np.asarray(tree.joint_bodies, int), np.asarray(tree.geom_bodies, int)
    return {
        "body_position": robot.body_position * longer[parent, None],
        "body_com": robot.body_com * longer[:, None],
        "joint_position": robot.joint_position * longer[owner, None],
        "frame_position": robot.frame_position * longer[carrier, None],
        "geom_position": robot.geom_position * longer[wearer, None],
        "geom_size": robot.geom_size * longer[wearer, None],
        "body_mass": robot.body_mass * heavier,
        "body_inertia": robot.body_inertia * (heavier * longer**2)[:, None, None],
    }


def _factors(tree: KinematicTree, given: Factors, what: str, dtype: np.dtype) -> Float[Array, " nbody"]:
    """Return one factor for each body; the world keeps 1."""
    factors = jnp.ones(len(tree.body_names), dtype)
    if not isinstance(given, Mapping):
        return factors.at[1:].set(_factor(given, what, dtype))
    for name, pattern in _matched("body", given, what, tree.body_names[1:]).items():
        factor = _factor(given[pattern], f"{what}[{pattern!r}]", dtype)
        factors = factors.at[tree.body_names.index(name)].set(factor)
    return factors


def _factor(value: Any, what: str, dtype: np.dtype) -> Array:
    """Return a factor; raise ValueError unless it is finite and, for a length, positive, for a mass, not negative."""
    factor = as_array(value, what, dtype)
    check_not_negative(factor, what)
    seen = concrete(factor)
    if what.startswith("length") and seen is not None and not seen.all():
        raise OsikValueError(f"{what} is {value}; a length is scaled by a positive factor")
    return factor
