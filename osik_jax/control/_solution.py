"""Results of a control step and of a rollout."""

from __future__ import annotations

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float, Int


class Solution(eqx.Module):
    """Answer of one step (or, with a leading axis, of many).

    Attributes:
        velocity: v; under ``WeightedQP`` and ``HierarchicalQP`` inside its box exactly. ``WeightedQP`` returns, by
            status: SOLVED, the optimum; INFEASIBLE, the least violation of hard rows; MAX_ITERATIONS, a step in the
            box that costs no more than standing still; NUMERICAL_ERROR, zero, clipped into the box.
            (nv,)
        status: a ``Status`` code. SOLVED says that no velocity serves the tasks better, not that targets are near:
            ``explain_step`` and ``explain_rollout`` say how near they are, and what stops the robot.
        iterations: changes of the active set, all levels together.
        factorizations: systems factored, all levels together; 1 in ``WeightedQP`` where the warm start was right.
        kkt_residual: largest violation of the optimality conditions, relative to the size of their terms: at most 1e-9
            (1e-5 in float32) where SOLVED. For ``NullSpace`` it is the largest entry of the gradient of the first
            priority's squared error, in the units of its weighted rows. Damping leaves a gradient, so SOLVED does not
            bound it. The largest finite number where the status is NUMERICAL_ERROR.
        box_violation: how far v leaves its box [rad/s or m/s], 0 but for ``NullSpace``; or, where that is more, how far
            it leaves the rows of limits that are no box, in their units: rounding, but for ``NullSpace`` and where the
            status is INFEASIBLE.
        slack: J v minus the nearest point of the interval, by task: the unmet part of its demand. {name: (m,)}
        error: error (equality) or value (inequality) at q, by task. {name: (m,)}
        warm_start: for the next step: the active set, as a pytree of integers; None for ``NullSpace``.

    All numbers are finite. If the input has a NaN, the numbers that depend on it are 0, with derivatives 0, and the
    status says so.
    """

    velocity: Float[Array, " nv"]
    status: Int[Array, ""]
    iterations: Int[Array, ""]
    factorizations: Int[Array, ""]
    kkt_residual: Float[Array, ""]
    box_violation: Float[Array, ""]
    slack: dict[str, Float[Array, " m"]]
    error: dict[str, Float[Array, " m"]]
    warm_start: Any


class Trajectory(eqx.Module):
    """Trajectory of a rollout.

    Attributes:
        time: time at the start of each step [s]. (steps,)
        q: configurations; ``q[0]`` is the start, ``q[k + 1]`` the result of step k. (steps + 1, nq)
        solution: of each step; every leaf has a leading axis. (steps, ...)
    """

    time: Float[Array, " steps"]
    q: Float[Array, "steps_1 nq"]
    solution: Solution
