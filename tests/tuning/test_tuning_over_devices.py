"""Tuning with its scenarios split over devices, of one process and of two: what one device finds, to rounding."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from other_processes import finish, free_port, start
from refusals import refuses

import osik_jax as osik
from osik_jax import tuning

JOB = """
import json, sys
import jax, jax.numpy as jnp, numpy as np, optax
{first}
import osik_jax as osik
from osik_jax import tuning

arm = osik.load_robot("arm7")
tasks = {{"hand": osik.FrameTask(arm, "hand", rows="position")}}
loop = tuning.Loop(arm, tasks, scheme=osik.NullSpace(damping=1e-2), limits=osik.no_limits, dt=0.05, steps=3)

def scenarios(count, seed):
    rng = np.random.default_rng(seed)
    place = np.asarray(tasks["hand"].target[0]) + 0.1 * rng.normal(size=(count, 3))
    if seed == 1:
        place[3] = np.nan  # is left out, on whichever device it is
    return tuning.Scenarios(q0=arm.q0 + 0.2 * rng.normal(size=(count, arm.nq)), values={{"hand.target[0]": place}})

loss = tuning.Tracking("hand") + 1e-5 * tuning.Smoothness()
search = optax.chain(optax.adam(0.3), optax.scale_by_backtracking_linesearch(max_backtracking_steps=3))
job = dict(held_out=scenarios(16, 2), loop=loop, optimizer=search, iterations=3, progress=False)
parameters = ["hand.weight", "hand.gain", "scheme.damping"]

def history(mesh):
    tuned = tuning.tune(loss, parameters, scenarios(21, 1), mesh=mesh, chunk=2, **job)  # 21 do not divide over 8
    return {{name: value.tolist() for name, value in vars(tuned.history).items() if name != "seconds"}}
"""

EIGHT = (
    JOB.format(first="")
    + """
found = {"devices": len(jax.devices())}
for name, mesh in (("one", None), ("eight", jax.sharding.Mesh(jax.devices(), ("lanes",)))):
    before = tuning._tune._step._cache_size()
    found[name] = history(mesh)
    found[name]["compiled"] = tuning._tune._step._cache_size() - before
    found[name]["losses"] = np.asarray(tuning.evaluate(loss, loop, scenarios(13, 3), mesh=mesh).losses).tolist()
print(json.dumps(found))
"""
)

TWO_HOSTS = (
    JOB.format(first='port, process = sys.argv[1:]\njax.distributed.initialize(f"localhost:{port}", 2, int(process))')
    + """
print(json.dumps({"devices": len(jax.devices()), **history(jax.sharding.Mesh(jax.devices(), ("lanes",)))}))
"""
)


@pytest.fixture(scope="module")
def eight():
    return finish(start(EIGHT, devices=8))


def assert_same(found: dict[str, Any], wanted: dict[str, Any]) -> None:
    for name in ("loss", "held_out", "gradient_norm", "vectors"):
        np.testing.assert_allclose(found[name], wanted[name], rtol=1e-10, atol=1e-14, err_msg=name)
    assert found["dropped"] == wanted["dropped"] == [1] * len(wanted["dropped"])
    assert found["held_out_dropped"] == wanted["held_out_dropped"]
    assert np.ptp(wanted["vectors"], axis=0).min() > 1e-3  # every parameter has moved


@pytest.mark.release
def test_eight_devices_tune_as_one(eight):
    """With a line search, some scenarios at a time, one left out, and a number of them that does not divide."""
    assert eight["devices"] == 8
    assert_same(eight["eight"], eight["one"])
    assert eight["eight"]["compiled"] == eight["one"]["compiled"]


@pytest.mark.release
def test_eight_devices_evaluate_as_one(eight):
    assert len(eight["one"]["losses"]) == 13
    np.testing.assert_allclose(eight["eight"]["losses"], eight["one"]["losses"], rtol=1e-12)


@pytest.mark.release
def test_two_processes_tune_as_one(eight):
    port = free_port()
    first, second = map(finish, [start(TWO_HOSTS, port, i, devices=2) for i in range(2)])
    assert first["devices"] == 4 and first == second
    assert_same(first, eight["one"])


def test_mistakes(arm):
    loop = tuning.Loop(arm, {"posture": osik.PostureTask(arm)}, scheme=osik.NullSpace(), limits=osik.no_limits, steps=1)
    scenarios, message = tuning.Scenarios(q0=arm.q0[None]), r"mesh is 8; it is a jax\.sharding\.Mesh"
    refuses(TypeError, message, tuning.tune, tuning.Effort(), ["posture.gain"], scenarios, loop=loop, mesh=8)
    refuses(TypeError, message, tuning.evaluate, tuning.Effort(), loop, scenarios, mesh=8)
