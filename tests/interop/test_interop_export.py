"""Exported controllers: loaded where osik_jax cannot be imported, they give the numbers of ``solve``."""

import io
import json
import zipfile
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from other_processes import finish, start
from refusals import refuses

import osik_jax as osik

pytest.importorskip("flatbuffers", reason="the extra export")

from osik_jax.interop import export_controller, load_exported

ELSEWHERE = """
import importlib.abc, json, sys
import numpy as np

class NoOsik(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("osik_jax", "mujoco", "equinox", "jaxlie"):
            raise ImportError(name)

sys.meta_path.insert(0, NoOsik())
import jax
jax.config.update("jax_enable_x64", sys.argv[2] == "float64")
for folder, counts in json.loads(sys.argv[1]).items():
    sys.path.insert(0, f"{folder}/controller.zip")
    from osik_controller import load_exported
    controller = load_exported(f"{folder}/controller.zip")
    given = dict(np.load(f"{folder}/in.npz"))
    q = given.pop("q")
    found = {}
    for count in counts:
        out = controller(q[:count], {name: value[:count] for name, value in given.items()})
        found |= {f"{name}.{count}": np.asarray(value) for name, value in out.items()}
    np.savez(f"{folder}/out.npz", **found)
assert not any(name.split(".")[0] in ("osik_jax", "mujoco") for name in sys.modules)
print(json.dumps("done"))
"""
SCHEMES = {
    "weighted": osik.WeightedQP,
    "hierarchical": osik.HierarchicalQP,
    "null-space": lambda: osik.NullSpace(method="saturated"),
}


def controller(priority=1):
    """An arm whose hand follows a pose, in the precision of the moment, and the priority of its posture."""
    robot = osik.load_robot("arm7")
    return robot, {
        "hand": osik.FrameTask(robot, "hand", priority=1, orientation_weight=0.3),
        "posture": osik.PostureTask(robot, priority=priority),
    }


def inputs(robot, tasks, count):
    """Configurations and targets that differ in every lane, some out of reach."""
    rng = np.random.default_rng(3)
    q = np.asarray(robot.q0) + rng.uniform(-0.3, 0.3, (count, robot.nq))
    p = np.asarray(tasks["hand"].target[0]) + rng.uniform(-0.4, 0.4, (count, 3))
    R = jax.vmap(lambda q: osik.forward_kinematics(robot, q).frame_pose(robot, "hand")[1])(q[::-1])
    given = {"q": q, "hand.target[0]": p, "hand.target[1]": R}
    return {name: np.asarray(value, robot.q0.dtype) for name, value in given.items()}


def expected(robot, tasks, given, *, scheme, limits=None, dt=0.005):
    """Answers of ``solve`` in this process."""

    def step(q, p, R):
        aimed = {**tasks, "hand": tasks["hand"].replace(target=(p, R))}
        answer = osik.solve(robot, q, aimed, scheme=scheme, limits=limits, dt=dt)
        return answer.velocity, osik.integrate(robot, q, answer.velocity, dt), answer.status

    return jax.jit(jax.vmap(step))(*given.values())


def elsewhere(folder, cases, precision="float64"):
    """Answers of controllers, by case and count, from a process that has no osik_jax."""
    work = {}
    for name, (data, given, counts) in cases.items():
        (folder / name).mkdir()
        (folder / name / "controller.zip").write_bytes(data)
        np.savez(folder / name / "in.npz", **given)
        work[str(folder / name)] = counts
    assert finish(start(ELSEWHERE, json.dumps(work), precision)) == "done"
    return {name: dict(np.load(folder / name / "out.npz")) for name in cases}


def check(found, wanted, count, atol):
    velocity, q, status = (np.asarray(a)[:count] for a in wanted)
    np.testing.assert_allclose(found[f"velocity.{count}"], velocity, atol=atol)
    np.testing.assert_allclose(found[f"q.{count}"], q, atol=atol)
    np.testing.assert_array_equal(found[f"status.{count}"], status)


