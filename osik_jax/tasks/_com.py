"""A task on the centre of mass."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikTypeError, OsikValueError
from ..execution._computed import by_kernel, side_by_side
from ..kinematics import Kinematics, center_of_mass
from ..kinematics._forward import body_masses, moving_center
from ..kinematics._kernels import Call, center_arguments
from ..numerics._host import on_host, to_jax
from ..robot import Robot
from ._curvature import jacobian_curvature
from ._gain import AdaptiveGain
from ._leaves import as_array, as_vector, check_finite, home_kinematics
from ._polygon import SupportPolygon
from ._pose import Fields, equality_rows, fields_by_core, fields_of
from ._task import CENTER, DEFAULT_GAIN, CoreCard, Task, TaskRows


class ComTask(Task):
    """Task that brings the centre of mass to a point, or keeps it within bounds or over a support polygon.

    With c (3,) the centre of mass in the world [m] and A the chosen axes:

    - a target: ``e = c_A - c*_A``, ``e' = J_A v - c*'_A``, asked to be ``-gain(e) e``;
    - bounds: ``gain (lower - c_A) <= J_A v - c*'_A <= gain (upper - c_A)``, on the coordinates themselves;
    - a polygon: ``normals J_xy v <= gain (offsets - normals c_xy)``, one row an edge.

    Args:
        robot: the robot.
        target: point in the world [m], (3,) or one entry for each axis; default: the centre of mass at ``robot.q0``.
        target_velocity: velocity of the target, or of the bounds [m/s], shaped as ``target``; default 0.
        lower: makes an inequality task: lower bounds on the coordinates [m], one for each axis, or a scalar.
        upper: upper bounds; one of the two may be left out, infinite entries bound nothing.
        polygon: makes an inequality task on the ground projection instead; see ``support_polygon``.
        axes: which of the world's axes, e.g. ``"xyz"``, ``"xy"``, ``"z"``.
        subtree: name of a body: the centre of mass of it and all that hangs from it. Default: the whole robot.
        weight: of each squared row: a scalar, or one for each axis or edge of the polygon.
        gain: [1/s], a number or an ``AdaptiveGain``.

    Raises:
        KeyError: no such body.
        TypeError: arguments that exclude each other.
        ValueError: a wrong shape, a negative weight, lower > upper, an unknown axis.
    """

    units: ClassVar[Mapping[str, str]] = {"": "m", "target_velocity": "m/s", "polygon.normals": "1 (direction)"}
    is_goal: ClassVar[bool] = True
    sees_places: ClassVar[bool] = True
    axes: str = eqx.field(static=True)
    subtree: str | None = eqx.field(static=True)
    target: Float[Array, " m"] | None
    target_velocity: Float[Array, " m"] | None
    lower: Float[Array, " m"] | None
    upper: Float[Array, " m"] | None
    polygon: SupportPolygon | None

    def __init__(
        self,
        robot: Robot,
        *,
        target: ArrayLike | Array | None = None,
        target_velocity: ArrayLike | Array | None = None,
        lower: ArrayLike | Array | None = None,
        upper: ArrayLike | Array | None = None,
        polygon: SupportPolygon | None = None,
        axes: str = "xyz",
        subtree: str | None = None,
        weight: ArrayLike | Array = 1.0,
        gain: ArrayLike | Array | AdaptiveGain = DEFAULT_GAIN,
        priority: int = 1,
        hard: bool = False,
    ):
        _check_exclusive(target, target_velocity, lower, upper, polygon, axes)
        if subtree is not None:
            robot.tree.frame(subtree)
        self.axes, self.subtree = check_axes(axes), subtree
        self.polygon = None if polygon is None else _cast(polygon, robot.q0.dtype)
        dtype = self._set_up(robot, weight, priority, hard, gain)
        self.target = self.target_velocity = None
        has_target = self._set_bounds(target, lower, upper, len(axes), dtype)
        if polygon is None:
            velocity = 0.0 if target_velocity is None else target_velocity
            self.target_velocity = along_axes(velocity, self.axes, "target_velocity", dtype)
            if has_target:
                point = center_of_mass(robot, home_kinematics(robot), subtree) if target is None else target
                self.target = along_axes(point, self.axes, "target", dtype)

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return one row per axis, or one per edge of the polygon [m]."""
        del q
        if kinematics.backend != "jax" and self.target is not None and not isinstance(self.gain, AdaptiveGain):
            mass = body_masses(robot, self.subtree)
            alike = eqx.tree_at(lambda robot: robot.body_mass, robot, mass), replace(kinematics, backend="jax")
            return equality_rows(*_by_kernel(self, *alike))
        return self._plain_rows(robot, kinematics)

    def _card(self, robot: Robot) -> CoreCard | str:
        tree, edges = robot.tree, self.polygon is not None
        rows = self.polygon.offsets.shape[-1] if self.polygon is not None else len(self.axes)
        axes = [0] * rows if edges else axis_numbers(self.axes).tolist()
        below = tree.is_own if self.subtree is None else tree.descendants[tree.frame_bodies[tree.frame(self.subtree)]]
        counts = np.asarray(below) | (self.subtree is None and bool(np.asarray(tree.is_own)[1:].all()))
        return CoreCard(CENTER, rows, [int(number) for number in (edges, *axes, *counts)])

    def error_bounds(self) -> tuple[Any, Any] | None:
        """Return the bounds on the coordinates, or on the distances along the normals of the polygon's edges [m]."""
        return super().error_bounds() if self.polygon is None else (-np.inf, self.polygon.offsets)

    def grip(self) -> tuple[Array, Array | None] | None:
        """Return the target if it has all three coordinates."""
        return None if self.target is None or self.axes != "xyz" else (self.target, None)

    def gripped(self, position: Float[np.ndarray, "3"], rotation: np.ndarray) -> Any:
        """Return the target at a position."""
        del rotation
        return position

    def core_leaves(self) -> list[Any]:
        """Return the leaves in the order of the card in ``core/tasks``."""
        bounds = [self.lower, self.upper, self.target, None]
        if self.polygon is not None:
            bounds = [None, self.polygon.offsets, self.polygon.normals, self.polygon.vertices]
        return [self.gain, self.weight, self.target_velocity, *bounds, None, None]

    def _plain_rows(self, robot: Robot, kinematics: Kinematics) -> TaskRows:
        point, jacobian = moving_center(robot, kinematics, self.subtree)
        bound = partial(jacobian_curvature, jacobian=jnp.where(robot.tree.turning, jacobian, 0.0))
        if self.polygon is not None:
            value, rows = (jnp.matmul(self.polygon.normals, a[:2], precision="highest") for a in (point, jacobian))
            # normals point outward, so an edge binds on its upper side alone
            lower, upper = jnp.full_like(value, -jnp.inf), self.polygon.offsets
        else:
            axes, lower, upper = axis_numbers(self.axes), self.lower, self.upper
            # own minus wanted: the error's Jacobian is then that of the centre of mass, without a sign
            value, rows = point[axes] if self.target is None else point[axes] - self.target, jacobian[axes]
        return TaskRows.of(
            value,
            rows,
            gain=self.gain,
            weight=jnp.broadcast_to(self.weight, value.shape),
            lower=lower,
            upper=upper,
            feedforward=self.target_velocity,
            curvature=bound,
        )

    @property
    def _weight_rows(self) -> int:
        return len(self.axes) if self.polygon is None else len(self.polygon.offsets)

    def _held(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> dict[str, Any]:
        if self.target is None:
            return super()._held(robot, kinematics, q)
        return dict(target=center_of_mass(robot, kinematics, self.subtree)[axis_numbers(self.axes)])

    def _convert(self, name: str, value: Any) -> Any:
        if name == "polygon":
            if not isinstance(value, SupportPolygon):
                raise OsikTypeError(f"polygon is a SupportPolygon (see support_polygon), got {type(value).__name__}")
            return _cast(value, self.weight.dtype)
        if name in ("target", "target_velocity"):
            return along_axes(value, self.axes, name, self.weight.dtype)
        return super()._convert(name, value)


def _fields(task: ComTask, robot: Robot, kinematics: Kinematics) -> Fields:
    return fields_of(task._plain_rows(robot, kinematics))


def _fields_by_kernel(call: Call, task: ComTask, robot: Robot, kinematics: Kinematics) -> Fields:
    """Return the fields of the rows of a batch of robots, computed by the core."""
    assert task.target is not None and task.target_velocity is not None and not isinstance(task.gain, AdaptiveGain)
    given, integers, _ = center_arguments(robot, kinematics)
    weight = task.weight if task.weight.ndim == 2 else task.weight[:, None]
    weight = jnp.broadcast_to(weight, (len(weight), len(task.axes)))
    numbers = side_by_side(task.target, task.target_velocity, weight, task.gain)
    tree = robot.tree
    options = np.concatenate([integers, axis_numbers(task.axes), tree.turning]).astype(np.int32)
    space = 4 * len(tree.body_parents) + (0 if len(tree.dof_body) == tree.nv else 3 * tree.nv)
    return fields_by_core(partial(call, space=space), "center_rows", tree.nv, weight, *given, options, numbers)


_by_kernel = by_kernel(_fields, _fields_by_kernel)


def _cast(polygon: SupportPolygon, dtype: Any) -> SupportPolygon:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), polygon)


