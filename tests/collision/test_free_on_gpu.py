"""Searches and limits in scenes by a GPU's text: by threads of a warp on a CPU, and on a GPU where there is one."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import one_warp
import pytest
from core_checks import needs_core

import osik_jax as osik
from osik_jax.collision import _core, _near_rows
from osik_jax.collision._core import are_free, core_robot, core_scene, gaps_at
from osik_jax.collision._robot_shapes import robot_shapes
from osik_jax.core import _cuda
from osik_jax.execution._backends import cuda_is_default
from osik_jax.inverse import _whole

pytestmark = needs_core
HAND = "panda_hand"


@pytest.fixture(scope="module")
def panda() -> osik.Robot:
    return osik.load_robot("panda", locked_joints={"panda_finger_joint1": 0.04, "panda_finger_joint2": 0.04})


def problems(robot: osik.Robot, count: int) -> tuple[tuple[np.ndarray, np.ndarray], osik.Scene]:
    """Poses of the hand between a board, a ball, a tilted hull and a can, each with a scene of its own."""
    rng = np.random.default_rng(5)
    scenes = []
    for _ in range(count):
        corners = rng.uniform(-0.15, 0.15, (12, 3)) + np.array([0.3, rng.uniform(-0.5, 0.5), 0.5])
        foot = np.array([rng.uniform(-0.4, 0.4), 0.45, 0.1])
        shapes = {
            "board": osik.CollisionShape.box([0.6, 0.6, 0.01], [0.0, 0.0, -0.03]),
            "ball": osik.CollisionShape.sphere(0.1, rng.uniform([0.2, -0.5, 0.2], [0.6, 0.5, 0.8])),
            "rock": osik.CollisionShape.convex(corners),
            "can": osik.CollisionShape.cylinder(0.04, foot, foot + np.array([0, 0, 0.4])),
        }
        scenes.append(osik.Scene(shapes, capacity=6))
    q = rng.uniform(robot.position_lower, robot.position_upper, (count, robot.nq))
    place, turn = jax.vmap(lambda q: osik.forward_kinematics(robot, q).frame_pose(robot, HAND))(q)
    return (np.asarray(place), np.asarray(turn)), osik.Scene.stack(scenes)


@pytest.mark.slow
def test_threads_of_a_warp_find_free_configurations(panda, tmp_path, monkeypatch):
    """The GPU's text on a CPU: distances are the core's, and answers the same however many threads a target has."""
    poses, scenes = problems(panda, 9)
    rng = np.random.default_rng(6)
    q = jnp.asarray(rng.uniform(panda.position_lower, panda.position_upper, (9, panda.nq)))
    shapes = robot_shapes(panda, None)
    own, arrays = core_robot(panda, shapes), core_scene(scenes, shapes)
    expected = gaps_at(own, q, arrays)
    by_core = osik.inverse_kinematics(panda, {HAND: poses}, scene=scenes, clearance=0.002)
    assert 0 < by_core.converged.sum() < 9 and (expected.distance < 0).sum() > 1  # depths too
    found = {}

    monkeypatch.setattr(_cuda, "call", partial(one_warp.call_of_lanes, tmp_path))
    monkeypatch.setattr(_core, "call_here", call_by_threads)
    monkeypatch.setattr(_whole, "call_here", call_by_threads)
    with jax.disable_jit():
        gaps = gaps_at(own, q, arrays)
        np.testing.assert_array_equal(are_free(own, q, arrays, jnp.zeros(1)), expected.distance >= 0)
        monkeypatch.setattr(_whole, "cuda_is_default", lambda: True)
        for members, threads in ((2, 64), (8, 128), (8, 16)):  # the last one in stages, two targets at a time
            monkeypatch.setattr(_whole, "_SOME", 2)
            monkeypatch.setattr(_whole, "_MEMBERS", members)
            monkeypatch.setattr(_whole, "_MOST_THREADS", threads)
            monkeypatch.setattr(_whole, "_FIRST", 1)
            found[members, threads] = osik.inverse_kinematics(panda, {HAND: poses}, scene=scenes, clearance=0.002)
    monkeypatch.undo()
    for one, other in zip(gaps, expected, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-8)
    for answers in found.values():
        np.testing.assert_array_equal(answers.converged, by_core.converged)
        np.testing.assert_array_equal(answers.obstruction, by_core.obstruction)
        free = np.asarray(answers.converged)
        np.testing.assert_allclose(np.asarray(answers.q)[free], np.asarray(found[2, 64].q)[free], atol=1e-12)
        check(panda, poses, scenes, answers, 0.002)


@pytest.mark.slow
@pytest.mark.parametrize("members", [1, 8])
def test_threads_find_the_rows_of_a_limit(panda, tmp_path, monkeypatch, members):
    """The GPU's text on a CPU, a scene each: rows, pairs and what derivatives are made of are those of the core."""
    _, scenes = problems(panda, 9)
    first = jax.tree.map(lambda a: a[0], scenes)
    limit = osik.CollisionAvoidanceLimit(panda, scene=first, detection_distance=0.1, q0_distance=-np.inf, max_pairs=5)
    q = np.random.default_rng(6).uniform(panda.position_lower, panda.position_upper, (9, panda.nq))
    kept = limit.kept
    assert kept is not None
    places, arrays = jax.vmap(partial(osik.forward_kinematics, panda))(q), core_scene(scenes, kept.shapes)
    numbers = jnp.asarray(limit.numbers(0.01))
    given = jax.tree.leaves(places), jnp.asarray(arrays.integers), jnp.asarray(arrays.numbers), numbers[None]
    expected = [_near_rows._by_core(kept, 5, with_geometry, *given) for with_geometry in (False, True)]
    distance = np.asarray(expected[0].distance)
    assert (distance < 0).any() and np.isinf(distance).any() and np.isfinite(distance[:, 4]).any()
    monkeypatch.setattr(_cuda, "call", partial(one_warp.call_of_lanes, tmp_path))
    monkeypatch.setattr(_near_rows, "call_here", call_by_threads)
    monkeypatch.setattr(_near_rows, "_MEMBERS", members)
    monkeypatch.setattr(_near_rows, "cuda_is_default", lambda: True)
    found = [_near_rows._by_core(kept, 5, with_geometry, *given) for with_geometry in (False, True)]
    monkeypatch.undo()
    for ours, rows in zip(found, expected, strict=True):
        for name in ("jacobian", "lower", "distance", "pair"):
            np.testing.assert_allclose(getattr(ours, name), getattr(rows, name), atol=1e-7)
    np.testing.assert_array_equal(found[1].carried, expected[1].carried)
    # points that a nearest point lies between are not unique on round shapes, but what follows from them is
    poses = jnp.asarray(scenes.table.position), jnp.asarray(scenes.table.rotation)
    rows = jax.vmap(partial(_near_rows._rows_of, kept), (0, 0, 0, 0, None))
    jacobian, lower = rows(found[1], scenes.body, places, poses, numbers)
    np.testing.assert_allclose(jacobian, expected[0].jacobian, atol=1e-6)
    np.testing.assert_allclose(lower, expected[0].lower, atol=1e-6)


