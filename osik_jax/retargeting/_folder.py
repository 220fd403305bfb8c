"""What ``osik retarget FOLDER`` does: every clip of a folder; a job that was killed goes on where it was."""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from .._errors import OsikValueError
from ..execution._workers import cores
from ..scaling._fingerprint import differences, fingerprint, identifier
from ..scaling._lock import only_job
from ..scaling._progress import Progress, reported
from ._command import write_json, write_motion
from ._lanes import Clip, one_a_core, shared_length
from ._load import Reader, clips_in
from ._profile_file import profile_text, save_profile
from ._report import report
from ._retarget import Retargeter, Source

FIGURES = {
    "off_plan_rad": ("off_plan_rad",),
    "beyond_range_max": ("joints", "beyond_range_max"),
    "speed_over_limit_max": ("joints", "speed_over_limit_max"),
    "acceleration_max": ("joints", "acceleration_max"),
    "acceleration_rms": ("joints", "acceleration_rms"),
    "jerk_rms": ("joints", "jerk_rms"),
    "slip_mm_max": ("feet", "slip_mm_max"),
    "float_mm_max": ("feet", "float_mm_max"),
    "below_floor_mm_max": ("feet", "below_floor_mm_max"),
    "penetration_mm_max": ("shapes", "penetration_mm_max"),
    "limb_error_mm_mean": ("tracking", "limb_error_mm_mean"),
    "segment_angle_deg_mean": ("tracking", "segment_angle_deg_mean"),
}
"""What the summary has of each clip's report, and where that is."""
_JOB = "job.json"
_COMPILING = 30_000
"""Frames that a CPU plans in the time that it takes to compile a program."""


def retarget_folder(
    retargeter: Retargeter,
    folder: Path,
    out: Path,
    reader: Reader | None = None,
    *,
    mapping: Mapping[str, str] | None = None,
    fps: float | None = None,
    chunk: int = 32,
    progress: Progress = True,
) -> dict[str, Any]:
    """Retargets every ``.bvh``, ``.amc``, ``.npz`` and ``.csv`` of a folder, those in its folders left out.

    Each clip gets a folder of its own name in ``out``, with ``motion.npz``, ``motion.csv`` and ``report.json``; beside
    them are ``profile.toml``, ``job.json`` (what the job was started with), the summary, ``report.json``, and
    ``index.csv``, a line for each clip with its figures and what there is to look at. Clips that
    are there already, of the same file and the same options, are left as they are. A clip that cannot be read is named
    in the summary with its error, and tried again the next time.

    Args:
        retargeter: for the robot.
        folder: with the clips.
        out: where to.
        reader: reads a clip. None: as ``load_motion`` does.
        mapping: as of ``Retargeter.retarget``, the same for all.
        fps: as of ``Retargeter.retarget``, the same for all.
        chunk: clips that a GPU works on at once; on a CPU each core works on one.
        progress: whether to show a bar; or a function of the number of clips that are done and of all.

    Returns:
        the summary: ``clips`` (how many are finished), ``frames``, ``worst`` (the largest value of each figure),
        ``failed`` (error by clip), ``notes`` (what ``report`` says in words, by clip) and ``figures`` (by clip).

    Raises:
        ValueError: no clips in the folder, or ``out`` has another job in it; the message says what differs.
        BlockingIOError: another process works in ``out``.
        OSError: something cannot be written.
    """
    files, reader = clips_in(folder), Reader() if reader is None else reader
    job = _job(retargeter, {"mapping": mapping, "fps": fps, **reader.options()})
    with only_job(out):
        _claim(out, job)
        save_profile(retargeter.profile, out / "profile.toml")
        work = _Work(retargeter, out, {name: _source(path, job) for name, path in files.items()}, chunk)
        with reported(len(files), len(work.found), progress, "clips") as advance:
            # the longest first: what is compiled for them does for shorter ones too
            todo = [name for name in files if name not in work.found]
            for name in sorted(todo, key=lambda name: -files[name].stat().st_size):
                advance(work.add(name, partial(reader, files[name]), mapping, fps))
            for done in work.rest():
                advance(done)
        summary = _summary(work.found, work.failed, [*files])
        write_json(summary, out / "report.json")
        _write_index(summary, out / "index.csv")
    return summary


