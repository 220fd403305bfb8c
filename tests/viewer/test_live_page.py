"""What a live view shows, as far as no browser is needed: surfaces, motions, exported pages, servers."""

from __future__ import annotations

import socket
import time
import urllib.request
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from refusals import refuses
from scipy.spatial import ConvexHull
from trimesh import Trimesh
from waiting import until

import osik_jax as osik
from osik_jax.cli import main
from osik_jax.retargeting._robot_motion import in_mujoco_order
from osik_jax.viewer import export_html, serve
from osik_jax.viewer._parts import Part, robot_parts
from osik_jax.viewer.live._open import sole_polygon, standing
from osik_jax.viewer.live._page import BalanceMarks
from osik_jax.viewer.live._panel import error_text
from osik_jax.viewer.live._playback import read_motion
from osik_jax.viewer.live._server import close_server, open_server
from osik_jax.viewer.live._surfaces import part_triangles

ARM, NAO = osik.load_robot("arm7"), osik.load_robot("nao")
_GEOM = mujoco.mjtGeom


def test_a_box_is_sharp_at_its_edges() -> None:
    """Each corner is there once for each side."""
    size = np.array([0.1, 0.2, 0.3])
    vertices, _ = part_triangles(Part(_GEOM.mjGEOM_BOX, size, np.ones(4)))
    assert np.all(np.isclose(np.abs(vertices), size), axis=1).sum() == 8 * 3


def test_large_meshes_become_smaller_and_stay_where_they_were() -> None:
    fine = 120
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, fine, endpoint=False), np.linspace(0, np.pi, fine))
    points = 0.5 * np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), -np.cos(v)], -1).reshape(-1, 3)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(fine - 1), np.arange(fine), indexing="ij"))
    a, b = i * fine + j, i * fine + (j + 1) % fine
    faces = np.concatenate([np.stack([a, b, b + fine], 1), np.stack([a, b + fine, a + fine], 1)])
    big = Part(_GEOM.mjGEOM_MESH, np.zeros(3), np.ones(4), (points, faces))
    vertices, fewer = part_triangles(big)
    assert len(fewer) <= 4000 < len(faces)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.5, atol=0.02)
    assert Trimesh(vertices, fewer, process=False).volume == pytest.approx(Trimesh(points, faces).volume, rel=0.03)


def test_motions_are_read_as_the_demo_and_rollouts_write_them(tmp_path: Path) -> None:
    q = np.tile(np.asarray(ARM.q0), (5, 1)) + 0.1 * np.arange(5)[:, None]
    np.savez(tmp_path / "demo.npz", time=0.01 * np.arange(4), q_weighted=q, v_weighted=q[1:], q_null_space=q[:3])
    motion = read_motion(tmp_path / "demo.npz", ARM)
    assert list(motion.runs) == ["weighted", "null_space"]
    assert motion.duration == pytest.approx(0.04)
    np.testing.assert_array_equal(motion.at("weighted", 0.0299), q[2])
    np.testing.assert_array_equal(motion.at("weighted", 9.0), q[4])
    np.savez(tmp_path / "rollout.npz", q=q)
    assert read_motion(tmp_path / "rollout.npz", ARM).duration == pytest.approx(4 / 200)


def test_motions_are_read_as_retargeting_writes_them(tmp_path: Path) -> None:
    q = np.tile(np.asarray(NAO.q0), (4, 1))
    q[:, :3] += [0.1, 0.2, 0.3]
    q[:, NAO.joint_qpos_index("LElbowRoll")] = np.linspace(-1.0, -0.5, 4)
    written = in_mujoco_order(NAO, q, 60.0)
    arrays: Any = dict(qpos=written.qpos, joint_names=np.array(written.joint_names), fps=written.fps)
    np.savez(tmp_path / "motion.npz", **arrays)
    motion = read_motion(tmp_path / "motion.npz", NAO)
    np.testing.assert_allclose(motion.runs["motion"], q, atol=1e-12)
    assert motion.duration == pytest.approx(3 / 60)
    refuses(ValueError, "another robot", read_motion, tmp_path / "motion.npz", ARM)


