"""Distances of convex shapes by the core beside coal's, and depths beside support functions."""

import coal
import numpy as np
import pytest
from robot_support import directions, table_support
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from osik_jax.collision._core import gaps_between
from osik_jax.collision._table import NO_VERTICES, ConvexShape, ShapeKind, shape_table
from osik_jax.core import _library

pytestmark = pytest.mark.skipif(not _library.installed(), reason="no compiled core")
ROUND = [ShapeKind.SPHERE, ShapeKind.CAPSULE, ShapeKind.CYLINDER]


def shape(kind: ShapeKind, size, position=(0, 0, 0), rotation=None, vertices=NO_VERTICES) -> ConvexShape:
    turn = np.eye(3) if rotation is None else rotation
    return ConvexShape(kind, np.asarray(size, float), np.asarray(position, float), turn, np.asarray(vertices, float))


def random_shape(rng: np.random.Generator) -> ConvexShape:
    """A shape of any kind but a half space, of 2 mm to 0.5 m, near the origin; one in three is not turned."""
    kind = rng.choice([*ROUND, ShapeKind.BOX, ShapeKind.HULL])
    size = rng.uniform(0.2, 1.0, 3) * rng.choice([1e-2, 0.1, 0.5])
    position = rng.normal(size=3) * rng.choice([0.0, 0.05, 0.3, 1.0])
    rotation = Rotation.random(random_state=rng).as_matrix() if rng.uniform() < 0.7 else np.eye(3)
    if kind is ShapeKind.HULL or kind == ShapeKind.HULL:
        points = rng.normal(size=(rng.integers(5, 60), 3)) * size
        return shape(ShapeKind.HULL, np.zeros(3), position, rotation, points[ConvexHull(points).vertices])
    kept = {ShapeKind.SPHERE: 1, ShapeKind.BOX: 3}.get(kind, 2)
    return shape(ShapeKind(kind), size * (np.arange(3) < kept), position, rotation)


def of_coal(own: ConvexShape) -> tuple[coal.CollisionGeometry, coal.Transform3s]:
    a, b, _ = own.size
    at = coal.Transform3s(own.rotation, own.position)
    if own.kind is ShapeKind.HULL:
        hull = ConvexHull(own.vertices)
        points, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
        points.extend(own.vertices)
        triangles.extend([coal.Triangle(*map(int, corners)) for corners in hull.simplices])
        return coal.Convex(points, triangles), at
    make = {
        ShapeKind.SPHERE: lambda: coal.Sphere(a),
        ShapeKind.CAPSULE: lambda: coal.Capsule(a, 2 * b),
        ShapeKind.CYLINDER: lambda: coal.Cylinder(a, 2 * b),
        ShapeKind.BOX: lambda: coal.Box(*(2 * own.size)),
    }
    return make[own.kind](), at


def coal_distances(pairs: list[tuple[ConvexShape, ConvexShape]]) -> np.ndarray:
    request, out = coal.DistanceRequest(), []
    request.enable_signed_distance = True
    request.gjk_tolerance, request.gjk_max_iterations = 1e-10, 500
    for a, b in pairs:
        out.append(coal.distance(*of_coal(a), *of_coal(b), request, coal.DistanceResult()))
    return np.array(out)


def gaps_of(pairs: list[tuple[ConvexShape, ConvexShape]]) -> tuple[np.ndarray, ...]:
    first, second = zip(*pairs, strict=True)
    gaps = gaps_between(shape_table(first), shape_table(second))
    return np.asarray(gaps.distance), np.asarray(gaps.points), np.asarray(gaps.normal)


@pytest.mark.parametrize("count", [1500, pytest.param(10_000, marks=pytest.mark.release)])
def test_random_pairs_have_coals_distances(count: int):
    rng = np.random.default_rng(count)
    pairs = [(random_shape(rng), random_shape(rng)) for _ in range(count)]
    (distance, points, normal), theirs = gaps_of(pairs), coal_distances(pairs)
    apart = theirs > 1e-6
    assert 0.2 < apart.mean() < 0.9
    assert abs(distance - theirs)[apart].max() < 2e-9
    assert ((distance > 0) == (theirs > 0))[abs(theirs) > 1e-7].all()
    assert abs(np.einsum("ni,ni->n", normal, points[:, 1] - points[:, 0]) - distance).max() < 1e-12
    assert abs(np.linalg.norm(normal, axis=1) - 1.0).max() < 1e-12


