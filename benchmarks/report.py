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
    """A table of one robot, one of many, one of gradients, and who was not there."""
    devices = sorted({row["device"] for row in [*result["one_robot"], *result["many_robots"]] if row["device"]})
    place = ", ".join([result["cpu"], f"{result['cores']} cores", *devices])
    console.print(f"{result['robot']} on {place}, load {result['load']:.1f} at the end")
    if result["one_robot"]:
        console.print(_one_robot(result["one_robot"]))
    if result["many_robots"]:
        console.print(_many_robots(result["many_robots"]))
    if result["gradients"]:
        console.print(_gradients(result["gradients"]))
    for row in [*result["one_robot"], *result["many_robots"]]:
        if row["failures"]:
            console.print(f"[red]{row['name']} failed:[/red] {', '.join(row['failures'])}")
    for peer, reason in result["missing"].items():
        console.print(f"{peer} did not take part: {reason}")


def _one_robot(rows: list[dict[str, Any]]) -> Table:
    table = Table(title="One robot, one core: a step, NumPy to NumPy")
    for heading in (
        "entrant",
        "µs median",
        "µs p99",
        "times mink",
        "first step [s]",
        "from cache [s]",
        "MiB",
        *_QUALITY,
    ):
        table.add_column(heading, justify="left" if heading == "entrant" else "right")
    mink = next((row["step_seconds_median"] for row in rows if row["peer"] == "mink"), None)
    for row in rows:
        median, warm = row["step_seconds_median"], row.get("first_step_warm_seconds")
        table.add_row(
            row["name"],
            f"{1e6 * median:.0f}",
            f"{1e6 * row['step_seconds_p99']:.0f}",
            f"{median / mink:.2f}" if mink else "",
            f"{row['first_step_seconds']:.2g}",
            f"{warm:.2g}" if warm is not None else "",
            _mebibytes(row["peak_bytes"]),
            *_quality(row),
        )
    return table


def _many_robots(rows: list[dict[str, Any]]) -> Table:
    table = Table(title="Many robots, all cores")
    memory = ("MiB a process", "MiB of the device")
    for heading in ("entrant", "robots", "steps/s", "ms a step of all", "first step [s]", *memory, *_QUALITY):
        table.add_column(heading, justify="left" if heading == "entrant" else "right")
    for row in rows:
        table.add_row(
            row["name"],
            f"{row['robots']:,}",
            f"{row['steps_per_second']:,.0f}",
            f"{1e3 * row['step_seconds_median']:.3g}",
            f"{row['first_step_seconds']:.2g}",
            *(_mebibytes(row[key]) for key in ("peak_bytes", "device_peak_bytes")),
            *_quality(row),
        )
    return table


def _gradients(rows: list[dict[str, Any]]) -> Table:
    table = Table(title="Gradients over weights and targets, and the value alone")
    heads = ("of a", "scheme", "precision", "robots", "steps", "value [ms]", "with gradient [ms]", "times")
    for heading in (*heads, "compile [s]", "MiB", "MiB of the device", "finite"):
        table.add_column(heading, justify="left" if heading in heads[:3] else "right")
    for row in rows:
        forward, gradient = row["forward_seconds"], row["gradient_seconds"]
        table.add_row(
            *(row["what"], row["scheme"], row["precision"], f"{row['robots']:,}", str(row["steps"])),
            *(f"{1e3 * forward:.3g}", f"{1e3 * gradient:.3g}", f"{gradient / forward:.2f}"),
            f"{row['compile_seconds']:.1f}",
            *(_mebibytes(row[key]) for key in ("peak_bytes", "device_peak_bytes")),
            "yes" if row["finite"] else "NO",
        )
    return table


def _mebibytes(given: int | None) -> str:
    return "" if given is None else f"{given / 2**20:,.0f}"


_QUALITY = ("steps", "hand, feet, CoM [mm]", "solved", "judged")
"""Slow entrants come to fewer steps, and so not to the fastest part of the curve."""


def _quality(row: dict[str, Any]) -> tuple[str, str, str, str]:
    steps, solved = f"{row['judged_steps']:,}", f"{row['solved']:.4f}"
    if row["score"] is None:
        return steps, "", solved, "not yet"
    errors = ", ".join(f"{1e3 * row['score'][name]:.2f}" for name in ("hand", "feet", "com"))
    return steps, errors, solved, "FAILED" if row["failures"] else "good"
