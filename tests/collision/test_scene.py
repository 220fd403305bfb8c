"""Scenes: shapes as arrays, capacity, names, things in hands, and files of MuJoCo, URDF and MoveIt."""

import sys
import types
from pathlib import Path

import coal
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pinocchio as pin
import pytest
from example_files import example_file
from refusals import no_warnings, refuses
from robot_support import coal_support, directions, pinocchio_geometry, table_support

import osik_jax as osik
from osik_jax.collision._robot_shapes import robot_shapes
from osik_jax.collision._table import ShapeKind, ShapeTable

SHAPE = osik.CollisionShape
TURN = np.array([0.6, 0.0, 0.8, 0.0])  # w x y z
CLOUD = np.random.default_rng(1).standard_normal((30, 3))


@pytest.fixture(scope="module")
def panda():
    return osik.load_robot("panda")


def every_kind():
    return {
        "table": SHAPE.box([0.5, 0.4, 0.02], [0.6, 0, 0.1], TURN),
        "can1": SHAPE.cylinder(0.03, [0.5, 0, 0], [0.5, 0, 0.14]),
        "rail": SHAPE.capsule(0.02, [0, 0, 1], [1, 0, 1.5]),
        "ball": SHAPE.sphere(0.1, [1, 2, 3]),
        "floor": SHAPE.half_space([0, 0, -1], [0, 1, 1]),
        "rock": SHAPE.convex(CLOUD, [1, 0, 0], TURN),
    }


def on_host(scene: osik.Scene) -> ShapeTable:
    return jax.tree.map(np.asarray, scene.table)


def supports(scene: osik.Scene) -> dict[str, np.ndarray]:
    """Support function of each shape, half spaces left out."""
    table, ways = on_host(scene), directions()
    rows = [k for k in range(len(scene.names)) if table.kind[k] != ShapeKind.HALF_SPACE]
    return {scene.names[k]: table_support(table, k, ways) for k in rows}


