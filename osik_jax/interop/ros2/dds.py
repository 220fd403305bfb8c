"""Nodes over DDS, their messages, and bags. Needs the extra ``ros2``."""

from ..._errors import missing_extra

try:
    from . import _messages as messages
    from ._bag import BagWriter as BagWriter
    from ._bag import Replay as Replay
    from ._bag import replay as replay
    from ._node import Endpoints as Endpoints
    from ._node import Node as Node
    from ._trajectory import joint_trajectory as joint_trajectory
except ImportError as missing:
    raise missing_extra("a ROS 2 topic", "cyclonedds and mcap", "ros2") from missing

__all__ = ["BagWriter", "Endpoints", "Node", "Replay", "joint_trajectory", "messages", "replay"]
