"""A task that keeps a point or a sole on a plane."""

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
from ..numerics._host import on_host
from ..robot import Robot
from ._curvature import jacobian_curvature, pose_curvature
from ._gain import AdaptiveGain, as_gain
from ._leaves import as_vector, as_weight, home_kinematics
from ._plane import PlaneTask, as_normal, as_offset, plane_axes
from ._pointing import across, unit
from ._pose import option
from ._rotation import dot
from ._task import DEFAULT_GAIN, TaskRows, check_priority


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
        priority: 1 is the most important.
        hard: makes it a constraint, see ``Task``.

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
        self.priority, self.hard = check_priority(priority), hard
        dtype = robot.q0.dtype
        self.weight = as_weight(weight, self._weight_rows, dtype)
        self.gain = as_gain(gain, dtype)
        self.point = as_vector(point, (3,), "point", dtype)
        self.normal = as_normal(normal, dtype)
        held = as_pose(home_kinematics(robot).frame_pose(robot, frame) if anchor is None else anchor, dtype)
        position, rotation, up, point = map(on_host, (*held, self.normal, self.point))
        height = dot(up, position + dot(rotation, point)) if offset is None else offset
        self.offset = as_offset(height, dtype)
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

    def rows_at(
        self,
        positions: Float[Array, "1 3"],
        rotations: Float[Array, "1 3 3"],
        jacobians: Float[Array, "1 6 nv"],
        backend: Backend = "jax",
    ) -> TaskRows:
        """Return the rows of the contact: position in the plane, height, tilts and spin, as its kind needs them."""
        del backend
        turn, axes = rotations[0], plane_axes(self.normal)
        arm = dot(turn, self.point)
        linear = jacobians[0, :3] + cross(jacobians[0, 3:], arm[:, None], along=-2)
        moves = jnp.concatenate([linear, jacobians[0, 3:]])
        # a sliding contact keeps the normal row alone
        held = axes[2:] if self.sliding else axes
        error, jacobian = self._place(positions[0] + arm, axes)[3 - len(held) :], dot(held, linear)
        if self.axis is not None:
            tilt, spin = self._tilt(self.axis, turn, axes)
            error, jacobian = jnp.concatenate([error, tilt]), jnp.concatenate([jacobian, dot(spin, jacobians[0, 3:])])

        def bound(pull: Float[Array, " m"]) -> Float[Array, ""]:
            force, tilts = pull[: len(held)], pull[len(held) :]
            of_position = pose_curvature(dot(force, held), jnp.zeros(3, pull.dtype), moves)
            return of_position + jacobian_curvature(tilts, jacobians[0, 3:])

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
