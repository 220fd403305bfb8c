"""Batches over devices and hosts, and jobs in chunks: equal to vmap, continued when killed, refused if they differ."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from other_processes import finish, free_port, start
from refusals import refuses

import osik_jax as osik
from osik_jax import scaling
from osik_jax.scaling._fingerprint import differences, fingerprint

EIGHT = """
import json
import jax, jax.numpy as jnp, numpy as np
import osik_jax as osik
from osik_jax.scaling import sharded

arm = osik.load_robot("arm7")
limits = (osik.VelocityLimit(arm, velocity={'*': 0.4}),)
q = arm.q0 + 0.3 * jax.random.normal(jax.random.key(0), (21, arm.nq))  # 21 lanes do not divide over 8 devices
hand = osik.FrameTask(arm, "hand", rows="position", gain=3.0, priority=1)
tasks = {"hand": hand, "posture": osik.PostureTask(arm, priority=2, weight=1.0)}
many = osik.batched(tasks, {"posture.gain": jnp.linspace(1.0, 3.0, 21)})
axes = (None, 0, osik.batch_axes(tasks, "posture.gain"))
largest = lambda a, b: max(float(abs(x - y).max()) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
found = {"devices": len(jax.devices())}
step = lambda robot, q, tasks: osik.solve(robot, q, tasks, scheme=osik.HierarchicalQP(), limits=limits, dt=0.01)
split = sharded(step, axes)
a, b = split(arm, q, many), jax.jit(jax.vmap(step, axes))(arm, q, many)
split(arm, q + 0.01, many)
exact = largest((a.status, a.warm_start), (b.status, b.warm_start))
found["step"] = dict(error=largest(a, b), exact=exact, lanes=len(a.velocity), compiled=split.run._cache_size())

def path(gain, q):
    own = {"hand": hand.replace(gain=gain)}
    return osik.solve(arm, q, own, scheme=osik.NullSpace(damping=1e-2), limits=limits, dt=0.01).velocity
loss = lambda paths, gain, q: jnp.mean(paths(gain, q) ** 3)
slope = jax.jit(jax.grad(loss, argnums=(1, 2)), static_argnums=0)
both = slope(sharded(path, (None, 0)), 3.0, q), slope(jax.vmap(path, (None, 0)), 3.0, q)
for name, a, b in zip(("shared", "lanes"), *both):
    found["gradient, " + name] = dict(error=largest(a, b), size=float(abs(b).max()))

mean = sharded(lambda a, x: a * x.mean(), (None, 0))
placed = mean.place(3.0, q[:16])
out = mean(*placed)
last = placed[1].addressable_shards[7].data.shape
found["placed"] = [last, len(out.sharding.device_set), out.sharding.is_fully_replicated]
two = sharded(mean.function, (None, 0), mesh=jax.sharding.Mesh(jax.devices()[:2], ("lanes",)))(3.0, q[:16])
found["two"] = [largest(two, np.asarray(out)), len(two.sharding.device_set)]
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def eight():
    return finish(start(EIGHT, devices=8))


@pytest.mark.slow
def test_eight_devices_give_what_vmap_gives(eight):
    assert eight["devices"] == 8
    assert eight["step"]["lanes"] == 21 and eight["step"]["compiled"] == 1
    assert eight["step"]["exact"] == 0.0
    assert eight["step"]["error"] < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("what", ["shared", "lanes"])
def test_gradients_through_eight_devices(eight, what):
    found = eight[f"gradient, {what}"]
    assert found["error"] < 1e-12 * max(1.0, found["size"]) and found["size"] > 1e-4


@pytest.mark.slow
def test_results_stay_on_their_devices(eight):
    assert eight["placed"] == [[2, 7], 8, False]
    assert eight["two"][0] < 1e-12 and eight["two"][1] == 2


@pytest.mark.release
def test_explicit_mesh_axes_are_refused_and_what_the_message_advises_works(arm):
    tasks = {"hand": osik.FrameTask(arm, "hand", target=arm.q0[:3], rows="position")}
    scheme = osik.NullSpace()  # compiles soonest
    velocities = jax.vmap(lambda q: osik.solve(arm, q, tasks, scheme=scheme, dt=0.01).velocity)
    q = arm.q0 + 0.1 * jnp.arange(3.0)[:, None]
    expected = velocities(q)
    explicit, auto = (
        jax.make_mesh((1,), ("robots",), axis_types=(kind,), devices=jax.devices()[:1])
        for kind in (jax.sharding.AxisType.Explicit, jax.sharding.AxisType.Auto)
    )
    lanes = jax.sharding.PartitionSpec("robots")
    given = jax.device_put(q, jax.sharding.NamedSharding(explicit, lanes))
    with jax.set_mesh(explicit):
        refuses(TypeError, "explicit mesh axis robots", velocities, given)
        refuses(TypeError, "explicit mesh axis robots", jax.jit(velocities), given)
        apart = jax.sharding.auto_axes(velocities, axes="robots", out_sharding=lanes)(given)
        alone = osik.solve(arm, arm.q0 + 0.1, tasks, scheme=scheme, dt=0.01)  # an array without a mesh
        np.testing.assert_allclose(alone.velocity, expected[1], atol=1e-12)
    split = scaling.sharded(lambda q: osik.solve(arm, q, tasks, scheme=scheme, dt=0.01).velocity)
    refuses(TypeError, "explicit mesh axis robots", velocities, given)
    refuses(TypeError, "explicit mesh axis robots", split, given)
    on_auto = velocities(jax.device_put(q, jax.sharding.NamedSharding(auto, lanes)))
    for found in (apart, on_auto, split(np.asarray(given))):
        np.testing.assert_allclose(np.asarray(found), expected, atol=1e-12)


TWO_HOSTS = """
import json, sys
import jax, numpy as np
port, process = sys.argv[1:]
jax.distributed.initialize(f"localhost:{port}", 2, int(process))
from osik_jax.scaling import run_in_chunks, sharded
split = sharded(lambda x, a: a * x**2, (0, None))
x = np.random.default_rng(0).uniform(size=(22, 3))
total = [float(jax.jit(lambda y: y.sum())(split(some, 2.0))) for some in (x[:20], x[:5])]
try:
    run_in_chunks(split, x, chunk=8, shared=(2.0,))
except ValueError as error:
    print(json.dumps([len(jax.devices()), len(jax.local_devices()), total, str(error)]))
"""


@pytest.mark.release
def test_two_hosts_split_a_batch():
    x, port = np.random.default_rng(0).uniform(size=(22, 3)), free_port()
    for devices, own, total, message in map(finish, [start(TWO_HOSTS, port, i, devices=2) for i in range(2)]):
        assert (devices, own) == (4, 2) and "works in one process" in message
        assert total == pytest.approx([2.0 * (x[:count] ** 2).sum() for count in (20, 5)], rel=1e-14)


def numbers(start: int, stop: int) -> dict[str, Any]:
    return {"x": np.arange(start, stop, dtype=float)}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(batch=numbers(1, 21)), r"batch\.x was float64 20 \w+, is float64 20 \w+$"),
        (dict(batch=numbers(0, 21)), r"count was 20, is 21; batch\.x was float64 20 \w+, is float64 21 \w+$"),
        (dict(batch=dict(x=np.arange(20))), r"batch\.x was float64 20 \w+, is int64 20"),
        (
            dict(batch=numbers(0, 20) | dict(z=np.zeros(20))),
            r"batch\.structure was .*; batch\.z was absent, is float64",
        ),
        (dict(shared=(4.0,)), r"differs: shared\.\[0\] was float64 scalar \w+, is float64 scalar \w+$"),
        (dict(chunk=5), "differs: chunk was 8, is 5$"),
        (dict(label="cube"), "differs: label was , is cube$"),
    ],
)
def test_another_job_is_refused(tmp_path, changes, message):
    ran = []

    def function(batch, a):
        ran.append(batch)
        return {"y": a * batch["x"] ** 2}

    job: dict[str, Any] = dict(batch=numbers(0, 20), chunk=8, shared=(3.0,), out=tmp_path, progress=False)
    scaling.run_in_chunks(function, **job)
    ran.clear()
    refuses(ValueError, message, scaling.run_in_chunks, function, **job | changes)
    assert ran == []


