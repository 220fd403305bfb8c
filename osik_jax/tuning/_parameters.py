"""Parameters to tune, and the unbounded space of the optimiser."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._errors import OsikTypeError, OsikValueError
from ..batching._names import find_leaves
from ..batching._structure import is_number
from ._loop import Loop

_NEVER_NEGATIVE = {
    *("weight", "position_weight", "orientation_weight", "gain", "maximum", "minimum", "decay"),
    *("damping", "potential_gain", "margin", "rank_tolerance", "velocity", "body_mass", "velocity_limit", "dt"),
    *("dof_armature", "radius", "torque_scale"),
}
"""Numbers that have no meaning below zero."""


@dataclasses.dataclass(frozen=True)
class Parameter:
    """Numbers of a loop to tune, with their bounds.

    Attributes:
        name: as in ``Loop``. Every finite entry of every array that it stands for is tuned by itself.
        lower: no value goes below; approached smoothly and never reached.
        upper: likewise.
        log: whether steps are factors instead of sums. Default: for what has no meaning below zero (weights, gains,
            damping, speeds, masses) unless it is zero or ``lower`` is negative.
        initial: where tuning begins, instead of at the loop's own number.
    """

    name: str
    lower: float | None = None
    upper: float | None = None
    log: bool | None = None
    initial: float | None = None


class ParameterSpace(eqx.Module):
    """A loop's parameters as one unbounded vector with entries of similar size.

    With y the number, or its logarithm where ``log``, between bounds A and B:
    ``y = A + (B - A) sigmoid(4 s z / (B - A))``; with one bound alone ``y = A + softplus(s z)`` or
    ``B - softplus(-s z)``, with none ``y = s z``. The scale s is 1 for logarithms, so that a step of 0.1 in z is
    one of 10 % away from the bounds; for other numbers a quarter of the interval, or else the size of the start.

    Args:
        loop: the loop.
        parameters: names or ``Parameter``s.

    Attributes:
        names: of the entries of the vector: ``hand.weight``, ``hand.position_weight[2]``. (static)
        initial: the loop's own numbers, or those that parameters begin at. (p,)

    Raises:
        KeyError: a name that does not exist; the message lists those that do.
        ValueError: bounds in the wrong order, a start that is not between them or not positive where ``log``, a
            number that is named twice, no parameter at all.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    places: tuple[tuple[int, int], ...] = eqx.field(static=True)  # a leaf of the loop and an index into it, raveled
    log: Bool[Array, " p"]
    lower: Float[Array, " p"]
    upper: Float[Array, " p"]
    scale: Float[Array, " p"]
    initial: Float[Array, " p"]

    def __init__(self, loop: Loop, parameters: Sequence[str | Parameter]):
        if isinstance(parameters, (str, Parameter)):
            raise OsikTypeError(
                f"parameters is a sequence of names and Parameters, not one alone: use [{parameters!r}]"
            )
        numbers = [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(loop, is_number))]
        entries = _entries(loop.names, numbers, [_as_parameter(p) for p in parameters])
        self.names = tuple(entry.name for entry in entries)
        self.places = tuple((entry.leaf, entry.place) for entry in entries)
        dtype = jnp.result_type(*(numbers[entry.leaf].dtype for entry in entries))
        self.log = jnp.asarray([entry.log for entry in entries])
        self.lower, self.upper, self.scale, start = (
            jnp.asarray([getattr(entry, field) for entry in entries], dtype)
            for field in ("lower", "upper", "scale", "start")
        )
        self.initial = self.vector(start)

    def numbers(self, vector: Float[Array, " p"]) -> Float[Array, " p"]:
        """Return the loop's numbers from the unbounded vector."""
        low, high, between, above, below = self._bounds()
        span = jnp.where(between, high - low, 1.0)
        z = self.scale * vector
        inside = low + span * jax.nn.sigmoid(4.0 * z / span)
        one_sided = jnp.where(above, low + jax.nn.softplus(z), high - jax.nn.softplus(-z))
        y = jnp.where(between, inside, jnp.where(above | below, one_sided, z))
        return jnp.where(self.log, jnp.exp(jnp.where(self.log, y, 0.0)), y)

    def vector(self, numbers: Float[Array, " p"]) -> Float[Array, " p"]:
        """Return the inverse of ``numbers``."""
        low, high, between, above, below = self._bounds()
        span = jnp.where(between, high - low, 1.0)
        y = jnp.where(self.log, jnp.log(jnp.where(self.log, numbers, 1.0)), numbers)
        share = jnp.where(between, (y - low) / span, 0.5)
        inside = 0.25 * span * (jnp.log(share) - jnp.log1p(-share))
        way = jnp.where(above, y - low, jnp.where(below, high - y, 1.0))
        beyond = jnp.where(above, 1.0, -1.0) * (way + jnp.log(-jnp.expm1(-way)))
        return jnp.where(between, inside, jnp.where(above | below, beyond, y)) / self.scale

    def _bounds(self) -> tuple[Array, Array, Array, Array, Array]:
        """Return bounds (0 if missing), and which entries have both, the lower one alone, the upper one alone."""
        has_low, has_high = jnp.isfinite(self.lower), jnp.isfinite(self.upper)
        low, high = jnp.where(has_low, self.lower, 0.0), jnp.where(has_high, self.upper, 0.0)
        return low, high, has_low & has_high, has_low & ~has_high, has_high & ~has_low

    def apply(self, loop: Loop, vector: Float[Array, " p"]) -> Loop:
        """Return the loop with the numbers of a vector; differentiable in both."""
        numbers, rest = eqx.partition(loop, is_number)
        leaves, structure = jax.tree.flatten(numbers)
        values, places = self.numbers(vector), np.array(self.places)
        for leaf in np.unique(places[:, 0]):
            rows, old = np.flatnonzero(places[:, 0] == leaf), jnp.asarray(leaves[leaf])
            new = old.ravel().at[places[rows, 1]].set(values[rows].astype(old.dtype))
            leaves[leaf] = new.reshape(old.shape)
        return eqx.combine(jax.tree.unflatten(structure, leaves), rest)

    def by_name(self, vector: Float[Array, " p"]) -> dict[str, float]:
        """Return the loop's numbers from the vector, by the names of the entries."""
        return dict(zip(self.names, np.asarray(self.numbers(vector)).tolist(), strict=True))