def test_an_exported_page_holds_everything(tmp_path: Path) -> None:
    q = np.tile(np.asarray(ARM.q0), (50, 1)) + np.linspace(0.0, 0.5, 50)[:, None]
    path = export_html(ARM, {"one": q, "other": q[::-1]}, tmp_path / "arm.html", dt=0.02, title="a <b> arm")
    page = path.read_text(encoding="utf-8")
    assert "<title>a &lt;b&gt; arm</title>" in page and "__VISER_EMBED_DATA__" in page
    assert ' src="http' not in page and ' href="http' not in page
    still = export_html(ARM, q[:1], tmp_path / "still.html")
    assert len(page) - len(still.read_text(encoding="utf-8")) > 1000  # what moves
    refuses(ValueError, "it is configurations", export_html, NAO, q, tmp_path / "wrong.html")
    refuses(ValueError, "dt is -1", export_html, ARM, q, tmp_path / "wrong.html", dt=-1.0)


def test_a_page_is_served_and_a_visitor_who_goes_leaves_the_robot_at_rest() -> None:
    tasks = {"hand": osik.FrameTask(ARM, "hand"), "posture": osik.PostureTask(ARM, weight=1e-6)}
    with serve(ARM, tasks, port=0, source="arm7") as view:
        with urllib.request.urlopen(view.url) as answer:
            assert answer.status == 200 and b"<html" in answer.read(4000)
        assert view.loop.wait_until_ready()
        far, turn = tasks["hand"].target[0] + np.array([-0.3, 0.4, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])
        view._drag("hand", (np.asarray(far), turn), 7, "start")
        time.sleep(0.1)
        view._drag("hand", (np.asarray(far), turn), 7, "end")  # of a visitor who is not connected
        assert until(lambda: view.loop.snapshot.time > 0.3 and np.abs(view.loop.snapshot.velocity).max() < 1e-3, 20.0)
        task: Any = view.session.tasks["hand"]
        assert np.linalg.norm(task.target[0] - far) > 0.05
        taken = int(view.url.rsplit(":", 1)[1])
        refuses(OSError, f"port {taken}", serve, ARM, tasks, port=taken)


def test_the_command_tells_what_is_wrong_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savez(tmp_path / "motion.npz", q=np.zeros((3, 7)))
    (tmp_path / "broken.urdf").write_text("<robot", encoding="utf-8")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = str(other.getsockname()[1])
        for arguments, told in (
            (["--port", taken], f"port {taken}"),
            (["--port", "70000"], "no port 70000"),
            (["--port", "0", "--robot", "nowhere.urdf"], "no such file: nowhere.urdf"),
            (["--port", "0", "--robot", str(tmp_path / "broken.urdf")], "broken XML"),
            (["nowhere.npz"], "no such file: nowhere.npz"),
            (["nowhere.txt"], "no .npz of a motion, nor .json of a controller"),
            ([str(tmp_path / "motion.npz")], "another robot"),
            (["--port", "0", "--support", "l_soul"], "l_sole"),
            (["--html", str(tmp_path / "page.html")], "--html goes with a motion.npz"),
            (
                ["controller.json", "--robot", "ur5", "--base", "fixed"],
                "--robot, --base go with a robot or a motion, not",
            ),
            (["motion.npz", "--support", "l_sole"], "--support goes with a robot to drag, not with a file"),
            (
                [str(tmp_path / "motion.npz"), "--robot", "arm7", "--html", str(tmp_path / "no" / "page.html")],
                "No such file",
            ),
        ):
            assert main(["view", "--no-browser", *arguments]) == 2
            error = capsys.readouterr().err
            assert told in error and error.count("\n") == 1 and error.startswith("osik: ")


