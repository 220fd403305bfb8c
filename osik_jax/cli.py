"""The command line: ``osik demo`` and ``osik info``."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Column, Table

    from .demo import Motion
    from .robot import Robot
    from .viewer import Look

_DESCRIPTION = "Operational-space inverse kinematics for redundant robots, in JAX. osik --version prints the version."
_EMBEDDED = ("nao", "arm7")
_USER_ERRORS = (OSError, KeyError, ValueError, ImportError)


class CommandError(Exception):
    """Something that the user can set right; told in one line."""


@dataclasses.dataclass(frozen=True)
class Demo:
    """Moves a robot with each scheme, and writes a film, a figure, the motion and a report to a folder.

    NAO sways over both feet (double-support), or lifts one (single-support). With --robot, the base or the tip of your
    own robot goes 5 cm to its left and back.
    """

    motion: Literal["double-support", "single-support"] | None = None
    """What NAO does. Default: double-support. Any other robot sways."""
    physics: bool = False
    """Run NAO in MuJoCo: feet on the floor with contact, position servos, what is sensed fed back every tick."""
    robot: str | None = None
    """A URDF or MJCF file (or nao, arm7) to move instead."""
    base: Literal["auto", "floating", "fixed"] = "auto"
    """With --robot: whether its root moves freely. auto: as the file says; a URDF that does not say floats if it has
    feet (or --support)."""
    frame: str | None = None
    """With --robot: the frame that moves. Default: the floating base, or the tip of a robot that is bolted down."""
    support: tuple[str, ...] = ()
    """With --robot: frames that stand on the ground. Default: those that look like feet."""
    duration: float = 8.0
    """Length of the motion [s]."""
    frequency: float = 200.0
    """Control ticks a second [Hz]."""
    schemes: tuple[Literal["weighted", "null-space", "hierarchical"], ...] = ("weighted", "null-space", "hierarchical")
    """Which schemes to run, one after the other; the film shows the last."""
    out: Path = Path("osik-demo")
    """Folder to write to."""
    animation: bool = True
    """Write the film (motion.gif; motion.mp4 too where the program ffmpeg is installed)."""
    picture: bool = False
    """Write picture.png as well: three instants side by side."""
    renderer: Literal["auto", "mujoco", "raycast"] = "auto"
    """mujoco needs OpenGL; raycast runs anywhere; auto takes the first that works."""


@dataclasses.dataclass(frozen=True)
class Info:
    """Prints a robot's joints with their limits, its frames and its mass."""

    robot: Annotated[str, tyro.conf.Positional]
    """A URDF or MJCF file, or one of the embedded robots: nao, arm7."""
    base: Literal["auto", "floating", "fixed"] = "auto"
    """Whether its root moves freely. auto: as the file says; a URDF that does not say floats if it has feet."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code.

    0, or 2 after what the user can set right (told on stderr in one line), or 130 where it was interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments == ["--version"]:
        print(f"osik-jax {importlib.metadata.version('osik-jax')}")
        return 0
    command = tyro.extras.subcommand_cli_from_dict(
        {"demo": Demo, "info": Info}, prog="osik", description=_DESCRIPTION, args=arguments or ["--help"]
    )
    try:
        with _notes():
            _run(command)
    except CommandError as error:
        print(f"osik: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"osik: interrupted{_left_behind(command)}", file=sys.stderr)
        return 130
    return 0


def _run(command: Demo | Info) -> None:
    """Runs a command in double precision."""
    import jax

    jax.config.update("jax_enable_x64", True)
    if isinstance(command, Info):
        _info(command)
    else:
        _demo(command)


def _left_behind(command: Demo | Info) -> str:
    """A remark where an interrupted command has written something."""
    if not isinstance(command, Demo) or not command.out.is_dir() or not os.listdir(command.out):
        return ""
    return f"; what is in {command.out} may be incomplete"


@contextmanager
def _notes() -> Iterator[None]:
    """Tells this package's warnings in one line each, in the words of the command line."""
    from ._errors import OsikWarning

    told = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *where: Any, **options: Any) -> None:
        if not issubclass(category, OsikWarning):
            return told(message, category, *where, **options)
        text = str(message).replace("floating_base=False", "--base fixed")
        text = text.replace("floating_base=True", "--base floating")
        print(f"osik: note: {text}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("always", OsikWarning)
        warnings.showwarning = show
        yield


@contextmanager
def _told() -> Iterator[None]:
    """Turns the exceptions of wrong input into a one-line message."""
    try:
        yield
    except _USER_ERRORS as error:
        text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
        raise CommandError(" ".join(text.split())) from error


def read_robot(source: str, base: str = "auto") -> Robot:
    """A robot by name (embedded, or one of robot_descriptions), or a URDF or MJCF file, told apart by what is in it.

    Args:
        source: name or path.
        base: ``"floating"``, ``"fixed"``, or ``"auto"``.

    Raises:
        CommandError: no such file, or what is in it is broken.
    """
    from .robot import Robot, load_robot

    with _told():
        if source in _EMBEDDED and not os.path.exists(source):
            if base != "auto":
                raise ValueError(f"--base goes with a file; {source} is what it is")
            return load_robot(source)
        path, floating = Path(source), {"auto": None, "floating": True, "fixed": False}[base]
        if not path.is_file():
            if source.endswith("_description"):
                return _described(source, floating)
            raise FileNotFoundError(
                f"no such file: {source} (embedded robots: {', '.join(_EMBEDDED)}; names of robot_descriptions end in "
                "_description)"
            )
        if _is_mjcf(path):
            return Robot.from_mjcf(path, floating_base=floating)
        return Robot.from_urdf(path, floating_base=floating)


def _described(name: str, floating: bool | None) -> Robot:
    """A robot of robot_descriptions, whose git may fail in ways of its own."""
    from .robot import load_robot

    try:
        return load_robot(name, floating_base=floating)
    except _USER_ERRORS:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())
        raise CommandError(f"{name} could not be fetched: {type(error).__name__}: {reason}") from error


