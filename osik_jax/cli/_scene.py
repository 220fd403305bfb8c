"""Options of commands that keep a robot off obstacles."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from ._messages import refuse


@dataclasses.dataclass(frozen=True, kw_only=True)
class InScene:
    """Obstacles, and what may touch."""

    scene: Path | None = None
    """File of obstacles that the robot keeps off, and off itself: .xml, .urdf, .yaml or .scene."""
    srdf: Path | None = None
    """With --scene: an SRDF, whose pairs may touch."""
    clearance: float = 0.0
    """With --scene: least distance of all shapes [m]."""

    def obstacles(self) -> dict[str, Any]:
        """Return the arguments of a function that takes a scene; none without one."""
        from ..collision import Scene

        refuse(self, self.scene is None, ("srdf", "clearance"), "--scene")
        if self.scene is None:
            return {}
        return dict(scene=Scene.from_file(self.scene), srdf=self.srdf, clearance=self.clearance)
