"""Ways around obstacles, judged by Pinocchio and coal on dense states."""

# pyright: reportArgumentType=false, reportOptionalMemberAccess=false, reportAttributeAccessIssue=false, reportAssignmentType=false
import tempfile
from pathlib import Path

import coal
import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from compilations import Compilations
from refusals import refuses

import osik_jax as osik
from osik_jax.collision import CollisionShape, Scene
from osik_jax.core import _library
from osik_jax.motion import Way, connect

pytestmark = pytest.mark.skipif(not _library.installed(), reason="no compiled core")
CRANE = """<robot name="crane"><link name="base"/>
  <link name="cart"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
  <link name="arm"><collision><origin xyz="0.3 0 0"/><geometry><box size="0.6 0.06 0.06"/></geometry></collision></link>
  <link name="hook"><collision><geometry><sphere radius="0.05"/></geometry></collision></link>
  <joint name="rail" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  <joint name="turn" type="revolute"><parent link="cart"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
  <joint name="drop" type="prismatic"><parent link="arm"/><child link="hook"/><origin xyz="0.6 0 0"/>
    <axis xyz="0 0 -1"/>
    <limit lower="0" upper="0.8" velocity="1" effort="1"/></joint></robot>"""
START, GOAL = np.array([-0.8, 0.0, 0.5]), np.array([0.2, 0.0, 0.5])


@pytest.fixture(scope="module")
def crane() -> osik.Robot:
    return osik.Robot.from_urdf(CRANE, floating_base=False)


def wall(height: float = 1.0) -> Scene:
    """A wall across the rail that the hook, which hangs low, has to be lifted over, or go around."""
    return Scene({"wall": CollisionShape.box([0.05, 0.5, height], [0.3, 0.0, -height - 0.1])}, capacity=2)


def states(way: Way, count: int = 2001) -> np.ndarray:
    return np.asarray(way.path.derivatives(jnp.linspace(0.0, 1.0, count))[0])


class Crane:
    """Least distance of the crane's links from obstacles, by coal."""

    def __init__(self):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "crane.urdf"
            path.write_text(CRANE)
            self.model = pin.buildModelFromUrdf(str(path))
            self.geometry = pin.buildGeomFromUrdf(self.model, str(path), pin.GeometryType.COLLISION)
        self.data = self.model.createData()

    def clearance(self, q: np.ndarray, obstacles: list[tuple[coal.CollisionGeometry, np.ndarray]]) -> float:
        pin.forwardKinematics(self.model, self.data, q)
        least, request = np.inf, coal.DistanceRequest()
        for thing in self.geometry.geometryObjects:
            at = self.data.oMi[thing.parentJoint] * thing.placement
            own = coal.Transform3s(at.rotation, at.translation)
            for shape, place in obstacles:
                there = coal.Transform3s(np.eye(3), place)
                least = min(least, coal.distance(thing.geometry, own, shape, there, request, coal.DistanceResult()))
        return least


WALL = [(coal.Box(0.1, 1.0, 2.0), np.array([0.3, 0.0, -1.1]))]


def test_a_way_is_free_between_its_ends_and_smooth(crane):
    way, judge = connect(crane, START, GOAL, wall()), Crane()
    assert isinstance(way, Way) and way.found and way.problem == "" and len(way.vertices) > 2
    q = states(way)
    np.testing.assert_allclose(q[[0, -1]], [START, GOAL], atol=1e-12)
    assert min(judge.clearance(one, WALL) for one in q) > 0.0
    straight = START + np.linspace(0, 1, 200)[:, None] * (GOAL - START)
    assert min(judge.clearance(one, WALL) for one in straight) < 0.0  # there is something to go around
    # continuous with two derivatives at the knots, by values on both sides
    knots = np.asarray(way.path.knots)[1:-1]
    before, after = (np.asarray(way.path.derivatives(jnp.asarray(knots + e)))[:3] for e in (-1e-9, 1e-9))
    np.testing.assert_allclose(before, after, atol=1e-4 * np.abs(before).max())
    inside = (q >= np.asarray(crane.position_lower) - 1e-9) & (q <= np.asarray(crane.position_upper) + 1e-9)
    assert inside.all()


@pytest.mark.parametrize("clearance", [0.01, 0.03])
def test_a_way_keeps_a_clearance(crane, clearance):
    way, judge = connect(crane, START, GOAL, wall(), clearance=clearance), Crane()
    assert way.found and min(judge.clearance(q, WALL) for q in states(way)) >= clearance


def test_thin_things_between_samples_are_seen(crane):
    """A sheet of 0.01 mm, which no sampling of a line would meet: the straight way is refused, and no way exists."""
    thin = Scene({"sheet": CollisionShape.box([5e-6, 5.0, 5.0], [0.0, 0.0, 0.0])})
    way = connect(crane, [-0.9, 3.0, 0.0], [0.9, 0.0, 0.0], thin, states=20_000)
    assert not way.found and "no way was found" in way.problem and way.path is None and len(way.vertices) == 0
    with pytest.raises(ValueError, match="no way was found"):
        way.retime(acceleration=1.0)


