"""Twelve robots of example-robot-data through ``osik demo --robot``: pictures on one sheet, and what was reached.

    python -m benchmarks.contact_sheet [--robots ur5,panda] [--out sheet] [--write]

runs the command for each robot and keeps its folder in ``--out``. ``--write`` writes
docs/data/demonstrations.csv, and the sheet into docs/images.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from PIL import Image

import osik_jax as osik
from osik_jax import cli, viewer
from osik_jax.runtime import configure_cpu

from .command_line import listed
from .data_file import DATA, DOCS, write_csv
from .robots_table import ROBOTS, file_of, load

SHEET, TABLE = DOCS / "images" / "robots.png", DATA / "demonstrations.csv"
HEAD = (
    "robot", "base", "dofs", "scheme", "what moves", "off its path [mm]", "once there [mm]", "feet drift [mm]",
    "limits broken", "steps solved", "CPU time [s]",
)  # fmt: skip
NAMES = (
    "ur5", "panda", "so101", "baxter", "tiago", "talos", "icub", "g1", "romeo", "anymal_b", "solo12", "go1",
)  # fmt: skip
SCHEME = "hierarchical"
DURATION = 4.0
TILE, COLUMNS = (400, 330), 4


class Row(NamedTuple):
    """A robot's line: ``goal`` and ``figures`` are those of its report."""

    name: str
    robot: osik.Robot
    goal: str
    figures: dict[str, Any]
    seconds: float

    def cells(self) -> tuple[str, ...]:
        """Return the texts of the columns in ``HEAD``."""
        figures, status = self.figures, self.figures["status"]
        drift = figures.get("feet_drift_mm")
        return (
            self.name,
            "floating" if self.robot.floating_base else "fixed",
            str(self.robot.nv),
            SCHEME,
            self.goal,
            f"{figures[f'{self.goal}_mm']:.2g}",
            f"{figures[f'{self.goal}_once_there_mm']:.2g}",
            "-" if drift is None else f"{drift:.1g}",
            str(figures["position_limits_broken"] + figures["velocity_limits_broken"]),
            f"{status['SOLVED']}/{sum(status.values())}",
            f"{self.seconds:.0f}",
        )


def demonstrate(name: str, folder: Path) -> Row:
    """Runs the command.

    Raises:
        RuntimeError: it failed.
    """
    out, started = folder / name, time.process_time()
    words = ["demo", "--robot", str(file_of(name)), "--schemes", SCHEME, "--duration", f"{DURATION:g}"]
    code = cli.main([*words, "--picture", "--no-animation", "--out", str(out)])
    if code:
        raise RuntimeError(f"osik demo ended with {code} for {name}")
    seconds = time.process_time() - started
    figures = json.loads((out / "report.json").read_text(encoding="utf-8"))["schemes"][SCHEME]
    robot = load(name)
    if robot.nq != _path(name, folder).shape[1]:  # the command bolts down what floats but has no feet
        robot = osik.Robot.from_urdf(file_of(name), floating_base=False)
    return Row(name, robot, "waist" if "waist_mm" in figures else "hand", figures, seconds)


def _path(name: str, folder: Path) -> np.ndarray:
    return np.load(folder / name / "motion.npz")[f"q_{SCHEME}"]


def tile(row: Row, folder: Path) -> Image.Image:
    """The robot in the middle of its motion."""
    path = _path(row.name, folder)
    look = file_of(row.name)
    picture = viewer.hero_picture(
        folder / f"{row.name}.png", row.robot, [path[len(path) // 2]], look=look, labels=(row.name,), size=TILE
    )
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
