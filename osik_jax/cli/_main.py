"""The command line: ``osik demo``, ``ik``, ``follow``, ``reach``, ``calibrate``, ``retarget``, ``view`` and so on."""

from __future__ import annotations

import importlib.metadata
import os
import sys
from collections.abc import Sequence
from typing import Any

import tyro

from ._calibrate import Calibrate
from ._demo import Demo
from ._follow import Follow
from ._ik import Ik
from ._info import Info
from ._messages import CommandError, notes
from ._place import Place
from ._reach import Reach
from ._retarget import Retarget
from ._ros2 import Ros2
from ._view import View

_DESCRIPTION = "Operational-space inverse kinematics for redundant robots, in JAX. osik --version prints the version."
_COMMANDS = {
    "demo": Demo,
    "ik": Ik,
    "follow": Follow,
    "reach": Reach,
    "calibrate": Calibrate,
    "place": Place,
    "retarget": Retarget,
    "ros2": Ros2,
    "view": View,
    "info": Info,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code.

    0, or 1 where ``osik ik`` finds nothing or a clip of a folder failed, or 2 after what the user can set right (told
    on stderr in one line), or 130 where it was interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments == ["--version"]:
        print(f"osik-jax {importlib.metadata.version('osik-jax')}")
        return 0
    command = tyro.extras.subcommand_cli_from_dict(
        _COMMANDS, prog="osik", description=_DESCRIPTION, args=arguments or ["--help"]
    )
    try:
        with notes():
            return _run(command)
    except CommandError as error:
        print(f"osik: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"osik: interrupted{_left_behind(command)}", file=sys.stderr)
        return 130


def _run(command: Any) -> int:
    """Run a command in double precision; return the exit code."""
    import jax

    from ..runtime import configure_cpu

    configure_cpu()
    jax.config.update("jax_enable_x64", True)
    return command.run()


def _left_behind(command: Any) -> str:
    """Return a remark where an interrupted command has written something."""
    if isinstance(command, Reach) and command.unfinished.is_dir():
        return f"; the same command goes on where it was ({command.unfinished})"
    if isinstance(command, Retarget) and os.path.isdir(command.clip) and command.out.is_dir():
        return f"; the same command goes on where it was ({command.out})"
    if not isinstance(command, Demo | Retarget) or not command.out.is_dir() or not os.listdir(command.out):
        return ""
    return f"; what is in {command.out} may be incomplete"
