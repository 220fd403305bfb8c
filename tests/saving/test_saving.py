"""Files of controllers and rollouts: every class comes back to the last bit; errors name the file."""

import json
import os
import stat
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from every_class import all_limits, all_tasks
from refusals import refuses
from small_files import files_of_at_most

import osik_jax as osik
from osik_jax._whole_file import whole_file, write_text


def test_everything_comes_back(arm, tmp_path):
    path, tasks, limits, scheme = tmp_path / "c.json", all_tasks(arm), all_limits(arm), osik.WeightedQP(2e-6)
    osik.save_controller(path, arm, tasks, scheme=scheme, limits=limits, dt=0.01, source="arm7")
    found = osik.load_controller(path)
    assert found.dt == 0.01 and eqx.tree_equal(found.scheme, scheme) and eqx.tree_equal(found.robot, arm)
    assert list(found.tasks) == list(tasks)
    assert [name for name, task in tasks.items() if not eqx.tree_equal(found.tasks[name], task)] == []
    assert all(eqx.tree_equal(*pair) for pair in zip(found.limits, limits, strict=True))


def test_it_gives_the_same_velocity_and_keeps_changed_numbers(arm, tmp_path):
    robot = arm.scaled(length=1.1).with_home(np.asarray(arm.q0) + 0.1)
    tasks = {
        "hand": osik.FrameTask(robot, "hand", rows="position", target=jnp.array([0.4, 0.1, 0.5])),
        "p": osik.PostureTask(robot),
    }
    osik.save_controller(tmp_path / "c.json", robot, tasks, source="arm7")
    found = osik.load_controller(tmp_path / "c.json")
    one, other = (osik.solve(r, r.q0, t).velocity for r, t in ((robot, tasks), (found.robot, found.tasks)))
    np.testing.assert_array_equal(one, other)


def test_a_class_of_ones_own_and_a_function_are_refused(arm, tmp_path):
    class Mine(osik.DampingTask):
        """A task of another package."""

    make: Any = Mine
    with pytest.raises(ValueError, match=r"tasks\['mine'\] is a Mine, which is no class of osik_jax"):
        osik.save_controller(tmp_path / "c.json", arm, {"mine": make(arm)}, source="arm7")
    make = osik.FunctionTask
    own = make(arm, lambda robot, kinematics, q: q[:1], target=0.0)
    with pytest.raises(ValueError, match=r"tasks\['own'\]\..* a file cannot hold"):
        osik.save_controller(tmp_path / "c.json", arm, {"own": own}, source="arm7")
    assert not (tmp_path / "c.json").exists()


def test_a_robot_from_text_and_a_file_that_changed(tmp_path):
    text = """<mujoco><worldbody><body name="u"><joint name="a" axis="0 1 0" range="-60 60"/><geom size=".02"/>
        <body name="l" pos=".3 0 0"><joint name="b" axis="0 1 0" range="-90 45"/><geom size=".02"/></body>
        </body></worldbody></mujoco>"""
    robot = osik.Robot.from_mjcf(text, floating_base=False)
    tasks = {"tip": osik.FrameTask(robot, "l", rows="position")}
    file = tmp_path / "robot.xml"
    file.write_text(text)
    osik.save_controller(tmp_path / "f.json", robot, tasks, source=file)
    assert eqx.tree_equal(osik.load_controller(tmp_path / "f.json").robot, robot)
    file.write_text(text.replace(".3 0 0", ".4 0 0"))
    refuses(ValueError, "has changed since", osik.load_controller, tmp_path / "f.json")


TABLE = osik.CollisionShape.box((0.5, 0.5, 0.02), (0.6, 0.0, -0.1))
TOOL = osik.CollisionShape.sphere(0.03, frame="hand")


