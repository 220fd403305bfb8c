"""Figures of a motion: one list for the report, the table and the plots."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from ..solvers import Status
from ._measure import Measurement
from ._motion import Motion
from ._physics import PhysicsMeasurement, PhysicsRun
from ._run import Run

DRIFT, PATH_ERROR = 1e-4, 1e-3
"""Requirements for a motion of 5 cm: drift of standing feet [m and rad], error of the first goal [m]."""
HEIGHT, TILT, SLIP = 0.01, float(np.radians(3.0)), 0.005
"""Requirements with dynamics: base height [m], base orientation [rad], displacement of a standing foot [m]."""

_ROOM = -1e-6
"""Room to a limit that counts as 0: speeds are differences of MuJoCo's configurations, with their rounding."""


@dataclasses.dataclass(frozen=True)
class Figure:
    """Number of a motion, or values over time of which the worst counts.

    Attributes:
        name: in the report, with its unit.
        label: in the table and over its plot, with its unit.
        values: a number, a text, or one value a configuration. () or (T,)
        least: smallest value that is wanted.
        most: largest value that is wanted.
        floor: its plot has a logarithmic axis that ends here; ``None``: a linear axis.
        span: a linear axis shows this much at least.
    """

    name: str
    label: str
    values: Float[np.ndarray, "*T"] | float | int | str | None
    least: float | None = None
    most: float | None = None
    floor: float | None = None
    span: float = 1e-3

    @property
    def worst(self) -> float | int | str | None:
        """Return the number, or the worst of the values over time; None if there is none."""
        if not isinstance(self.values, np.ndarray):
            return self.values
        known = self.values[~np.isnan(self.values)]
        return None if not len(known) else float(known.max() if self.least is None else known.min())

    @property
    def missed(self) -> bool:
        """Return whether the figure is outside its range."""
        worst = self.worst
        if worst is None or isinstance(worst, str):
            return False
        return (self.least is not None and worst < self.least) or (self.most is not None and worst > self.most)


def figures(motion: Motion, run: Run) -> list[Figure]:
    """Return the figures of a run that exist for its robot; required lengths grow with the scale of the motion."""
    m, scale = run.measurement, motion.scale
    balance = Figure("com_inside_mm", "centre of mass inside [mm]", 1e3 * m.com_margin, least=0.0, span=scale)
    fast = Figure("velocity_limits_broken", "velocity limits broken", m.velocity_violations, most=0)
    status = run.solution.status
    solver = [
        Figure("steps_not_solved", "steps not solved", int((status != Status.SOLVED).sum()), most=0),
        Figure("compile_s", "compile [s]", run.compile_seconds),
        Figure("step_us", "a step [µs]", 1e6 * run.run_seconds / len(status)),
    ]
    if isinstance(run, PhysicsRun):
        return [*_physics(run.physics), balance, *_goals(m, None), fast, *solver]
    broken = Figure("position_limits_broken", "position limits broken", m.position_violations, most=0)
    limits = [
        Figure("position_margin", "room to position limits (0 to 1)", m.position_margin, least=_ROOM, span=0.1),
        Figure("velocity_margin", "room to speed limits (0 to 1)", m.velocity_margin, least=_ROOM, span=0.1),
    ]
    drift = _drift(m, scale) if m.stances else []
    return [*drift, *([balance] if motion.balanced else []), *_goals(m, scale), *limits, broken, fast, *solver]


def _drift(m: Measurement, scale: float) -> list[Figure]:
    """Return the largest drift of the standing frames; no orientation of point feet."""
    most = 1e3 * DRIFT
    position, turn = (
        1e3 * np.fmax.reduce([getattr(track, part) for track in m.stances.values()])
        for part in ("position", "orientation")
    )
    return [
        Figure("feet_drift_mm", "standing feet, drift [mm]", position, most=most * scale, floor=1e-6 * most * scale),
        Figure("feet_turn_mrad", "standing feet, turn [mrad]", turn, most=most, floor=1e-6 * most),
    ]


def _goals(m: Measurement, scale: float | None) -> list[Figure]:
    """Return the distance of each goal from its path; the first is held to a requirement where a scale is given."""
    out = []
    for label, track in m.goals.items():
        most = None if scale is None or out else 1e3 * PATH_ERROR * scale
        floor = None if scale is None else 1e-5 * scale
        settled = 1e3 * float(track.position[track.settled].max()) if track.settled.any() else None
        words = label.replace("_", " ")
        out.append(Figure(f"{label}_mm", f"{words}, from path [mm]", 1e3 * track.position, floor=floor))
        out.append(Figure(f"{label}_once_there_mm", f"{words}, once there [mm]", settled, most=most))
    return out


def _physics(physics: PhysicsMeasurement) -> list[Figure]:
    """Return the figures of a simulated motion."""
    slip = 1e3 * np.fmax.reduce(list(physics.slip.values()))
    slide = 1e3 * max(physics.contact_slip.values())
    return [
        Figure("falls", "falls", int(physics.fell is not None), most=0),
        Figure("fell_at_s", "  at [s]", physics.fell),
        Figure("base_height_mm", "base height off plan [mm]", 1e3 * physics.height_error, most=1e3 * HEIGHT),
        Figure("base_turn_deg", "base turned off plan [deg]", np.degrees(physics.tilt_error), most=np.degrees(TILT)),
        Figure("feet_slip_mm", "standing feet off their place [mm]", slip, most=1e3 * SLIP),
        Figure("contact_slip_mm", "a touching point slides [mm]", slide, most=1e3 * SLIP),
        Figure("pressure_inside_mm", "centre of pressure inside [mm]", 1e3 * physics.pressure_margin, least=0.0),
        Figure("torque", "greatest torque, of its limit", physics.effort_used),
        Figure("busiest_joint", "  in", physics.busiest),
        Figure("beyond_limits_deg", "joints beyond position limits [deg]", np.degrees(physics.beyond_limits)),
    ]
