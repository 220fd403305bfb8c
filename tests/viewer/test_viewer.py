"""The viewer against MuJoCo: where faces, cameras, rays and pictures put a robot."""

import os

import jax
import mujoco
import numpy as np
import pytest
from frames_beside_mujoco import random_configurations
from model_files import mjcf
from mujoco_states import mujoco_at
from PIL import Image
from refusals import refuses
from trimesh import Trimesh

import osik_jax as osik
from osik_jax import viewer
from osik_jax.robot import _mujoco
from osik_jax.viewer import _animate
from osik_jax.viewer._parts import robot_parts
from osik_jax.viewer._raycast import RayCaster
from osik_jax.viewer._stage import Camera, Stage
from osik_jax.viewer.live._surfaces import part_triangles

BALL = """<mujoco><worldbody><body name="ball" pos="0 0 0.5"><joint name="j" axis="0 0 1"/>
<geom type="sphere" size="0.2" rgba="1 0 0 1"/></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def shapes():
    return osik.Robot.from_mjcf(mjcf("one_geom_of_each_kind"))


def surface_distance(kind, size, p):
    """How far points (k, 3) in a geom's frame are from its surface, negative inside; ellipsoids up to scale."""
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.linalg.norm(p, axis=-1) - size[0]
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return np.linalg.norm(p / size, axis=-1) - 1.0
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        axis = np.clip(p[:, 2], -size[1], size[1])
        return np.linalg.norm(p - np.outer(axis, [0, 0, 1]), axis=-1) - size[0]
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return np.maximum(np.linalg.norm(p[:, :2], axis=-1) - size[0], np.abs(p[:, 2]) - size[1])
    return np.max(np.abs(p) - size, axis=-1)


def test_faces_lie_on_mujocos_geoms(shapes):
    q = random_configurations(shapes, count=1)[0]
    data = mujoco_at(shapes, q)
    model = shapes.mj_model
    for geom in range(model.ngeom):
        points = robot_surface_of(shapes, data, geom).triangles.reshape(-1, 3)
        local = (points - data.geom_xpos[geom]) @ data.geom_xmat[geom].reshape(3, 3)
        distance = surface_distance(model.geom_type[geom], model.geom_size[geom], local)
        assert len(distance)
        np.testing.assert_allclose(distance, 0.0, atol=1e-12)


def robot_surface_of(robot, data, geom):
    shape = robot_parts(robot)
    position, rotation = (each[geom] for each in shape.poses(data))
    vertices, faces = part_triangles(shape.parts[geom])
    return Trimesh(vertices @ rotation.T + position, faces, process=False)


@pytest.mark.parametrize(
    ("geom", "volume"),
    [
        (0, 4 / 3 * np.pi * 0.1**3),
        (1, np.pi * 0.05**2 * 0.4 + 4 / 3 * np.pi * 0.05**3),
        (2, np.pi * 0.07**2 * 0.2),
        (3, 0.1 * 0.2 * 0.4),
        (4, 4 / 3 * np.pi * 0.05 * 0.1 * 0.2),
    ],
)
def test_faces_close_and_point_outward(shapes, geom, volume):
    data = mujoco_at(shapes, shapes.q0)
    # positive where faces run counter-clockwise seen from outside
    assert robot_surface_of(shapes, data, geom).volume == pytest.approx(volume, rel=0.03)


def test_nao_com_and_frames_are_mujocos(nao):
    configurations = random_configurations(nao, count=3)
    forward = jax.jit(lambda q: osik.forward_kinematics(nao, q))
    for q, data in zip(configurations, _mujoco.mujoco_poses(nao, configurations), strict=True):
        reference = mujoco_at(nao, q)
        np.testing.assert_allclose(_mujoco.robot_com(nao, data), reference.subtree_com[1], atol=1e-12)
        kinematics = forward(q)
        for name in ("torso", "l_sole", "r_sole_corner_2", "l_gripper"):
            p, R = _mujoco.mujoco_frame_pose(nao, data, name)
            p_ours, R_ours = kinematics.frame_pose(nao, name)
            np.testing.assert_allclose(p, p_ours, atol=1e-12)
            np.testing.assert_allclose(R, R_ours, atol=1e-12)


def test_frame_of_a_fused_link_follows_its_body():
    urdf = """<robot name="r"><link name="base"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1"
    iyz="0" izz="1"/></inertial></link><link name="arm"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0"
    iyy="1" iyz="0" izz="1"/></inertial></link><link name="tool"/>
    <joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
    <joint name="f" type="fixed"><parent link="arm"/><child link="tool"/><origin xyz="0.5 0 0"/></joint></robot>"""
    robot = osik.Robot.from_urdf(urdf, floating_base=False)
    data = next(_mujoco.mujoco_poses(robot, robot.configuration({"j": 0.5})))
    p, _ = _mujoco.mujoco_frame_pose(robot, data, "tool")
    np.testing.assert_allclose(p, [0.5 * np.cos(0.5), 0.5 * np.sin(0.5), 0.0], atol=1e-12)
    refuses(KeyError, "tool", _mujoco.mujoco_frame_pose, robot, data, "tol")


