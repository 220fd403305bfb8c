"""Files of motions: what was written is read again, and what is no motion is refused."""

import csv
import sys
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from refusals import refuses

import osik_jax as osik
from osik_jax.interop.ros2.dds import joint_trajectory
from osik_jax.motion import Motion, draw_motion, film_motion, load_motion, retime

MOTION = retime(np.array([[0.0, 0.0], [1.0, 0.5], [1.5, 2.0]]), acceleration=5.0, velocity=2.0, cells=40).sample(0.02)
MOTION = Motion(MOTION.time, MOTION.position, MOTION.velocity, MOTION.acceleration, joints=("lift", "turn"))


@pytest.mark.parametrize("kind", ["npz", "csv", "parquet"])
def test_a_file_gives_the_same_motion(tmp_path, kind) -> None:
    if kind == "parquet":
        pytest.importorskip("pyarrow")
    MOTION.save(tmp_path / f"motion.{kind}")
    found = load_motion(tmp_path / f"motion.{kind}")
    assert found.joints == MOTION.joints
    for name in ("time", "position", "velocity", "acceleration"):
        np.testing.assert_array_equal(getattr(found, name), getattr(MOTION, name))


def test_columns_of_a_csv(tmp_path) -> None:
    MOTION.save(tmp_path / "motion.csv")
    with open(tmp_path / "motion.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(MOTION.time)
    np.testing.assert_array_equal([float(row["velocity.turn"]) for row in rows], MOTION.velocity[:, 1])


def test_a_table_of_positions_alone_gets_velocities_by_differences(tmp_path) -> None:
    time = np.linspace(0.0, 1.0, 101)
    table = np.column_stack([time, np.sin(time)])
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="time,position.a", comments="")
    np.testing.assert_allclose(load_motion(tmp_path / "a.csv").velocity[1:-1, 0], np.cos(time[1:-1]), atol=1e-4)


def test_a_rollout_is_a_motion() -> None:
    arm = osik.load_robot("arm7")
    path = osik.rollout(arm, arm.q0, {"hand": osik.FrameTask(arm, "hand")}, dt=0.01, steps=5)
    motion = Motion.of(arm, path)
    np.testing.assert_array_equal(motion.position, path.q[:-1])
    assert motion.velocity.shape == motion.acceleration.shape == (5, 7) and motion.joints[0] == "joint1"


def test_parquet_needs_its_extra(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install \".\[motion\]\""):
        MOTION.save(tmp_path / "motion.parquet")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "text, message",
    [
        ("time,position.a\n0,1\n1,2\n1,3\n", "times have to increase, two or more; sample 2 does not"),
        ("time,position.a\n1,1\n0,2\n", "sample 1 does not"),
        ("time,position.a\n0,1\n", "two or more"),
        ("a,b\n0,1\n", "no column time"),
        ("time,a\n0,1\n", "no columns position.JOINT"),
        ("time,position.a\n0,x\n", "line 2, column position.a: 'x' is no finite number"),
        ("time,position.a\n0,nan\n1,2\n", "column position.a: 'nan' is no finite number"),
        ("", "at least one line of numbers"),
        ("time,position.a\n", "at least one line of numbers"),
        ("time,position.a,position.a\n0,1,3\n1,2,4\n", "different names"),
    ],
)
def test_what_is_no_motion_is_refused(tmp_path, text, message) -> None:
    (tmp_path / "motion.csv").write_text(text)
    refuses(osik.OsikError, message, load_motion, tmp_path / "motion.csv")


def test_marks_blank_lines_and_other_columns_of_spreadsheets_are_read_over(tmp_path) -> None:
    text = "\ufefftime,note,position.a,note,effort.a\n0,here,1,,nan\n1,there,2,,\n,,,\n\n"
    (tmp_path / "motion.csv").write_text(text, encoding="utf-8")
    np.testing.assert_array_equal(load_motion(tmp_path / "motion.csv").position, [[1.0], [2.0]])


GOOD: dict[str, Any] = dict(time=np.arange(3.0), position=np.zeros((3, 2)), joints=np.array(["a", "b"]))


