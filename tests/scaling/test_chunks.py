"""What can happen to the folder of a job: damage, files of other jobs, a full disk, two processes, Ctrl-C."""

from __future__ import annotations

import errno
import gc
import json
import os
import shutil
import warnings
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.core import Tracer
from refusals import refuses
from small_files import files_of_at_most

from osik_jax import scaling
from osik_jax._progress import Pace
from osik_jax.scaling._chunk_file import DamagedFile, Part, check_chunk, read_chunk

X = np.arange(20.0)
program = jax.jit(lambda x, a: {"square": a * x**2, "twice": jnp.stack([x, x], -1)})


class Counted:
    """The function of a job, which notes the first lane of each chunk that it runs."""

    def __init__(self) -> None:
        self.ran: list[int] = []

    def __call__(self, x: Any, a: Any = 3.0) -> Any:
        if not isinstance(x, Tracer):
            self.ran.append(int(x[0]))
        return program(x, a)


def run(folder: Path | None, function: Any, batch: Any = X, **changes: Any) -> Any:
    job: dict[str, Any] = dict(chunk=4, out=folder, progress=False)
    return scaling.run_in_chunks(function, batch, **job | changes)


def assert_right(saved: Any) -> None:
    results = saved[:]
    np.testing.assert_array_equal(results["square"], 3.0 * X**2)
    np.testing.assert_array_equal(results["twice"], np.stack([X, X], -1))


@pytest.fixture
def done(tmp_path):
    """The folder of a job of five chunks that is done."""
    run(tmp_path, program, shared=(3.0,))
    return tmp_path


def leftovers(folder: Path) -> list[str]:
    """Return hidden files but for the lock, which stays: to remove it would let two jobs in."""
    return [path.name for path in folder.iterdir() if path.name.startswith(".") and path.name != ".lock"]


def flipped(data: bytes, place: int) -> bytes:
    return data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1 :]


def other_chunk(folder: Path) -> bytes:
    return (folder / "00000001.npz").read_bytes()