def test_shapes_are_those_of_coal():
    """Cylinders, too, which are no prisms here."""
    found, turned = supports(osik.Scene(every_kind())), pin.Quaternion(*TURN).matrix()
    axis = np.array([1, 0, 0.5]) / np.linalg.norm([1, 0, 0.5])
    wanted = {
        "table": (coal.Box(1.0, 0.8, 0.04), pin.SE3(turned, np.array([0.6, 0, 0.1]))),
        "can1": (coal.Cylinder(0.03, 0.14), pin.SE3(np.eye(3), np.array([0.5, 0, 0.07]))),
        "ball": (coal.Sphere(0.1), pin.SE3(np.eye(3), np.array([1.0, 2.0, 3.0]))),
    }
    for name, (geometry, pose) in wanted.items():
        np.testing.assert_allclose(found[name], coal_support(geometry, pose, directions()), atol=1e-6)
    ends = np.stack([directions() @ [0, 0, 1], directions() @ [1, 0, 1.5]])
    np.testing.assert_allclose(found["rail"], 0.02 + ends.max(0), atol=1e-6)
    points = CLOUD @ turned.T + [1, 0, 0]
    np.testing.assert_allclose(found["rock"], (directions() @ points.T).max(1), atol=2e-6)
    table = on_host(osik.Scene(every_kind()))
    np.testing.assert_allclose(table.rotation[4][:, 2], [0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-6)
    np.testing.assert_allclose(table.position[4], [0, 0, -1])
    assert axis @ table.rotation[2][:, 2] == pytest.approx(1.0)


def test_another_scene_compiles_nothing(panda):
    shapes, traced = robot_shapes(panda), []

    @jax.jit
    def touched(scene):
        traced.append(scene)
        return scene.table.position.sum() + scene.contacts(shapes).sum() + (scene.body >= 0).sum()

    first = osik.Scene(every_kind()).allow(("can1", "panda_*finger"))
    others = {f"box {k}": SHAPE.box([0.1, 0.1, 0.1 * (k + 1)], [k, 0, 0]) for k in range(7)}
    second = osik.Scene({**others, "stone": SHAPE.convex(CLOUD[:20])}).allow(("box 3", "panda_*finger"))
    for scene in (first, second, second.moved("box 1", ([1, 2, 3], TURN)), osik.Scene.stack([first, second])[1]):
        expected = np.asarray(scene.table.position).sum() + scene.contacts(shapes).sum()
        assert float(touched(scene)) == pytest.approx(float(expected), abs=1e-4)
    assert len(traced) == 1 and first.capacity == second.capacity == 8
    assert second.names[-1] == "stone" and "stone" not in str(first) and "stone" in str(second)


def test_capacity_is_stated_or_the_next_power_of_two():
    assert [osik.Scene({str(k): SHAPE.sphere(1.0) for k in range(n)}).capacity for n in (0, 1, 2, 3, 9)] == [
        0,
        1,
        2,
        4,
        16,
    ]
    scene = osik.Scene(every_kind(), capacity=7, vertex_capacity=100)
    assert scene.capacity == 7 and scene.table.vertices.shape == (100, 3)
    table = on_host(scene)
    assert table.kind[6] == ShapeKind.ABSENT and np.array_equal(table.rotation[6], np.eye(3))
    refuses(ValueError, "vertices of hulls, and its vertex_capacity is 3", osik.Scene, every_kind(), vertex_capacity=3)


def test_a_stack_has_a_scene_for_each_target(panda):
    scenes = [
        osik.Scene(every_kind()).allow(("can1", "panda_hand")),
        osik.Scene({"a": SHAPE.sphere(0.2)}),
        osik.Scene({"a": SHAPE.box([1, 1, 1]), "b": SHAPE.sphere(1.0)}).allow(("b", "panda_link7"), ("b", "a")),
    ]
    stack, shapes = osik.Scene.stack(scenes), robot_shapes(panda)
    assert stack.table.kind.shape == (3, 8) and stack.contact.shape == (3, 8, 3) and stack.is_stack
    contacts = jax.vmap(lambda scene: scene.contacts(shapes))(stack)
    assert np.array_equal(contacts, stack.contacts(shapes))
    for k, scene in enumerate(scenes):
        assert stack[k].names == scene.names and not stack[k].is_stack
        assert np.array_equal(contacts[k][: scene.capacity], scene.contacts(shapes))
        for own, whole in zip(on_host(scene)[:6], on_host(stack[k])[:6], strict=True):
            np.testing.assert_array_equal(own, whole[: scene.capacity])


def test_objects_move_as_one_and_the_pose_has_derivatives():
    parts = [SHAPE.sphere(0.1, [0, 0, 1]), SHAPE.sphere(0.1, [0, 0.5, 1])]
    scene = osik.Scene({"pair": parts, "other": SHAPE.sphere(1.0)})
    assert scene.names == ("pair:0", "pair:1", "other")
    quarter = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])  # about z
    np.testing.assert_allclose(
        scene.moved("pair", ([2, 0, 0], quarter)).table.position[:3], [[2, 0, 0], [1.5, 0, 0], [0, 0, 0]], atol=1e-6
    )
    assert np.array_equal(scene.moved("pair:1", np.eye(4)).table.position[0], [0, 0, 1])
    rate = jax.jit(jax.grad(lambda x: scene.moved("pair", (x, np.eye(3))).table.position[1, 0] ** 2))(
        jnp.array([3.0, 0, 0])
    )
    np.testing.assert_allclose(rate, [6, 0, 0], atol=1e-6)
    refuses(KeyError, "no shape 'pear'; did you mean 'pair'", scene.moved, "pear", np.eye(4))
    refuses(ValueError, "the pose of 'pair''s quaternion is not one", scene.moved, "pair", ([0, 0, 0], [0, 0, 0, 0]))


