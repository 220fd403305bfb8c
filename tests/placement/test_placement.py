"""Placements judged by MuJoCo C: tips at the poses, distances to the scene, and bases that stand free."""

import dataclasses
import json
from typing import Any

import mujoco
import numpy as np
import pytest
from refusals import refuses

import osik_jax as osik
from osik_jax.cli import main
from osik_jax.core import _library
from osik_jax.placement import Placement, Team, compare_placements, place_base, place_robots

pytestmark = pytest.mark.skipif(not _library.installed(), reason="no compiled core")

ARM = """
<body name="stand" pos="{pos}" euler="0 0 {yaw}">
  <geom name="stand" type="box" size="0.08 0.12 0.1" pos="0.02 0 0.1"/>
  <body name="upper" pos="0 0 0.3"><joint name="pan" axis="0 0 1" range="-2.5 2.5"/>
    <joint name="lift" axis="0 1 0" range="-2 2"/>
    <geom name="upper" type="capsule" size="0.03" fromto="0.06 0 0 0.3 0 0" mass="1"/>
    <body name="lower" pos="0.35 0 0"><joint name="elbow" axis="0 1 0" range="-2.5 2.5"/>
      <geom name="lower" type="capsule" size="0.03" fromto="0.04 0 0 0.2 0 0" mass="1"/>
      <body name="hand" pos="0.25 0 0"><joint name="wrist" axis="0 1 0" range="-2 2"/>
        <geom name="hand" type="sphere" size="0.03" pos="0.04 0 0" mass="1"/><site name="tip" pos="0.1 0 0"/>
      </body>
    </body>
  </body>
</body>"""
PARTS = "stand", "upper", "lower", "hand"
BOXES = {"table": ([0.25, 0.4, 0.15], [0.6, 0.0, 0.15]), "lid": ([0.2, 0.4, 0.01], [0.65, 0.0, 0.7])}
GRID: dict[str, Any] = dict(x=np.linspace(-0.2, 0.8, 6), y=np.linspace(-0.6, 0.6, 5), yaw=[-0.5, 0.0, 1.5])


def mjcf(base: np.ndarray | None = None) -> str:
    """Return the arm alone, or on a base x, y, yaw, height among the boxes."""
    box = '<geom name="{}" type="box" size="{} {} {}" pos="{} {} {}"/>'.format
    boxes = "" if base is None else "".join(box(name, *size, *at) for name, (size, at) in BOXES.items())
    x, y, yaw, height = np.zeros(4) if base is None else base
    arm = ARM.format(pos=f"{x} {y} {height}", yaw=yaw)
    return f'<mujoco><compiler angle="radian"/><worldbody>{boxes}{arm}</worldbody></mujoco>'


def distance(model: mujoco.MjModel, data: mujoco.MjData, geoms: tuple[str, ...]) -> float:
    """Return MuJoCo's smallest distance of some geoms from the boxes [m]."""
    pairs = [(model.geom(a).id, model.geom(b).id) for a in geoms for b in BOXES]
    return min(mujoco.mj_geomDistance(model, data, *pair, 2.0, None) for pair in pairs)


@pytest.fixture(scope="module")
def arm() -> osik.Robot:
    return osik.Robot.from_mjcf(mjcf())


@pytest.fixture(scope="module")
def scene() -> osik.Scene:
    return osik.Scene({name: osik.CollisionShape.box(*box) for name, box in BOXES.items()})


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(0).uniform([0.4, -0.2, 0.4], [0.6, 0.2, 0.55], (10, 3))


@pytest.fixture(scope="module")
def found(arm: osik.Robot, scene: osik.Scene, points: np.ndarray) -> Placement:
    return place_base(arm, {"tip": points}, **GRID, scene=scene, clearance=0.01)


def test_the_best_base_reaches_all_poses_and_mujoco_sees_nothing_touch(arm, found, points):
    assert found.is_reached.all() and found.solution.converged.all()
    model = mujoco.MjModel.from_xml_string(mjcf(found.best))
    data = mujoco.MjData(model)
    for q, point in zip(found.q, points, strict=True):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        assert np.linalg.norm(data.site("tip").xpos - point) < 1e-3
        assert distance(model, data, PARTS) > 0.01 - 1e-6
    lower, upper = np.asarray(arm.position_lower), np.asarray(arm.position_upper)
    margin = (np.minimum(found.q - lower, upper - found.q) / (upper - lower)).min(1)
    assert np.allclose(found.best_margin, margin)
    assert margin.min() > np.nanmax(found.margin[found.reached == len(points)])  # the search has improved the grid's


