"""Report of a demonstration with dynamics: JSON for programs, a table and plots for people."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.table import Table

from ..physics import World
from ..viewer._figures import Panel
from ._motion import Motion
from ._physics import FEEDBACK_GAIN, PhysicsMeasurement, PhysicsRun
from ._report import inside, limit_count, number, report, solved, table_of_schemes
from ._schemes import TITLES

HEIGHT, TILT, SLIP = 0.01, float(np.radians(3.0)), 0.005
"""Largest accepted errors: base height [m], base orientation [rad], displacement of a standing foot [m]."""


def physics_report(
    motion: Motion, runs: Sequence[PhysicsRun], world: World, *, dt: float, files: Sequence[str] = ()
) -> dict[str, Any]:
    """Return all figures of a demonstration with dynamics; lengths in mm, angles in degrees or mrad as named."""
    out = report(motion, {r.run.scheme: (r.run.outcome, r.run.measurement) for r in runs}, dt=dt, files=files)
    out["checked_with"] = "MuJoCo's data along the simulation; the plan is the kinematic motion of the same scheme"
    out["settings"] |= {
        "feedback_gain_per_s": FEEDBACK_GAIN,
        "timestep_s": float(world.model.opt.timestep),
        "servos": {joint: dataclasses.asdict(servo) for joint, servo in world.servos.items()},
    }
    for run in runs:
        scheme = out["schemes"][run.run.scheme]
        del scheme["reached"]  # what the kinematic motion has to reach
        scheme["physics"] = physics_figures(run.physics)
    return out


def physics_figures(physics: PhysicsMeasurement) -> dict[str, Any]:
    """Return one scheme's figures; lengths in mm, angles in degrees."""
    return {
        "fell_at_s": physics.fell,
        "base_height_error_mm": 1e3 * float(physics.height_error.max()),
        "base_tilt_error_deg": float(np.degrees(physics.tilt_error.max())),
        "slip_mm": {foot: 1e3 * _worst(slip) for foot, slip in physics.slip.items()},
        "contact_slip_mm": {foot: 1e3 * slip for foot, slip in physics.contact_slip.items()},
        "least_pressure_margin_mm": _least(physics.pressure_margin),
        "least_com_margin_mm": _least(physics.com_margin),
        "greatest_part_of_torque_limit": float(physics.effort_used.max()),
        "busiest_joint": physics.busiest,
        "servo_steps_at_limit": physics.saturated,
        "joints_beyond_limits_deg": float(np.degrees(physics.beyond_limits.max())),
        "furthest_beyond": physics.furthest,
        "reached": reached(physics),
    }


def _worst(values: Float[np.ndarray, " T"]) -> float:
    """Return the largest value that is not NaN; 0 without any."""
    return float(np.nanmax(values, initial=0.0))


def _least(margin: Float[np.ndarray, " T"]) -> float | None:
    """Return the least value that is not NaN [mm]."""
    known = margin[~np.isnan(margin)]
    return 1e3 * float(known.min()) if len(known) else None


def reached(physics: PhysicsMeasurement) -> dict[str, bool]:
    """Return, for each requirement, whether it was met."""
    slips = [_worst(slip) for slip in physics.slip.values()] + list(physics.contact_slip.values())
    return {
        "standing": physics.fell is None,
        "height": bool(physics.height_error.max() <= HEIGHT),
        "tilt": bool(physics.tilt_error.max() <= TILT),
        "slip": max(slips, default=0.0) <= SLIP,
    }


def physics_table(summary: Mapping[str, Any]) -> Table:
    """Return a table of the schemes with dynamics; figures in red miss their requirement."""
    schemes = list(summary["schemes"].values())
    return table_of_schemes(f"{summary['title']}, with dynamics", schemes, _rows(schemes[0]))


def _rows(example: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return row labels, each with a function from a scheme's figures to the cell's text."""
    return [
        ("stands to the end", lambda s: _stands(s["physics"]["fell_at_s"])),
        ("base height off plan [mm]", lambda s: number(s["physics"]["base_height_error_mm"], 1e3 * HEIGHT)),
        ("base turned off plan [deg]", lambda s: number(s["physics"]["base_tilt_error_deg"], np.degrees(TILT))),
        ("standing feet off their place [mm]", lambda s: number(max(s["physics"]["slip_mm"].values()), 1e3 * SLIP)),
        ("a touching point slides [mm]", lambda s: number(max(s["physics"]["contact_slip_mm"].values()), 1e3 * SLIP)),
        ("centre of pressure inside by [mm]", lambda s: _margin(s["physics"]["least_pressure_margin_mm"])),
        ("centre of mass inside by [mm]", lambda s: _margin(s["physics"]["least_com_margin_mm"])),
        ("greatest torque, of its limit", lambda s: number(s["physics"]["greatest_part_of_torque_limit"], None)),
        ("  in", lambda s: s["physics"]["busiest_joint"]),
        ("servo steps at the limit", lambda s: str(s["physics"]["servo_steps_at_limit"])),
        ("joints beyond their position limits [deg]", lambda s: number(s["physics"]["joints_beyond_limits_deg"], None)),
        *(_goal_row(label) for label in example["goals"]),
        ("velocity limits broken", lambda s: limit_count(s["limits"]["velocity_violations"])),
        ("steps solved", lambda s: solved(s["solver"]["status"])),
        ("a step, MuJoCo and records too [µs]", lambda s: f"{s['solver']['microseconds_per_step']:.0f}"),
    ]


def _goal_row(label: str) -> tuple[str, Any]:
    title = f"{label.replace('_', ' ')}, from path [mm]"
    return title, lambda s: number(s["goals"][label]["position_mm"], None)


def _stands(fell: float | None) -> str:
    return "yes" if fell is None else f"[red]fell at {fell:.2f} s[/red]"


def _margin(value: float | None) -> str:
    return "-" if value is None else inside(value)


def physics_panels(runs: Sequence[PhysicsRun]) -> list[Panel]:
    """Return the panels of the comparison plot."""
    measured = {TITLES[run.run.scheme]: run.physics for run in runs}
    slips = {name: 1e3 * _greatest(list(m.slip.values())) for name, m in measured.items()}
    return [
        Panel(
            "base height off plan [mm]",
            {name: 1e3 * m.height_error for name, m in measured.items()},
            bound=1e3 * HEIGHT,
            bound_label="10 mm allowed",
        ),
        Panel(
            "base turned off plan [deg]",
            {name: np.degrees(m.tilt_error) for name, m in measured.items()},
            bound=np.degrees(TILT),
            bound_label="3 deg allowed",
        ),
        Panel("standing feet off their first place [mm]", slips, bound=1e3 * SLIP, bound_label="5 mm allowed"),
        Panel(
            "centre of pressure inside the soles [mm]",
            {name: 1e3 * m.pressure_margin for name, m in measured.items()},
            bound=0.0,
            above=True,
            bound_label="edge: tips over",
        ),
        Panel(
            "centre of mass inside the soles [mm]",
            {name: 1e3 * m.com_margin for name, m in measured.items()},
            bound=0.0,
            above=True,
            bound_label="edge",
        ),
        Panel(
            "busiest servo, part of its torque limit",
            {name: m.effort_used for name, m in measured.items()},
            bound=1.0,
            bound_label="limit",
        ),
    ]


def _greatest(values: Sequence[np.ndarray]) -> np.ndarray:
    """Return the largest value over the feet at each time. (T,)."""
    return np.nanmax(np.stack(values), 0)