def test_what_a_hand_holds_moves_with_it(panda):
    """Beside Pinocchio's pose of the hand."""
    model, _ = pinocchio_geometry(example_file("panda_description/urdf/panda.urdf"))
    data, frame = model.createData(), model.getFrameId("panda_hand")

    def hand(q):
        full = pin.neutral(model)
        full[:7] = q[:7]
        pin.framesForwardKinematics(model, data, full)
        return pin.SE3(data.oMf[frame])

    start, later = np.asarray(panda.q0, float), np.asarray(panda.q0, float) + 0.3
    scene = osik.Scene(every_kind())
    held = scene.attach("can1", panda, "panda_hand", q=start, touch=["panda_*finger"])
    assert [panda.tree.body_names[b] for b in held.body if b >= 0] == ["panda_link7"]
    moved = hand(later) * hand(start).inverse() * pin.SE3(np.eye(3), np.array([0.5, 0, 0.07]))
    world = held.detach("can1", panda, later)
    np.testing.assert_allclose(world.table.position[1], moved.translation, atol=1e-6)
    np.testing.assert_allclose(world.table.rotation[1][:, 2], moved.rotation[:, 2], atol=1e-6)
    assert (np.asarray(world.body) == -1).all()
    shapes = robot_shapes(panda)
    touched = {shapes.links[k] for k in np.flatnonzero(held.contacts(shapes)[1])}
    assert touched == {"panda_hand", "panda_link7", "panda_leftfinger", "panda_rightfinger"}
    assert not held.contacts(shapes)[[0, 2, 3, 4, 5]].any()
    assert scene.attach("can1", panda, "panda_hand", touch="panda_*finger").partners == held.partners
    in_hand = scene.moved("can1", ([0, 0, 0.1], TURN)).attach("can1", panda, "panda_hand").detach("can1", panda, later)
    wanted = hand(later) * pin.SE3(pin.Quaternion(*TURN), np.array([0, 0, 0.1]))
    np.testing.assert_allclose(in_hand.table.position[1], wanted.translation, atol=1e-6)
    refuses(ValueError, "'can1' is held already; detach it first", held.attach, "can1", panda, "panda_hand")
    refuses(ValueError, "no body holds 'ball', so it cannot be detached", held.detach, "ball", panda, start)
    refuses(KeyError, "no frame 'hand'", scene.attach, "can1", panda, "hand")


def test_allowed_pairs_by_name_and_glob(panda):
    shapes = robot_shapes(panda)
    scene = osik.Scene(every_kind()).allow(("can*", "table"), ("ball", "panda_leftfinger:2"))
    assert np.argwhere(np.asarray(scene.among)).tolist() == [[0, 1], [1, 0]]
    allowed = [(scene.names[i], shapes.names[j]) for i, j in np.argwhere(scene.contacts(shapes))]
    assert allowed == [("ball", "panda_leftfinger:2")]
    alike = osik.Scene({"can[1]": SHAPE.sphere(0.1), "can1": SHAPE.sphere(0.1)})
    assert alike.moved("can[1]", ([5, 0, 0], TURN)).table.position[:, 0].tolist() == [5, 0]
    assert alike.moved("can[0-9]", ([5, 0, 0], TURN)).table.position[:, 0].tolist() == [0, 5]
    refuses(TypeError, "names of a traced scene are unknown", jax.jit(lambda s: s.allow(("can1", "panda_hand"))), scene)


def test_mistakes_are_named():
    refuses(
        TypeError, "'a' is traced: make the scene outside", jax.jit(lambda r: osik.Scene({"a": SHAPE.sphere(r)})), 1.0
    )
    refuses(TypeError, "a mesh is a path, or vertices", SHAPE.mesh, 3)
    refuses(ValueError, "are no triangles of 4 vertices", SHAPE.mesh, (np.eye(4, 3), [[0, 1, 7]]))
    refuses(ValueError, "a quaternion w x y z", SHAPE.box, [1, 1, 1], [0, 0, 0], [1, 0])


L_SHAPE = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]


def bent_mesh():
    """A closed prism over an L, whose volume is 3 and whose hull's is 3.5."""
    vertices = np.array([(x, y, z) for z in (0, 1) for x, y in L_SHAPE], float)
    tops = [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]
    faces = [*((a, c, b) for a, b, c in tops), *((a + 6, b + 6, c + 6) for a, b, c in tops)]
    for k in range(6):
        n = (k + 1) % 6
        faces += [(k, n, n + 6), (k, n + 6, k + 6)]
    return vertices, np.array(faces)


def test_meshes_that_are_not_convex_are_split_if_coacd_is_there(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "coacd", None)
    with pytest.warns(osik.OsikWarning, match="a mesh fills 86% of its convex hull, and the hull stands for it"):
        (whole,) = SHAPE.mesh(bent_mesh())
    assert len(osik.Scene({"l": whole}).names) == 1
    vertices, _ = bent_mesh()
    boxes = [vertices[[0, 1, 2, 6, 7, 8]], vertices[[0, 3, 4, 5, 6, 9, 10, 11]]]
    stub = types.SimpleNamespace(
        set_log_level=lambda level: None,
        Mesh=lambda *parts: parts,
        run_coacd=lambda mesh, **how: [(2.0 * b, None) for b in boxes],
    )
    monkeypatch.setitem(sys.modules, "coacd", stub)
    with no_warnings():
        scene = osik.Scene({"l": SHAPE.mesh(bent_mesh(), [1, 0, 0], scale=2.0)})
    assert scene.names == ("l:0", "l:1")
    np.testing.assert_allclose(
        supports(scene)["l:1"], (directions() @ (2.0 * boxes[1] + [1, 0, 0]).T).max(1), atol=1e-6
    )


