"""What checks the package against its annotations, array shapes included, while tests run.

pytest --jaxtyping-packages=osik_jax,shape_checks.checked

Arguments are looked at when a function has returned, together with its result: what it refuses in words of its own, it
still refuses in those. Not checked: functions that give ``Any``, results annotated ``Self`` (beartype does not see the
class), and all items of a list but one.
"""

from collections.abc import Callable
from types import UnionType
from typing import Any, Self, Union, get_args, get_origin

import jax
import numpy as np
import numpy.typing as npt
from beartype import BeartypeConf, FrozenDict, beartype
from jaxtyping import AbstractArray

_WHOLE = int | np.integer
_REAL = float | np.floating | _WHOLE
_NUMBERS = {bool: bool | np.bool_, int: _WHOLE, float: _REAL, complex: complex | np.complexfloating | _REAL}
"""NumPy's numbers are numbers, and an int is a float, as for every type checker."""
_checking = beartype(conf=BeartypeConf(hint_overrides=FrozenDict(_NUMBERS)))


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """``function``, which checks; jaxtyping asks once for arguments alone and once for arguments and result."""
    hints = function.__annotations__
    result = hints.get("return")
    if result is Any:
        return function
    hints |= {name: _from_numpy_too(hint) for name, hint in hints.items() if name != "return"}
    if result is Self:
        hints["return"] = Any
    return _checking(function)


def _from_numpy_too(hint: Any) -> Any:
    """JAX takes NumPy's arrays for its own: an argument may be one. A result may not."""
    if get_origin(hint) in (Union, UnionType):
        if set(get_args(npt.ArrayLike)) <= set(get_args(hint)):
            return Any  # it has protocols that tuples and lists have for type checkers alone
        return Union[tuple(_from_numpy_too(part) for part in get_args(hint))]  # noqa: UP007
    if get_origin(hint) is tuple:
        return tuple[tuple(_from_numpy_too(part) for part in get_args(hint))]
    if hint is jax.Array:
        return jax.Array | np.ndarray
    if isinstance(hint, type) and issubclass(hint, AbstractArray) and hint.array_type is jax.Array:
        return hint.dtype[jax.Array | np.ndarray, hint.dim_str]
    return hint
