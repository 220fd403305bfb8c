"""Robots of the package robot_descriptions, which clones their repositories at first use."""

from __future__ import annotations

import difflib
import importlib
import os
from collections.abc import Iterable
from types import ModuleType

from ..._errors import OsikKeyError, OsikValueError, missing_extra, unknown_name
from .._model import RobotModel
from ._embedded import NAMES
from ._mjcf import from_mjcf
from ._options import LoadOptions
from ._urdf import from_urdf

SUFFIX = "_description"
_NEAREST = 8


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


def urdf_of_description(name: str) -> tuple[str, list[str]] | None:
    """Return the file of a robot that comes as URDF, and the folders of its packages; ``None``: it comes otherwise."""
    module = importlib.import_module(f"robot_descriptions.{name}")
    if hasattr(module, "MJCF_PATH") or not hasattr(module, "URDF_PATH"):
        return None
    return module.URDF_PATH, _package_dirs(module)


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
