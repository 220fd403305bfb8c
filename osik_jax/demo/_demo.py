"""Run of a motion with each scheme, and its output files."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from ..viewer import animate
from ._figures import figures, table
from ._motion import Motion
from ._run import TITLES, Run, run_scheme

_DIRECTIONS = ("forward", "to the left", "up")


def run_demo(
    motion: Motion,
    folder: Path,
    *,
    schemes: Sequence[str],
    dt: float = 0.005,
    animation: bool = True,
    announce: Callable[[str], None] = lambda stage: None,
) -> tuple[Table, Sequence[Run]]:
    """Run the schemes in turn and write ``motion.npz`` and a film.

    Return the table of all figures, and the runs. The film is that of the last scheme, ``motion.gif``, and
    ``motion.mp4`` where the program ffmpeg is installed. ``announce`` is called with the current stage. ``motion.npz``
    has the time and, of each scheme, q_SCHEME (steps + 1, nq) and v_SCHEME (steps, nv).

    Raises:
        KeyError: no such scheme.
    """
    folder.mkdir(parents=True, exist_ok=True)
    runs, arrays = [], {}
    for scheme in schemes:
        announce(f"{TITLES.get(scheme, scheme)}: compiling and running")
        runs.append(run := run_scheme(motion, scheme, dt=dt))
        name = scheme.replace("-", "_")
        arrays |= {"time": run.seen.time, f"q_{name}": run.q, f"v_{name}": run.solution.velocity}
    np.savez_compressed(folder / "motion.npz", allow_pickle=False, **arrays)
    if animation:
        announce("filming")
        for name in ["motion.gif", "motion.mp4"] if shutil.which("ffmpeg") else ["motion.gif"]:
            _film(folder / name, motion, runs[-1], dt)
    return table(motion.title, {run.scheme: figures(motion, run) for run in runs}), runs


def _film(path: Path, motion: Motion, run: Run, dt: float) -> None:
    """Write a film of a scheme's motion, with a curve of the largest component of up to two goals [mm]."""
    seen, values, wanted = run.seen, {}, {}
    for label in list(motion.goals)[:2]:
        axis = int(np.argmax(np.ptp(seen.wanted[label], axis=0)))
        name = f"{label.replace('_', ' ')} {_DIRECTIONS[axis]}"
        values[name], wanted[name] = 1e3 * seen.moved[label][:, axis], 1e3 * seen.wanted[label][:, axis]
    animate(
        path,
        motion.robot,
        run.q,
        dt=dt,
        support=seen.support or None,
        trails=[goal.frame for label, goal in motion.goals.items() if label != "waist"],
        curves=values,
        wanted=wanted,
        curves_title="moved from the start [mm], dashed: wanted",
        caption=f"{motion.title}: {TITLES[run.scheme]}",
    )
