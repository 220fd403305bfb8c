"""Files, and what is read with them."""

# pyright: reportArgumentType=false
from __future__ import annotations

import numpy as np

import osik_jax as osik

from ._given import Add, F, K, T, V, arm
from ._models import (
    JOINT_IN_MJCF,
    LIMIT,
    MESH_IN_MJCF,
    bomb,
    folder,
    includes_itself,
    joint,
    link,
    mimics,
    mjcf,
    one_joint,
    two_joints,
    urdf,
    with_secret,
)


def files(add: Add) -> None:
    read, load = osik.Robot.from_urdf, osik.load_robot
    add("no such file", lambda: read(folder() / "gone" / "x.urdf"), F, "gone")
    add("a folder", lambda: read(folder()), F, ".urdf files")
    add("from_urdf(None)", lambda: read(None), T, "path")
    add("an MJCF for a URDF", lambda: read("<mujoco/>"), V, "Robot.from_mjcf")
    add("a URDF for an MJCF", lambda: osik.Robot.from_mjcf("<robot/>"), V, "Robot.from_urdf")
    add("a path for a model", lambda: osik.Robot.from_mjmodel("robot.xml"), T, "from_mjcf")
    add("an empty text", lambda: read(""), V, "empty")
    add("broken XML", lambda: read("<robot><link name='a'>"), V, "line 1, column 23", foreign=True)
    add("a xacro", lambda: read('<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:arm/></robot>'), V, "run xacro")
    add("masses of 0, and their centre", lambda: osik.ComTask(arm().scaled(mass=0.0)), V, "has no mass")
    add("a list for values by joint", lambda: arm().configuration([0.0] * 7), T, "maps names of joints to values")
    add("a NaN for a joint's value", lambda: arm().configuration({"joint1": np.nan}), V, "'joint1' is nan")
    add("a text for a joint's value", lambda: arm().configuration({"joint1": "x"}), T, "'joint1' is 'x'")
    add(
        "a negative mass",
        lambda: urdf(link("a"), link("b", '<inertial><mass value="-1"/></inertial>'), joint("j", "a", "b")),
        V,
        "'b'",
    )
    add(
        "a link with two parents",
        lambda: urdf(*map(link, "abc"), joint("j1", "a", "b"), joint("j2", "a", "c"), joint("j3", "b", "c")),
        V,
        "'j2' and 'j3'",
    )
    add("a loop", lambda: urdf(link("a"), link("b"), joint("j1", "a", "b"), joint("j2", "b", "a")), V, "loop")
    add(
        "a link that is its own parent",
        lambda: urdf(link("a"), link("b"), joint("j1", "a", "b"), joint("j2", "b", "b")),
        V,
        "'j1' and 'j2'",
    )
    add("two roots", lambda: urdf(*map(link, "abcd"), joint("j1", "a", "b"), joint("j2", "c", "d")), V, "a, c")
    add("a parent that does not exist", lambda: urdf(link("a"), link("b"), joint("j1", "zz", "b")), V, "links: a, b")
    add("two joints of one name", lambda: urdf(*map(link, "abc"), joint("j", "a", "b"), joint("j", "b", "c")), V, "'j'")
    add("two links of one name", lambda: urdf(link("a"), link("a"), joint("j", "a", "a")), V, "'a'")
    add("a type that does not exist", lambda: one_joint(kind="hinge"), V, "revolute, continuous")
    add("a planar joint", lambda: one_joint(kind="planar"), V, "two prismatic joints")
    add(
        "joints that mimic each other",
        lambda: mimics('<mimic joint="j2"/>', '<mimic joint="j1"/>'),
        V,
        "j1 -> j2 -> j1",
    )
    add("a joint that mimics itself", lambda: mimics('<mimic joint="j1"/>'), V, "j1 -> j1")
    add("a joint that mimics nothing", lambda: mimics('<mimic joint="zz"/>'), V, "joints: j1")
    add("limits, lower above upper", lambda: one_joint(inner='<limit lower="1" upper="-1"/>'), V, "lower 1.0 > upper")
    add("a limit that is NaN", lambda: one_joint(inner='<limit lower="nan" upper="1"/>'), V, "'nan'")
    add("a limit that is text", lambda: one_joint(inner='<limit lower="${-pi}" upper="1"/>'), V, "${-pi}")
    add(
        "a negative velocity limit",
        lambda: one_joint(inner='<limit lower="-1" upper="1" velocity="-1"/>'),
        V,
        "negative",
    )
    add("an axis of zeros", lambda: one_joint(inner='<axis xyz="0 0 0"/>' + LIMIT), V, "axis is zero")
    add("no joint", lambda: urdf(link("a")), V, "no joint")
    add("fixed joints alone", lambda: one_joint(kind="fixed", inner=""), V, "no joint")
    add("all joints locked", lambda: two_joints(locked_joints=("*",)), V, "j1, j2, all locked")
    add("a lock on a joint that does not exist", lambda: two_joints(locked_joints=("zz",)), K, "j1, j2")
    add("a lock at NaN", lambda: two_joints(locked_joints={"j1": np.nan}), V, "'j1'")
    add("a speed for a joint that does not exist", lambda: two_joints(velocity_limits={"zz": 1.0}), K, "j1, j2")
    add("a speed of 0", lambda: two_joints(velocity_limits={"j1": 0.0}), V, "positive")
    add("a range for a joint that does not exist", lambda: two_joints(position_limits={"zz": (0, 1)}), K, "j1, j2")
    add("a range with lower above upper", lambda: two_joints(position_limits={"j1": (1, -1)}), V, "'j1'")
    add("a home of the wrong length", lambda: two_joints(home=np.zeros(3)), V, "(2,)")
    add("a home in degrees", lambda: two_joints(home={"j1": 30.0}), osik.OsikWarning, "[-1, 1]")
    add("a home for a joint that does not exist", lambda: two_joints(home={"zz": 0.0}), K, "j1, j2")
    add("a body replaced that is a frame", lambda: arm().replace(body_mass={"hand": 1.0}), K, "frame fixed to the body")
    add("a field replaced that does not exist", lambda: arm().replace(length=1.0), K, "no field 'length'")
    add("a keyframe that does not exist", lambda: arm().with_home("stand"), K, "keyframe")
    add("XML entities without end, URDF", lambda: read(bomb("robot")), V, "broken XML at line 1", foreign=True)
    add(
        "XML entities without end, MJCF",
        lambda: osik.Robot.from_mjcf(bomb("mujoco")),
        V,
        "broken XML at line 1",
        foreign=True,
    )
    add("an entity that reads a file", with_secret, V, "broken XML at line 1", foreign=True)
    add(
        "an include that is not there",
        lambda: mjcf(f'<include file="nope.xml"/>{JOINT_IN_MJCF}'),
        V,
        "nope.xml",
        foreign=True,
    )
    add(
        "an include of a file that is no MJCF",
        lambda: mjcf(f'<include file="/etc/passwd"/>{JOINT_IN_MJCF}'),
        V,
        "XML",
        foreign=True,
    )
    add("a file that includes itself", includes_itself, V, "self.xml", foreign=True)
    add("an MJCF without joints", lambda: mjcf('<worldbody><body><geom size="1"/></body></worldbody>'), V, "no joint")
    add(
        "a mass from a mesh that is not there",
        lambda: mjcf(MESH_IN_MJCF),
        V,
        "<inertial>",
        foreign=True,
    )
    add("a misspelt robot", lambda: load("neo"), K, "'nao'")
    add("load_robot(3)", lambda: load(3), T, "nao")
