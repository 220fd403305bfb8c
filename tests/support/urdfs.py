"""Parts of URDFs, for tests that write a robot of their own."""

from __future__ import annotations

import re

INERTIAL = (
    '<inertial><origin xyz="0.01 0.02 0.03"/><mass value="1.5"/>'
    '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>'
)
LIMIT = '<limit lower="-1" upper="2" velocity="3" effort="1"/>'
ORIGIN = 'xyz="0.1 0 0.2" rpy="0.1 0.2 0.3"'


def link(name: str, inner: str = INERTIAL) -> str:
    return f'<link name="{name}">{inner}</link>'


def joint(
    name: str, parent: str, child: str, inner: str = "", kind: str = "revolute", *, origin=ORIGIN, axis="0 0 1"
) -> str:
    """A joint with ``LIMIT``, unless ``inner`` has another one."""
    limit = LIMIT if "<limit" not in inner and kind != "fixed" else ""
    return (
        f'<joint name="{name}" type="{kind}"><origin {origin}/><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="{axis}"/>{limit}{inner}</joint>'
    )


def urdf(*elements: str) -> str:
    return f'<?xml version="1.0"?>\n<robot name="r">{"".join(elements)}</robot>'


def tree(*joints: str) -> str:
    """A robot of these joints and of the links that they name, each with ``INERTIAL``."""
    names = dict.fromkeys(re.findall(r'<(?:parent|child) link="([^"]+)"', "".join(joints)))
    return urdf(*map(link, names), *joints)
