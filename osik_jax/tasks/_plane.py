"""Tasks on planes of the world: contacts of points and soles, and rolling wheels."""

from __future__ import annotations

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from .._errors import OsikTypeError
from ..execution._backends import Backend
from ..kinematics import Kinematics
from ..kinematics._pose_forms import Pose, PoseLike, as_pose
from ..kinematics._rigid import cross
from ..numerics._host import on_host, to_jax
from ..robot import Robot
from ._bases import FramedTask, Frames
from ._curvature import jacobian_curvature, pose_curvature
from ._gain import AdaptiveGain
from ._leaves import as_vector, check_not_negative, home_kinematics
from ._pointing import across, as_direction, unit
from ._pose import option
from ._rotation import dot
from ._task import DEFAULT_GAIN, Task, TaskRows


class PlaneTask(FramedTask):
    """Base of equality tasks that keep one frame on a plane of the world: all x with ``normal x = offset``."""

    frame: str = eqx.field(static=True)
    normal: Float[Array, "3"]
    offset: Float[Array, ""]

    @property
    def frames(self) -> tuple[str, ...]:
        """Return the name of the frame."""
        return (self.frame,)

    @property
    def bounded(self) -> bool:
        """Return False: the rows are equalities."""
        return False

    def _convert(self, name: str, value: Any) -> Any:
        return as_normal(value, self.weight.dtype) if name == "normal" else super()._convert(name, value)


