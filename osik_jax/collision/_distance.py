"""Signed distances between convex shapes, the points where they are nearest, and the direction between them.

A shape is a core (a segment or a polytope) with a radius around it, or a half-space. If shapes overlap, the distance is
negative: minus the shortest translation that separates them. Capsules have a closed form. For polytopes, the best
separating axis gives the depth of an overlap, and the algorithm of Gilbert, Johnson and Keerthi the nearest points.

The iterations determine integers alone: the vertices between which the nearest points lie. The points, and their
derivatives, are functions of these vertices.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..kinematics._rigid import cross
from ..numerics._constants import PARALLEL

_MOST_ITERATIONS = 48
_SEGMENTS = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)], np.int32)  # in either precision
_TRIANGLES = np.array([(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)], np.int32)


class Nearest(NamedTuple):
    """Signed distance from shape a to shape b, in world axes.

    ``d distance / dt = normal @ (velocity of point_b - velocity of point_a)``, each point moving with its shape.

    Attributes:
        distance: [m], negative where they overlap. ()
        point_a: nearest point on the surface of a [m]. (3,)
        point_b: nearest point on the surface of b [m]. (3,)
        normal: unit vector from a to b; where they overlap, the direction in which b leaves a soonest. (3,)
    """

    distance: Float[Array, ""]
    point_a: Float[Array, "3"]
    point_b: Float[Array, "3"]
    normal: Float[Array, "3"]


class Core(NamedTuple):
    """A convex polytope and a radius around it, in world axes. Padding repeats rows.

    Attributes:
        vertices: [m]. (v, 3)
        normals: of its faces, each or its opposite, of unit length. (f, 3)
        edges: directions of its edges, of any length. (e, 3)
        radius: [m]. ()
    """

    vertices: Float[Array, "v 3"]
    normals: Float[Array, "f 3"]
    edges: Float[Array, "e 3"]
    radius: Float[Array, ""]


def between_segments(a: Core, b: Core) -> Nearest:
    """Return the separation of two spheres or capsules: segments, of length 0 for a sphere, with a radius.

    Axes that cross or centres that coincide leave the direction open: perpendicular to both axes is taken.
    """
    start_a, start_b = a.vertices[0], b.vertices[0]
    along_a, along_b = a.vertices[1] - start_a, b.vertices[1] - start_b
    s, t = _segment_parameters(along_a, along_b, start_a - start_b)
    on_a, on_b = start_a + s * along_a, start_b + t * along_b
    outward = jnp.sum(b.vertices - a.vertices, 0)
    return _rounded(on_a, on_b, a.radius, b.radius, _across(along_a, along_b, outward))


def from_plane(point: Float[Array, "3"], normal: Float[Array, "3"], b: Core) -> Nearest:
    """Return a half-space, whose surface holds ``point`` and whose outside ``normal`` points to, and a core."""
    height = _dot(b.vertices - point, normal)
    lowest = jnp.argmin(height)
    distance = height[lowest] - b.radius
    below = b.vertices[lowest] - b.radius * normal
    return Nearest(distance, below - distance * normal, below, normal)


def between_polytopes(a: Core, b: Core, *, rounds: int = 1) -> Nearest:
    """Return the separation of two cores, at least one of which has faces.

    If they overlap, b is first moved out along the best separating axis, slightly farther than necessary. The answer is
    exact if ``normals`` and ``edges`` are complete. If edges are missing, the depth is overestimated where edges cross;
    each further round improves it. In an overlap, derivatives of ``normal`` and of the points (so second derivatives
    of the distance) take the points as fixed to the shapes.

    Args:
        a: the first.
        b: the second.
        rounds: searches for the nearest points, at least 1 (static).
    """
    origin = a.vertices[0]
    vertices_a, vertices_b = a.vertices - origin, b.vertices - origin
    axes = _axes(a, b)
    fixed_a, fixed_b, fixed_axes = jax.lax.stop_gradient((vertices_a, vertices_b, axes))
    best, separation = _best_axis(fixed_a, fixed_b, fixed_axes)
    margin = _margin(fixed_a, fixed_b)

    def search(found: _Apart) -> _Apart:
        shift = jnp.maximum(margin - found.separation, 0.0) * found.axis
        ids_a, ids_b = _search(fixed_a, fixed_b + shift)
        points = _corners(fixed_a, fixed_b + shift, (ids_a, ids_b))
        way = _weights(points) @ points
        axis = way / _length(way)
        return _Apart(axis, _length(way) - _dot(shift, axis), shift, ids_a, ids_b, found.round + 1)

    none = jnp.zeros(4, int)
    start = _Apart(_signed(fixed_axes, best), separation, jnp.ones(3, separation.dtype), none, none, jnp.array(0))
    found = jax.lax.while_loop(lambda f: jnp.any(f.shift != 0.0) & (f.round < rounds), search, start)
    axis, shift, ids = found.axis, found.shift, (found.ids_a, found.ids_b)
    points = _corners(vertices_a, vertices_b + shift, ids)
    weights, moved = _weights(points), jnp.any(shift != 0.0)
    weights = jnp.where(moved, jax.lax.stop_gradient(weights), weights)
    on_a, on_b = weights @ vertices_a[ids[0]], weights @ vertices_b[ids[1]]
    turning = _signed(axes, best)
    normal = jnp.where(moved, axis + turning - jax.lax.stop_gradient(turning), _unit(weights @ points, axis))
    return Nearest(
        _dot(axis, on_b - on_a) - a.radius - b.radius,
        origin + on_a + a.radius * normal,
        origin + on_b - b.radius * normal,
        normal,
    )


def nearest_points(
    a: Float[Array, "4 3"], b: Float[Array, "4 3"], radii: Float[Array, "2"], otherwise: Float[Array, "3"]
) -> Nearest:
    """Return the separation of two shapes from the points of their cores between which the nearest ones lie."""
    weights = _weights(b - a)
    return _rounded(weights @ a, weights @ b, radii[0], radii[1], otherwise)


class _Apart(NamedTuple):
    """Separating direction of two polytopes, the second one shifted, and the vertices nearest to each other then."""

    axis: Float[Array, "3"]
    separation: Float[Array, ""]
    shift: Float[Array, "3"]
    ids_a: Int[Array, "4"]
    ids_b: Int[Array, "4"]
    round: Int[Array, ""]


def _rounded(
    on_a: Float[Array, "3"],
    on_b: Float[Array, "3"],
    radius_a: Float[Array, ""],
    radius_b: Float[Array, ""],
    otherwise: Float[Array, "3"],
) -> Nearest:
    """Return the separation of two balls; ``otherwise`` is the normal if their centres coincide."""
    way = on_b - on_a
    normal, apart = _unit(way, otherwise), _length(way)
    return Nearest(apart - radius_a - radius_b, on_a + radius_a * normal, on_b - radius_b * normal, normal)


def _segment_parameters(
    a: Float[Array, "3"], b: Float[Array, "3"], offset: Float[Array, "3"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the parameters in [0, 1] of the nearest points of two segments.

    ``a`` and ``b``: the segments' vectors [m]. ``offset``: vector from the start of b to the start of a [m]. Of
    parallel segments that overlap, the middle of the overlap is taken.
    """
    return _parameters(_dot(a, a), _dot(b, b), _dot(a, b), _dot(a, offset), _dot(b, offset))


