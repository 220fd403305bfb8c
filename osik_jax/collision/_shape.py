"""Added shapes: obstacles in the world, and shapes on links."""

from __future__ import annotations

from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..numerics._arguments import concrete
from ..numerics._host import to_jax
from ..numerics._rotations import exact_rotation
from ._geometry import Kind, UnitCore, convex_hull


class CollisionShape(eqx.Module):
    """A convex shape fixed to the world, or to a frame of the robot. Make one by ``sphere``, ``capsule`` and so on.

    Attributes:
        kind: what it is (static).
        frame: name of the robot's frame that it is fixed to; None: the world (static).
        position: of its centre in the frame [m]; of a half-space, any point of its surface. (3,)
        rotation: from its axes to the frame's. (3, 3)
        size: [m], as of MuJoCo's geoms; of a hull, factors of its points. (3,)
        hull: of a hull, its vertices [m], face normals and edges.
    """

    kind: Kind = eqx.field(static=True)
    frame: str | None = eqx.field(static=True)
    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    size: Float[Array, "3"]
    hull: UnitCore | None = None

    @classmethod
    def sphere(
        cls, radius: ArrayLike | Array, position: ArrayLike | Array = (0.0, 0.0, 0.0), *, frame: str | None = None
    ) -> Self:
        """Return a ball.

        Args:
            radius: [m].
            position: of its centre, in the frame [m]. (3,)
            frame: of the robot; None: the world.

        Raises:
            ValueError: a size that is not positive, or a wrong shape.
        """
        return cls(Kind.SEGMENT, frame, _vector(position, "position"), _rotation(None), _sizes(radius))

    @classmethod
    def capsule(
        cls, radius: ArrayLike | Array, start: ArrayLike | Array, end: ArrayLike | Array, *, frame: str | None = None
    ) -> Self:
        """Return all points within ``radius`` [m] of the segment between two points of the frame [m].

        Raises:
            ValueError: as in ``sphere``; start and end are one point.
        """
        start, end = _vector(start, "start"), _vector(end, "end")
        length = jnp.linalg.norm(end - start)
        _check_positive(length, "the length of a capsule")
        rotation = _turned_to((end - start) / length)
        return cls(Kind.SEGMENT, frame, 0.5 * (start + end), rotation, _sizes(radius, 0.5 * length))

    @classmethod
    def box(
        cls,
        half_sizes: ArrayLike | Array,
        position: ArrayLike | Array = (0.0, 0.0, 0.0),
        rotation: ArrayLike | Array | None = None,
        *,
        frame: str | None = None,
    ) -> Self:
        """Return a box.

        Args:
            half_sizes: half its edges [m]. (3,)
            position: of its centre, in the frame [m]. (3,)
            rotation: from its axes to the frame's. (3, 3)
            frame: of the robot; None: the world.

        Raises:
            ValueError: as in ``sphere``; ``rotation`` is no rotation.
        """
        sizes = _sizes(*_vector(half_sizes, "half_sizes"))
        return cls(Kind.BOX, frame, _vector(position, "position"), _rotation(rotation), sizes)

    @classmethod
    def cylinder(
        cls, radius: ArrayLike | Array, start: ArrayLike | Array, end: ArrayLike | Array, *, frame: str | None = None
    ) -> Self:
        """Return a cylinder of ``radius`` [m] between two points of the frame [m].

        It is taken as the prism of 16 sides around it.

        Raises:
            ValueError: as in ``capsule``.
        """
        start, end = _vector(start, "start"), _vector(end, "end")
        length = jnp.linalg.norm(end - start)
        _check_positive(length, "the length of a cylinder")
        rotation = _turned_to((end - start) / length)
        return cls(Kind.CYLINDER, frame, 0.5 * (start + end), rotation, _sizes(radius, 0.5 * length))

    @classmethod
    def half_space(cls, point: ArrayLike | Array, normal: ArrayLike | Array, *, frame: str | None = None) -> Self:
        """Return the half-space behind a plane.

        Args:
            point: of the plane, in the frame [m]. (3,)
            normal: of the plane, towards the free side. (3,)
            frame: of the robot; None: the world.

        Raises:
            ValueError: a wrong shape, or a normal of length 0.
        """
        normal = _vector(normal, "normal")
        length = jnp.linalg.norm(normal)
        _check_positive(length, "the length of a normal")
        return cls(Kind.PLANE, frame, _vector(point, "point"), _turned_to(normal / length), jnp.zeros(3))

    @classmethod
    def convex(
        cls,
        points: np.ndarray,
        position: ArrayLike | Array = (0.0, 0.0, 0.0),
        rotation: ArrayLike | Array | None = None,
        *,
        frame: str | None = None,
    ) -> Self:
        """Return the convex hull of points, such as a mesh's vertices.

        Args:
            points: [m]. (k, 3)
            position: of their origin, in the frame [m]. (3,)
            rotation: from their axes to the frame's. (3, 3)
            frame: of the robot; None: the world.

        Raises:
            ValueError: as in ``box``; the points lie in a plane.
        """
        hull = convex_hull(np.asarray(points, float))
        return cls(
            Kind.HULL, frame, _vector(position, "position"), _rotation(rotation), to_jax(np.ones(3), float), hull
        )


def _vector(value: Any, what: str) -> Float[Array, "3"]:
    out = to_jax(value, float)
    if out.shape != (3,):
        raise OsikValueError(f"{what} has shape {out.shape}, expected (3,)")
    return out


def _sizes(*sizes: Any) -> Float[Array, "3"]:
    """Return MuJoCo's sizes: the given ones, which have to be positive, then zeros."""
    for size in sizes:
        _check_positive(size, "a size")
    return to_jax([*sizes, 0.0, 0.0][:3], float)


def _check_positive(value: Any, what: str) -> None:
    seen = concrete(value)
    if seen is not None and not (seen > 0.0).all():
        raise OsikValueError(f"{what} is {seen}; it has to be positive [m]")


def _rotation(value: Any) -> Float[Array, "3 3"]:
    if value is None:
        return to_jax(np.eye(3), float)
    out = to_jax(value, float)
    if out.shape != (3, 3):
        raise OsikValueError(f"rotation has shape {out.shape}, expected (3, 3)")
    return exact_rotation(out, "rotation")


def _turned_to(axis: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return a rotation that takes z to a unit vector."""
    steepest = jnp.eye(3, dtype=axis.dtype)[jnp.argmin(jnp.abs(axis))]
    side = jnp.cross(steepest, axis)
    side = side / jnp.linalg.norm(side)
    return jnp.stack([side, jnp.cross(axis, side), axis], -1)
