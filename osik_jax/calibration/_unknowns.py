"""Unknown numbers of a setup, as a vector of changes by name."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from .._errors import OsikTypeError, OsikValueError, unknown_name
from ..kinematics._rigid import compose
from ..numerics._arguments import concrete
from ..robot import Robot
from ..robot._joint_selection import is_scalar, select_joints
from ..robot.loading._followers import match_names
from ._setup import BASE, Setup

_UNITS = {
    "joint_offset": "rad",
    "joint_axis": "rad",
    "body_position": "m",
    "body_rotation": "rad",
    "frame_position": "m",
    "frame_rotation": "rad",
    "base_position": "m",
    "base_rotation": "rad",
}


@dataclasses.dataclass(frozen=True)
class Unknown:
    """Numbers that a calibration finds, as changes of what the robot and the fixed frames have.

    Attributes:
        quantity: ``"joint_offset"`` is added to what the encoder reads [rad or m]. ``"joint_axis"`` tilts an axis: a
            change of components of the unit axis, which stays of length 1 [rad]. ``"body_position"`` and
            ``"body_rotation"`` move a body in its parent: link lengths. ``"frame_position"`` and ``"frame_rotation"``
            move a frame of the robot in its body (a tool), or a fixed frame in its parent (a camera, a plane).
            ``"base_position"`` and ``"base_rotation"`` move the robot's base in the world in which is measured.
            Positions are in the axes of the parent [m]; rotations are rotation vectors about the own axes [rad].
        names: a name or glob, or several: of joints, bodies or frames. Not of the base, which is one.
        axes: which components: ``"xz"``. Default: all three; of a joint's axis the two that tilt it most.
        prior: standard deviation of the change that is expected before anything is measured [m or rad]; infinite if
            nothing is known.
    """

    quantity: str
    names: str | Sequence[str] = "*"
    axes: str | None = None
    prior: float = math.inf

    def __post_init__(self) -> None:
        """Check what needs no robot.

        Raises:
            KeyError: no such quantity.
            ValueError: other axes than x, y and z; a prior that is not positive; axes of an offset.
        """
        if self.quantity not in _UNITS:
            raise unknown_name("quantity", self.quantity, tuple(_UNITS))
        if self.axes is not None and (
            self.quantity == "joint_offset" or not set(self.axes) <= set("xyz") or not self.axes
        ):
            raise OsikValueError(f"axes is {self.axes!r}; it is some of 'xyz', and nothing for a joint_offset")
        if isinstance(self.prior, bool) or not isinstance(self.prior, int | float) or not self.prior > 0.0:
            raise OsikValueError(f"prior is {self.prior!r}; it is a standard deviation: a positive number, or inf")


class Parameter(NamedTuple):
    """One number of the vector of unknowns."""

    quantity: str
    name: str
    axis: int

    @property
    def label(self) -> str:
        """Return the parameter's name: ``body_position[forearm_link].z``."""
        where = f"[{self.name}]" if self.name else ""
        return f"{self.quantity}{where}" + ("" if self.quantity == "joint_offset" else f".{'xyz'[self.axis]}")


def unit_of(setup: Setup, parameter: Parameter) -> str:
    """Return ``"m"`` or ``"rad"``."""
    tree = setup.robot.tree
    if parameter.quantity == "joint_offset" and not tree.turning[tree.dof_address[tree.joint(parameter.name)]]:
        return "m"
    return _UNITS[parameter.quantity]


def parameters_of(setup: Setup, unknowns: Sequence[Unknown]) -> tuple[tuple[Parameter, ...], Float[Array, " p"]]:
    """Return all numbers that are unknown, and the precision of each prior, 1 / variance.

    Raises:
        KeyError: a name that does not exist.
        TypeError: no sequence of ``Unknown``.
        ValueError: none at all, a number twice, or the offset of a free or ball joint.
    """
    if isinstance(unknowns, Unknown) or not all(isinstance(unknown, Unknown) for unknown in unknowns):
        raise OsikTypeError("unknowns is a sequence of calibration.Unknown, such as [Unknown('joint_offset', '*')]")
    found = [(part, 1.0 / unknown.prior**2) for unknown in unknowns for part in _parts(setup, unknown)]
    parts = [part for part, _ in found]
    for part in parts:
        if parts.count(part) > 1:
            raise OsikValueError(f"{part.label} is unknown twice")
    if not found:
        raise OsikValueError("nothing is unknown: give at least one calibration.Unknown")
    return tuple(parts), jnp.asarray([precision for _, precision in found], setup.position.dtype)


def _parts(setup: Setup, unknown: Unknown) -> list[Parameter]:
    return [
        Parameter(unknown.quantity, name, axis)
        for name in _names(setup, unknown)
        for axis in _axes(setup.robot, unknown, name)
    ]


def _names(setup: Setup, unknown: Unknown) -> list[str]:
    """Return the names that an unknown stands for, each once."""
    kind, robot = unknown.quantity.split("_")[0], setup.robot
    if kind == "base":
        return [BASE]
    given = (unknown.names,) if isinstance(unknown.names, str) else tuple(unknown.names)
    if kind != "joint":
        known = robot.body_names if kind == "body" else (*robot.frame_names, *setup.names[1:])
        return list(dict.fromkeys(known[k] for pattern in given for k in match_names(kind, pattern, known)))
    joints = dict.fromkeys(joint for pattern in given for joint in select_joints(robot, pattern))
    for joint in joints:
        if not is_scalar(robot, joint):
            raise OsikValueError(
                f"joint {robot.tree.joint_names[joint]!r} is free or ball: it has no {unknown.quantity}"
            )
    return [robot.tree.joint_names[joint] for joint in joints]