def run_elsewhere(folder, schemes, precision, counts, atol):
    """Export with a symbolic batch, run in the other process and compare."""
    with jax.enable_x64(precision == "float64"):
        robot, tasks = controller(priority=1 if schemes == ["weighted"] else 2)
        given = inputs(robot, tasks, max(counts))
        made = {name: SCHEMES[name]() for name in schemes}
        options: dict[str, Any] = dict(batch="symbolic", platforms=("cpu",))
        cases = {
            name: (export_controller(robot, tasks, scheme=scheme, **options), given, counts)
            for name, scheme in made.items()
        }
        found = elsewhere(folder, cases, precision)
        for name, scheme in made.items():
            wanted = expected(robot, tasks, given, scheme=scheme)
            for count in counts:
                assert found[name][f"velocity.{count}"].dtype == precision
                check(found[name], wanted, count, atol)


@pytest.mark.slow
def test_a_batch_of_any_size_without_osik_jax(tmp_path):
    run_elsewhere(tmp_path, ["weighted"], "float64", [1, 7], 1e-9)


@pytest.mark.variants(release=["float32-0.002"])
@pytest.mark.release
@pytest.mark.parametrize(("precision", "atol"), [("float64", 1e-9), ("float32", 2e-3)])
def test_every_scheme_and_4096_lanes_without_osik_jax(tmp_path, precision, atol):
    run_elsewhere(tmp_path, list(SCHEMES), precision, [1, 7, 4096], atol)


@pytest.fixture(scope="module")
def remembering():
    """A controller whose limit remembers the last velocity, with one weight as an input, and its bytes."""
    robot, tasks = controller()
    limits = (osik.AccelerationLimit(robot, {"*": 20.0}),)
    names = ("hand.target[0]", "posture.weight")
    data = export_controller(robot, tasks, limits=limits, dt=0.01, platforms=("cpu",), inputs=names)
    return robot, tasks, limits, data


def test_names_shapes_and_units(remembering):
    robot, tasks, _, data = remembering
    loaded = load_exported(data)
    assert {name: (port.shape, port.unit) for name, port in loaded.inputs.items()} == {
        "q": ((7,), ["rad"] * 7),
        "hand.target[0]": ((3,), "m"),
        "posture.weight": ((), "1"),
        "last_velocity": ((7,), ["rad/s"] * 7),
    }
    assert {name: port.shape for name, port in loaded.outputs.items()} == {"velocity": (7,), "q": (7,), "status": ()}
    assert loaded.inputs["q"].entries == list(robot.tree.joint_names)
    assert loaded.inputs["posture.weight"].default == tasks["posture"].weight
    assert (loaded.dt, loaded.batch, loaded.platforms) == (0.01, None, ("cpu",))


@pytest.mark.slow
def test_a_loop_that_remembers_its_velocity(remembering):
    """Fed with its own velocity, an exported step with a limit on accelerations is ``rollout``."""
    robot, tasks, limits, data = remembering
    loaded = load_exported(data)
    position, weight = tasks["hand"].target[0] + jnp.array([0.1, -0.2, 0.1]), 0.02
    q, v, path = robot.q0, None, []
    for _ in range(30):
        given = {"hand.target[0]": position, "posture.weight": weight}
        out = loaded(q, given | ({} if v is None else {"last_velocity": v}))
        q, v = out["q"], out["velocity"]
        path.append(q)
    aimed = {
        "hand": tasks["hand"].replace(target=(position, tasks["hand"].target[1])),
        "posture": tasks["posture"].replace(weight=weight),
    }
    wanted = osik.rollout(robot, robot.q0, aimed, limits=limits, dt=0.01, steps=30)
    assert np.abs(wanted.q[-1] - robot.q0).max() > 0.1
    np.testing.assert_allclose(np.stack(path), wanted.q[1:], atol=1e-9)


def test_targets_are_checked_in_the_program(remembering):
    """A rotation of two digits is normalised as ``replace`` does; NaN gives a status and finite numbers."""
    robot, tasks, _, _ = remembering
    loaded = load_exported(export_controller(robot, {"hand": tasks["hand"]}, platforms=("cpu",)))
    R = np.round(np.asarray(tasks["hand"].target[1]), 2) @ np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0, 0, 1]])
    p = np.asarray(tasks["hand"].target[0])
    wanted = osik.solve(robot, robot.q0, {"hand": tasks["hand"].replace(target=(p, R))}).velocity
    np.testing.assert_allclose(loaded(robot.q0, {"hand.target[1]": R})["velocity"], wanted, atol=1e-9)
    spoilt = loaded(robot.q0, {"hand.target[0]": p * np.nan})
    assert spoilt["status"] == osik.Status.NUMERICAL_ERROR and (spoilt["velocity"] == 0.0).all()


