"""The demonstration: references, figures beside MuJoCo C's, and the numbers that the motions have to reach."""

from types import SimpleNamespace
from typing import Any, cast

import jax
import mujoco
import numpy as np
import pytest
from mujoco_states import mujoco_at
from PIL import Image
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax.demo import _nao
from osik_jax.demo._demo import run_demo
from osik_jax.demo._figures import Figure, comparison, figures, table
from osik_jax.demo._motion import Path, Stroke, minimum_jerk
from osik_jax.demo._observed import observe
from osik_jax.demo._run import Run, make_scheme, run_scheme

DT = 0.005
FEET = ("l_sole", "r_sole")


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A demonstration of half a second: its folder, table, motion and run."""
    folder, motion = tmp_path_factory.mktemp("demo"), _nao.double_support(0.5)
    shown, (run,) = run_demo(motion, folder, schemes=("weighted",), dt=DT)
    return folder, shown, motion, run


def corners(data, *feet):
    return np.array([data.site(f"{foot}_corner_{k}").xpos[:2] for foot in feet for k in range(4)])


def turn(a, b):
    return np.linalg.norm(Rotation.from_matrix(a.reshape(3, 3) @ b.reshape(3, 3).T).as_rotvec())


def test_minimum_jerk_starts_and_ends_at_rest():
    t = np.linspace(0.0, 4.0, 401)
    value, rate = map(np.asarray, minimum_jerk(t, 1.0, 2.0))
    assert value[0] == value[100] == 0.0 and value[300] == value[-1] == 1.0
    assert rate[100] == rate[300] == 0.0
    np.testing.assert_allclose(rate[1:-1], (value[2:] - value[:-2]) / 0.02, atol=2e-4)
    assert rate.max() == pytest.approx(1.875 / 2.0)


def test_path_velocity_is_the_rate_of_its_position():
    rotation = Rotation.from_euler("xyz", [0.3, -0.2, 0.5]).as_matrix()
    strokes = (Stroke(0.0, 2.0, (0.1, -0.2, 0.3)), Stroke(1.0, 3.0, (0.0, 0.1, 0.0)))
    path, h = Path(np.array([0.1, 0.2, 0.3]), rotation, strokes), 1e-5
    at = jax.jit(path.at)
    for t in (0.7, 1.5, 2.2):
        (_, R), velocity = at(t)
        np.testing.assert_allclose(velocity[:3], (at(t + h)[0][0] - at(t - h)[0][0]) / (2 * h), atol=1e-8)
        np.testing.assert_array_equal(velocity[3:], 0.0)
        np.testing.assert_array_equal(R, rotation)
    np.testing.assert_allclose(at(3.0)[0][0], [0.2, 0.1, 0.6], atol=1e-12)


def test_the_polygon_shrinks_from_both_feet_to_one(nao):
    """At the ends it touches the polygon of both feet from outside; in the middle it is that of the left foot."""
    both = osik.support_polygon(nao, nao.q0, ("l_sole", "r_sole"), margin=0.01)
    foot = osik.support_polygon(nao, nao.q0, ("l_sole",), margin=0.01)
    tasks = _nao.single_support(8.0).tasks

    def polygon_at(t: float) -> osik.SupportPolygon:
        task = tasks(t)["com"]
        assert isinstance(task, osik.ComTask) and task.polygon is not None
        return task.polygon

    for t in (0.0, 8.0):
        polygon = polygon_at(t)
        beyond = np.asarray(both.vertices) @ np.asarray(polygon.normals).T - np.asarray(polygon.offsets)
        np.testing.assert_allclose(beyond.max(0), 0.0, atol=1e-12)
    np.testing.assert_allclose(polygon_at(4.0).offsets, foot.offsets, atol=1e-12)
    early = np.asarray(polygon_at(1.0).offsets)
    assert (early <= np.asarray(polygon_at(0.0).offsets) + 1e-12).all()
    assert (early >= np.asarray(foot.offsets) - 1e-12).all() and early.sum() > np.asarray(foot.offsets).sum() + 1e-3


def test_a_motion_made_by_hand(nao):
    """The whole robot slides and one knee goes past its limit: every number is known beforehand, or by MuJoCo."""
    motion = _nao.double_support(1.0)
    q = np.tile(np.asarray(nao.q0), (11, 1))
    q[:, 0] += 0.001 * np.arange(11)
    knee, dof = nao.joint_qpos_index("LKneePitch"), nao.joint_dof_index("LKneePitch")
    low, top = float(nao.position_lower[dof]), float(nao.position_upper[dof])
    q[10, knee] = top + 0.1
    seen = observe(motion, q, 0.1)
    np.testing.assert_allclose(seen.drift[:10], 0.001 * np.arange(10), atol=1e-12)
    np.testing.assert_allclose(seen.turn[:10], 0.0, atol=1e-7)
    first, last = mujoco_at(nao, q[0]), mujoco_at(nao, q[10])
    assert seen.drift[10] == pytest.approx(np.linalg.norm(last.site("l_sole").xpos - first.site("l_sole").xpos))
    assert seen.turn[10] == pytest.approx(turn(last.site("l_sole").xmat, first.site("l_sole").xmat))
    wanted = jax.jit(jax.vmap(motion.goals["waist"].path.at))(0.1 * np.arange(11))[0][0]
    np.testing.assert_allclose(seen.off_path("waist"), np.linalg.norm(q[:, :3] - wanted, axis=1), atol=1e-12)
    hull = corners(first, "l_sole", "r_sole")
    hull = hull[ConvexHull(hull).vertices]
    equations = ConvexHull(hull).equations
    for k in (0, 5, 10):
        com = mujoco_at(nao, q[k]).subtree_com[1]
        np.testing.assert_allclose(seen.com[k], com, atol=1e-12)
        assert seen.com_inside[k] == pytest.approx(-np.max(equations[:, :2] @ com[:2] + equations[:, 2]), abs=1e-12)
    velocity = np.zeros((10, nao.nv))
    velocity[3, dof] = 0.75 * float(nao.velocity_limit[dof])
    solution = SimpleNamespace(velocity=velocity, status=np.array([osik.solvers.Status.SOLVED] * 9 + [3]))
    rows = {row.label: row for row in figures(motion, Run("weighted", q, cast(Any, solution), 1.0, 2.0, seen))}
    assert rows["room to position limits (0 to 1)"].worst == pytest.approx(-0.2 / (top - low))
    assert rows["room to speed limits (0 to 1)"].worst == pytest.approx(0.25)
    assert rows["steps not solved"].worst == 1 and rows["a step [µs]"].worst == pytest.approx(2e5)
    missed = {label for label, row in rows.items() if row.missed}
    feet = {"standing feet, drift [mm]", "standing feet, turn [mrad]"}
    assert missed == feet | {"room to position limits (0 to 1)", "steps not solved"}
    cells = [cell for column in table("x", {"weighted": list(rows.values())}).columns for cell in column.cells]
    assert {"[red]1[/red]", f"[red]{-0.2 / (top - low):.2g}[/red]", "0.25"} <= set(cells)


def check_requirements(motion, run, lifted=None):
    """What issue 2 asks of the hierarchical scheme, from MuJoCo C alone; ``lifted``: steps with the right foot up."""
    robot = motion.robot
    first = mujoco_at(robot, run.q[0])
    hulls = {feet: ConvexHull(corners(first, *feet)).equations for feet in (("l_sole", "r_sole"), ("l_sole",))}
    paths = jax.jit(jax.vmap(motion.goals["waist"].path.at))(DT * np.arange(len(run.q)))[0][0]
    for k, data in enumerate(mujoco_at(robot, q) for q in run.q):
        feet = ("l_sole",) if lifted is not None and lifted[0] < DT * k < lifted[1] else ("l_sole", "r_sole")
        for foot in feet:
            assert np.linalg.norm(data.site(foot).xpos - first.site(foot).xpos) <= 1e-4, (k, foot)
            assert turn(data.site(foot).xmat, first.site(foot).xmat) <= 1e-4, (k, foot)
        com = data.subtree_com[1][:2]
        assert np.max(hulls[feet][:, :2] @ com + hulls[feet][:, 2]) <= 0.0, k
        assert np.linalg.norm(data.body("torso").xpos - np.asarray(paths[k])) <= 1e-3, k
    qpos = np.asarray(jax.vmap(robot.mujoco_qpos)(run.q))
    limited = robot.mj_model.jnt_limited.astype(bool)
    joints = qpos[:, robot.mj_model.jnt_qposadr[limited]]
    low, high = robot.mj_model.jnt_range[limited].T
    assert (joints >= low - 1e-9).all() and (joints <= high + 1e-9).all()
    assert (np.abs(run.solution.velocity) <= np.asarray(robot.velocity_limit)).all()
    assert (run.solution.status == osik.solvers.Status.SOLVED).all()


@pytest.mark.release
def test_double_support_reaches_its_numbers():
    """A motion of 8 s at 200 Hz."""
    motion = _nao.double_support()
    run = run_scheme(motion, "hierarchical", dt=DT)
    assert len(run.q) == 1601
    check_requirements(motion, run)
    waist = run.seen.moved["waist"]
    assert waist[700, 1] == pytest.approx(0.05, abs=1e-3)
    assert waist[-1, 1] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.release
def test_single_support_reaches_its_numbers():
    """A motion of 8 s at 200 Hz."""
    motion = _nao.single_support()
    run = run_scheme(motion, "hierarchical", dt=DT)
    check_requirements(motion, run, lifted=motion.stances[1].lifted)
    height = run.seen.moved["right_foot"][:, 2]
    assert height[780] == pytest.approx(0.055, abs=1e-3)
    assert run.seen.moved["left_hand"][780, 2] > 0.05


def test_files_and_figures_agree_with_mujoco(short, nao):
    """Velocities integrate to the configurations, by MuJoCo's own integration."""
    folder, shown, motion, run = short
    assert {p.name for p in folder.iterdir()} >= {"motion.gif", "comparison.png", "motion.npz"}
    arrays = np.load(folder / "motion.npz")
    assert arrays["q_weighted"].shape == (101, nao.nq) and arrays["v_weighted"].shape == (100, nao.nv)
    assert [column.header for column in shown.columns] == ["", "Weighted QP"]
    data = [mujoco_at(nao, q) for q in run.q]
    drift = max(np.linalg.norm(d.site(foot).xpos - data[0].site(foot).xpos) for d in data for foot in FEET)
    assert run.seen.drift.max() == pytest.approx(drift, rel=1e-6, abs=1e-12)
    hull = ConvexHull(corners(data[0], *FEET)).equations
    inside = min(-np.max(hull[:, :2] @ d.subtree_com[1][:2] + hull[:, 2]) for d in data)
    assert run.seen.com_inside.min() == pytest.approx(inside, rel=1e-9)
    missed = [row.label for row in figures(motion, run) if row.missed]
    assert not any("room" in label or "steps" in label or "mass" in label for label in missed)
    model = motion.robot.mj_model
    own, _ = motion.robot.tree.dof_columns[0]
    for k in (0, 30, 90):
        full = np.zeros(model.nv)
        a, b = (np.asarray(motion.robot.mujoco_qpos(run.q[i])) for i in (k, k + 1))
        mujoco.mj_differentiatePos(model, full, DT, a, b)
        np.testing.assert_allclose(full[own], run.solution.velocity[k], atol=1e-9)


