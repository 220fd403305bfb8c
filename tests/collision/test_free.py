"""Configurations in which nothing touches: searches, checks and clearances, judged by Pinocchio and coal."""

# pyright: reportArgumentType=false, reportOptionalMemberAccess=false, reportOptionalOperand=false
# pyright: reportOptionalSubscript=false, reportOperatorIssue=false, reportCallIssue=false
from functools import partial

import coal
import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from compilations import Compilations
from example_files import example_file
from refusals import refuses
from robot_support import pinocchio_geometry

import osik_jax as osik
from osik_jax.collision._robot_shapes import robot_shapes
from osik_jax.core import _library
from osik_jax.robot.loading._named import EXAMPLES

pytestmark = pytest.mark.skipif(not _library.installed(), reason="no compiled core")
UP = np.array([0.0, 0.0, 1.0])
DOWN = np.diag([1.0, -1.0, -1.0])
OPEN = {"panda_finger_joint1": 0.04, "panda_finger_joint2": 0.04}


@pytest.fixture(scope="module")
def panda() -> osik.Robot:
    return osik.load_robot("panda", locked_joints=OPEN)


def board(size, place) -> osik.CollisionShape:
    return osik.CollisionShape.box(np.asarray(size) / 2, np.asarray(place))


def shelf(rng: np.random.Generator) -> tuple[osik.Scene, np.ndarray, np.ndarray]:
    """A shelf of two boards and three walls in front of the robot with a can in it, and the pose that grips the can."""
    turn = pin.rpy.rpyToMatrix(0, 0, rng.uniform(-0.3, 0.3))
    at = turn @ [rng.uniform(0.5, 0.6), 0, rng.uniform(0.25, 0.45)]
    parts = {"low": ([0.3, 0.8, 0.02], [0, 0, 0]), "high": ([0.3, 0.8, 0.02], [0, 0, 0.35])}
    parts |= {"left": ([0.3, 0.02, 0.4], [0, 0.4, 0.17]), "right": ([0.3, 0.02, 0.4], [0, -0.4, 0.17])}
    parts |= {"back": ([0.02, 0.8, 0.4], [0.16, 0, 0.17])}
    shapes = {
        name: osik.CollisionShape.box(np.array(size) / 2, at + turn @ place, turn)
        for name, (size, place) in parts.items()
    }
    shapes["lamp"] = board([1, 1, 0.02], [0.2, 0, 0.6])  # an elbow that is up touches it
    foot = at + turn @ [0, rng.uniform(-0.15, 0.15), 0.015]
    shapes["can"] = osik.CollisionShape.cylinder(0.03, foot, foot + 0.14 * UP)
    grip = turn @ np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # the fingers open along the shelf, and point into it
    return osik.Scene(shapes, capacity=8), foot + 0.08 * UP - 0.1034 * grip[:, 2], grip


class Judge:
    """Pinocchio's Panda with coal's distances on the hulls of its collision meshes."""

    def __init__(self, robot: osik.Robot):
        urdf = example_file(EXAMPLES["panda"][0])
        self.model, self.geometry = pinocchio_geometry(urdf)
        self.data, shapes = self.model.createData(), robot_shapes(robot)
        self.pairs = {frozenset((shapes.links[i], shapes.links[j])) for i, j in shapes.pairs}
        self.world = {link for link, kept in zip(shapes.links, shapes.world, strict=True) if kept}
        for thing in self.geometry.geometryObjects:
            if isinstance(thing.geometry, coal.BVHModelBase):
                thing.geometry.buildConvexRepresentation(False)

    def distance(self, q: np.ndarray, scene: osik.Scene) -> float:
        pin.forwardKinematics(self.model, self.data, np.r_[q, 0.04, 0.04])
        parts = []
        for thing in self.geometry.geometryObjects:
            at = self.data.oMi[thing.parentJoint] * thing.placement
            shape = thing.geometry.convex if isinstance(thing.geometry, coal.BVHModelBase) else thing.geometry
            parts.append(
                (self.model.frames[thing.parentFrame].name, shape, coal.Transform3s(at.rotation, at.translation))
            )
        pairs = [(a, b) for k, a in enumerate(parts) for b in parts[:k] if frozenset((a[0], b[0])) in self.pairs]
        pairs += [(a, b) for a in parts if a[0] in self.world for b in obstacles(scene)]
        request = coal.DistanceRequest()
        request.enable_signed_distance = True
        return min(coal.distance(*a[1:], *b[1:], request, coal.DistanceResult()) for a, b in pairs)


