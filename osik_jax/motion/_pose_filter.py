"""A filter of streamed poses that estimates their velocity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, ArrayLike, Float

from .._errors import OsikValueError
from ..control._clutch import pose_numbers
from ..kinematics._pose_forms import Pose, PoseLike, as_pose
from ..numerics._arguments import concrete
from ..numerics._dense import full_precision
from ..numerics._replace import Replaceable
from ..tasks._leaves import as_scalar, as_vector
from ..tasks._rotation import dot, rotation_log

_Own = TypeVar("_Own", bound="PoseFilter")


class PoseFilter(Replaceable):
    """Smooths a stream of poses with noise, and estimates the velocity: a critically damped alpha-beta filter.

    The filter predicts the pose with its velocity over the time dt. The measured pose corrects both, with shares that
    follow from ``theta = exp(-dt / time_constant)``:

        pose     = predicted + (1 - theta^2) (measured - predicted)
        velocity = velocity + (1 - theta)^2 / dt (measured - predicted)

    A pose that moves with constant velocity is followed without lag. With a constant acceleration a, the pose is
    ``a time_constant^2`` behind, and the velocity about ``2 a time_constant``. There is no further latency: each
    measured pose counts at once. Feed the velocity forward, and the loop's gain may be low:

        filter, target, velocity = filter.update(measured, dt)
        task = task.replace(target=target, target_velocity=velocity)

    A pure pytree for ``jit``, ``scan`` and ``vmap``. A measured pose that is not finite counts as missing: the pose
    goes on, and its velocity fades with the time constant.

    Args:
        pose: first pose, in any form that a ``FrameTask`` takes.
        time_constant: time over which noise is averaged [s], positive. Default: 0.1.
        velocity: first velocity in the world's axes, linear [m/s] and angular [rad/s]. Default: at rest. (6,)

    Raises:
        TypeError, ValueError: an invalid pose, or a time constant that is not positive.
    """

    time_constant: Float[Array, ""]
    pose: Pose
    velocity: Float[Array, "6"]

    def __init__(
        self, pose: PoseLike, *, time_constant: ArrayLike = 0.1, velocity: ArrayLike | Sequence[float] | None = None
    ):
        dtype = jnp.result_type(float)
        self.time_constant = as_scalar(time_constant, "time_constant", dtype)
        self.pose = as_pose(pose, dtype)
        self.velocity = as_vector(0.0 if velocity is None else velocity, (6,), "velocity", dtype)
        self._check()

    def update(self: _Own, pose: PoseLike, dt: ArrayLike) -> tuple[_Own, Pose, Float[Array, "6"]]:
        """Return the filter for the next pose, the smooth pose and its velocity, [linear; angular] in the world's axes.

        Args:
            pose: measured pose. It may hold NaN where it is missing.
            dt: time since the last pose [s], positive.

        Raises:
            ValueError: ``dt`` is not positive.
        """
        dtype = self.time_constant.dtype
        time = as_scalar(dt, "dt", dtype)
        if (seen := concrete(time)) is not None and not seen > 0.0:
            raise OsikValueError(f"dt is {seen:g}; it is the positive time since the last pose [s]")
        return _update(self, pose_numbers(pose, dtype), time)

    def _check(self) -> None:
        seen = concrete(self.time_constant)
        if seen is not None and not seen > 0.0:
            raise OsikValueError(f"time_constant is {seen:g}; it is positive [s]")


@jax.jit
@full_precision
def _update(own: _Own, given: PoseLike, dt: Float[Array, ""]) -> tuple[_Own, Pose, Array]:
    position, rotation = as_pose(given, own.velocity.dtype)
    seen = jnp.isfinite(position).all() & jnp.isfinite(rotation).all()
    fade = jnp.exp(-dt / own.time_constant)
    moved = own.pose[0] + dt * own.velocity[:3]
    turned = dot(jaxlie.SO3.exp(dt * own.velocity[3:]).as_matrix(), own.pose[1])
    turn = rotation_log(dot(jnp.where(seen, rotation, turned), turned.T))
    miss = jnp.concatenate([jnp.where(seen, position, moved) - moved, turn])
    velocity = jnp.where(seen, 1.0, fade) * own.velocity + (1.0 - fade) ** 2 / dt * miss
    step = (1.0 - fade**2) * miss
    pose = moved + step[:3], dot(jaxlie.SO3.exp(step[3:]).as_matrix(), turned)
    return eqx.tree_at(lambda own: (own.pose, own.velocity), own, (pose, velocity)), pose, velocity