def moved_q(base: np.ndarray, q: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, float]:
    """Return MuJoCo's nearest configuration with the tip at the point, and the tip's index of Yoshikawa there."""
    model = mujoco.MjModel.from_xml_string(mjcf(base))
    data, matrix = mujoco.MjData(model), np.zeros((6, 4))
    data.qpos[:] = q
    for _ in range(4):
        mujoco.mj_forward(model, data)
        mujoco.mj_jacSite(model, data, matrix[:3], matrix[3:], model.site("tip").id)
        data.qpos[:] += np.linalg.pinv(matrix[:3]) @ (point - data.site("tip").xpos)
    mujoco.mj_forward(model, data)
    mujoco.mj_jacSite(model, data, matrix[:3], matrix[3:], model.site("tip").id)
    return data.qpos.copy(), float(np.sqrt(np.linalg.det(matrix.T @ matrix)))


def test_the_gradient_is_that_of_central_differences_of_mujoco(arm, found, points):
    slope, lower, upper = found.gradient, np.asarray(arm.position_lower), np.asarray(arm.position_upper)
    for k, step in [(k, step) for k in (0, 3, 7) for step in 1e-5 * np.eye(4)]:
        # from configurations on the point, or the first correction would count as motion
        start = moved_q(found.best, found.q[k], points[k])[0]
        ends = [moved_q(found.best + sign * step, start, points[k]) for sign in (1.0, -1.0)]
        margins = [(np.minimum(q - lower, upper - q) / (upper - lower)).min() for q, _ in ends]
        at = step.argmax()
        assert np.allclose(slope.q[k, :, at], (ends[0][0] - ends[1][0]) / 2e-5, atol=1e-5)
        assert np.isclose(slope.margin[k, at], (margins[0] - margins[1]) / 2e-5, atol=1e-5)
        assert np.isclose(slope.manipulability[k, at], (ends[0][1] - ends[1][1]) / 2e-5, atol=1e-5)


def test_the_climb_leaves_no_base_nearby_with_a_larger_margin(arm, scene, points):
    grid: dict[str, Any] = dict(GRID, x=[-0.2, 0.0], y=[0.0, 0.3], yaw=[0.0])
    kept = place_base(arm, {"tip": points}, **grid, scene=scene, refine=0)
    climbed = place_base(arm, {"tip": points}, **grid, scene=scene)
    assert kept.is_reached.all() and climbed.is_reached.all()
    # the best of a fine grid of bases, with the configurations that searches find
    fine: dict[str, Any] = dict(x=np.linspace(-0.2, 0.0, 9), y=np.linspace(0.0, 0.3, 9), yaw=[0.0])
    best = place_base(arm, {"tip": points}, **fine, scene=scene, refine=0)
    assert climbed.best_margin.min() > kept.best_margin.min() + 0.005
    assert climbed.best_margin.min() > best.best_margin.min() - 0.005
    assert (climbed.best >= [-0.2, 0.0, 0.0, 0.0]).all() and (climbed.best <= [0.0, 0.3, 0.0, 0.0]).all()


def test_a_yaw_of_a_whole_turn_has_no_ends(arm, points):
    """The best rotation is between the last one of the grid and the first."""
    turn = np.array([[np.cos(-0.75), -np.sin(-0.75), 0.0], [np.sin(-0.75), np.cos(-0.75), 0.0], [0.0, 0.0, 1.0]])
    given: dict[str, Any] = dict(x=0.0, y=0.0, seeds=8)
    found = place_base(arm, {"tip": points @ turn.T}, **given, yaw=4)
    bounded = place_base(arm, {"tip": points @ turn.T}, **given, yaw=[0.0, 1.0, 2.0])
    assert bounded.best[2] >= 0.0 and not 0.0 <= found.best[2] <= 1.5 * np.pi
    assert found.best_margin.min() > bounded.best_margin.min() + 0.01


