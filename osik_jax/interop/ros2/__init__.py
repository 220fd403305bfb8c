"""ROS 2 topics without ROS: a robot's controller as a function of messages. ``.dds`` speaks DDS."""

from ._controller import Controller as Controller
from ._settings import Settings as Settings
