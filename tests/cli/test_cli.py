"""The command line: what it prints, and how it refuses."""

import signal
import subprocess
import sys

import mujoco
import numpy as np
import pytest
from core_checks import needs_core
from model_files import MJCF
from mujoco_states import mujoco_at
from PIL import Image
from small_files import files_of_at_most
from urdfs import joint, tree

import osik_jax as osik
from osik_jax import cli
from osik_jax._progress import spoken
from osik_jax.cli._inputs import read_pose_file

ARM_FILE = str(MJCF / "three_joints.xml")


def run(*arguments):
    return subprocess.run([sys.executable, "-m", "osik_jax.cli", *arguments], capture_output=True, text=True)


def refused(capsys, *arguments):
    """The one line that a mistake gets."""
    assert cli.main(arguments) == 2
    captured = capsys.readouterr()
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("osik: ")
    assert captured.out == ""
    return lines[0]


def test_help_names_commands_and_options(capsys):
    everything = run("--help")
    assert everything.returncode == 0 and "demo" in everything.stdout and "info" in everything.stdout
    with pytest.raises(SystemExit):
        cli.main(["demo", "--help"])
    said = capsys.readouterr().out
    for option in ("motion", "duration", "frequency", "schemes", "out"):
        assert f"--{option}" in said
    assert "--no-animation" in said


