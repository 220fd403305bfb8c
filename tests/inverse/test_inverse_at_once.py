"""Plain calls for poses, which the core answers in one call: against the definition in plain JAX, and each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chain_robots import made
from core_checks import needs_core
from model_files import mjcf

import osik_jax as osik
from osik_jax.inverse._chain_problem import ChainRoute, Settings
from osik_jax.inverse._chain_search import Goal


def poses_of(robot, frames, q):
    return jax.vmap(lambda q: osik.forward_kinematics(robot, q).frame_poses(robot, frames))(q)


@needs_core
@pytest.mark.variants(slow=["tree"])
@pytest.mark.parametrize("name", ["arm7", "tree"])
def test_the_answer_of_the_core_is_that_of_the_definition(name, rng):
    """At the configuration that it found: residuals, errors, limits that stop it, and the bound on its reach."""
    robot, wanted = made(name)
    route = ChainRoute(tuple(wanted), tuple(wanted.values()))
    low, high = (np.clip(end, -2.0, 2.0) for end in (robot.position_lower, robot.position_upper))
    position, rotation = map(
        jnp.asarray, poses_of(robot, route.frames, low + (high - low) * rng.random((12, robot.nq)))
    )
    position = position.at[8:].multiply(2.5)  # some of them out of reach
    if name == "tree":  # its rows that do not count have no say in what is found
        goals = {frame: position[:, at] for at, frame in enumerate(wanted)}
        route = ChainRoute(route.frames, ((True,) * 3 + (False,) * 3,) * 2)
    else:
        goals = {frame: (position[:, at], rotation[:, at]) for at, frame in enumerate(wanted)}
    found = osik.inverse_kinematics(robot, goals, closest=False, seeds=4, restarts=1)
    assert found.converged[:8].sum() >= 6 and not found.converged[8:].any()
    settings = Settings(robot.q0, robot.position_lower, robot.position_upper, 0, jnp.array([1e-3, 1e-2]), 4)

    @jax.jit
    def defined(q):
        search = route.search(robot, settings, warm=False, near=False)
        return route.answer(
            robot, search, Goal(position, rotation), q[:, route.entries(robot)], found.seed, found.steps
        )

    expected = defined(found.q)
    for field in ("residual", "position_error", "orientation_error", "beyond_reach"):
        ours, theirs = (jax.tree.leaves(getattr(answer, field)) for answer in (found, expected))
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-5)  # the definition takes one more step towards a target
    missed = ~np.asarray(found.converged)
    np.testing.assert_array_equal(found.at_limit[missed], expected.at_limit[missed])
    np.testing.assert_array_equal(found.converged, expected.converged)


@needs_core
def test_one_target_is_answered_as_in_a_batch(rng):
    arm = osik.load_robot("ur5")
    position, rotation = (part[:, 0] for part in poses_of(arm, ("tool0",), rng.uniform(-2.0, 2.0, (3, 6))))
    for options in ({}, {"nearest": True, "seeds": 32}, {"all": True, "seeds": 32}):
        many = osik.inverse_kinematics(arm, {"tool0": (position, rotation)}, q0=arm.q0, **options)
        for at in range(3):
            one = osik.inverse_kinematics(arm, {"tool0": (position[at], rotation[at])}, q0=arm.q0, **options)
            assert jax.tree.structure(one) == jax.tree.structure(many)
            for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(many), strict=True):
                assert isinstance(a, jax.Array) and a.dtype == b.dtype
                np.testing.assert_allclose(a, b[at], atol=1e-12)


def test_what_a_trace_has_made_is_not_kept_for_later_calls():
    """Limits of a robot that are first read inside jit, then by a plain call with the same objects."""
    planar = osik.Robot.from_mjcf(mjcf("two_links_with_a_tip"))
    limits = (osik.ConfigurationLimit(planar, lower=jnp.full(2, -1.5), upper=jnp.full(2, 1.5)),)

    def find(position):
        return osik.inverse_kinematics(planar, {"tip": position}, limits=limits, seeds=4, closest=False)

    target = np.array([0.7, 0.3, 0.0])
    traced, plain = jax.jit(find)(target), find(target)
    assert traced.converged and plain.converged
    assert jnp.abs(plain.q).max() <= 1.5
