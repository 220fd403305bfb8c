"""XML from a path or as text: found, read and parsed, with errors that name the source."""

from __future__ import annotations

import difflib
import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from ..._errors import OsikTypeError, OsikValueError

_ROOTS = {"robot": "a URDF: use Robot.from_urdf", "mujoco": "an MJCF: use Robot.from_mjcf", "sdf": "an SDF"}


def is_mjcf(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is in MuJoCo's format, by its content."""
    text = Path(path).read_text(encoding="utf-8", errors="replace")
    return "<mujoco" in text and "<robot" not in text.split("<mujoco")[0]


class Source(NamedTuple):
    """XML before it is parsed."""

    label: str  # what error messages call it: the file's path, or "the XML text"
    content: str | bytes  # the XML
    path: Path | None  # of the file, None where the text itself was given


def read_source(given: str | os.PathLike[str], kind: str) -> Source:
    """Read a file, or take the text itself (anything that starts with ``<``)."""
    if not isinstance(given, str | os.PathLike):
        raise OsikTypeError(f"{given!r} is no {kind}: give a path, or the XML text itself")
    if not str(given).strip():
        raise OsikValueError(f"the {kind} is an empty text: give a path, or the XML text itself")
    if isinstance(given, str) and given.lstrip("\ufeff \t\r\n").startswith("<"):
        return Source("the XML text", given.lstrip("\ufeff \t\r\n"), None)
    path = Path(given)
    if not os.path.isfile(path):
        raise FileNotFoundError(_missing(path, kind))
    return Source(str(path), path.read_bytes(), path)


def parse_xml(source: Source) -> ElementTree.Element:
    """Return the root element of XML that may break three rules, as robot files often do.

    Comments may hold ``--``, an ``&`` may stand alone, and prefixes of names (``drake:``) may be undeclared.
    """
    try:
        return ElementTree.fromstring(_edited(source.content, _well_formed))
    except ElementTree.ParseError as error:
        line, column = error.position
        reason = str(error).partition(":")[0]
        raise OsikValueError(f"{source.label}: broken XML at line {line}, column {column + 1}: {reason}") from None


def check_root(root: ElementTree.Element, expected: str, source: Source) -> None:
    """Raise ValueError unless the root element is ``expected`` ("robot" or "mujoco")."""
    if root.tag != expected:
        what = _ROOTS.get(root.tag, "not a robot description that can be read here")
        raise OsikValueError(f"{source.label}: the root element is <{root.tag}>, not <{expected}>: this is {what}")


def _edited(content: str | bytes, edit: Callable[[str], str]) -> str | bytes:
    """Return text or the bytes of a file, edited as text of one byte a character."""
    if isinstance(content, bytes):  # latin-1 maps every byte to one character and back
        return edit(content.decode("latin-1")).encode("latin-1")
    return edit(content)


def _well_formed(text: str) -> str:
    """Return the text without comments (line breaks stay), with ampersands escaped and prefixes declared."""
    text = re.sub("<!--.*?-->", lambda comment: "\n" * comment.group().count("\n"), text, flags=re.DOTALL)
    text = re.sub(r"&(?!#?\w+;)", "&amp;", text)
    used = {prefix for prefix in re.findall(r"<(\w+):\w", text)} | set(re.findall(r"\s(\w+):\w+\s*=", text))
    lacking = sorted(prefix for prefix in used - {"xml", "xmlns"} if f"xmlns:{prefix}" not in text)
    declared = "".join(f' xmlns:{prefix}="{prefix}"' for prefix in lacking)
    return re.sub(r"<\w+", lambda root: root.group() + declared, text, count=1)


def _missing(path: Path, kind: str) -> str:
    if not os.path.isdir(path.parent):
        return f"no {kind} file {str(path)!r}: the folder {str(path.parent)!r} does not exist"
    folder = path if os.path.isdir(path) else path.parent
    suffix = path.suffix or f".{'urdf' if kind == 'URDF' else 'xml'}"
    there = sorted(entry.name for entry in folder.iterdir() if entry.suffix == suffix)
    close = difflib.get_close_matches(path.name, there, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else "."
    return f"no {kind} file {str(path)!r}{hint} {suffix} files in {str(folder)!r}: {', '.join(there) or '(none)'}"
