"""Choice of the configurations to measure next."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._errors import OsikValueError
from ..numerics._arguments import check_count
from ..numerics._dense import full_precision
from ..robot import Robot
from ..robot._joint_selection import scalar_layout
from ._calibration import Calibration
from ._measurements import Measurement, _array, check_measurements, reading_at
from ._setup import FixedFrame, Setup, make_setup
from ._unknowns import Parameter, Unknown, apply, parameters_of

_RIDGE = 1e-9
"""Information before anything is known, relative to that of all candidates."""


def next_poses(
    robot: Robot,
    measurement: Measurement,
    unknowns: Sequence[Unknown],
    count: int,
    *,
    candidates: Float[np.ndarray, "m nq"] | int = 1000,
    allowed: Callable[[Float[np.ndarray, "m nq"]], Bool[np.ndarray, " m"]] | None = None,
    after: Calibration | None = None,
    frames: Mapping[str, FixedFrame] | None = None,
    base: FixedFrame | None = None,
    seed: int = 0,
) -> Float[np.ndarray, "count nq"]:
    """Return the configurations whose readings tell most about the unknowns, the best one first.

    Each next one is the candidate that raises the determinant of the information matrix most (D-optimal, greedy). A
    candidate may come again: two readings tell more than one.

    Args:
        robot: the robot, or its last fit.
        measurement: one reading of the kind that will be measured; its numbers do not matter, its sigma does.
        unknowns: as in ``calibrate``.
        count: how many configurations.
        candidates: configurations (m, nq); or how many to draw evenly within the joints' ranges (of joints without one
            within half a turn), the other entries as in ``q0``.
        allowed: takes candidates (m, nq) and returns which may be measured (m,), free of collisions.
        after: a calibration with the same unknowns whose measurements are known already.
        frames: as in ``calibrate``.
        base: as in ``calibrate``.
        seed: of the draw.

    Raises:
        KeyError, TypeError, ValueError: as in ``calibrate``; no candidate is allowed; ``after`` has other unknowns.
    """
    check_count("count", count)
    setup = make_setup(robot, frames or {}, base)
    (measurement,) = check_measurements(setup, measurement)
    parameters, precision = parameters_of(setup, unknowns)
    if after is not None and after.parameters != parameters:
        raise OsikValueError(f"after has the unknowns {', '.join(after.names)}; give the same")
    if isinstance(candidates, int | np.integer):
        q = _drawn(robot, candidates, seed)
    else:
        q = np.asarray(_array(candidates, "candidates", (None, robot.nq)))
    q = q if allowed is None else q[np.asarray(allowed(q), bool)]
    if not len(q):
        raise OsikValueError("no candidate is allowed: give more candidates, or another function allowed")
    known = jnp.diag(precision) + (0.0 if after is None else after.information)
    sensitivities = _sensitivities(setup, measurement, jnp.asarray(q), parameters)
    return q[np.asarray(_greedy(sensitivities, known, count))]


def _drawn(robot: Robot, count: int, seed: int) -> Float[np.ndarray, "m nq"]:
    """Return configurations with hinges and slides drawn evenly within their ranges."""
    check_count("candidates", count)
    is_scalar, index = scalar_layout(robot)
    low, high = (np.asarray(bound)[is_scalar] for bound in (robot.position_lower, robot.position_upper))
    low, high = np.where(np.isfinite(low), low, -np.pi), np.where(np.isfinite(high), high, np.pi)
    q = np.tile(np.asarray(robot.q0), (count, 1))
    q[:, index[is_scalar]] = np.random.default_rng(seed).uniform(low, high, (count, len(low)))
    return q


@partial(jax.jit, static_argnums=3)
@full_precision
def _sensitivities(
    setup: Setup, measurement: Measurement, q: Float[Array, "m nq"], parameters: tuple[Parameter, ...]
) -> Float[Array, "m k p"]:
    """Return the Jacobian of a reading's rows over their deviations at each configuration."""

    def rows(change: Array, own: Array) -> Array:
        there = reading_at(measurement, own[None])
        read = jax.lax.stop_gradient(there.predicted(setup))
        return (there.differences(there.predicted(apply(setup, parameters, change)), read) / there.deviations())[0]

    return jax.vmap(lambda own: jax.jacfwd(rows)(jnp.zeros(len(parameters), q.dtype), own))(q)


@partial(jax.jit, static_argnums=2)
def _greedy(sensitivities: Float[Array, "m k p"], known: Float[Array, "p p"], count: int) -> Int[Array, " count"]:
    """Return the candidates that raise the log determinant of the information most, one after the other."""
    each = jnp.einsum("mkp,mkq->mpq", sensitivities, sensitivities, precision="highest")
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(each.sum(0) + known), jnp.finfo(each.dtype).tiny))
    each, start = (a / scale / scale[:, None] for a in (each, known))

    def choose(information: Array, _: None) -> tuple[Array, Array]:
        gain = jnp.linalg.slogdet(information + each)[1]
        best = jnp.argmax(gain)
        return information + each[best], best

    return jax.lax.scan(choose, start + _RIDGE * jnp.eye(len(scale), dtype=each.dtype), None, length=count)[1]
