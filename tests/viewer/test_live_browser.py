"""A live view in a real browser: Chromium drags targets with its mouse, through the page's own websocket."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from motion_files import dancer, write_bvh
from playwright.sync_api import Page, sync_playwright
from scipy.spatial.transform import Rotation
from waiting import steps_of, until

import osik_jax as osik
from osik_jax.cli import Retarget, View
from osik_jax.robot._mujoco import mujoco_frame_pose, mujoco_poses
from osik_jax.viewer import export_html
from osik_jax.viewer.live._open import default_session
from osik_jax.viewer.live._page import LiveView

pytestmark = pytest.mark.slow
ROBOT = osik.load_robot("nao")
FEET, HAND = ("l_sole", "r_sole"), "l_gripper"
ARGUMENTS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
SIZE = {"width": 900, "height": 600}
HERE = ("http://127.0.0.1", "ws://127.0.0.1", "blob:", "data:", "file:")


class Visit:
    """A page, what it asked for and what it complained about."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.requests: list[str] = []
        self.errors: list[str] = []
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("websocket", lambda socket: self.requests.append(socket.url))
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("console", lambda told: self.errors.append(told.text) if told.type == "error" else None)

    def check(self) -> None:
        assert self.requests and all(url.startswith(HERE) for url in self.requests), self.requests
        assert not self.errors, self.errors


@pytest.fixture(scope="module")
def visit() -> Iterator[Visit]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        page = browser.new_context(viewport=SIZE).new_page()  # type: ignore[arg-type]
        page.set_default_timeout(120_000)
        yield Visit(page)
        browser.close()


@pytest.fixture(scope="module")
def view() -> Iterator[LiveView]:
    polygon = osik.support_polygon(ROBOT, ROBOT.q0, FEET, margin=0.01)
    session = default_session(ROBOT, feet=FEET, polygon=polygon, source="nao")
    with LiveView(session, host="127.0.0.1", port=0) as view:
        assert view.loop.wait_until_ready(120.0)
        yield view


def target(view: LiveView) -> np.ndarray:
    task: Any = view.session.tasks[HAND]
    return np.asarray(task.target[0])


def away(view: LiveView) -> float:
    """Of the hand from its target, as MuJoCo has it [m]."""
    data = next(mujoco_poses(ROBOT, view.loop.snapshot.q))
    return float(np.linalg.norm(mujoco_frame_pose(ROBOT, data, HAND)[0] - target(view)))


def pixel(view: LiveView, point: np.ndarray) -> tuple[float, float]:
    """Where the first visitor sees a point of the world."""
    clients = view._server.get_clients()
    camera = clients[min(clients)].camera
    turn = Rotation.from_quat(np.asarray(camera.wxyz)[[1, 2, 3, 0]]).as_matrix()
    right, down, deep = turn.T @ (point - camera.position)
    scale = 0.5 * camera.image_height / np.tan(0.5 * camera.fov) / deep
    return 0.5 * camera.image_width + scale * right, 0.5 * camera.image_height + scale * down


def drag(view: LiveView, page: Page, axis: np.ndarray, by: float) -> None:
    """Takes the arrow of the hand's handle along an axis, and moves it by a length [m]."""
    pull(view, page, target(view) + 0.75 * view._gizmos._scale * axis, axis, by)


def pull(view: LiveView, page: Page, grip: np.ndarray, axis: np.ndarray, by: float) -> None:
    """Moves what is at a point along an axis by a length [m]."""
    start, end = pixel(view, grip), pixel(view, grip + by * axis)
    page.mouse.move(*start)
    let_it_draw(page, 500)
    page.mouse.down()
    for part in np.linspace(0.0, 1.0, 9)[1:]:
        page.mouse.move(*(start[k] + part * (end[k] - start[k]) for k in range(2)))
        let_it_draw(page, 100)
    page.mouse.up()
    let_it_draw(page, 500)


def let_it_draw(page: Page, milliseconds: float) -> None:
    """Waits so long, and until the page has drawn a few pictures, which takes longer on a busy machine."""
    page.wait_for_timeout(milliseconds)
    for _ in range(3):
        page.evaluate("() => new Promise((drawn) => requestAnimationFrame(drawn))")


def enter(view: LiveView, page: Page) -> None:
    """Opens the view in the page, unless it is open there."""
    if page.url.rstrip("/") != view.url.rstrip("/"):
        page.goto(view.url)
        assert until(lambda: len(view._server.get_clients()) == 1)
    page.get_by_text("running").first.wait_for()
    let_it_draw(page, 3000)