@pytest.mark.variants(slow=["locked1"], release=["locked0"])
@pytest.mark.parametrize("locked", [{}, {"joint3": 0.4, "joint5": -0.3}])
def test_a_robot_of_no_source_keeps_what_is_numbered(tmp_path, locked):
    """Fused links come after the others in the file, and locked joints are gone: numbers of frames and joints move."""
    robot = osik.load_robot("arm7", locked_joints=locked).scaled(length=1.1)
    tasks = {
        "hand": osik.FrameTask(robot, "hand", target=(jnp.array([0.4, 0.1, 0.5]), jnp.eye(3)), weight=3.0),
        "last": osik.PostureTask(robot, joints=("joint6", "joint7"), target=robot.q0 + 0.2),
        "gear": osik.JointCouplingTask(robot, {"joint4": 1.0, "joint7": 2.0}, target=0.3, hard=True),
        "rest": osik.FreezeTask(robot, joints=("joint2",)),
        "index": osik.ManipulabilityTask(robot, "hand", rows="position"),
    }
    shapes = {"table": TABLE, "tool": TOOL, "post": osik.CollisionShape.sphere(0.1, (0.3, 0.3, 0.6))}
    limits = [osik.CollisionAvoidanceLimit(robot, shapes=shapes, pairs=[("tool", "table"), ("tool", "post")])]
    osik.save_controller(tmp_path / "c.json", robot, tasks, scheme=osik.WeightedQP(), limits=limits)
    found = osik.load_controller(tmp_path / "c.json")
    given = (robot, tasks, limits), (found.robot, found.tasks, found.limits)
    answers = [osik.solve(r, r.q0, t, scheme=osik.WeightedQP(), limits=limit) for r, t, limit in given]
    np.testing.assert_allclose(answers[1].velocity, answers[0].velocity, atol=1e-9)
    kinematics = [osik.forward_kinematics(r, r.q0) for r in (robot, found.robot)]
    near = [cast(Any, limit).distances(r, k) for (r, _, (limit,)), k in zip(given, kinematics, strict=True)]
    np.testing.assert_allclose(near[1], near[0], atol=1e-12)


@pytest.mark.slow
def test_a_limit_on_meshes_needs_the_source(tmp_path):
    wedge = '<mujoco><asset><mesh name="wedge" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset><worldbody>'
    link = '<body pos="{} 0 0"><joint name="{}" axis="0 1 0"/><geom type="mesh" mesh="wedge"/></body>'
    text = wedge + link.format(0, "a") + link.format(1, "b") + "</worldbody></mujoco>"
    robot = osik.Robot.from_mjcf(text)
    tasks, limits = {"p": osik.PostureTask(robot)}, [osik.CollisionAvoidanceLimit(robot)]
    with pytest.raises(ValueError, match=r"MJCF .*[Gg]ive source="):
        osik.save_controller(tmp_path / "c.json", robot, tasks, limits=limits)
    osik.save_controller(tmp_path / "c.json", robot, tasks)
    (tmp_path / "r.xml").write_text(text)
    osik.save_controller(tmp_path / "f.json", robot, tasks, limits=limits, source=tmp_path / "r.xml")
    assert eqx.tree_equal(osik.load_controller(tmp_path / "f.json").limits[0], limits[0])


FUSED = """<mujoco><worldbody><body name="a"><joint name="a" axis="0 1 0"/><geom size=".05"/>
  <body name="b" pos="0 0 .3"><joint name="b" axis="1 0 0"/><geom size=".06"/>
    <body name="d" pos="0 0 .3"><joint name="d" axis="0 1 0"/><geom size=".07"/></body></body>
  <body name="c" pos="0 0 .5"><geom size=".2"/></body></body></worldbody>{}</mujoco>"""
GEAR = '<equality><joint joint1="d" joint2="a" polycoef="0 1 .5 0 0"/></equality>'


@pytest.mark.slow
@pytest.mark.parametrize("source", [None, "arm7"])
def test_a_robot_of_single_precision_stays_one(arm, tmp_path, source):
    """The whole controller is of one precision, so a step of it is too."""
    single = arm.astype("float32")
    tasks = {"hand": osik.FrameTask(single, "hand", target=np.array([0.4, 0.1, 0.5]), rows="position")}
    osik.save_controller(tmp_path / "c.json", single, tasks, source=source)
    found = osik.load_controller(tmp_path / "c.json")
    kinds = {jax.tree.leaves(part)[0].dtype for part in (found.robot, found.tasks, found.scheme)}
    assert kinds == {jnp.dtype("float32")}
    assert {leaf.dtype for leaf in jax.tree.leaves(found.robot)} == {leaf.dtype for leaf in jax.tree.leaves(single)}
    one, other = (osik.solve(r, r.q0, t) for r, t in ((single, tasks), (found.robot, found.tasks)))
    assert other.velocity.dtype == one.velocity.dtype
    np.testing.assert_allclose(other.velocity, one.velocity, rtol=0.0, atol=1e-4)


def moved(robot):
    return {"com": osik.ComTask(robot, target=[0.1, 0.0, 0.3]), "posture": osik.PostureTask(robot)}


def shaped(robot, frame) -> list[osik.Limit]:
    shapes = {"own": osik.CollisionShape.sphere(0.03, frame=frame), "table": TABLE}
    return [osik.CollisionAvoidanceLimit(robot, shapes=shapes, pairs=[("own", "table")])]


