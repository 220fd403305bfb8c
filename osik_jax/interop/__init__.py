"""Controllers in other programs: PyTorch in ``torch``, action spaces in ``action``, ROS 2 in ``ros2``."""
