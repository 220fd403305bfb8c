"""Interface of schemes: their inputs and their answer."""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._errors import OsikValueError
from ..limits import LimitRows
from ..numerics._arguments import as_scalar
from ..numerics._constants import BELOW_OTHERS, CONSTRAINT_TOL, STANDING_SPEED
from ..numerics._dense import apply
from ..numerics._guarded import greatest, positive_root, quotient, safe_norm
from ..numerics._replace import Replaceable
from ..solvers import Damping, Level, Status
from ..tasks import TaskRows
from ..tasks._curvature import fraction_to_damp, near_part, row_sums, share_of_far


class VelocityProblem(eqx.Module):
    """Problem of one step: rows of the tasks on the velocity v, and its limits.

    Attributes:
        rows: rows of each task, by name.
        priorities: name and priority of each task; 1 is the most important (static).
        lower: lower bounds of the box on v, -inf where free. (nv,)
        upper: upper bounds of the box on v, inf where free. (nv,)
        position: position of each dof [rad or m], 0 for ball and free joints. (nv,)
        position_lower: lower end of each dof's range, -inf without a ``ConfigurationLimit``. (nv,)
        position_upper: upper end of each dof's range, inf without one. (nv,)
        hard: names of the tasks that are constraints (static).
        limit_rows: rows of all limits that are not a box; None if there are none.
        dt: time of the step [s].
        turning: whether each dof rotates a body, which bends paths. (nv,)
        scalar: whether each dof is a hinge or slide. (nv,)
    """

    rows: dict[str, TaskRows]
    priorities: tuple[tuple[str, int], ...] = eqx.field(static=True)
    lower: Float[Array, " nv"]
    upper: Float[Array, " nv"]
    position: Float[Array, " nv"]
    position_lower: Float[Array, " nv"]
    position_upper: Float[Array, " nv"]
    hard: tuple[str, ...] = eqx.field(default=(), static=True)
    limit_rows: LimitRows | None = None
    dt: Float[Array, ""] = eqx.field(default=0.0, converter=jnp.asarray)
    turning: Bool[Array, " nv"] = eqx.field(default=True, converter=jnp.asarray)
    scalar: Bool[Array, " nv"] = eqx.field(default=True, converter=jnp.asarray)

    def soft(self) -> dict[str, TaskRows]:
        """Return the rows of the tasks that are not constraints."""
        return {name: rows for name, rows in self.rows.items() if name not in self.hard}

    def by_priority(self) -> list[list[str]]:
        """Return the names of the tasks of each priority, most important first, without constraints."""
        ranked = [(name, rank) for name, rank in self.priorities if name not in self.hard]
        return [[name for name, own in ranked if own == rank] for rank in sorted({rank for _, rank in ranked})]

    def curvature(self, names: Iterable[str]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return a bound on the second-order terms that the linear model of these tasks omits, and the damping for it.

        The model omits ``1/2 dt^2 (grad^2 e)[v, v]`` of each error; see ``TaskRows.curvature``. The bounds of tasks
        are combined as a Euclidean norm, because tasks bend along different chains.

        Near the targets of all tasks only a part of the bound counts (``near_part``). The damping is the part that the
        tasks' own rows do not resist (``fraction_to_damp``). For inequality tasks, whose rows may be inactive, it is
        the whole bound.

        Returns:
            The bound and the damping, in the units of weight times J^2.
        """
        rows = [self.rows[name] for name in names]
        rest = [own for own in rows if not own.is_equality]
        equal = [own for own in rows if own.is_equality and own.dofs is None]  # rows on single dofs bend nothing
        of_rest = self._bounds(rest)
        if not equal:
            return safe_norm(of_rest), safe_norm(of_rest)
        # what each row adds to its task's distance and stiffness: few operations whatever the number of tasks
        divisor, pull = (
            jnp.concatenate([jnp.broadcast_to(a, own.error.shape) for own, a in zip(equal, of_each, strict=True)])
            for of_each in (
                [jnp.where(own.curvature > 0.0, own.curvature, 1.0) for own in equal],
                [own.pull for own in equal],
            )
        )
        weight, error = (jnp.concatenate([getattr(own, field) for own in equal]) for field in ("weight", "error"))
        squared = jnp.concatenate([own.squared_lengths() for own in equal])
        weight, squared = _or_zeros(weight), _or_zeros(squared)
        # both terms of the quotient have the weight as a factor: that of the pull alone is infinite for a small weight
        parts = jnp.stack([error * quotient(weight * pull, divisor), weight * squared])
        of_task = np.repeat(np.eye(len(equal), dtype=bool), [len(own.error) for own in equal], axis=1)
        distance, stiffness = jnp.sum(jnp.where(of_task, parts[:, None], 0.0), axis=2)
        far = share_of_far(distance)
        bounds = self._bounds(equal)
        bounds = near_part(greatest(jnp.where(bounds > 0.0, far, 0.0))) * bounds
        to_damp = fraction_to_damp(bounds, far, stiffness) * bounds
        return safe_norm(jnp.concatenate([of_rest, bounds])), safe_norm(jnp.concatenate([of_rest, to_damp]))

    def _bounds(self, rows: Sequence[TaskRows]) -> Float[Array, " k"]:
        """Return dt times the curvature of each task; empty without tasks."""
        return self.dt * jnp.stack([own.curvature for own in rows]) if rows else jnp.zeros(0, self.dt.dtype)

    def dampings(
        self, constraints: Level | None, constant: Float[Array, ""], curvature: Float[Array, ""] | float
    ) -> list[Damping]:
        """Return the damping of each level of ``levels``.

        Constraints have none although they bend too: with damping, they would be missed.

        Args:
            constraints: answer of ``constraints()``.
            constant: constant damping of each priority.
            curvature: kappa, the factor of each priority's curvature damping.
        """
        found, above = [], list(self.hard)
        if constraints is not None:
            found.append(Damping(bends=curvature * self.bends(self.hard)) if self.hard else Damping())
        for names in self.by_priority():
            residuals = [positive_root(rows.weight) * rows.pull for rows in map(self.rows.__getitem__, names)]
            # the rows of the levels above balance the unmet demand of a priority, and bend too
            factor = (BELOW_OTHERS if found else 1.0) * curvature
            found.append(
                Damping(
                    constant,
                    factor * self.curvature(names)[1] + curvature * self.curvature_above(names, above),
                    safe_norm(jnp.concatenate(residuals)),
                    factor * self.bends(names),
                )
            )
            above = above + names
        return found

    def curvature_above(self, names: Iterable[str], above: Sequence[str]) -> Float[Array, ""]:
        """Return the bound on the curvature of the rows above these tasks, along the force that the tasks exert.

        The rows above balance the unmet demand of a task, and bend: a closed loop at its toggle point moves at second
        order only. In the joints, the force of the task and that of the rows above have about the same norm. For tasks
        with a curvature of their own (``curvature``) only closed loops count. Feet do not: legs bend little while they
        stand, and a hand would lag behind a target within reach.
        """
        loops = [name for name in above if self.rows[name].closes_loop]
        rows = [self.rows[name] for name in names]
        linear = [_or_zeros(own.weight) * own.pull for own in rows if own.dofs is not None]
        curved = [
            apply(_or_zeros(own.jacobian.T), _or_zeros(own.weight) * own.pull) for own in rows if own.dofs is None
        ]
        parts = [
            safe_norm(jnp.concatenate(forces)) * self._bending(by)
            for forces, by in ((linear, above), (curved, loops))
            if forces and by
        ]
        return safe_norm(jnp.stack(parts)) if parts else jnp.zeros((), self.lower.dtype)

    def _bending(self, names: Sequence[str]) -> Float[Array, ""]:
        """Return the curvature of tasks for a unit force in the joints: that for a unit residual, over their norm."""
        rows = [self.rows[name] for name in names]
        squared = jnp.concatenate([_or_zeros(own.weight) * _or_zeros(own.squared_lengths()) for own in rows])
        size = positive_root(jnp.sum(squared))
        return quotient(greatest(self.bends(names)), jnp.where(size > 0.0, size, 1.0))

    def bends(self, names: Iterable[str]) -> Float[Array, " nv"]:
        """Return the second-order cost of a motion of each dof for these tasks, for a unit residual (``row_sums``).

        It is 0 for the dofs of ball and free joints: a box on the components of a rotation would depend on the world's
        axes. If a robot stands, its legs keep its base from turning.
        """
        arms = [jnp.broadcast_to(self.rows[name].levers, self.lower.shape) for name in names]
        farthest = reduce(jnp.maximum, arms)  # a maximum over an axis has no derivative where XLA rounds it twice
        return jnp.where(self.scalar, self.dt * row_sums(jnp.where(self.turning, farthest, 0.0)), 0.0)

    def level(self, names: Sequence[str]) -> Level:
        """Return the rows of some tasks as one level."""
        rows = [self.rows[name] for name in names]
        matrix, lower, upper, weight = (
            jnp.concatenate([getattr(r, field) for r in rows]) for field in ("jacobian", "lower", "upper", "weight")
        )
        return Level(matrix, lower, upper, weight, [r.is_equality for r in rows for _ in r.error])

    def constraints(self) -> Level | None:
        """Return hard tasks and then rows of limits as one level; None if there are none."""
        if self.limit_rows is None:
            return self.level(self.hard) if self.hard else None
        limit = self.limit_rows
        rows = Level(limit.jacobian, limit.lower, limit.upper, jnp.ones_like(limit.lower), (False,) * len(limit.lower))
        return _joined(self.level(self.hard), rows) if self.hard else rows

    def levels(self, constraints: Level | None) -> list[Level]:
        """Return the constraints as the first level, if there are any, then the priorities."""
        ranked = [self.level(names) for names in self.by_priority()]
        return ranked if constraints is None else [constraints, *ranked]

    def slack(self, velocity: Float[Array, " nv"]) -> dict[str, Float[Array, " m"]]:
        """Return J v minus the nearest point of the interval, by task."""
        dense = {name: rows for name, rows in self.rows.items() if rows.dofs is None}
        values = {name: velocity[np.array(rows.dofs, int)] for name, rows in self.rows.items() if name not in dense}
        if dense:
            together = apply(jnp.concatenate([rows.jacobian for rows in dense.values()]), velocity)
            ends = np.cumsum([len(rows.error) for rows in dense.values()])[:-1]
            values |= dict(zip(dense, jnp.split(together, ends), strict=True))
        return {name: values[name] - jnp.clip(values[name], r.lower, r.upper) for name, r in self.rows.items()}


def _or_zeros(a: Array) -> Array:
    """Return the numbers with 0 for the NaN of a step that is not valid: factors of NaN have the derivative NaN."""
    return jnp.where(jnp.isnan(a), 0.0, a)


def _joined(first: Level, second: Level) -> Level:
    matrix, lower, upper, weight = (
        jnp.concatenate([getattr(level, field) for level in (first, second)])
        for field in ("matrix", "lower", "upper", "weight")
    )
    return Level(matrix, lower, upper, weight, first.equalities + second.equalities)


def status_with(
    constraints: Level, status: Int[Array, ""], velocity: Float[Array, " nv"], *, start: Array | None = None
) -> Int[Array, ""]:
    """Return the status, with INFEASIBLE in place of SOLVED if the velocity misses a constraint.

    With a ``start`` (nv,), inequalities that hold there do not count, as in a projection.
    """
    level = constraints.scaled()
    finite = [jnp.where(jnp.isfinite(b), jnp.abs(b), jnp.inf) for b in (level.lower, level.upper)]
    nearest = jnp.minimum(*finite)
    fastest = jnp.maximum(jnp.max(jnp.abs(velocity)), STANDING_SPEED)
    size = level.length * fastest + jnp.where(jnp.isfinite(nearest), nearest, 0.0)
    missed = jnp.abs(level.distance(velocity)) > CONSTRAINT_TOL[velocity.dtype] * size
    if start is not None:
        missed &= level.equal | (level.distance(start) != 0.0)
    return jnp.where(missed.any() & (status == Status.SOLVED), Status.INFEASIBLE, status)


class SchemeAnswer(eqx.Module):
    """Answer of a scheme for one step; ``Solution`` describes the fields."""

    velocity: Float[Array, " nv"]
    status: Int[Array, ""]
    iterations: Int[Array, ""]
    factorizations: Int[Array, ""]
    kkt_residual: Float[Array, ""]
    warm_start: Any = None


class Scheme(Replaceable):
    """Base of the schemes, which decide between tasks that cannot all be met.

    ``scheme.replace(name=value, ...)`` returns the scheme with other numbers; ``scheme.replaceable`` lists their names.
    """

    @abc.abstractmethod
    def solve(self, problem: VelocityProblem, warm_start: Any = None) -> SchemeAnswer:
        """Return the velocity of one step.

        Args:
            problem: the step.
            warm_start: ``warm_start`` of the answer to a similar step; integers, all zeros for a cold start. It
                changes the computing time, not the answer.
        """

    def _convert(self, name: str, value: Any) -> Any:
        return as_scalar(value, name, getattr(self, name).dtype)


def as_max_iterations(value: Any) -> int | None:
    """Return a checked maximum of iterations: an integer from 0 up, or None."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
        raise OsikValueError(f"max_iterations is {value!r}; it is an integer, or None for the solver's own maximum")
    return int(value)


def as_leaf(name: str) -> Callable[[ArrayLike | Array], Float[Array, ""]]:
    """Return a converter of a scheme's number to an array leaf; its errors for negative or infinite values name it."""
    return lambda value: as_scalar(value, name)
