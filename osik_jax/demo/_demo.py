"""Run of a motion with each scheme, and its output files."""

from __future__ import annotations

import dataclasses
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from ..viewer import animate, hero_picture
from ._figures import comparison, figures, table
from ._motion import Motion
from ._physics import PhysicsRun, run_physics
from ._run import TITLES, Run, run_scheme

_DIRECTIONS = ("forward", "to the left", "up")
_PICTURES = 12_000_000
"""Upper bound of the size of film, figure, picture and report [bytes]."""


def writable_folder(path: Path, motion: Motion, *, schemes: int, dt: float) -> Path:
    """Create the folder and check that the files can be written to it, the motion counted without compression."""
    path.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryFile(dir=path) as file:
            file.write(b"\0" * 4096)
            file.flush()
    except OSError as error:
        raise OSError(f"cannot write to {path}: {error.strerror or error}") from error
    entries = 1 + schemes * (motion.robot.nq + motion.robot.nv)
    free, needed = shutil.disk_usage(path).free, _PICTURES + 8 * (round(motion.duration / dt) + 1) * entries
    if free < needed:
        raise OSError(f"{path} has {free / 1e6:.1f} MB of room left, and up to {needed / 1e6:.0f} MB are needed")
    return path


def run_demo(
    motion: Motion,
    folder: Path,
    *,
    schemes: Sequence[str],
    dt: float = 0.005,
    physics: bool = False,
    animation: bool = True,
    picture: bool = False,
    announce: Callable[[str, float], None] = lambda stage, done: None,
) -> tuple[Table, Sequence[Run]]:
    """Run the schemes in turn and write ``comparison.png``, ``motion.npz`` and a film.

    Return the table of all figures, and the runs. With ``physics`` the loop is closed with MuJoCo; the motion is then
    one of NAO. The film is that of the last scheme, ``motion.gif``, and ``motion.mp4`` where the program ffmpeg is
    installed. ``picture`` adds ``picture.png``, three instants side by side. ``announce`` is called with the current
    stage and the finished share, 0 to 1.

    Raises:
        KeyError: no such scheme.
    """
    folder.mkdir(parents=True, exist_ok=True)
    run, doing = run_scheme, "compiling and running"
    if physics:
        run, doing = run_physics, "planning, then simulating"
        motion = dataclasses.replace(motion, title=f"{motion.title}, with dynamics")
    share, runs = (0.6 if animation else 0.9) / len(schemes), []
    for scheme in schemes:
        announce(f"{TITLES.get(scheme, scheme)}: {doing}", share * len(runs))
        runs.append(run(motion, scheme, dt=dt))
    start = share * len(runs)
    announce("drawing the comparison", start)
    found = {run.scheme: figures(motion, run) for run in runs}
    comparison(motion.title, found, dt).savefig(folder / "comparison.png")
    np.savez_compressed(folder / "motion.npz", allow_pickle=False, **_arrays(runs))
    if animation:
        names = ["motion.gif", "motion.mp4"] if shutil.which("ffmpeg") else ["motion.gif"]
        for name in names:
            _film(folder / name, motion, runs[-1], dt, lambda x: announce("filming", start + 0.35 * x))
    if picture:
        announce("drawing the picture", 0.97)
        _draw_picture(folder / "picture.png", motion, runs[-1])
    announce("done", 1.0)
    return table(motion.title, found), runs


def _arrays(runs: Sequence[Run]) -> dict[str, np.ndarray]:
    """Return the arrays of ``motion.npz``: time, and of each scheme q_SCHEME (steps + 1, nq) and v_SCHEME (steps, nv).

    With dynamics, of each scheme: time, q (sensed), plan, command, effort, com, contact_points and contact_forces.
    """
    arrays: dict[str, np.ndarray] = {}
    for run in runs:
        if isinstance(run, PhysicsRun):
            names = ("time", "q", "command", "effort", "com", "contact_points", "contact_forces")
            parts = {name: getattr(run.recording, name) for name in names} | {"plan": run.plan.q}
        else:
            arrays["time"] = run.seen.time
            parts = {"q": run.q, "v": run.solution.velocity}
        arrays |= {f"{name}_{run.scheme.replace('-', '_')}": np.asarray(value) for name, value in parts.items()}
    return arrays


def _film(path: Path, motion: Motion, run: Run, dt: float, progress: Callable[[float], None]) -> None:
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
        progress=progress,
    )


def _draw_picture(path: Path, motion: Motion, run: Run) -> None:
    """Write a PNG with three instants of a motion side by side."""
    shown = [round(part * (len(run.q) - 1)) for part in (0.0, 0.26, 0.45)]
    support = [run.seen.support[k] for k in shown] if run.seen.support else None
    labels = [f"{run.seen.time[k]:.1f} s" for k in shown]
    hero_picture(path, motion.robot, [run.q[k] for k in shown], support=support, labels=labels)
