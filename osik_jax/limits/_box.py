"""Base class of limits, their common velocity box, and the rows of limits that are not a box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._errors import OsikValueError
from ..kinematics import Kinematics
from ..numerics._arguments import concrete
from ..numerics._dense import apply
from ..numerics._guarded import clipped
from ..numerics._replace import Replaceable
from ..robot import Robot
from ..robot._made_for import MadeForRobot

Kind = Literal["acceleration", "velocity", "braking", "position"]
Time = Float[Array, ""] | float
Box = tuple[Float[Array, " nv"], Float[Array, " nv"]]
"""Lower and upper bounds on the velocity."""
_COMPUTED: tuple[Kind, ...] = ("acceleration", "braking")
# machine epsilons by which two evaluations of the same bound may differ
_ROUNDOFF = 4.0
_ORDER: tuple[Kind, ...] = ("acceleration", "velocity", "braking", "position")


class LimitRows(eqx.Module):
    """Rows of a limit at one configuration, beside its box: ``lower <= jacobian @ v <= upper``, hard.

    Attributes:
        jacobian: of what is bounded. (m, nv)
        lower: of its rate, -inf for none. (m,)
        upper: of its rate, inf for none. (m,)
    """

    jacobian: Float[Array, "m nv"]
    lower: Float[Array, " m"]
    upper: Float[Array, " m"]

    def violation(self, velocity: Float[Array, " nv"]) -> Float[Array, " m"]:
        """Return the distance of each row's value outside its bounds; 0 if the row holds. (m,)."""
        value = apply(self.jacobian, velocity)
        return jnp.maximum(jnp.maximum(self.lower - value, value - self.upper), 0.0)


class Limit(MadeForRobot, Replaceable):
    """Base of all limits: subclass it and write ``box``, ``rows`` or both to make your own.

    ``limit.replace(name=value, ...)`` returns the limit with other numbers; ``limit.replaceable`` lists their names.

    The box is never empty. Rows may contradict it or each other; the status is then INFEASIBLE.

    Attributes:
        kind: limits are applied in the order ``"acceleration"``, ``"velocity"``, ``"braking"``, ``"position"``. If two
            contradict each other, the one applied first holds.
        bound_name: what a bound on a single joint is called in verdicts; empty: by the class.
        sees_places: whether the limit keeps places of bodies, such as a hand before a wall; not joints alone.
            ``inverse_kinematics`` of poses keeps such a limit if ``sought`` returns one.
    """

    kind: ClassVar[Kind] = "velocity"
    bound_name: ClassVar[str] = ""
    sees_places: ClassVar[bool] = False

    def parts(self) -> Sequence[Limit]:
        """Return the parts that are applied in place of this limit, if it is of several kinds."""
        return (self,)

    def box(self, robot: Robot, q: Float[Array, " nq"], dt: Time) -> Box:
        """Return lower and upper bounds on v [rad/s or m/s], lower <= upper, +-inf where free. Default: all free."""
        del dt
        free = jnp.full(robot.nv, jnp.inf, jnp.result_type(jnp.asarray(q), robot.q0))
        return -free, free

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"], dt: Time) -> LimitRows | None:
        """Return bounds on linear functions of v at configuration q. Default: none."""
        del robot, kinematics, q, dt
        return None

    def core_leaves(self) -> list[Any]:
        """Return ``StepLimit`` of the core and the leaves that it reads; empty: it reads none."""
        return []

    @property
    def core_has_box(self) -> bool:
        """Return whether the core computes the box; of a subclass JAX does, which may have a box of its own."""
        return "core_leaves" in vars(type(self))

    def has_rows(self, robot: Robot) -> bool:
        """Return whether the limit has rows beside its box, for this robot."""
        del robot
        return any(type(part).rows is not Limit.rows for part in self.parts())

    def sought(self, robot: Robot) -> Limit | None:
        """Return the limit as ``inverse_kinematics`` uses it, whose steps go as far as its bounds in 1 s.

        None: it bounds velocities and no configurations.
        """
        del robot
        return None

    def after(self, velocity: Float[Array, " nv"]) -> Self:
        """Return the limit for the next step, given this step's ``velocity``; itself if it has no memory.

        ``rollout`` calls this at every step; around ``solve`` you call it.
        """
        del velocity
        return self


def limit_box(robot: Robot, q: Float[Array, " nq"], limits: Sequence[Limit], dt: Time) -> Box:
    """Return the box of all limits on v for a step of dt [s]; lower <= upper always.

    Acceleration and velocity limits first; then each position limit is clipped into the box so far:
    ``lower = clip((q_lower - q) / dt, v_lower, v_upper)``, ``upper = clip((q_upper - q) / dt, v_lower, v_upper)``.
    So a joint outside its range returns, at the ``return_speed`` of its ``ConfigurationLimit`` and no faster than its
    velocity limit allows, instead of making the problem infeasible. Without limits: -inf and inf.

    Args:
        robot: the robot.
        q: configuration. (nq,)
        limits: any number of limits.
        dt: time until the next configuration [s], positive.

    Returns:
        lower and upper bounds on v. (nv,) each

    Raises:
        ValueError: a concrete dt is not positive.
    """
    seen = concrete(dt)
    if seen is not None and not (seen > 0.0).all():
        raise OsikValueError(f"dt is {dt}; it has to be positive, in seconds")
    dtype = jnp.result_type(jnp.asarray(q), robot.q0)
    lower, upper = jnp.full(robot.nv, -jnp.inf, dtype), jnp.full(robot.nv, jnp.inf, dtype)
    parts = [part for limit in limits for part in limit.parts()]
    # the first of two contradicting bounds holds, so physical limits (acceleration, speed) come before positions
    for limit in sorted(parts, key=lambda part: _ORDER.index(part.kind)):
        low, high = limit.box(robot, q, dt)
        lower, upper = clipped(low, lower, upper), clipped(high, lower, upper)
    if any(part.kind in _COMPUTED for part in parts):
        lower = jnp.minimum(lower, _a_little_below(upper))
    return lower, upper


def _a_little_below(upper: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """Return bounds lowered by some roundoff: XLA may round the same bound differently in two places."""
    fraction = _ROUNDOFF * jnp.finfo(upper.dtype).eps
    return jnp.where(upper > 0.0, upper * (1.0 - fraction), upper * (1.0 + fraction))


def limit_rows(
    robot: Robot,
    kinematics: Kinematics,
    q: Float[Array, " nq"],
    limits: Sequence[Limit],
    dt: Time,
) -> LimitRows | None:
    """Return the rows of all limits, in the order of the limits; None if there are none.

    Args:
        robot: the robot.
        kinematics: at q.
        q: configuration. (nq,)
        limits: any number of limits.
        dt: time until the next configuration [s], positive.
    """
    found = [limit.rows(robot, kinematics, q, dt) for limit in limits]
    parts = [rows for rows in found if rows is not None]
    if not parts:
        return None
    return LimitRows(*(jnp.concatenate([getattr(r, name) for r in parts]) for name in ("jacobian", "lower", "upper")))
