"""Each script of ``examples`` runs, is short, draws its picture, and reaches what its first line promises."""

import os
import re
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image

import osik_jax as osik

FOLDER = Path(__file__).parents[2] / "examples"
GALLERY = FOLDER.parent / "docs" / "gallery.md"
Names = dict[str, Any]


def solved(motion: Any) -> bool:
    return bool((motion.solution.status == 0).all())


def ur5_pose(names: Names) -> None:
    assert len(names["ways"]) == 8
    assert names["found"].converged
    assert names["nearest"].converged


def panda_draws(names: Names) -> None:
    assert solved(names["motion"])
    assert names["error"].max() < 2.0  # mm
    assert np.ptp(names["drawn"], axis=0)[1] > 0.38  # m


def xarm_elbow(names: Names) -> None:
    assert solved(names["motions"])
    moved = np.linalg.norm(names["motions"].solution.error["hand"][..., :3], axis=-1)
    assert moved.max() < 2e-4
    assert moved[:, -1].max() < 1e-5


def so101_pose(names: Names) -> None:
    assert [bool(names[name].converged) for name in ("whole", "place", "above", "far")] == [False, True, True, False]
    assert names["far"].beyond_reach > 0.05
    assert "6 rows and 5 joints" in names["whole"].explain()


def so101_teleoperation(names: Names) -> None:
    steps = np.diff(names["angles"], axis=0)
    assert names["angles"][0, 2] > names["arm"].position_upper[2] + 0.09
    assert names["angles"][-1, 2] <= names["arm"].position_upper[2]
    inside = np.flatnonzero(names["angles"][:, 2] <= names["arm"].position_upper[2])[0]
    assert inside > 90  # steps of 10 ms, for 0.1 rad at return_speed
    assert np.abs(steps[:5]).max() < 5 * 8.0 * 0.01**2 + 1e-9  # starts from rest, by its accelerations
    assert np.ptp(names["goals"], axis=0).max() > 0.05


def so101_chunks(names: Names) -> None:
    position, velocity = names["states"][:2]
    assert names["stream"].taken and max(names["used"]) <= 1.0 + 1e-6
    assert np.abs(np.diff(velocity, axis=0)).max() <= 20.0 * names["dt"] + 1e-9  # at joins too
    assert np.abs(np.diff(position, n=2, axis=0)).max() <= 20.0 * names["dt"] ** 2 + 1e-9
    assert names["lag"] < 0.02  # rad


def weld_line(names: Names) -> None:
    assert names["motion"].position_error < 1e-4 and names["motion"].orientation_error < 1.7e-3
    assert names["at_speed"] > 0.97 and names["speed"].max() <= 1.001 * names["wanted"]
    _, _, pull, jerk = np.abs(names["motion"].at(np.arange(0.0, names["motion"].duration, 1e-3)))
    assert (pull <= 1.0001 * names["limits"]["acceleration"]).all() and (jerk <= 1.0001 * names["limits"]["jerk"]).all()


def allegro_grasp(names: Names) -> None:
    assert names["grasp"].converged
    np.testing.assert_allclose(names["closing"].q[-1], names["grasp"].q, atol=0.01)


def tiago_drives(names: Names) -> None:
    assert solved(names["motion"])
    assert np.linalg.norm(names["path"][-1, 1] - names["goal"]) < 2e-3
    assert np.linalg.norm(names["path"][-1, 0, :2]) > 0.5
    assert np.abs(names["path"][:, 0, 2]).max() < 1e-3


def go2_body(names: Names) -> None:
    assert solved(names["motion"])
    assert names["slip"] < 3e-4


def g1_reaches(names: Names) -> None:
    assert solved(names["motion"])
    error = names["motion"].solution.error
    assert max(np.abs(error[name][-1]).max() for name in ("left foot", "right foot")) < 1e-4
    assert np.abs(error["hand"][-1]).max() < 2e-3
    assert names["margin"] > -2e-3  # of the last motion
    assert solved(names["bent_down"])
    feet = [names["bent_down"].solution.error[name] for name in ("left foot", "right foot")]
    assert np.abs(feet).max() < 3e-4  # at any time
    assert np.linalg.norm(names["bent_down"].solution.error["hand"][-1]) < 3e-3


def nao_one_foot(names: Names) -> None:
    assert solved(names["motion"])
    assert min(names["inside"]) > 10.0  # mm
    assert names["raised"][-1] - names["raised"][0] > 0.06


def baxter_two_arms(names: Names) -> None:
    assert solved(names["motion"])
    assert np.ptp(names["apart"]) < 1e-5
    assert np.ptp(names["at"][:, 0], axis=0).min() > 0.08


