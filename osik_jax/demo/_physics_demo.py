"""Run of a NAO motion with dynamics, and its output files."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..viewer._figures import compare_figure
from ..viewer._opengl import RendererName
from ._motion import Motion
from ._physics import PhysicsRun, run_physics
from ._physics_report import physics_panels, physics_report
from ._report import write_report
from ._run import SCHEME_COLORS, Announce, film
from ._schemes import TITLES


def run_physics_demo(
    motion: Motion,
    out: str | Path,
    *,
    schemes: Sequence[str],
    dt: float = 0.005,
    animation: bool = True,
    renderer: RendererName = "auto",
    announce: Announce | None = None,
) -> tuple[dict, list[PhysicsRun]]:
    """Run the schemes as ``run_demo`` does, in closed loop with MuJoCo; film the simulated robot.

    Args:
        motion: of NAO.
        out: folder to write to; made if need be.
        schemes: names from ``SCHEMES``.
        dt: control period [s].
        animation: whether to write a film of the last scheme.
        renderer: for the film, as in ``viewer.animate``.
        announce: told which stage runs.

    Returns:
        The report, as it is in ``report.json``, and the runs.

    Raises:
        KeyError: no such scheme.
        RuntimeError: ``renderer="mujoco"`` where OpenGL does not work.
    """
    tell = announce or (lambda stage, done: None)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    share = (0.7 if animation else 0.95) / len(schemes)
    runs = []
    for place, scheme in enumerate(schemes):
        tell(f"{TITLES.get(scheme, scheme)}: planning, then simulating", share * place)
        runs.append(run_physics(motion, scheme, dt=dt))
    start = share * len(schemes)
    tell("drawing the comparison", start)
    files = [_save_figure(motion, runs, folder), _save_arrays(runs, folder)]
    if animation:
        shown = dataclasses.replace(motion, title=f"{motion.title}, with dynamics")
        files += film(shown, runs[-1].run, folder, dt, renderer, lambda x: tell("filming", start + (0.99 - start) * x))
    summary = physics_report(motion, runs, runs[0].world, dt=dt, files=files)
    write_report(summary, folder / "report.json")
    tell("done", 1.0)
    return summary, runs


def _save_figure(motion: Motion, runs: Sequence[PhysicsRun], folder: Path) -> str:
    longest = max((run.recording.time for run in runs), key=len)
    figure = compare_figure(
        longest,
        physics_panels(runs),
        title=f"{motion.title}, with dynamics",
        note="All figures are from MuJoCo's data along the simulation; the plan is the kinematic motion.",
        colors=SCHEME_COLORS,
    )
    figure.savefig(folder / "comparison.png")
    return "comparison.png"


def _save_arrays(runs: Sequence[PhysicsRun], folder: Path) -> str:
    """Write time, q (sensed), plan, command, effort, com, contact_points and contact_forces of each scheme."""
    arrays: dict[str, np.ndarray] = {}
    for run in runs:
        key, r = run.run.scheme.replace("-", "_"), run.recording
        parts = dict(time=r.time, q=r.q, plan=run.plan.q, command=r.command, effort=r.effort, com=r.com)
        parts |= dict(contact_points=r.contact_points, contact_forces=r.contact_forces)
        arrays |= {f"{name}_{key}": value for name, value in parts.items()}
    np.savez_compressed(folder / "motion.npz", allow_pickle=False, **arrays)
    return "motion.npz"