def test_a_motion_along_a_way_keeps_limits_and_stays_free(crane):
    way, judge = connect(crane, START, GOAL, wall()), Crane()
    for more in ({}, {"jerk": 10.0}):
        timing = way.retime(acceleration=2.0, **more)
        time = np.linspace(0.0, float(timing.duration), 1001)
        q, v, a, j = np.asarray(timing.at(jnp.asarray(time)))
        assert np.abs(v).max() <= 1.0001 and np.abs(a).max() <= 2.0002 and (not more or np.abs(j).max() <= 10.001)
        assert min(judge.clearance(one, WALL) for one in q) > 0.0
        np.testing.assert_allclose(q[-1], GOAL, atol=1e-9)


def test_the_nearest_of_several_goals_is_reached(crane):
    goals = np.stack(
        [[0.3, 0.0, 0.5], GOAL, GOAL + np.array([0.1, 0.1, 0.0])]
    )  # at the others the hook is in the block
    way = connect(crane, START, goals, Scene({"block": CollisionShape.box([0.02, 0.02, 0.2], [0.9, 0.0, -0.5])}))
    assert way.found and way.goal == 1
    np.testing.assert_allclose(way.vertices[-1], goals[1])


def test_what_the_robot_holds_is_kept_clear_too(crane):
    """With a pole below the hook."""
    shapes = {"wall": CollisionShape.box([0.05, 0.5, 1.0], [0.3, 0.0, -1.1])}
    hook, _ = osik.forward_kinematics(crane, START).frame_pose(crane, "hook")
    scene = Scene(shapes | {"pole": CollisionShape.box([0.01, 0.01, 0.15], hook - jnp.array([0.0, 0.0, 0.21]))})
    judge, request = Crane(), coal.DistanceRequest()
    way = connect(crane, START, GOAL, scene.attach("pole", crane, "hook", q=START))
    assert way.found
    for q in states(way, 500):
        assert judge.clearance(q, WALL) > 0.0
        at, turn = map(np.asarray, osik.forward_kinematics(crane, q).frame_pose(crane, "hook"))
        pole, there = coal.Transform3s(turn, at - [0.0, 0.0, 0.21]), coal.Transform3s(np.eye(3), WALL[0][1])
        assert coal.distance(coal.Box(0.02, 0.02, 0.3), pole, WALL[0][0], there, request, coal.DistanceResult()) > 0.0


def test_starts_and_goals_that_are_wrong_are_named_and_harm_no_neighbour(crane):
    starts = np.stack([START, [-0.3, 0.0, 0.5], START, START])
    goals = np.stack([GOAL, GOAL, [-0.3, 0.0, 0.5], [1.5, 0.0, 0.5]])
    ways = connect(crane, starts, goals, wall())
    assert [way.found for way in ways] == [True, False, False, False]
    assert "the start does not keep the clearance" in ways[1].problem and "wall" in ways[1].problem
    assert "no goal keeps the clearance" in ways[2].problem and "wall" in ways[2].problem
    assert "rail" in ways[3].problem and "0.5 outside" in ways[3].problem
    alone = connect(crane, START, GOAL, wall())
    np.testing.assert_array_equal(ways[0].vertices, alone.vertices)


def test_ends_out_of_range_are_refused_before_a_search_and_are_no_goals(crane):
    """Without the wall, the goal out of range is the nearer one."""
    beyond, fine = START + np.array([0.0, 0.0, 9.0]), GOAL + np.array([0.2, 0.1, 0.0])
    way = connect(crane, START, [beyond, fine], Scene({}, capacity=2))
    assert way.found and way.goal == 1 and np.array_equal(way.vertices[-1], fine)
    for ends, name in (((beyond, GOAL), "q_from"), ((START, [beyond, beyond]), "q_to")):
        way = connect(crane, *ends, wall())
        assert not way.found and way.states < 10 and way.problem.startswith(f"{name}: joint drop is ")


def test_scenes_of_many_starts_are_their_own(crane):
    scenes = Scene.stack([wall(), Scene({}, capacity=2)])
    first, second = connect(crane, np.stack([START] * 2), np.stack([GOAL] * 2), scenes)
    assert first.found and len(first.vertices) > 2 and len(second.vertices) == 2


def test_another_scene_and_other_ends_compile_nothing(crane):
    connect(crane, START, GOAL, wall())
    with Compilations() as compilations:
        connect(crane, START + 0.01, GOAL + 0.02, wall(0.9))
    assert compilations.names == []


def test_joints_that_may_not_move_stay(crane):
    way = connect(crane, START, GOAL, wall(), joints=["rail", "drop"])
    assert way.found and np.ptp(states(way)[:, 1]) == 0.0
    refuses(
        ValueError, "turn", connect, crane, START, GOAL + np.array([0.0, 0.1, 0.0]), wall(), joints=["rail", "drop"]
    )


def test_a_start_that_is_the_goal(crane):
    way = connect(crane, START, START, wall())
    assert way.found and len(way.vertices) == 1 and way.path is None


def test_it_is_for_plain_calls_and_joints_with_one_number(crane):
    scene = wall()
    refuses(ValueError, "q_to", connect, crane, START, np.zeros((2, 1, 3)), scene)
    refuses(TypeError, "outside jit", jax.jit(lambda q: connect(crane, q, GOAL, scene)), jnp.asarray(START))
    nao = osik.load_robot("nao")
    refuses(ValueError, "other joints: floating_base; lock them", connect, nao, nao.q0, nao.q0, Scene({}))
