"""Report of a demonstration: JSON for programs and a table for people."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
import os
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int
from rich.markup import escape
from rich.table import Table

from ..solvers import Status
from ._measure import TOLERANCE, Measurement, Track
from ._motion import Motion
from ._schemes import PROMISES_LIMITS, TITLES

DRIFT_POSITION, DRIFT_ORIENTATION, PATH_ERROR = 1e-4, 1e-4, 1e-3
"""Requirements of the hierarchical scheme for a motion of 5 cm: drift of standing feet [m], [rad], error of the first
goal [m].

Lengths are those of a motion of 5 cm.
"""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Solver results along a motion, and run times.

    Attributes:
        compile_seconds: tracing and compiling the whole loop [s].
        run_seconds: running it once [s].
        status: of each step. (steps,)
        iterations: of each step. (steps,)
        kkt_residual: of each step. (steps,)
    """

    compile_seconds: float
    run_seconds: float
    status: Int[np.ndarray, " steps"]
    iterations: Int[np.ndarray, " steps"]
    kkt_residual: Float[np.ndarray, " steps"]


def report(
    motion: Motion,
    results: Mapping[str, tuple[Outcome, Measurement]],
    *,
    dt: float,
    files: Sequence[str] = (),
) -> dict[str, Any]:
    """Return all figures of a demonstration; lengths in mm, angles in mrad."""
    return {
        "motion": motion.name,
        "title": motion.title,
        "settings": _settings(motion, dt),
        "schemes": {name: _scheme(motion, name, *result) for name, result in results.items()},
        "checked_with": "MuJoCo's mj_kinematics and mj_comPos, from the configurations alone",
        "versions": _versions(),
        "files": [*files, "report.json"],
        "notes": list(motion.notes),
    }


def write_report(summary: Mapping[str, Any], path: Path) -> None:
    """Write a report as strict JSON."""
    path.write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _settings(motion: Motion, dt: float) -> dict[str, Any]:
    tasks = motion.tasks(0.0)
    return {
        "duration_s": motion.duration,
        "dt_s": dt,
        "steps": round(motion.duration / dt),
        "joints": len(motion.robot.joint_names),
        "scale": motion.scale,
        "precision": str(motion.robot.q0.dtype),
        "tasks": {
            name: {
                "kind": type(task).__name__,
                "priority": task.priority,
                "weight": float(np.asarray(task.weight)),
                "gain_per_s": float(np.asarray(task.gain)),
            }
            for name, task in tasks.items()
        },
        "limits": [type(limit).__name__ for limit in motion.limits],
        "violation_tolerance": TOLERANCE,
    }


