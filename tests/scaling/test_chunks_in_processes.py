"""Jobs in processes of their own, killed while they write, again and again."""

from __future__ import annotations

import signal

import numpy as np
import pytest
from other_processes import start

from osik_jax import scaling

JOB = """
import json, os, signal, sys
from pathlib import Path
import numpy as np
from osik_jax.scaling import run_in_chunks
folder, dies = Path(sys.argv[1]), int(sys.argv[2])
real, written = os.fsync, []
def fsync(file):  # every file goes to the disk through it
    written.append(file)
    if len(written) == dies:
        os.kill(os.getpid(), signal.SIGKILL)
    real(file)
os.fsync = fsync
def lanes(start, stop):
    return np.arange(start, stop, dtype=float)
square = lambda x, a: {"y": a * np.square(np.asarray(x))}
saved = run_in_chunks(square, lanes, count=64, chunk=8, shared=(3.0,), out=folder, progress=False)
print(json.dumps(bool(np.array_equal(saved[:]["y"], 3.0 * np.arange(64.0) ** 2))))
"""


@pytest.mark.release
def test_killed_again_and_again(tmp_path):
    """Each run dies while it writes its third file: a lock, a manifest or half a chunk is left and stops nobody."""
    folder, finished, kills = tmp_path / "job", {}, 0
    while (process := start(JOB, folder, 3)).communicate(timeout=300) and process.returncode == -signal.SIGKILL:
        kills += 1
        now = {path.name: (path.stat().st_mtime_ns, path.read_bytes()) for path in folder.glob("*.npz")}
        assert finished.items() < now.items()  # those before as they were, and more
        finished = now
        assert len(list(folder.glob(".*.partial"))) == 1 and (folder / ".lock").exists()
        assert kills < 8
    assert process.returncode == 0 and kills >= 3
    saved = scaling.load(folder)
    np.testing.assert_array_equal(saved[:]["y"], 3.0 * np.arange(64.0) ** 2)
    assert [path.name for path in folder.glob(".*")] == [".lock"]
    assert all((folder / name).stat().st_mtime_ns == then for name, (then, _) in finished.items())
