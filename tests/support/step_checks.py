"""Control steps of several robots or configurations, by the core's one call and by the definition in plain JAX."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import osik_jax as osik
from osik_jax.control import _compiled_step, _step
from osik_jax.limits import with_own_limits

DT, LANES = 0.005, 6
SCHEMES = {
    "weighted": osik.WeightedQP,
    "hierarchy": osik.HierarchicalQP,
    "null-space": osik.NullSpace,
    "saturated": partial(osik.NullSpace, method="saturated"),
}


def frames_of(robot: osik.Robot) -> list[str]:
    """Two frames at the ends of the tree."""
    parents = set(np.asarray(robot.tree.body_parents).tolist())
    ends = [name for body, name in enumerate(robot.tree.body_names) if body not in parents]
    return [ends[-1], robot.tree.body_names[2]]


def lanes_of(robot: osik.Robot, spread: float = 0.2, seed: int = 0) -> Any:
    noise = np.random.default_rng(seed).normal(size=(LANES, robot.nv))
    return jax.vmap(lambda v: osik.integrate(robot, robot.q0, v, spread))(jnp.asarray(noise, robot.q0.dtype))


def arguments(robot: osik.Robot, tasks: dict[str, osik.Task], scheme: osik.Scheme) -> tuple[Any, ...]:
    return tasks, scheme, with_own_limits(robot, None), jnp.asarray(DT, robot.q0.dtype), None


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, *[None] * 5))
def in_plain_jax(robot: osik.Robot, q: Any, *rest: Any) -> osik.Solution:
    return _step._plain_step(robot, q, *rest)


def plainly(tasks: Any, scheme: Any, *rest: Any) -> tuple[Any, ...]:
    """Levels are solved by the kernels, whose answers have roundoff of 1e-10 beside those of plain JAX."""
    return tasks, osik.WeightedQP(backend="jax") if isinstance(scheme, osik.WeightedQP) else scheme, *rest


def by_core(robot: osik.Robot, q: Any, *rest: Any) -> tuple[osik.Solution, np.ndarray]:
    """The core's answers for lanes of q, and which are certified."""

    @jax.jit  # one program: its operations by themselves would be hundreds
    def program(*given: Any) -> osik.Solution:
        packed = _compiled_step._Arrays(given)
        return _compiled_step._by_core(packed, *packed.arrays)

    first, *others = jax.tree.map(lambda a: jnp.asarray(a)[None], (robot, *rest))
    found = program(first, q, *others)
    return found, np.asarray(found.status) == 0


def plain(robot: osik.Robot, q: Any, *rest: Any) -> osik.Solution:
    """The step from its parts."""
    return in_plain_jax(robot, q, *plainly(*rest))


def assert_close(found: Any, wanted: Any, tolerance: float) -> None:
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=0.0, atol=tolerance)


def assert_answers_of_plain_jax(
    robot: osik.Robot, given: tuple[Any, ...], tolerance: float
) -> tuple[osik.Solution, osik.Solution]:
    """Return the core's answers and those of plain JAX; assert that they agree within a relative tolerance."""
    q = lanes_of(robot)
    assert _step.is_compiled(robot, q[0], *given)
    found, done = by_core(robot, q, *given)
    wanted = plain(robot, q, *given)
    assert done.mean() > 0.8 and (np.asarray(wanted.status)[done] == 0).all()
    for field in ("velocity", "slack", "error"):
        a, b = (jax.tree.map(lambda x: x[done], getattr(s, field)) for s in (found, wanted))
        assert_close(a, b, tolerance * (1.0 + max(float(jnp.abs(x).max()) for x in jax.tree.leaves(b))))
    return found, wanted


def assert_near_in_single_precision(name: str, tasks_of: Any, scheme: str) -> None:
    """Assert that the core's answer for a robot by name in float32 is plain JAX's in float64, but for roundoff."""
    with jax.enable_x64(False):
        robot = osik.load_robot(name)
        q = lanes_of(robot)
        found, done = by_core(robot, q, *arguments(robot, tasks_of(robot), SCHEMES[scheme]()))
        assert found.velocity.dtype == jnp.float32 and done.all()
    robot = osik.load_robot(name)
    wanted = plain(robot, jnp.asarray(q, float), *arguments(robot, tasks_of(robot), SCHEMES[scheme]()))
    np.testing.assert_allclose(found.velocity, wanted.velocity, atol=2e-3 * float(jnp.abs(wanted.velocity).max()))


def assert_slopes_are_differences(cost: Any, *given: Any) -> None:
    """Assert that the gradient of a jitted function by all its arguments is that of central differences."""
    found, _ = ravel_pytree(jax.jit(jax.grad(cost, argnums=tuple(range(len(given)))))(*given))
    flat, tree = ravel_pytree(given)
    wanted = [float(cost(*tree(flat + h)) - cost(*tree(flat - h))) / 2e-6 for h in 1e-6 * np.eye(len(flat))]
    assert np.abs(wanted).max() > 1e-3
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-9 * np.abs(wanted).max())


def assert_alike_where_numbers_are_not_valid(given: Any, scheme: str) -> None:
    """Assert the answers of plain JAX with NaN, infinity or -1 in place of the first number of each argument."""
    leaves, tree = jax.tree.flatten(given)
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_flatten_with_path(given)[0]]
    cases = [(k, np.nan) for k, leaf in enumerate(leaves) if leaf.size]
    # the core does not look at an infinite mass of the world; negative weights in levels, and tolerances, mean nothing
    cases += [(k, np.inf) for k, _ in cases if not names[k].startswith("[0]")]
    meaningless = ("rank_tolerance",) if scheme == "weighted" else ("rank_tolerance", "weight")
    negative = [k for k, name in enumerate(names) if not any(field in name for field in meaningless)]
    cases += [(k, -1.0) for k, value in cases if np.isnan(value) and k in negative]
    wide = [np.tile(np.asarray(leaf)[None], (len(cases), *[1] * leaf.ndim)) for leaf in leaves]
    for lane, (k, value) in enumerate(cases):
        wide[k].reshape(len(cases), -1)[lane, 0] = value
    assert_alike(jax.tree.unflatten(tree, list(map(jnp.asarray, wide))), scheme)


def assert_alike(lanes: Any, scheme: str) -> None:
    """Assert the statuses and numbers of plain JAX for a batch of arguments, some of which are not valid."""
    found, wanted = (jax.jit(jax.vmap(step))(*lanes) for step in (_step._compiled_step, _step._plain_step))
    np.testing.assert_array_equal(found.status, wanted.status)
    assert set(np.asarray(wanted.status).tolist()) >= {0, 3}
    fields = "velocity", "slack", "error", "box_violation"
    for a, b in zip(*(jax.tree.leaves([getattr(s, field) for field in fields]) for s in (found, wanted)), strict=True):
        np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-9)
    failed = np.asarray(wanted.status) == 3
    np.testing.assert_array_equal(found.kkt_residual[failed], wanted.kkt_residual[failed])
    if scheme in ("null-space", "saturated"):
        for field in ("iterations", "factorizations"):
            np.testing.assert_array_equal(getattr(found, field), getattr(wanted, field))
    assert all(np.isfinite(np.asarray(a)).all() for a in jax.tree.leaves(found))
