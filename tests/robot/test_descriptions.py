"""Robots by name from a package with the interface of robot_descriptions: nothing here clones or downloads."""

from __future__ import annotations

import importlib
import importlib.metadata
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from refusals import refuses

import osik_jax as osik
from osik_jax.cli import CommandError, read_robot

MODULES = {
    "toy_mj_description": 'MJCF_PATH = os.path.join(PACKAGE_PATH, "toy.xml")',
    "toy_description": 'URDF_PATH = os.path.join(PACKAGE_PATH, "urdf", "toy.urdf")',
    "solo12_description": 'URDF_PATH = os.environ["SOLO12"]',
    "ur10e_description": 'XACRO_PATH = os.path.join(PACKAGE_PATH, "ur.urdf.xacro")\nXACRO_ARGS = {"name": "ur10e"}',
    "srdf_description": 'SRDF_PATH = os.path.join(PACKAGE_PATH, "toy.srdf")',
}
MJCF = """
<mujoco><worldbody><body name="base"><freejoint name="root"/><geom size="0.1"/>
  <body name="arm"><joint name="elbow" range="-1 1"/><geom size="0.1"/></body></body></worldbody></mujoco>"""
URDF = """
<robot name="toy"><link name="base"/><link name="arm"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/>
  </inertial></link><joint name="elbow" type="revolute"><parent link="base"/><child link="arm"/>
  <limit lower="-1" upper="1" velocity="2" effort="1"/></joint></robot>"""


@pytest.fixture(autouse=True)
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A package called robot_descriptions, its modules written as those of release 3.3 are."""
    repository = tmp_path / "cache" / "toys"
    (repository / "toy" / "urdf").mkdir(parents=True)
    (repository / "toy" / "toy.xml").write_text(MJCF)
    (repository / "toy" / "urdf" / "toy.urdf").write_text(URDF)
    folder = tmp_path / "site" / "robot_descriptions"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text(f"DESCRIPTIONS = {dict.fromkeys(MODULES)}\n")
    for name, line in MODULES.items():
        paths = (
            f'import os\nREPOSITORY_PATH = {str(repository)!r}\nPACKAGE_PATH = os.path.join(REPOSITORY_PATH, "toy")\n'
        )
        (folder / f"{name}.py").write_text(f"{paths}{line}\n")
    (solo,) = (f for f in importlib.metadata.files("example-robot-data") or [] if f.name == "solo12.urdf")
    monkeypatch.setenv("SOLO12", str(solo.locate()))
    monkeypatch.syspath_prepend(folder.parent)
    _forget()
    yield
    _forget()


def _forget() -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "robot_descriptions"]:
        del sys.modules[name]
    importlib.invalidate_caches()


def test_mjcf_and_urdf_by_name():
    mjcf = osik.load_robot("toy_mj_description", velocity_limits={"elbow": 3.0})
    assert (mjcf.tree.joint_names, mjcf.velocity_limit.tolist()) == (("root", "elbow"), [np.inf] * 6 + [3.0])
    urdf = osik.load_robot("toy_description", floating_base=False)
    assert (urdf.joint_names, urdf.velocity_limit.tolist()) == (("elbow",), [2.0])
    locked = osik.load_robot("toy_mj_description", locked_joints={"elbow": 0.5}, floating_base=None)
    assert (locked.nv, locked.locked_joints) == (6, ("elbow",))


def test_a_real_urdf_by_name():
    """That of example-robot-data, which robot_descriptions clones."""
    robot = osik.load_robot("solo12_description")
    assert (robot.nv, robot.floating_base) == (18, True)
    assert {"FL_FOOT", "HR_FOOT"} <= set(robot.frame_names)


def test_options_reach_embedded_robots_too():
    arm = osik.load_robot("arm7", floating_base=True, velocity_limits={"*": 1.0}, locked_joints=("joint7",))
    assert (arm.nv, arm.locked_joints) == (12, ("joint7",))
    np.testing.assert_array_equal(arm.velocity_limit[6:], 1.0)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("toy_mj_descriptoin", r"no robot 'toy_mj_descriptoin'; did you mean 'toy_mj_description', 'toy_description'"),
        ("solo12", r"no robot 'solo12'; did you mean 'solo12_description'\? robots: nao, .*allegro, and robot_desc"),
        ("solo_description", r"did you mean .*'solo12_description'"),
        ("qqq", r"no robot 'qqq'\. robots: nao, arm7, g1, talos, .*allegro, and robot_descriptions.DESCRIPTIONS"),
    ],
)
def test_a_mistyped_name_gets_those_near_it(name: str, message: str):
    refuses(KeyError, message, osik.load_robot, name)


def test_what_cannot_be_read_says_what_to_do():
    with pytest.raises(ValueError, match=r"'ur10e_description' comes as xacro: run xacro on '.*toy/ur.urdf.xacro'"):
        osik.load_robot("ur10e_description")
    refuses(ValueError, r"'srdf_description' comes neither as MJCF nor as URDF", osik.load_robot, "srdf_description")


def test_without_the_package(monkeypatch: pytest.MonkeyPatch):
    """The embedded robots load, others name the extra; it is not imported before it is needed."""
    monkeypatch.setitem(sys.modules, "robot_descriptions", None)
    assert osik.load_robot("arm7").nv == 7
    with pytest.raises(ImportError, match=r"'toy_mj_description' needs .*pip install \"\.\[descriptions\]\""):
        osik.load_robot("toy_mj_description")
    refuses(KeyError, r"no robot 'nau'; did you mean 'nao'\? robots: nao, arm7", osik.load_robot, "nau")


@pytest.mark.parametrize("path", ["robot.urdf", "models/robot", "Robot.XML"])
def test_a_path_is_told_what_reads_files(path: str):
    refuses(KeyError, rf"no robot '{path}': .*nao, arm7.*Robot\.from_urdf\(path\)", osik.load_robot, path)


def test_the_command_line_takes_their_names():
    assert read_robot("toy_mj_description").nv == 7
    assert read_robot("toy_description", base="fixed").nv == 1
    refuses(CommandError, r"no robot 'toi_description'; did you mean 'toy_description'", read_robot, "toi_description")