DAMAGES = {
    "half of it": lambda data, folder: data[: len(data) // 2],
    "empty": lambda data, folder: b"",
    "no zip": lambda data, folder: b"text" * 100,
    "an array": lambda data, folder: b"\x93NUMPY\x01\x00" + data,
    "byte flipped in an array": lambda data, folder: flipped(data, data.find(b"result.twice.npy") + 200),
    "byte flipped in a header": lambda data, folder: flipped(data, data.find(b"NUMPY") + 40),
    "another chunk": lambda data, folder: other_chunk(folder),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_chunk_is_named_and_made_anew(done, damage):
    path = done / "00000003.npz"
    good = path.read_bytes()
    path.write_bytes(DAMAGES[damage](good, done))
    gc.freeze()  # to look only at what is made here
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ResourceWarning)
        with pytest.raises(ValueError, match=r"00000003\.npz .*call run_in_chunks again with the same arguments"):
            scaling.load(done)[:]
        gc.collect()
    gc.unfreeze()
    assert [str(w.message) for w in caught] == []  # the file is closed
    function = Counted()
    with pytest.warns(UserWarning, match=r"00000003\.npz .*; it is made anew"):
        saved = run(done, function, shared=(3.0,))
    assert function.ran == [12]
    assert_right(saved)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run(done, function, shared=(3.0,))
    assert function.ran == [12]


def test_no_byte_of_a_chunk_changes_unseen(done):
    """Wherever one changes, either the file is refused as damaged or its numbers are what they were."""
    path, part = done / "00000002.npz", Part(2)
    good, job = path.read_bytes(), scaling.load(done).manifest["job"]
    blocks, arrays = read_chunk(path, part, job)
    seen, directory = 0, good.index(b"PK\x01\x02")  # what comes before is under zip's checksums
    places = [*range(0, directory, 7), *range(directory, len(good))]
    for place in places:
        path.write_bytes(flipped(good, place))
        try:
            check_chunk(path, part, job)
        except DamagedFile as damaged:
            assert "00000002.npz" in str(damaged)
            seen += 1
            continue
        again, others = read_chunk(path, part, job)
        assert again == blocks and others.keys() == arrays.keys()
        assert all(
            a.dtype == b.dtype and np.array_equal(a, b) for a, b in zip(arrays.values(), others.values(), strict=True)
        )
    assert seen > 0.5 * len(places)  # the rest are dates, rights and versions in zip's own headers


@pytest.mark.parametrize("damage", ["half of it", "empty", "edited", "removed", "a list"])
def test_a_damaged_manifest_is_written_anew(done, damage):
    """The chunks say themselves of which job they are."""
    path = done / "manifest.json"
    good = path.read_text()
    if damage == "removed":
        path.unlink()
    else:
        edited = json.dumps(json.loads(good) | {"chunk": 2})
        path.write_text({"half of it": good[: len(good) // 2], "empty": "", "edited": edited, "a list": "[]"}[damage])
        refuses(ValueError, r"manifest\.json is damaged .*call run_in_chunks again", scaling.load, done)
    function = Counted()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        saved = run(done, function, shared=(3.0,))
    assert [str(w.message).partition(" is ")[0] for w in caught] == [str(path)] * (damage != "removed")
    assert caught == [] or caught[0].filename == __file__
    assert function.ran == [] and path.read_text() == good
    assert_right(saved)


def test_chunks_of_another_job_are_refused_and_kept(done, tmp_path_factory):
    """Where the manifest is gone, and where one file came in among those of this job."""
    before = {path.name: path.read_bytes() for path in done.glob("*.npz")}
    (done / "manifest.json").unlink()
    function = Counted()
    with pytest.raises(ValueError, match=r"00000000\.npz has results of another job; name another folder"):
        run(done, function, shared=(4.0,))
    assert function.ran == [] and not (done / "manifest.json").exists() and leftovers(done) == []
    assert {path.name: path.read_bytes() for path in done.glob("*.npz")} == before
    other = tmp_path_factory.mktemp("other")
    run(other, program, shared=(4.0,))
    shutil.copy(done / "00000002.npz", other)
    with pytest.raises(ValueError, match=r"00000002\.npz has results of another job"):
        scaling.load(other)[8:12]
    refuses(ValueError, r"00000002\.npz has results of another job", run, other, function, shared=(4.0,))
    assert (other / "00000002.npz").read_bytes() == before["00000002.npz"]


def test_two_jobs_in_one_folder(tmp_path):
    """The second is told who works there; the first goes on as if nothing had been."""
    told = []

    def function(x):
        if not isinstance(x, Tracer) and not told:
            with pytest.raises(BlockingIOError, match=rf"process {os.getpid()} on \S+ works in the folder") as caught:
                run(tmp_path, program, shared=(3.0,))
            told.append(caught.value.filename)
        return program(x, 3.0)

    assert_right(run(tmp_path, function))
    assert told == [str(tmp_path)] and leftovers(tmp_path) == []


def test_two_jobs_where_the_file_system_has_no_locks(tmp_path, monkeypatch):
    """Both write the same file at the same time, and neither is harmed."""
    import fcntl

    def no_locks(*_: Any) -> None:
        raise OSError(errno.ENOLCK, "no locks available")

    real, second = np.savez, []

    def savez(file, *args, **arrays):
        if not second:
            second.append(None)
            second[0] = run(tmp_path, program, shared=(3.0,))
        real(file, *args, **arrays)

    monkeypatch.setattr(fcntl, "flock", no_locks)
    monkeypatch.setattr(np, "savez", savez)
    assert_right(run(tmp_path, program, shared=(3.0,)))
    assert_right(second[0])
    assert leftovers(tmp_path) == []


def test_what_a_killed_job_left_stops_nobody(done):
    """A lock file that nobody holds, and half a chunk; its owner is a process that runs, this one."""
    (done / ".lock").touch()
    (done / ".lock.owner").write_text(f"process {os.getpid()} on here")
    (done / ".00000001.npz.0123.partial").write_bytes(b"half")
    (done / "00000001.npz").unlink()
    assert_right(run(done, program, shared=(3.0,)))
    assert leftovers(done) == []


@pytest.mark.parametrize("failure", [KeyboardInterrupt, RuntimeError])
def test_what_is_computed_when_the_job_stops_stays(tmp_path, failure):
    """Also the chunk that was about to be written while the next one ran."""
    function, failures = Counted(), [failure]

    def batch(start: int, stop: int) -> Any:
        if start == 12 and failures:
            raise failures.pop()
        return X[start:stop]

    with pytest.raises(failure):
        run(tmp_path, function, batch, count=20, shared=(3.0,))
    assert sorted(path.name for path in tmp_path.glob("*.npz")) == [f"{k:08d}.npz" for k in range(3)]
    assert leftovers(tmp_path) == []
    assert_right(run(tmp_path, function, batch, count=20, shared=(3.0,)))
    assert function.ran == [0, 4, 8, 12, 16]


def test_a_folder_that_cannot_be_written_to(tmp_path):
    (tmp_path / "file").write_text("")
    function = Counted()
    for out, kind in ((tmp_path / "file", FileExistsError), (tmp_path / "file" / "job", NotADirectoryError)):
        with pytest.raises(kind, match="folder for the results cannot be made or written to") as caught:
            run(out, function)
        assert caught.value.filename == str(out)
    assert function.ran == []


def test_a_disk_that_is_too_small_is_found_before_the_work(tmp_path):
    """A petabyte does not fit anywhere: 20 lanes of 50 TB."""
    ran = []

    def large(x):
        if not isinstance(x, Tracer):
            ran.append(len(x))
            raise RuntimeError("this does not fit into memory either")
        return jnp.zeros((len(x), 5 * 10**13), jnp.int8)

    with pytest.raises(OSError, match=r"take 931,322\.6 GiB, and the folder's disk has [\d.,]+ [GM]iB left") as caught:
        run(tmp_path, large)
    assert caught.value.filename == str(tmp_path) and ran == []


def test_a_disk_that_fills_up(tmp_path):
    """From the fourth chunk on no file may be larger than 500 bytes: those written stay, the rest comes later."""
    function = Counted()
    with ExitStack() as full:

        def batch(start: int, stop: int) -> Any:
            if start == 12 and function.ran == [0, 4, 8]:
                full.enter_context(files_of_at_most(500))
            return X[start:stop]

        with pytest.raises(OSError, match=r"00000002\.npz cannot be written: File too large; chunks .* stay") as caught:
            run(tmp_path, function, batch, count=20, shared=(3.0,))
    assert caught.value.filename == str(tmp_path)
    assert sorted(path.name for path in tmp_path.glob("[!.]*")) == ["00000000.npz", "00000001.npz", "manifest.json"]
    function.ran.clear()
    assert_right(run(tmp_path, function, batch, count=20, shared=(3.0,)))
    assert function.ran == [8, 12, 16]


CHANGES = [
    (lambda y: {"y": y[:, None]}, r"y was float64 \(\), is float64 \(1,\)$"),
    (lambda y: {"y": y.astype(np.float32)}, r"y was float64 \(\), is float32 \(\)$"),
    (lambda y: {"z": y}, r"y was float64 \(\), is absent; z was absent, is float64 \(\)$"),
]


@pytest.mark.parametrize(("changed", "message"), CHANGES, ids=["shape", "type", "name"])
def test_chunks_have_the_same_types_and_shapes(tmp_path, changed, message):
    def function(x):
        y = np.sin(x)
        return changed(y) if x[0] == 8 else {"y": y}

    for out in (None, tmp_path):
        refuses(ValueError, r"results of chunk 2 are not like those of chunk 0: " + message, run, out, function)
    assert scaling.load(tmp_path).missing == (2, 3, 4)
    refuses(ValueError, "chunk 2 of .* is missing, with 2 more of 5", scaling.load(tmp_path).__getitem__, slice(None))


@pytest.mark.parametrize(("changed", "message"), CHANGES, ids=["shape", "type", "name"])
def test_a_job_goes_on_with_the_same_types_and_shapes(tmp_path, changed, message):
    run(tmp_path, lambda x: {"y": np.sin(x)})
    (tmp_path / "00000003.npz").unlink()
    with pytest.raises(ValueError, match=r"results of chunk 3 are not like those of chunk 0: " + message):
        run(tmp_path, lambda x: changed(np.sin(x)))
    assert not (tmp_path / "00000003.npz").exists()


def test_a_job_of_numpy_that_is_done(tmp_path):
    """JAX cannot trace the function, and the results come back in its structure all the same."""
    for _ in range(2):
        sine, both = run(tmp_path, lambda x: (np.sin(x), [np.stack([x, x], -1)]))[5:7]
        np.testing.assert_array_equal(sine, np.sin(X[5:7]))
        np.testing.assert_array_equal(both[0], np.stack([X[5:7]] * 2, -1))


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x: {"y": jnp.asarray(x, jnp.bfloat16)}, "y is of type bfloat16, which no .npz keeps"),
        (lambda x: {"y": np.array([{}] * len(x))}, "y is of type object, which no .npz keeps"),
        (lambda x: {"a.b": x, "a": {"b": -x}}, r"two arrays of the function's results are called 'a\.b'"),
    ],
)
def test_results_that_would_not_come_back(tmp_path, function, message):
    refuses(ValueError, message, run, tmp_path, function)
    assert [path.name for path in tmp_path.glob("[!.]*")] == ["manifest.json"]


def test_the_bar_says_how_many_of_what_are_done(tmp_path, capfd):
    """Those of an earlier job count as done."""

    def stop(done: int, count: int) -> None:
        if done == 12:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, program, shared=(3.0,), progress=stop)
    counted = Counted()
    assert_right(run(tmp_path, counted, shared=(3.0,), progress=True, unit="clips"))
    assert len(counted.ran) == 2
    shown = capfd.readouterr().err
    assert "20 of 20 clips" in shown and "a second" in shown and "left" not in shown
    run(None, program, shared=(3.0,), progress=True)
    assert "20 of 20 lanes" in capfd.readouterr().err