def obstacles(scene: osik.Scene) -> list[tuple[str, coal.CollisionGeometry, coal.Transform3s]]:
    table = jax.tree.map(np.asarray, scene.table)
    made = []
    for k, name in enumerate(scene.names):
        a, b, c = (float(size) for size in table.size[k])
        shape = coal.Box(2 * a, 2 * b, 2 * c) if table.kind[k] == 4 else coal.Cylinder(a, 2 * b)
        made.append((name, shape, coal.Transform3s(table.rotation[k], table.position[k])))
    return made


@pytest.fixture(scope="module")
def problems() -> list[tuple[osik.Scene, np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(3)
    return [shelf(rng) for _ in range(8)]


def test_answers_in_shelves_are_there_and_free_by_coal(panda, problems):
    judge = Judge(panda)
    touching = 0
    for scene, place, turn in problems:
        found = osik.inverse_kinematics(panda, {"panda_hand": (place, turn)}, scene=scene)
        assert found.converged and found.obstruction == 0
        distance = judge.distance(np.asarray(found.q), scene)
        pin.updateFramePlacements(judge.model, judge.data)
        at = judge.data.oMf[judge.model.getFrameId("panda_hand")]
        assert np.linalg.norm(at.translation - place) < 1e-3 and distance >= 0.0
        assert np.isclose(found.clearance, distance, atol=1e-6)
        first, second = found.pairs[int(found.nearest_pair)]
        assert first in robot_shapes(panda).names and second in (*scene.names, *robot_shapes(panda).names)
        anywhere = osik.inverse_kinematics(panda, {"panda_hand": (place, turn)})
        touching += judge.distance(np.asarray(anywhere.q), scene) < 0.0
    assert touching > 2  # the search has something to do


def test_a_batch_has_the_answers_of_a_loop(panda, problems):
    scenes = osik.Scene.stack([scene for scene, *_ in problems])
    poses = np.array([place for _, place, _ in problems]), np.array([turn for *_, turn in problems])
    found = osik.inverse_kinematics(panda, {"panda_hand": poses}, scene=scenes, clearance=0.002)
    assert found.converged.all()
    for k, (scene, place, turn) in enumerate(problems):
        one = osik.inverse_kinematics(panda, {"panda_hand": (place, turn)}, scene=scene, clearance=0.002)
        np.testing.assert_allclose(found.q[k], one.q, atol=1e-6)
        assert one.clearance >= 0.002
        assert found.pairs[int(found.nearest_pair[k])] == one.pairs[int(one.nearest_pair)]
    shared = osik.inverse_kinematics(panda, {"panda_hand": poses}, scene=problems[0][0])
    np.testing.assert_allclose(
        shared.q[0], osik.inverse_kinematics(panda, {"panda_hand": problems[0][1:]}, scene=problems[0][0]).q, atol=1e-6
    )


def test_another_scene_of_the_same_capacity_compiles_nothing(panda, problems):
    (first, second), start = problems[:2], np.asarray(panda.q0)
    osik.inverse_kinematics(panda, {"panda_hand": first[1:]}, scene=first[0])
    osik.is_free(panda, start, first[0])
    osik.clearance(panda, start, first[0])
    with Compilations() as compiled:
        osik.inverse_kinematics(panda, {"panda_hand": second[1:]}, scene=second[0], clearance=0.001)
        osik.is_free(panda, start + 0.1, second[0], 0.01)
        osik.clearance(panda, start, second[0])
    assert not compiled.names


def test_clearances_are_coals_and_tell_what_is_free(panda, problems):
    judge, scene = Judge(panda), problems[4][0]
    q = np.random.default_rng(1).uniform(panda.position_lower, panda.position_upper, (60, 7))
    found = osik.clearance(panda, q, scene)
    theirs = np.array([judge.distance(at, scene) for at in q])
    assert 5 < (theirs > 0).sum() < 55
    np.testing.assert_allclose(np.maximum(found.distance, 0.0), np.maximum(theirs, 0.0), rtol=0, atol=1e-7)
    np.testing.assert_array_equal(np.asarray(found.distance) > 0, theirs > 0)
    for least in (0.0, 0.02):
        np.testing.assert_array_equal(osik.is_free(panda, q, scene, least), np.asarray(found.distance) >= least)
    one = osik.clearance(panda, q[7], scene)
    assert one.distance == found.distance[7] and one.pair_names() == found.pair_names(7)
    mapped = jax.vmap(lambda q: osik.clearance(panda, q, scene).distance)(q)
    np.testing.assert_allclose(mapped, found.distance, atol=1e-7)


def test_gradients_of_clearances_are_central_differences(panda, problems):
    scene, step = problems[5][0], 1e-6
    q = np.random.default_rng(2).uniform(panda.position_lower, panda.position_upper, (20, 7))

    @jax.jit
    def distances(q, shift=0.0):
        moved = scene.moved("low", (scene.table.position[0] + shift * jnp.array([0, 0, 1.0]), scene.table.rotation[0]))
        return osik.clearance(panda, q, moved).distance

    slopes = jax.jit(jax.vmap(jax.grad(lambda q: osik.clearance(panda, q, scene).distance)))(q)
    numbers = np.stack([(distances(q + step * e) - distances(q - step * e)) / (2 * step) for e in np.eye(7)], 1)
    np.testing.assert_allclose(slopes, numbers, atol=1e-5)
    lift = jax.jit(jax.jacfwd(distances, argnums=1))(q, 0.0)
    np.testing.assert_allclose(lift, (distances(q, step) - distances(q, -step)) / (2 * step), atol=1e-5)
    assert np.abs(lift).max() > 0.1


@pytest.mark.slow
def test_gradients_through_the_search_and_inside_jit(panda, problems):
    scene, place, turn = problems[2]

    @jax.jit
    def at(place):
        found = osik.inverse_kinematics(panda, {"panda_hand": (place, turn)}, scene=scene)
        return found.q, found.clearance, found.converged

    q, clearance, converged = at(jnp.asarray(place))
    outside = osik.inverse_kinematics(panda, {"panda_hand": (place, turn)}, scene=scene)
    assert converged
    np.testing.assert_allclose(q, outside.q, atol=1e-5)
    np.testing.assert_allclose(clearance, outside.clearance, atol=1e-6)
    slope = jax.jacfwd(lambda place: at(place)[:2])(jnp.asarray(place))
    poses = jax.jacfwd(lambda q: osik.forward_kinematics(panda, q).frame_pose(panda, "panda_hand")[0])(q)
    np.testing.assert_allclose(poses @ slope[0], np.eye(3), atol=1e-5)
    along = jax.grad(lambda q: osik.clearance(panda, q, scene).distance)(q) @ slope[0]
    np.testing.assert_allclose(slope[1], along, atol=1e-5)
    many = jax.vmap(at)(jnp.stack([place, place]))
    np.testing.assert_allclose(many[0][1], q, atol=1e-6)


def test_the_first_call_of_a_robot_may_be_inside_jit():
    """Its shapes are made there, from numbers that are known."""
    scene, q0 = osik.Scene({"post": board([0.05, 0.05, 0.5], [0.35, 0.25, 0.5])}), np.zeros(6)
    arm, pose = osik.load_robot("ur5"), {"tool0": (np.array([0.5, 0.1, 0.4]), DOWN)}
    found = jax.jit(lambda q0: osik.inverse_kinematics(arm, pose, q0=q0, scene=scene))(q0)
    assert found.converged and osik.is_free(arm, found.q, scene)
    arm = osik.load_robot("ur5")
    inside = jax.jit(lambda q: osik.clearance(arm, q, scene).distance)(found.q)
    np.testing.assert_allclose(inside, osik.clearance(arm, found.q, scene).distance, atol=1e-12)
    arm = osik.load_robot("ur5")

    @jax.jit
    def lower(q):
        limit = osik.CollisionAvoidanceLimit(arm, scene=scene, q0_distance=0.0)
        return limit.rows(arm, osik.forward_kinematics(arm, q), q, 0.01).lower

    assert (np.asarray(lower(found.q)) > -np.inf).any()


@pytest.mark.slow
def test_a_batch_inside_jit_is_one_call(panda, problems):
    """Targets alone, and each with a scene: as one by one. Starts of their own are solved one after another."""
    scenes, places, turns = zip(*problems[:3], strict=True)
    stack, places, turns = osik.Scene.stack(scenes), np.stack(places), np.stack(turns)

    def at(scene, place, turn, q0):
        pose = {"panda_hand": (place, turn)}
        found = osik.inverse_kinematics(panda, pose, scene=scene, q0=q0, clearance=0.002)
        return found.q, found.converged, found.clearance

    home = jnp.asarray(panda.q0)
    starts = home + 0.1 * np.arange(3)[:, None]
    one = jax.jit(at)
    for axes, q0 in (((None, 0, 0, None), home), ((0, 0, 0, None), home), ((0, 0, 0, 0), starts)):
        given = stack if axes[0] == 0 else scenes[0]
        program = jax.jit(jax.vmap(at, axes)).lower(given, places, turns, q0).compile()
        text = program.as_text() or ""
        calls = [line for line in text.splitlines() if "custom-call" in line and "osik_free_find" in line]
        assert len(calls) == 1 and f"f64[{1 if axes[3] == 0 else 3},7]" in calls[0]  # configurations of a call
        found = program(given, places, turns, q0)
        for k in range(3):
            scene, start = scenes[k if axes[0] == 0 else 0], q0[k] if axes[3] == 0 else q0
            for got, wanted in zip(found, one(scene, places[k], turns[k], start), strict=True):
                np.testing.assert_allclose(got[k], wanted, atol=1e-8)
        assert found[1].any()


def test_all_and_nearest_are_free(panda, problems):
    scene, place, turn = problems[0]
    arm = osik.load_robot("ur5")
    rack = osik.Scene({"post": board([0.05, 0.05, 1.0], [0.35, 0.1, 0.5]), "floor": board([2, 2, 0.1], [0, 0, -0.06])})
    pose = {"tool0": (np.array([0.5, 0.1, 0.4]), DOWN)}
    found = osik.inverse_kinematics(arm, pose, scene=rack, all=True)
    every = osik.inverse_kinematics(arm, pose, all=True)
    count, free = int(found.branches), osik.is_free(arm, every.solutions[: int(every.branches)], rack)
    assert 0 < count == int(free.sum()) < int(every.branches)
    assert osik.is_free(arm, found.solutions[: int(found.count)], rack).all()
    q0 = np.asarray(panda.q0) + 0.1
    near = osik.inverse_kinematics(panda, {"panda_hand": (place, turn)}, scene=scene, q0=q0, nearest=True)
    far = osik.inverse_kinematics(panda, {"panda_hand": (place, turn)}, scene=scene)
    assert near.converged and osik.is_free(panda, near.q, scene)
    assert np.linalg.norm(near.q - q0) <= np.linalg.norm(far.q - q0) + 1e-6


def test_an_obstacle_around_the_target_is_told_at_once(panda):
    scene = osik.Scene({"post": board([0.05, 0.05, 0.6], [0.5, 0, 0.3]), "far": board([0.1, 0.1, 0.1], [-1, 0, 0])})
    found = osik.inverse_kinematics(panda, {"panda_hand": (np.array([0.5, 0.0, 0.4]), DOWN)}, scene=scene)
    assert not found.converged and found.obstruction == 2 and found.steps < 500
    said = found.explain()
    assert "an obstacle stands around the target" in said and "post overlap by" in said
    # a position alone leaves the hand free to turn, so nothing is proven; but nothing is free 25 mm from the post
    open_ = osik.inverse_kinematics(panda, {"panda_hand": np.array([0.5, 0.0, 0.4])}, scene=scene)
    assert not open_.converged and open_.obstruction == 3 and "in every solution found" in open_.explain()


def test_a_clearance_that_nothing_keeps_is_told(panda, problems):
    scene, place, turn = problems[0]
    found = osik.inverse_kinematics(panda, {"panda_hand": (place, turn)}, scene=scene, clearance=0.03)
    assert not found.converged and found.obstruction in (2, 3) and 0.0 < found.clearance < 0.03
    assert "apart" in found.explain()


def test_overlap_of_parts_that_no_joint_of_the_frames_moves():
    robot, rules = osik.load_robot("baxter"), True
    here = osik.forward_kinematics(robot, robot.q0).frame_pose(robot, "right_gripper")
    other = osik.forward_kinematics(robot, robot.q0).frame_pose(robot, "left_gripper")
    scene = osik.Scene({"crate": board([0.2, 0.2, 0.2], np.asarray(other[0]))})
    found = osik.inverse_kinematics(robot, {"right_gripper": here}, scene=scene, srdf=rules)
    assert not found.converged and found.obstruction == 1
    assert "crate overlap by" in found.explain() and "where q0 puts them" in found.explain()


def test_an_srdf_that_is_edited_is_read_anew(tmp_path):
    robot, path = osik.load_robot("panda"), tmp_path / "rules.srdf"
    pose = {"panda_hand": (np.array([0.5, 0.0, 0.4]), DOWN)}

    def reason(rules: str) -> int:
        path.write_text(f'<robot name="panda">{rules}</robot>')
        found = osik.inverse_kinematics(robot, pose, scene=osik.Scene(), srdf=str(path))
        return int(found.obstruction)

    assert reason("") == 1  # the fingers are closed
    assert reason('<disable_collisions link1="panda_leftfinger" link2="panda_rightfinger"/>') == 0


def test_overlap_of_closed_fingers_is_told_at_once(problems):
    """The frame carries both, so that the search moves them, but not apart."""
    robot, (scene, place, turn) = osik.load_robot("panda"), problems[0]
    found = osik.inverse_kinematics(robot, {"panda_hand": (place, turn)}, scene=scene)
    assert found.obstruction == 1 and found.steps == 0 and "leftfinger" in found.explain()
    allowed = osik.inverse_kinematics(
        robot, {"panda_hand": (place + np.array([0.0, 0.0, 0.4]), turn)}, scene=scene, srdf=True
    )
    assert allowed.obstruction != 1


def test_held_objects_are_kept_off_the_scene(panda):
    home = osik.inverse_kinematics(panda, {"panda_hand": (np.array([0.5, 0.0, 0.5]), DOWN)}, scene=osik.Scene())
    start = np.asarray(home.q)
    place, turn = (np.asarray(a) for a in osik.forward_kinematics(panda, start).frame_pose(panda, "panda_hand"))
    tip = place + 0.1034 * turn[:, 2]
    stick = osik.CollisionShape.cylinder(0.01, tip, tip + 0.3 * turn[:, 2])
    wall = board([0.4, 0.4, 0.02], place + 0.3 * turn[:, 2])
    scene = osik.Scene({"stick": stick, "wall": wall}).attach(
        "stick", panda, "panda_hand", q=start, touch=("panda_*finger",)
    )
    assert not osik.is_free(panda, start, scene)
    assert osik.clearance(panda, start, scene).pair_names() == ("stick", "wall")
    assert osik.is_free(panda, start, scene.allow(("stick", "wall")))
    lifted = osik.inverse_kinematics(panda, {"panda_hand": (place - 0.25 * turn[:, 2], turn)}, scene=scene)
    assert lifted.converged and osik.is_free(panda, lifted.q, scene)


def test_wrong_arguments_are_refused(panda, problems):
    scene, place, turn = problems[0]
    solve, pose = partial(osik.inverse_kinematics, panda), {"panda_hand": (place, turn)}
    two, stack = {"panda_hand": (np.stack([place] * 2), np.stack([turn] * 2))}, osik.Scene.stack([scene] * 3)
    refuses(ValueError, "clearance is -0.1; it is one number, 0 or more", solve, pose, scene=scene, clearance=-0.1)
    refuses(ValueError, "there are 3 scenes and 2 targets", solve, two, scene=stack)
    refuses(ValueError, "the last axis has the robot's 7 entries", osik.is_free, panda, np.zeros(6), scene)
    refuses(ValueError, "there are 3 scenes and 2 configurations", osik.clearance, panda, np.zeros((2, 7)), stack)
    refuses(TypeError, "scene is a dict", osik.clearance, panda, np.zeros(7), {})


def test_bad_configurations_are_not_free_and_harm_no_others(panda, problems):
    scene = problems[0][0]
    q = np.stack([panda.q0, np.full(7, np.nan), panda.q0])
    found = osik.clearance(panda, q, scene)
    assert np.isnan(found.distance[1]) and found.distance[0] == found.distance[2]
    free = osik.is_free(panda, q, scene)
    assert not free[1] and free[0] == free[2] == (found.distance[0] >= 0)


@pytest.mark.slow
def test_tasks_are_met_in_free_configurations(panda):
    """By steps of a scheme: a hand with a preference, judged by ``is_free``; the last target is inside an obstacle."""
    scene = osik.Scene({"wall": board([0.02, 0.5, 0.5], [0.35, 0.0, 0.5]), "floor": board([1, 1, 0.1], [0, 0, -0.16])})
    places = np.random.default_rng(1).uniform([0.45, -0.3, 0.2], [0.55, 0.3, 0.6], (12, 3))
    places[-1] = [0.35, 0.0, 0.5]
    tasks = {"hand": osik.FrameTask(panda, "panda_hand", rows="position"), "posture": osik.PostureTask(panda)}
    targets, solve = {"hand": (places, np.tile(np.eye(3), (12, 1, 1)))}, partial(osik.inverse_kinematics, panda)
    found = solve(tasks, targets=targets, scene=scene, clearance=0.005, closest=False, restarts=1)
    met = np.asarray(found.converged)
    assert met.sum() >= 8 and (np.asarray(found.obstruction)[met] == 0).all()
    assert osik.is_free(panda, found.q[met], scene, 0.005).all()
    np.testing.assert_allclose(found.clearance, osik.clearance(panda, found.q, scene).distance, atol=1e-12)
    hands = jax.vmap(lambda q: osik.forward_kinematics(panda, q).frame_pose(panda, "panda_hand")[0])(found.q)
    np.testing.assert_allclose(hands[met], places[met], atol=1e-3)
    assert not met[-1] and found.obstruction[-1] == 3 and "wall" in found.explain(11)
    refuses(ValueError, "one scene for all targets", solve, tasks, scene=osik.Scene.stack([scene, scene]))


@pytest.mark.release
def test_a_standing_g1_reaches_into_a_shelf_and_keeps_its_balance():
    robot = osik.load_robot("g1")
    home, feet = osik.forward_kinematics(robot, robot.q0), ("left_ankle_roll_link", "right_ankle_roll_link")
    soles = {foot: home.frame_pose(robot, foot) for foot in feet}
    middle = np.mean([np.asarray(pose[0]) for pose in soles.values()], 0)
    low, high = middle[:2] + np.array([-0.03, -0.1]), middle[:2] + np.array([0.09, 0.1])
    tasks = {foot: osik.FrameTask(robot, foot, target=pose) for foot, pose in soles.items()}
    tasks["hand"] = osik.FrameTask(robot, "right_rubber_hand", rows="position")
    tasks["balance"] = osik.ComTask(robot, axes="xy", lower=low, upper=high)
    tasks["posture"] = osik.PostureTask(robot)
    boards = {"low": ([0.15, 0.4, 0.01], [0.5, 0.0, 0.65]), "high": ([0.15, 0.4, 0.01], [0.5, 0.0, 1.1])}
    boards |= {"left": ([0.15, 0.01, 0.25], [0.5, 0.4, 0.87]), "right": ([0.15, 0.01, 0.25], [0.5, -0.4, 0.87])}
    scene = osik.Scene({name: board(size, middle + np.array(place)) for name, (size, place) in boards.items()})
    places = np.random.default_rng(0).uniform([0.33, -0.3, 0.72], [0.5, 0.1, 1.03], (100, 3)) + middle
    targets = {"hand": (places, np.tile(np.eye(3), (100, 1, 1)))}
    found = osik.inverse_kinematics(robot, tasks, targets=targets, scene=scene)
    met = np.asarray(found.converged)
    assert met.mean() >= 0.984 and osik.is_free(robot, found.q[met], scene).all()
    center = jax.vmap(lambda q: osik.center_of_mass(robot, osik.forward_kinematics(robot, q)))(found.q)[met, :2]
    assert ((center > low - 1e-3) & (center < high + 1e-3)).all()