def test_structure_of_robots_and_tasks_is_part_of_the_job():
    """The same in every process, and another for another scheme or other rows."""
    arm, again = osik.load_robot("arm7"), osik.load_robot("arm7")
    assert fingerprint(arm) == fingerprint(again)
    assert differences(fingerprint(arm), fingerprint(arm.scaled(mass={"link7": 2.0})))[0].startswith("body_mass was")
    assert fingerprint(osik.WeightedQP()) != fingerprint(osik.NullSpace())
    a, b = (fingerprint(osik.FrameTask(arm, "hand", rows=rows)) for rows in ("position", "orientation"))
    assert any(line.startswith("structure was") for line in differences(a, b))


def test_slices_by_name(tmp_path):
    x = np.random.default_rng(1).normal(size=(23, 2))
    double = jax.jit(jax.vmap(lambda x: (x[0], {"both": 2.0 * x, "none": None})))
    saved = scaling.run_in_chunks(double, x, chunk=5, out=tmp_path, progress=False)
    assert (len(saved), saved.chunks, saved.missing) == (23, 5, ())
    for lanes in (slice(None), slice(4, 11), slice(-3, None), slice(9, 9), slice(50, None)):
        found = saved[lanes]
        assert found.keys() == {"[0]", "[1].both"}
        np.testing.assert_array_equal(found["[0]"], x[lanes, 0])
        np.testing.assert_array_equal(found["[1].both"], 2.0 * x[lanes])
    first, rest = scaling.run_in_chunks(double, x, chunk=5, progress=False)
    np.testing.assert_array_equal(first, x[:, 0])
    np.testing.assert_array_equal(rest["both"], 2.0 * x)
    again = scaling.load(tmp_path)
    assert again.read(["[0]"], slice(20, 23)).keys() == {"[0]"}
    refuses(KeyError, r"no array 'both'; arrays: \[0\], \[1\]\.both", again.read, ["both"])
    one: Any = 3
    with pytest.raises(TypeError, match=r"use \[3 : 3 \+ 1\]"):
        again[one]
    with pytest.raises(ValueError, match="step"):
        again[::-1]
    refuses(FileNotFoundError, "no manifest", scaling.load, tmp_path / "elsewhere")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(chunk=0), "chunk is 0"),
        (dict(batch=dict(a=np.zeros(3), b=np.zeros(4))), "lengths: 3, 4"),
        (dict(batch={}), "nothing is given"),
        (dict(batch=numbers), "count has to say"),
        (dict(count=3), "count goes with a batch that is a function"),
        (dict(batch=lambda a, b: numbers(a, b + 1), count=9), r"batch\(0, 4\) made arrays of 5 lanes, expected 4"),
        (dict(function=lambda b: {"sum": b["x"].sum()}), "4 of them: sum does not"),
        (dict(function=lambda b: {}), "there are none"),
    ],
)
def test_mistakes_in_jobs(changes, message):
    job: dict[str, Any] = dict(function=lambda batch: batch, batch=numbers(0, 8), chunk=4, progress=False)
    refuses(ValueError, message, scaling.run_in_chunks, **job | changes)


