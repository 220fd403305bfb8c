"""Names and units of the entries of configurations, velocities and the numbers of tasks."""

from __future__ import annotations

from collections.abc import Mapping

from ..robot import Robot
from ..robot._tree import BALL, FREE, HINGE, SLIDE
from ..tasks import Task

_QUATERNION = ("qw", "qx", "qy", "qz")
_IN_Q = {
    FREE: ([*"xyz", *_QUATERNION], ["m"] * 3 + ["1"] * 4),
    BALL: (list(_QUATERNION), ["1"] * 4),
    SLIDE: ([""], ["m"]),
    HINGE: ([""], ["rad"]),
}
_IN_V = {
    FREE: (["vx", "vy", "vz", "wx", "wy", "wz"], ["m/s"] * 3 + ["rad/s"] * 3),
    BALL: (["wx", "wy", "wz"], ["rad/s"] * 3),
    SLIDE: ([""], ["m/s"]),
    HINGE: ([""], ["rad/s"]),
}


def configuration_units(robot: Robot) -> tuple[list[str], list[str]]:
    """Return the name and the unit of each entry of q: the joint's name, with a suffix for free and ball joints."""
    return _entries(robot, _IN_Q)


def velocity_units(robot: Robot) -> tuple[list[str], list[str]]:
    """Return the name and the unit of each entry of v, as ``configuration_units``."""
    return _entries(robot, _IN_V)


def _entries(robot: Robot, parts: Mapping[int, tuple[list[str], list[str]]]) -> tuple[list[str], list[str]]:
    tree = robot.tree
    entries, units = [], []
    for joint in tree.independent:
        suffixes, own = parts[tree.joint_types[joint]]
        entries += [f"{tree.joint_names[joint]}.{suffix}".removesuffix(".") for suffix in suffixes]
        units += own
    return entries, units


def unit_of(tasks: Mapping[str, Task], name: str) -> str:
    """Return the unit of a number of a task, by its name in ``leaf_names(tasks)``."""
    owner = max((own for own in tasks if name.startswith(f"{own}.")), key=len)
    return tasks[owner].unit_of(name.removeprefix(f"{owner}."))
