"""Conversion of all accepted forms of a pose to position and rotation matrix."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikTypeError, OsikValueError
from ..numerics._arguments import check_finite, concrete
from ..numerics._host import Numbers, is_traced, to_host, to_jax
from ..numerics._rotations import exact_quaternion, exact_rotation
from ._rigid import rotation_matrix

Pose = tuple[Float[Numbers, "3"], Float[Numbers, "3 3"]]
"""Position [m] and rotation matrix (frame axes to world axes)."""
PoseLike = tuple[ArrayLike | Array, ArrayLike | Array] | ArrayLike | Array | jaxlie.SE3 | Any
"""Accepted forms of a pose: ``(p (3,), R (3, 3))``, ``(p (3,), quaternion w x y z (4,))``, a (4, 4) matrix, a
``jaxlie.SE3`` or another object with ``as_matrix()`` (mink) or ``homogeneous`` (Pinocchio). p or R alone is accepted
if the other is not used.
"""

_LAST_ROW = 1e-4
_ACCEPTED = (
    "a pose is (position (3,), rotation matrix (3, 3)), (position (3,), quaternion w x y z (4,)), a (4, 4) matrix or a "
    "jaxlie.SE3"
)


def as_pose(
    value: Any, dtype: Any, *, rest: tuple[Any, Any] = (None, None), numbers: Any = jnp, what: str = "the target"
) -> Pose:
    """Return position and rotation matrix from any form of a pose (``PoseLike``).

    Quaternions and matrices that are rounded, up to 2 %, become the nearest rotation. Traced values that are farther
    from a rotation become NaN, which a solve answers with its status. ``rest`` has position and rotation for a value
    with only the other part; None: the value has to have that part. ``numbers`` is the module of the result's arrays,
    for traced values always ``jax.numpy``; ``what`` names the owner of the pose in messages.
    """
    own = jnp if is_traced(value) else np
    parts = pose_parts(value, dtype, numbers=own)
    if parts is None:
        array = pose_array(value, dtype, numbers=own)
        if array.shape == (4, 4):
            parts = array[:3, 3], array[:3, :3]
            check_last_row(array)
        elif array.shape == (3,) and rest[1] is not None:
            check_finite(array, f"{what}'s position")
            return _made(numbers, array, rest[1])
        elif array.shape in ((3, 3), (4,)) and rest[0] is not None:
            return _made(numbers, rest[0], _rotation(array, what))
        else:
            raise _unfit(f"an array of shape {array.shape}", rest)
    position, rotation = parts
    if position.shape != (3,) or rotation.shape not in ((3, 3), (4,)):
        raise _unfit(f"a pair of shapes {position.shape} and {rotation.shape}", rest)
    check_finite(position, f"{what}'s position")
    return _made(numbers, position, _rotation(rotation, what))


def _made(numbers: Any, position: Any, rotation: Any) -> Pose:
    return (position, rotation) if numbers is np else (to_jax(position), to_jax(rotation))


def pose_parts(value: Any, dtype: Any, accepted: str = _ACCEPTED, numbers: Any = jnp) -> tuple[Numbers, Numbers] | None:
    """Return position and rotation of a pair or of an SE3, None of anything else."""
    if isinstance(value, jaxlie.SE3):  # its quaternion, so that no other normalisation comes in between
        both = numbers.asarray(value.wxyz_xyz, dtype)
        return both[..., 4:], both[..., :4]
    if isinstance(value, (tuple, list)) and len(value) == 2:
        return pose_array(value[0], dtype, accepted, numbers), pose_array(value[1], dtype, accepted, numbers)
    return None


def pose_array(value: Any, dtype: Any, accepted: str = _ACCEPTED, numbers: Any = jnp) -> Numbers:
    """Return the numbers of an array, or of an object that has a matrix."""
    if callable(getattr(value, "as_matrix", None)):
        value = value.as_matrix()
    elif hasattr(value, "homogeneous"):
        value = value.homogeneous
    try:
        return to_host(value, dtype) if numbers is np else numbers.asarray(value, dtype)
    except (TypeError, ValueError):
        raise OsikTypeError(f"got {type(value).__name__}, which is no pose; {accepted}") from None


def _unfit(what: str, rest: tuple[Any, Any]) -> ValueError:
    alone = "; here a position (3,) alone will do" if rest[1] is not None else ""
    alone += "; here a rotation alone will do" if rest[0] is not None else ""
    return OsikValueError(f"got {what}; {_ACCEPTED}{alone}. Batch with jax.vmap.")


def _rotation(given: Float[Numbers, "3 3"] | Float[Numbers, "4"], what: str) -> Float[Numbers, "3 3"]:
    """Return the normalised rotation matrix of a matrix or quaternion rounded to a few digits."""
    if given.shape == (4,):
        return rotation_matrix(exact_quaternion(given, f"{what}'s quaternion"))
    return exact_rotation(given, f"{what}'s rotation")


def check_last_row(matrix: Float[Numbers, "*B 4 4"]) -> None:
    """Raise ValueError unless the last row of each matrix is 0 0 0 1; traced values are not checked."""
    seen = concrete(matrix)
    if seen is None:
        return
    rows = seen[..., 3, :].reshape(-1, 4)
    wrong = ~(np.abs(rows - [0.0, 0.0, 0.0, 1.0]).max(-1) < _LAST_ROW)
    if wrong.any():
        raise OsikValueError(
            f"the last row of a pose's matrix is 0 0 0 1, got {rows[wrong.argmax()]}; is it transposed?"
        )