@pytest.mark.variants(release=["shape on a locked link", "mass of a locked joint", "shapes of fused links"])
@pytest.mark.parametrize(
    "case", ["shapes of fused links", "mass of a locked joint", "shape on a locked link", "gear of a locked joint"]
)
def test_a_robot_whose_text_gives_another_step_needs_the_source(tmp_path, case):
    """What is written is read again and compared; it may be the same after all, and then is saved."""
    limits: list[osik.Limit] = []
    if case == "shapes of fused links":
        robot = osik.Robot.from_mjcf(FUSED.format(""))
        tasks = {"p": osik.PostureTask(robot)}
        limits = [osik.CollisionAvoidanceLimit(robot, q0_distance=-np.inf)]
    elif case == "gear of a locked joint":
        robot = osik.Robot.from_mjcf(FUSED.format(GEAR), locked_joints={"a": 0.2})
        tasks = {"gear": osik.EqualityConstraintTask(robot), "p": osik.PostureTask(robot)}
    else:
        robot = osik.load_robot("arm7", locked_joints={"joint1" if case.startswith("mass") else "joint7": 0.4})
        tasks = moved(robot)
        limits = shaped(robot, "hand") if case.startswith("shape") else []
    path = tmp_path / "c.json"
    try:
        osik.save_controller(path, robot, tasks, limits=limits, scheme=osik.WeightedQP())
    except ValueError as refused:
        assert "Give source=" in str(refused) and not path.exists()
        return
    found = osik.load_controller(path)
    q = np.asarray(robot.q0) + 0.2
    answer = osik.solve(found.robot, q, found.tasks, scheme=found.scheme, limits=found.limits)
    expected = osik.solve(robot, q, tasks, scheme=osik.WeightedQP(), limits=limits)
    np.testing.assert_allclose(answer.velocity, expected.velocity, atol=1e-9)


def test_other_files_and_classes_are_refused(tmp_path, arm):
    path = tmp_path / "c.json"
    path.write_text("{}")
    refuses(ValueError, "no controller that save_controller wrote", osik.load_controller, path)
    osik.save_controller(path, arm, {"p": osik.PostureTask(arm)}, source="arm7")
    content = json.loads(path.read_text())
    for kind in ("os.system", "load_robot", "Robot", None):
        content["scheme"]["kind"] = kind
        path.write_text(edited(content))
        refuses(ValueError, "scheme is .*, which is no task, limit, scheme or gain of this", osik.load_controller, path)


def test_a_file_has_public_names_and_what_is_missing_in_it_is_the_default(saved, arm, tmp_path):
    content = json.loads(saved)
    kinds = [one["kind"] for one in (content["scheme"], *content["tasks"].values())]
    assert kinds == ["HierarchicalQP", "FrameTask", "PostureTask"]
    content |= {"scheme": {"kind": "HierarchicalQP"}, "limits": [{"kind": "ConfigurationLimit", "gain": 0.5}]}
    content["tasks"] = {"hand": {"kind": "FrameTask", "frame": "hand", "weight": 7.0}, "rest": {"kind": "PostureTask"}}
    (path := tmp_path / "c.json").write_text(edited(content))
    found = osik.load_controller(path)
    wanted = {"hand": osik.FrameTask(arm, "hand", weight=7.0), "rest": osik.PostureTask(arm)}
    assert eqx.tree_equal(found.tasks, wanted) and eqx.tree_equal(found.scheme, osik.HierarchicalQP())
    assert eqx.tree_equal(found.limits, (osik.ConfigurationLimit(arm, gain=0.5),))


def edited(content: dict[str, Any]) -> str:
    """Return the text of a file that was edited by hand: without its last two entries."""
    return json.dumps({name: value for name, value in content.items() if name not in ("core", "checksum")})


@pytest.fixture(scope="module")
def saved(arm, tmp_path_factory) -> str:
    """The text of a controller's file."""
    path = tmp_path_factory.mktemp("saved") / "c.json"
    tasks = {"hand": osik.FrameTask(arm, "hand"), "rest": osik.PostureTask(arm, priority=2)}
    osik.save_controller(path, arm, tasks, scheme=osik.HierarchicalQP(), source="arm7")
    return path.read_text()


