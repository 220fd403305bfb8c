"""Twelve robots of example-robot-data whose waist or hand sways as NAO's: pictures on one sheet, and what was reached.

    python -m benchmarks.contact_sheet [--robots ur5,panda] [--out sheet] [--write]

runs the demonstration of each robot and keeps its folder in ``--out``. ``--write`` writes
docs/data/demonstrations.csv, and the sheet into docs/images.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from PIL import Image

from osik_jax import viewer
from osik_jax.cli import read_robot
from osik_jax.demo._demo import run_demo
from osik_jax.demo._figures import Figure, figures
from osik_jax.demo._motion import Motion
from osik_jax.runtime import configure_cpu

from .command_line import listed
from .data_file import DATA, DOCS, write_csv
from .demonstrated import file_motion
from .robots_table import ROBOTS, file_of

SHEET, TABLE = DOCS / "images" / "robots.png", DATA / "demonstrations.csv"
HEAD = (
    "robot", "base", "dofs", "scheme", "what moves", "off its path [mm]", "feet drift [mm]", "limits broken",
    "steps solved", "CPU time [s]",
)  # fmt: skip
NAMES = (
    "ur5", "panda", "so101", "baxter", "tiago", "talos", "icub", "g1", "romeo", "anymal_b", "solo12", "go1",
)  # fmt: skip
SCHEME = "hierarchical"
DURATION = 4.0
TILE, COLUMNS = (400, 330), 4


class Row(NamedTuple):
    """A robot's line: its motion, the configurations of it, and their figures by label."""

    name: str
    motion: Motion
    path: np.ndarray
    figures: dict[str, Figure]
    steps: int
    seconds: float

    def cells(self) -> tuple[str, ...]:
        """Return the texts of the columns in ``HEAD``."""
        robot, goal, drift = self.motion.robot, next(iter(self.motion.goals)), "standing feet, drift [mm]"
        rooms = [figure for label, figure in self.figures.items() if label.startswith("room to")]
        return (
            self.name,
            "floating" if robot.floating_base else "fixed",
            str(robot.nv),
            SCHEME,
            goal,
            f"{self.figures[f'{goal}, from path [mm]'].worst:.2g}",
            f"{self.figures[drift].worst:.1g}" if drift in self.figures else "-",
            str(sum(figure.missed for figure in rooms)),
            f"{self.steps - int(self.figures['steps not solved'].worst or 0)}/{self.steps}",
            f"{self.seconds:.0f}",
        )


def demonstrate(name: str, folder: Path) -> Row:
    """Runs the demonstration of a robot."""
    started = time.process_time()
    motion = file_motion(read_robot(str(file_of(name))), name=file_of(name).stem, duration=DURATION)
    _, (run,) = run_demo(motion, folder / name, schemes=(SCHEME,), animation=False)
    found = {figure.label: figure for figure in figures(motion, run)}
    return Row(name, motion, run.q, found, len(run.solution.status), time.process_time() - started)


def tile(row: Row, folder: Path) -> Image.Image:
    """The robot in the middle of its motion."""
    middle = row.path[len(row.path) // 2]
    picture = viewer.hero_picture(folder / f"{row.name}.png", row.motion.robot, [middle], labels=(row.name,), size=TILE)
    with Image.open(picture) as image:
        return image.convert("RGB")


def sheet(tiles: list[Image.Image]) -> Image.Image:
    """All pictures, line by line."""
    width, height = TILE
    out = Image.new("RGB", (COLUMNS * width, -(-len(tiles) // COLUMNS) * height), "white")
    for k, image in enumerate(tiles):
        out.paste(image, (k % COLUMNS * width, k // COLUMNS * height))
    return out


def main() -> None:
    """Runs all robots, and writes the sheet and, where asked to, the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.contact_sheet", description=__doc__)
    parser.add_argument("--robots", type=listed(str, among=tuple(ROBOTS)), default=NAMES)
    parser.add_argument("--out", type=Path, default=Path("contact-sheet"))
    parser.add_argument("--write", action="store_true", help=f"write {TABLE.name} and {SHEET.name} in docs")
    given = parser.parse_args()
    rows, tiles = [], []
    for name in given.robots:
        rows.append(demonstrate(name, given.out))
        tiles.append(tile(rows[-1], given.out))
        print(*rows[-1].cells(), sep=", ", flush=True)
        jax.clear_caches()
    sheet(tiles).save(SHEET if given.write else given.out / "robots.png", optimize=True)
    if given.write:
        write_csv(TABLE, HEAD, [row.cells() for row in rows])


if __name__ == "__main__":
    configure_cpu()
    main()