def axis_numbers(axes: str) -> np.ndarray:
    """Return 0 for x, 1 for y, 2 for z. (m,)."""
    return np.array(["xyz".index(axis) for axis in axes])


def along_axes(value: Any, axes: str, what: str, dtype: Any) -> Float[Array, " m"]:
    """Return one entry per axis from a scalar, from a vector x, y, z, or from one entry per axis."""
    value = as_array(value, what, dtype)
    check_finite(value, what)
    if value.shape == (3,) and len(axes) < 3:
        value = to_jax(on_host(value)[axis_numbers(axes)])
    return as_vector(value, (len(axes),), what, dtype)


def check_axes(axes: str) -> str:
    """Return the names of axes, or raise ValueError unless they are x, y or z, each at most once."""
    if not axes or len(set(axes)) != len(axes) or not set(axes) <= set("xyz"):
        raise OsikValueError(f"axes is {axes!r}; it is made of x, y and z, each at most once")
    return axes


def _check_exclusive(target: Any, velocity: Any, lower: Any, upper: Any, polygon: Any, axes: str) -> None:
    if polygon is None:
        return
    if not isinstance(polygon, SupportPolygon):
        raise OsikTypeError(f"polygon is a SupportPolygon (see support_polygon), got {type(polygon).__name__}")
    if any(given is not None for given in (target, velocity, lower, upper)) or axes != "xyz":
        raise OsikTypeError("a ComTask with a polygon takes no target, target_velocity, lower, upper or axes")
