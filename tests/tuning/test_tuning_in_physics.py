"""Gains tuned in the kinematic loop stand in the physics loop, within the bounds that servos set; beyond them not."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import osik_jax as osik
from osik_jax import physics, tuning

pytestmark = pytest.mark.slow

FEET = {"left_foot": "l_sole", "right_foot": "r_sole"}
FOLLOWED = 5.0
"""The highest gain that NAO's servos follow without swinging [1/s]; docs/physics.md."""
LEGS = {pattern: physics.Servo(150.0, 5.0) for pattern in ("*Hip*", "*Knee*", "*Ankle*")}


@pytest.fixture(scope="module")
def loop():
    """NAO moves its waist over its feet; all weights and gains are the library's defaults."""
    robot = osik.load_robot("nao")
    tasks: dict[str, osik.Task] = {name: osik.FrameTask(robot, sole) for name, sole in FEET.items()}
    tasks["waist"] = osik.FrameTask(robot, "torso")
    tasks["posture"] = osik.PostureTask(robot, weight=1.0)
    limits = osik.ConfigurationLimit(robot), osik.VelocityLimit(robot)
    return tuning.Loop(robot, tasks, scheme=osik.WeightedQP(), limits=limits, dt=0.04, steps=40)


def sway(loop, by, times):
    """The waist goes by a vector and back, in the time that there is: targets (steps, 3) and (steps, 3, 3)."""
    position, rotation = loop.tasks["waist"].target
    part = np.interp(times / (times[-1] - times[0]), [0.0, 0.45, 0.55, 1.0], [0.0, 1.0, 1.0, 0.0])
    part = part**3 * (10.0 - 15.0 * part + 6.0 * part**2)
    return np.asarray(position) + part[:, None] * np.asarray(by), np.tile(rotation, (len(times), 1, 1))


@pytest.fixture(scope="module")
def tuned(loop):
    """All weights, and gains up to what the servos follow, over six sways."""
    amounts = np.random.default_rng(0).uniform((-0.02, -0.05, -0.03), (0.02, 0.05, 0.0), (6, 3))
    paths = [sway(loop, by, 0.04 * np.arange(loop.steps)) for by in amounts]
    scenarios = tuning.Scenarios(targets={"waist": tuple(np.stack(part) for part in zip(*paths, strict=True))})
    loss = tuning.Tracking("waist") + 10.0 * tuning.Tracking(*FEET) + 1e-7 * tuning.Smoothness()
    chosen = [
        tuning.Parameter("*.weight", 1e-4, 1e4),
        *(tuning.Parameter(f"{name}.gain", 0.1, FOLLOWED, initial=4.0) for name in loop.tasks),
    ]
    optimizer = optax.adam(0.2)
    return tuning.tune(loss, chosen, scenarios, loop=loop, optimizer=optimizer, iterations=50, progress=False)


def in_physics(loop, seconds, by=(0.0, 0.05, -0.01), dt=0.005):
    """A sway with contact, servos and sensed feedback.

    Whether it fell; greatest height error [m], tilt [deg], slip [m], and how far the base stays behind sideways [m].
    """
    world = physics.build_world(loop.robot, servos=LEGS)
    targets = {"waist": sway(loop, by, dt * np.arange(round(seconds / dt)))}
    settings: Any = dict(scheme=loop.scheme, limits=loop.limits, dt=dt, steps=len(targets["waist"][0]), targets=targets)
    recording = physics.simulate(physics.Simulation(world), loop.tasks, **settings)
    base, home = recording.q[1:], np.asarray(loop.robot.q0)
    count = len(base)
    height = np.abs(base[:, 2] - targets["waist"][0][:count, 2]).max()
    tilt = 2.0 * np.arccos(np.clip(np.abs(base[:, 3:7] @ home[3:7]), 0.0, 1.0)).max()
    slip = np.linalg.norm((recording.contact_points - recording.contact_points[0])[..., :2], axis=-1).max()
    behind = np.abs(base[:, 1] - targets["waist"][0][:count, 1]).max()
    return recording.fell, height, np.degrees(tilt), slip, behind


def test_the_base_of_nao_is_its_waist(loop):
    """So that the plan of the base is the target itself."""
    np.testing.assert_allclose(loop.tasks["waist"].target[0], loop.robot.q0[:3], atol=1e-12)


@pytest.mark.release
def test_tuned_gains_stand(tuned):
    assert tuned.loss < 0.2 * tuned.history.loss[0]
    gains = {name: value for name, value in tuned.parameters.items() if name.endswith("gain")}
    assert len(gains) == 4 and max(gains.values()) < FOLLOWED
    fell, height, tilt, slip, behind = in_physics(tuned.loop, 8.0)
    assert not fell
    assert height < 0.01 and tilt < 3.0 and slip < 0.005
    assert behind < 0.02


def test_without_tuning_the_waist_stays_behind(loop):
    fell, _, _, _, behind = in_physics(loop.replace({"*.gain": 4.0}), 4.0)
    assert not fell and behind > 0.04


@pytest.mark.release
def test_what_the_bound_is_for(tuned):
    """The kinematic loop takes gains up to 1 / dt and more; servos and floor do not."""
    names = [f"{name}.gain" for name in tuned.loop.tasks]
    loop = eqx.tree_at(lambda loop: loop.scheme.curvature_damping, tuned.loop, jnp.zeros(()))  # which would calm it
    fell, _, tilt, slip, _ = in_physics(loop.replace(dict.fromkeys(names, 40.0)), 4.0)
    assert fell or tilt > 3.0 or slip > 0.005


def test_targets_by_step_are_those_of_a_function_of_time(arm):
    world = physics.build_world(arm, servos={"*": physics.Servo(600.0, 50.0)})
    hand = osik.FrameTask(arm, "hand", rows="position", gain=5.0)
    home, rotation = hand.target
    others = {"posture": osik.PostureTask(arm, weight=1e-3)}
    settings: Any = dict(scheme=osik.WeightedQP(), dt=0.005, steps=40)
    path = np.asarray(home) + 0.2 * 0.005 * np.arange(40)[:, None]
    rotations = np.tile(rotation, (40, 1, 1))
    given = physics.simulate(
        physics.Simulation(world), others | {"hand": hand}, targets={"hand": (path, rotations)}, **settings
    )
    computed = physics.simulate(
        physics.Simulation(world),
        lambda t: others | {"hand": hand.replace(target=(home + 0.2 * t, rotation))},
        **settings,
    )
    np.testing.assert_allclose(given.q, computed.q, rtol=0, atol=1e-12)
    assert np.abs(given.q[-1] - given.q[0]).max() > 0.02
    simulation = physics.Simulation(world)
    with pytest.raises(KeyError, match="no task; tasks: posture"):
        physics.simulate(simulation, others, targets={"hand": (path, rotations)}, **settings)
    with pytest.raises(ValueError, match="first axis is the steps, 40"):
        physics.simulate(simulation, others | {"hand": hand}, targets={"hand": (path[:-1], rotations)}, **settings)
    with pytest.raises(ValueError, match="a function of time sets them itself"):
        physics.simulate(simulation, lambda t: others, targets={"hand": (path, rotations)}, **settings)