def _read_demo_robot(command: Demo, source: str) -> Robot:
    """The robot to move; a URDF that does not say whether its base moves floats if --support names what stands."""
    stands = command.base == "auto" and command.support and Path(source).is_file() and not _is_mjcf(Path(source))
    return read_robot(source, "floating" if stands else command.base)


def _look(source: str) -> Look | None:
    """What a URDF shows; an MJCF's own shapes are in its model already."""
    from ._loading import urdf_of_description
    from .viewer import read_look

    if os.path.isfile(source):
        return None if _is_mjcf(Path(source)) else read_look(source)
    urdf = None if source in _EMBEDDED else urdf_of_description(source)
    return None if urdf is None else read_look(urdf[0], package_dirs=urdf[1])


def _is_mjcf(path: Path) -> bool:
    text = path.read_text(encoding="utf-8", errors="replace")
    return "<mujoco" in text and "<robot" not in text.split("<mujoco")[0]


def _info(command: Info) -> None:
    from rich.console import Console

    robot = read_robot(command.robot, command.base)
    console = Console()
    base = "floating base" if robot.floating_base else "bolted down"
    mass = float(robot.body_mass.sum())
    size = f"{len(robot.joint_names)} joints, {base}, nq {robot.nq}, nv {robot.nv}, {mass:.3f} kg"
    console.print(f"[bold]{command.robot}[/bold]: {size}")
    console.print(_joint_table(robot))
    for follower, (leader, multiplier) in robot.mimic_joints.items():
        console.print(f"{follower} follows {leader}, times {multiplier:g}")
    console.print(f"[bold]{len(robot.frame_names)} frames[/bold]: {', '.join(robot.frame_names)}")


def _joint_table(robot: Robot) -> Table:
    from rich.table import Table

    table = Table("joint", *(_right(name) for name in ("in q", "in v", "lower", "upper", "top speed")))
    for name in robot.joint_names:
        dof = robot.joint_dof_index(name)
        limits = (robot.position_lower[dof], robot.position_upper[dof], robot.velocity_limit[dof])
        numbers = (f"{float(value):.4f}".rstrip("0").rstrip(".") for value in limits)
        table.add_row(name, str(robot.joint_qpos_index(name)), str(dof), *numbers)
    return table