def test_the_time_left_is_that_of_the_pace_since_the_first_were_done():
    """600 s of compiling count only while nothing else is known."""
    pace = Pace(1000, 50.0)
    assert pace.seconds_left(1100, 2000, 650.0) == pytest.approx(600.0 / 100 * 900)
    assert pace.seconds_left(1400, 2000, 680.0) == pytest.approx(30.0 / 300 * 600)
    assert pace.seconds_left(1700, 2000, 750.0) == pytest.approx(100.0 / 600 * 300)


def test_progress_as_a_function(tmp_path):
    """It is told what is on the disk; if it fails the job stops, and loses nothing that it was told of."""
    told: list[tuple[int, int]] = []

    def tell(done: int, count: int) -> None:
        told.append((done, count))
        assert len(list(tmp_path.glob("*.npz"))) == done // 4
        if done == 12:
            raise RuntimeError("enough")

    refuses(RuntimeError, "enough", run, tmp_path, program, shared=(3.0,), progress=tell)
    assert_right(run(tmp_path, program, shared=(3.0,), progress=tell))
    assert told == [(4, 20), (8, 20), (12, 20), (16, 20), (20, 20)] and leftovers(tmp_path) == []
    told.clear()
    run(None, program, shared=(3.0,), progress=lambda *now: told.append(now))
    assert told == [(4, 20), (8, 20), (12, 20), (16, 20), (20, 20)]
    refuses(TypeError, "progress is 'bar'; it is True, False, or a function", run, tmp_path, program, progress="bar")
