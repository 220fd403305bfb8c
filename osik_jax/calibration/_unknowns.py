"""Unknown numbers of a setup, as a vector of changes by name."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from numbers import Real
from typing import Any, NamedTuple

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
        if isinstance(self.prior, bool) or not isinstance(self.prior, Real) or not self.prior > 0.0:
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
    """Return all numbers that are unknown, checked, and the precision of each prior, 1 / variance."""
    given: tuple[Any, ...] = tuple(unknowns) if isinstance(unknowns, Iterable) else (None,)
    if not all(isinstance(unknown, Unknown) for unknown in given):
        raise OsikTypeError("unknowns is a sequence of calibration.Unknown, such as [Unknown('joint_offset', '*')]")
    found = [
        (Parameter(unknown.quantity, name, axis), 1.0 / unknown.prior**2)
        for unknown in given
        for name in _names(setup, unknown)
        for axis in _axes(setup.robot, unknown, name)
    ]
    parts = [part for part, _ in found]
    for part in parts:
        if parts.count(part) > 1:
            raise OsikValueError(f"{part.label} is unknown twice")
    if not found:
        raise OsikValueError("nothing is unknown: give at least one calibration.Unknown")
    return tuple(parts), jnp.asarray([precision for _, precision in found], setup.position.dtype)


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
    groups: dict[tuple[str, bool], list[int]] = {}
    for k, part in enumerate(parameters):
        is_fixed = part.quantity.startswith(("frame", "base")) and part.name in setup.names
        groups.setdefault((part.quantity, is_fixed), []).append(k)
    for (quantity, is_fixed), own in groups.items():
        setup = _changed(setup, quantity, is_fixed, [parameters[k] for k in own], change[np.array(own)])
    return setup


def _changed(setup: Setup, quantity: str, is_fixed: bool, parts: list[Parameter], change: Array) -> Setup:
    """Return the setup with numbers of one quantity changed: of fixed frames, the base included, or of the robot."""
    tree, (kind, field) = setup.robot.tree, quantity.split("_")
    if quantity == "joint_offset":
        return _with_offsets(setup, parts, change)
    rows_of = {"joint": tree.joint, "body": lambda name: tree.body_names.index(name, 1), "frame": tree.frame}
    row_of = setup.names.index if is_fixed else rows_of[kind]
    name = "body_quaternion" if quantity == "body_rotation" else field if is_fixed else quantity

    def array_of(setup: Setup) -> Array:
        return getattr(setup if is_fixed else setup.robot, name)

    old, axes = array_of(setup), np.array([part.axis for part in parts])
    rows = np.array([row_of(part.name) for part in parts])
    added = (old if field != "rotation" else jnp.zeros((len(old), 3), change.dtype)).at[rows, axes].add(change)
    if field == "axis":
        added = added / jnp.linalg.norm(added, axis=-1, keepdims=True)
    elif name == "body_quaternion":
        added = jax.vmap(jaxlie.SO3.multiply)(jaxlie.SO3(old), jaxlie.SO3.exp(added)).wxyz
    elif field == "rotation":
        added = compose(old, jax.vmap(jaxlie.SO3.as_matrix)(jaxlie.SO3.exp(added)))
    return eqx.tree_at(array_of, setup, added)


def _with_offsets(setup: Setup, parts: list[Parameter], change: Array) -> Setup:
    """A joint that stands ``change`` further than its encoder reads has a reference lower by that; so do followers."""
    tree, places, terms = setup.robot.tree, [], []
    for part, value in zip(parts, change, strict=True):
        joint = tree.joint(part.name)
        for moved, factor in [(joint, 1.0), *((f, m) for f, leader, m in tree.followers if leader == joint)]:
            places.append(int(tree.full_qpos_address[moved]))
            terms.append(-factor * value)
    reference = setup.robot.joint_reference.at[np.array(places)].add(jnp.stack(terms))
    return eqx.tree_at(lambda s: s.robot.joint_reference, setup, reference)
