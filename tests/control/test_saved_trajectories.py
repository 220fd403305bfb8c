"""Files of rollouts: the same numbers are read again, also of a free base and of many rollouts in one call."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import osik_jax as osik


def check(path, trajectory) -> None:
    trajectory.save(path)
    found = osik.load_trajectory(path)
    wanted = (trajectory.time, trajectory.q, vars(trajectory.solution) | {"warm_start": None})
    found = (found.time, found.q, vars(found.solution))
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_array_equal(own, other)
        assert own.dtype == other.dtype


def test_a_file_gives_the_same_rollout(tmp_path, nao) -> None:
    tasks = {"hand/left": osik.FrameTask(nao, "l_gripper", priority=2), "com": osik.ComTask(nao)}
    check(tmp_path / "a.npz", osik.rollout(nao, nao.q0, tasks, steps=3))


def test_of_many_rollouts(tmp_path, arm) -> None:
    tasks = {"posture.all": osik.PostureTask(arm)}
    many = jax.vmap(lambda q: osik.rollout(arm, q, tasks, steps=3))(arm.q0 + jnp.linspace(0.0, 0.1, 4)[:, None])
    check(tmp_path / "many.npz", many)


def test_what_is_no_trajectory_is_refused(tmp_path) -> None:
    np.savez(tmp_path / "other.npz", time=np.zeros(3))
    with pytest.raises(osik.OsikError, match="other.npz is no trajectory: it has no q"):
        osik.load_trajectory(tmp_path / "other.npz")
    with pytest.raises(FileNotFoundError):
        osik.load_trajectory(tmp_path / "none.npz")