def _axes(robot: Robot, unknown: Unknown, name: str) -> list[int]:
    """Return the components of an unknown: for an axis by default all but its largest one."""
    if unknown.axes is not None:
        return ["xyz".index(axis) for axis in dict.fromkeys(unknown.axes)]
    if unknown.quantity == "joint_offset":
        return [0]
    if unknown.quantity == "joint_axis":
        axes = concrete(robot.joint_axis)
        if axes is None:
            raise OsikValueError(f"the axis of joint {name!r} is traced: name the components that tilt it, axes='xy'")
        return sorted(np.argsort(np.abs(axes[robot.tree.joint(name)]))[:2].tolist())
    return [0, 1, 2]


def apply(setup: Setup, parameters: tuple[Parameter, ...], change: Float[Array, " p"]) -> Setup:
    """Return the setup with the unknown numbers changed."""
    for quantity in dict.fromkeys(part.quantity for part in parameters):
        own = [k for k, part in enumerate(parameters) if part.quantity == quantity]
        setup = _CHANGES[quantity](setup, [parameters[k] for k in own], change[np.array(own)])
    return setup


def _change_offsets(setup: Setup, parts: list[Parameter], change: Array) -> Setup:
    """A joint that stands ``change`` further than its encoder reads has a reference lower by that; so do followers."""
    tree, places, terms = setup.robot.tree, [], []
    for part, value in zip(parts, change, strict=True):
        joint = tree.joint(part.name)
        for moved, factor in [(joint, 1.0), *((f, m) for f, leader, m in tree.followers if leader == joint)]:
            places.append(int(tree.full_qpos_address[moved]))
            terms.append(-factor * value)
    reference = setup.robot.joint_reference.at[np.array(places)].add(jnp.stack(terms))
    return eqx.tree_at(lambda s: s.robot.joint_reference, setup, reference)


def _change_axes(setup: Setup, parts: list[Parameter], change: Array) -> Setup:
    rows = np.array([setup.robot.tree.joint(part.name) for part in parts])
    axis = _added(setup.robot.joint_axis, rows, parts, change)
    axis = axis / jnp.linalg.norm(axis, axis=-1, keepdims=True)
    return eqx.tree_at(lambda s: s.robot.joint_axis, setup, axis)


def _added(array: Array, rows: np.ndarray, parts: list[Parameter], change: Array) -> Array:
    return array.at[rows, np.array([part.axis for part in parts])].add(change)


def _turns(count: int, rows: np.ndarray, parts: list[Parameter], change: Array) -> jaxlie.SO3:
    """Return a rotation for each row, the identity where nothing is unknown."""
    return jaxlie.SO3.exp(_added(jnp.zeros((count, 3), change.dtype), rows, parts, change))


def _body_rows(setup: Setup, parts: list[Parameter]) -> np.ndarray:
    return np.array([setup.robot.tree.body_names.index(part.name, 1) for part in parts])


def _change_body_positions(setup: Setup, parts: list[Parameter], change: Array) -> Setup:
    moved = _added(setup.robot.body_position, _body_rows(setup, parts), parts, change)
    return eqx.tree_at(lambda s: s.robot.body_position, setup, moved)


def _change_body_rotations(setup: Setup, parts: list[Parameter], change: Array) -> Setup:
    old = setup.robot.body_quaternion
    turned = jax.vmap(jaxlie.SO3.multiply)(jaxlie.SO3(old), _turns(len(old), _body_rows(setup, parts), parts, change))
    return eqx.tree_at(lambda s: s.robot.body_quaternion, setup, turned.wxyz)


def _frames_changed(setup: Setup, parts: list[Parameter], change: Array, field: str, new: Callable) -> Setup:
    """Change frames of the robot and fixed frames, each in its own array."""
    fixed = np.array([part.name in setup.names for part in parts])
    for which, owner, rows in (
        (~fixed, lambda s: getattr(s.robot, f"frame_{field}"), setup.robot.tree.frame),
        (fixed, lambda s: getattr(s, field), setup.names.index),
    ):
        own = [part for part, here in zip(parts, which, strict=True) if here]
        if own:
            places = np.array([rows(part.name) for part in own])
            setup = eqx.tree_at(owner, setup, new(owner(setup), places, own, change[np.flatnonzero(which)]))
    return setup


def _change_frame_positions(setup: Setup, parts: list[Parameter], change: Array) -> Setup:
    return _frames_changed(setup, parts, change, "position", _added)


def _change_frame_rotations(setup: Setup, parts: list[Parameter], change: Array) -> Setup:
    return _frames_changed(setup, parts, change, "rotation", _turned)


def _turned(old: Array, rows: np.ndarray, parts: list[Parameter], change: Array) -> Array:
    return compose(old, jax.vmap(jaxlie.SO3.as_matrix)(_turns(len(old), rows, parts, change)))


_CHANGES = {
    "joint_offset": _change_offsets,
    "joint_axis": _change_axes,
    "body_position": _change_body_positions,
    "body_rotation": _change_body_rotations,
    "frame_position": _change_frame_positions,
    "frame_rotation": _change_frame_rotations,
    "base_position": _change_frame_positions,
    "base_rotation": _change_frame_rotations,
}
