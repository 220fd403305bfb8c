"""Task that minimises the kinetic energy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ..kinematics import Kinematics, mass_matrix
from ..kinematics._forward import body_masses
from ..numerics._constants import INERTIA_ROUNDOFF
from ..robot import Robot
from ._leaves import as_scalar
from ._stay import MotionTask
from ._task import TaskRows, check_priority


class KineticEnergyTask(MotionTask):
    """Task for low kinetic energy: among motions that serve other tasks, it prefers those that move little mass.

    With M = L L' the ``mass_matrix``, asks for ``L' v = 0``. In a weighted problem that adds ``weight v' M v / 2``,
    the weight times the kinetic energy [J]: damping in which a heavy dof counts more than a light one. It has as many
    rows as v has entries and leaves nothing free, so it comes last, or with a small weight. The error is 0, and
    there is no gain.

    L is a Cholesky factor. Where a motion moves no mass at all, M counts as larger by some roundings, so that L exists
    and has finite derivatives.

    Args:
        robot: the robot.
        weight: of the energy against the other tasks' squared rows, halved [1/J].
        priority: 1 is the most important.
        hard: makes it a constraint, see ``Task``: nothing moves.

    Raises:
        ValueError: a negative weight, or a robot without masses.
    """

    def __init__(self, robot: Robot, *, weight: ArrayLike | Array = 1.0, priority: int = 1, hard: bool = False):
        self.priority, self.hard = check_priority(priority), hard
        body_masses(robot)  # raises if there is no mass
        self.weight = as_scalar(weight, "weight", robot.q0.dtype)
        self.gain = as_scalar(0.0, "gain", robot.q0.dtype)

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return nv rows: the square root of the mass matrix."""
        del q
        root = _root(mass_matrix(robot, kinematics))
        # |U v|^2 = v' M v is twice the energy, and schemes halve squared rows: weight 1 counts the energy once
        zero = jnp.zeros(robot.nv, root.dtype)
        return TaskRows(zero, root, zero, zero, jnp.broadcast_to(self.weight, zero.shape), is_equality=True)


def _root(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the upper triangular U with U' U = M, the joint-space inertia (positive semidefinite).

    The Cholesky factor is that of M with each dof in units of the square root of its own inertia; immovable dofs get 0.
    """
    inertia = jnp.diagonal(matrix)
    moves = inertia > 0.0
    scale = jnp.where(moves, jnp.sqrt(jnp.where(moves, inertia, 1.0)), 0.0)
    unit = jnp.where(moves, scale, 1.0)
    roundoff = INERTIA_ROUNDOFF * len(inertia) * jnp.finfo(matrix.dtype).eps
    lift = jnp.diag(jnp.where(moves, roundoff, 1.0))
    return jax.lax.linalg.cholesky(matrix / (unit[:, None] * unit) + lift, symmetrize_input=False).T * scale
