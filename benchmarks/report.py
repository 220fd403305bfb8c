"""Results as tables, and what they were measured on."""

from __future__ import annotations

import datetime
import os
import platform
from typing import Any

from rich.console import Console
from rich.table import Table

from .machine import processor


def surroundings() -> dict[str, Any]:
    """Machine and moment."""
    return dict(
        cpu=processor(),
        cores=os.cpu_count(),
        load=os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        system=platform.platform(),
        date=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    )


def show(console: Console, result: dict[str, Any]) -> None:
    """A table of one robot, one of many, and who was not there."""
    console.print(
        f"{result['robot']} on {result['cpu']}, {result['cores']} cores, load {result['load']:.1f} at the end"
    )
    if result["one_robot"]:
        console.print(_one_robot(result["one_robot"]))
    if result["many_robots"]:
        console.print(_many_robots(result["many_robots"]))
    for row in [*result["one_robot"], *result["many_robots"]]:
        if row["failures"]:
            console.print(f"[red]{row['name']} failed:[/red] {', '.join(row['failures'])}")
    for peer, reason in result["missing"].items():
        console.print(f"{peer} did not take part: {reason}")


def _one_robot(rows: list[dict[str, Any]]) -> Table:
    table = Table(title="One robot, one core: a step, NumPy to NumPy")
    for heading in ("entrant", "µs median", "µs p99", "times mink", "first tick [s]", "from cache [s]", *_QUALITY):
        table.add_column(heading, justify="left" if heading == "entrant" else "right")
    mink = next((row["tick_seconds_median"] for row in rows if row["peer"] == "mink"), None)
    for row in rows:
        median, warm = row["tick_seconds_median"], row.get("first_tick_warm_seconds")
        table.add_row(
            row["name"],
            f"{1e6 * median:.0f}",
            f"{1e6 * row['tick_seconds_p99']:.0f}",
            f"{median / mink:.2f}" if mink else "",
            f"{row['first_tick_seconds']:.2g}",
            f"{warm:.2g}" if warm is not None else "",
            *_quality(row),
        )
    return table


def _many_robots(rows: list[dict[str, Any]]) -> Table:
    table = Table(title="Many robots, all cores")
    for heading in ("entrant", "robots", "steps/s", "ms a step of all", "first tick [s]", *_QUALITY):
        table.add_column(heading, justify="left" if heading == "entrant" else "right")
    for row in rows:
        table.add_row(
            row["name"],
            f"{row['robots']:,}",
            f"{row['steps_per_second']:,.0f}",
            f"{1e3 * row['tick_seconds_median']:.3g}",
            f"{row['first_tick_seconds']:.2g}",
            *_quality(row),
        )
    return table


_QUALITY = ("hand, feet, CoM [mm]", "solved", "judged")


def _quality(row: dict[str, Any]) -> tuple[str, str, str]:
    errors = ", ".join(f"{1e3 * row['score'][name]:.2f}" for name in ("hand", "feet", "com"))
    return errors, f"{row['solved']:.4f}", "FAILED" if row["failures"] else "good"
