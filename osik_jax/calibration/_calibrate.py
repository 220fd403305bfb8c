"""The fit of unknown numbers to measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._errors import OsikValueError
from ..numerics._arguments import as_scalar, check_count
from ..numerics._dense import full_precision
from ..robot import Robot
from ..robot._made_for import check_robot
from ._calibration import Calibration
from ._fit import LEAST_SCALE, LOSSES, Fit, Loss, Rows, fit, is_negligible, normal_matrix
from ._measurements import Measurement, check_measurements
from ._setup import FixedFrame, Setup, make_setup
from ._unknowns import Parameter, Unknown, apply, parameters_of, unit_of

RANK_TOLERANCE = 1e-3
"""Singular value relative to the largest below which a combination counts as unobservable.

The columns of the Jacobian have length 1. At this ratio a combination's deviation is a thousand times what the noise
allows one number alone.
"""

_HELD = 1e-2
"""Least precision of an unknown in the fit [1/m^2 or 1/rad^2]: it holds what nothing determines at the given value.

It is far below that of any measurement, and does not count in the covariance.
"""
_UNDETERMINED = 1e-10
"""Relative singular value of data and priors below which a combination is not determined."""
_TOUCHED = 1e-2
"""Least part of an unknown in such a combination for which its deviation is infinite."""


def calibrate(
    robot: Robot,
    measurements: Measurement | Sequence[Measurement],
    unknowns: Sequence[Unknown],
    *,
    frames: Mapping[str, FixedFrame] | None = None,
    base: FixedFrame | None = None,
    loss: str = "squared",
    noise: str = "given",
    rank_tolerance: float = RANK_TOLERANCE,
    max_iterations: int = 100,
) -> Calibration:
    """Return the unknown numbers that explain measurements best, with their uncertainty.

    Minimises the squares of (predicted - read) / sigma over all readings, plus those of change / prior, by
    Levenberg-Marquardt with exact Jacobians. Compiled on first use; other numbers compile nothing. Under ``jax.vmap``
    many calibrations run at once. Use double precision. The derivative is that of a Gauss-Newton step at the fit, which
    is exact for readings that the fit explains.

    Args:
        robot: the robot as its file has it.
        measurements: one or several, of any mix.
        unknowns: what may differ from the robot and frames as given.
        frames: cameras, markers and planes by name, with first guesses of what is unknown of them.
        base: pose of the robot's base in the world of the measurements, or a first guess. Default: the same frame.
        loss: ``"squared"``; with outliers ``"huber"``, ``"cauchy"`` or ``"geman_mcclure"`` (the strongest), which weigh
            readings by their distance in units of the noise, whose scale comes from the median of their lengths.
        noise: ``"given"``: deviations follow from sigma. ``"estimated"``: from sigma times the size of the residuals,
            for each measurement. With a robust loss always estimated, from a scale of at least sigma if that is given.
        rank_tolerance: singular value of the Jacobian relative to the largest, columns scaled to length 1, below which
            a combination of unknowns counts as unobservable.
        max_iterations: greatest number of steps.

    Raises:
        KeyError: a frame, joint or body that does not exist.
        TypeError: something else than measurements or unknowns.
        ValueError: nothing measured or unknown, a wrong shape, an unknown that is given twice, no such loss.
    """
    check_robot(robot, "calibrate(robot, measurements, unknowns)")
    for what, value, known in (("loss", loss, LOSSES), ("noise", noise, ("given", "estimated"))):
        if value not in known:
            raise OsikValueError(f"{what} is {value!r}; it is one of {', '.join(known)}")
    check_count("max_iterations", max_iterations)
    least_ratio = as_scalar(rank_tolerance, "rank_tolerance")
    setup = make_setup(robot, frames or {}, base)
    given = check_measurements(setup, measurements)
    parameters, precision = parameters_of(setup, unknowns)
    weighting = Loss(loss, 1.0 if noise == "given" else LEAST_SCALE, len(parameters))
    estimated = loss != "squared" or noise == "estimated"
    return _calibrated(setup, given, precision, least_ratio, parameters, weighting, estimated, max_iterations)


def rows_at(
    setup: Setup, measurements: Sequence[Measurement], parameters: tuple[Parameter, ...], change: Array
) -> Rows:
    """Return the differences of all measurements over their deviations, with the unknowns changed."""
    changed = apply(setup, parameters, change)
    return tuple(one.differences(one.predicted(changed), one.readings) / one.deviations() for one in measurements)


@partial(jax.jit, static_argnums=(4, 5, 6, 7))
@full_precision
def _calibrated(
    setup: Setup,
    measurements: tuple[Measurement, ...],
    precision: Float[Array, " p"],
    rank_tolerance: Array | float,
    parameters: tuple[Parameter, ...],
    loss: Loss,
    estimated: bool,
    limit: int,
) -> Calibration:
    fixed = jax.lax.stop_gradient((setup, measurements))
    rows_of, fixed_rows = (partial(rows_at, *parts, parameters) for parts in ((setup, measurements), fixed))
    found = fit(rows_of, fixed_rows, jnp.maximum(precision, _HELD), loss, limit)
    directions, scale, ratios = _directions(found)
    observable = ratios > rank_tolerance
    covariance, deviation = _covariance(found, precision, directions, scale, ratios * observable, estimated)
    sizes = tuple(one.deviations() for one in measurements)
    return Calibration(
        setup=apply(setup, parameters, found.change),
        parameters=parameters,
        units=tuple(unit_of(setup, part) for part in parameters),
        kinds=tuple((f"{type(one).__name__} of {' and '.join(one.frames)}", one.unit) for one in measurements),
        vector=found.change,
        covariance=covariance,
        deviation=deviation,
        information=normal_matrix(found.jacobian, tuple(jnp.ones(()) for _ in measurements)),
        noise=jnp.stack([_noise(rows, weights) for rows, weights in zip(found.rows, found.weights, strict=True)]),
        before=tuple(rows * size for rows, size in zip(found.before, sizes, strict=True)),
        after=tuple(rows * size for rows, size in zip(found.rows, sizes, strict=True)),
        weights=found.weights,
        directions=directions,
        scale=scale,
        ratios=ratios,
        observable=observable,
        iterations=found.iterations,
        converged=found.converged,
    )


def _noise(rows: Array, weights: Array) -> Array:
    """Return the root mean square of the rows, weighted."""
    return jnp.sqrt((weights * (rows**2).mean(-1)).sum() / weights.sum())


def _directions(found: Fit) -> tuple[Float[Array, "p p"], Float[Array, " p"], Float[Array, " p"]]:
    """Return right singular vectors of the Jacobian with columns of length 1, those lengths, and the ratios."""
    parts = zip(found.jacobian, found.weights, strict=True)
    rows = jnp.concatenate([(j * jnp.sqrt(w)[:, None, None]).reshape(-1, j.shape[-1]) for j, w in parts])
    scale = jnp.linalg.norm(rows, axis=0)
    small = is_negligible(scale)
    rows, scale = jnp.where(small, 0.0, rows), jnp.where(small, 1.0, scale)
    values, directions = _right_vectors(rows / scale)
    return directions, scale, values / jnp.maximum(values[0], jnp.finfo(values.dtype).tiny)


def _right_vectors(rows: Float[Array, "m p"]) -> tuple[Float[Array, " p"], Float[Array, "p p"]]:
    """Return all p singular values and right singular vectors; the values beyond m are 0."""
    missing = max(0, rows.shape[1] - rows.shape[0])
    _, values, directions = jnp.linalg.svd(jnp.pad(rows, ((0, missing), (0, 0))), full_matrices=False)
    return values, directions


def _covariance(
    found: Fit, precision: Array, directions: Array, scale: Array, ratios: Array, estimated: bool
) -> tuple[Float[Array, "p p"], Float[Array, " p"]]:
    """Return the covariance of the changes (0 along what is not determined) and their deviations (inf there).

    With the normal matrix ``A`` of the loss and the scatter ``B`` of its gradient, the covariance is ``A^-1 B A^-1``.
    For least squares with the given noise both are ``J' J`` plus the prior's precision. ``ratios`` are 0 for
    unobservable combinations, so the prior alone determines those.
    """
    priors = jnp.diag(jnp.sqrt(precision) / scale)
    values, rows = _right_vectors(jnp.concatenate([ratios[:, None] * directions, priors]))
    free = values <= _UNDETERMINED * jnp.maximum(values[0], 1e-30)
    count = sum(rows.size for rows in found.rows)
    freedom = count / max(count - len(precision), 1)
    ones = tuple(jnp.ones((), precision.dtype) for _ in found.rows)
    slope = found.slope if estimated else ones
    spread = tuple(value * freedom for value in found.spread) if estimated else ones
    basis, outside = rows / scale, free[:, None] | free
    curvature, scatter = (
        basis @ (normal_matrix(found.jacobian, parts) + jnp.diag(precision)) @ basis.T for parts in (slope, spread)
    )
    curvature = jnp.where(outside, jnp.eye(len(basis), dtype=basis.dtype), curvature)
    half = jnp.linalg.solve(curvature, jnp.where(free[:, None], 0.0, basis))
    covariance = half.T @ jnp.where(outside, 0.0, scatter) @ half
    touched = (free[:, None] & (jnp.abs(rows) > _TOUCHED)).any(0)
    return covariance, jnp.where(touched, jnp.inf, jnp.sqrt(jnp.maximum(jnp.diagonal(covariance), 0.0)))
