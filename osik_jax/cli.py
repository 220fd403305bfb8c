"""The command line: ``osik demo``, ``ik``, ``reach``, ``retarget``, ``view`` and ``info``."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import os
import sys
import warnings
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from ._errors import OsikValueError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Column, Table

    from .demo import Motion
    from .robot import Robot

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
class View:
    """Shows a robot in the browser: drag its hands, feet and waist, and it follows. Needs the extra viewer.

    With a file: plays the motion.npz that osik demo wrote, opens a session that a view has saved, or shows slices of
    the map.npz that osik reach wrote.
    """

    file: Annotated[Path | None, tyro.conf.Positional] = None
    """A motion.npz to play, a session.json to open, or a map.npz. Default: drag the robot."""
    robot: str = "nao"
    """A URDF or MJCF file, or nao, arm7, g1 (from the package example-robot-data), or a name of robot_descriptions."""
    base: Literal["auto", "floating", "fixed"] = "auto"
    """Whether its root moves freely. auto: as the file says; a URDF that does not say floats if it has feet."""
    support: tuple[str, ...] = ()
    """Frames that stand on the ground. Default: those that look like feet."""
    host: str = "127.0.0.1"
    """Address to listen at; the default is this machine alone."""
    port: int = 8080
    """Port to listen at; 0 for any that is free."""
    browser: bool = True
    """Open the page in a browser."""
    html: Path | None = None
    """With a motion.npz: write a page that plays it without a server, instead of serving one."""


@dataclasses.dataclass(frozen=True)
class Ik:
    """Finds a configuration that brings a frame to a pose, and prints it; or says what stops the robot.

    The exit code is 1 where none is found.
    """

    robot: Annotated[str, tyro.conf.Positional]
    """A URDF or MJCF file, or one of the embedded robots: nao, arm7."""
    frame: str
    """The frame: a link, body, site or geom."""
    position: tuple[float, float, float]
    """Where its origin should be, in world axes [m]."""
    quaternion: tuple[float, float, float, float] | None = None
    """How it should be turned: w x y z. Default: anyhow."""
    hold: tuple[str, ...] = ()
    """Frames that stay where they are at the robot's home configuration, such as feet."""
    base: Literal["auto", "floating", "fixed"] = "auto"
    """Whether its root moves freely. auto: as the file says; a URDF that does not say floats if it has feet."""
    nearest: bool = False
    """Of the solutions that are found, the one nearest to the home configuration."""
    all: bool = False
    """Print all solutions that differ."""
    seeds: int = 64
    """Number of searches."""
    key: int = 0
    """Number of the sequence of their starts."""
    position_tolerance: float = 1e-3
    """Largest distance from the position [m]."""
    orientation_tolerance: float = 1e-2
    """Largest angle to the orientation [rad]."""


@dataclasses.dataclass(frozen=True)
class Reach:
    """Maps what a frame gets to: for each position of a grid, the share of orientations that it reaches.

    Writes the map and, beside it, a picture. What is finished is kept in a folder until then: the name of the map with
    .chunks after it.
    """

    robot: str
    """A URDF or MJCF file, or one of the embedded robots: nao, arm7."""
    frame: str
    """The frame: a link, body, site or geom, carried by hinges and slides."""
    out: Path = Path("map.npz")
    """File to write. The picture has the same name, and ends in .png."""
    resume: bool = False
    """Go on with a map that was interrupted, with the same options."""
    positions: int = 20_000
    """About how many positions."""
    orientations: int = 64
    """How many orientations at each."""
    seeds: int = 64
    """Number of searches for a pose, at most."""
    key: int = 0
    """Number of the sequence of their starts."""
    base: Literal["auto", "floating", "fixed"] = "auto"
    """Whether its root moves freely. auto: as the file says; a URDF that does not say floats if it has feet."""
    position_tolerance: float = 1e-3
    """Largest distance from a position [m]."""
    orientation_tolerance: float = 1e-2
    """Largest angle to an orientation [rad]."""
    picture: bool = True
    """Draw the picture."""

    @property
    def unfinished(self) -> Path:
        """Folder of what is finished."""
        return self.out.with_name(f"{self.out.name}.chunks")


@dataclasses.dataclass(frozen=True)
class Info:
    """Prints a robot's joints with their limits, its frames and its mass."""

    robot: Annotated[str, tyro.conf.Positional]
    """A URDF or MJCF file, or one of the embedded robots: nao, arm7."""
    base: Literal["auto", "floating", "fixed"] = "auto"
    """Whether its root moves freely. auto: as the file says; a URDF that does not say floats if it has feet."""


