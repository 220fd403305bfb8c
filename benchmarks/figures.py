"""A figure of steps a second against the size of the batch.

python -m benchmarks.figures results.json [figure.png]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

MARKERS = {"osik_jax": "o", "mjinx": "s", "mink-warp": "D"}
"""Of the peers that run batches."""


def draw(result: dict[str, Any], path: Path) -> None:
    """Writes a panel for each precision of ours: a line a scheme or peer, hollow where the judge failed a motion.

    Peers that run one robot a process are level lines. Nothing is written where no batch was run.
    """
    rows = result["many_robots"]
    batched = [row for row in rows if row["options"].get("batch")]
    if not batched:
        return
    precisions = sorted(
        {row["options"]["precision"] for row in batched if row["peer"] == "osik_jax"}, reverse=True
    ) or [""]
    figure = Figure(figsize=(5.5 * len(precisions), 4.5), layout="constrained")
    axes = figure.subplots(1, len(precisions), sharey=True, squeeze=False)[0]
    for panel, precision in zip(axes, precisions, strict=True):
        for name, line in sorted(_lines(batched, precision).items()):
            _line(panel, name, line)
        for row in rows:
            if row not in batched:
                panel.axhline(row["steps_per_second"], color="0.5", lw=1)
                panel.annotate(
                    row["name"],
                    (1.0, row["steps_per_second"]),
                    xycoords=("axes fraction", "data"),
                    fontsize=7,
                    ha="right",
                    va="bottom",
                )
        panel.set(xscale="log", yscale="log", xlabel="robots in a batch", title=_title(precision))
        panel.grid(True, which="major", color="0.9")
        panel.legend(fontsize=7, loc="upper left")
    axes[0].set_ylabel("steps of a robot a second")
    places = sorted({row["device"] or result["cpu"] for row in rows})
    figure.suptitle(f"{result['robot']} on {', '.join(places)}", fontsize=9)
    figure.savefig(path, dpi=150)


def _title(precision: str) -> str:
    return f"osik_jax in {precision}" if precision else ""


def _lines(rows: Iterable[dict[str, Any]], precision: str) -> dict[str, list[dict[str, Any]]]:
    """Rows of each line of a panel, by growing batch."""
    lines: dict[str, list[dict[str, Any]]] = {}
    for row in sorted(rows, key=lambda row: row["options"]["batch"]):
        options = row["options"]
        if row["peer"] != "osik_jax":
            lines.setdefault(row["peer"], []).append(row)
        elif options["precision"] == precision and options.get("warm", True):
            lines.setdefault(f"osik_jax, {options['scheme']}", []).append(row)
    return lines


def _line(axes: Axes, name: str, rows: list[dict[str, Any]]) -> None:
    sizes, rates = ([row[key] for row in rows] for key in ("robots", "steps_per_second"))
    (line,) = axes.plot(sizes, rates, label=name, lw=1.5)
    colour, marker = line.get_color(), MARKERS[rows[0]["peer"]]
    for row, size, rate in zip(rows, sizes, rates, strict=True):
        face = "white" if row["failures"] else colour
        axes.plot([size], [rate], marker, color=colour, markerfacecolor=face)


def main() -> None:
    """Draws anew what a run has written."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.figures", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("results", type=Path, help="JSON file of python -m benchmarks")
    parser.add_argument("figure", type=Path, nargs="?", help="default: a .png beside it")
    given = parser.parse_args()
    draw(json.loads(given.results.read_text(encoding="utf-8")), given.figure or given.results.with_suffix(".png"))


if __name__ == "__main__":
    main()
