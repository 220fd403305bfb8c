"""``osik info``."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated

import tyro

from ._inputs import HasBase, read_robot
from ._messages import CommandError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from ..robot import Robot


@dataclasses.dataclass(frozen=True)
class Info(HasBase):
    """Prints a robot's joints with their limits, its frames and its mass, and what it does not keep of its file."""

    robot: Annotated[str, tyro.conf.Positional] = ""
    """A URDF or MJCF file, or a robot by name: nao, ur5, g1 and others, or one of robot_descriptions."""
    system: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the versions and devices in use, and which compiled core is loaded and why."""

    spheres: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the spheres that cover its collision shapes: how many, and how far they stick out."""
    given: Annotated[str, tyro.conf.arg(metavar="FILE")] = ""
    """With --spheres: spheres of your own, a .yaml of cuRobo or a URDF whose collision shapes are spheres."""
    png: Annotated[str, tyro.conf.arg(metavar="FILE")] = ""
    """With --spheres: write a picture of the robot and the spheres."""

    def run(self) -> int:
        """Run the command; return the exit code."""
        from rich.console import Console
        from rich.markup import escape

        console = Console()
        if self.system:
            _print_system(console)
        if not self.robot:
            if self.system:
                return 0
            raise CommandError("osik info needs a robot, as in osik info nao, or --system")
        robot = read_robot(self.robot, self.base)
        if self.spheres:
            return _print_spheres(console, robot, self.given, self.png)
        if self.given or self.png:
            raise CommandError("--given and --png go with --spheres")
        base = "floating base" if robot.floating_base else "bolted down"
        own = robot.body_mass[robot.tree.is_own] if len(robot.tree.robots) <= 1 else robot.body_mass
        size = f"{len(robot.joint_names)} joints, {base}, nq {robot.nq}, nv {robot.nv}, {float(own.sum()):.3f} kg"
        console.print(f"[bold]{escape(self.robot)}[/bold]: {size}")
        console.print(_joint_table(robot))
        for follower, (leader, multiplier) in robot.mimic_joints.items():
            console.print(f"{follower} follows {leader}, times {multiplier:g}", markup=False)
        console.print(f"[bold]{len(robot.frame_names)} frames[/bold]: {escape(', '.join(robot.frame_names))}")
        _print_report(console, robot)
        return 0


def _print_system(console: Console) -> None:
    """Print versions, devices and which compiled core is loaded."""
    import platform
    from importlib.metadata import version

    import jax

    from ..core import _cuda, _library

    packages = ", ".join(f"{name} {version(name)}" for name in ("osik-jax", "jax", "jaxlib", "mujoco", "mujoco-mjx"))
    nvrtc = _cuda.nvrtc() or "none; it comes with jax[cuda13] and jax[cuda12]"
    lines = (
        f"Python {platform.python_version()} on {platform.machine()}: {packages}",
        f"devices: {', '.join(map(str, jax.devices()))}",
        f"compiled core: {_library.core().reason}",
        f"CUDA compiler (NVRTC): {nvrtc}",
    )
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def _print_spheres(console: Console, robot: Robot, given: str, png: str) -> int:
    """Print a table of the covering spheres of each collision shape; return the exit code."""
    from rich.markup import escape
    from rich.table import Table

    from ..collision import covering_spheres
    from ..viewer._figures import sphere_picture

    try:
        spheres = covering_spheres(robot, given or None)
    except (OSError, ValueError, KeyError, ImportError) as error:
        raise CommandError(str(error)) from None
    table = Table("shape", "spheres", "radii, mm", "stick out, mm")
    for row, name in enumerate(spheres.names):
        own = spheres.shape == row
        if own.any():
            radii, over = 1e3 * spheres.radius[own], 1e3 * spheres.overshoot[own]
            span = f"{radii.min():.1f} to {radii.max():.1f}"
            table.add_row(escape(name), str(own.sum()), span, f"{over.mean():.1f}, at most {over.max():.1f}")
    console.print(table)
    over = 1e3 * spheres.overshoot
    console.print(
        f"{len(over)} spheres stick out by {over.mean():.1f} mm in the mean and {over.max():.1f} mm at most; "
        "no surface is uncovered",
        highlight=False,
        soft_wrap=True,
    )
    if png:
        console.print(f"{sphere_picture(png, robot, spheres)}: the robot, and its spheres", markup=False)
    return 0


def _print_report(console: Console, robot: Robot) -> None:
    """Print a table of what the file asks for and the robot does not keep."""
    from rich.markup import escape
    from rich.table import Table

    if not robot.load_report:
        console.print(f"[bold]load report[/bold]: {robot.load_report}")
        return
    table = Table("element", "name", "what was done instead", title="load report")
    for note in robot.load_report:
        table.add_row(*(escape(text) for text in note))
    console.print(table)


def _joint_table(robot: Robot) -> Table:
    from rich.markup import escape
    from rich.table import Table

    table = Table("joint")
    for name in ("in q", "in v", "lower", "upper", "top speed"):
        table.add_column(name, justify="right")
    for name in robot.joint_names:
        dof = robot.joint_dof_index(name)
        limits = (robot.position_lower[dof], robot.position_upper[dof], robot.velocity_limit[dof])
        numbers = (f"{float(value):.4f}".rstrip("0").rstrip(".") for value in limits)
        table.add_row(escape(name), str(robot.joint_qpos_index(name)), str(dof), *numbers)
    return table