@dataclasses.dataclass(frozen=True)
class Retarget:
    """Makes a robot do what a person did: from a motion file to a folder.

    Writes motion.npz (MuJoCo's order, with the person's joints), motion.csv (position, quaternion x y z w, joints; no
    headings), report.json (figures recomputed by MuJoCo), profile.toml (how the robot was seen) and motion.gif.
    """

    clip: Annotated[str, tyro.conf.Positional]
    """A BVH file, or keypoints as .npz or .csv."""
    robot: str = "nao"
    """nao, g1 (of example-robot-data, where that is installed), or a URDF or MJCF file."""
    out: Path = Path("osik-retarget")
    """Folder to write to."""
    profile: str | None = None
    """A TOML file that says how the robot is seen. Default: the package's own for NAO and G1, else a guess."""
    mapping: tuple[str, ...] = ()
    """Which of the clip's joints is which, as ROLE=NAME, where names are not to be guessed; all of them then."""
    fps: float | None = None
    """Frames a second of the result. Default: the clip's."""
    acceleration: float = 240.0
    """Greatest acceleration of the joints [rad/s^2]."""
    unit: str | None = None
    """Of a BVH: m, cm, mm, inch, cmu, or metres a unit as a number. Default: found from the skeleton's size."""
    up: Literal["x", "y", "z"] | None = None
    """Of a BVH: the axis that points up. Default: found from the skeleton."""
    animation: bool = True
    """Write the film (motion.gif)."""
    live: bool = False
    """Frame by frame: CLIP is replayed at its own rate, as it would come from a person; - reads JSON lines from stdin
    and writes JSON lines to stdout, and nothing to a folder."""
    look_ahead: int = 8
    """With --live: how many frames the robot is behind the person."""


