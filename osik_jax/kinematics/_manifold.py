"""Integration on the configuration manifold, and its inverse."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from ctypes import byref
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Num

from .._errors import OsikValueError
from ..core import _library
from ..core._plain import functions
from ..execution._platform import cuda_is_default
from ..numerics._host import float_now
from ..robot import Robot
from ..robot._configuration import check_configuration
from ..robot._made_for import check_robot
from ..robot._tree import BALL, FREE, KinematicTree


def integrate(
    robot: Robot,
    q: Num[ArrayLike, " nq"] | Sequence[float],
    v: Num[ArrayLike, " nv"] | Sequence[float],
    dt: Float[Array, ""] | float = 1.0,
) -> Float[Array, " nq"]:
    """Return the configuration after moving from q at a constant velocity v for dt.

    A free joint's position moves along its linear velocity, in world axes; its quaternion, and that of a ball joint,
    becomes ``quaternion * exp(omega dt)``: angular velocities are in body axes (MuJoCo's ``mj_integratePos``).

    Args:
        robot: the robot.
        q: configuration. (nq,)
        v: velocity, in the tangent space [rad/s or m/s]. (nv,)
        dt: time [s].

    Returns:
        The configuration, its quaternions normalised. (nq,)

    Raises:
        ValueError: q or v has the wrong length, or (outside jit) q is not finite or holds a quaternion of zeros.
    """
    check_robot(robot, "integrate(robot, q, v)")
    check_configuration(robot, q, "q")
    if np.shape(v) != (robot.nv,):
        raise OsikValueError(f"v has shape {np.shape(v)}, this robot's velocities have shape ({robot.nv},)")
    if _is_plain(q) and _is_plain(v) and isinstance(dt, float) and _library.core().library is not None:
        return _as_array(plain_integration(robot.tree)(np.asarray(q), np.asarray(v) * dt))
    return _integrated(robot.tree, jnp.asarray(q), jnp.asarray(v), dt)


def _is_plain(numbers: Any) -> bool:
    """Return whether these are numbers in double precision, on the host and not traced."""
    kind = isinstance(numbers, jax.Array | np.ndarray) and not isinstance(numbers, Tracer)
    return kind and numbers.dtype == np.float64 == float_now() and not (cuda_is_default() or jax.config.jax_disable_jit)  # pyright: ignore[reportAttributeAccessIssue]


@jax.jit
def _as_array(numbers: Any) -> Array:
    """Return an array of JAX; ``jnp.asarray`` takes three times as long."""
    return numbers


@lru_cache(maxsize=64)
def plain_integration(tree: KinematicTree) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return the function from q and a velocity in unit time to the next configuration, by the core without XLA."""
    scalar_q, scalar_v, quaternions = layout(tree)
    scalar = np.concatenate([scalar_q, scalar_v]).astype(np.int32)
    quaternion = np.array(quaternions, np.int32).reshape(-1, 2).T.copy()
    places = len(scalar_q), len(quaternions), scalar.ctypes.data, quaternion.ctypes.data
    call = functions().integrate
    address: Any = ctypes.c_double.from_buffer  # an array's own address takes longer

    def integrated(q: np.ndarray, v: np.ndarray, kept: tuple[np.ndarray, ...] = (scalar, quaternion)) -> np.ndarray:
        given, out = np.concatenate([q, v]), np.empty(len(q))
        call(*places, byref(address(given)), byref(address(given, 8 * len(q))), byref(address(out)))
        return out

    return integrated


@partial(jax.jit, static_argnums=0, inline=True)
def _integrated(tree: KinematicTree, q: Array, v: Array, dt: Array | float) -> Float[Array, " nq"]:
    step = v * dt
    q = jnp.asarray(q, jnp.result_type(q, step))
    scalar_q, scalar_v, quaternions = layout(tree)
    moves = np.zeros(len(q), int)
    moves[scalar_q] = scalar_v
    added, parts, end = q + step[moves], [], 0  # put together from pieces: fewer operations than scatters
    for at, dof in quaternions:
        turned = jaxlie.SO3(q[at : at + 4]).normalize() @ jaxlie.SO3.exp(step[dof : dof + 3])
        parts += [added[end:at], turned.normalize().wxyz]
        end = at + 4
    return jnp.concatenate([*parts, added[end:]])


def difference(
    robot: Robot, qa: Num[ArrayLike, " nq"] | Sequence[float], qb: Num[ArrayLike, " nq"] | Sequence[float]
) -> Float[Array, " nv"]:
    """Return the velocity (nv,) that moves qa to qb in unit time; ``integrate`` is the inverse.

    Rotations go the short way round: no angle is greater than pi.

    Raises:
        ValueError: as in ``integrate``.
    """
    check_robot(robot, "difference(robot, qa, qb)")
    check_configuration(robot, qa, "q")
    check_configuration(robot, qb, "q")
    return _difference(robot.tree, jnp.asarray(qa), jnp.asarray(qb))


@partial(jax.jit, static_argnums=0, inline=True)
def _difference(tree: KinematicTree, qa: Array, qb: Array) -> Float[Array, " nv"]:
    dtype = jnp.result_type(qa, qb, float)
    qa, qb = qa.astype(dtype), qb.astype(dtype)
    scalar_q, scalar_v, quaternions = layout(tree)
    out = jnp.zeros(len(scalar_v) + 3 * len(quaternions), dtype).at[scalar_v].set((qb - qa)[scalar_q])
    for at, dof in quaternions:
        a, b = (jaxlie.SO3(x[at : at + 4]).normalize() for x in (qa, qb))
        out = out.at[dof : dof + 3].set((a.inverse() @ b).log())
    return out


def layout(tree: KinematicTree) -> tuple[np.ndarray, np.ndarray, list[tuple[int, int]]]:
    """Return the entries of q and v that simply add, and (start in q, start in v) of each quaternion."""
    scalar_q, scalar_v, quaternions = [], [], []
    for joint, at in tree.qpos_address.items():
        kind, dof = tree.joint_types[joint], tree.dof_address[joint]
        linear = {FREE: 3, BALL: 0}.get(kind, 1)
        scalar_q += range(at, at + linear)
        scalar_v += range(dof, dof + linear)
        if kind in (FREE, BALL):
            quaternions.append((at + linear, dof + linear))
    return np.array(scalar_q, int), np.array(scalar_v, int), quaternions
