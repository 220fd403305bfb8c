"""What pictures of URDFs show: mesh files against Coal, triangles against brute force, cameras against projections."""

import struct
from pathlib import Path

import coal
import mujoco
import numpy as np
import pytest
from example_files import example_file
from PIL import Image
from refusals import refuses
from trimesh import Trimesh

import osik_jax as osik
from osik_jax import viewer
from osik_jax.robot._mujoco import mujoco_poses
from osik_jax.robot.loading._collada import read_collada
from osik_jax.robot.loading._meshes import read_mesh
from osik_jax.viewer._parts import lowest_points, robot_parts
from osik_jax.viewer._stage import frame_camera
from osik_jax.viewer.live._surfaces import part_triangles

MESHES = Path(__file__).parents[1] / "data" / "meshes"
COLLADA = (MESHES / "square.dae").read_text(encoding="utf-8")
CUBE_OBJ = (MESHES / "box.obj").read_text(encoding="utf-8")
ARM = (MESHES / "arm.urdf").read_text(encoding="utf-8")


def written(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def look_of(robot):
    """The visual shapes of a robot's URDF."""
    assert robot.holder.look is not None
    return robot.holder.look.read


def test_collada_by_hand(tmp_path):
    """A unit square, stretched to 2 by 3, turned, moved, in centimetres."""
    (part,) = read_collada(written(tmp_path / "square.dae", COLLADA))
    np.testing.assert_allclose(part.vertices.min(0), [0.97, 0.0, 0.5], atol=1e-12)
    np.testing.assert_allclose(part.vertices.max(0), [1.0, 0.02, 0.5], atol=1e-12)
    assert Trimesh(part.vertices, part.faces, process=False).area == pytest.approx(6e-4)
    assert part.color == (1.0, 0.5, 0.0, 1.0) and not part.y_up
    a, b, c = part.vertices[part.faces[0]]
    assert np.cross(b - a, c - a)[2] > 0.0


@pytest.mark.parametrize(
    "ending",
    [
        "anymal_b_simple_description/meshes/hip/anymal_hip_l.dae",
        "icub_description/meshes/upmc/visual/icub_l_thigh.dae",
        "panda_description/meshes/visual/link0.dae",
        "hyq_description/meshes/leg/hipassembly.dae",
        "ur_description/meshes/ur5/visual/forearm.dae",
    ],
)
def test_collada_lies_where_coal_has_it(ending):
    path = example_file(ending)
    points = np.concatenate([part.vertices for part in read_collada(path)])
    expected = np.asarray(coal.MeshLoader().load(str(path), np.ones(3)).vertices())
    span = np.ptp(expected, axis=0).max()
    np.testing.assert_allclose(points.min(0), expected.min(0), atol=1e-6 * span)
    np.testing.assert_allclose(points.max(0), expected.max(0), atol=1e-6 * span)


def test_broken_meshes_are_refused(tmp_path):
    refuses(ValueError, "broken XML", read_mesh, written(tmp_path / "a.dae", "<COLLADA"))
    refuses(ValueError, "no triangles", read_mesh, written(tmp_path / "b.dae", "<COLLADA/>"))
    with pytest.raises(ValueError, match="broken COLLADA"):
        read_mesh(written(tmp_path / "c.dae", COLLADA.replace('source="#p"', 'source="#gone"')))
    refuses(ValueError, r"one of \.dae", read_mesh, written(tmp_path / "d.ply", "ply"))


def test_stl_and_obj_hold_the_same_box(tmp_path):
    obj = read_mesh(written(tmp_path / "box.obj", CUBE_OBJ))[0]
    triangles = obj.vertices[obj.faces]
    text = "solid box\n" + "".join(
        "facet normal 0 0 0\nouter loop\n" + "".join(f"vertex {x} {y} {z}\n" for x, y, z in t) + "endloop\nendfacet\n"
        for t in triangles
    )
    binary = b"solid binary".ljust(80) + struct.pack("<I", len(triangles))
    binary += b"".join(struct.pack("<12fH", 0, 0, 0, *t.ravel(), 0) for t in triangles)
    (tmp_path / "binary.stl").write_bytes(binary)
    for part in (obj, *read_mesh(written(tmp_path / "text.stl", text)), *read_mesh(tmp_path / "binary.stl")):
        np.testing.assert_allclose(part.vertices.min(0), [0.0, 0.0, 0.0], atol=1e-7)
        np.testing.assert_allclose(part.vertices.max(0), [1.0, 1.0, 2.0], atol=1e-7)
        mesh = Trimesh(part.vertices, part.faces, process=False)
        assert (mesh.area, mesh.volume) == pytest.approx((10.0, 2.0), rel=1e-6)


def test_look_places_shapes_where_mujoco_has_their_links(tmp_path):
    written(tmp_path / "meshes" / "box.obj", CUBE_OBJ)
    path = written(tmp_path / "arm.urdf", ARM.format(mesh="package://any_name/meshes/box.obj"))
    robot = osik.Robot.from_urdf(path, floating_base=False)
    look = look_of(robot)
    assert look.missing == () and [shape.link for shape in look.shapes] == ["base", "upper"]
    shape, data = robot_parts(robot), next(mujoco_poses(robot, [0.5]))
    assert shape.style == "look"
    placed = zip(shape.parts, *shape.poses(data), strict=True)
    points = np.concatenate([part_triangles(part).vertices @ R.T + p for part, p, R in placed])
    low, high = points.min(0), points.max(0)
    turn = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    corners = np.array([(x, z) for x in (-0.1, 0.1) for z in (-0.05, 0.25)]) @ turn.T + [0.0, 0.2]
    np.testing.assert_allclose(high[[0, 2]], np.maximum(corners.max(0), [0.1, 0.2]), atol=1e-6)
    np.testing.assert_allclose(low[[0, 2]], np.minimum(corners.min(0), [0.0, 0.0]), atol=1e-6)
    np.testing.assert_allclose(lowest_points(shape, data), [0.0, corners[:, 1].min()], atol=1e-6)
    assert osik.load_robot("nao").holder.look is None


def test_collision_shapes_stand_in_for_meshes_that_are_gone(tmp_path):
    path = written(tmp_path / "arm.urdf", ARM.format(mesh="package://gone/box.stl"))
    look = look_of(osik.Robot.from_urdf(path, floating_base=False))
    assert look.missing == ("package://gone/box.stl",)
    assert [shape.kind for shape in look.shapes] == [mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_BOX]


def from_joints(robot, look):
    """How far joints are from boxes about the meshes of the links that they hang from [m]."""
    model, points = robot.mj_model, {}
    for shape in look.shapes:
        points.setdefault(shape.link, []).append(shape.mesh[0])
    boxes = {link: np.concatenate(groups) for link, groups in points.items()}
    parents = [model.body(model.body_parentid[body]).name for body in range(model.nbody)]
    places = [(model.body_pos[k], boxes[parents[k]]) for k in range(2, model.nbody) if parents[k] in boxes]
    return np.array([np.linalg.norm(place - np.clip(place, box.min(0), box.max(0))) for place, box in places])


def test_the_icubs_meshes_are_turned():
    """All of them say that y is up, and mean it: left as they are, its joints are 6 cm away from them."""
    path = example_file("robots/icub.urdf")
    robot = osik.Robot.from_urdf(path, floating_base=True)
    away = from_joints(robot, look_of(robot))
    assert len(away) > 30 and away.mean() < 0.02


@pytest.mark.parametrize("elbow", ["0 0 1", "0 -1 0"])
def test_y_up_is_followed_where_that_brings_meshes_to_joints(tmp_path, elbow):
    """A blade 1 m along its z axis, which the file calls not up: the next joint is at its end, as it is or turned."""
    blade = COLLADA.replace("Z_UP", "Y_UP").replace("0 0 0 1 0 0 1 1 0 0 1 0", "0 0 0 1 0 0 1 0 100 0 0 100")
    blade = blade.replace("100 0 0</translate>", "0 0 0</translate>").replace("0 0 1 50 0 0 0 1", "0 0 1 0 0 0 0 1")
    written(tmp_path / "meshes" / "blade.dae", blade)
    text = ARM.format(mesh="meshes/blade.dae").replace("0.1 0.1 0.1", "1 1 1").replace("0 0 0.2", elbow)
    look = look_of(osik.Robot.from_urdf(written(tmp_path / "arm.urdf", text), floating_base=False))
    (mesh,) = (shape.mesh[0] for shape in look.shapes if shape.mesh is not None)
    end = np.array([float(x) for x in elbow.split()])
    assert (mesh @ end).max() == pytest.approx(1.0) and (mesh @ end).min() == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("lens", [2.0, 3.6, 10.0])
def test_camera_holds_everything_and_no_more(lens):
    rng = np.random.default_rng(1)
    points = rng.uniform(-1.0, 1.0, (200, 3)) * [2.0, 0.3, 1.0]
    size, window = (300, 200), (0.1, 0.6, 0.2, 0.9)
    camera = frame_camera(points, size, 25.0, 10.0, window, lens)
    place = camera.project(points, size) / size
    low, high = place.min(0), place.max(0)
    assert (low >= [0.1 - 1e-9, 0.2 - 1e-9]).all() and (high <= [0.6 + 1e-9, 0.9 + 1e-9]).all()
    assert np.min(np.abs([*(high - low - [0.5, 0.7])])) < 1e-9


def test_no_instant_is_cut_and_no_head_is_under_the_title(tmp_path):
    """A long red arm that reaches towards the camera: nothing red is at the border, nor where the title is."""
    path = written(tmp_path / "arm.urdf", ARM.format(mesh="none.stl").replace("0.1 0.2 0.3", "1.6 0.2 0.3"))
    robot = osik.Robot.from_urdf(path, floating_base=False)
    q = np.linspace(-0.4, 0.4, 9)[:, None]
    picture = viewer.hero_picture(tmp_path / "h.png", robot, list(q[::4]), size=(320, 144))
    film = viewer.animate(tmp_path / "f.gif", robot, q, dt=0.1, size=(240, 136), caption="a title")
    pictures = [np.asarray(Image.open(picture).convert("RGB"), float)]
    with Image.open(film) as frames:
        for k in range(getattr(frames, "n_frames", 1)):
            frames.seek(k)
            pictures.append(np.asarray(frames.convert("RGB"), float))
    assert len(pictures) == 10
    for top, image in zip([4] + [12] * 9, pictures, strict=True):
        red = image[..., 0] - image[..., 1] > 60.0
        assert red.sum() > 300 and not red[:top].any() and not red[-3:].any() and not red[:, [0, 1, -2, -1]].any()
