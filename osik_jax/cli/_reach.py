"""``osik reach``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ._inputs import HasBase, InScene, read_robot
from ._messages import told, writing

if TYPE_CHECKING:
    from rich.table import Table

    from ..reachability._map import ReachabilityMap


@dataclasses.dataclass(frozen=True)
class Reach(HasBase, InScene):
    """Maps what a frame gets to: for each position of a grid, the share of orientations that it reaches.

    Writes the map and, beside it, a picture. What is finished is kept in a folder until then: the name of the map with
    .chunks after it. The same command resumes an interrupted map; for another one remove the folder or change --out.
    """

    robot: str
    """A URDF or MJCF file, or a robot by name: nao, ur5, g1 and others, or one of robot_descriptions."""
    frame: str
    """The frame: a link, body, site or geom, carried by hinges and slides."""
    out: Path = Path("map.npz")
    """File to write. The picture has the same name, and ends in .png."""
    positions: int = 20_000
    """About how many positions."""
    orientations: int = 64
    """Number of orientations at each position."""
    seeds: int = 64
    """Number of searches for a pose, at most."""
    key: int = 0
    """Number of the sequence of their starts."""
    position_tolerance: float = 1e-3
    """Largest distance from a position [m]."""
    orientation_tolerance: float = 1e-2
    """Largest angle to an orientation [rad]."""
    picture: bool = True
    """Draw the picture."""

    @property
    def unfinished(self) -> Path:
        """Return the folder of what is finished."""
        return self.out.with_name(f"{self.out.name}.chunks")

    def run(self) -> int:
        """Run the command; return the exit code."""
        import shutil

        from rich.console import Console

        from .. import reachability

        chunks = self.unfinished
        robot = read_robot(self.robot, self.base)
        with told():
            found = reachability.reachability_map(
                robot,
                self.frame,
                grid=self.positions,
                orientations=self.orientations,
                seeds=self.seeds,
                key=self.key,
                position_tolerance=self.position_tolerance,
                orientation_tolerance=self.orientation_tolerance,
                out=chunks,
                **self.obstacles(),
            )
            found.save(self.out)
        written, picture = [str(self.out)], self.out.with_suffix(".png")
        if self.picture:
            with writing(picture):
                found.figure().savefig(picture)
            written.append(str(picture))
        shutil.rmtree(chunks, ignore_errors=True)
        console = Console()
        console.print(_summary(found))
        console.print(f"written: {', '.join(written)}", markup=False, highlight=False)
        return 0


def _summary(found: ReachabilityMap) -> Table:
    """Return a table of the reached share of the grid, and of the best positions for turning and moving the frame."""
    from rich.table import Table

    share, some = found.share, found.reached.any(-1)
    table = Table(show_header=False)
    table.add_row("positions", f"{share.size} ({' x '.join(str(n) for n in share.shape)})")
    table.add_row("proven out of reach", str(int((found.beyond_reach > 0.0).sum())))
    table.add_row("reached in some orientation", str(int(some.sum())))
    table.add_row(f"reached in all {len(found.rotations)} orientations", str(int((share == 1.0).sum())))
    if some.any():
        table.add_row("orientations reached there, on average", f"{100.0 * share[some].mean():.1f} %")
        best = np.unravel_index(np.nanargmax(found.manipulability), share.shape)
        place = " ".join(f"{value:.3f}" for value in found.positions[best])
        table.add_row("best manipulability", f"{found.manipulability[best]:.4g} at {place}")
    return table