YAML = """
allowed_collision_matrix:
  entry_names: [can, hand, arm]
  entry_values: [[false, true, false], [true, false, true], [false, true, false]]
robot_state: {attached_collision_objects: [{object: {id: cup}}]}
world:
  collision_objects:
  - id: can
    primitives: [{type: cylinder, dimensions: [0.2, 0.03]}]
    primitive_poses: [{position: [1, 0, 0], orientation: [0, 0, 0, 1]}]
  - id: shelf
    pose: {position: {x: 0, y: 0, z: 1}, orientation: {x: 0, y: 0, z: 0.6, w: 0.8}}
    primitives:
    - {type: 1, dimensions: [1, 2, 3]}
    - {type: sphere, dimensions: [0.5]}
    - {type: cone, dimensions: [0.4, 0.1]}
    primitive_poses:
    - {position: [1, 0, 0], orientation: [0, 0, 0, 1]}
    - {position: [0, 1, 0], orientation: [0, 0, 0, 1]}
    - {position: [0, 0, 1], orientation: [0, 0, 0, 1]}
  - id: ground
    planes: [{coef: [0, 0, 2, 1]}]
    plane_poses: [{position: [0, 0, 0], orientation: [0, 0, 0, 1]}]
  - id: tent
    meshes: [{vertices: [{x: 0, y: 0, z: 0}, [1, 0, 0], [0, 1, 0], [0, 0, 1]],
              triangles: [{vertex_indices: [0, 2, 1]}, [0, 1, 3], [0, 3, 2], [1, 2, 3]]}]
    mesh_poses: [{position: [5, 0, 0], orientation: [0, 0, 0, 1]}]
"""

