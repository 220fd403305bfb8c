"""Run of a motion with each scheme, and its output files."""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ..control import rollout
from ..viewer import Curves, animate, hero_picture
from ..viewer._figures import Panel, compare_figure
from ..viewer._opengl import RendererName
from ._measure import Measurement, measure
from ._motion import Motion
from ._report import Outcome, report, write_report
from ._schemes import TITLES, make_scheme

SCHEME_COLORS = {TITLES["weighted"]: "#f08c3a", TITLES["null-space"]: "#4d5561", TITLES["hierarchical"]: "#1565c0"}
Announce = Callable[[str, float], None]
"""Callback with the name of the current stage and the finished share, 0 to 1."""


@dataclasses.dataclass(frozen=True)
class Run:
    """Motion of one scheme.

    Attributes:
        scheme: name of the scheme.
        q: configurations, starting with the start. (steps + 1, nq)
        v: velocities [rad/s or m/s]. (steps, nv)
        outcome: solver results and run times.
        measurement: figures of the motion.
    """

    scheme: str
    q: Float[np.ndarray, "T nq"]
    v: Float[np.ndarray, "steps nv"]
    outcome: Outcome
    measurement: Measurement


def run_scheme(motion: Motion, scheme: str, *, dt: float) -> Run:
    """Compile the closed loop, run it once, and measure the motion."""
    steps = round(motion.duration / dt)

    def loop(q0):
        return rollout(
            motion.robot, q0, motion.tasks, scheme=make_scheme(scheme), limits=motion.limits, dt=dt, steps=steps
        )

    start = time.perf_counter()
    program = jax.jit(loop).lower(motion.q0).compile()
    compiled = time.perf_counter()
    trajectory = jax.block_until_ready(program(motion.q0))
    done = time.perf_counter()
    solution = trajectory.solution
    outcome = Outcome(
        compile_seconds=compiled - start,
        run_seconds=done - compiled,
        status=np.asarray(solution.status),
        iterations=np.asarray(solution.iterations),
        kkt_residual=np.asarray(solution.kkt_residual),
    )
    q = np.asarray(trajectory.q)
    return Run(scheme, q, np.asarray(solution.velocity), outcome, measure(motion, q, dt))


