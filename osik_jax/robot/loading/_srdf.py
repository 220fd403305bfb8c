"""Reader of SRDF files: pairs of links that may touch, groups of joints and links, and named states."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

from ..._errors import OsikValueError
from ._source import check_root, parse_xml, read_source
from ._urdf_elements import finite_numbers


class Srdf(NamedTuple):
    """Contents of an SRDF file.

    Attributes:
        disabled: pairs of links that may touch, each in alphabetical order.
        untested: links all of whose pairs may touch, but for those of ``enabled``.
        enabled: pairs of links that are kept apart although one of them is in ``untested``.
        groups: names of the joints, links, chains (``"base to tip"``) and subgroups of each group.
        states: value [rad or m] of each joint in each named state; states of one name in several groups are one state.
    """

    disabled: frozenset[tuple[str, str]]
    untested: frozenset[str]
    enabled: frozenset[tuple[str, str]]
    groups: Mapping[str, tuple[str, ...]]
    states: Mapping[str, Mapping[str, float]]

    @property
    def links(self) -> set[str]:
        """Return the links that are named in pairs."""
        return {*self.untested, *(link for pair in (*self.disabled, *self.enabled) for link in pair)}

    def allows(self, first: str, second: str) -> bool:
        """Return whether two links may touch."""
        pair = _pair(first, second)
        return pair in self.disabled or (bool({*pair} & self.untested) and pair not in self.enabled)


def read_srdf(given: str | os.PathLike[str]) -> Srdf:
    """Return the contents of an SRDF, given as a path or as text.

    Raises:
        FileNotFoundError: no such file.
        TypeError: neither a path nor text.
        ValueError: the XML is broken, is no SRDF, or lacks an attribute.
    """
    source = read_source(given, "SRDF")
    root = parse_xml(source)
    check_root(root, "robot", source)
    try:
        return Srdf(
            disabled=_pairs(root, "disable_collisions"),
            untested=frozenset(_attribute(e, "link") for e in root.findall("disable_default_collisions")),
            enabled=_pairs(root, "enable_collisions"),
            groups={_attribute(group, "name"): _members(group) for group in root.findall("group")},
            states=_states(root),
        )
    except ValueError as error:
        raise OsikValueError(f"{source.label}: {error}") from None


@cache
def srdf_beside(urdf: Path | None) -> Path:
    """Return the SRDF of a URDF file, in its folder or in ``srdf`` beside that; its name begins like the URDF's.

    ``ur5.srdf`` is that of ``ur5_robot.urdf``, and ``baxter_manipulation.srdf`` that of ``baxter.urdf``.
    """
    if urdf is None:
        raise FileNotFoundError("srdf=True needs a robot read from a URDF file; give the path of the SRDF, or its text")
    folders = (urdf.parent, urdf.parent / "srdf", urdf.parent.parent / "srdf")
    there = sorted({path for folder in folders for path in folder.glob("*.srdf")})
    words = urdf.stem.split("_")
    for fits in (lambda own: own == words, lambda own: own[: len(words)] == words[: len(own)]):
        found = [path for path in there if fits(path.stem.split("_"))]
        if len(found) == 1:
            return found[0]
    raise FileNotFoundError(
        f"not one SRDF beside {str(urdf)!r} has its name; give srdf=PATH. SRDFs there: "
        f"{', '.join(map(str, there)) or '(none)'}"
    )


def _pair(first: str, second: str) -> tuple[str, str]:
    return min(first, second), max(first, second)


def _pairs(root: ElementTree.Element, kind: str) -> frozenset[tuple[str, str]]:
    return frozenset(_pair(_attribute(e, "link1"), _attribute(e, "link2")) for e in root.findall(kind))


def _members(group: ElementTree.Element) -> tuple[str, ...]:
    names = []
    for part in group:
        if part.tag == "chain":
            names.append(f"{_attribute(part, 'base_link')} to {_attribute(part, 'tip_link')}")
        elif part.tag in ("joint", "link", "group"):
            names.append(_attribute(part, "name"))
    return tuple(names)


def _states(root: ElementTree.Element) -> dict[str, dict[str, float]]:
    """Return the named states; joints with several values (bases) are passed over."""
    states: dict[str, dict[str, float]] = {}
    for element in root.findall("group_state"):
        state = states.setdefault(_attribute(element, "name"), {})
        for joint in element.findall("joint"):
            name, value = _attribute(joint, "name"), _attribute(joint, "value")
            if len(value.split()) == 1:
                state[name] = float(finite_numbers(value, 1, f"joint {name!r}, value")[0])
    return states


def _attribute(element: ElementTree.Element, name: str) -> str:
    value = element.get(name)
    if value is None:
        raise OsikValueError(f"a <{element.tag}> lacks the attribute {name!r}")
    return value
