"""Where the G1's URDF is: example-robot-data brings it, and this package does not."""

from __future__ import annotations

import sys
from pathlib import Path

_URDF = Path("example-robot-data/robots/g1_description/urdf/g1_29dof_rev_1_0.urdf")


def g1_urdf() -> Path:
    """The URDF of Unitree's G1 with 29 joints, of the package example-robot-data.

    Raises:
        FileNotFoundError: it is not installed.
    """
    for folder in sys.path:
        for share in ("cmeel.prefix/share", "share"):
            found = Path(folder) / share / _URDF
            if found.is_file():
                return found
    raise FileNotFoundError(
        "the G1's URDF comes with example-robot-data (pip install example-robot-data), which is not installed; or give "
        "the path of a URDF of yours with --robot"
    )
