"""Steps of searches for poses by the compiled core, against plain JAX."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chain_robots import made
from core_checks import needs_core

import osik_jax as osik
from osik_jax.inverse._chain_problem import ChainRoute, Settings
from osik_jax.inverse._chain_search import ChainSearch, Goal

LANES = 40


@needs_core
@pytest.mark.variants(slow=["tree-False", "nao-False", "nao-True"], release=["arm7-False", "arm7-True"])
@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize("name", ["arm7", "nao", "tree"])
def test_steps_are_those_of_plain_jax(name, near, rng):
    robot, wanted = made(name)
    route, low = ChainRoute(tuple(wanted), tuple(wanted.values())), np.asarray(robot.position_lower)
    high, tolerance = np.asarray(robot.position_upper), jnp.array([1e-3, 1e-2])
    limits = jnp.where(jnp.isfinite(low), 0.5 * low, low), jnp.where(jnp.isfinite(high), 0.5 * high, high)
    settings = Settings(robot.q0, *limits, 0, tolerance, 64)
    search = jax.jit(lambda: route.search(robot, settings, warm=False, near=near))()  # one program, not hundreds

    def poses(q):
        return osik.forward_kinematics(robot, q).frame_poses(robot, route.frames)

    goal = Goal(*jax.jit(jax.vmap(poses))(robot.q0 + 0.8 * rng.standard_normal((LANES, robot.nq))))
    goal = goal._replace(position=goal.position.at[0, 0, 0].set(jnp.nan))  # harms its own lane alone
    x, stopped = jax.jit(ChainSearch.begin)(search, jnp.arange(LANES), goal), 0
    for steps in (1, 4, 4, 4):
        expected = jax.jit(ChainSearch.advance_plain, static_argnums=3)(search, x, goal, steps)
        found = jax.jit(ChainSearch.advance, static_argnums=3)(search, x, goal, steps)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a[1:], b[1:], rtol=1e-8, atol=1e-8)
            np.testing.assert_array_equal(jnp.isnan(a[0]), jnp.isnan(b[0]))
        _, x, errors = expected
        stopped = jnp.sum((x == search.lower) | (x == search.upper))
    assert stopped > 0 or near
    assert jnp.median(errors.cost[1:]) > 0.0


@needs_core
def test_robots_of_a_batch_have_their_own_chains(rng):
    robot, wanted = made("arm7")
    route = ChainRoute(tuple(wanted), tuple(wanted.values()))
    shares = jnp.array([1.0, 1.2, 0.9])
    robots = jax.vmap(lambda a: dataclasses.replace(robot, body_position=a * robot.body_position))(shares)
    x = rng.standard_normal((3, LANES, 7))
    goal = Goal(rng.standard_normal((3, LANES, 1, 3)), jnp.broadcast_to(jnp.eye(3), (3, LANES, 1, 3, 3)))

    def both(robot, x, goal):
        settings = Settings(robot.q0, robot.position_lower, robot.position_upper, 0, jnp.array([1e-3, 1e-2]), 64)
        search = route.search(robot, settings, warm=False, near=False)
        return search.advance(x, goal, 3), search.advance_plain(x, goal, 3)

    found, expected = jax.jit(jax.vmap(both))(robots, x, goal)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