@pytest.mark.slow
def test_poses_too_far_are_counted_and_searched_for_nowhere(arm, scene):
    far = np.array([[0.3, 0.0, 0.4], [5.0, 0.0, 0.4]])
    found = place_base(arm, {"tip": far}, x=[0.0, 0.1, 4.5], y=0.0, yaw=[0.0], scene=scene, refine=1)
    assert found.too_far.ravel().tolist() == [1, 1, 1] and found.reached.ravel().tolist() == [1, 1, 1]
    said = "of 3 bases of the grid 0 reach all poses, 0 do not stand free, 3 have a pose out of reach"
    assert said in found.explain()
    none = place_base(
        arm, {"tip": far + np.array([0.0, 9.0, 0.0])}, x=[0.0, 0.1], y=0.0, yaw=[0.0], scene=scene, refine=1
    )
    assert not none.reaches.any() and np.isnan(none.gradient.margin).all()


def test_fewer_searches_find_the_base_that_all_searches_find(arm, scene, points):
    grid: dict[str, Any] = dict(x=np.linspace(-0.2, 0.8, 11), y=np.linspace(-0.6, 0.6, 9), yaw=[0.0], refine=0)
    found = place_base(arm, {"tip": points}, **grid, scene=scene)
    every = place_base(arm, {"tip": points}, **grid, scene=scene, seeds=256)  # an eighth of them is 32
    assert found.reached.max() == every.reached.max() == len(points)
    assert (found.reached <= every.reached).all() and (found.reached.sum() > 0.9 * every.reached.sum())
    full = every.reached == len(points)
    assert (found.reached[full] == len(points)).all()


def test_the_bases_that_reach_all_poses_are_those_that_all_searches_find(arm, scene, points):
    """With 8 searches the first round is one search, after which the best bases lack nothing."""
    grid: dict[str, Any] = dict(x=np.linspace(-0.2, 0.8, 11), y=np.linspace(-0.6, 0.6, 7), yaw=[0.0], refine=0, seeds=8)
    found = place_base(arm, {"tip": points[:1]}, **grid, scene=scene)
    for at in np.argwhere(found.stands_free):
        shift = np.array([found.x[at[0]], found.y[at[1]], 0.0])
        boxes = {name: osik.CollisionShape.box(size, center - shift) for name, (size, center) in BOXES.items()}
        alone = osik.inverse_kinematics(
            arm, {"tip": points[0] - shift}, scene=osik.Scene(boxes), seeds=8, restarts=0, closest=False
        )
        assert found.reached[tuple(at)] == alone.converged


def test_which_bases_stand_free_is_as_mujoco_says(found):
    gaps = np.zeros(found.reached.shape)
    for at in np.ndindex(gaps.shape):
        model = mujoco.MjModel.from_xml_string(mjcf(base_at(found, at)))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        gaps[at] = distance(model, data, ("stand",))
    apart = gaps > 0.0
    assert apart.any() and not apart.all()  # some bases are in the table
    assert np.allclose(found.base_clearance[apart], gaps[apart], atol=1e-6)
    assert ((found.base_clearance < 0.0) == ~apart).all()
    assert (found.reached[~found.stands_free] == 0).all()
    blocked = int((~found.stands_free).sum())
    assert found.blocked_by == {("table", "stand"): blocked}
    assert f"{blocked} do not stand free (table and stand: {blocked})" in found.explain()


def base_at(found: Placement, at: tuple[int, ...]) -> np.ndarray:
    axes = found.x, found.y, found.yaw, found.height
    return np.array([axis[k] for axis, k in zip(axes, at, strict=True)])


