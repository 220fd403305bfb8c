"""Files of ``osik retarget``: of one clip, or of all clips of a folder, resumable after an interruption."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from .._errors import OsikValueError
from .._progress import Progress, reported
from .._whole_file import write_text
from ..scaling._fingerprint import differences, fingerprint, identifier
from ..scaling._folder import only_job
from ._load import ENDINGS, load_motion
from ._profile_file import profile_text, save_profile
from ._report import FIGURES, picked, report
from ._retarget import Clip, Retargeter
from ._retargeted import Retargeted
from ._skeletons import shortened
from ._up import Up

_JOB = "job.json"


def write_folder(result: Retargeted, name: str, out: Path) -> dict[str, Any]:
    """Write motion (.npz and .csv), report and profile to an existing folder; return the report."""
    save_profile(result.profile, out / "profile.toml")
    return _write_motion(result, {"clip": name}, out)


def _write_motion(result: Retargeted, source: dict[str, str], out: Path) -> dict[str, Any]:
    """Write ``motion.npz``, ``motion.csv`` and, last of all, ``report.json``; return the report."""
    figures = {**source, **report(result)}
    result.save(out / "motion.npz")
    result.motion.save_csv(out / "motion.csv")
    _write_json(figures, out / "report.json")
    return figures


def _write_json(figures: dict[str, Any], path: Path) -> None:
    """Write a JSON file, so that a file of this name is always complete."""
    write_text(path, json.dumps(figures, indent=2, allow_nan=False) + "\n")


def retarget_folder(
    retargeter: Retargeter,
    folder: Path,
    out: Path,
    *,
    unit: str | float | None = None,
    up: Up | None = None,
    mapping: Mapping[str, str] | None = None,
    fps: float | None = None,
    chunk: int = 32,
    progress: Progress = True,
) -> dict[str, Any]:
    """Retarget every ``.bvh`` and ``.npz`` file directly inside a folder.

    Each clip gets a folder of its own name in ``out``, with ``motion.npz``, ``motion.csv`` and ``report.json``. ``out``
    also holds ``profile.toml``, ``job.json`` (the job's options), the summary ``report.json``, and ``index.csv`` with
    one line of figures and notes per clip. Finished clips of the same file and options are kept. A clip that cannot be
    read is listed in the summary with its error, and tried again in the next run.

    Args:
        retargeter: the retargeter of the robot.
        folder: folder of the clips; folders inside it are not searched.
        out: output folder.
        unit, up: as of ``load_motion``; ``unit`` is that of the BVH files.
        mapping, fps: as of ``Retargeter.retarget``, the same for all clips.
        chunk: number of clips per batch on a GPU; on a CPU each core works on one clip.
        progress: whether to show a bar; or a function of the numbers of finished clips and of all clips.

    Returns:
        the summary: ``clips`` (number finished), ``frames``, ``worst`` (the largest value of each figure), ``failed``
        (error by clip), ``notes`` (those of ``report``, by clip), ``figures`` (by clip) and ``no_clips`` (names of
        files with other endings, and of folders).

    Raises:
        ValueError: no clips in the folder, or ``out`` has another job in it; the message says what differs.
        BlockingIOError: another process works in ``out``.
        OSError: something cannot be written.
    """
    files, others = _clips_in(folder)
    others = [name for name in others if folder / name != out]
    job = _job(retargeter, {"mapping": mapping, "fps": fps, "unit": unit, "up": up})
    with only_job(out):
        _claim(out, job)
        save_profile(retargeter.profile, out / "profile.toml")
        sources = {name: _source(path, job) for name, path in files.items()}
        finished = {name: _finished(out / name, of) for name, of in sources.items()}
        found = {name: figures for name, figures in finished.items() if figures is not None}
        failed: dict[str, str] = {}
        # longest first, so that no core waits for a long clip at the end
        todo = sorted((name for name in files if name not in found), key=lambda name: -files[name].stat().st_size)

        def finish(number: int, make: Callable[[], Retargeted]) -> None:
            name = todo[number]
            try:
                result = make()
            except Exception as error:  # a broken file may raise anything in a reader; the job goes on with other clips
                failed[name] = _reason(error)
                return
            (out / name).mkdir(exist_ok=True)
            found[name] = _write_motion(result, {"clip": name, **sources[name]}, out / name)

        def read(name: str) -> Clip:
            path = files[name]
            motion = load_motion(path, unit=unit if path.suffix.lower() == ".bvh" else None, up=up)
            return retargeter._prepared(motion, mapping, fps)

        with (
            reported(len(files), len(found), progress, "clips") as advance,
            contextlib.closing(retargeter._each([partial(read, name) for name in todo], finish, chunk)) as each,
        ):
            for _ in each:
                advance(1)
        summary = {**_summary(found, failed, [*files]), "no_clips": others}
        _write_json(summary, out / "report.json")
        with (out / "index.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(_index(summary))
    return summary


def _clips_in(folder: Path) -> tuple[dict[str, Path], list[str]]:
    """Return the motion files of a folder by clip name, and the names of what else is in it.

    A clip's name is the file's, without its ending unless two would clash. Hidden files are not named.
    """
    inside = [path for path in sorted(folder.iterdir()) if not path.name.startswith(".")]
    files = [path for path in inside if path.is_file() and path.suffix.lower() in ENDINGS]
    others = [path.name + "/" * path.is_dir() for path in inside if path not in files]
    if not files:
        seen = shortened([path.name for path in inside]) or "nothing"
        raise OsikValueError(f"{folder} has no clips ({', '.join(ENDINGS)}); in it: {seen}")
    stems = [path.stem for path in files]
    return {path.stem if stems.count(path.stem) == 1 else path.name: path for path in files}, others


def _job(retargeter: Retargeter, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return all inputs of the results other than the clips, for comparison with an earlier job."""
    most = np.asarray(retargeter.limits[2].acceleration)
    finite = np.unique(most[np.isfinite(most)])
    return {
        "version": version("osik-jax"),
        "precision": str(np.asarray(retargeter.robot.q0).dtype),
        "robot": identifier(fingerprint(retargeter.robot)),
        "profile": identifier({"text": profile_text(retargeter.profile)}),
        "acceleration": finite[0].item() if len(finite) == 1 else identifier(fingerprint(most)),
        "smoothness": float(retargeter.smoothness),
        "balance": retargeter.balance,
        "max_iterations": int(retargeter.max_iterations),
        **options,
    }


def _claim(out: Path, job: dict[str, Any]) -> None:
    """Mark a folder as belonging to a job, or raise ValueError if it belongs to another."""
    path = out / _JOB
    old = _read(path)
    changed = differences(old, json.loads(json.dumps(job))) if old else []
    if changed:
        raise OsikValueError(f"{out} has another job in it; name another folder. What differs: {'; '.join(changed)}")
    _write_json(job, path)


def _source(path: Path, job: dict[str, Any]) -> dict[str, str]:
    """Return a clip's file name, content hash and job identifier."""
    try:
        content = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    except OSError:  # reported when the clip is read
        content = ""
    return {"source": path.name, "sha256": content, "job": identifier(job)}


def _finished(folder: Path, source: dict[str, str]) -> dict[str, Any] | None:
    """Return the report of a finished clip, or None if there is none for this file and job."""
    figures = _read(folder / "report.json") or {}
    try:
        picked(figures)
    except (KeyError, TypeError):
        return None
    return figures if source.items() <= figures.items() else None


def _read(path: Path) -> dict[str, Any] | None:
    """Return the object in a JSON file, or None if there is none."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def _reason(error: Exception) -> str:
    """Return an exception's message on one line; prefixed with its type unless an OSError, ValueError or KeyError."""
    text = " ".join(str(error.args[0] if isinstance(error, KeyError) and error.args else error).split())
    return text if text and isinstance(error, OSError | ValueError | KeyError) else f"{type(error).__name__}: {text}"


def _summary(found: Mapping[str, dict[str, Any]], failed: Mapping[str, str], order: Sequence[str]) -> dict[str, Any]:
    """Return the summary of ``retarget_folder``, clips in the given order."""
    figures = {name: found[name] for name in order if name in found}
    rows = {name: {"frames": own["frames"], "fps": own["fps"], **picked(own)} for name, own in figures.items()}
    seen = {key: [row[key] for row in rows.values() if row[key] is not None] for key in FIGURES}
    return {
        "clips": len(rows),
        "frames": sum(row["frames"] for row in rows.values()),
        "worst": {key: max(values) for key, values in seen.items() if values},
        "failed": {name: failed[name] for name in order if name in failed},
        "notes": {name: own["notes"] for name, own in figures.items() if own.get("notes")},
        "figures": rows,
    }


def _index(summary: dict[str, Any]) -> list[list[Any]]:
    """Return a row of headings, and one row per clip with its figures and notes; clips with notes come first."""
    notes: dict[str, list[str]] = summary["notes"]
    rows: list[list[Any]] = [["clip", "look at", "frames", "fps", *FIGURES]]
    rows += [[name, reason] for name, reason in summary["failed"].items()]
    for name in sorted(summary["figures"], key=lambda name: name not in notes):
        rows.append([name, "; ".join(notes.get(name, ())), *summary["figures"][name].values()])
    return rows
