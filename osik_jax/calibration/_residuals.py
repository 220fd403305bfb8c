"""Parts of a calibration's result: residuals, and combinations that are not determined."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, ArrayLike, Float


class Combination(NamedTuple):
    """A change of several unknowns that changes no measurement.

    Attributes:
        coefficients: change of each unknown by its name, the largest 1 [m or rad].
        ratio: how much the measurements change relative to the best observed combination, 0 to 1.
    """

    coefficients: dict[str, float]
    ratio: float

    def __str__(self) -> str:
        """Return ``a + 0.5 b - c``."""
        parts = [(("+ ", "- ")[v < 0.0], f"{abs(v):.3g} ", name) for name, v in self.coefficients.items()]
        return " ".join(sign + size.removeprefix("1 ") + name for sign, size, name in parts).removeprefix("+ ")


class Residuals(NamedTuple):
    """Differences between prediction and readings of one measurement.

    Attributes:
        kind: of the measurement, with its frames: ``"Points of tool0"``.
        unit: of the rows.
        before: with the numbers as given [unit]. (n, k)
        after: with the fit [unit]. (n, k)
        weights: of each reading by the robust loss: small for outliers, 1 for least squares. (n,)
    """

    kind: str
    unit: str
    before: Float[Array, "n k"]
    after: Float[Array, "n k"]
    weights: Float[Array, " n"]


def lengths(rows: ArrayLike) -> Float[np.ndarray, " n"]:
    """Return the length of each reading's residual, in its unit; of a pose that of its position."""
    return np.linalg.norm(np.asarray(rows)[:, :3], axis=-1)


def root_mean_square(rows: ArrayLike) -> float:
    """Return the root mean square of the lengths of the readings' residuals."""
    return float(np.sqrt(np.mean(lengths(rows) ** 2)))