def ur5_keeps_off_a_post(names: Names) -> None:
    assert names["gaps"].min() > 0.0299
    assert names["left"] < 5e-3


def collision_free(names: Names) -> None:
    free = names["free"]
    assert 10 < free.sum() < 40
    assert osik.is_free(names["robot"], names["found"].q[free], names["scene"], srdf=True).all()


def panda_thousand_targets(names: Names) -> None:
    found = names["found"]
    assert found.converged.sum() > 700
    assert found.position_error[found.converged].max() < 1e-3
    assert names["ends"].shape == (1000, 7)
    assert np.isfinite(names["ends"]).all()


def tune_a_weight(names: Names) -> None:
    np.testing.assert_allclose(names["slope"], names["difference"], rtol=1e-5)
    assert names["history"][-1][1] < 0.5 * names["history"][0][1]


def retarget_a_person(names: Names) -> None:
    assert names["figures"]["feet"]["slip_mm_max"] < 0.1
    assert names["figures"]["joints"]["beyond_range_max"] == 0.0


def carry_a_box(names: Names) -> None:
    assert names["figures"]["touches"]["off_mm_max"] < 0.5
    assert names["figures"]["feet"]["slip_mm_max"] < 0.1
    assert names["figures"]["joints"]["beyond_range_max"] == 0.0 and not names["figures"]["notes"]


def pick_and_place(names: Names) -> None:
    motions, held = names["motions"], names["held"]
    assert osik.is_free(names["robot"], motions[0].position, names["scene"], srdf=True).all()
    assert osik.is_free(names["robot"], motions[1].position, held, srdf=True).all()
    np.testing.assert_allclose(motions[0].position[-1], motions[1].position[0], atol=1e-9)


def ur5e_calibrated(names: Names) -> None:
    assert names["found"].converged and not names["found"].unobservable
    assert names["off"].max() < 1e-4
    found = names["found"].values  # the maker's parameters of both arms
    assert abs(found["body_position[shoulder_link].z"] - (0.1625 - 0.089159)) < 2e-5
    assert abs(found["frame_position[tool0].y"] - (0.0996 - 0.0823)) < 2e-5


def hand_eye(names: Names) -> None:
    assert names["found"].converged and names["missed"] < 0.5 and names["turned"] < 0.05


def panda_placed(names: Names) -> None:
    found = names["found"]
    assert found.is_reached.all() and np.isfinite(names["slope"]).all()


def tiago_parks(names: Names) -> None:
    assert names["found"].is_reached.all()


CHECKS: list[Callable[[Names], None]] = [
    ur5_pose, panda_draws, xarm_elbow, so101_pose, so101_teleoperation, so101_chunks, weld_line, allegro_grasp,
    tiago_drives, go2_body, g1_reaches, nao_one_foot, baxter_two_arms, ur5_keeps_off_a_post, panda_thousand_targets,
    tune_a_weight, retarget_a_person, carry_a_box, collision_free, pick_and_place, ur5e_calibrated, hand_eye,
    panda_placed, tiago_parks,
]  # fmt: skip


IN_THE_GATE = [so101_teleoperation, retarget_a_person]
AT_NIGHT = [check for check in CHECKS if check not in IN_THE_GATE]


@pytest.mark.variants(slow=[check.__name__ for check in IN_THE_GATE], release=[check.__name__ for check in AT_NIGHT])
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
@pytest.mark.filterwarnings("error::osik_jax.OsikWarning")
def test_runs(
    check: Callable[[Names], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("Agg")
    try:
        names = runpy.run_path(str(FOLDER / f"{check.__name__}.py"))
    finally:
        plt.close("all")
        jax.config.update("jax_enable_x64", True)
    check(names)
    assert len(capsys.readouterr().out.splitlines()) >= 2
    assert os.listdir(tmp_path) == [f"{check.__name__}.png"]
    with Image.open(tmp_path / f"{check.__name__}.png") as picture:
        assert len(picture.convert("RGB").getcolors(1 << 24) or ()) > 200


def test_each_example_is_short_tested_and_in_the_gallery() -> None:
    sources = sorted(path for path in FOLDER.glob("*.py") if path.stem != "__main__")
    assert [path.stem for path in sources] == sorted(check.__name__ for check in CHECKS)
    assert max(len(path.read_text().splitlines()) for path in sources) <= 60
    shown = re.findall(r"images/examples/(\w+)\.png", GALLERY.read_text())
    assert sorted(shown) == [path.stem for path in sources]
    pictures = {path.stem: path.stat().st_size for path in (GALLERY.parent / "images" / "examples").iterdir()}
    assert sorted(pictures) == [path.stem for path in sources]
    assert max(pictures.values()) <= 60_000
