"""Results of a control step and of a rollout."""

from __future__ import annotations

import os
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._errors import OsikValueError
from .._npz import open_npz
from .._whole_file import whole_file

_BY_TASK = "slack", "error"
_NUMBERS = "velocity", "status", "iterations", "factorizations", "kkt_residual", "box_violation"


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

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a ``.npz`` with all numbers but the warm start, for ``load_trajectory``.

        The arrays are ``time``, ``q``, those of the solution by their names, and ``slack.TASK`` and ``error.TASK``.
        ``motion.Motion.of(robot, trajectory).save`` writes tables for other programs.

        Raises:
            OSError: it cannot be written.
        """
        arrays = {"time": self.time, "q": self.q} | {name: getattr(self.solution, name) for name in _NUMBERS}
        for kind in _BY_TASK:
            arrays |= {f"{kind}.{task}": value for task, value in getattr(self.solution, kind).items()}
        with whole_file(path) as file:
            np.savez_compressed(file, allow_pickle=False, **{name: np.asarray(value) for name, value in arrays.items()})


def load_trajectory(path: str | os.PathLike[str]) -> Trajectory:
    """Return the trajectory that ``Trajectory.save`` has written; its warm start is None.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no trajectory.
    """
    with open_npz(path) as file:
        for name in ("time", "q", *_NUMBERS):
            if name not in file.files:
                raise OsikValueError(f"{os.fspath(path)} is no trajectory: it has no {name}")
        arrays = {name: jnp.asarray(file[name]) for name in file.files}
    fields: dict[str, Any] = {name: arrays[name] for name in _NUMBERS}
    for kind in _BY_TASK:
        fields[kind] = {n.partition(".")[2]: a for n, a in arrays.items() if n.startswith(f"{kind}.")}

    def made(time: Array, q: Array, fields: dict[str, Any]) -> Trajectory:
        return Trajectory(time, q, jax.vmap(lambda own: Solution(**own, warm_start=None))(fields))

    for _ in range(arrays["time"].ndim - 1):  # many rollouts
        made = jax.vmap(made)
    return made(arrays["time"], arrays["q"], fields)
