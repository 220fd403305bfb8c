"""Calibration: the corrected robot, its uncertainty, and what the data cannot tell apart."""

from __future__ import annotations

import json
import os
import re
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._whole_file import write_text
from ..robot import Robot
from ._residuals import Combination, Residuals, root_mean_square
from ._setup import BASE, FixedFrame, Setup
from ._unknowns import Parameter

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TOO_MUCH = 5.0
"""Residuals by the given sigma that noise does not explain."""
_SHOWN = 0.05
"""Least part of an unknown in a combination, by what it does to the measurements, that is shown."""


class Calibration(eqx.Module):
    """Result of ``calibrate``; a pytree, so under ``vmap`` each array has the batch's axis in front.

    Attributes:
        setup: robot, base and fixed frames with the fitted numbers.
        parameters: which numbers were unknown (static).
        units: of each (static).
        kinds: kind and unit of each measurement (static).
        vector: fitted change of each number [m or rad]. (p,)
        covariance: of the changes. In directions that neither data nor a prior determine it is 0. (p, p)
        deviation: standard deviation of each change; inf if neither data nor a prior determine it. (p,)
        information: ``J' J`` of the measurements over their standard deviations. (p, p)
        noise: size of the residuals of each measurement relative to the sigma that was given, of the inliers. (g,)
        before: differences between prediction and readings of each measurement, with the numbers as given. (n, k)
        after: the same with the fit. (n, k)
        weights: of each measurement's readings by the robust loss. (n,)
        directions: rows are combinations of unknowns, each in its own scale, from the best observed one. (p, p)
        scale: of each unknown in ``directions``. (p,)
        ratios: singular value of each direction relative to the largest. (p,)
        observable: whether each is above the threshold. (p,)
        iterations: number of steps.
        converged: whether the last one was below the tolerance.
    """

    setup: Setup
    parameters: tuple[Parameter, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    kinds: tuple[tuple[str, str], ...] = eqx.field(static=True)
    vector: Float[Array, " p"]
    covariance: Float[Array, "p p"]
    deviation: Float[Array, " p"]
    information: Float[Array, "p p"]
    noise: Float[Array, " g"]
    before: tuple[Float[Array, "n k"], ...]
    after: tuple[Float[Array, "n k"], ...]
    weights: tuple[Float[Array, " n"], ...]
    directions: Float[Array, "p p"]
    scale: Float[Array, " p"]
    ratios: Float[Array, " p"]
    observable: Bool[Array, " p"]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]

    @property
    def robot(self) -> Robot:
        """Return the robot with the fitted numbers; its ``q`` is still what the encoders read."""
        return self.setup.robot

    @property
    def frames(self) -> dict[str, FixedFrame]:
        """Return the fixed frames with the fitted numbers."""
        return {name: self.setup.frame(name) for name in self.setup.names[1:]}

    @property
    def base(self) -> FixedFrame:
        """Return the pose of the robot's base in the world in which was measured."""
        return self.setup.frame(BASE)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the unknowns, in the order of ``vector``."""
        return tuple(parameter.label for parameter in self.parameters)

    @property
    def values(self) -> dict[str, Array]:
        """Return the fitted changes by name [m or rad]."""
        return {name: self.vector[..., i] for i, name in enumerate(self.names)}

    @property
    def sigma(self) -> dict[str, Array]:
        """Return the standard deviations of the changes by name [m or rad]."""
        return {name: self.deviation[..., i] for i, name in enumerate(self.names)}

    @property
    def residuals(self) -> tuple[Residuals, ...]:
        """Return the residuals of each measurement, before and after."""
        parts = zip(self.kinds, self.before, self.after, self.weights, strict=True)
        return tuple(Residuals(*kind, before, after, weights) for kind, before, after, weights in parts)

    @property
    def unobservable(self) -> tuple[Combination, ...]:
        """Return the combinations of unknowns that the measurements cannot tell apart; not under ``vmap`` or ``jit``.

        Each has an unknown that is in no other one. Priors do not count here.
        """
        lost = ~np.asarray(self.observable)
        if not lost.any():
            return ()
        ratio, scale = float(np.asarray(self.ratios)[lost].max()), np.asarray(self.scale)
        return tuple(self._combination(row, row / scale, ratio) for row in _reduced(np.asarray(self.directions)[lost]))

    def _combination(self, scaled: np.ndarray, change: np.ndarray, ratio: float) -> Combination:
        """Return a combination of the unknowns that matter for the measurements, its largest coefficient 1."""
        shown = np.flatnonzero(np.abs(scaled) > _SHOWN)
        change = change / change[shown[np.abs(change[shown]).argmax()]]
        return Combination({self.names[i]: float(change[i]) for i in shown}, ratio)

    def explain(self) -> str:
        """Return the fit in words: residuals before and after, numbers with deviations, what is not determined."""
        lines = [f"{'converged' if bool(self.converged) else 'NOT converged'} after {int(self.iterations)} iterations"]
        for part, noise in zip(self.residuals, np.asarray(self.noise), strict=True):
            before, after = (root_mean_square(rows) for rows in (part.before, part.after))
            lines.append(
                f"{part.kind}: {len(part.after)} readings, rms {before:.4g} -> {after:.4g} {part.unit}, "
                f"{noise:.2f} of the given sigma, {int((np.asarray(part.weights) < 0.1).sum())} outliers"
            )
        if (worst := float(np.max(self.noise))) > _TOO_MUCH:
            lines.append(
                f"residuals of {worst:.0f} sigma are no noise: outliers (loss='geman_mcclure'), numbers in other units "
                "(SI: m and rad), a joint or an unknown that is missing"
            )
        for name, value, sigma, unit in zip(
            self.names, np.asarray(self.vector), np.asarray(self.deviation), self.units, strict=True
        ):
            lines.append(f"  {name}: {1e3 * value:+.4f} +- {1e3 * sigma:.4f} m{unit}")
        for combination in self.unobservable:
            lines.append(f"not determined by these measurements: {combination}")
        return "\n".join(lines)

    def figure(self) -> Figure:
        """Return a picture of the residuals before and after the fit."""
        from ._picture import draw_residuals  # loads matplotlib

        return draw_residuals(self.residuals)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write changes, deviations (null: infinite), residuals and undetermined combinations to a YAML file.

        The text is JSON, which is YAML. Units are SI.
        """
        numbers = zip(self.names, np.asarray(self.vector), np.asarray(self.deviation), self.units, strict=True)
        content = {
            "converged": bool(self.converged),
            "unknowns": {
                name: {"change": float(value), "sigma": float(sigma) if np.isfinite(sigma) else None, "unit": unit}
                for name, value, sigma, unit in numbers
            },
            "residuals": [
                {
                    "of": part.kind,
                    "readings": len(part.after),
                    "rms_before": root_mean_square(part.before),
                    "rms_after": root_mean_square(part.after),
                    "unit": part.unit,
                }
                for part in self.residuals
            ],
            "undetermined": [one.coefficients for one in self.unobservable],
            "frames": {
                name: {
                    "parent": frame.parent,
                    "position": np.asarray(frame.position).tolist(),
                    "rotation": np.asarray(frame.rotation).tolist(),
                }
                for name, frame in {"base": self.base, **self.frames}.items()
            },
        }
        text = json.dumps(content, indent=2)
        # PyYAML reads 1e-05 as text, and 1.0e-05 as a number
        write_text(path, re.sub(r"(?m)([ -]\d)(e[-+]\d+,?)$", r"\1.0\2", text) + "\n")


def _reduced(rows: np.ndarray) -> np.ndarray:
    """Return rows that span the same space, each with a pivot in which the others are 0 (Gauss-Jordan)."""
    rows = rows.copy()
    for i in range(len(rows)):
        k, j = np.unravel_index(np.abs(rows[i:]).argmax(), rows[i:].shape)
        rows[[i, i + k]] = rows[[i + k, i]]
        rows[i] /= rows[i, j]
        others = np.arange(len(rows)) != i
        rows[others] -= rows[others, j][:, None] * rows[i]
    return rows
