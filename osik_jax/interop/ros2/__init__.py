"""ROS 2 topics without ROS: a robot's controller as a function of messages. ``.dds`` speaks DDS and reads bags."""

from ._controller import Command as Command
from ._controller import Controller as Controller
from ._controller import Memory as Memory
from ._controller import Output as Output
from ._controller import Received as Received
from ._settings import Settings as Settings
from ._settings import Topics as Topics
from ._settings import read_settings as read_settings
