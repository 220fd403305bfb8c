"""URDF and MJCF files that are right but for one thing."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path
from typing import Any

import osik_jax as osik


@functools.cache
def folder() -> Path:
    """A folder for the files of some cases."""
    return Path(tempfile.mkdtemp())


INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
LIMIT = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'
MESH_IN_MJCF = (
    '<asset><mesh name="m" file="nope.stl"/></asset><worldbody><body name="b"><joint/>'
    '<geom type="mesh" mesh="m"/></body></worldbody>'
)
JOINT_IN_MJCF = '<worldbody><body><joint/><geom size="1"/></body></worldbody>'


def link(name: str, inner: str = INERTIAL) -> str:
    return f'<link name="{name}">{inner}</link>'


def joint(name: str, parent: str, child: str, *, inner: str = LIMIT, kind: str = "revolute") -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    axis = "" if "<axis" in inner else '<axis xyz="0 0 1"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{axis}{inner}</joint>'


def urdf(*parts: str, **options: Any) -> osik.Robot:
    text = f'<robot name="x">{"".join(parts)}</robot>'
    return osik.Robot.from_urdf(text, **{"floating_base": False, **options})


def one_joint(**changes: Any) -> osik.Robot:
    return urdf(link("a"), link("b"), joint("j", "a", "b", **changes))


def two_joints(**options: Any) -> osik.Robot:
    return urdf(link("a"), link("b"), link("c"), joint("j1", "a", "b"), joint("j2", "b", "c"), **options)


def mimics(*pairs: str) -> osik.Robot:
    """Joints j1, j2, ... in a row, each with a mimic element, or none."""
    links = [link(f"l{k}") for k in range(len(pairs) + 1)]
    return urdf(*links, *(joint(f"j{k + 1}", f"l{k}", f"l{k + 1}", inner=LIMIT + own) for k, own in enumerate(pairs)))


def mjcf(inner: str, **options: Any) -> osik.Robot:
    return osik.Robot.from_mjcf(f"<mujoco>{inner}</mujoco>", **options)


def bomb(root: str) -> str:
    """Entities that grow to gigabytes."""
    entities = '<!ENTITY e0 "lol">' + "".join(f'<!ENTITY e{k + 1} "{f"&e{k};" * 10}">' for k in range(9))
    return f'<!DOCTYPE x [{entities}]><{root}><a name="&e9;"/></{root}>'


def with_secret() -> osik.Robot:
    """An entity that would read a file."""
    (folder() / "secret.txt").write_text("secret")
    head = f'<!DOCTYPE r [<!ENTITY x SYSTEM "file://{folder()}/secret.txt">]>'
    return osik.Robot.from_urdf(f'{head}<robot name="r">{link("a")}{link("&x;")}</robot>')


def includes_itself() -> osik.Robot:
    path = folder() / "self.xml"
    path.write_text(f'<mujoco><include file="self.xml"/>{JOINT_IN_MJCF}</mujoco>')
    return osik.Robot.from_mjcf(path)


MESH = INERTIAL + '<collision><geometry><mesh filename="package://zz/a.stl"/></geometry></collision>'