def test_what_does_not_fit_is_told(remembering):
    robot, tasks, _, data = remembering
    loaded = load_exported(data)
    with pytest.raises(KeyError, match=r"hand\.target.*inputs: q, hand\.target\[0\], posture\.weight"):
        loaded(robot.q0, {"hand.target": robot.q0})
    refuses(ValueError, r"q has shape \(6,\), expected \(7,\)", loaded, robot.q0[:6])
    refuses(ValueError, r"hand\.target\[0\] has shape \(2,\)", loaded, robot.q0, {"hand.target[0]": robot.q0[:2]})
    refuses(ValueError, "no bytes of export_controller", load_exported, b"something else")
    with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64"):
        loaded(np.zeros(7))
    refused: list[dict[str, Any]] = [{"batch": 0}, {"batch": "many"}, {"batch": 2.5}, {"platforms": ("tpu",)}]
    for bad in [*refused, {"platforms": "cpu"}]:
        refuses((ValueError, TypeError), next(iter(bad)), export_controller, robot, tasks, **bad)
    refuses(osik.OsikError, "no number 'hand.aim'", export_controller, robot, tasks, inputs=("hand.aim",))


def test_another_release_of_jax_or_another_platform_is_refused(remembering):
    data = remembering[-1]

    def edited(**changes):
        out = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
            for name in old.namelist():
                content = old.read(name)
                if name == "description.json":
                    content = json.dumps(json.loads(content) | changes)
                new.writestr(name, content)
        return out.getvalue()

    load_exported(edited(jax="0.1.0"))  # StableHLO alone runs with other releases
    with pytest.raises(ValueError, match=r"needs the release of JAX that made it, 0\.1\.0"):
        load_exported(edited(jax="0.1.0", same_jax=True))
    refuses(ValueError, r"exported for \['cuda'\]", load_exported, edited(platforms=["cuda"]))
    refuses(ValueError, "this loader reads", load_exported, edited(format="another"))


@pytest.mark.release
def test_a_fixed_batch_and_programs_for_cuda():
    """A GPU's program of a fixed batch has no blocks of 16 lanes, which are for the caches of a CPU."""
    robot, tasks = controller()
    for scheme in (osik.WeightedQP(), osik.HierarchicalQP()):
        data = export_controller(robot, tasks, scheme=scheme, batch=40, platforms=("cpu", "cuda"))
        loaded, given = load_exported(data), inputs(robot, tasks, 40)
        wanted = expected(robot, tasks, given, scheme=scheme)[0]
        q = given.pop("q")
        np.testing.assert_allclose(loaded(q, given)["velocity"], wanted, atol=1e-9)
        refuses(ValueError, "q has shape", loaded, q[:3])
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            description = json.loads(archive.read("description.json"))
            on_gpu = jax.export.deserialize(bytearray(archive.read("program.cuda")))
        assert description["same_jax"] == isinstance(scheme, osik.HierarchicalQP)
        assert on_gpu.platforms == ("cuda",) and str(on_gpu.in_avals[0].shape[0]) == "n"


def test_a_free_base_and_robots_of_every_joint_have_units():
    """The names and units of q and v, where joints have several entries."""
    from osik_jax.control._units import configuration_units, velocity_units

    mjcf = """<mujoco><worldbody><body name="a"><freejoint name="base"/><geom size="0.1"/>
        <body><joint name="ball" type="ball"/><geom size="0.1"/>
        <body><joint name="slide" type="slide"/><geom size="0.1"/></body></body></body></worldbody></mujoco>"""
    robot = osik.Robot.from_mjcf(mjcf)
    names, units = configuration_units(robot)
    quaternion = ["qw", "qx", "qy", "qz"]
    assert names == [*(f"base.{e}" for e in ["x", "y", "z", *quaternion]), *(f"ball.{e}" for e in quaternion), "slide"]
    assert units == ["m"] * 3 + ["1"] * 8 + ["m"]
    assert velocity_units(robot)[1] == ["m/s"] * 3 + ["rad/s"] * 6 + ["m/s"]
