"""Searches in scenes by the text of a GPU: on a CPU by one thread, and on a GPU where there is one."""

import ctypes
import os
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_checks import needs_core

import osik_jax as osik
from osik_jax.collision import _core
from osik_jax.core import _build, _cuda
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


@pytest.fixture
def by_the_gpus_text(tmp_path, monkeypatch):
    """From here on, the calls of the core are those of groups of one thread."""
    source = Path(__file__).parents[1] / "support" / "groups_on_one_thread.cpp"
    built = tmp_path / "groups.so"
    options = ["-std=c++20", "-O1", "-fPIC", "-shared", f"-I{_build.FOLDER}", str(source), "-o", str(built)]
    subprocess.run([os.environ.get("CXX") or "c++", *options], check=True)
    library = ctypes.CDLL(str(built))
    for method in ("chain_find", "free_find", "clearances", "are_free"):
        handler = jax.ffi.pycapsule(getattr(library, f"osik_{method}"))
        jax.ffi.register_ffi_target(f"osik_group_{method}", handler, platform="cpu")

    def call(method, shapes, *given, **_):
        name = f"osik_group_{method}"
        results = [jax.ShapeDtypeStruct(shape, np.float64 if kind is float else np.int32) for shape, kind in shapes]
        arrays = [a.astype(np.float64 if np.issubdtype(a.dtype, np.floating) else np.int32) for a in given]
        return jax.ffi.ffi_call(name, results)(*arrays)

    _whole._program.cache_clear()
    for module in (_core, _whole):
        monkeypatch.setattr(module, "call_here", call)
    jax.clear_caches()
    yield
    _whole._program.cache_clear()
    jax.clear_caches()


@pytest.mark.slow
def test_one_thread_finds_free_configurations_as_the_core_measures_them(panda, request):
    poses, scenes = problems(panda, 40)
    q = np.random.default_rng(6).uniform(panda.position_lower, panda.position_upper, (40, panda.nq))
    expected = osik.clearance(panda, q, scenes)
    request.getfixturevalue("by_the_gpus_text")
    own = osik.clearance(panda, q, scenes)
    np.testing.assert_allclose(own.distance, expected.distance, atol=1e-9)
    np.testing.assert_array_equal(own.pair, expected.pair)
    assert (expected.distance < 0).sum() > 5  # depths too
    np.testing.assert_array_equal(osik.is_free(panda, q, scenes), expected.distance >= 0)
    found = osik.inverse_kinematics(panda, {HAND: poses}, scene=scenes, clearance=0.002)
    anywhere = osik.inverse_kinematics(panda, {HAND: poses})
    request.getfixturevalue("monkeypatch").undo()
    _whole._program.cache_clear()
    jax.clear_caches()
    by_core = osik.inverse_kinematics(panda, {HAND: poses}, scene=scenes, clearance=0.002)
    np.testing.assert_array_equal(found.converged, by_core.converged)
    np.testing.assert_array_equal(found.obstruction, by_core.obstruction)
    assert anywhere.converged.all() and 0 < by_core.converged.sum() < 40
    check(panda, poses, scenes, found, 0.002)


def check(robot, poses, scenes, found, clearance):
    """Answers that are called free are there, within the joints' ranges, and free in double precision."""
    q, called = np.asarray(found.q, float), np.asarray(found.converged)
    place = jax.vmap(lambda q: osik.forward_kinematics(robot, q).frame_pose(robot, HAND)[0])(q)
    assert np.linalg.norm(np.asarray(place) - poses[0], axis=1)[called].max() < 1e-3
    assert ((q >= robot.position_lower) & (q <= robot.position_upper)).all()
    assert np.asarray(osik.is_free(robot, q, scenes, clearance))[called].all()


@pytest.mark.skipif(
    not (cuda_is_default() and _cuda.installed()), reason="needs JAX_PLATFORMS=cuda,cpu and a CUDA device"
)
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
