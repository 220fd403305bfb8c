"""A clutch between a held device and a frame of the robot, for teleoperation."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, ArrayLike, Bool, Float

from .._errors import OsikValueError
from ..kinematics._pose_forms import Pose, PoseLike, as_pose, pose_array
from ..numerics._arguments import concrete
from ..numerics._replace import Replaceable
from ..tasks._leaves import as_scalar
from ..tasks._rotation import dot

_REST = 1e-5
"""Metres and radians in a step: 2 mm/s at 200 Hz."""


class Clutch(Replaceable):
    """Turns the motion of a held device into targets of a frame, while a clutch is pressed.

    With d0 and f0 the poses of the device and of the frame when the clutch was pressed, and A the rotation ``axes``:

        position = f0.position + scale A (d.position - d0.position)
        rotation = A (d.rotation d0.rotation') A' f0.rotation

    So only the motion since the clutch was pressed counts. The device may be moved freely while the clutch is open, and
    pressing or releasing the clutch moves nothing. While it is open the target stands still. A pose of the device that
    is not finite opens the clutch.

    At each press and release, f0 is the last target if the frame is at rest, so a frame at rest stays at rest. If the
    frame moves, f0 is the frame's pose, so a release stops it. After a frame was moved by other means, make a new
    clutch.

    A pure pytree for ``jit``, ``scan`` and ``vmap``:

        clutch = osik.Clutch(hand_pose, scale=0.5)
        clutch, target = clutch.step(pressed, device_pose, hand_pose)

    Args:
        frame: pose of the frame in the world at the start, in any form that a ``FrameTask`` takes. It is the target
            until the clutch is pressed.
        scale: metres that the frame moves for each metre of the device, positive. Rotations are not scaled. A change
            by ``replace`` counts from the last press on: change it while the clutch is open.
        axes: rotation from the axes of the device's poses to the world's, as a matrix (3, 3) or quaternion w x y z
            (4,). Default: the same axes.

    Raises:
        TypeError, ValueError: an invalid pose or rotation, or a scale that is not positive.
    """

    engaged: Bool[Array, ""]
    scale: Float[Array, ""]
    axes: Float[Array, "3 3"]
    device: Pose
    anchor: Pose
    target: Pose
    frame: Pose

    def __init__(self, frame: PoseLike, *, scale: ArrayLike = 1.0, axes: ArrayLike | None = None):
        dtype = jnp.result_type(float)
        self.engaged = jnp.asarray(False)
        self.scale = as_scalar(scale, "scale", dtype)
        origin = jnp.zeros(3, dtype)
        self.axes = jnp.eye(3, dtype=dtype) if axes is None else as_pose((origin, axes), dtype)[1]
        self.frame = self.anchor = self.target = as_pose(frame, dtype)
        self.device = origin, jnp.eye(3, dtype=dtype)
        self._check()

    def step(self, engaged: ArrayLike, device: PoseLike, frame: PoseLike) -> tuple[Clutch, Pose]:
        """Return the clutch for the next step and the target of the frame, as position (3,) and rotation (3, 3).

        Args:
            engaged: whether the clutch is pressed.
            device: pose of the device now. It may hold NaN where the device is not tracked.
            frame: pose of the frame now, of the commanded configuration: a measured one has noise, and moves always.
        """
        dtype = self.scale.dtype
        return _step(self, jnp.asarray(engaged, bool), pose_numbers(device, dtype), pose_numbers(frame, dtype))

    def _check(self) -> None:
        scale = concrete(self.scale)
        if scale is not None and not scale > 0.0:
            raise OsikValueError(f"scale is {scale}; it is positive")


@jax.jit
def _step(clutch: Clutch, engaged: Array, device: PoseLike, frame: PoseLike) -> tuple[Clutch, Pose]:
    held: Pose = as_pose(device, clutch.scale.dtype)
    device, frame = held, as_pose(frame, clutch.scale.dtype)
    tracked = jnp.isfinite(held[0]).all() & jnp.isfinite(held[1]).all()
    pressed, device = engaged & tracked, _choose(tracked, device, clutch.device)
    here = _choose(_is_at_rest(frame, clutch.frame), clutch.target, frame)
    anchor = _choose(pressed != clutch.engaged, here, clutch.anchor)
    start = _choose(pressed & ~clutch.engaged, device, clutch.device)
    turn = dot(dot(clutch.axes, dot(device[1], start[1].T)), clutch.axes.T)
    moved = anchor[0] + clutch.scale * dot(clutch.axes, device[0] - start[0]), dot(turn, anchor[1])
    target = _choose(pressed, moved, anchor)
    state = pressed, start, anchor, target, frame
    return eqx.tree_at(lambda own: (own.engaged, own.device, own.anchor, own.target, own.frame), clutch, state), target


def _is_at_rest(frame: Pose, last: Pose) -> Bool[Array, ""]:
    """Return whether a frame has hardly moved in the last step; a rotation by an angle a changes entries by about a."""
    return (jnp.abs(frame[0] - last[0]).max() <= _REST) & (jnp.abs(frame[1] - last[1]).max() <= _REST)


def pose_numbers(pose: PoseLike, dtype: Any) -> Any:
    """Return a pose as arrays, with NaN allowed."""
    if isinstance(pose, jaxlie.SE3):
        return pose
    if isinstance(pose, tuple | list) and len(pose) == 2:
        return pose_array(pose[0], dtype), pose_array(pose[1], dtype)
    return pose_array(pose, dtype)


def _choose(condition: Array, yes: Pose, no: Pose) -> Pose:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
