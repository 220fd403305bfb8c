"""Controllers in other programs: exports; PyTorch in ``torch``, action spaces in ``action``, ROS 2 in ``ros2``."""

from ._export import export_controller as export_controller
from ._exported import load_exported as load_exported


def __getattr__(name: str) -> object:
    """Raise an error that names the function whose name changed."""
    if name == "load_controller":
        raise ImportError("osik_jax.interop has load_exported, which reads what export_controller made")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
