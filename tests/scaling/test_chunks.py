"""What can happen to the folder of a job: damage, files of other jobs, a full disk, two processes, Ctrl-C."""

from __future__ import annotations

import json
import shutil
import warnings
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refuses
from small_files import files_of_at_most

from osik_jax import scaling
from osik_jax._progress import Pace

X = np.arange(20.0)
program = jax.jit(lambda x, a: {"square": a * x**2, "twice": jnp.stack([x, x], -1)})


class Counted:
    """The function of a job, which notes the first lane of each chunk that it runs."""

    def __init__(self) -> None:
        self.ran: list[int] = []

    def __call__(self, x: Any, a: Any = 3.0) -> Any:
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


DAMAGES = {
    "half of it": lambda data: data[: len(data) // 2],
    "empty": lambda data: b"",
    "an array hidden": lambda data: flipped(data, data.find(b"PK\x01\x02") + 32),  # length of a comment
    "marked as encrypted": lambda data: flipped(data, data.find(b"PK\x01\x02") + 8),
    "no zip": lambda data: b"text" * 100,
    "an array": lambda data: b"\x93NUMPY\x01\x00" + data,
    "byte flipped in an array": lambda data: flipped(data, data.find(b"result.twice.npy") + 200),
    "byte flipped in a header": lambda data: flipped(data, data.find(b"NUMPY") + 40),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_chunk_is_named_and_made_anew(done, damage):
    path = done / "00000003.npz"
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    with pytest.raises(ValueError, match=r"00000003\.npz .*call run_in_chunks again with the same arguments"):
        scaling.load(done)[:]
    function = Counted()
    with pytest.warns(UserWarning, match=r"00000003\.npz .*; it is made anew"):
        saved = run(done, function, shared=(3.0,))
    assert function.ran == [12]
    assert_right(saved)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run(done, function, shared=(3.0,))
    assert function.ran == [12]


@pytest.mark.parametrize("damage", ["half of it", "a list", "removed", "format 2"])
def test_a_folder_whose_manifest_is_lost_is_refused_and_kept(done, damage):
    path, before = done / "manifest.json", sorted(done.glob("*.npz"))
    old = json.dumps(json.loads(path.read_text()) | {"format": 2})
    if damage == "removed":
        path.unlink()
    else:
        path.write_text({"half of it": path.read_text()[:40], "a list": "[]", "format 2": old}[damage])
    function = Counted()
    refuses(ValueError, "name another folder", run, done, function, shared=(3.0,))
    assert function.ran == [] and sorted(done.glob("*.npz")) == before and leftovers(done) == []


def test_a_chunk_of_another_job_is_refused_and_kept(done, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    run(other, program, shared=(4.0,))
    shutil.copy(done / "00000002.npz", other)
    function = Counted()
    for call in (lambda: scaling.load(other)[8:12], lambda: run(other, function, shared=(4.0,))):
        refuses(ValueError, r"00000002\.npz has results of another job", call)
    assert (other / "00000002.npz").read_bytes() == (done / "00000002.npz").read_bytes() and function.ran == []


CHANGES = [
    (lambda y: {"y": y[:, None]}, r"y was float64 \(\), is float64 \(1,\)$"),
    (lambda y: {"y": y.astype(np.float32)}, r"y was float64 \(\), is float32 \(\)$"),
    (lambda y: {"z": y}, r"y was float64 \(\), is absent; z was absent, is float64 \(\)$"),
]


@pytest.mark.parametrize(("changed", "message"), CHANGES, ids=["shape", "type", "name"])
def test_chunks_have_the_same_types_and_shapes(tmp_path, changed, message):
    """In one job, and where a job goes on."""
    wrong = r"results of chunk 2 are not like those before: " + message
    for out in (None, tmp_path):
        refuses(ValueError, wrong, run, out, lambda x: changed(x) if x[0] == 8 else {"y": x})
    assert scaling.load(tmp_path).missing == (2, 3, 4)
    refuses(ValueError, wrong, run, tmp_path, changed)


def test_plain_numpy_reads_a_chunk(done):
    with np.load(done / "00000004.npz", allow_pickle=False) as file:
        np.testing.assert_array_equal(file["result.square"], 3.0 * X[16:] ** 2)


def test_two_jobs_in_one_folder(tmp_path):
    """The second is refused; the first goes on as if nothing had been."""
    told = []

    def function(x):
        if not told:
            with pytest.raises(BlockingIOError, match="another process works in the folder") as caught:
                run(tmp_path, program, shared=(3.0,))
            told.append(caught.value.filename)
        return program(x, 3.0)

    assert_right(run(tmp_path, function))
    assert told == [str(tmp_path)] and leftovers(tmp_path) == []


def test_what_a_killed_job_left_stops_nobody(done):
    """A lock file that nobody holds, and half a chunk."""
    (done / ".lock").touch()
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
        refuses(kind, str(out), run, out, function)
    assert function.ran == []


def test_a_disk_that_fills_up(tmp_path):
    """From the fourth chunk on no file may be larger than 500 bytes: those written stay, the rest comes later."""
    function = Counted()
    with ExitStack() as full:

        def batch(start: int, stop: int) -> Any:
            if start == 12 and function.ran == [0, 4, 8]:
                full.enter_context(files_of_at_most(500))
            return X[start:stop]

        with pytest.raises(OSError, match="it cannot be written: File too large") as caught:
            run(tmp_path, function, batch, count=20, shared=(3.0,))
    assert caught.value.filename == str(tmp_path / "00000002.npz")
    assert sorted(path.name for path in tmp_path.glob("[!.]*")) == ["00000000.npz", "00000001.npz", "manifest.json"]
    refuses(ValueError, "chunk 2 of .* is missing, with 2 more of 5", scaling.load(tmp_path).read, None)
    function.ran.clear()
    assert_right(run(tmp_path, function, batch, count=20, shared=(3.0,)))
    assert function.ran == [8, 12, 16]


def test_a_job_of_numpy_that_is_done(tmp_path):
    for _ in range(2):
        found = run(tmp_path, lambda x: (np.sin(x), [np.stack([x, x], -1)]))[5:7]
        np.testing.assert_array_equal(found["[0]"], np.sin(X[5:7]))
        np.testing.assert_array_equal(found["[1][0]"], np.stack([X[5:7]] * 2, -1))


def test_typed_keys_are_lanes_like_others(tmp_path):
    """In the batch and in ``shared``; other keys are another job."""
    keys, draw = jax.random.split(jax.random.key(0), 20), jax.vmap(lambda key, add: jax.random.normal(key, (2,)) + add)
    function = jax.jit(lambda keys, key: draw(keys, jnp.broadcast_to(jax.random.normal(key), keys.shape)))
    expected = function(keys, jax.random.key(1))
    for folder in (None, tmp_path):
        found = run(folder, function, keys, chunk=8, shared=(jax.random.key(1),))
        np.testing.assert_array_equal(found if folder is None else found[:][""], expected)
    refuses(ValueError, "shared.* was key<fry>", run, tmp_path, function, keys, chunk=8, shared=(jax.random.key(2),))


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
