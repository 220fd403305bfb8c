"""Names of robots: ``load_robot`` and every command take the same ones."""

import sys
import warnings

import numpy as np
import pytest
from refusals import refuses

import osik_jax as osik
from osik_jax.cli import CommandError, read_robot
from osik_jax.robot.loading import NAMES, example_urdf


@pytest.mark.parametrize("name", NAMES)
def test_every_way_loads_the_same_robot(name: str):
    robot = osik.load_robot(name)
    other = read_robot(name)
    assert other.tree == robot.tree
    np.testing.assert_array_equal(other.q0, robot.q0)


@pytest.mark.parametrize("name", ["g1", "talos", "ur5", "so101"])
def test_urdfs_of_example_robot_data(name: str):
    """The same as its file, with a base as asked; meshes stay unread."""
    robot = osik.Robot.from_urdf(example_urdf(name), floating_base=False)
    assert osik.load_robot(name, floating_base=False).tree == robot.tree
    assert read_robot(name, "fixed").tree == robot.tree
    assert robot.holder.look is not None and "read" not in vars(robot.holder.look)


def test_without_the_packages_both_are_named(monkeypatch):
    monkeypatch.setattr(sys, "path", [])
    monkeypatch.setitem(sys.modules, "robot_descriptions", None)
    refuses(FileNotFoundError, "pip install example-robot-data", osik.load_robot, "g1")
    refuses(CommandError, "pip install example-robot-data", read_robot, "g1")
    refuses(FileNotFoundError, "the URDF of ur5 comes with example-robot-data", osik.load_robot, "ur5")


@pytest.mark.parametrize(
    ("name", "floats"), [("g1", True), ("go2", True), ("ur5", False), ("tiago", False), ("allegro", False)]
)
@pytest.mark.filterwarnings("ignore:the robot does not keep:osik_jax.OsikWarning")
def test_the_base_is_known_by_name(name, floats):
    """No warning asks whether an arm is bolted down, and what is asked for holds."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*floating_base", category=osik.OsikWarning)
        assert osik.load_robot(name).floating_base is floats
    assert osik.load_robot(name, floating_base=not floats).floating_base is not floats
