"""The robot's own limits, and which of them hold beside the limits that a user gives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

from ..robot import Robot
from ._box import Limit
from ._configuration import ConfigurationLimit
from ._velocity import VelocityLimit

_OWN: tuple[type[ConfigurationLimit] | type[VelocityLimit], ...] = (ConfigurationLimit, VelocityLimit)


class NoLimits(Limit):
    """Marker that switches off the robot's own limits; see ``no_limits``."""

    def parts(self) -> Sequence[Limit]:
        """Return no parts: the marker bounds nothing."""
        return ()

    def core_leaves(self) -> list[Any]:
        """Return nothing: the marker bounds nothing."""
        return []

    def __repr__(self) -> str:
        """Return the expression that names it."""
        return "osik_jax.no_limits"


no_limits = NoLimits()
"""No limits of the robot's own: ``limits=osik.no_limits``; ``limits=(osik.no_limits, limit)`` is that limit alone."""

Limits: TypeAlias = Sequence[Limit] | NoLimits
"""Types that ``limits=`` takes, besides None."""


def keeps_own(limits: Sequence[Limit] | None, kind: type[Limit]) -> bool:
    """Return whether the robot's own limit of this class holds beside the given limits."""
    return not any(isinstance(limit, kind | NoLimits) for limit in limits or ())


def with_own_limits(robot: Robot, limits: Sequence[Limit] | None) -> tuple[Limit, ...]:
    """Return the given limits, and after them the robot's own limits that they do not replace.

    The own limits are ``ConfigurationLimit(robot)`` and ``VelocityLimit(robot)``. A given limit of one of these classes
    replaces the own limit of that class; ``no_limits`` among the given ones replaces both. A second call adds nothing.

    Args:
        robot: the robot.
        limits: the given limits, in any order; None: none.
    """
    return (*(limits or ()), *(own(robot) for own in _OWN if keeps_own(limits, own)))
