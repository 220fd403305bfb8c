"""The parent's side of ``worker.py``: peers in processes of their own that take turns."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Generator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

ROOT = Path(__file__).parent.parent
ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
"""Peers' linear algebra is small: threads only cost. XLA's own pool is left alone."""


class PeerUnavailable(RuntimeError):
    """A peer did not start; the message says why."""


@dataclass(frozen=True)
class Entrant:
    """What takes part in a run.

    Attributes:
        name: shown in tables.
        peer: a name in ``peers.PEERS``.
        options: of its runner.
        cores: to which its processes are pinned, one each; none: one process with all cores.
    """

    name: str
    peer: str
    options: Mapping[str, Any] = field(default_factory=dict)
    cores: tuple[int, ...] = ()

    @property
    def robots(self) -> int:
        """Robots that take a step together, in all its processes."""
        return max(len(self.cores), 1) * (self.options.get("batch") or 1)


class Worker:
    """One process that runs a peer; what it said of itself is in ``hello``."""

    def __init__(self, process: subprocess.Popen[str], errors: TextIO) -> None:
        assert process.stdin is not None and process.stdout is not None
        self._process, self._errors = process, errors
        self._questions, self._answers = process.stdin, process.stdout
        self.hello = self.receive()

    def send(self, **question: Any) -> None:
        """Asks without waiting."""
        print(json.dumps(question), file=self._questions, flush=True)

    def receive(self) -> dict[str, Any]:
        """The next answer.

        Raises:
            PeerUnavailable: the process has ended; the message is its last line.
        """
        line = self._answers.readline()
        if line:
            return json.loads(line)
        self._process.wait()
        self._errors.seek(0)
        said = [text for text in self._errors.read().splitlines() if text.strip()]
        raise PeerUnavailable(said[-1] if said else "it ended without a word")

    def ask(self, **question: Any) -> dict[str, Any]:
        """An answer to a question."""
        self.send(**question)
        return self.receive()


@contextmanager
def started(
    peer: str, options: Mapping[str, Any], *, workload: Path, python: str, cache: Path
) -> Generator[Worker, None, None]:
    """A worker that ends with the context.

    Args:
        peer: a name in ``peers.PEERS``.
        options: of its runner, and ``core``.
        workload: file of the workload.
        python: its interpreter.
        cache: folder of compiled programs, of JAX, and of Warp for mink-warp.

    Raises:
        PeerUnavailable: it did not come up.
    """
    settings = {
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "WARP_CACHE_PATH": str(cache / "warp"),
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",  # several processes share a GPU
        "PYTHONPATH": os.pathsep.join([str(ROOT), *_own_path(python)]),
    }
    command = [python, "-m", "benchmarks.worker", peer, str(workload), json.dumps(dict(options))]
    environment = {**os.environ, **ONE_THREAD, **settings}
    pipe = subprocess.PIPE
    with tempfile.TemporaryFile("w+", encoding="utf-8") as errors:
        try:
            process = subprocess.Popen(
                command, stdin=pipe, stdout=pipe, stderr=errors, text=True, cwd=ROOT, env=environment
            )
        except OSError as reason:
            raise PeerUnavailable(str(reason)) from reason
        with process:
            yield Worker(process, errors)


def _own_path(python: str) -> list[str]:
    """Where this process looks for packages, if a peer has no environment of its own."""
    given = os.environ.get("PYTHONPATH", "")
    return given.split(os.pathsep) if given and python == sys.executable else []


class Team:
    """The processes of an entrant, which all do the same at once."""

    def __init__(self, entrant: Entrant, *, workload: Path, pythons: Mapping[str, str], cache: Path) -> None:
        self.entrant = entrant
        places = [dict(core=core) for core in entrant.cores] or [{}]
        python = pythons.get(entrant.peer, sys.executable)
        with ExitStack() as stack:
            self.workers = [
                stack.enter_context(
                    started(entrant.peer, {**entrant.options, **place}, workload=workload, python=python, cache=cache)
                )
                for place in places
            ]
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Ends the processes."""
        self._stack.close()

    def ask(self, **question: Any) -> list[dict[str, Any]]:
        """Answers of all processes, which work at the same time."""
        for worker in self.workers:
            worker.send(**question)
        return [worker.receive() for worker in self.workers]


def cores(most: int | None = None) -> tuple[int, ...]:
    """The last cores that this process may use, all without a number; the first ones serve the system."""
    available = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    return tuple(available[-most:] if most else available)
