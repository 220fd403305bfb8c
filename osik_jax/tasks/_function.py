"""A task made of a user's own function."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikTypeError, OsikValueError
from ..batching._structure import Static, put_together, taken_apart
from ..kinematics import Kinematics, forward_kinematics, integrate
from ..kinematics._rates import kinematics_rates
from ..numerics._host import to_jax
from ..robot import Robot
from ._curvature import jacobian_curvature
from ._gain import AdaptiveGain
from ._leaves import as_vector
from ._task import DEFAULT_GAIN, Task, TaskRows

Function = Callable[[Robot, Kinematics, Float[Array, " nq"]], Float[Array, " m"] | Float[Array, ""]]


class FunctionTask(Task):
    """Task that brings a function of the configuration to a value or within bounds; JAX derives the Jacobian.

    With x = ``function(robot, kinematics, q)``, a scalar or (m,), the Jacobian is that of x along the tangent,
    ``d x(integrate(q, v)) / dv`` at v = 0, by forward differentiation of the function alone: how the kinematics change
    is known. So take poses from the kinematics that are given.

    - a target: ``e = x - target``, ``e' = J v - target'``, asked to be ``-gain(e) e``;
    - bounds: ``gain (lower - x) <= J v - target' <= gain (upper - x)``.

    The numbers of a function that is a pytree, such as an ``equinox.Module`` with ``__call__``, are traced (arrays and
    floats; integers are static): a new task of such a function with other numbers compiles nothing. Any other function
    compiles once for each object: define it once and keep it, for a lambda made anew in a loop compiles anew.

    Args:
        robot: the robot.
        function: of (robot, kinematics, q), differentiable; it may ignore any of the three. Choose one whose Jacobian
            is finite everywhere: that of a norm is not at 0, that of its square is.
        target: of x, one entry for each row, or a scalar; default 0, also where x is something else at ``robot.q0``.
        target_velocity: of the target, or of the bounds, in the units of x a second; default 0.
        lower: makes an inequality task: lower bounds on x, one for each row, or a scalar.
        upper: upper bounds; one of the two may be left out, infinite entries bound nothing.
        weight: of each squared row: a scalar, or one for each.
        gain: [1/s], a number or an ``AdaptiveGain``.

    Raises:
        TypeError: a target and bounds, or a function that is none.
        ValueError: x is neither a scalar nor (m,), a wrong shape, a negative weight, lower > upper.
    """

    is_goal: ClassVar[bool] = True
    numbers: Any
    structure: Static = eqx.field(static=True)
    target: Float[Array, " m"] | None
    target_velocity: Float[Array, " m"]
    lower: Float[Array, " m"] | None
    upper: Float[Array, " m"] | None

    def __init__(
        self,
        robot: Robot,
        function: Function,
        *,
        target: ArrayLike | Array | None = None,
        target_velocity: ArrayLike | Array | None = None,
        lower: ArrayLike | Array | None = None,
        upper: ArrayLike | Array | None = None,
        weight: ArrayLike | Array = 1.0,
        gain: ArrayLike | Array | AdaptiveGain = DEFAULT_GAIN,
        priority: int = 1,
        hard: bool = False,
    ):
        if not callable(function):
            raise OsikTypeError(f"function is a {type(function).__name__}; it is called with (robot, kinematics, q)")
        _check_signature(function)
        dtype, rows = robot.q0.dtype, _length(robot, function)
        numbers, self.structure = taken_apart(function)
        self.numbers = jax.tree.map(lambda a: to_jax(a, dtype if isinstance(a, float) else None), numbers)
        velocity = 0.0 if target_velocity is None else target_velocity
        self.target_velocity = as_vector(velocity, (rows,), "target_velocity", dtype)
        self._set_up(robot, weight, priority, hard, gain)
        self.target = None
        if self._set_bounds(target, lower, upper, rows, dtype):
            self.target = as_vector(0.0 if target is None else target, (rows,), "target", dtype)

    @property
    def function(self) -> Function:
        """Return the user's function with the task's present numbers put back into it."""
        return put_together(self.numbers, self.structure)

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return one row per entry of x."""
        still = jnp.zeros(robot.nv, q.dtype)
        kinematics = replace(kinematics, backend="jax")  # of which there are rates
        rates = kinematics_rates(robot, kinematics), jax.jacfwd(lambda v: integrate(robot, q, v))(still)

        def value(kinematics: Kinematics, q: Float[Array, " nq"]) -> Float[Array, " m"]:
            return jnp.atleast_1d(self.function(robot, kinematics, q))

        def along(rates: tuple[Kinematics, Float[Array, " nq"]]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
            return jax.jvp(value, (kinematics, q), rates)

        x, jacobian = jax.vmap(along, in_axes=-1, out_axes=(None, -1))(rates)
        return TaskRows.of(
            # value minus target, so that the Jacobian is that of the function
            x if self.target is None else x - self.target,
            jacobian,
            gain=self.gain,
            weight=jnp.broadcast_to(self.weight, x.shape),
            lower=self.lower,
            upper=self.upper,
            feedforward=self.target_velocity,
            # dofs that only translate bend no path
            curvature=partial(jacobian_curvature, jacobian=jnp.where(robot.tree.turning, jacobian, 0.0)),
        )

    @property
    def _weight_rows(self) -> int:
        return len(self.target_velocity)

    def _held(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> dict[str, Any]:
        if self.target is None:
            return super()._held(robot, kinematics, q)
        return dict(target=jnp.atleast_1d(self.function(robot, kinematics, q)))

    @property
    def replaceable(self) -> tuple[str, ...]:
        """Return the names that ``replace`` accepts; a function of other numbers takes another task."""
        return tuple(name for name in super().replaceable if name != "numbers")


def _check_signature(function: Function) -> None:
    """Raise TypeError if the function certainly does not take three arguments."""
    try:
        signature = inspect.signature(function)
    except ValueError:  # some built-in functions have none
        return
    try:
        signature.bind(None, None, None)
    except TypeError as error:
        raise OsikTypeError(
            f"the function takes {signature}; it is called with (robot, kinematics, q): {error}"
        ) from None


def _length(robot: Robot, function: Function) -> int:
    """Return the number of rows of a function."""
    x = jax.eval_shape(lambda r, q: function(r, forward_kinematics(r, q), q), robot, robot.q0)
    shape = getattr(x, "shape", None)
    if shape is None or len(shape) > 1 or 0 in shape:
        raise OsikValueError(f"the function returns {x}; it returns a scalar or an array (m,)")
    return shape[0] if shape else 1
