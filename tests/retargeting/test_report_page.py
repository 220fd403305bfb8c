"""The page of ``osik retarget --report``: what it says is what MuJoCo and the contacts say, and it needs no network."""

import csv
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from motion_files import dancer, sliding, write_bvh
from playwright.sync_api import sync_playwright

import osik_jax as osik
from osik_jax.cli._retarget import Retarget
from osik_jax.retargeting import Retargeter, load_profile, report
from osik_jax.retargeting._command import write_folder
from osik_jax.viewer.live._playback import read_motion

FRAMES = 20


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    clip = write_bvh(folder / "dance <1>.bvh", dancer(FRAMES), 0.01)
    assert Retarget(clip=str(clip), robot="nao", out=folder / "out", report=True, animation=False).run() == 0
    return folder / "out"


def strips(page: str) -> dict[str, np.ndarray]:
    """The strips of a page: whether each is coloured in each frame."""
    out = {}
    for name, inside in re.findall(r'aria-label="(.*?)">(.*?)</svg>', page):
        out[name] = np.zeros(FRAMES, bool)
        for start, width in re.findall(r'x="(\d+)" width="(\d+)"', inside):
            out[name][int(start) : int(start) + int(width)] = True
    return out


@pytest.mark.slow
def test_the_page_says_what_the_motion_is(written: Path) -> None:
    page = (written / "report.html").read_text(encoding="utf-8")
    assert (
        "<title>dance &lt;1&gt;</title>" in page
        and page.count("dance &lt;1&gt;") > 1
        and f"{FRAMES} frames, 30 a second" in page
    )
    assert ' src="http' not in page and ' href="http' not in page and page.count("</body>") == 1
    assert "<h2>What gave way</h2><p>nothing</p>" in page
    found = strips(page)
    with np.load(written / "motion.npz") as file:
        contact, qpos, names = file["contact"], file["qpos"], list(file["joint_names"])
    for k, name in enumerate(("left heel", "left toe", "right heel", "right toe")):
        np.testing.assert_array_equal(found[name], contact[:, k])
    robot = osik.load_robot("nao")
    at_end = np.zeros(FRAMES, bool)
    for name in robot.joint_names:  # by MuJoCo's ranges
        low, high = robot.mj_model.joint(name).range
        q = qpos[:, 7 + names.index(name)]
        at_end |= (q <= low + 0.01 * (high - low)) | (q >= high - 0.01 * (high - low))
    np.testing.assert_array_equal(found["a joint at an end of its range"], at_end)


def test_view_plays_the_person_beside_the_robot(written: Path) -> None:
    motion = read_motion(written / "motion.npz", osik.load_robot("nao"))
    person = motion.person
    assert person is not None and len(motion.runs["motion"]) == len(person.points) == FRAMES
    lengths = np.stack([np.linalg.norm(person.points[:, a] - person.points[:, b], axis=-1) for a, b in person.bones])
    assert len(lengths) >= 14 and np.ptp(lengths[:8], axis=1).max() < 1e-6  # limbs are bones of one length
    sized = person.sized(np.array([[0.0, 0.0, 0.0], [0.0, 0.3, 0.5]]), motion.runs["motion"][:, :3], 0.2)
    assert np.linalg.norm(np.ptp(sized.points[0], axis=0)) == pytest.approx(np.hypot(0.3, 0.5))
    assert sized.points[0, :, 2].min() == pytest.approx(0.2)


def test_what_gave_way_is_told(tmp_path: Path) -> None:
    """A person whose feet are said to stand and move far apart: the page names the bound."""
    robot = osik.load_robot("nao")
    result = Retargeter(robot, max_iterations=2).retarget(sliding(FRAMES, 0.45))
    notes = report(result)["notes"]
    write_folder(result, "slides", tmp_path, animation=False, page=True)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert notes and all(f"<li>{note}" in page for note in notes)
    assert load_profile(tmp_path / "profile.toml") == load_profile("nao")


def test_a_folder_has_a_page_per_clip_and_an_index(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    clips, out = tmp_path / "clips", tmp_path / "out"
    clips.mkdir()
    write_bvh(clips / "dance <1>.bvh", dancer(FRAMES), 0.01)
    write_bvh(clips / "dance 2.bvh", dancer(FRAMES), 0.01)
    (clips / "broken.csv").write_text("time,Hips.x\n0,1\n1,2\n")
    for other in ("walk <2>.txt", ".hidden"):
        (clips / other).write_text("")
    (clips / "more").mkdir()

    def run() -> int:
        return Retarget(clip=str(clips), robot="nao", out=out, report=True).run()

    assert run() == 1
    with (out / "index.csv").open(newline="", encoding="utf-8") as file:
        table = list(csv.reader(file))
    assert [row[0] for row in table[2:]] == ["dance 2", "dance <1>"]
    # what is no clip is told
    assert "no clips, and not read: more/, walk <2>.txt\n" in capsys.readouterr().out
    page = out / "dance 2" / "report.html"
    assert "<h1>dance 2</h1>" in page.read_text(encoding="utf-8")
    # the same command makes what is missing, and nothing else
    page.unlink()
    kept = (out / "dance <1>" / "report.json").stat().st_mtime_ns
    assert run() == 1 and page.exists() and (out / "dance <1>" / "report.json").stat().st_mtime_ns == kept
    capsys.readouterr()


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 390])
def test_pages_fit_a_desk_and_a_phone(written: Path, width: int) -> None:
    """In a browser: nothing is wider than the window, and the scene of a clip is no strip."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": width, "height": 800})
        page.goto((written / "report.html").as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        root = page.evaluate("['#root', '#osik'].map(name => document.querySelector(name).getBoundingClientRect())")
        scene, figures = root
        assert scene["width"] >= min(width, 900) and scene["height"] >= 250 and figures["width"] >= 340
        browser.close()