def test_mistakes_in_sharded():
    add = scaling.sharded(lambda x, y: x + y, (0, None))
    refuses(ValueError, "in_axes has 2 parts, for 1 arguments", add, jnp.ones(3))
    refuses(ValueError, "axis 0 for an array of shape \\(\\)", add, 1.0, jnp.ones(3))
    refuses(ValueError, "found: 0", add, jnp.ones(0), 1.0)
    with pytest.raises(ValueError, match="found: 2, 3"):
        scaling.sharded(lambda x, y: x + y)(jnp.ones(3), jnp.ones(2))
    with pytest.raises(ValueError, match="in_axes splits no argument"):
        scaling.sharded(lambda x: x, None)(jnp.ones(3))
    refuses(ValueError, "in_axes has axis -1", scaling.sharded, lambda x: x, -1)
    number: Any = 3
    refuses(TypeError, "mesh is 3", scaling.sharded, lambda x: x, mesh=number)
    refuses(TypeError, "3 is no function", scaling.sharded, number)


def test_other_axes_and_precisions():
    x, y = np.arange(12.0).reshape(3, 4), np.arange(4, dtype=np.float32)
    got = scaling.sharded(lambda x, y, a: (x * y, a * y), (1, 0, None))(x, y, 2.0)
    np.testing.assert_array_equal(got[0], x.T * y[:, None])
    assert got[1].dtype == jnp.float32  # a Python number takes the precision of what it meets