class ContactTask(PlaneTask):
    """Task that keeps a frame in contact with a plane of the world: a foot on the ground, a hand on a wall.

    The plane is all x with ``normal x = offset``, t_1 and t_2 two unit vectors along it; p (3,) is the contact point of
    the frame, R (3, 3) the frame's axes, and p*, R* those of the anchor. The rows are those of e that the kind of
    contact keeps, asked to follow ``e' = -gain e``:

    | contact | sliding | rows | e |
    |---|---|---|---|
    | ``"point"`` | no | 3 | ``t_1 (p - p*), t_2 (p - p*), normal p - offset`` |
    | ``"point"`` | yes | 1 | ``normal p - offset`` |
    | ``"plane"`` | no | 6 | as a point, then ``t_1 a, t_2 a, normal (b* x b)`` |
    | ``"plane"`` | yes | 3 | ``normal p - offset, t_1 a, t_2 a`` |

    with a the frame's axis that stands on the plane and b one across it, in world axes. The last three are the sines of
    the tilts and of the turn about the normal, so angles have to stay below 90 degrees, as those of a contact do. Two
    feet may be ``hard=True`` where the robot can keep both contacts at once; otherwise the status is INFEASIBLE.

    A contact holds motions, no forces: nothing keeps a real foot from lifting or slipping but a slow motion.

    Args:
        robot: the robot.
        frame: name of a body, link, site or geom.
        contact: ``"point"``, or ``"plane"`` for a sole that lies on it.
        sliding: whether the contact may move along the plane, and turn about its normal.
        point: the contact point in the frame's axes [m]; default: its origin.
        normal: of the plane, in the world, of any length.
        offset: of the plane along its normal [m]; default: where the contact point is in the anchor.
        anchor: pose of the frame that the contact holds, in any of the forms that a ``FrameTask``'s target has: the
            position along the plane and the turn about the normal. Default: the pose at ``robot.q0``.
        axis: the frame's axis that stands on the plane (``"plane"`` alone), in the frame's axes, of any length.
            Default: the one along the normal in the anchor.
        weight: of each squared row: a scalar, or one for each.
        gain: [1/s], a number or an ``AdaptiveGain``.

    Raises:
        KeyError: no such frame.
        TypeError: an axis for a point.
        ValueError: a wrong shape, a direction of length 0, a negative weight, an unknown kind of contact.
    """

    contact: str = eqx.field(static=True)
    sliding: bool = eqx.field(static=True)
    point: Float[Array, "3"]
    anchor: Pose | None
    axis: Float[Array, "3"] | None

    def __init__(
        self,
        robot: Robot,
        frame: str,
        *,
        contact: Literal["point", "plane"] = "plane",
        sliding: bool = False,
        point: ArrayLike | Array = (0.0, 0.0, 0.0),
        normal: ArrayLike | Array = (0.0, 0.0, 1.0),
        offset: ArrayLike | Array | None = None,
        anchor: PoseLike | None = None,
        axis: ArrayLike | Array | None = None,
        weight: ArrayLike | Array = 1.0,
        gain: ArrayLike | Array | AdaptiveGain = DEFAULT_GAIN,
        priority: int = 1,
        hard: bool = False,
    ):
        robot.tree.frame(frame)
        self.frame, self.sliding = frame, bool(sliding)
        self.contact = option("contact", contact, ("point", "plane"))
        if contact == "point" and axis is not None:
            raise OsikTypeError("a contact at a point has no axis that stands on the plane; contact='plane' has")
        dtype = self._set_up(robot, weight, priority, hard, gain)
        self.point = as_vector(point, (3,), "point", dtype)
        self.normal = as_normal(normal, dtype)
        held = as_pose(home_kinematics(robot).frame_pose(robot, frame) if anchor is None else anchor, dtype)
        position, rotation, up, point = map(on_host, (*held, self.normal, self.point))
        height = dot(up, position + dot(rotation, point)) if offset is None else offset
        self.offset = as_vector(height, (), "offset", dtype)
        self.anchor = None if sliding else held
        standing = dot(rotation.T, up) if axis is None else axis
        self.axis = as_normal(standing, dtype) if contact == "plane" else None

    @property
    def _weight_rows(self) -> int:
        return {("point", True): 1, ("point", False): 3, ("plane", True): 3, ("plane", False): 6}[
            self.contact, self.sliding
        ]

    def are_lengths(self, count: int) -> Bool[np.ndarray, " m"]:
        """Return which rows are in metres: those of the contact's place."""
        return np.arange(count) < (1 if self.sliding else 3)

    def rows_at(self, frames: Frames, backend: Backend = "jax") -> TaskRows:
        """Return the rows of the contact: position in the plane, height, tilts and spin, as its kind needs them."""
        del backend
        (position,), (turn,), (moving,) = frames
        axes = plane_axes(self.normal)
        arm = dot(turn, self.point)
        linear = moving[:3] + cross(moving[3:], arm[:, None], along=-2)
        moves = jnp.concatenate([linear, moving[3:]])
        # a sliding contact keeps the normal row alone
        held = axes[2:] if self.sliding else axes
        error, jacobian = self._place(position + arm, axes)[3 - len(held) :], dot(held, linear)
        if self.axis is not None:
            tilt, spin = self._tilt(self.axis, turn, axes)
            error, jacobian = jnp.concatenate([error, tilt]), jnp.concatenate([jacobian, dot(spin, moving[3:])])

        def bound(pull: Float[Array, " m"]) -> Float[Array, ""]:
            force, tilts = pull[: len(held)], pull[len(held) :]
            of_position = pose_curvature(dot(force, held), jnp.zeros(3, pull.dtype), moves)
            return of_position + jacobian_curvature(tilts, moving[3:])

        weight = jnp.broadcast_to(self.weight, error.shape)
        return TaskRows.of(error, jacobian, gain=self.gain, weight=weight, curvature=bound)

    def _place(self, point: Float[Array, "3"], axes: Float[Array, "3 3"]) -> Float[Array, "3"]:
        """Return the position along the plane relative to the anchor, and the height above the plane [m]."""
        if self.anchor is None:
            return dot(axes, point) - self.offset * jnp.array([0.0, 0.0, 1.0], point.dtype)
        held = self.anchor[0] + dot(self.anchor[1], self.point)
        along = dot(axes[:2], point - held)
        return jnp.append(along, dot(axes[2], point) - self.offset)

    def _tilt(
        self, axis: Float[Array, "3"], turn: Float[Array, "3 3"], axes: Float[Array, "3 3"]
    ) -> tuple[Float[Array, " m"], Float[Array, "m 3"]]:
        """Return the sines of the tilts (and of the spin if held), and their rates per unit angular velocity."""
        standing = dot(turn, axis)
        # t . (w x s) = w . (s x t), for the two axes t of the plane
        error, derivative = dot(axes[:2], standing), cross(standing, axes[:2])
        if self.anchor is None:
            return error, derivative
        beside = across(axis)[0]
        ahead = dot(turn, beside)
        # n x d, across the held direction d: the row is the sine of the spin, positive counter-clockwise
        wanted = cross(axes[2], unit(self._along(dot(self.anchor[1], beside), axes[2])))
        return jnp.append(error, dot(wanted, ahead)), jnp.concatenate([derivative, cross(ahead, wanted)[None]])

    @staticmethod
    def _along(direction: Float[Array, "3"], normal: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the component of a direction along the plane."""
        return direction - dot(normal, direction) * normal

    def _held(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> dict[str, Any]:
        """Return the fields for which the contact holds where it is: anchor, and plane through the contact point."""
        del q
        position, rotation = kinematics.frame_pose(robot, self.frame)
        held: dict[str, Any] = dict(offset=dot(self.normal, position + dot(rotation, self.point)))
        if self.anchor is not None:
            held["anchor"] = position, rotation
        if self.axis is not None:
            held["axis"] = dot(rotation.T, self.normal)
        return held

    def _convert(self, name: str, value: Any) -> Any:
        dtype = self.weight.dtype
        if name == "axis":
            return as_normal(value, dtype)
        if name == "anchor":
            return as_pose(value, dtype)
        return super()._convert(name, value)


class WheelTask(PlaneTask):
    """Task that makes a wheel roll on a plane of the world without slipping.

    With a the wheel's axis and n the plane's normal in world axes, the wheel rolls along ``x = a x n / |a x n|``, its
    side is ``y = n x x``, and it touches the plane at ``p + radius (a x x)``, its lowest point, also when it leans.
    With u the velocity of the wheel's material there and h its height over the plane:

    - ``x u = 0`` and ``y u = 0``: no slip ahead, none to the side. These are velocities that cannot be integrated to a
      configuration: their error is 0, and what the steps of a loop miss is not made up for later;
    - ``h' = -gain h``: the wheel stays on the plane.

    A wheel with rollers on its rim (omniwheel, mecanum) has one row in place of the first two: no slip along the
    roller's axis, ``(cos(angle) x + sin(angle) y) u = 0``. A wheel that lies flat on the plane has no rolling
    direction; there its centre is what is held at the plane.

    With a base that is free to move, wheels at priority 1 or with ``hard=True`` turn a wanted motion of the base, or of
    a hand, into turns of the wheels.

    Args:
        robot: the robot.
        frame: name of a body, link, site or geom that turns with the wheel, with its origin at the wheel's centre.
        radius: of the wheel [m].
        axis: about which it turns, in the frame's axes, of any length. A turn about it by the right-hand rule rolls
            the wheel ahead, along x.
        roller_angle: makes a wheel with rollers: from the rolling direction to the roller's axis on the plane, about n
            [rad]: 0 for an omniwheel, +-pi/4 for most mecanum wheels. Default: a plain wheel.
        normal: of the plane, in the world, towards the wheel, of any length.
        offset: of the plane along its normal [m].
        weight: of each squared row: a scalar, or one for each.
        gain: of the height [1/s], a number or an ``AdaptiveGain``.

    Raises:
        KeyError: no such frame.
        ValueError: a wrong shape, a direction of length 0, a negative radius or weight.
    """

    radius: Float[Array, ""]
    axis: Float[Array, "3"]
    roller_angle: Float[Array, ""] | None

    def __init__(
        self,
        robot: Robot,
        frame: str,
        *,
        radius: ArrayLike | Array,
        axis: ArrayLike | Array = (0.0, 1.0, 0.0),
        roller_angle: ArrayLike | Array | None = None,
        normal: ArrayLike | Array = (0.0, 0.0, 1.0),
        offset: ArrayLike | Array = 0.0,
        weight: ArrayLike | Array = 1.0,
        gain: ArrayLike | Array | AdaptiveGain = DEFAULT_GAIN,
        priority: int = 1,
        hard: bool = False,
    ):
        robot.tree.frame(frame)
        self.frame = frame
        dtype = robot.q0.dtype
        self.radius = _as_radius(radius, dtype)
        self.axis = unit(as_direction(axis, "axis", dtype))
        self.roller_angle = None if roller_angle is None else as_vector(roller_angle, (), "roller_angle", dtype)
        self.normal, self.offset = as_normal(normal, dtype), as_vector(offset, (), "offset", dtype)
        self._set_up(robot, weight, priority, hard, gain)

    def rows_at(self, frames: Frames, backend: Backend = "jax") -> TaskRows:
        """Return the no-slip rows (ahead and sideways, or along the rollers), then the height row."""
        del backend
        (position,), (turn,), (moving,) = frames
        axle = dot(turn, self.axis)
        ahead = unit(cross(axle, self.normal))
        # axle x ahead points at the plane: for a level axle it is minus the normal
        spoke = self.radius * cross(axle, ahead)
        touching = moving[:3] + cross(moving[3:], spoke[:, None], along=-2)
        directions = jnp.concatenate([self._rolling(ahead), self.normal[None]])
        height = dot(self.normal, position + spoke) - self.offset
        # slip is a velocity without an error to feed back; only the height has one
        error = jnp.zeros(len(directions), height.dtype).at[-1].set(height)
        weight = jnp.broadcast_to(self.weight, error.shape)
        moves = jnp.concatenate([touching, moving[3:]])

        def bound(pull: Float[Array, " m"]) -> Float[Array, ""]:
            return pose_curvature(dot(pull, directions), jnp.zeros(3, pull.dtype), moves)

        return TaskRows.of(error, dot(directions, touching), gain=self.gain, weight=weight, curvature=bound)

    def sought(self, robot: Robot, q0: Float[Array, " nq"]) -> Task | None:
        """Return the task with its height alone: slipping is a matter of velocities."""
        height = jnp.asarray(np.eye(self._weight_rows)[-1], self.weight.dtype)
        return eqx.tree_at(lambda task: task.weight, super().sought(robot, q0), self.weight * height)

    @property
    def _weight_rows(self) -> int:
        return 3 if self.roller_angle is None else 2

    def _rolling(self, ahead: Float[Array, "3"]) -> Float[Array, "m 3"]:
        """Return the directions along the plane in which the wheel must not slip."""
        aside = cross(self.normal, ahead)
        if self.roller_angle is None:
            return jnp.stack([ahead, aside])
        return (jnp.cos(self.roller_angle) * ahead + jnp.sin(self.roller_angle) * aside)[None]

    def _convert(self, name: str, value: Any) -> Any:
        dtype = self.weight.dtype
        if name == "radius":
            return _as_radius(value, dtype)
        if name == "axis":
            return unit(as_direction(value, name, dtype))
        return super()._convert(name, value)


def _as_radius(value: Any, dtype: Any) -> Float[Array, ""]:
    out = as_vector(value, (), "radius", dtype)
    check_not_negative(out, "radius")
    return out


def as_normal(value: Any, dtype: Any) -> Float[Array, "3"]:
    """Return a unit normal from a vector of any non-zero length."""
    return to_jax(unit(on_host(as_direction(value, "normal", dtype))))


def plane_axes(normal: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return right-handed axes as rows: two unit vectors in the plane, and the unit normal."""
    return jnp.concatenate([across(normal), normal[None]])
