"""The kinematic model that everything else takes: from files to an immutable pytree."""

from ._load_robot import load_robot as load_robot
from ._robot import Robot as Robot
