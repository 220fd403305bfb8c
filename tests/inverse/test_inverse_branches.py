"""All and nearest solutions of inverse kinematics, beside EAIK's analytic solutions and closed forms of two links."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import osik_jax as osik
from osik_jax.inverse._branches import Coordinates, _copies

UR10E = Path(__file__).parents[1] / "data" / "ur10e_branches.npz"
"""Poses of random configurations, and their solutions by EAIK 1.2.2, NaN where there are fewer than eight."""
LINKS = ((0, 0, 0.1807), (0, 0.17415, 0), (0.6127, 0, 0), (0.57155, 0, 0), (0, 0, -0.11985), (0, 0.11655, 0))
AXES = ((0, 0, 1), (0, 1, 0), (0, 1, 0), (0, 1, 0), (0, 0, -1), (0, 1, 0))


def arm_of(places, axes, joint, tip=(0, 0, 0)):
    """A chain of hinges as MJCF."""
    words = lambda numbers: " ".join(map(str, numbers))  # noqa: E731
    body = f'<site name="tip" pos="{words(tip)}"/>'
    for number, (place, axis) in reversed(list(enumerate(zip(places, axes, strict=True)))):
        hinge = f'<joint name="j{number + 1}" axis="{words(axis)}" {joint}/><geom size=".02"/>'
        body = f'<body pos="{words(place)}">{hinge}{body}</body>'
    text = f'<mujoco><compiler angle="radian" autolimits="true"/><worldbody>{body}</worldbody></mujoco>'
    return osik.Robot.from_mjcf(text)


def two_links(joint):
    return arm_of(((0, 0, 0), (1, 0, 0)), ((0, 0, 1), (0, 0, 1)), joint, tip=(1, 0, 0))


def place(q):
    return np.array([np.cos(q[0]) + np.cos(q[0] + q[1]), np.sin(q[0]) + np.sin(q[0] + q[1]), 0.0])


def counts(found):
    """How many solutions there are, and how many of them are branches."""
    assert found.count is not None and found.branches is not None
    return int(found.count), int(found.branches)


def modulo_turns(x, other):
    return np.abs(np.angle(np.exp(1j * (np.asarray(x) - other)))).max(-1)


@pytest.mark.variants(release=["home0"])
@pytest.mark.parametrize("home", [(0.0, 0.0), (50.0, -3.0)])
def test_joints_without_limits_have_two_branches_next_to_q0(home):
    robot = two_links("")
    branch = np.array([1.2584, -1.7264])
    found = osik.inverse_kinematics(robot, {"tip": place(branch)}, all=True, q0=jnp.array(home))
    assert counts(found) == (2, 2)
    solutions = np.asarray(found.solutions)[:2]
    mirrored = np.array([branch.sum(), -branch[1]])
    for expected in (branch, mirrored):
        assert modulo_turns(solutions, expected).min() < 1e-4
    assert np.abs(solutions - home).max() <= np.pi


def test_configurations_by_whole_turns_within_limits_follow_the_branches():
    robot = two_links('range="-6.2832 6.2832"')
    branch = np.array([1.2584, -1.7264])
    found = osik.inverse_kinematics(robot, {"tip": place(branch)}, all=True)
    turns = 2 * np.pi * np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    expected = np.concatenate([branch + turns, np.array([branch.sum(), -branch[1]]) + turns])
    expected = expected[(np.abs(expected) <= 6.2832).all(1)]
    assert counts(found) == (len(expected), 2) == (8, 2)
    solutions = np.asarray(found.solutions)
    assert max(np.abs(solutions[:8] - one).max(1).min() for one in expected) < 1e-4
    assert np.abs(solutions[:2]).max() <= np.pi and np.isnan(solutions[8:]).all()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_copies_by_whole_turns_stay_within_limits_also_by_rounding(rng, dtype):
    for here in rng.uniform(-6.0, 0.0, 50).astype(dtype):
        turned = here + np.asarray(2 * np.pi, dtype)
        for upper, expected in ((turned, 1), (np.nextafter(turned, here), 0)):
            own = (np.array([number]) for number in (True, here, upper, here))
            assert len(_copies(here[None, None], Coordinates(np.arange(1), *own), 8)) == expected


@pytest.mark.parametrize("joint", ["", 'range="-20 20"'])
def test_nearest_and_usual_answers_are_next_to_q0_across_turns(joint):
    robot = two_links(joint)
    for branch, turns in (((3.1, 0.4), 1), ((0.3, -0.8), -2), ((-3.1, 1.0), 2)):
        start = np.array(branch) + [2 * np.pi * turns, 0.0] + 0.02
        for nearest in (True, False):
            found = osik.inverse_kinematics(robot, {"tip": place(branch)}, q0=jnp.asarray(start), nearest=nearest)
            np.testing.assert_allclose(found.q, start - 0.02, atol=2e-3)


@pytest.mark.parametrize(("limit", "dtype"), [(600.283, "float64"), (1e10, "float64"), (1e10, "float32")])
def test_ranges_that_stand_for_none_do_not_spread_the_searches(rng, limit, dtype):
    """Files write 1e10 for no limit; a configuration of 1e9 rad has lost its angle to rounding."""
    robot = two_links(f'range="-{limit} {limit}"').astype(dtype)
    positions = np.stack([place(q) for q in rng.uniform(-3.0, 3.0, (20, 2))])
    found = osik.inverse_kinematics(robot, {"tip": positions}, seeds=16)
    q = np.asarray(found.q, float)
    assert np.asarray(found.converged).all() and np.abs(q).max() < 2 * np.pi
    assert max(np.linalg.norm(place(one) - p) for one, p in zip(q, positions, strict=True)) < 1.1e-3


@pytest.mark.slow
def test_finds_all_analytic_solutions_of_a_ur10e():
    """Joints within two turns: eight branches, some of them 0.02 rad apart."""
    robot = arm_of(LINKS, AXES, 'range="-6.2832 6.2832"')
    given = np.load(UR10E)
    found = osik.inverse_kinematics(robot, {"tip": (given["position"], given["rotation"])}, all=True)
    complete = 0
    solutions, branches = np.asarray(found.solutions), np.asarray(found.branches)
    for own, count, expected in zip(solutions, branches, given["solutions"], strict=True):
        expected = expected[np.isfinite(expected[:, 0])]
        complete += max(modulo_turns(own[:count], one).min() for one in expected) < 5e-3
    assert complete >= 0.95 * len(given["solutions"])


@pytest.mark.slow
def test_a_follower_of_half_the_angle_has_no_copies():
    """A turn of the joint brings its follower to another place."""
    robot = osik.Robot.from_mjcf(
        '<mujoco><worldbody><body><joint name="a" axis="0 0 1"/><geom size=".1"/><body pos="1 0 0"><joint name="b" '
        'axis="0 0 1"/><geom size=".1"/><site name="tip" pos=".5 0 0"/></body></body></worldbody><equality>'
        '<joint joint1="b" joint2="a" polycoef="0 0.5 0 0 0"/></equality></mujoco>'
    )
    q = 2.0
    position = np.array([np.cos(q) + 0.5 * np.cos(1.5 * q), np.sin(q) + 0.5 * np.sin(1.5 * q), 0.0])
    found = osik.inverse_kinematics(robot, {"tip": position}, q0=jnp.array([q - 2.5]), all=True)
    assert found.converged and counts(found)[0] == 1  # a turn further the follower points the other way
    np.testing.assert_allclose(found.q, [q], atol=2e-3)
