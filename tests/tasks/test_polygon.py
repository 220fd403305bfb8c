"""Support polygons against SciPy's Delaunay triangulation, brute force and MuJoCo's corner positions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mujoco_states import mujoco_at
from refusals import refuses
from scipy.spatial import ConvexHull, Delaunay

import osik_jax as osik

_kinematics = jax.jit(osik.forward_kinematics)
FEET = ("l_sole", "r_sole")


def _polygon(arm, points, margin=0.0):
    """The hull of points (k, 2), given as corners of a frame that sits still at the origin."""
    corners = np.concatenate([points, np.zeros((len(points), 1))], 1)
    return osik.support_polygon(arm, arm.q0, ("world",), margin=margin, corners={"world": corners})


def _distance_to_segments(vertices, xy):
    """Distance from xy to the nearest point of a closed polygonal line."""
    ends = np.roll(vertices, -1, 0)
    along = np.clip(np.sum((xy - vertices) * (ends - vertices), 1) / np.sum((ends - vertices) ** 2, 1), 0.0, 1.0)
    return np.linalg.norm(vertices + along[:, None] * (ends - vertices) - xy, axis=1).min()


points_strategy = st.integers(0, 2**32 - 1).map(
    lambda seed: np.random.default_rng(seed).uniform(-0.2, 0.2, (np.random.default_rng(seed).integers(3, 12), 2))
)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(points=points_strategy, seed=st.integers(0, 1000))
def test_hull_against_delaunay_and_brute_force(arm, points, seed):
    polygon = _polygon(arm, points)
    tests = np.random.default_rng(seed).uniform(-0.25, 0.25, (200, 2))
    inside = Delaunay(points).find_simplex(tests) >= 0
    distance = np.asarray(polygon.distance(tests))
    clear = np.abs(distance) > 1e-5
    np.testing.assert_array_equal(np.asarray(polygon.contains(tests))[clear], inside[clear])
    np.testing.assert_array_equal(np.asarray(polygon.contains(tests)), distance >= 0.0)
    expected = [_distance_to_segments(np.asarray(polygon.vertices), xy) for xy in tests[inside]]
    np.testing.assert_allclose(distance[inside], expected, atol=2e-6)
    np.testing.assert_allclose(np.linalg.norm(polygon.normals, axis=1), 1.0, atol=1e-14)
    assert abs(ConvexHull(np.asarray(polygon.vertices)).volume - ConvexHull(points).volume) < 1e-6


@pytest.mark.slow
@settings(max_examples=60, deadline=None, derandomize=True)
@given(points=points_strategy, seed=st.integers(0, 1000))
def test_a_margin_leaves_the_points_that_are_that_far_inside(arm, points, seed):
    whole = _polygon(arm, points)
    grid = np.stack(np.meshgrid(*[np.linspace(-0.2, 0.2, 81)] * 2), -1).reshape(-1, 2)
    margin = 0.6 * float(np.max(whole.distance(grid)))
    if margin < 1e-3:
        return
    drawn_in = _polygon(arm, points, margin)
    tests = np.random.default_rng(seed).uniform(-0.2, 0.2, (200, 2))
    reserve = np.asarray(whole.distance(tests)) - margin
    clear = np.abs(reserve) > 1e-5
    np.testing.assert_array_equal(np.asarray(drawn_in.contains(tests))[clear], (reserve > 0.0)[clear])
    np.testing.assert_allclose(whole.distance(drawn_in.vertices), margin, atol=2e-6)


class TestByHand:
    def test_a_rectangle_with_points_on_its_edges(self, arm):
        corners = [[0, 0], [2, 0], [2, 1], [0, 1], [1, 0], [0.5, 1e-9], [1, 1 - 1e-8], [0, 0], [1, 0.5]]
        polygon = _polygon(arm, np.array(corners, float))
        assert polygon.normals.shape == (4, 2)
        order = np.lexsort(np.round(np.asarray(polygon.normals), 6).T)
        np.testing.assert_allclose(np.asarray(polygon.normals)[order], [[0, -1], [-1, 0], [1, 0], [0, 1]], atol=1e-7)
        np.testing.assert_allclose(np.asarray(polygon.offsets)[order], [0, 0, 2, 1], atol=1e-7)
        np.testing.assert_allclose(polygon.distance(np.array([0.3, 0.4])), 0.3, atol=1e-7)
        np.testing.assert_allclose(polygon.distance(np.array([2.5, 0.4])), -0.5, atol=1e-7)

    def test_edges_end_at_the_next_vertex_counter_clockwise(self, arm):
        polygon = _polygon(arm, np.array([[0, 0], [3, 0], [2, 2], [0, 1]], float))
        vertices, normals = np.asarray(polygon.vertices), np.asarray(polygon.normals)
        edges = np.roll(vertices, -1, 0) - vertices
        np.testing.assert_allclose(np.sum(edges * normals, 1), 0.0, atol=1e-14)
        assert (edges[:, 0] * np.roll(edges[:, 1], -1) - edges[:, 1] * np.roll(edges[:, 0], -1) > 0).all()

    def test_a_margin_drops_an_edge_that_no_longer_matters(self, arm):
        """A unit square with a corner cut off by a chamfer of depth 0.05: a margin of 0.2 swallows the chamfer."""
        cut = 0.05 * np.sqrt(2.0)
        points = np.array([[0, 0], [1, 0], [1, 1 - cut], [1 - cut, 1], [0, 1]])
        assert _polygon(arm, points).normals.shape == (5, 2)
        drawn_in = _polygon(arm, points, 0.2)
        assert drawn_in.normals.shape == (4, 2)
        expected = {(0.2, 0.2), (0.8, 0.2), (0.8, 0.8), (0.2, 0.8)}
        assert {(round(float(x), 9), round(float(y), 9)) for x, y in drawn_in.vertices} == expected

    def test_gradient(self, arm):
        polygon = _polygon(arm, np.array([[0, 0], [2, 0], [2, 1], [0, 1]], float))
        np.testing.assert_allclose(jax.grad(polygon.distance)(jnp.array([0.3, 0.4])), [1.0, 0.0], atol=1e-14)
        np.testing.assert_allclose(jax.grad(polygon.distance)(jnp.array([1.0, 1.5])), [0.0, -1.0], atol=1e-14)
        for tie in ([0.0, 0.0], [0.3, 0.3], [1.0, 0.5]):
            assert np.isfinite(jax.grad(polygon.distance)(jnp.array(tie))).all()


class TestOnRobots:
    def test_corners_are_where_mujoco_puts_them(self, nao, rng):
        v = np.concatenate([rng.uniform(-0.3, 0.3, 6), rng.uniform(-0.1, 0.1, nao.nv - 6)])
        q = osik.integrate(nao, nao.q0, jnp.asarray(v))
        data = mujoco_at(nao, q)
        names = [nao.mj_model.site(i).name for i in range(nao.mj_model.nsite)]
        corners = np.array([data.site_xpos[i, :2] for i, name in enumerate(names) if "_sole_corner_" in name])
        assert len(corners) == 8
        polygon = osik.support_polygon(nao, q, FEET)
        hull = corners[ConvexHull(corners).vertices]
        assert len(polygon.vertices) == len(hull)
        for vertex in hull:
            assert np.linalg.norm(np.asarray(polygon.vertices) - vertex, axis=1).min() < 1e-9
        tests = corners.mean(0) + rng.uniform(-0.15, 0.15, (200, 2))
        np.testing.assert_array_equal(polygon.contains(tests), Delaunay(corners).find_simplex(tests) >= 0)

    def test_one_foot_is_smaller_than_two(self, nao):
        double, single = (osik.support_polygon(nao, nao.q0, feet) for feet in (FEET, FEET[:1]))
        assert np.asarray(double.contains(single.vertices * (1 - 1e-9))).all()
        com = osik.center_of_mass(nao, _kinematics(nao, nao.q0))[:2]
        assert float(double.distance(com)) > 0.01
        assert float(single.distance(com)) < 0.0

    def test_given_corners_replace_the_model_s(self, nao):
        p, R = map(np.asarray, _kinematics(nao, nao.q0).frame_pose(nao, "l_sole"))
        corners = np.array([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [-0.1, -0.1, 0.0]])
        polygon = osik.support_polygon(nao, nao.q0, ("l_sole",), corners={"l_sole": corners})
        expected = (p + corners @ R.T)[:, :2]
        for vertex in expected:
            assert np.linalg.norm(np.asarray(polygon.vertices) - vertex, axis=1).min() < 1e-12


class TestMistakes:
    def test_no_area(self, arm):
        line = np.array([[0.0, 0.0], [1.0, 1.0], [0.5, 0.5], [2.0, 2.0]])
        for points in (line, line + 1e-8 * np.array([[0, 0], [0, 0], [1, -1], [0, 0]]), line[:2], np.zeros((4, 2))):
            refuses(ValueError, "span no area", _polygon, arm, points)
        refuses(ValueError, "span no area", osik.support_polygon, arm, arm.q0, ())

    def test_margin(self, arm):
        square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
        assert _polygon(arm, square, 0.499).vertices.shape == (4, 2)
        refuses(ValueError, "0 or more", _polygon, arm, square, -0.1)

    def test_names(self, nao):
        with pytest.raises(ValueError, match=r"'r_wrist' has no contact corners.*r_wrist_corner_0.*l_sole, r_sole"):
            osik.support_polygon(nao, nao.q0, ("r_wrist",))
        with pytest.raises(ValueError, match="not among the frames: l_sole"):
            osik.support_polygon(nao, nao.q0, ("l_sole",), corners={"r_sole": np.zeros((4, 3))})
        with pytest.raises(ValueError, match=r"points \(k, 3\)"):
            osik.support_polygon(nao, nao.q0, ("l_sole",), corners={"l_sole": np.zeros((4, 2))})