def test_unknown_schemes_are_refused():
    with pytest.raises(KeyError, match="hierarchical"):
        make_scheme("magic")


def test_comparison_draws_the_curves_it_gets(tmp_path):
    """Schemes in one plot; what is only rounding about a constant, or 0 throughout, draws no curve."""
    time = np.linspace(0.0, 1.0, 11)
    curves = {"weighted": 1e-3 * (1.0 + time), "hierarchical": 1e-6 * (1.0 + time)}
    rows = {
        scheme: [
            Figure("drift [mm]", values, most=0.1, floor=1e-5),
            Figure("margin [mm]", values, least=0.0),
            Figure("steady", 0.5 + 1e-16 * np.sin(40.0 * time), span=0.1),
            Figure("zero", 0.0 * time, floor=1e-5),
            Figure("number", 3.0),
        ]
        for scheme, values in curves.items()
    }
    page = comparison("x", rows, 0.1)
    page.savefig(tmp_path / "f.png")
    log, linear, steady, zero = page.axes[:4]
    assert [bool(axes.lines) for axes in page.axes] == [True] * 4 + [False] * 2
    np.testing.assert_allclose(np.asarray(log.lines[0].get_xydata()), np.stack([time, curves["weighted"]], -1))
    np.testing.assert_allclose(np.asarray(log.lines[1].get_ydata()), 1e-5)
    np.testing.assert_allclose(np.asarray(linear.lines[1].get_ydata()), curves["hierarchical"])
    assert log.get_yscale() == "log" and log.get_ylim()[1] > 0.1 and linear.get_ylim()[0] < 0.0
    assert np.ptp(steady.get_ylim()) >= 0.1 and zero.get_ylim() == pytest.approx((1e-5, 1e-3))
    with Image.open(tmp_path / "f.png") as picture:
        assert picture.size == tuple(round(x) for x in page.get_size_inches() * page.dpi)
