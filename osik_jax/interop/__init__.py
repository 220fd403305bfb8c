"""Controllers in other programs: ROS 2 topics in ``interop.ros2``."""
