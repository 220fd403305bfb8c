"""The core's plans of retargeting on a CPU: beside the plain method, which it follows iteration by iteration."""

import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_checks import needs_core
from motion_files import dancer, write_bvh

import osik_jax as osik
from osik_jax.retargeting import Retargeter, load_motion
from osik_jax.retargeting._plan import _Clip, _descended, _descended_plain

pytestmark = needs_core
FRAMES = 9
LOCKED = ("HeadYaw", "HeadPitch", "LWristYaw", "LHand", "RWristYaw", "RHand", "LElbowYaw")


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    return load_motion(write_bvh(tmp_path_factory.mktemp("clips") / "dance.bvh", dancer(FRAMES), 0.01))


def clip_of(robot, motion, balance=None):
    """What a plan is made for, with frames behind the end, and where it begins: anywhere, with shapes that overlap."""
    own = Retargeter(robot, balance=balance)
    clip = own._prepared(motion, None, None)
    frames, rng = len(clip.start), np.random.default_rng(0)
    assert frames > clip.frames == FRAMES
    free = jnp.where(jnp.arange(frames) < 3, 0.0, 1.0)
    lane = _Clip(own._body, clip.goals, own.profile.weights, clip.bounds, free)
    q = clip.start + 0.3 * rng.normal(size=clip.start.shape)
    return jax.tree.map(jnp.asarray, lane), jnp.asarray(q)


@cache
def compiled(until):
    return [jax.jit(partial(function, until=until)) for function in (_descended, _descended_plain)]


def agree(kernel, plain):
    np.testing.assert_array_equal(kernel.iterations, plain.iterations)
    np.testing.assert_allclose(kernel.cost, plain.cost, rtol=1e-7)
    np.testing.assert_allclose(kernel.q, plain.q, rtol=1e-7, atol=1e-8)


@pytest.mark.variants(slow=["ready"], release=["settled", "mended"])
@pytest.mark.parametrize("until", ["ready", "settled", "mended"])
def test_a_plan_is_improved_as_by_the_plain_method(until, nao, motion):
    clip, q = clip_of(nao, motion)
    by_kernel, plainly = compiled(until)
    for most in (0, 1, 6):
        found = by_kernel(clip, q, jnp.array(most))
        agree(found, plainly(clip, q, jnp.array(most)))
        assert int(found.iterations) == most or until == "ready"
        np.testing.assert_allclose(found.q[:3, 7:], q[:3, 7:], rtol=0.0, atol=1e-14)  # what is past
    assert np.abs(found.q - q)[3:FRAMES, 7:].max() > 0.1


@pytest.mark.slow
def test_a_plan_ends_with_the_same_step_as_by_the_plain_method(nao, motion):
    clip, _ = clip_of(nao, motion)
    start = jnp.asarray(Retargeter(nao)._prepared(motion, None, None).start)
    by_kernel, plainly = (function(clip, start, jnp.array(100)) for function in compiled("settled"))
    assert by_kernel.iterations == plainly.iterations < 100


@pytest.mark.release
def test_the_centre_of_mass_is_kept_as_by_the_plain_method(nao, motion):
    clip, q = clip_of(nao, motion, 0.02)
    by_kernel, plainly = compiled("mended")
    for contact in ([1.0, 1.0, 1.0, 1.0], [1.0, 1.0, 0.0, 1.0], [0.0, 0.0, 1.0, 1.0]):
        goals = dataclasses.replace(clip.goals, contact=clip.goals.present[:, None] * jnp.array(contact))
        given = clip._replace(goals=goals), q, jnp.array(2)
        agree(by_kernel(*given), plainly(*given))
        left_alone = dataclasses.replace(clip.body, inside=None)
        without = by_kernel(given[0]._replace(body=left_alone), *given[1:])
        assert (np.abs(without.q - by_kernel(*given).q).max() > 1e-3) == (contact[0] > 0.0)


@pytest.mark.release
def test_locked_joints_and_rows_of_whole_blocks(motion):
    robot = osik.load_robot("nao", locked_joints=dict.fromkeys(LOCKED, 0.1))
    assert robot.nv % 8 == 0
    clip, q = clip_of(robot, motion)
    by_kernel, plainly = compiled("mended")
    agree(by_kernel(clip, q, jnp.array(2)), plainly(clip, q, jnp.array(2)))


@pytest.mark.slow
def test_a_batch_is_what_each_clip_is_alone(nao, motion):
    clip, q = clip_of(nao, motion)
    starts, stiffer = jnp.stack([q, q[::-1]]), jnp.array([1.0, 2.0])
    by_kernel, _ = compiled("mended")

    def one(start, factor):
        bounds = clip.bounds._replace(step=factor * clip.bounds.step)
        return by_kernel(clip._replace(bounds=bounds), start, jnp.array(2))

    together = jax.vmap(one)(starts, stiffer)
    for i in range(2):
        alone = one(starts[i], stiffer[i])
        np.testing.assert_array_equal(together.q[i], alone.q)
        np.testing.assert_array_equal(together.cost[i], alone.cost)


@pytest.mark.parametrize("number", [0, pytest.param(1, marks=pytest.mark.release)], ids=["kernel", "plain"])
def test_what_cannot_be_solved_moves_nothing(nao, motion, number):
    clip, q = clip_of(nao, motion, 0.02)
    wrong = clip._replace(bounds=clip.bounds._replace(lower=jnp.full_like(clip.bounds.lower, jnp.nan)))
    found = compiled("mended")[number](wrong, q, jnp.array(2))
    np.testing.assert_array_equal(found.q, q)
    assert int(found.iterations) == 2
