"""Moving along the configuration manifold, and the way back."""

from __future__ import annotations

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from .._tree import BALL, FREE
from ..robot import Robot


def integrate(
    robot: Robot, q: Float[Array, " nq"], v: Float[Array, " nv"], dt: Float[Array, ""] | float = 1.0
) -> Float[Array, " nq"]:
    """Configuration reached from q at velocity v held for dt [s]. Quaternions come back normalised.

    A free joint's angular velocity is in body axes: quaternion * exp(omega dt). (nq,)
    """
    q, step = jnp.asarray(q), jnp.asarray(v) * dt
    scalar_q, scalar_v, quaternions = _layout(robot)
    out = q.at[scalar_q].add(step[scalar_v]) if len(scalar_q) else q
    for at, dof in quaternions:
        turned = jaxlie.SO3(q[at : at + 4]).normalize() @ jaxlie.SO3.exp(step[dof : dof + 3])
        out = out.at[at : at + 4].set(turned.normalize().wxyz)
    return out


def difference(robot: Robot, qa: Float[Array, " nq"], qb: Float[Array, " nq"]) -> Float[Array, " nv"]:
    """The velocity that goes from qa to qb in unit time: ``qb = integrate(robot, qa, difference(robot, qa, qb))``."""
    qa, qb = jnp.asarray(qa), jnp.asarray(qb)
    scalar_q, scalar_v, quaternions = _layout(robot)
    out = jnp.zeros(robot.nv, jnp.result_type(qa, qb)).at[scalar_v].set((qb - qa)[scalar_q])
    for at, dof in quaternions:
        a, b = (jaxlie.SO3(x[at : at + 4]).normalize() for x in (qa, qb))
        out = out.at[dof : dof + 3].set((a.inverse() @ b).log())
    return out


def _layout(robot: Robot) -> tuple[np.ndarray, np.ndarray, list[tuple[int, int]]]:
    """Entries of q and v that simply add, and (start in q, start in v) of each quaternion."""
    tree = robot.tree
    scalar_q, scalar_v, quaternions = [], [], []
    for joint, at in tree.qpos_address.items():
        kind, dof = tree.joint_types[joint], tree.dof_address[joint]
        linear = {FREE: 3, BALL: 0}.get(kind, 1)
        scalar_q += range(at, at + linear)
        scalar_v += range(dof, dof + linear)
        if kind in (FREE, BALL):
            quaternions.append((at + linear, dof + linear))
    return np.array(scalar_q, int), np.array(scalar_v, int), quaternions
