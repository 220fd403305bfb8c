"""A map of what a frame reaches in a page, without a browser: the slice's picture, the panel, the robot."""

from __future__ import annotations

import dataclasses
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from made_up_map import ORIENTATIONS, WHOLE, X, Y, Z, made_up_map
from waiting import until

import osik_jax as osik
from osik_jax.cli import main
from osik_jax.reachability._map import ReachabilityMap
from osik_jax.robot._mujoco import mujoco_poses
from osik_jax.viewer import serve_reach
from osik_jax.viewer.live._open import is_map, open_map
from osik_jax.viewer.live._reach import _FAINT, ReachView, slice_picture, slice_words

ARM = osik.load_robot("arm7")


@pytest.fixture(scope="module")
def found() -> ReachabilityMap:
    return made_up_map(ARM)


@pytest.fixture(scope="module")
def view(found: ReachabilityMap) -> Iterator[ReachView]:
    with serve_reach(ARM, found, port=0) as view:
        yield view


def turned(vectors: np.ndarray, wxyz: np.ndarray) -> np.ndarray:
    """By MuJoCo."""
    out = np.empty_like(vectors)
    for own, vector in zip(out, vectors, strict=True):
        mujoco.mju_rotVecQuat(own, vector, wxyz)
    return out


@pytest.mark.parametrize(("across", "index"), [(0, 2), (1, 1), (2, 3)])
def test_each_pixel_is_coloured_by_the_position_that_is_nearest(
    found: ReachabilityMap, across: int, index: int
) -> None:
    made = slice_picture(found, across, index)
    rows, columns = (np.linspace(0, count - 1, 23).astype(int) for count in made.image.shape[:2])
    i, j = (k.ravel() for k in np.meshgrid(rows, columns, indexing="ij"))
    flat = [
        ((j + 0.5) / made.image.shape[1] - 0.5) * made.size[0],
        ((i + 0.5) / made.image.shape[0] - 0.5) * made.size[1],
    ]
    points = made.center + turned(np.stack([*flat, np.zeros(len(i))], 1), made.wxyz)
    np.testing.assert_allclose(points[:, across], (X, Y, Z)[across][index], atol=1e-12)
    cells = tuple(np.abs(axis - points[:, k, None]).argmin(1) for k, axis in enumerate((X, Y, Z)))
    share, beyond, shown = found.share[cells], found.beyond_reach[cells] > 0.0, made.image[i, j]
    np.testing.assert_array_equal(shown[:, 3] == 0, beyond)
    np.testing.assert_array_equal((shown == [230, 232, 235, _FAINT]).all(1), ~beyond & (share == 0.0))
    some = share > 0.0
    assert some.any() and len(np.unique(shown[some], axis=0)) == len(np.unique(share[some]))
    order = np.argsort(share[some])
    assert (np.diff(shown[some][order].sum(1).astype(int)) <= 0).all()  # darker where more is reached


def test_words_are_of_the_slice(found: ReachabilityMap) -> None:
    flat = dataclasses.replace(found, reached=np.zeros_like(found.reached))
    assert slice_words(flat, 1, 0).startswith("**y = -0.400 m**: 0 of 20 positions reached;")
    some = found.reached[:, :, 2].any(-1).sum()
    assert f"**z = 0.600 m**: {some} of 15 positions reached, on average in" in slice_words(found, 2, 2)


def test_the_page_shows_the_slice_that_is_asked_for(view: ReachView, found: ReachabilityMap) -> None:
    with urllib.request.urlopen(view.url) as answer:
        assert answer.status == 200 and b"<html" in answer.read(4000)
    for across, at, index in (("x", 0.33, 2), ("x", 9.0, 4), ("z", 0.1, 0)):
        view.show(across, at)  # type: ignore[arg-type]
        axis = "xyz".index(across)
        assert until(lambda axis=axis, index=index: view._drawn == (axis, index))
        made, picture = slice_picture(found, axis, index), view._picture
        assert picture is not None
        np.testing.assert_array_equal(picture.image, made.image)
        np.testing.assert_allclose(picture.position, made.center)
        np.testing.assert_allclose(picture.wxyz, made.wxyz)
        assert (picture.render_width, picture.render_height) == made.size
        assert view._words.content == slice_words(found, axis, index)
        assert [name for name, slider in view._sliders.items() if slider.visible] == [across]
    with pytest.raises(KeyError, match="no axis 'w'"):
        view.show("w", 0.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="at is nan; it is a coordinate"):
        view.show("x", float("nan"))


def test_a_click_puts_the_robot_there(view: ReachView, found: ReachabilityMap) -> None:
    """Where nothing is reached it stays, and where the click goes past the slice or away from it."""
    view.show("y", 0.0)
    assert until(lambda: view._drawn == (1, 1))
    cell, eye = WHOLE, np.array([1.0, -3.0, 2.0])
    goal = found.positions[cell] + np.array([0.1, 0.0, -0.05])
    view._clicked(event(eye, goal - eye))
    assert until(lambda: view._placed == cell)
    assert f"At **0.200 0.000 0.400** m: {ORIENTATIONS} of {ORIENTATIONS} orientations" in view._told.content
    assert standing_at(view, found.q[cell])
    for way in (eye - goal, np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])):
        view._clicked(event(eye, way))
        assert view._cell == cell
    hole = tuple(np.argwhere(~found.reached.any(-1))[0])
    assert not view.stand(found.positions[hole].tolist())
    assert view._cell == cell
    assert view.stand(None) and until(lambda: view._placed is None)
    assert standing_at(view, np.asarray(ARM.q0))


def event(origin: np.ndarray, way: np.ndarray) -> Any:
    return SimpleNamespace(ray_origin=tuple(origin), ray_direction=tuple(way / np.linalg.norm(way)))


def standing_at(view: ReachView, q: np.ndarray) -> bool:
    data = next(mujoco_poses(ARM, q))
    frames = view._nodes._frames
    return all(np.allclose(frame.position, data.xpos[body], atol=1e-6) for body, frame in frames.items())


def test_mistakes(found: ReachabilityMap) -> None:
    with pytest.raises(TypeError, match="found is 'map.npz'; it is a ReachabilityMap"):
        serve_reach(ARM, "map.npz", port=0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="the map is of another robot: of 'tool'"):
        serve_reach(ARM, dataclasses.replace(found, frame="tool"), port=0)


def test_the_command_opens_a_map(found: ReachabilityMap, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "map.npz"
    found.save(path)
    assert is_map(path) and not is_map(tmp_path / "nowhere.npz")
    with open_map(path, ARM, host="127.0.0.1", port=0) as view:
        np.testing.assert_array_equal(view.map.reached, found.reached)
    for arguments, told in (
        ([str(path)], "the map is of another robot"),  # NAO
        ([str(path), "--robot", "arm7", "--html", str(tmp_path / "page.html")], "--html goes with a motion.npz"),
    ):
        assert main(["view", "--no-browser", "--port", "0", *arguments]) == 2
        error = capsys.readouterr().err
        assert told in error and error.count("\n") == 1