def test_version_is_the_packages(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("osik-jax 0.")


@pytest.mark.parametrize("arguments", [["dmo"], ["demo", "--motion", "jump"], ["demo", "--schemes", "magic"]])
def test_unknown_words_exit_with_2(arguments, capsys):
    with pytest.raises(SystemExit) as exit_info:
        cli.main(arguments)
    assert exit_info.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_info_of_the_system_says_which_core_is_loaded(capsys):
    from osik_jax.core import _library

    assert cli.main(["info", "--system"]) == 0
    said = capsys.readouterr().out
    assert _library.core().reason in said and "jaxlib" in said and "NVRTC" in said
    assert "--system" in refused(capsys, "info")


def test_info_tells_of_the_spheres_and_draws_them(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    picture = tmp_path / "spheres.png"
    assert cli.main(["info", "ur5", "--spheres", "--png", str(picture)]) == 0
    printed = capsys.readouterr().out
    assert "upper_arm_link:0" in printed and "no surface is uncovered" in printed
    pixels = np.asarray(Image.open(picture).convert("RGB"), int)
    orange = (pixels[..., 0] > pixels[..., 2] + 60).mean(0)  # the spheres are in the right half
    assert pixels.shape == (900, 1600, 3) and orange[800:].sum() > 5.0 > orange[:800].sum()
    assert "--given and --png go with --spheres" in refused(capsys, "info", "ur5", "--png", "a.png")
    assert "no spheres file 'lost.yaml'" in refused(capsys, "info", "ur5", "--spheres", "--given", "lost.yaml")


def test_missing_and_broken_files_are_named(capsys, tmp_path):
    assert "no such file: gone.urdf" in refused(capsys, "info", "gone.urdf")
    assert "gone.xml" in refused(capsys, "view", "--robot", "gone.xml")
    broken = tmp_path / "broken.urdf"
    broken.write_text("<robot name='x'><link")
    assert "broken.urdf" in refused(capsys, "info", str(broken))
    assert "mjcf" in refused(capsys, "info", str(_written(tmp_path / "mjcf.xml", "<mujoco><worldbody><bod"))).lower()


def _written(path, text):
    path.write_text(text)
    return path


def test_unknown_frames_are_listed(capsys):
    line = refused(capsys, "ik", ARM_FILE, "--frame", "tol", "--position", "0", "0", "0")
    assert "'tol'" in line and "did you mean 'tool'" in line and "base, a, b, c" in line


def test_options_that_make_no_sense_are_explained(capsys):
    assert "--frequency is 0" in refused(capsys, "demo", "--frequency", "0")
    assert "two control steps" in refused(capsys, "demo", "--duration", "0")
    assert "--base goes with a file" in refused(capsys, "info", "nao", "--base", "fixed")


def test_a_folder_that_cannot_be_made_is_named(capsys, tmp_path):
    blocked = _written(tmp_path / "file", "")
    line = refused(capsys, "demo", "--out", str(blocked / "out"))
    assert str(blocked) in line


def test_a_disk_that_fills_up_ends_in_one_line(capsys, tmp_path):
    """The system refuses to write files of more than 2 kB: smaller than the motion."""
    words = ["demo", "--duration", "1", "--frequency", "20", "--schemes", "weighted"]
    with files_of_at_most(2_000):
        code = cli.main([*words, "--no-animation", "--out", str(tmp_path / "out")])
    told = capsys.readouterr().err.strip().splitlines()
    assert code == 2 and len(told) == 1
    assert told[0] == f"osik: cannot write to {tmp_path / 'out'}: File too large; it may be incomplete"


@pytest.mark.slow
def test_an_interrupt_ends_in_one_line(tmp_path):
    """Ctrl-C once the title has been told."""
    words = [sys.executable, "-m", "osik_jax.cli", "demo", "--duration", "60", "--out"]
    signal.signal(signal.SIGINT, signal.default_int_handler)  # what a shell starts in the background ignores it
    with subprocess.Popen(
        [*words, str(tmp_path / "out")], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        first = process.stdout.readline()
        process.send_signal(signal.SIGINT)
        told = process.stderr.read().strip().splitlines()
    assert "NAO in double support" in first
    assert process.returncode == 130 and len(told) == 1 and told[0].startswith("osik: interrupted")


def test_times_are_told_no_more_exactly_than_they_are_known():
    seconds = (0.2, 42.0, 89.0, 100.0, 340.0, 9500.0)
    assert [spoken(given) for given in seconds] == ["5 s", "40 s", "90 s", "1.5 min", "5.5 min", "2.5 h"]


def test_a_name_without_its_extra_is_one_line(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "robot_descriptions", None)
    line = refused(capsys, "info", "panda_mj_description")
    assert 'pip install ".[descriptions]"' in line
    assert "names of robot_descriptions end in _description" in refused(capsys, "info", "atlas")


def test_info_lists_joints_limits_frames_and_mass(capsys):
    assert cli.main(["info", "nao"]) == 0
    out = capsys.readouterr().out
    robot = osik.load_robot("nao")
    words = out.replace("\n", " ").replace(",", " ").split()
    for name in (*robot.joint_names, *robot.frame_names):
        assert name in words
    assert f"{mujoco.mj_getTotalmass(robot.mj_model):.3f}" in words
    row = next(line for line in out.splitlines() if " LKneePitch " in line)
    dof = robot.joint_dof_index("LKneePitch")
    numbers = [float(cell) for cell in row.strip("│").split("│")[1:]]
    expected = [robot.joint_qpos_index("LKneePitch"), dof, robot.position_lower[dof], robot.position_upper[dof]]
    np.testing.assert_allclose(numbers[:4], np.asarray(expected, float), atol=5e-5)
    assert numbers[4] == pytest.approx(float(robot.velocity_limit[dof]), abs=5e-5)


def test_ik_finds_a_configuration_or_says_what_stops_it(arm, capsys):
    """The printed joints put the hand there, by MuJoCo."""
    assert cli.main(["ik", "arm7", "--frame", "hand", "--position", "0.4", "0.1", "0.5"]) == 0
    out = capsys.readouterr().out
    values = [float(line.split()[5]) for line in out.splitlines() if line.startswith("│ joint")]
    np.testing.assert_allclose(mujoco_at(arm, values).site("hand").xpos, [0.4, 0.1, 0.5], atol=1e-3)
    assert cli.main(["ik", "arm7", "--frame", "hand", "--position", "4", "0", "0", "--seeds", "2"]) == 1
    assert "out of reach" in capsys.readouterr().out
    assert "no frame 'hnd'" in refused(capsys, "ik", "arm7", "--frame", "hnd", "--position", "0", "0", "0")
    both = "--frame", "hand", "--position", "0", "0", "0", "--hold", "hand"
    assert "both name 'hand'" in refused(capsys, "ik", "arm7", *both)


SCENE = """<mujoco><worldbody>
  <geom name="floor" type="plane" size="1 1 1" pos="0 0 -0.02"/>
  <geom name="crate" type="box" size="0.1 0.1 0.1" pos="{}"/>
</worldbody></mujoco>"""


@needs_core
def test_ik_keeps_off_a_scene_or_says_what_is_in_the_way(tmp_path, capsys):
    """The printed joints are free of the crate by ``is_free``; inside the crate there is no answer."""
    scene, arm = tmp_path / "scene.xml", osik.load_robot("ur5")
    wanted = "ik", "ur5", "--frame", "tool0", "--position", "0.5", "0.1", "0.4", "--scene", str(scene)
    scene.write_text(SCENE.format("0.35 0.25 0.4"))
    assert cli.main([*wanted, "--clearance", "0.005"]) == 0
    values = [float(line.split()[5]) for line in capsys.readouterr().out.splitlines() if "_joint " in line]
    assert osik.is_free(arm, np.array(values), osik.Scene.from_file(scene), 0.0049)
    scene.write_text(SCENE.format("0.5 0.1 0.4"))
    assert cli.main([*wanted, "--quaternion", "0", "1", "0", "0"]) == 1
    assert "an obstacle stands around the target" in " ".join(capsys.readouterr().out.split())
    assert "--clearance goes with --scene" in refused(capsys, *wanted[:-2], "--clearance", "0.1")
    assert "no scene: there are" in refused(capsys, *wanted[:-1], str(tmp_path / "scene.stl"))
    assert "clearance is -1.0" in refused(capsys, *wanted, "--clearance", "-1")


def test_names_with_brackets_are_printed_as_they_are(tmp_path, capsys):
    path = tmp_path / "u[b].urdf"
    path.write_text(tree(joint("j[left]", "a", "[/x]")))
    assert cli.main(["info", str(path)]) == 0
    said = capsys.readouterr().out
    assert "j[left]" in said and "[/x]" in said and "u[b].urdf" in said.replace("\n", "")
    assert cli.main(["ik", str(path), "--frame", "[/x]", "--position", "0", "0", "0"]) == 1
    assert "j[left]" in capsys.readouterr().out


def test_poses_are_read_with_a_head_in_any_order_and_without_one(tmp_path):
    path, rows = tmp_path / "poses.csv", np.arange(14.0).reshape(2, 7)
    for names in ([*"xyz", "qw", "qx", "qy", "qz"], ["qz", "qw", "qx", "qy", "z", "y", "x"], []):
        order = [["x", "y", "z", "qw", "qx", "qy", "qz"].index(name) for name in names] or [*range(7)]
        np.savetxt(path, rows[:, order], delimiter=",", header=",".join(names), comments="" if names else "# ")
        position, quaternion = read_pose_file(path)
        assert (position == rows[:, :3]).all() and (quaternion == rows[:, 3:]).all()
    path.write_text("0.1,0.2,0.3\n# by hand\n0.4,0.5,0.6\n")
    assert (read_pose_file(path) == [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]).all()
    for text, message in [
        ("x,y\n1,2\n", "its columns are x,y"),
        ("x,y,z\n1,2\n", "each line has 3 numbers"),
        ("1,2,3,4\n", "its columns are x,y,z,qw"),
        ("1,2,3,4,5,6,7,8\n", "each line has 7 numbers"),
        ("x,y,z\n", "at least one line"),
    ]:
        path.write_text(text)
        with pytest.raises(osik.OsikError, match=message):
            read_pose_file(path)