def call_by_threads(method, shapes, *given, sizes, members=1):
    """A call of ``_core.call_here`` by threads of a GPU, which ``_cuda.call`` runs."""
    space = _cuda.space_of_lane(_core._SPACES.get(method, method), *sizes)
    return list(map(jnp.asarray, _cuda.call_lanes(method, shapes, *given, space=space, members=members)))


def check(robot, poses, scenes, found, clearance):
    """Answers that are called free are there, within the joints' ranges, and free in double precision."""
    q, called = np.asarray(found.q, float), np.asarray(found.converged)
    place = jax.vmap(lambda q: osik.forward_kinematics(robot, q).frame_pose(robot, HAND)[0])(q)
    assert np.linalg.norm(np.asarray(place) - poses[0], axis=1)[called].max() < 1e-3
    assert ((q >= robot.position_lower) & (q <= robot.position_upper)).all()
    assert np.asarray(osik.is_free(robot, q, scenes, clearance))[called].all()


on_a_gpu = pytest.mark.skipif(
    not (cuda_is_default() and _cuda.installed()), reason="needs JAX_PLATFORMS=cuda,cpu and a CUDA device"
)


@on_a_gpu
def test_steps_with_a_limit_and_nearest_solutions_are_those_of_a_cpu(panda):
    (place, turn), scenes = problems(panda, 60)
    q = np.random.default_rng(8).uniform(panda.position_lower, panda.position_upper, (60, panda.nq))
    first = jax.tree.map(lambda a: a[0], scenes)
    limit = osik.CollisionAvoidanceLimit(panda, scene=first, q0_distance=-np.inf)
    tasks = {HAND: osik.FrameTask(panda, HAND), "posture": osik.PostureTask(panda, weight=1e-2)}

    @jax.jit
    @jax.vmap
    def steps(q, place, turn, scene):
        aims, limits = {HAND: (place, turn)}, (limit.replace(scene=scene),)
        return osik.solve(panda, q, tasks, limits=limits, targets=aims, dt=0.01)

    def nearest():
        return osik.inverse_kinematics(panda, {HAND: (place, turn)}, scene=scenes, q0=q[0], nearest=True)

    found, near = steps(q, place, turn, scenes), nearest()
    with jax.default_device(jax.devices("cpu")[0]):
        expected, by_cpu = steps(q, place, turn, scenes), nearest()
    np.testing.assert_array_equal(found.status, expected.status)
    solved = np.asarray(found.status) == osik.Status.SOLVED
    assert solved.sum() > 20
    np.testing.assert_allclose(found.velocity[solved], expected.velocity[solved], atol=2e-3)
    np.testing.assert_array_equal(near.converged, by_cpu.converged)
    np.testing.assert_allclose(near.q, by_cpu.q, atol=1e-4)


@on_a_gpu
def test_a_gpu_finds_what_a_cpu_finds_in_batches_of_any_size(panda):
    poses, scenes = problems(panda, 300)
    found = osik.inverse_kinematics(panda, {HAND: poses}, scene=scenes, clearance=0.002)
    with jax.default_device(jax.devices("cpu")[0]):
        by_cpu = osik.inverse_kinematics(panda, {HAND: poses}, scene=scenes, clearance=0.002)
        check(panda, poses, scenes, found, 0.0019)
    np.testing.assert_array_equal(found.converged, by_cpu.converged)
    poses, scenes = jax.tree.map(lambda a: jnp.repeat(a, 20, 0), (poses, scenes))
    solve = jax.jit(lambda poses, scene: osik.inverse_kinematics(panda, {HAND: poses}, scene=scene, clearance=0.002))
    many, free = solve(poses, scenes), np.asarray(found.converged).repeat(20)  # so many that stages follow each other
    np.testing.assert_array_equal(many.converged, free)
    np.testing.assert_allclose(np.asarray(many.q)[free], np.asarray(found.q).repeat(20, 0)[free], atol=1e-4)