@dataclasses.dataclass(frozen=True)
class _Entry:
    """One number: its place in the loop, its start, and its bounds and scale (logarithms where ``log``)."""

    name: str
    leaf: int
    place: int
    log: bool
    start: float
    lower: float
    upper: float
    scale: float


def _as_parameter(given: Any) -> Parameter:
    if not isinstance(given, (str, Parameter)):
        raise OsikTypeError(f"a parameter is a name or a Parameter, got {given!r}")
    return Parameter(given) if isinstance(given, str) else given


def _entries(names: tuple[str, ...], numbers: list[np.ndarray], parameters: list[Parameter]) -> list[_Entry]:
    entries: list[_Entry] = []
    taken: dict[int, str] = {}
    for parameter in parameters:
        for leaf in find_leaves(names, parameter.name):
            if leaf in taken:
                raise OsikValueError(f"{names[leaf]} is tuned twice, by {taken[leaf]!r} and by {parameter.name!r}")
            taken[leaf] = parameter.name
            value = numbers[leaf]
            for place in np.flatnonzero(np.isfinite(value)).tolist():
                at = ", ".join(str(i) for i in np.unravel_index(place, value.shape))
                label = f"{names[leaf]}[{at}]" if value.ndim else names[leaf]
                entries.append(_entry(label, leaf, place, float(value.ravel()[place]), parameter))
    if not entries:
        raise OsikValueError(f"there is no finite number to tune; numbers: {', '.join(names)}")
    return entries


def _entry(name: str, leaf: int, place: int, value: float, parameter: Parameter) -> _Entry:
    start = value if parameter.initial is None else float(parameter.initial)
    low = -np.inf if parameter.lower is None else float(parameter.lower)
    high = np.inf if parameter.upper is None else float(parameter.upper)
    log = _is_log(name, start, low) if parameter.log is None else parameter.log
    if not low < high:
        raise OsikValueError(f"{parameter.name}: the lower bound {low} is not below the upper bound {high}")
    if log and not start > 0.0:
        raise OsikValueError(
            f"{name} is {start}; in log space it begins at a positive number: Parameter(..., initial=...)"
        )
    if not low < start < high:
        raise OsikValueError(f"{name} begins at {start}, which is not between its bounds, {low} and {high}")
    if log:
        with np.errstate(divide="ignore"):
            return _Entry(name, leaf, place, True, start, float(np.log(max(low, 0.0))), float(np.log(high)), 1.0)
    scale = (high - low) / 4.0 if np.isfinite(high - low) else abs(start) or 1.0
    return _Entry(name, leaf, place, False, start, low, high, scale)


def _is_log(name: str, start: float, low: float) -> bool:
    """Return whether a number is positive by its name (its last part), and is tuned in log space."""
    field = name.split("[")[0] if "." not in name else name.rsplit(".", 1)[1].split("[")[0]
    return field in _NEVER_NEGATIVE and start > 0.0 and not (np.isfinite(low) and low < 0.0)


def overlap(space: ParameterSpace, loop: Loop, values: Mapping[str, Any]) -> None:
    """Raise ValueError if scenarios set a tuned number."""
    tuned = {leaf for leaf, _ in space.places}
    for name in values:
        both = [loop.names[leaf] for leaf in find_leaves(loop.names, name) if leaf in tuned]
        if both:
            raise OsikValueError(f"{both[0]} is a parameter, so scenarios cannot set it")