class _Work:
    """What is finished, what failed, and what was read and waits for others of its length.

    Attributes:
        found: the reports of clips that are finished, by name.
        failed: what is wrong with others.
    """

    def __init__(self, retargeter: Retargeter, out: Path, sources: Mapping[str, dict[str, str]], chunk: int):
        self._retargeter, self._out, self._sources = retargeter, out, sources
        self.found = {name: own for name, of in sources.items() if (own := _finished(out / name, of)) is not None}
        self.failed: dict[str, str] = {}
        self._lanes = cores() if one_a_core() else min(chunk, max(1, len(sources) - len(self.found)))
        self._lengths = _Lengths()
        self._waiting: dict[int, list[tuple[str, Clip]]] = {}

    def add(
        self,
        name: str,
        read: Callable[[], Source],
        mapping: Mapping[str, str] | None,
        fps: float | None,
    ) -> int:
        """Reads a clip, and retargets it if it has no others to wait for; returns how many clips are done by that."""
        try:
            clip = self._retargeter._prepared(read(), mapping, fps)
        except Exception as error:  # whatever a broken file leads a reader to: it does not end the others
            self.failed[name] = _reason(error)
            return 1
        length = self._lengths.of(shared_length(clip))
        waiting = self._waiting.setdefault(length, [])
        waiting.append((name, clip))
        return self._finish(length, self._waiting.pop(length)) if len(waiting) == self._lanes else 0

    def rest(self) -> Iterator[int]:
        """Retargets what waits, those of a length at once; yields how many they are."""
        for length, waiting in self._waiting.items():
            yield self._finish(length, waiting)

    def _finish(self, length: int, clips: list[tuple[str, Clip]]) -> int:
        made = self._retargeter._solved([clip for _, clip in clips], length, self._lanes)
        for (name, _), record in zip(clips, made, strict=True):
            try:
                result = record()
            except ValueError as error:
                self.failed[name] = _reason(error)
                continue
            self.found[name] = {"clip": name, **self._sources[name], **report(result)}
            (self._out / name).mkdir(exist_ok=True)
            write_motion(result, self.found[name], self._out / name)
        return len(clips)


class _Lengths:
    """For how many frames programs are compiled.

    A clip takes one that is longer and is there, until what clips of its length have wasted so adds up to compiling.
    """

    def __init__(self) -> None:
        self._compiled: set[int] = set()
        self._wasted: dict[int, int] = {}

    def of(self, own: int) -> int:
        """The number of frames that a clip of so many is filled up to."""
        longer = min((length for length in self._compiled if length >= own), default=own)
        wasted = self._wasted.get(own, 0) + longer - own
        if wasted > _COMPILING:
            longer, wasted = own, 0
        self._wasted[own] = wasted
        self._compiled.add(longer)
        return longer


def _job(retargeter: Retargeter, options: Mapping[str, Any]) -> dict[str, Any]:
    """What the results depend on, but for the clips."""
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
    """Makes a folder that of a job, or raises ValueError where it is that of another."""
    path = out / _JOB
    old = _read(path)
    changed = differences(old, json.loads(json.dumps(job))) if old else []
    if changed:
        raise OsikValueError(f"{out} has another job in it; name another folder. What differs: {'; '.join(changed)}")
    write_json(job, path)


def _source(path: Path, job: dict[str, Any]) -> dict[str, str]:
    """Which file a clip is, what is in it, and which job it is worked on in."""
    try:
        content = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    except OSError:  # said when it is its turn to be read
        content = ""
    return {"source": path.name, "sha256": content, "job": identifier(job)}


def _finished(folder: Path, source: dict[str, str]) -> dict[str, Any] | None:
    """The report of a clip that is there already; None where it is not, or of another file or job."""
    figures = _read(folder / "report.json") or {}
    try:
        _picked(figures)
    except (KeyError, TypeError):
        return None
    return figures if source.items() <= figures.items() else None


def _read(path: Path) -> dict[str, Any] | None:
    """An object in a file of JSON; None where there is none."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def _reason(error: Exception) -> str:
    """What an exception says, in one line; with its type, where it is not of those that say what is wrong."""
    text = " ".join(str(error.args[0] if isinstance(error, KeyError) and error.args else error).split())
    return text if text and isinstance(error, OSError | ValueError | KeyError) else f"{type(error).__name__}: {text}"


def _summary(found: Mapping[str, dict[str, Any]], failed: Mapping[str, str], order: Sequence[str]) -> dict[str, Any]:
    """What ``retarget_folder`` returns, clips in this order."""
    figures = {name: found[name] for name in order if name in found}
    rows = {name: {"frames": own["frames"], "fps": own["fps"], **_picked(own)} for name, own in figures.items()}
    seen = {key: [row[key] for row in rows.values() if row[key] is not None] for key in FIGURES}
    return {
        "clips": len(rows),
        "frames": sum(row["frames"] for row in rows.values()),
        "worst": {key: max(values) for key, values in seen.items() if values},
        "failed": {name: failed[name] for name in order if name in failed},
        "notes": {name: own["notes"] for name, own in figures.items() if own.get("notes")},
        "figures": rows,
    }


def _write_index(summary: dict[str, Any], path: Path) -> None:
    """Write a line for each clip: its figures, and what there is to look at; clips to look at come first."""
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["clip", "look at", "frames", "fps", *FIGURES])
        table.writerows([name, reason] for name, reason in summary["failed"].items())
        notes: dict[str, list[str]] = summary["notes"]
        for name in sorted(summary["figures"], key=lambda name: name not in notes):
            row = summary["figures"][name]
            table.writerow([name, "; ".join(notes.get(name, ())), *(row[key] for key in ("frames", "fps", *FIGURES))])


def _picked(figures: Any) -> dict[str, float | None]:
    """The figures of a report that the summary has."""
    out = {}
    for name, path in FIGURES.items():
        value = figures
        for key in path:
            value = value[key]
        out[name] = value
    return out