def test_wrong_arguments_are_named() -> None:
    tasks = {"posture": osik.PostureTask(ARM)}
    refuses(TypeError, r"serve\(robot, tasks\)", serve, "arm7", tasks, port=0)
    refuses(TypeError, "tasks is a list; it is a dict from names to tasks", serve, ARM, list(tasks.values()), port=0)
    refuses(ValueError, "there is no task", serve, ARM, port=0)
    refuses(ValueError, "q0 has shape", serve, ARM, tasks, q0=np.zeros(3), port=0)
    # what a controller has is not given beside it
    parts: dict[str, Any] = dict(tasks=tasks, scheme=osik.NullSpace(), limits=osik.no_limits, dt=0.005)
    for name, part in parts.items():
        refuses(ValueError, "a controller has its own", serve, osik.Controller(ARM, tasks), port=0, **{name: part})


def test_without_viser_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    with pytest.raises(ImportError, match=r'pip install "\.\[viewer\]"'):
        serve(ARM, {"posture": osik.PostureTask(ARM, weight=1.0)}, port=0)


def test_soles_without_named_corners_span_what_they_stand_on() -> None:
    shapes = robot_parts(NAO)
    q = standing(NAO, shapes, ("l_sole", "r_sole"))
    named = sole_polygon(NAO, shapes, q, ("l_sole", "r_sole"))
    drawn = sole_polygon(NAO, shapes, q, ("l_ankle", "r_ankle"))
    assert named is not None and drawn is not None
    assert bool(np.all(named.distance(drawn.vertices) > -0.01))
    assert ConvexHull(drawn.vertices).volume > 0.6 * ConvexHull(named.vertices).volume  # areas


def square(half: float) -> osik.SupportPolygon:
    normals = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    made: Any = osik.SupportPolygon
    return made(*map(jnp.asarray, (normals, np.full(4, half), half * normals)))


def test_balance_marks_follow_slow_motions_and_turn_red_outside() -> None:
    server = open_server("127.0.0.1", 0, "test")
    try:
        marks = BalanceMarks(server.scene, 0.0, 1.0)
        marks.show_polygon(square(0.1))
        for x in np.linspace(0.0, 1e-3, 401):  # less in a picture than what is worth a message
            marks.place(np.array([x, 0.0, 0.5]))
        np.testing.assert_allclose(marks._ball.position, [1e-3, 0.0, 0.5], atol=1.1e-5)
        inside = marks._ball.color
        marks.place(np.array([0.2, 0.0, 0.5]))
        assert marks._ball.color == marks._disc.color != inside
        marks.show_polygon(None)
        marks.place(np.array([0.2, 0.0, 0.5]))
        assert marks._ball.color == marks._disc.color == inside
    finally:
        close_server(server)


def test_readings() -> None:
    task = osik.FrameTask(ARM, "hand")
    assert error_text(task, np.array([3e-3, 4e-3, 0.0, np.pi / 180.0, 0.0, 0.0])) == "5.0 mm, 1.0°"
    balance = osik.ComTask(ARM, polygon=square(0.1))
    assert error_text(balance, np.array([0.08, 0.0, -0.08, 0.0])) == "20 mm inside"
    assert error_text(balance, np.array([0.13, 0.0, -0.13, 0.0])) == "30.0 mm outside"
    height = osik.FrameTask(ARM, "hand", rows="position", lower=-0.1)
    assert error_text(height, np.array([0.0, -0.13, -0.14])) == "50.0 mm outside"
    assert error_text(height, np.array([0.0, 0.2, 0.0])) == "inside"
    assert error_text(osik.LookAtTask(ARM, "hand", target=[1.0, 0.0, 0.0]), np.array([0.0, np.pi / 6])) == "30.0°"
    assert error_text(osik.PostureTask(ARM), np.array([0.0, 2.0])) == "2"