def _right(header: str) -> Column:
    from rich.table import Column

    return Column(header, justify="right")


def _demo(command: Demo) -> None:
    from rich.console import Console
    from rich.markup import escape

    from . import demo

    console = Console()
    motion, dt = _motion(command), 1.0 / command.frequency
    with _told():
        out = demo.writable_folder(command.out, demo.needed_bytes(motion, len(command.schemes), dt))
    for note in motion.notes:
        console.print(f"[yellow]note:[/yellow] {escape(note)}")
    settings: Any = dict(schemes=command.schemes, dt=dt, animation=command.animation)
    seconds = demo.estimate_seconds(motion, physics=command.physics, **settings)
    console.print(f"{escape(motion.title)}: this will take about {_spoken(seconds)}")
    settings["renderer"] = command.renderer
    with _writing(out), _progress(console) as announce:
        if command.physics:
            summary, simulated = demo.run_physics_demo(motion, out, announce=announce, **settings)
            last, table = simulated[-1].run, demo.physics_table(summary)
        else:
            summary, runs = demo.run_demo(motion, out, announce=announce, **settings)
            last, table = runs[-1], demo.table(summary)
        if command.picture:
            announce("drawing the picture", 1.0)
            demo.draw_picture(motion, last, out / "picture.png")
    console.print(table)
    console.print(f"written to {command.out}: {', '.join(sorted(os.listdir(command.out)))}")


def _motion(command: Demo) -> Motion:
    """The motion that the options ask for."""
    from . import demo

    _check(command)
    if command.robot is not None:
        robot = _read_demo_robot(command, command.robot)
        with _told():
            return demo.file_motion(
                robot,
                name=Path(command.robot).stem,
                frame=command.frame,
                support=command.support,
                duration=command.duration,
                look=_look(command.robot),
            )
    make = demo.single_support if command.motion == "single-support" else demo.double_support
    return make(command.duration)


def _check(command: Demo) -> None:
    """Options that exclude each other, and values out of range."""
    if command.robot is None and (command.frame is not None or command.support):
        raise CommandError("--frame and --support go with --robot FILE; NAO's motions choose their own")
    if command.robot is not None and command.motion is not None:
        raise CommandError(
            f"--motion {command.motion} is NAO's, and --robot moves another: its waist or its tip sways; "
            "--frame, --support and --duration say what, on what and how long"
        )
    if command.physics and command.robot is not None:
        raise CommandError("--physics goes with NAO's motions; for a robot of yours, see osik_jax.physics")
    if not command.frequency > 0.0:
        raise CommandError(f"--frequency is {command.frequency:g}; it has to be positive")
    if not command.duration * command.frequency >= 2.0:
        raise CommandError(f"--duration is {command.duration:g} s; it has to last two control ticks at least")
    if not command.schemes:
        raise CommandError("--schemes is empty; name at least one of: weighted, null-space, hierarchical")
    if command.renderer == "mujoco" and command.animation:
        from .viewer import check_opengl

        try:
            check_opengl()
        except RuntimeError as error:
            raise CommandError(f"--renderer mujoco: {' '.join(str(error).split())}; use auto or raycast") from error


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    """Tells in one line that a file could not be written, as on a full disk."""
    try:
        yield
    except OSError as error:
        raise CommandError(f"cannot write to {folder}: {error.strerror or error}; it may be incomplete") from error


def _spoken(seconds: float) -> str:
    """A time as one says it: no more exact than it is known."""
    if seconds < 90.0:
        return f"{max(5 * round(seconds / 5.0), 5)} s"
    return f"{0.5 * round(seconds / 30.0):g} min"


@contextmanager
def _progress(console: Console) -> Iterator[Callable[[str, float], None]]:
    """A progress bar over the stages; yields what to tell it."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (BarColumn(bar_width=30), TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn())
    with Progress(*columns, TextColumn("{task.description}"), console=console) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda stage, done: bar.update(task, description=stage, completed=done)


if __name__ == "__main__":
    sys.exit(main())
