"""Kinematic model of a robot as an immutable pytree, and its readers."""

from ._load_robot import load_robot as load_robot
from ._robot import Robot as Robot