def run_demo(
    motion: Motion,
    out: str | Path,
    *,
    schemes: Sequence[str],
    dt: float = 0.005,
    animation: bool = True,
    renderer: RendererName = "auto",
    announce: Announce | None = None,
) -> tuple[dict, list[Run]]:
    """Run the schemes in turn and write ``comparison.png``, ``motion.npz``, ``report.json`` and a film.

    Args:
        motion: what to do.
        out: folder to write to; made if need be.
        schemes: names from ``SCHEMES``.
        dt: control period [s].
        animation: whether to write ``motion.gif`` (and ``motion.mp4`` where the program ffmpeg is installed) of the
            last scheme.
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
    share = (0.6 if animation else 0.9) / len(schemes)
    runs = []
    for number, scheme in enumerate(schemes):
        tell(f"{TITLES.get(scheme, scheme)}: compiling and running", share * number)
        runs.append(run_scheme(motion, scheme, dt=dt))
    tell("drawing the comparison", share * len(schemes))
    files = [_save_figure(motion, runs, folder), _save_arrays(runs, folder)]
    if animation:
        start = share * len(schemes) + 0.05
        files += film(motion, runs[-1], folder, dt, renderer, lambda x: tell("filming", start + (0.99 - start) * x))
    summary = report(motion, {run.scheme: (run.outcome, run.measurement) for run in runs}, dt=dt, files=files)
    write_report(summary, folder / "report.json")
    tell("done", 1.0)
    return summary, runs


def _save_arrays(runs: Sequence[Run], folder: Path) -> str:
    """Write time, q_SCHEME (steps + 1, nq) and v_SCHEME (steps, nv) of all schemes."""
    arrays = {"time": runs[0].measurement.time}
    for run in runs:
        key = run.scheme.replace("-", "_")
        arrays |= {f"q_{key}": run.q, f"v_{key}": run.v}
    np.savez_compressed(folder / "motion.npz", allow_pickle=False, **arrays)
    return "motion.npz"


def _save_figure(motion: Motion, runs: Sequence[Run], folder: Path) -> str:
    """Write the comparison plot without panels that have no data for this robot."""
    figure = compare_figure(
        runs[0].measurement.time,
        comparison_panels(motion, {TITLES[run.scheme]: run.measurement for run in runs}),
        title=f"{motion.title}: {', '.join(TITLES[run.scheme] for run in runs)}",
        note="All figures are recomputed from the configurations by MuJoCo's C code.",
        colors=SCHEME_COLORS,
    )
    figure.savefig(folder / "comparison.png")
    return "comparison.png"


def comparison_panels(motion: Motion, measured: dict[str, Measurement]) -> list[Panel]:
    """Return the panels of the comparison plot; lengths in mm."""
    label, goal = next(iter(motion.goals.items()))
    panels = []
    if motion.stances:
        drift = {name: 1e3 * _worst_drift(m) for name, m in measured.items()}
        panels.append(
            Panel("drift of the standing feet [mm]", drift, floor=1e-7 * motion.scale, **_wanted(0.1 * motion.scale))
        )
    error = {name: 1e3 * m.goals[label].position for name, m in measured.items()}
    title = f"{label.replace('_', ' ')} ({goal.frame}) from its path [mm]"
    panels.append(Panel(title, error, floor=1e-5 * motion.scale, **_wanted(motion.scale)))
    if motion.balanced:
        margin = {name: 1e3 * m.com_margin for name, m in measured.items()}
        panels.append(
            Panel(
                "centre of mass inside its support [mm]",
                margin,
                bound=0.0,
                above=True,
                span=motion.scale,
                bound_label="edge of the polygon",
            )
        )
    for title, values in (
        ("joint nearest to a position limit (1: mid-range)", {n: m.position_margin for n, m in measured.items()}),
        ("joint nearest to its top speed (1: at rest)", {n: m.velocity_margin for n, m in measured.items()}),
    ):
        panels.append(Panel(title, values, bound=0.0, above=True, bound_label="limit", span=0.1))
    return panels


def _wanted(bound: float) -> dict[str, Any]:
    """Return the options of the line at a required error [mm]."""
    return {"bound": bound, "bound_label": f"{bound:.2g} mm wanted"}


def _worst_drift(m: Measurement) -> np.ndarray:
    """Return the largest drift of the standing frames at each time [m]. (T,)."""
    return np.nanmax(np.stack([track.position for track in m.stances.values()]), 0)


def film(
    motion: Motion, run: Run, folder: Path, dt: float, renderer: RendererName, progress: Callable[[float], None]
) -> list[str]:
    """Write a film of a scheme's motion, with a curve of each goal's largest component."""
    names = ["motion.gif"] + (["motion.mp4"] if shutil.which("ffmpeg") else [])
    for name in names:
        animate(
            folder / name,
            motion.robot,
            run.q,
            dt=dt,
            renderer=renderer,
            look=motion.look,
            support=run.measurement.support or None,
            trails=[goal.frame for label, goal in motion.goals.items() if label != "waist"],
            curves=_film_curves(run.measurement, motion.scale),
            caption=f"{motion.title}: {TITLES[run.scheme]}",
            progress=progress,
        )
    return names


def draw_picture(motion: Motion, run: Run, path: str | Path, instants: Sequence[float] = (0.0, 0.26, 0.45)) -> Path:
    """Write a PNG with three instants of a motion side by side.

    Args:
        motion: the motion.
        run: the scheme's motion to show.
        path: the file to write.
        instants: as parts of the duration, 0 to 1.
    """
    shown = [round(part * (len(run.q) - 1)) for part in instants]
    support = [run.measurement.support[k] for k in shown] if run.measurement.support else None
    labels = [f"{run.measurement.time[k]:.1f} s" for k in shown]
    return hero_picture(path, motion.robot, [run.q[k] for k in shown], support=support, labels=labels, look=motion.look)


_DIRECTIONS = ("forward", "to the left", "up")


def _film_curves(m: Measurement, scale: float) -> Curves:
    """Return the curves of the largest component of up to two goals [mm]."""
    values, wanted = {}, {}
    for label in list(m.goals)[:2]:
        axis = int(np.argmax(np.ptp(m.wanted[label], axis=0)))
        name = f"{label.replace('_', ' ')} {_DIRECTIONS[axis]}"
        values[name], wanted[name] = 1e3 * m.displacement[label][:, axis], 1e3 * m.wanted[label][:, axis]
    return Curves("moved from the start [mm], dashed: wanted", values, wanted, span=scale)