def _versions() -> dict[str, str]:
    packages = ("osik-jax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "equinox", "numpy", "scipy", "matplotlib")
    found = {name: importlib.metadata.version(name) for name in packages}
    return found | {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "device": str(jax.devices()[0]),
        "cores": str(os.cpu_count()),
    }


def _scheme(motion: Motion, name: str, outcome: Outcome, m: Measurement) -> dict[str, Any]:
    out = {
        "title": TITLES[name],
        "standing": {frame: _drift(track) for frame, track in m.stances.items()},
        "goals": {label: _error(track) for label, track in m.goals.items()},
        "limits": {
            "promised": name in PROMISES_LIMITS,
            "position_violations": m.position_violations,
            "velocity_violations": m.velocity_violations,
            "least_position_margin": float(m.position_margin.min()),
            "least_velocity_margin": float(m.velocity_margin.min()),
        },
        "solver": _solver(outcome),
    }
    if motion.balanced:
        out["balance"] = {
            "least_margin_mm": 1e3 * float(m.com_margin.min()),
            "steps_outside": int((m.com_margin < 0.0).sum()),
        }
    return out | {"reached": _reached(motion, m)}


def _drift(track: Track) -> dict[str, float]:
    out = {"position_mm": 1e3 * float(np.nanmax(track.position))}
    return out | _turn(track)


def _turn(track: Track) -> dict[str, float]:
    """Return the largest orientation error [mrad]; None if no orientation is tracked."""
    angle = track.orientation[~np.isnan(track.orientation)]
    return {"orientation_mrad": 1e3 * float(angle.max())} if len(angle) else {}


def _error(track: Track) -> dict[str, float | None]:
    """Return the largest errors over all times, and over the times when the path is at rest again."""
    out: dict[str, float | None] = {"position_mm": 1e3 * float(track.position.max())}
    out["settled_position_mm"] = 1e3 * float(track.position[track.settled].max()) if track.settled.any() else None
    return out | _turn(track)


def _solver(outcome: Outcome) -> dict[str, Any]:
    steps = len(outcome.status)
    return {
        "status": {status.name: int((outcome.status == status).sum()) for status in Status},
        "iterations_mean": float(outcome.iterations.mean()),
        "iterations_max": int(outcome.iterations.max()),
        "kkt_residual_max": _finite(outcome.kkt_residual.max()),
        "compile_s": outcome.compile_seconds,
        "run_s": outcome.run_seconds,
        "microseconds_per_step": 1e6 * outcome.run_seconds / steps,
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _reached(motion: Motion, m: Measurement) -> dict[str, bool]:
    """Return, for each requirement of the hierarchical scheme, whether a motion met it."""
    first = next(iter(m.goals.values()))
    settled = first.position[first.settled]
    out = {"first_goal": bool(len(settled) and settled.max() <= PATH_ERROR * motion.scale)}
    if motion.stances:
        out["standing"] = all(
            np.nanmax(t.position) <= DRIFT_POSITION * motion.scale and not (t.orientation > DRIFT_ORIENTATION).any()
            for t in m.stances.values()
        )
    if motion.balanced:
        out["balance"] = bool((m.com_margin >= 0.0).all())
    return out | {"limits": m.position_violations == 0 and m.velocity_violations == 0}


def table(summary: Mapping[str, Any]) -> Table:
    """Return the figures as a table with one column per scheme."""
    schemes = list(summary["schemes"].values())
    return table_of_schemes(summary["title"], schemes, _rows(schemes[0], summary["settings"]["scale"]))


def table_of_schemes(title: str, schemes: Sequence[Mapping[str, Any]], rows: Sequence[tuple[str, Any]]) -> Table:
    """Return a table with one column per scheme.

    Each row has a label, and a function from a scheme's figures to the cell's text.
    """
    out = Table(title=title, title_justify="left", title_style="bold")
    out.add_column("")
    for scheme in schemes:
        out.add_column(scheme["title"], justify="right")
    for label, cell in rows:
        out.add_row(escape(label), *(cell(scheme) for scheme in schemes))
    return out


def _rows(example: Mapping[str, Any], scale: float) -> list[tuple[str, Any]]:
    """Return row labels, each with a function from a scheme's figures to the cell's text.

    Required lengths grow with the scale of the motion.
    """
    rows: list[tuple[str, Any]] = []
    if example["standing"]:
        rows.append(("standing feet, drift [mm]", lambda s: number(_worst(s["standing"], "position_mm"), 0.1 * scale)))
    if any("orientation_mrad" in figures for figures in example["standing"].values()):
        rows.append(("standing feet, turn [mrad]", lambda s: number(_worst(s["standing"], "orientation_mrad"), 0.1)))
    if "balance" in example:
        rows.append(("centre of mass inside by [mm]", lambda s: inside(s["balance"]["least_margin_mm"])))
    first = next(iter(example["goals"]))
    for label in example["goals"]:
        limit = scale if label == first else None
        rows.append(
            (
                f"{label.replace('_', ' ')}, from path [mm]",
                lambda s, k=label: number(s["goals"][k]["position_mm"], None),
            )
        )
        rows.append(
            ("  once there [mm]", lambda s, k=label, top=limit: number(s["goals"][k]["settled_position_mm"], top))
        )
    rows.append(("position limits broken", lambda s: limit_count(s["limits"]["position_violations"])))
    rows.append(("velocity limits broken", lambda s: limit_count(s["limits"]["velocity_violations"])))
    rows.append(("steps solved", lambda s: solved(s["solver"]["status"])))
    rows.append(("compile [s]", lambda s: f"{s['solver']['compile_s']:.1f}"))
    rows.append(("a step [µs]", lambda s: f"{s['solver']['microseconds_per_step']:.0f}"))
    return rows


def _worst(standing: Mapping[str, Mapping[str, float]], key: str) -> float:
    return max(figures[key] for figures in standing.values())


def number(value: float | None, limit: float | None) -> str:
    """Return a figure as a cell, in red above its limit."""
    if value is None:
        return "-"
    text = f"{value:.2g}" if value < 10 else f"{value:.1f}"
    return text if limit is None or value <= limit else f"[red]{text}[/red]"


def inside(value: float) -> str:
    """Return a margin as a cell, in red if negative."""
    return f"{value:.1f}" if value >= 0.0 else f"[red]{value:.1f}[/red]"


def limit_count(value: int) -> str:
    """Return a count of violations as a cell, in red above 0."""
    return "0" if value == 0 else f"[red]{value}[/red]"


def solved(status: Mapping[str, int]) -> str:
    """Return the number of solved steps out of all as a cell, in red if any is unsolved."""
    total = sum(status.values())
    done = status[Status.SOLVED.name]
    return f"{done}/{total}" if done == total else f"[red]{done}/{total}[/red]"
