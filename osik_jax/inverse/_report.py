"""Configurations as tables, for the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.markup import escape
from rich.table import Column, Table

from ..robot import Robot

if TYPE_CHECKING:
    from rich.console import Console

    from ._solution import InverseKinematicsSolution


def print_found(console: Console, robot: Robot, found: InverseKinematicsSolution) -> None:
    """Print the answer for one target, or why there is none, and the configurations joint by joint.

    Of several, those that differ by more than whole turns.
    """
    console.print(found.explain(), markup=False, highlight=False)
    several = found.solutions is not None and found.converged
    solutions = list(found.solutions[: int(found.branches)]) if several else [found.q]  # pyright: ignore
    if several and found.count > found.branches:  # pyright: ignore
        console.print(f"beside these, {int(found.count - found.branches)} that differ by whole turns")  # pyright: ignore
    for q in solutions:
        console.print(configuration_table(robot, q))


def configuration_table(robot: Robot, q: Any) -> Table:
    """Return a configuration, joint by joint."""
    table = Table("joint", *(Column(name, justify="right") for name in ("in q", "value", "lower", "upper")))
    for joint in robot.tree.free_bases:
        start = robot.tree.qpos_address[joint]
        pose = " ".join(f"{float(value):.5f}" for value in q[start : start + 7])
        table.add_row("base", f"{start}-{start + 6}", pose, "", "")
    for name in robot.joint_names:
        dof, index = robot.joint_dof_index(name), robot.joint_qpos_index(name)
        numbers = (q[index], robot.position_lower[dof], robot.position_upper[dof])
        table.add_row(escape(name), str(index), *(f"{float(value):.5f}" for value in numbers))
    return table
