"""Balls that cover the collision shapes of robots: every point of the true surface is inside, and the bound holds."""

import numpy as np
import pytest
from example_files import example_file
from refusals import refuses
from robot_support import directions, mesh_vertices, pinocchio_geometry, table_support

import osik_jax as osik
from osik_jax.collision import covering_spheres, robot_shapes
from osik_jax.collision._spheres import LEAST, MOST, covering_balls
from osik_jax.collision._table import ConvexShape, CoveringSpheres, ShapeKind, shape_table
from osik_jax.robot._size import robot_size
from osik_jax.robot.loading._named import EXAMPLES

NO_POINTS = np.zeros((0, 3))


@pytest.fixture(autouse=True)
def empty_cache(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def on_triangles(vertices: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Random points of a surface of triangles, evenly by area. (count, 3)"""
    random, corners = np.random.default_rng(0), vertices[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    which = random.choice(len(faces), count, p=areas / areas.sum())
    return np.einsum("nk,nkj->nj", random.dirichlet(np.ones(3), count), corners[which])


def uncovered(points: np.ndarray, centers: np.ndarray, radii: np.ndarray) -> float:
    """Farthest that a point is outside of all balls [m]; negative if all are inside."""
    return max(
        (np.linalg.norm(part[:, None] - centers, axis=2) - radii).min(1).max() for part in np.array_split(points, 20)
    )


def balls_of(spheres: CoveringSpheres, row: int) -> tuple[np.ndarray, np.ndarray]:
    own = spheres.shape == row
    return spheres.center[own], spheres.radius[own]


@pytest.mark.filterwarnings("ignore:these pairs touch")
@pytest.mark.parametrize(
    "name", ["panda", "ur5", pytest.param("baxter", marks=pytest.mark.slow), pytest.param("g1", marks=pytest.mark.slow)]
)
def test_no_point_of_a_true_mesh_is_outside(name: str):
    """20,000 points on each mesh as Pinocchio reads it, and the corners of the hulls; meshes need not be convex."""
    robot = osik.load_robot(name)
    shapes, spheres = robot_shapes(robot), covering_spheres(robot)
    model, geometry = pinocchio_geometry(example_file(EXAMPLES[name][0]))
    for thing in geometry.geometryObjects:
        if hasattr(thing.geometry, "num_vertices"):
            frame = model.frames[thing.parentFrame]
            at = robot.frame_names.index(frame.name)
            turn, place = (np.asarray(part[at], float) for part in (robot.frame_rotation, robot.frame_position))
            own = frame.placement.inverse() * thing.placement
            corners = (mesh_vertices(thing.geometry) @ own.rotation.T + own.translation) @ turn.T + place
            triangles = (thing.geometry.tri_indices(k) for k in range(thing.geometry.num_tris))
            faces = np.array([[triangle[k] for k in range(3)] for triangle in triangles])
            points = np.concatenate([corners, on_triangles(corners, faces, 20_000)])
            rows = [k for k, link in enumerate(shapes.links) if link == frame.name and shapes.table.count[k]]
            assert min(uncovered(points, *balls_of(spheres, row)) for row in rows) < 1e-6
    assert set(spheres.shape) == set(range(len(shapes.names)))
    assert np.bincount(spheres.shape).max() <= MOST


def inside(shape: ConvexShape, count: int) -> np.ndarray:
    """Random points of a shape. (count, 3)"""
    random = np.random.default_rng(0)
    a, b, c = shape.size
    if shape.kind == ShapeKind.BOX:
        points = random.uniform(-1, 1, (count, 3)) * [a, b, c]
        points[: count // 2, 0] = np.sign(points[: count // 2, 0]) * a
    elif shape.kind == ShapeKind.HULL:
        points = random.dirichlet(0.2 * np.ones(len(shape.vertices)), count) @ shape.vertices + a * directions(count)
    else:
        ring = random.uniform(0, 2 * np.pi, count)
        points = np.stack([a * np.cos(ring), a * np.sin(ring), random.uniform(-b, b, count)], 1)
        if shape.kind == ShapeKind.CAPSULE:
            points[: count // 2] = [0, 0, b] + a * directions(count // 2) * [1, 1, np.sign(1)]
        points[: count // 4] *= random.uniform(0, 1, (count // 4, 1))
    return points @ shape.rotation.T + shape.position


TURN = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
SHAPES = {
    "ball": (ShapeKind.SPHERE, (0.3, 0, 0), NO_POINTS),
    "capsule": (ShapeKind.CAPSULE, (0.1, 0.4, 0), NO_POINTS),
    "short capsule": (ShapeKind.CAPSULE, (0.4, 0.01, 0), NO_POINTS),
    "cylinder": (ShapeKind.CYLINDER, (0.1, 0.4, 0), NO_POINTS),
    "disc": (ShapeKind.CYLINDER, (0.5, 0.01, 0), NO_POINTS),
    "box": (ShapeKind.BOX, (0.1, 0.2, 0.3), NO_POINTS),
    "plate": (ShapeKind.BOX, (0.5, 0.5, 0.005), NO_POINTS),
    "rounded hull": (ShapeKind.HULL, (0.02, 0, 0), 0.2 * directions(40)),
    "large hull": (ShapeKind.HULL, (0.0, 0, 0), directions(1000) * [0.1, 0.2, 0.4]),
    "needle": (ShapeKind.HULL, (0.0, 0, 0), np.array([[0, 0, 1], [0.01, 0, -1], [0, 0.01, -1], [-0.01, -0.01, -1]])),
}


@pytest.mark.parametrize("name", list(SHAPES))
def test_a_shape_is_inside_its_balls_and_they_stick_out_no_farther_than_told(name: str):
    kind, size, vertices = SHAPES[name]
    shape = ConvexShape(kind, np.array(size, float), np.array([1.0, 2.0, 3.0]), TURN, np.asarray(vertices, float))
    balls = covering_balls(shape, 1e-3 / LEAST)
    points = inside(shape, 20_000)
    assert uncovered(points, balls.center, balls.radius) < 1e-9
    ways = directions(4000)
    table = shape_table([shape])
    # the farthest point of a ball from a convex shape: the greatest difference of their support functions
    beyond = (balls.center @ ways.T + balls.radius[:, None] - table_support(table, 0, ways)).max(1)
    assert (beyond <= balls.overshoot + 1e-9).all()
    assert (
        balls.overshoot - beyond < 0.05 * np.abs(shape.vertices).max(initial=max(size)) + 1e-3
    ).all()  # a tight bound
    assert len(balls.radius) <= MOST and (len(balls.radius) == 1) == (name == "ball")
    if name == "box":
        assert (
            covering_balls(shape, 0.1 / LEAST).overshoot.max() <= 0.1
            and len(covering_balls(shape, 0.1 / LEAST).radius) <= 8
        )


def test_balls_are_kept_in_the_cache_folder(tmp_path, monkeypatch: pytest.MonkeyPatch):
    robot = osik.load_robot("ur5")
    first = covering_spheres(robot)
    (path,) = (tmp_path / "osik_jax").glob("spheres_*.npz")
    again = covering_spheres(osik.load_robot("ur5"))
    assert again is not first and np.array_equal(again.radius, first.radius)
    path.write_bytes(b"damaged")
    assert np.array_equal(covering_spheres(osik.load_robot("ur5")).center, first.center)
    assert path.stat().st_size > 100
    with np.load(path) as file:
        changed = {**file, "radius": 2.0 * file["radius"]}
    np.savez(path, **changed)
    read = covering_spheres(osik.load_robot("ur5"))
    assert np.array_equal(read.radius, 2.0 * first.radius)  # what is in the file is taken
    longer = covering_spheres(osik.load_robot("ur5").scaled(length=1.5))
    np.testing.assert_allclose(longer.radius.max(), 1.5 * first.radius.max(), rtol=1e-5)
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null")
    assert np.array_equal(covering_spheres(osik.load_robot("ur5")).center, first.center)
    assert first.overshoot.min() >= 0.0 and robot_size(robot) * LEAST > 0.005


def given_for(robot: osik.Robot):
    """The spheres that this package makes, in the axes of the links."""
    shapes, spheres = robot_shapes(robot), covering_spheres(robot)
    found: dict[str, list] = {}
    for row, center, radius in zip(spheres.shape, spheres.center, spheres.radius, strict=True):
        at = robot.frame_names.index(shapes.links[row])
        turn, place = np.asarray(robot.frame_rotation[at], float), np.asarray(robot.frame_position[at], float)
        found.setdefault(shapes.links[row], []).append(
            {"center": ((center - place) @ turn).tolist(), "radius": float(radius)}
        )
    return shapes.table, spheres, found


def as_collision(ball: dict) -> str:
    place, radius = " ".join(map(str, ball["center"])), ball["radius"]
    return f'<collision><origin xyz="{place}"/><geometry><sphere radius="{radius}"/></geometry></collision>'


@pytest.mark.slow
def test_given_spheres_cover_after_they_are_grown(tmp_path):
    """Those of cuRobo's files, of spherized URDFs and of dictionaries."""
    ur5 = osik.load_robot("ur5")
    table, own, given = given_for(ur5)
    smaller = {link: [{**one, "radius": 0.8 * one["radius"]} for one in some] for link, some in given.items()}
    del smaller["wrist_1_link"]
    with pytest.warns(osik.OsikWarning) as told:
        found = covering_spheres(ur5, smaller)
    texts = [str(one.message) for one in told]
    assert any("are grown until they are sure to cover their shapes: upper_arm_link by" in text for text in texts)
    assert any("shapes without a given sphere get spheres of their own: wrist_1_link" in text for text in texts)
    for row in range(len(found.names)):
        count, first = table.count[row], table.first[row]
        if count:
            hull = table.vertices[first : first + count]
            points = np.concatenate([hull, np.random.default_rng(0).dirichlet(0.1 * np.ones(count), 5000) @ hull])
            points = points @ table.rotation[row].T + table.position[row]
            assert uncovered(points, *balls_of(found, row)) < 1e-9
    ways = directions(2000)
    for k, row in enumerate(found.shape):
        beyond = (ways @ found.center[k] + found.radius[k] - table_support(table, row, ways)).max()
        assert beyond <= found.overshoot[k] + 1e-9
    text = "".join(f'<link name="{link}">{"".join(map(as_collision, some))}</link>' for link, some in given.items())
    joints = "".join(
        f'<joint name="{link}" type="fixed"><parent link="base_link"/><child link="{link}"/></joint>'
        for link in given
        if link != "base_link"
    )
    (tmp_path / "balls.urdf").write_text(f'<robot name="r">{text}{joints}</robot>')
    yaml = {"robot_cfg": {"kinematics": {"collision_spheres": "spheres.yml"}}}
    (tmp_path / "robot.yml").write_text(str(yaml))
    (tmp_path / "spheres.yml").write_text(str({"collision_spheres": given}))
    for name in ("balls.urdf", "robot.yml"):
        read = covering_spheres(ur5, tmp_path / name)
        assert len(read.radius) == len(own.radius)


def test_spheres_that_are_none_are_refused(tmp_path):
    panda = osik.load_robot("panda")
    refuses(TypeError, r"spheres is float; it is a path, or \{link", covering_spheres, panda, 1.0)
    refuses(KeyError, "no link with a collision shape 'hand'", covering_spheres, panda, {"hand": []})
    wrong = {"panda_hand": [{"radius": 1.0}]}
    refuses(ValueError, "the spheres of 'panda_hand' are not", covering_spheres, panda, wrong)
    refuses(FileNotFoundError, "no spheres file .*lost.yml", covering_spheres, panda, tmp_path / "lost.yml")
    (tmp_path / "a.yml").write_text("joints: 3")
    refuses(ValueError, "it has no collision_spheres", covering_spheres, panda, tmp_path / "a.yml")
    urdf = example_file("panda_description/urdf/panda.urdf")
    refuses(ValueError, "none of the collision shapes is a sphere", covering_spheres, panda, urdf)