def test_sticks_where_there_is_no_geom():
    robot = osik.Robot.from_mjcf(mjcf("links_without_geoms"))
    shape = robot_parts(robot)
    assert shape.style == "sticks"
    data = mujoco_at(robot, robot.configuration({"j1": 0.3, "j2": -0.7}))
    positions, rotations = shape.poses(data)
    dots = [k for k, part in enumerate(shape.parts) if part.kind == mujoco.mjtGeom.mjGEOM_SPHERE]
    links = [k for k in range(len(shape.parts)) if k not in dots]
    np.testing.assert_allclose(positions[dots], data.xpos[1:], atol=1e-12)
    ends = np.array([data.xpos[2], data.xpos[3], data.site_xpos[0]])
    half = np.array([shape.parts[k].size[1] for k in links])[:, None]
    np.testing.assert_allclose(positions[links] + half * rotations[links][:, :, 2], ends, atol=1e-12)
    np.testing.assert_allclose(positions[links] - half * rotations[links][:, :, 2], data.xpos[1:], atol=1e-12)


def test_camera_is_mujocos_camera():
    nao = osik.load_robot("nao")  # whose model is changed here
    camera = Camera((0.1, -0.2, 0.3), 2.0, 35.0, 20.0, 0.8)
    scene = mujoco.MjvScene(nao.mj_model, maxgeom=10)
    nao.mj_model.vis.global_.fovy = 2.0 * np.rad2deg(np.arctan2(0.5 * camera.height, camera.distance))
    same = mujoco.MjvCamera()
    same.type, same.lookat[:] = mujoco.mjtCamera.mjCAMERA_FREE, camera.center
    same.distance, same.azimuth, same.elevation = camera.distance, camera.azimuth + 180.0, -camera.elevation
    options = mujoco.MjvOption()
    still, data = mujoco.mjtCatBit.mjCAT_STATIC, mujoco_at(nao, nao.q0)
    mujoco.mjv_updateScene(nao.mj_model, data, options, mujoco.MjvPerturb(), same, still, scene)
    eyes = [(np.asarray(c.pos), np.asarray(c.forward), np.asarray(c.up)) for c in scene.camera]
    position, forward, up = (np.mean(part, 0) for part in zip(*eyes, strict=True))
    np.testing.assert_allclose(position, camera.eye, atol=1e-6)
    np.testing.assert_allclose(forward, camera.axes[2], atol=1e-6)
    np.testing.assert_allclose(up, camera.axes[1], atol=1e-6)
    top, near = scene.camera[0].frustum_top, scene.camera[0].frustum_near
    assert top / near == pytest.approx(0.5 * camera.height / camera.distance, rel=1e-5)


def test_rays_and_projection_undo_each_other():
    camera, size = Camera((0.1, -0.2, 0.3), 2.0, 35.0, 20.0, 0.8), (320, 240)
    pixels = np.random.default_rng(0).uniform(0, 240, (50, 2))
    depth = np.random.default_rng(1).uniform(0.5, 5.0, (50, 1))
    np.testing.assert_allclose(camera.project(camera.eye + depth * camera.rays(pixels, size), size), pixels, atol=1e-9)


def picture_of_a_ball(pixels, *floor):
    robot = osik.Robot.from_mjcf(BALL)
    camera = Camera((0.0, 0.0, 0.5), 20.0, 10.0, 0.0, 1.0)
    stage = Stage([robot_parts(robot)])
    return RayCaster(stage, camera, (pixels, pixels), floor=0.0).image(stage.pose([mujoco_at(robot, robot.q0)]), *floor)


def test_ray_caster_covers_what_a_ball_covers():
    picture = picture_of_a_ball(200)
    red = np.clip(picture[..., 0] - picture[..., 1], 0.0, None)
    rows, columns = np.nonzero(red > 0.05)
    assert (rows.mean(), columns.mean()) == pytest.approx((99.5, 99.5), abs=0.5)
    assert np.ptp(columns) + 1 == pytest.approx(80, abs=2)  # 0.4 m of 1 m in 200 pixels
    assert len(rows) == pytest.approx(np.pi * 40**2, rel=0.02)


def test_what_lies_on_the_floor_is_behind_the_robot():
    picture = picture_of_a_ball(100, np.tile(np.array([0.0, 0.0, 1.0, 1.0]), (100, 100, 1)))
    np.testing.assert_allclose(picture[5, 5], [0.0, 0.0, 1.0], atol=1e-6)
    assert picture[50, 50, 0] > 0.5 > picture[50, 50, 2]