def _parameters(aa: Array, bb: Array, ab: Array, ao: Array, bo: Array) -> tuple[Array, Array]:
    """Return these parameters for any number of pairs, from the dot products of ``_segment_parameters``."""
    square = aa * bb - ab * ab
    parallel = square <= PARALLEL * aa * bb
    crossing = jnp.clip(_over(ab * bo - ao * bb, jnp.where(parallel, 0.0, square)), 0.0, 1.0)
    ends = jnp.clip(_over(-ao, aa), 0.0, 1.0), jnp.clip(_over(ab - ao, aa), 0.0, 1.0)
    s = jnp.where(parallel, 0.5 * (ends[0] + ends[1]), crossing)
    t = jnp.clip(_over(ab * s + bo, bb), 0.0, 1.0)
    return jnp.clip(_over(ab * t - ao, aa), 0.0, 1.0), t


def _across(a: Float[Array, "3"], b: Float[Array, "3"], outward: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return a unit vector perpendicular to two directions, on the outward side; if they are parallel, any one.

    Its derivative is 0.
    """
    a, b, outward = jax.lax.stop_gradient((a, b, outward))
    longer = jnp.where(_dot(a, a) >= _dot(b, b), a, b)
    steepest = jnp.eye(3, dtype=a.dtype)[jnp.argmin(jnp.abs(longer))]
    either = _unit(cross(longer, steepest), jnp.array([0.0, 0.0, 1.0], a.dtype))
    normal = _unit(cross(a, b), either)
    return jnp.where(_dot(normal, outward) < 0.0, -normal, normal)


def _axes(a: Core, b: Core) -> Float[Array, "k 3"]:
    """Return the candidates for a separating axis of two convex polytopes, each up to its sign; unused rows are 0."""
    crossed = cross(a.edges[:, None], b.edges[None]).reshape(-1, 3)
    lengths = jax.vmap(_length)(a.edges)[:, None] * jax.vmap(_length)(b.edges)
    tiny = jax.vmap(_length)(crossed) <= PARALLEL * lengths.reshape(-1)
    unit = jax.vmap(_unit)(crossed, jnp.zeros_like(crossed))
    return jnp.concatenate([a.normals, b.normals, jnp.where(tiny[:, None], 0.0, unit)])


def _best_axis(
    a: Float[Array, "v 3"], b: Float[Array, "w 3"], axes: Float[Array, "k 3"]
) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """Return the index of the axis that separates b from a most (plus k for the opposite direction), and the gap."""
    along_a, along_b = (_dot(points[:, None], axes) for points in (a, b))
    ahead = jnp.min(along_b, 0) - jnp.max(along_a, 0)
    behind = jnp.min(along_a, 0) - jnp.max(along_b, 0)
    usable = jnp.concatenate([jnp.any(axes != 0.0, -1)] * 2)
    separation = jnp.where(usable, jnp.concatenate([ahead, behind]), -jnp.inf)
    best = jnp.argmax(separation)
    return best, separation[best]


def _signed(axes: Float[Array, "k 3"], best: Int[Array, ""]) -> Float[Array, "3"]:
    return jnp.concatenate([axes, -axes])[best]


def _margin(a: Float[Array, "v 3"], b: Float[Array, "w 3"]) -> Float[Array, ""]:
    """Return a distance that is small relative to the shapes and large relative to rounding."""
    size = jnp.max(jnp.abs(a - a[0])) + jnp.max(jnp.abs(b - b[0]))
    return jnp.finfo(a.dtype).eps ** 0.4 * size


def _search(a: Float[Array, "v 3"], b: Float[Array, "w 3"]) -> tuple[Int[Array, "4"], Int[Array, "4"]]:
    """Return vertices of two disjoint polytopes between which their nearest points lie (Gilbert's distance)."""
    tolerance = 8.0 * jnp.finfo(a.dtype).eps

    def support(way: Array) -> tuple[Array, Array]:
        return jnp.argmax(_dot(a, way)), jnp.argmin(_dot(b, way))

    def step(state: _Search) -> _Search:
        i, j = support(state.way)
        reach = _dot(b[j] - a[i], state.way)
        square = _dot(state.way, state.way)
        spare = jnp.arange(4) == jnp.argmin(state.weights)
        ids = jnp.where(spare, i, state.ids_a), jnp.where(spare, j, state.ids_b)
        points = _corners(a, b, ids)
        weights = _weights(points)
        way = weights @ points
        better = (square - reach > tolerance * square) & (_dot(way, way) < square)
        new = _Search(ids[0], ids[1], weights, way, state.steps + 1, better)
        old = state._replace(going=better)
        return jax.tree.map(lambda n, o: jnp.where(better, n, o), new, old)

    first = support(jnp.mean(b, 0) - jnp.mean(a, 0))
    ids = jnp.full(4, first[0]), jnp.full(4, first[1])
    way = b[first[1]] - a[first[0]]
    start = _Search(ids[0], ids[1], jnp.eye(4, dtype=a.dtype)[0], way, jnp.array(0), jnp.array(True))
    done = jax.lax.while_loop(lambda s: s.going & (s.steps < _MOST_ITERATIONS), step, start)
    return done.ids_a, done.ids_b


class _Search(NamedTuple):
    """Four vertices of each shape (repeated if fewer are used), and the point of their differences nearest to 0."""

    ids_a: Int[Array, "4"]
    ids_b: Int[Array, "4"]
    weights: Float[Array, "4"]
    way: Float[Array, "3"]
    steps: Int[Array, ""]
    going: Bool[Array, ""]


def _corners(
    a: Float[Array, "v 3"], b: Float[Array, "w 3"], ids: tuple[Int[Array, "4"], Int[Array, "4"]]
) -> Float[Array, "4 3"]:
    return b[ids[1]] - a[ids[0]]


def _weights(points: Float[Array, "4 3"]) -> Float[Array, "4"]:
    """Return barycentric weights of the point nearest to 0 of a tetrahedron that 0 is not inside of.

    Each edge and each face is tried. Points may coincide.
    """
    on_edges, on_faces = jax.vmap(_edge_weights)(points[_SEGMENTS]), jax.vmap(_face_weights)(points[_TRIANGLES])
    edges = jnp.einsum("ki,kij->kj", on_edges, np.eye(4)[_SEGMENTS].astype(points.dtype))
    faces = jnp.einsum("ki,kij->kj", on_faces[0], np.eye(4)[_TRIANGLES].astype(points.dtype))
    weights = jnp.concatenate([edges, faces])
    nearest = weights @ points
    usable = jnp.concatenate([jnp.ones(len(_SEGMENTS), bool), on_faces[1]])
    square = jnp.where(usable, _dot(nearest, nearest), jnp.inf)
    return weights[jnp.argmin(square)]


def _edge_weights(ends: Float[Array, "2 3"]) -> Float[Array, "2"]:
    along = ends[1] - ends[0]
    t = jnp.clip(_over(-_dot(ends[0], along), _dot(along, along)), 0.0, 1.0)
    return jnp.stack([1.0 - t, t])


def _face_weights(corners: Float[Array, "3 3"]) -> tuple[Float[Array, "3"], Bool[Array, ""]]:
    """Return the weights of the point of a plane nearest to 0, and whether it is inside the triangle."""
    u, v = corners[1] - corners[0], corners[2] - corners[0]
    uu, vv, uv = _dot(u, u), _dot(v, v), _dot(u, v)
    u0, v0 = -_dot(u, corners[0]), -_dot(v, corners[0])
    square = uu * vv - uv * uv
    flat = square <= 8.0 * jnp.finfo(corners.dtype).eps * uu * vv
    square = jnp.where(flat, 0.0, square)
    s, t = _over(u0 * vv - v0 * uv, square), _over(v0 * uu - u0 * uv, square)
    weights = jnp.stack([1.0 - s - t, s, t])
    return weights, ~flat & jnp.all(weights > 0.0)


def _dot(a: Float[Array, "... 3"], b: Float[Array, "... 3"]) -> Float[Array, "..."]:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _over(a: Float[Array, "*B"], b: Float[Array, "*B"]) -> Float[Array, "*B"]:
    """Return a / b; 0 where b is 0, with derivatives 0."""
    is_zero = b == 0.0
    return jnp.where(is_zero, 0.0, a / jnp.where(is_zero, 1.0, b))


def _length(a: Float[Array, "3"]) -> Float[Array, ""]:
    """Return the 2-norm, with derivatives 0 at 0."""
    square = _dot(a, a)
    is_zero = square == 0.0
    return jnp.where(is_zero, 0.0, jnp.sqrt(jnp.where(is_zero, 1.0, square)))


def _unit(a: Float[Array, "3"], otherwise: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return a / |a|; ``otherwise`` where a is only rounding."""
    square = _dot(a, a)
    is_zero = square <= jnp.finfo(a.dtype).tiny ** 0.5
    return jnp.where(is_zero, otherwise, a / jnp.sqrt(jnp.where(is_zero, 1.0, square)))