_Command = Demo | Ik | Reach | Retarget | View | Info


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code.

    0, or 1 where ``osik ik`` finds nothing, or 2 after what the user can set right (told on stderr in one line), or 130
    where it was interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments == ["--version"]:
        print(f"osik-jax {importlib.metadata.version('osik-jax')}")
        return 0
    command = tyro.extras.subcommand_cli_from_dict(
        {"demo": Demo, "ik": Ik, "reach": Reach, "retarget": Retarget, "view": View, "info": Info},
        prog="osik",
        description=_DESCRIPTION,
        args=arguments or ["--help"],
    )
    try:
        with _notes():
            return _run(command)
    except CommandError as error:
        print(f"osik: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"osik: interrupted{_left_behind(command)}", file=sys.stderr)
        return 130


def _run(command: _Command) -> int:
    """Runs a command in double precision; returns the exit code."""
    import jax

    from .runtime import configure_cpu

    configure_cpu()
    jax.config.update("jax_enable_x64", True)
    if isinstance(command, Info):
        _info(command)
    elif isinstance(command, Ik):
        return _ik(command)
    elif isinstance(command, Reach):
        _reach(command)
    elif isinstance(command, View):
        _view(command)
    elif isinstance(command, Retarget):
        _retarget(command)
    else:
        _demo(command)
    return 0


def _left_behind(command: _Command) -> str:
    """A remark where an interrupted command has written something."""
    if isinstance(command, Reach) and command.unfinished.is_dir():
        return f"; with --resume it goes on where it was ({command.unfinished})"
    if not isinstance(command, Demo | Retarget) or not command.out.is_dir() or not os.listdir(command.out):
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
    from ._loading import is_mjcf
    from .robot import Robot, load_robot

    with _told():
        if source in _EMBEDDED and not os.path.exists(source):
            if base != "auto":
                raise OsikValueError(f"--base goes with a file; {source} is what it is")
            return load_robot(source)
        path, floating = Path(source), {"auto": None, "floating": True, "fixed": False}[base]
        if not path.is_file():
            if source.endswith("_description"):
                return _described(source, floating)
            raise FileNotFoundError(
                f"no such file: {source} (embedded robots: {', '.join(_EMBEDDED)}; names of robot_descriptions end in "
                "_description)"
            )
        if is_mjcf(path):
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
    from ._loading import is_mjcf

    stands = command.base == "auto" and command.support and Path(source).is_file() and not is_mjcf(source)
    return read_robot(source, "floating" if stands else command.base)


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


def _ik(command: Ik) -> int:
    from rich.console import Console

    from .inverse import inverse_kinematics
    from .inverse._report import print_found

    robot = read_robot(command.robot, command.base)
    with _told():
        held = _home_poses(robot, command.hold)
        turned = command.quaternion is not None
        wanted = {command.frame: (command.position, command.quaternion) if turned else command.position}
        found = inverse_kinematics(
            robot,
            held | wanted,
            seeds=command.seeds,
            key=command.key,
            nearest=command.nearest,
            all=command.all,
            position_tolerance=command.position_tolerance,
            orientation_tolerance=command.orientation_tolerance,
        )
    print_found(Console(), robot, found)
    return 0 if found.converged else 1


def _home_poses(robot: Robot, frames: Sequence[str]) -> dict[str, Any]:
    """Where frames are at the home configuration."""
    from .kinematics import forward_kinematics

    if not frames:
        return {}
    home = forward_kinematics(robot, robot.q0)
    return {name: home.frame_pose(robot, name) for name in frames}


def _reach(command: Reach) -> None:
    import shutil

    from rich.console import Console

    from . import reachability
    from .reachability._report import summary_table

    chunks = command.unfinished
    if chunks.exists() and not command.resume:
        raise CommandError(f"{chunks} has an unfinished map: --resume goes on with it; else remove it, or change --out")
    robot = read_robot(command.robot, command.base)
    with _told():
        found = reachability.reachability_map(
            robot,
            command.frame,
            grid=command.positions,
            orientations=command.orientations,
            seeds=command.seeds,
            key=command.key,
            position_tolerance=command.position_tolerance,
            orientation_tolerance=command.orientation_tolerance,
            out=chunks,
        )
        found.save(command.out)
    written, picture = [str(command.out)], command.out.with_suffix(".png")
    if command.picture:
        with _writing(picture):
            found.figure().savefig(picture)
        written.append(str(picture))
    shutil.rmtree(chunks, ignore_errors=True)
    console = Console()
    console.print(summary_table(found))
    console.print(f"written: {', '.join(written)}", markup=False, highlight=False)


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
    from ._progress import spoken

    console = Console()
    motion, dt = _motion(command), 1.0 / command.frequency
    with _told():
        out = demo.writable_folder(command.out, demo.needed_bytes(motion, len(command.schemes), dt))
    for note in motion.notes:
        console.print(f"[yellow]note:[/yellow] {escape(note)}")
    settings: Any = dict(schemes=command.schemes, dt=dt, animation=command.animation)
    seconds = demo.estimate_seconds(motion, physics=command.physics, **settings)
    console.print(f"{escape(motion.title)}: this will take about {spoken(seconds)}")
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


def _retarget(command: Retarget) -> None:
    if command.live:
        return _retarget_live(command)
    from rich.console import Console
    from rich.markup import escape

    from . import retargeting
    from .retargeting._command import retarget_to_folder

    console = Console()
    with _told():
        unit = None if command.unit is None else _number_or_name(command.unit)
        motion = retargeting.load_motion(command.clip, unit=unit, up=command.up)
        profile = None if command.profile is None else retargeting.load_profile(command.profile)
        robot = _robot_to_retarget(command.robot)
        retargeter = retargeting.Retargeter(robot, profile=profile, acceleration=command.acceleration)
        mapping = _mapping(command.mapping)
        console.print(f"{escape(motion.name)}: {motion.frames} frames at {motion.fps:g} a second")
        _, figures = retarget_to_folder(
            retargeter, motion, command.out, mapping=mapping, fps=command.fps, animation=command.animation
        )
    _print_retargeted(console, figures, command.out)


def _retarget_live(command: Retarget) -> None:
    """A clip at its own rate, or a stream on stdin."""
    import numpy as np
    from rich.console import Console
    from rich.markup import escape

    from . import retargeting
    from .retargeting._command import write_folder
    from .retargeting._live_command import replay, stream

    console = Console()
    with _told():
        profile = None if command.profile is None else retargeting.load_profile(command.profile)
        robot, mapping = _robot_to_retarget(command.robot), _mapping(command.mapping)

        def make(standing: retargeting.HumanMotion) -> retargeting.LiveRetargeter:
            return retargeting.LiveRetargeter(
                robot,
                standing,
                profile=profile,
                mapping=mapping,
                acceleration=command.acceleration,
                look_ahead=command.look_ahead,
            )

        if command.clip == "-":
            stream(make, sys.stdin, sys.stdout)
            return
        unit = None if command.unit is None else _number_or_name(command.unit)
        motion = retargeting.load_motion(command.clip, unit=unit, up=command.up)
        motion = motion if command.fps is None else motion.resampled(command.fps)
        command.out.mkdir(parents=True, exist_ok=True)
        console.print(f"{escape(motion.name)}: {motion.frames} frames at {motion.fps:g} a second, as they come")
        result, frames = replay(make, motion)
        figures = write_folder(result, motion.name, command.out, animation=command.animation)
    spent = 1e3 * np.array([frame.seconds for frame in frames])
    waiting = 1e3 * command.look_ahead / motion.fps
    console.print(
        f"the robot is {waiting + np.median(spent):.0f} ms behind: {command.look_ahead} frames of look-ahead are "
        f"{waiting:.0f} ms, and computing took {np.median(spent):.1f} ms a frame ({spent.max():.1f} at most)"
    )
    _print_retargeted(console, figures, command.out)


def _print_retargeted(console: Console, figures: dict[str, Any], out: Path) -> None:
    """What came of a clip."""
    joints, feet, tracking = figures["joints"], figures["feet"], figures["tracking"]
    console.print(
        f"segments {tracking['segment_angle_deg_mean']:.1f} deg off, slip {feet['slip_mm_max']:.2f} mm, soles "
        f"{feet['float_mm_max']:.2f} mm above and {feet['below_floor_mm_max']:.2f} mm below the floor at most, "
        f"acceleration {joints['acceleration_max']:.0f} rad/s^2 at most"
    )
    console.print(f"written to {out}: {', '.join(sorted(os.listdir(out)))}")


def _robot_to_retarget(source: str) -> Robot:
    """A robot by name or file, its base floating; ``g1`` is that of example-robot-data."""
    if source == "g1" and not os.path.exists(source):
        from .retargeting._g1 import g1_urdf

        source = str(g1_urdf())
    return read_robot(source, "auto" if source in _EMBEDDED else "floating")


def _number_or_name(text: str) -> str | float:
    try:
        return float(text)
    except ValueError:
        return text


def _mapping(pairs: Sequence[str]) -> dict[str, str] | None:
    """ROLE=NAME as a mapping; None where there are none."""
    wrong = [pair for pair in pairs if "=" not in pair]
    if wrong:
        raise OsikValueError(f"--mapping takes ROLE=NAME; got {', '.join(wrong)}")
    return {role: name for role, _, name in (pair.partition("=") for pair in pairs)} or None


def _motion(command: Demo) -> Motion:
    """The motion that the options ask for."""
    from . import demo
    from .viewer.live._source import RobotSource, source_look

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
                look=source_look(RobotSource(command.robot)),
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


def _view(command: View) -> None:
    """Serves a page until Ctrl-C, which is how a view ends."""
    from .viewer.live import _open

    with _told():
        if command.html is not None and (
            command.file is None or command.file.suffix == ".json" or _open.is_map(command.file)
        ):
            raise CommandError("--html goes with a motion.npz")
        _open.check(command.host, 0 if command.html is not None else command.port)
        source = _open.source_of(command.robot, {"auto": None, "floating": True, "fixed": False}[command.base])
        if command.file is not None and command.file.suffix == ".json":
            view = _open.open_session(command.file, host=command.host, port=command.port)
        else:
            robot = read_robot(source.robot, command.base)
            options: Any = dict(host=command.host, port=command.port)
            if command.file is not None and command.html is not None:
                _open.write_motion(command.file, robot, source, command.html)
                print(f"written: {command.html}")
                return
            if command.file is not None:
                opened = _open.open_map if _open.is_map(command.file) else _open.open_motion
                view = opened(command.file, robot, source, **options)
            else:
                feet = command.support or _feet(robot)
                view = _open.open_robot(robot, source, feet, **options)
    print(f"osik view: {view.url} (Ctrl-C ends it)", flush=True)
    if command.browser:
        webbrowser.open(view.url)
    with suppress(KeyboardInterrupt):
        view.wait()
    view.stop()


def _feet(robot: Robot) -> tuple[str, ...]:
    """Frames on the ground, of a robot that moves freely."""
    from .demo import guess_feet

    return guess_feet(robot) if robot.floating_base else ()


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    """Tells in one line that a file could not be written, as on a full disk."""
    try:
        yield
    except OSError as error:
        raise CommandError(f"cannot write to {folder}: {error.strerror or error}; it may be incomplete") from error


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
