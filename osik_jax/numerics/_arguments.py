"""Conversion of a user's numbers to array leaves, with checks of concrete values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, DTypeLike, Float

from .._errors import OsikTypeError, OsikValueError
from ._host import is_traced, repeated, to_host, to_jax


def float_dtype(dtype: DTypeLike, what: str) -> np.dtype:
    """Return a floating-point dtype that JAX supports now; ``float`` stands for JAX's default."""
    wanted = np.dtype(jnp.result_type(float) if dtype is float else dtype)
    if not jnp.issubdtype(wanted, np.floating):
        raise OsikTypeError(f"dtype is {dtype!r}; {what} floating-point: float32 or float64")
    if wanted == np.float64 and jnp.result_type(float) != wanted:
        raise OsikValueError("float64 needs jax.config.update('jax_enable_x64', True) first")
    return wanted


def as_scalar(value: Any, what: str, dtype: Any = None) -> Float[Array, ""]:
    """Return a finite number that is not negative; ``dtype=None``: an array's float dtype, else JAX's default."""
    if dtype is None:
        own = isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating)
        dtype = value.dtype if own else float
    out = as_vector(value, (), what, dtype)
    check_not_negative(out, what)
    return out


def as_vector(value: Any, shape: tuple[int, ...], what: str, dtype: Any) -> Array:
    """Return an array of this shape; a scalar is repeated."""
    out = as_array(value, what, dtype)
    if out.shape not in ((), shape):
        expected = "a scalar" if shape == () else f"{shape} or a scalar"
        raise OsikValueError(f"{what} has shape {out.shape}, expected {expected}. Batch with jax.vmap.")
    check_not_nan(out, what)
    return repeated(out, shape)


def check_not_nan(value: Array, what: str) -> None:
    """Raise ValueError if a concrete value has a NaN."""
    seen = concrete(value)
    if seen is not None and np.isnan(seen).any():
        raise OsikValueError(f"{what} is {seen}; it has to be numbers, not NaN")


def check_finite(value: Any, what: str) -> None:
    """Raise ValueError unless a value is finite; traced values are not checked."""
    seen = concrete(value)
    if seen is not None and not np.isfinite(seen).all():
        raise OsikValueError(f"{what} is {seen}; it has to be finite")


def check_not_negative(value: Array, what: str, *, finite: bool = True) -> None:
    """Raise ValueError unless a value is not negative, and finite if wanted; traced values are not checked."""
    seen = concrete(value)
    if seen is not None and not ((not finite or np.isfinite(seen).all()) and (seen >= 0.0).all()):
        raise OsikValueError(f"{what} is {seen}; it has to be {'finite and ' if finite else ''}not negative")


def as_bounds(lower: Any, upper: Any, rows: int, dtype: Any) -> tuple[Array | None, Array | None]:
    """Return both bounds as arrays (rows,), a missing one infinite; (None, None) if neither is given."""
    if lower is None and upper is None:
        return None, None
    low = as_vector(-jnp.inf if lower is None else lower, (rows,), "lower", dtype)
    high = as_vector(jnp.inf if upper is None else upper, (rows,), "upper", dtype)
    check_bounds(low, high)
    return low, high


def check_bounds(lower: Array | None, upper: Array | None) -> None:
    """Raise ValueError if a concrete lower bound is above the upper one."""
    low, high = concrete(lower), concrete(upper)
    if lower is None or upper is None or low is None or high is None:
        return
    if (low > high).any():
        rows = np.flatnonzero(low > high)
        raise OsikValueError(f"lower > upper in rows {rows.tolist()}: lower {low[rows]}, upper {high[rows]}")


def entries(values: np.ndarray, which: np.ndarray, names: Sequence[str] | None = None) -> str:
    """Return some entries of an array as text for messages, with their names or numbers."""
    found = np.flatnonzero(which).tolist()
    return ", ".join(f"{names[i] if names else f'entry {i}'} ({values[i]})" for i in found)


def check_positive(what: str, values: Any, names: Sequence[str] | None = None, *, or_zero: bool = False) -> None:
    """Raise ValueError unless each entry is positive, or 0 if that is allowed; traced values are not checked."""
    seen = concrete(values)
    if seen is None:
        return
    wrong = ~((seen >= 0.0) if or_zero else (seen > 0.0))
    if wrong.any():
        raise OsikValueError(
            f"{what} have to be {'0 or more' if or_zero else 'positive'}: {entries(seen, wrong, names)}"
        )


def check_count(what: str, value: Any, *, least: int = 1) -> None:
    """Raise ValueError unless the value is an integer of at least ``least``."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise OsikValueError(f"{what} is {value!r}; it is an integer, at least {least}")


def as_array(value: Any, what: str, dtype: Any) -> Array:
    """Return the value as an array of this dtype."""
    try:
        return to_jax(value, dtype)
    except (TypeError, ValueError):
        shown = repr(value)
        raise OsikTypeError(f"{what} is {shown[:80]}; it is a number, or an array of numbers") from None


def as_host_numbers(value: Any, what: str) -> Any:
    """Return floats of NumPy, for which nothing is compiled; traced numbers as floats of JAX."""
    if isinstance(value, int | float):  # the checks of arrays take as long as a short search
        return np.asarray(value, float)
    try:
        return as_floats(value) if is_traced(value) else to_host(value, float)
    except (TypeError, ValueError):
        raise OsikTypeError(f"{what} is {repr(value)[:80]}; it is a number, or an array of numbers") from None


def as_floats(value: Any, *beside: Any) -> Array:
    """Return an array of the value's own precision; integers get that of the floats beside it, or JAX's default."""
    array = jnp.asarray(value)
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array
    if jnp.issubdtype(array.dtype, jnp.complexfloating):
        raise OsikTypeError(f"numbers are real; got an array of {array.dtype}")
    kind = jnp.result_type(array, *(jnp.asarray(other) for other in beside if other is not None))
    return array.astype(kind if jnp.issubdtype(kind, jnp.floating) else jnp.result_type(float))


def concrete(value: Any) -> np.ndarray | None:
    """Return the value as a NumPy array, or None if it is traced."""
    return None if isinstance(value, Tracer) else np.asarray(value)


def numbers_for(*values: Any) -> Any:
    """Return NumPy for NumPy's arrays alone, else ``jax.numpy``, whose dispatch costs more than a short computation."""
    return np if all(isinstance(value, np.ndarray) for value in values) else jnp
