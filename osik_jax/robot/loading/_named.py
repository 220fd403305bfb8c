"""Robots by name: those of this package, of example-robot-data and of robot_descriptions."""

from __future__ import annotations

import difflib
import importlib
import os
import sys
from collections.abc import Iterable
from importlib import resources
from pathlib import Path
from types import ModuleType

from ..._errors import OsikKeyError, OsikValueError, missing_extra, unknown_name
from .._model import RobotModel
from ._mjcf import from_mjcf
from ._options import LoadOptions
from ._urdf import from_urdf

ELSEWHERE = {"g1": "g1_mj_description", "talos": "talos_description"}
"""The same robots in robot_descriptions, taken where example-robot-data is not installed."""
ROBOTS = ("nao", "arm7")
EXAMPLES = {
    "g1": ("g1_description/urdf/g1_29dof_rev_1_0.urdf", True),
    "talos": ("talos_data/robots/talos_full_v2.urdf", True),
    "go2": ("go2_description/urdf/go2.urdf", True),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", False),
    "panda": ("panda_description/urdf/panda.urdf", False),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", False),
    "so101": ("so_arm_description/urdf/so101.urdf", False),
    "baxter": ("baxter_description/urdf/baxter.urdf", False),
    "tiago": ("tiago_description/robots/tiago.urdf", False),
    "allegro": ("allegro_hand_description/urdf/allegro_right_hand.urdf", False),
}
"""Robots of the package example-robot-data: the URDF's path below its ``robots``, and whether the base floats."""
NAMES = (*ROBOTS, *EXAMPLES)
"""Names that ``load_robot`` and every command take, beside those of robot_descriptions."""
SUFFIX = "_description"
_NEAREST = 8


def example_urdf(name: str) -> Path:
    """Return the URDF of one of ``EXAMPLES``; raise FileNotFoundError if example-robot-data is not installed."""
    if name not in EXAMPLES:
        raise unknown_name("robot", name, tuple(EXAMPLES))
    for folder in sys.path:
        for share in ("cmeel.prefix/share", "share"):
            found = Path(folder) / share / "example-robot-data" / "robots" / EXAMPLES[name][0]
            if found.is_file():
                return found
    raise FileNotFoundError(
        f"the URDF of {name} comes with example-robot-data (pip install example-robot-data), which is not installed; "
        "or give the path of a URDF of yours"
    )


def named(name: str, options: LoadOptions) -> RobotModel:
    """Return names and numbers of a robot by its name.

    One of ``EXAMPLES`` raises FileNotFoundError if neither example-robot-data nor robot_descriptions is installed.
    """
    if name in ROBOTS:
        model = resources.files("osik_jax") / "robot" / "models" / f"{name}.xml"
        return from_mjcf(model.read_text(encoding="utf-8"), options)
    if name not in EXAMPLES:
        return described(name, options)
    try:
        if options.floating_base is None:
            options = options._replace(floating_base=EXAMPLES[name][1])
        return from_urdf(example_urdf(name), options)
    except FileNotFoundError as missing:
        if name not in ELSEWHERE:
            raise
        try:
            return described(ELSEWHERE[name], options)
        except ImportError:
            raise missing from None


def described(name: str, options: LoadOptions) -> RobotModel:
    """Return names and numbers of a robot that ``robot_descriptions`` knows.

    A URDF looks for its meshes in its own packages instead of ``options.package_dirs``.
    """
    known = _known(name)
    if name not in known:
        raise _unknown(name, known)
    module = importlib.import_module(f"robot_descriptions.{name}")
    if hasattr(module, "MJCF_PATH"):
        return from_mjcf(module.MJCF_PATH, options)
    if hasattr(module, "URDF_PATH"):
        return from_urdf(module.URDF_PATH, options._replace(package_dirs=_package_dirs(module)))
    xacro = getattr(module, "XACRO_PATH", None)
    if xacro is None:
        raise OsikValueError(f"robot {name!r} comes neither as MJCF nor as URDF")
    raise OsikValueError(f"robot {name!r} comes as xacro: run xacro on {xacro!r} and load what it writes")


def _known(name: str) -> tuple[str, ...]:
    """Return the robots that the package lists; empty without the package, unless a full name is given."""
    try:
        package = importlib.import_module("robot_descriptions")
    except ImportError as missing:
        if name.endswith(SUFFIX):
            raise missing_extra(f"robot {name!r}", "robot_descriptions", "descriptions") from missing
        raise unknown_name("robot", name, NAMES) from None
    return tuple(package.DESCRIPTIONS)


def _unknown(name: str, known: Iterable[str]) -> KeyError:
    """Return the error for an unknown name; it lists the short names and similar ones, because hundreds are known."""
    available = (*NAMES, *known)
    close = difflib.get_close_matches(name, available, n=_NEAREST)
    short = name.removesuffix(SUFFIX)
    close += [other for other in available if short and short in other and other not in close]
    hint = f"; did you mean {', '.join(map(repr, close[:_NEAREST]))}?" if close else "."
    return OsikKeyError(f"no robot {name!r}{hint} robots: {', '.join(NAMES)}, and robot_descriptions.DESCRIPTIONS")


def _package_dirs(module: ModuleType) -> list[str]:
    """Return the folders that the description's ``package://`` addresses may refer to."""
    roots = [getattr(module, name) for name in ("PACKAGE_PATH", "REPOSITORY_PATH") if hasattr(module, name)]
    return [*roots, *map(os.path.dirname, roots)]