def test_a_base_of_the_grid_gets_what_a_search_for_it_alone_gets(arm, found, points):
    for at in [(1, 2, 1, 0), (0, 1, 1, 0), (2, 4, 0, 0)]:
        (x, y, yaw, _), turn = base_at(found, at), np.eye(3)
        turn[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        boxes = {
            n: osik.CollisionShape.box(size, np.subtract(p, [x, y, 0]) @ turn, turn.T) for n, (size, p) in BOXES.items()
        }
        there = (points - [x, y, 0.0]) @ turn
        alone = osik.inverse_kinematics(arm, {"tip": there}, scene=osik.Scene(boxes), clearance=0.01)
        assert found.stands_free[at] and found.reached[at] == alone.converged.sum()


def test_a_pose_in_the_table_is_reached_by_no_base_and_the_answer_says_why(arm, scene, points):
    poses = np.concatenate([points[:2], [[0.5, 0.0, 0.25]]])
    found = place_base(arm, {"tip": poses}, x=[-0.1, 0.1], y=0.0, yaw=[0.0], scene=scene, refine=1)
    assert found.reached.max() == 2 and found.is_reached.tolist() == [True, True, False]
    assert np.isnan(found.q[2]).all() and "pose 2: not found" in found.explain() and "table" in found.explain()


def test_a_footprint_and_what_the_base_may_touch_count(arm, scene, points):
    wide = osik.CollisionShape.box([0.3, 0.1, 0.05], [0.0, 0.0, 0.05])
    given: dict[str, Any] = dict(x=[0.1], y=[0.0], yaw=[0.0], refine=0)
    found = place_base(arm, {"tip": points}, **given, scene=scene)
    assert np.isclose(found.base_clearance, 0.15, atol=1e-6)
    said = r"stands free: at the best one table and footprint are -.*allow\(\('table', 'footprint'\)\)"
    refuses(ValueError, said, place_base, arm, {"tip": points}, **given, scene=scene, footprint=wide)
    on = place_base(arm, {"tip": points}, x=[0.6], y=[0.0], yaw=[0.0], refine=0, scene=scene.allow(("table", "stand")))
    assert on.base_clearance > 0.0


@pytest.fixture(scope="module")
def around(arm: osik.Robot, scene: osik.Scene) -> tuple[np.ndarray, Placement]:
    """Points over the whole table, and the placement of one arm, which does not reach them all."""
    points = np.random.default_rng(1).uniform([0.35, -0.8, 0.35], [0.85, 0.8, 0.5], (14, 3))
    grid: dict[str, Any] = dict(x=np.linspace(-0.2, 1.4, 9), y=np.linspace(-1.0, 1.0, 9), yaw=[0.0, 3.0])
    return points, place_base(arm, {"tip": points}, **grid, scene=scene, clearance=0.01)


@pytest.fixture(scope="module")
def team(around) -> Team:
    return place_robots({"a": around[1], "b": around[1]})


def two_arms(bases: np.ndarray) -> tuple[mujoco.MjModel, mujoco.MjData, list[tuple[int, int]]]:
    """Return MuJoCo's model of two arms on their bases (2, 4), and all pairs of a shape of each."""
    bodies = [mjcf(base).split("<worldbody>")[1].split("</worldbody>")[0] for base in bases]
    boxes, arms = bodies[0][: bodies[0].index("<body")], [body[body.index("<body") :] for body in bodies]
    arms = [body.replace('name="', f'name="{name}_') for body, name in zip(arms, "ab", strict=True)]
    text = f'<mujoco><compiler angle="radian"/><worldbody>{boxes}{"".join(arms)}</worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(text)
    pairs = [(model.geom(f"a_{first}").id, model.geom(f"b_{second}").id) for first in PARTS for second in PARTS]
    return model, mujoco.MjData(model), pairs


def test_two_robots_reach_more_and_mujoco_sees_them_keep_clear(around, arm, team):
    (points, one), (model, data, pairs) = around, two_arms(team.bases)
    assert team.is_reached.sum() > one.is_reached.sum()
    # no pair of bases of the grid reaches more, whether it keeps clear or not
    reaches = one.reaches.reshape(-1, len(points)).astype(int)
    together = reaches.sum(1)[:, None] + reaches.sum(1) - reaches @ reaches.T
    assert team.is_reached.sum() <= together.max() <= team.is_reached.sum() + 1
    for k, owner in enumerate(team.robot):
        if owner < 0:
            continue
        name = "ab"[owner]
        data.qpos[:] = np.tile(arm.q0, 2)
        data.qpos[4 * owner : 4 * owner + 4] = team.q[owner][k]
        mujoco.mj_forward(model, data)
        assert np.linalg.norm(data.site(f"{name}_tip").xpos - points[k]) < 1e-3
        assert distance(model, data, tuple(f"{name}_{part}" for part in PARTS)) > 0.01 - 1e-6
        assert min(mujoco.mj_geomDistance(model, data, *pair, 2.0, None) for pair in pairs) > 0.01 - 1e-6
    taken = [(team.robot == k).sum() for k in (0, 1)]
    assert min(taken) > 0 and sum(taken) == team.is_reached.sum() and f"takes {taken[1]}" in team.explain()


def test_robots_that_work_at_once_are_as_far_apart_as_mujoco_says(team):
    """The second arm stands nearer than it was placed, so some configurations overlap."""
    near = dataclasses.replace(team, bases=team.bases + np.array([[0.0] * 4, [-0.3, -0.5, 0.0, 0.0]]))
    model, data, pairs = two_arms(near.bases)
    found, seen = near.distances("a", "b"), 0
    assert not np.array_equal(found, found.T, equal_nan=True)
    np.testing.assert_allclose(near.distances("b", "a").T, found, atol=1e-6)
    for k, row in enumerate(found):
        for column, own in enumerate(row):
            known = np.isfinite(team.q[0][k]).all() and np.isfinite(team.q[1][column]).all()
            assert np.isfinite(own) == known
            if known:
                data.qpos[:] = np.concatenate([team.q[0][k], team.q[1][column]])
                mujoco.mj_forward(model, data)
                wanted = min(mujoco.mj_geomDistance(model, data, *pair, 2.0, None) for pair in pairs)
                assert abs(own - wanted) < 1e-4 or max(own, wanted) < 0.0
                seen += 1
    assert seen > 20 and np.nanmin(found) < 0.01 < np.nanmax(found)
    refuses(KeyError, "no robot 'c'", team.distances, "a", "c")


def test_a_picture_of_a_team_has_its_robots_and_their_poses(team):
    place = team.figure().axes[0]
    text = [label.get_text() for label in place.get_legend().get_texts()]
    assert [f"takes {(team.robot == k).sum()} poses" in own for k, own in enumerate(text[-2:])] == [True, True]
    dots = [line for line in place.lines if line.get_marker() == "."]
    assert [len(line.get_xdata()) for line in dots] == [(team.robot == k).sum() for k in (0, 1)]


def test_robots_of_other_poses_or_without_a_scene_are_refused(around, arm, points):
    _, one = around
    alone = place_base(arm, {"tip": points}, x=0.0, y=0.0, yaw=1, refine=0)
    refuses(ValueError, r"poses of each: {'a': 14}", place_robots, {"a": one})
    refuses(ValueError, r"poses of each: {'a': 14, 'b': 10}", place_robots, {"a": one, "b": alone})
    refuses(ValueError, "has no scene", place_robots, {"a": alone, "b": alone})


def test_a_longer_tool_is_compared_with_a_shorter_one(found, scene, points):
    other = osik.Robot.from_mjcf(mjcf().replace('pos="0.1 0 0"', 'pos="0.02 0 0"'))
    short = place_base(other, {"tip": points}, **GRID, scene=scene, clearance=0.01)
    lines = compare_placements({"long": found, "short": short}).splitlines()
    for line, name, one in zip(lines[1:], ("long", "short"), (found, short), strict=True):
        full = (one.reached == len(points)).sum()
        assert line.split()[:4] == [name, str(one.is_reached.sum()), "of", "10"] and f"{full} of 90" in line
    assert lines[1].split()[1:] != lines[2].split()[1:]


def test_the_command_writes_the_base(tmp_path, monkeypatch, capsys, points):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.xml").write_text(mjcf())
    np.savetxt("poses.csv", points[:3], delimiter=",", header="x,y,z", comments="")
    command = "place --robot arm.xml --frame tip --poses poses.csv --x -0.2 0.2 3 --y 0 0 1 --yaw 1"
    assert main(command.split()) == 0
    assert "3 of 3 poses reached" in capsys.readouterr().out
    written = json.loads((tmp_path / "osik-placement" / "placement.json").read_text())
    assert len(written["q"]) == 3 and (tmp_path / "osik-placement" / "placement.png").stat().st_size > 10_000
