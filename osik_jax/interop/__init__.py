"""Controllers in other programs: exports; PyTorch in ``torch``, action spaces in ``action``, ROS 2 in ``ros2``."""

from ._export import export_controller as export_controller
from ._exported import load_exported as load_exported