@pytest.mark.release
def test_dragging_switching_and_reaching_too_far(view: LiveView, visit: Visit, tmp_path: Path) -> None:
    page, ahead, up = visit.page, np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    enter(view, page)
    start = target(view)
    with steps_of(view.loop) as steps:
        drag(view, page, up, 0.05)
        assert target(view)[2] - start[2] == pytest.approx(0.05, abs=0.02)
        np.testing.assert_allclose(target(view)[:2], start[:2], atol=1e-6)
        assert until(lambda: away(view) < 1e-3)
        page.screenshot(path=tmp_path / "dragged.png")

        page.get_by_role("combobox", name="Scheme").click()
        page.get_by_role("option", name="Hierarchical QP").click()
        assert until(lambda: isinstance(view.session.scheme, osik.HierarchicalQP))
        assert view.loop.wait_until_ready(120.0)
        assert until(lambda: away(view) < 1e-3)

        drag(view, page, ahead, 0.4)
        assert target(view)[0] - start[0] > 0.3
        assert until(lambda: float(np.abs(view.loop.snapshot.velocity).max()) < 0.1)
        assert away(view) > 0.02
        page.screenshot(path=tmp_path / "out_of_reach.png")
        drag(view, page, ahead, -0.4)
        assert until(lambda: away(view) < 1e-3)
        page.screenshot(path=tmp_path / "back.png")

    q = np.array([step.q for step in steps])
    lower, upper, top = (
        np.asarray(part)[6:] for part in (ROBOT.position_lower, ROBOT.position_upper, ROBOT.velocity_limit)
    )
    assert np.all(np.abs(np.diff(q[:, 7:], axis=0)) <= top * view.loop.dt * (1.0 + 1e-9))
    assert np.all((q[:, 7:] >= lower) & (q[:, 7:] <= upper))
    assert view.loop.snapshot.failures == 0
    visit.check()


@pytest.mark.release
def test_a_visitor_who_leaves_in_the_middle_of_a_drag_while_another_stays(view: LiveView, visit: Visit) -> None:
    page = visit.page
    enter(view, page)
    other = page.context.new_page()
    other.goto(view.url)
    assert until(lambda: len(view._server.get_clients()) == 2)
    page.bring_to_front()
    grip = target(view) + 0.75 * view._gizmos._scale * np.array([0.0, 0.0, 1.0])
    page.mouse.move(*pixel(view, grip))
    let_it_draw(page, 500)
    page.mouse.down()
    page.mouse.move(*pixel(view, grip + np.array([0.0, 0.0, 0.3])), steps=4)
    assert until(lambda: bool(view._gizmos.held))
    page.goto("about:blank")
    assert until(lambda: len(view._server.get_clients()) == 1 and not view._gizmos.held)
    assert until(lambda: float(np.abs(view.loop.snapshot.velocity).max()) < 1e-2)
    assert until(lambda: away(view) < 1e-3)
    other.get_by_text("running").first.wait_for()
    other.close()
    assert until(lambda: not view._server.get_clients())


def test_an_exported_page_plays_without_a_server(visit: Visit, tmp_path: Path) -> None:
    q = np.tile(np.asarray(ROBOT.q0), (100, 1))
    q[:, ROBOT.joint_qpos_index("LShoulderPitch")] -= np.linspace(0.0, 1.5, 100)
    path = export_html(ROBOT, q, tmp_path / "nao.html", dt=0.05)
    page: Any = visit.page
    visit.requests.clear()
    page.goto(path.as_uri())
    clock = page.locator("input").first
    clock.wait_for()
    before = float(clock.input_value())
    page.wait_for_timeout(2000)
    assert float(clock.input_value()) != before
    page.screenshot(path=tmp_path / "exported.png")
    visit.check()


@pytest.mark.release
def test_a_retargeted_motion_plays_beside_the_person(visit: Visit, tmp_path: Path) -> None:
    clip = write_bvh(tmp_path / "dance.bvh", dancer(40), 0.01)
    assert Retarget(clip=str(clip), out=tmp_path / "out").run() == 0
    assert View(file=tmp_path / "out" / "motion.npz", html=tmp_path / "motion.html", browser=False).run() == 0
    page: Any = visit.page
    visit.requests.clear()
    page.goto((tmp_path / "motion.html").as_uri())
    slider = page.locator("#root [role=slider]").first
    slider.wait_for(state="attached")
    assert float(slider.get_attribute("aria-valuemax")) == pytest.approx(40 / 30, abs=1e-6)
    seen = set()
    assert until(lambda: len(seen.add(slider.get_attribute("aria-valuenow")) or seen) > 3)
    page.screenshot(path=tmp_path / "retargeted.png")
    visit.check()
