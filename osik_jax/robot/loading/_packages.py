"""Files that a robot description points at: ``package://`` and ``file://`` addresses, and plain paths."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from urllib.parse import unquote

from ..._errors import OsikTypeError

_PACKAGE_SCHEMES = ("package://", "model://")
_FILE_SCHEME = "file://"


def is_uri(given: object) -> bool:
    """Return whether this is an address that ``Packages.path`` reads, and neither a plain path nor XML."""
    return isinstance(given, str) and given.startswith((*_PACKAGE_SCHEMES, _FILE_SCHEME))


class Packages:
    """Folders of ROS packages: those given, then those of ``ROS_PACKAGE_PATH`` and ``AMENT_PREFIX_PATH``.

    A folder is either a package itself, by its own name, or holds packages. An address is taken as it is, then with
    ``%20`` and the like decoded, then with its backslashes as slashes.
    """

    def __init__(self, folders: Iterable[str | os.PathLike[str]] = ()) -> None:
        if isinstance(folders, str):
            raise OsikTypeError(f"package_dirs is a sequence of folders, not one string: use ({folders!r},)")
        self.folders = tuple(Path(folder) for folder in folders)

    def path(self, address: object, *, beside: Path | None = None) -> Path:
        """Return the file of an address: ``package://NAME/...``, ``model://NAME/...``, ``file://...``, or a path.

        Plain paths are relative to the folder of ``beside``, the file that names them. Any folder above it that is
        called ``NAME`` is taken for the package, last of all.
        """
        text = str(address)
        spellings = dict.fromkeys([text, unquote(text), unquote(text).replace("\\", "/")])
        tried = list(dict.fromkeys(path for spelling in spellings for path in self._candidates(spelling, beside)))
        for path in tried:
            if path.is_file():
                return path
        hint = "; name the folder of the package in package_dirs" if text.startswith(_PACKAGE_SCHEMES) else ""
        raise FileNotFoundError(f"no file {text!r}{hint}. Looked for: {', '.join(map(str, tried)) or '(nowhere)'}")

    def _candidates(self, text: str, beside: Path | None) -> Iterator[Path]:
        if text.startswith(_FILE_SCHEME):
            yield Path(text.removeprefix(_FILE_SCHEME))
        elif text.startswith(_PACKAGE_SCHEMES):
            package, _, rest = text.partition("://")[2].lstrip("/").partition("/")  # some write three slashes
            for folder in (*self.folders, *_environment()):
                yield folder / package / rest
                if folder.name == package:
                    yield folder / rest
            for folder in () if beside is None else beside.absolute().parents:
                if folder.name == package:
                    yield folder / rest
        else:
            yield (Path() if beside is None else beside.parent) / text


def _environment() -> Iterator[Path]:
    """Yield the folders in which ROS 1 and ROS 2 look for packages."""
    for folder in filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)):
        yield Path(folder)
    for folder in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        yield Path(folder) / "share"