def test_a_byte_that_changed_is_refused(saved, tmp_path, rng):
    path, whole = tmp_path / "c.json", saved.encode()
    for place, change in zip(rng.integers(len(whole), size=400), rng.integers(1, 256, 400), strict=True):
        changed = bytearray(whole)
        changed[place] ^= change
        path.write_bytes(changed)
        refuses(ValueError, rf"{path} is (no controller|not as) .*save_controller wrote", osik.load_controller, path)
    path.write_text(saved[: len(saved) // 2])
    refuses(ValueError, rf"{path} is .* damaged", osik.load_controller, path)


EDITS = {
    "period": (["dt"], 0.0, "dt is 0.0; it has to be positive and finite"),
    "no period": (["dt"], float("nan"), "dt is nan; it has to be positive"),
    "no tasks": (["tasks"], [], "there is no task"),
    "frame": (["tasks", "hand", "frame"], "paw", "no frame 'paw'"),
    "joint": (["tasks", "rest", "joints", 2], "knee", "no joint 'knee'"),
    "weight": (["tasks", "hand", "weight"], -1.0, "weight is -1.0; it has to be .* not negative"),
    "shape": (["tasks", "hand", "weight"], [1.0, 2.0], "weight has shape"),
    "text": (["tasks", "hand", "gain"], "much", r"gain|much"),
    "argument": (["tasks", "hand", "wait"], 1.0, r"tasks\['hand'\]: .*'wait'"),
    "no frame": (["tasks", "hand", "frame"], ..., r"tasks\['hand'\]: .*'frame'"),
    "task": (["tasks", "hand"], None, r"tasks\['hand'\] is None, which is no task"),
    "scheme": (["tasks", "hand"], {"kind": "WeightedQP"}, r"tasks\['hand'\] is a WeightedQP, not a Task"),
    "robot": (["robot", "name"], "arm77", "no robot 'arm77'|arm77"),
    "no scheme": (["scheme"], ..., "its entry 'scheme' is missing"),
    "no robot": (["robot"], ..., "its entry 'robot' is missing"),
}


@pytest.mark.parametrize("edit", EDITS)
def test_an_edited_file_that_solve_does_not_take_is_refused(saved, tmp_path, edit):
    place, value, message = EDITS[edit]
    part = content = json.loads(saved)
    for key in place[:-1]:
        part = part[key]
    if value is ...:
        del part[place[-1]]
    else:
        part[place[-1]] = value
    path = tmp_path / "c.json"
    path.write_text(edited(content))
    refuses(ValueError, rf"{path} cannot be loaded: .*{message}", osik.load_controller, path)


def test_on_a_full_disk_the_older_file_stays(saved, arm, tmp_path):
    (path := tmp_path / "c.json").write_text(saved)
    with files_of_at_most(500), pytest.raises(OSError, match="cannot be written: File too large") as caught:
        osik.save_controller(path, arm, {"p": osik.PostureTask(arm)}, source="arm7")
    assert caught.value.filename == str(path)
    assert [one.name for one in tmp_path.iterdir()] == ["c.json"] and path.read_text() == saved


def check_trajectory(path, trajectory) -> None:
    trajectory.save(path)
    found = osik.load_trajectory(path)
    wanted = (trajectory.time, trajectory.q, vars(trajectory.solution) | {"warm_start": None})
    found = (found.time, found.q, vars(found.solution))
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_array_equal(own, other)
        assert own.dtype == other.dtype


def test_a_file_gives_the_same_rollout(tmp_path, nao) -> None:
    tasks = {"hand/left": osik.FrameTask(nao, "l_gripper", priority=2), "com": osik.ComTask(nao)}
    check_trajectory(tmp_path / "a.npz", osik.rollout(nao, nao.q0, tasks, steps=3))


def test_of_many_rollouts(tmp_path, arm) -> None:
    tasks = {"posture.all": osik.PostureTask(arm)}
    many = jax.vmap(lambda q: osik.rollout(arm, q, tasks, steps=3))(arm.q0 + jnp.linspace(0.0, 0.1, 4)[:, None])
    check_trajectory(tmp_path / "many.npz", many)


def test_what_is_no_trajectory_is_refused(tmp_path) -> None:
    np.savez(tmp_path / "other.npz", time=np.zeros(3))
    with pytest.raises(osik.OsikError, match="other.npz is no trajectory: it has no q"):
        osik.load_trajectory(tmp_path / "other.npz")
    with pytest.raises(FileNotFoundError):
        osik.load_trajectory(tmp_path / "none.npz")


def test_links_devices_and_permissions_stay(tmp_path):
    file, link, nothing = tmp_path / "file", tmp_path / "link", tmp_path / "nothing"
    write_text(file, "older")
    file.chmod(0o640)
    link.symlink_to(file)
    write_text(link, "ä\n")
    assert link.is_symlink() and file.read_bytes() == "ä\n".encode() and stat.S_IMODE(file.stat().st_mode) == 0o640
    nothing.symlink_to(os.devnull)
    write_text(nothing, "text")
    assert nothing.is_char_device() and sorted(path.name for path in tmp_path.iterdir()) == ["file", "link", "nothing"]


def test_after_an_error_the_older_file_stays(tmp_path):
    write_text(path := tmp_path / "file", "older")
    with pytest.raises(RuntimeError), whole_file(path) as file:
        file.write(b"new")
        raise RuntimeError
    assert path.read_text() == "older" and [one.name for one in tmp_path.iterdir()] == ["file"]
    missing = tmp_path / "none" / "file"
    with pytest.raises(FileNotFoundError) as caught:
        write_text(missing, "text")
    assert caught.value.filename == str(missing)