def test_depths_separate_and_no_translation_is_shorter():
    rng, ways = np.random.default_rng(5), directions(4000)
    pairs = [(random_shape(rng), random_shape(rng)) for _ in range(600)]
    distance, _, normal = gaps_of(pairs)
    overlap = np.flatnonzero(distance < -1e-6)
    assert len(overlap) > 100
    moved = [(a, b._replace(position=b.position + normal[k] * (1e-7 - distance[k]))) for k, (a, b) in enumerate(pairs)]
    assert gaps_of([moved[k] for k in overlap])[0].min() >= 0.0
    # a support function of the difference of two shapes is an upper bound on the depth
    first, second = (shape_table([pair[at] for pair in pairs]) for at in (0, 1))
    for k in overlap:
        reach = table_support(first, int(k), ways) + table_support(second, int(k), -ways)
        assert -distance[k] < reach.min() + 1e-5


QUARTER = Rotation.from_euler("x", 90, degrees=True).as_matrix()
BOX = shape(ShapeKind.BOX, [0.1, 0.2, 0.3])
CAN = shape(ShapeKind.CYLINDER, [0.1, 0.3, 0])
TRIANGLE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])


def placed(own: ConvexShape, *position: float, rotation=None) -> ConvexShape:
    return own._replace(position=np.array(position), rotation=own.rotation if rotation is None else rotation)


@pytest.mark.parametrize(
    ("first", "second", "distance"),
    [
        pytest.param(BOX, placed(BOX, 0.2, 0, 0), 0.0, id="face on face"),
        pytest.param(BOX, placed(BOX, 0.2 + 1e-8, 0.05, 0.1), 1e-8, id="faces 10 nm apart"),
        pytest.param(BOX, BOX, -0.2, id="the same box twice"),
        pytest.param(BOX, placed(BOX, 0.2, 0.4, 0.6), 0.0, id="corner on corner"),
        pytest.param(CAN, placed(CAN, 0.2, 0, 0), 0.0, id="side on side"),
        pytest.param(CAN, placed(CAN, 0, 0, 0.601), 0.001, id="lid over lid"),
        pytest.param(CAN, placed(CAN, 0, 0.4 + 1e-5, 0, rotation=QUARTER), 1e-5, id="lid on side"),
        pytest.param(shape(ShapeKind.SPHERE, [0.3, 0, 0]), shape(ShapeKind.SPHERE, [0.1, 0, 0]), -0.4, id="concentric"),
        pytest.param(shape(ShapeKind.SPHERE, [1e-6, 0, 0]), placed(BOX, 1.0, 0, 0), 0.9 - 1e-6, id="tiny"),
        pytest.param(BOX, placed(BOX, 1e4, 0, 0), 1e4 - 0.2, id="far away"),
        pytest.param(
            shape(ShapeKind.HULL, [0, 0, 0], vertices=TRIANGLE), placed(BOX, 0.2, 0.2, 0.31), 0.01, id="flat hull"
        ),
        pytest.param(
            shape(ShapeKind.HULL, [0, 0, 0], vertices=TRIANGLE),
            shape(ShapeKind.HULL, [0, 0, 0], [0.1, 0.1, 0], vertices=TRIANGLE),
            0.0,
            id="flat hulls in one plane",
        ),
        pytest.param(
            shape(ShapeKind.HULL, [0.05, 0, 0], vertices=TRIANGLE), placed(BOX, 0.2, 0.2, 0.31), -0.04, id="round hull"
        ),
        pytest.param(
            shape(ShapeKind.CAPSULE, [0.1, 0.5, 0]), placed(shape(ShapeKind.CAPSULE, [0.1, 0.5, 0]), 0, 0, 1.5), 0.3,
            id="capsules in one line",
        ),
        pytest.param(
            shape(ShapeKind.HALF_SPACE, [0, 0, 0]), placed(CAN, 0, 0, 0.25, rotation=QUARTER), 0.15, id="half space"
        ),
        pytest.param(placed(BOX, 3, 4, -1), shape(ShapeKind.HALF_SPACE, [0, 0, 0]), -1.3, id="under a half space"),
    ],
)  # fmt: skip
def test_degenerate_pairs(first: ConvexShape, second: ConvexShape, distance: float):
    found, points, normal = gaps_of([(first, second), (second, first)])
    # a depth, as of shapes that just touch, is known to 1e-8 m
    assert abs(found - distance).max() < (1e-9 * max(1.0, distance) if distance > 0 else 1e-8)
    assert np.isfinite(points).all() and abs(np.linalg.norm(normal, axis=1) - 1.0).max() < 1e-12


def test_places_that_are_not_finite_have_no_distance():
    bad = [placed(BOX, np.nan, 0, 0), placed(BOX, np.inf, 0, 0), placed(CAN, 0, 0, 0, rotation=np.full((3, 3), np.nan))]
    found, *_ = gaps_of([(BOX, other) for other in bad] + [(BOX, placed(BOX, 1, 0, 0))])
    assert np.isnan(found[:3]).all() and found[-1] == pytest.approx(0.8)