@pytest.mark.parametrize(
    "wrong, message",
    [
        (dict(position=np.zeros((2, 2))), r"position has shape \(2, 2\); expected \(3, 2\)"),
        (dict(joints=np.array(["a"])), r"position has shape \(3, 2\); expected \(3, 1\)"),
        (dict(velocity=np.zeros((3, 1))), "velocity has shape"),
        (dict(acceleration=np.full((3, 2), np.nan)), "acceleration .* finite numbers"),
        (dict(position=np.full((3, 2), "x")), "position .* finite numbers"),
        (dict(time=np.array(1.0)), "time has shape"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(tmp_path, wrong, message) -> None:
    np.savez(tmp_path / "motion.npz", **(GOOD | wrong))
    refuses(osik.OsikError, message, load_motion, tmp_path / "motion.npz")


def test_parquet_that_is_none_is_refused(tmp_path) -> None:
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    (tmp_path / "a.parquet").write_text("hello")
    refuses(osik.OsikError, "cannot be read as a Parquet file", load_motion, tmp_path / "a.parquet")
    for states, message in (([[0.0], [0.0, 1.0]], "position has shape"), ([0.0, 1.0], r"\(2,\); expected \(2, 2\)")):
        table = arrow.table({"observation.state": states, "timestamp": [0.0, 1.0]})
        parquet.write_table(table, tmp_path / "b.parquet")
        refuses(osik.OsikError, message, load_motion, tmp_path / "b.parquet")


def test_other_ends_of_names_are_refused(tmp_path) -> None:
    with pytest.raises(osik.OsikError, match=r"ends in .npz, .csv or .parquet"):
        MOTION.save(tmp_path / "motion.txt")
    np.savez(tmp_path / "other.npz", a=jnp.zeros(2))
    with pytest.raises(osik.OsikError, match="has no time"):
        load_motion(tmp_path / "other.npz")


def test_a_picture_has_a_line_a_joint_and_its_limits(tmp_path, monkeypatch) -> None:
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda self, file, **_: (figures.append(self), file.write(b"x")))
    draw_motion(MOTION, tmp_path / "motion.png", np.array([[2.0, 2.0], [5.0, 5.0], [np.inf, np.inf]]))
    speeds, accelerations = figures[0].axes
    assert (tmp_path / "motion.png").read_bytes() == b"x" and len(speeds.lines) == len(accelerations.lines) == 4
    np.testing.assert_array_equal(speeds.lines[1].get_ydata(), np.asarray(MOTION.velocity)[:, 1] / 2.0)


def test_a_film_shows_the_motion_from_its_begin_to_its_end(tmp_path) -> None:
    """At times that are not even; the last picture is the last sample."""
    arm, time = osik.load_robot("arm7"), jnp.array([0.0, 0.1, 0.35, 0.5])
    q = arm.q0 + jnp.array([0.0, 0.3, 0.7, 1.0])[:, None] * jnp.array([1.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    motion = Motion(time, q, 0.0 * q + 0.5, 0.0 * q)
    options: Any = {"size": (160, 90)}
    film_motion(motion, arm, tmp_path / "m.gif", np.full((3, 7), 2.0), **options)
    with Image.open(tmp_path / "m.gif") as film:
        assert getattr(film, "n_frames", 1) == 8  # seven in 0.5 s, and the end
        film.seek(7)
        last = np.asarray(film.convert("RGB"), float)
        film.seek(0)
        assert np.abs(last - np.asarray(film.convert("RGB"), float)).mean() > 1.0
    refuses(ValueError, "the motion has 2 joints, and the robot 7", film_motion, MOTION, arm, tmp_path / "m.gif")
    refuses(ValueError, "has to be .gif or .mp4", film_motion, motion, arm, tmp_path / "m.avi")


def test_a_motion_is_a_message_of_ros() -> None:
    message = joint_trajectory(MOTION)
    assert message.joint_names == ["lift", "turn"] and len(message.points) == len(MOTION.time)
    times = [point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec for point in message.points]
    np.testing.assert_allclose(times, MOTION.time, atol=1e-9)
    for names, name in (("positions", "position"), ("velocities", "velocity"), ("accelerations", "acceleration")):
        np.testing.assert_array_equal([getattr(point, names) for point in message.points], getattr(MOTION, name))
    assert type(message).deserialize(message.serialize()) == message
