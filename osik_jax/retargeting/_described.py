"""Where URDFs are that example-robot-data brings, and this package does not."""

from __future__ import annotations

import sys
from pathlib import Path

from .._errors import unknown_name

_URDFS = {
    "g1": "g1_description/urdf/g1_29dof_rev_1_0.urdf",
    "talos": "talos_data/robots/talos_full_v2.urdf",
}
DESCRIBED = tuple(_URDFS)
"""Robots whose profiles come with this package, and whose URDFs with example-robot-data."""


def described_urdf(name: str) -> Path:
    """The URDF of Unitree's G1 with 29 joints, or of PAL's Talos, of the package example-robot-data.

    Raises:
        KeyError: no such robot.
        FileNotFoundError: example-robot-data is not installed.
    """
    if name not in _URDFS:
        raise unknown_name("robot", name, DESCRIBED)
    for folder in sys.path:
        for share in ("cmeel.prefix/share", "share"):
            found = Path(folder) / share / "example-robot-data" / "robots" / _URDFS[name]
            if found.is_file():
                return found
    raise FileNotFoundError(
        f"the URDF of {name} comes with example-robot-data (pip install example-robot-data), which is not installed; "
        "or give the path of a URDF of yours with --robot"
    )
