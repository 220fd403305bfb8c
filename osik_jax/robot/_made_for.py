"""Base of tasks and limits, which remember the robot that they were made for."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable
from functools import cache
from typing import Any, Self

import equinox as eqx
import jax
import numpy as np

from .._errors import OsikTypeError, OsikValueError
from ._robot import Robot


class MadeForRobot(eqx.Module):
    """Base of tasks and limits. A class whose constructor takes a ``robot`` first remembers that robot's joints."""

    # names of the joints that own entries of v, in one string (static); None where no robot was given
    made_for: str | None = eqx.field(default=None, init=False, static=True, repr=False)

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Check the robot before the constructor runs."""
        new = super().__new__(cls)
        if _takes_robot(cls) and (args or "robot" in kwargs):
            robot = args[0] if args else kwargs["robot"]
            check_robot(robot, f"{cls.__name__}(robot, ...)")
            object.__setattr__(new, "made_for", robot.tree.dof_owners)
        return new


@cache
def _takes_robot(cls: type) -> bool:
    return next(iter(list(inspect.signature(cls.__init__).parameters)[1:]), None) == "robot"


def check_robot(robot: Any, where: str) -> None:
    """Raise TypeError unless the argument is a robot, ValueError for a stack of robots."""
    if not isinstance(robot, Robot):
        raise OsikTypeError(
            f"{where}: robot is {robot!r}; it is a Robot, as osik_jax.load_robot and Robot.from_urdf return"
        )
    shape = getattr(robot.q0, "shape", None)
    if shape is not None and shape != (robot.nq,):
        raise OsikValueError(
            f"{where}: robot is a stack of robots (its q0 has shape {shape}, one robot's has ({robot.nq},)). "
            "Take it apart with jax.vmap, or osik_jax.batched"
        )


def check_single(part: eqx.Module, what: str) -> None:
    """Raise ValueError for a stack: a leaf with more axes than the annotation of its field says."""
    for name, most in _most_axes(type(part)):
        value = getattr(part, name)
        if isinstance(value, eqx.Module):
            check_single(value, f"{what}.{name}")
            continue
        for leaf in jax.tree.leaves(value):
            if np.ndim(leaf) > most:
                raise OsikValueError(
                    f"{what} is a stack, or has too many axes: its {name} has shape {np.shape(leaf)}. "
                    "Take stacks apart with jax.vmap, or osik_jax.batched"
                )


@cache
def _most_axes(cls: type) -> list[tuple[str, float]]:
    """Return the fields of a class whose annotations say how many axes their arrays have, with the largest number."""
    try:
        hints = typing.get_type_hints(cls)
    except Exception:  # a user's annotation may say anything, or what only type checkers see
        return _most_axes(cls.__base__) if cls.__base__ else []
    most = {name: max(map(_axes, _parts(hint))) for name, hint in hints.items()}
    return [(name, axes) for name, axes in most.items() if 0 <= axes < np.inf]


def _parts(hint: Any) -> list[Any]:
    """Return the types that a union or a tuple is made of."""
    inner = () if typing.get_origin(hint) is Callable else typing.get_args(hint)
    return [part for one in inner for part in _parts(one)] if inner else [hint]


def _axes(hint: Any) -> float:
    """Return how many axes arrays of this type have at most, -1 for None and modules, which tell of their own."""
    if hint is type(None) or (isinstance(hint, type) and issubclass(hint, eqx.Module)):
        return -1
    return len(hint.dims) if getattr(hint, "index_variadic", 0) is None else np.inf


def check_made_for(part: MadeForRobot, robot: Robot, what: str) -> None:
    """Raise ValueError if the part was made for a robot with other joints."""
    if part.made_for is not None and part.made_for != robot.tree.dof_owners:
        raise OsikValueError(
            f"{what} is a {type(part).__name__} that was made for another robot, whose joints are: {part.made_for}. "
            f"Make it with this robot, whose joints are: {robot.tree.dof_owners}"
        )
