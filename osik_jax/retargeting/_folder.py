"""Implementation of ``osik retarget FOLDER``: all clips of a folder, resumable after an interruption."""

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
from .._progress import Progress, reported
from ..execution._platform import cpu_is_default
from ..execution._workers import cores
from ..scaling._fingerprint import differences, fingerprint, identifier
from ..scaling._folder import only_job
from ._command import write_json, write_motion
from ._lanes import Clip, shared_length
from ._load import Reader, clips_in
from ._page import write_index
from ._profile import Limb
from ._profile_file import find_profile, profile_text, save_profile
from ._report import FIGURES, picked, report
from ._retarget import Retargeter, Source

_JOB = "job.json"
_COMPILING = 30_000
"""Frames that a CPU plans in the time of one compilation."""


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
    page: bool = False,
) -> dict[str, Any]:
    """Retarget every ``.bvh``, ``.amc``, ``.npz`` and ``.csv`` file directly inside a folder.

    Each clip gets a folder of its own name in ``out``, with ``motion.npz``, ``motion.csv`` and ``report.json``. ``out``
    also holds ``profile.toml``, ``job.json`` (the job's options), the summary ``report.json``, and ``index.csv`` with
    one line of figures and notes per clip. Finished clips of the same file and options are kept. A clip that cannot be
    read is listed in the summary with its error, and tried again in the next run.

    Args:
        retargeter: the retargeter of the robot.
        folder: folder of the clips; folders inside it are not searched.
        out: output folder.
        reader: function that reads a clip. None: as ``load_motion`` does.
        mapping: as of ``Retargeter.retarget``, the same for all clips.
        fps: as of ``Retargeter.retarget``, the same for all clips.
        chunk: number of clips per batch on a GPU; on a CPU each core works on one clip.
        progress: whether to show a bar; or a function of the numbers of finished clips and of all clips.
        page: whether each clip gets a page, ``report.html``, and ``out`` an ``index.html`` with links to them.

    Returns:
        the summary: ``clips`` (number finished), ``frames``, ``worst`` (the largest value of each figure), ``failed``
        (error by clip), ``notes`` (those of ``report``, by clip), ``figures`` (by clip) and ``no_clips`` (names of
        files with other endings, and of folders).

    Raises:
        ValueError: no clips in the folder, or ``out`` has another job in it; the message says what differs.
        BlockingIOError: another process works in ``out``.
        OSError: something cannot be written.
    """
    (files, others), reader = clips_in(folder), Reader() if reader is None else reader
    others = [name for name in others if folder / name != out]
    if reader.source is not None:
        retargeter = retargeter._led_by(reader.profile or find_profile(reader.source))
    job = _job(retargeter, {"mapping": mapping, "fps": fps, **reader.options()})
    with only_job(out):
        _claim(out, job)
        save_profile(retargeter.profile, out / "profile.toml")
        sources = {name: _source(path, job) for name, path in files.items()}
        work = _Work(retargeter, out, sources, chunk, page)
        with reported(len(files), len(work.found), progress, "clips") as advance:
            # longest first: shorter clips can then use the program compiled for longer ones
            todo = [name for name in files if name not in work.found]
            for name in sorted(todo, key=lambda name: -files[name].stat().st_size):
                advance(work.add(name, partial(reader.in_folder, files[name]), mapping, fps))
            for done in work.rest():
                advance(done)
        summary = {**_summary(work.found, work.failed, [*files]), "no_clips": others}
        write_json(summary, out / "report.json")
        with (out / "index.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(_index(summary))
        if page:
            write_index(summary, out / "index.html")
    return summary


class _Work:
    """Progress of a folder job: finished and failed clips, and clips that wait for others of the same length.

    Attributes:
        found: reports of finished clips by name.
        failed: error messages of failed clips by name.
    """

    def __init__(
        self,
        retargeter: Retargeter,
        out: Path,
        sources: Mapping[str, dict[str, str]],
        chunk: int,
        page: bool,
    ):
        self._retargeter, self._out, self._sources, self._page = retargeter, out, sources, page
        found = {name: _finished(out / name, of, page) for name, of in sources.items()}
        self.found = {name: own for name, own in found.items() if own is not None}
        self.failed: dict[str, str] = {}
        self._lanes = cores() if cpu_is_default() else min(chunk, max(1, len(sources) - len(self.found)))
        self._lengths = _Lengths()
        self._waiting: dict[tuple[int, tuple[Limb, ...]], list[tuple[str, Clip]]] = {}

    def add(
        self,
        name: str,
        read: Callable[[], Source],
        mapping: Mapping[str, str] | None,
        fps: float | None,
    ) -> int:
        """Read a clip; retarget it with the waiting clips once a batch is full; return the number finished."""
        try:
            clip = self._retargeter._prepared(read(), mapping, fps)
        except Exception as error:  # a broken file may raise anything in a reader; the job goes on with other clips
            self.failed[name] = _reason(error)
            return 1
        length = self._lengths.of(shared_length(clip))
        alike = length, clip.touching
        waiting = self._waiting.setdefault(alike, [])
        waiting.append((name, clip))
        return self._finish(length, self._waiting.pop(alike)) if len(waiting) == self._lanes else 0

    def rest(self) -> Iterator[int]:
        """Retarget all waiting clips, one batch per length; yield the number finished."""
        for (length, _), waiting in self._waiting.items():
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
            write_motion(result, self.found[name], self._out / name, self._page)
        return len(clips)


class _Lengths:
    """Frame counts for which programs are compiled.

    A clip uses the next longer compiled length, until the padding of its length adds up to the cost of a compilation.
    """

    def __init__(self) -> None:
        self._compiled: set[int] = set()
        self._wasted: dict[int, int] = {}

    def of(self, own: int) -> int:
        """Return the number of frames to which a clip of ``own`` frames is padded."""
        longer = min((length for length in self._compiled if length >= own), default=own)
        wasted = self._wasted.get(own, 0) + longer - own
        if wasted > _COMPILING:
            longer, wasted = own, 0
        self._wasted[own] = wasted
        self._compiled.add(longer)
        return longer


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
    write_json(job, path)


def _source(path: Path, job: dict[str, Any]) -> dict[str, str]:
    """Return a clip's file name, content hash and job identifier."""
    try:
        content = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    except OSError:  # reported when the clip is read
        content = ""
    return {"source": path.name, "sha256": content, "job": identifier(job)}


def _finished(folder: Path, source: dict[str, str], page: bool) -> dict[str, Any] | None:
    """Return the report of a finished clip, or None if there is none for this file and job, or lacks its ``page``."""
    figures = _read(folder / "report.json") or {}
    try:
        picked(figures)
    except (KeyError, TypeError):
        return None
    whole = source.items() <= figures.items() and ((folder / "report.html").exists() or not page)
    return figures if whole else None


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