TEXT = """a scene
* can
1 0 0
0 0 0 1
1
cylinder
0.03 0.2
0 0 0
0 0 0 1
0 0 0 0
0
* shelf of books
0 0 1
0 0 0.6 0.8
3
box
1 2 3
1 0 0
0 0 0 1
1 0 0 1
sphere
0.5
0 1 0
0 0 0 1
0 0 0 0
cone
0.1 0.4
0 0 1
0 0 0 1
0 0 0 0
1
front
0 0 0
0 0 0 1
* ground
0 0 0
0 0 0 1
1
plane
0 0 2 1
0 0 0
0 0 0 1
0 0 0 0
0
* tent
5 0 0
0 0 0 1
1
mesh
4 4
0 0 0
1 0 0
0 1 0
0 0 1
0 2 1
0 1 3
0 3 2
1 2 3
0 0 0
0 0 0 1
0 0 0 0
0
.
"""
OLD_TEXT = "old\n* can\n1\ncylinder\n0.03 0.2\n1 0 0\n0 0 0 1\n0 0 0 0\n.\n"


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_scenes_of_moveit(tmp_path: Path, panda):
    with pytest.warns(osik.OsikWarning, match="objects attached to a robot are left out; use Scene.attach: cup"):
        scene = osik.Scene.from_file(written(tmp_path, "a.yaml", YAML))
    assert scene.names == ("can", "shelf:0", "shelf:1", "shelf:2", "ground", "tent")
    found, ways, turn = supports(scene), directions(), pin.Quaternion(0.8, 0, 0, 0.6).matrix()
    shelf = pin.SE3(turn, np.array([0, 0, 1.0]))
    wanted = {
        "can": (coal.Cylinder(0.03, 0.2), pin.SE3(np.eye(3), np.array([1.0, 0, 0]))),
        "shelf:0": (coal.Box(1, 2, 3), shelf * pin.SE3(np.eye(3), np.array([1.0, 0, 0]))),
        "shelf:1": (coal.Sphere(0.5), shelf * pin.SE3(np.eye(3), np.array([0, 1.0, 0]))),
    }
    for name, (geometry, pose) in wanted.items():
        np.testing.assert_allclose(found[name], coal_support(geometry, pose, ways), atol=1e-6)
    round_part = 0.1 * np.linalg.norm(ways[:, :2], axis=1) - 0.2 * ways[:, 2]
    excess = found["shelf:2"] - (2.0 * ways[:, 2] + np.maximum(0.2 * ways[:, 2], round_part))
    assert excess.min() > -1e-6 and excess.max() < 0.005 * 0.1
    np.testing.assert_allclose(scene.table.position[4], [0, 0, -0.5], atol=1e-7)
    corners = np.eye(4, 3) + np.array([5, 0, 0])
    np.testing.assert_allclose(found["tent"], (ways @ corners.T).max(1), atol=1e-6)
    assert scene.partners == ("hand",) and np.flatnonzero(scene.contact[:, 0]).tolist() == [0]
    same = osik.Scene.from_file(written(tmp_path, "a.scene", TEXT))
    assert same.names == tuple(name.replace("shelf", "shelf of books") for name in scene.names)
    for own, other in zip(on_host(scene), on_host(same), strict=True):
        np.testing.assert_allclose(own, other, atol=1e-7)
    old = osik.Scene.from_file(written(tmp_path, "old.scene", OLD_TEXT))
    np.testing.assert_allclose(supports(old)["can"], found["can"], atol=1e-7)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.stl", "", "is no scene: there are .xml"),
        ("a.yaml", "a: [", "a.yaml: while parsing"),
        ("a.yaml", "robot: 1", "a.yaml: it has no 'world'"),
        ("a.yaml", YAML.replace("dimensions: [0.5]", "dimensions: [-1]"), "the sizes of a sphere are .* positive"),
        ("a.yaml", YAML.replace("type: sphere", "type: torus"), "'torus' is no shape of MoveIt"),
        ("a.yaml", YAML.replace("id: can", "name: can"), "'id' is missing"),
        ("a.scene", TEXT.replace("1 0 0 1\nsphere", "1 0 0\nsphere"), "could not convert"),
        ("a.scene", "x\n* a\n0 0 0\n0 0 0 1\n1\nbox\n1 1", "an object ends too early"),
        ("a.scene", TEXT.replace("0 0 0.6 0.8", "0 0 0 0"), "no pose: position"),
        ("a.xml", "<mujoco><worldbody><geom type='box'/></worldbody></mujoco>", "a.xml: "),
        ("a.xml", "<sdf/>", "the root element is <sdf>, not <mujoco>"),
    ],
)  # fmt: skip
def test_broken_files_are_named(tmp_path: Path, name: str, text: str, message: str):
    refuses(ValueError, message, osik.Scene.from_file, written(tmp_path, name, text))
    refuses(FileNotFoundError, "no scene file", osik.Scene.from_file, tmp_path / "lost.yaml")


def test_scenes_of_mujoco(tmp_path: Path):
    text = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>
    <body name="box" pos="1 0 0" euler="0 0 30"><freejoint/><geom type="box" size=".1 .2 .3"/>
    <geom type="ellipsoid" size=".1 .2 .3" pos="0 0 1"/>
    <geom type="sphere" size="1" contype="0" conaffinity="0"/></body>
    <geom type="capsule" size=".1 .2"/></worldbody></mujoco>"""
    path = written(tmp_path, "a.xml", text)
    scene, model = osik.Scene.from_file(path), mujoco.MjModel.from_xml_path(str(path))
    assert scene.names == ("floor", "world", "box:0", "box:1")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for row, geom in ((1, 1), (2, 2)):
        np.testing.assert_allclose(scene.table.position[row], data.geom_xpos[geom], atol=1e-7)
        np.testing.assert_allclose(np.ravel(scene.table.rotation[row]), data.geom_xmat[geom], atol=1e-6)
        np.testing.assert_allclose(scene.table.size[row], model.geom_size[geom], atol=1e-7)


@pytest.mark.filterwarnings("ignore::osik_jax.OsikWarning")
def test_scenes_of_urdf_are_those_of_pinocchio():
    urdf = example_file("panda_description/urdf/panda.urdf")
    scene, (model, geometry) = osik.Scene.from_file(urdf), pinocchio_geometry(urdf)
    data, ways = model.createData(), directions()
    placed = pin.GeometryData(geometry)
    pin.updateGeometryPlacements(model, data, geometry, placed, np.zeros(model.nq))
    found = list(supports(scene).values())
    assert len(found) == geometry.ngeoms == 17
    for thing, pose in zip(geometry.geometryObjects, placed.oMg, strict=True):
        wanted = coal_support(thing.geometry, pose, ways)
        assert min(abs(own - wanted).max() for own in found) < 1e-6