def test_gif_has_its_frames(tmp_path, nao):
    q = np.tile(np.asarray(nao.q0), (41, 1))
    q[:, 1] += 0.05 * np.sin(np.linspace(0.0, 3.0, 41))
    support = np.asarray(osik.support_polygon(nao, nao.q0, ("l_sole", "r_sole")).vertices)
    path = viewer.animate(
        tmp_path / "m.gif",
        nao,
        q,
        dt=0.02,
        frames_per_second=12.5,
        size=(240, 136),
        support=support,
        trails=("l_gripper",),
        curves={"waist": 1e3 * q[:, 1]},
        wanted={"waist": 1e3 * q[:, 1]},
        curves_title="y [mm]",
        caption="sways",
    )
    with Image.open(path) as film:
        assert film.size == (240, 136)
        assert getattr(film, "n_frames", 1) == 11  # steps 0, 4, ..., 40
        assert film.info["duration"] == 80
        film.seek(5)
        assert len(np.unique(np.asarray(film.convert("RGB")).reshape(-1, 3), axis=0)) > 30


def test_films_of_another_kind_or_of_nothing_are_refused(tmp_path, nao, monkeypatch):
    q = np.asarray(nao.q0)[None]
    refuses(ValueError, r"\.gif or \.mp4", viewer.animate, tmp_path / "m.avi", nao, q, dt=0.01)
    for wrong in (q[:0], q[0], q[:, 1:]):
        refuses(ValueError, r"q has shape .*\(T, 32\)", viewer.animate, tmp_path / "m.gif", nao, wrong, dt=0.01)
    monkeypatch.setattr(_animate.shutil, "which", lambda name: None)
    refuses(ValueError, "ffmpeg", viewer.animate, tmp_path / "m.mp4", nao, q, dt=0.01)


def test_what_ffmpeg_says_is_told(tmp_path, nao, monkeypatch):
    """A program of that name that reads nothing and complains, as ffmpeg does on a full disk."""
    program = tmp_path / "ffmpeg"
    program.write_text("#!/bin/sh\necho no space left >&2\nexit 3\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    with pytest.raises(OSError, match=r"ffmpeg could not write .*m\.mp4: no space left"):
        viewer.animate(tmp_path / "m.mp4", nao, np.asarray(nao.q0)[None], dt=0.1, size=(64, 36))


def test_hero_picture_shows_shapes_and_trails_where_they_are(tmp_path):
    """A ball and a line beside the arm, both in colours of their own, and all robots in one place."""
    arm, ball = osik.load_robot("arm7"), osik.CollisionShape.sphere(0.1, [0.0, 0.8, 0.5])
    trail = np.array([[0.0, -0.8, 0.2], [0.0, -0.8, 0.8]])
    path = viewer.hero_picture(
        tmp_path / "h.png", arm, [arm.q0] * 2, shapes=[ball], trails=[trail], spacing=0.0, size=(300, 135)
    )
    with Image.open(path) as image:
        red, green, blue = np.moveaxis(np.asarray(image.convert("RGB"), int), -1, 0)
    is_ball, is_trail = (red > blue + 90) & (red > green + 40), (blue > red + 90)
    is_ball[:, :200] = False  # the arm's own colours
    left, right = np.flatnonzero(is_trail.any(0)), np.flatnonzero(is_ball.any(0))
    assert 0 < len(left) < 10
    assert left.max() < 100 < right.min()
    assert 0.7 < np.ptp(np.flatnonzero(is_ball.any(1))) / np.ptp(right) < 1.4  # round


@pytest.mark.parametrize("shape", ["plane", "palm"])
def test_hero_picture_refuses_what_it_cannot_draw(tmp_path, shape):
    arm = osik.load_robot("arm7")
    bad = {
        "plane": osik.CollisionShape.half_space([0.0, 0.0, 0.0], [0.0, 0.0, 1.0]),
        "palm": osik.CollisionShape.sphere(0.1, frame="hand"),
    }[shape]
    with pytest.raises(ValueError, match="is not drawn; shapes are spheres, capsules, boxes and cylinders"):
        viewer.hero_picture(tmp_path / "h.png", arm, [arm.q0], shapes=[bad], size=(300, 135))


def test_hero_picture_shows_every_instant(tmp_path, nao):
    path = viewer.hero_picture(tmp_path / "h.png", nao, [nao.q0] * 3, labels=("a", "b", "c"), size=(300, 135))
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    orange = (pixels[..., 0] - pixels[..., 2]) > 90
    counts = [orange[:, 100 * k : 100 * (k + 1)].sum() for k in range(3)]
    assert min(counts) > 0.6 * max(counts) > 20
