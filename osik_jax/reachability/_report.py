"""Summary of a map for the command line."""

from __future__ import annotations

import numpy as np
from rich.table import Table

from ._map import ReachabilityMap


def summary_table(found: ReachabilityMap) -> Table:
    """Return a table of the reached share of the grid, and of the best positions for turning and moving the frame."""
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
