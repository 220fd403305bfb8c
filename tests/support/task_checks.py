"""What the tests of tasks share: rows, and what they should be by differences."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mink
import numpy as np
from mujoco_states import full_velocities
from scipy.spatial.transform import Rotation

import osik_jax as osik

_traces: list[int] = []

kinematics_at = jax.jit(osik.forward_kinematics)


@jax.jit
def moved_by(robot, q, v):
    return osik.integrate(robot, q, v)


def anywhere(robot, rng):
    """Joints anywhere, a base anywhere: the formulas hold outside the joint ranges too."""
    return np.asarray(moved_by(robot, robot.q0, jnp.asarray(rng.uniform(-1.0, 1.0, robot.nv))))


def random_pose(rng, near):
    return near + rng.normal(size=3) * 0.3, Rotation.from_quat(rng.normal(size=4)).as_matrix()


def square(scale=0.1):
    """A support polygon."""
    normals = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    vertices = scale * np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]])
    return osik.SupportPolygon(jnp.asarray(normals), jnp.full(4, scale), jnp.asarray(vertices))


def the_same_in_mink(robot, seed):
    """The robot, a configuration, the same in mink, a target, and mink's velocities from ours."""
    rng = np.random.default_rng(seed)
    q = jnp.asarray(anywhere(robot, rng))
    configuration = mink.Configuration(robot.mj_model, q=np.asarray(robot.mujoco_qpos(q)))
    return robot, q, configuration, random_pose(rng, np.zeros(3)), full_velocities(robot)


@jax.jit
def rows_of_each(robot, tasks, q):
    """The rows of each task, one by one."""
    _traces.append(1)
    kinematics = osik.forward_kinematics(robot, q)
    return {name: task.rows(robot, kinematics, q) for name, task in tasks.items()}


@jax.jit
def rows_and_differences(robot, tasks, q, h=1e-6):
    """The rows, and their errors' Jacobians by central differences along the tangent."""
    steps = h * jnp.concatenate([jnp.zeros((1, robot.nv)), jnp.eye(robot.nv), -jnp.eye(robot.nv)])
    batch = jax.vmap(lambda v: rows_of_each(robot, tasks, osik.integrate(robot, q, v)))(steps)
    ahead, behind = slice(1, robot.nv + 1), slice(robot.nv + 1, None)
    differences = {k: (r.error[ahead] - r.error[behind]).T / (2 * h) for k, r in batch.items()}
    return jax.tree.map(lambda x: x[0], batch), differences


@jax.jit
def at_each(robot, tasks, configurations):
    """``rows_and_differences`` at each of some configurations (k, nq)."""
    return jax.vmap(rows_and_differences, in_axes=(None, None, 0))(robot, tasks, configurations)


def assert_jacobians(rows, differences, atol=1e-7):
    """Every task's Jacobian is that of its error: what ``at_each`` gave."""
    for name, row in rows.items():
        scale = np.maximum(1.0, np.abs(differences[name]).max((1, 2), keepdims=True))
        np.testing.assert_allclose(row.jacobian / scale, differences[name] / scale, atol=atol, rtol=0, err_msg=name)


def assert_every_number_counts(robot, tasks, q, idle=()):
    """Other numbers in any leaf change the rows and compile nothing, but for those whose paths begin with ``idle``.

    A leaf is changed by a little that differs from entry to entry, so that a rotation is no longer one.
    """
    before = jax.tree.leaves(rows_of_each(robot, tasks, q))
    traces = len(_traces)
    leaves, structure = jax.tree.flatten(tasks)
    for i, (path, leaf) in enumerate(jax.tree_util.tree_leaves_with_path(tasks)):
        if jax.tree_util.keystr(path).startswith(tuple(idle)):
            continue
        changed = leaf + 0.1 + 0.01 * np.arange(leaf.size, dtype=leaf.dtype).reshape(leaf.shape)
        after = jax.tree.leaves(
            rows_of_each(robot, jax.tree.unflatten(structure, [*leaves[:i], changed, *leaves[i + 1 :]]), q)
        )
        same = [np.array_equal(a, b) for a, b in zip(before, after, strict=True)]
        assert not all(same), f"{jax.tree_util.keystr(path)} changes nothing"
    assert len(_traces) == traces


def alone(*given):
    """Batches of one."""
    return jax.tree.map(lambda a: jnp.asarray(a)[None], given)


def assert_finite_gradients(rows, *given):
    """Of all that a dict of rows holds, in both modes, with respect to every number given, for each of a batch."""

    def numbers(*given):
        found = rows(*given).values()
        bounds = [jnp.where(jnp.isfinite(b), b, 0.0) for r in found for b in (r.lower, r.upper)]
        return jnp.concatenate([jnp.ravel(a) for r in found for a in (r.error, r.jacobian, r.weight, *bounds)])

    def both(*given):
        value, forward = jax.jvp(numbers, given, jax.tree.map(jnp.ones_like, given))
        return forward, jax.vjp(numbers, *given)[1](jnp.cos(jnp.arange(value.size, dtype=value.dtype)))

    kinds = {leaf.dtype for leaf in jax.tree.leaves(given)}
    for path, leaf in jax.tree_util.tree_leaves_with_path(jax.jit(jax.vmap(both))(*given)):
        assert {leaf.dtype} == kinds, f"{jax.tree_util.keystr(path)} is {leaf.dtype}"
        assert np.isfinite(leaf).all(), f"{jax.tree_util.keystr(path)}: {leaf}"
