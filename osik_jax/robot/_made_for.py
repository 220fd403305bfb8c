"""Base of tasks and limits, which remember the robot that they were made for."""

from __future__ import annotations

import inspect
from functools import cache
from typing import Any, Self

import equinox as eqx

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


def check_made_for(part: MadeForRobot, robot: Robot, what: str) -> None:
    """Raise ValueError if the part was made for a robot with other joints."""
    if part.made_for is not None and part.made_for != robot.tree.dof_owners:
        raise OsikValueError(
            f"{what} is a {type(part).__name__} that was made for another robot, whose joints are: {part.made_for}. "
            f"Make it with this robot, whose joints are: {robot.tree.dof_owners}"
        )
