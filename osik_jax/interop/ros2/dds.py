"""Nodes over DDS and their messages. Needs the extra ``ros2``."""

from ..._errors import missing_extra

try:
    from . import _messages as messages
    from ._node import Endpoints as Endpoints
    from ._node import Node as Node
    from ._node import joint_trajectory as joint_trajectory
except ImportError as missing:
    raise missing_extra("a ROS 2 topic", "cyclonedds", "ros2") from missing

__all__ = ["Endpoints", "Node", "joint_trajectory", "messages"]
