"""Added shapes: obstacles in the world, and shapes on links."""

from __future__ import annotations

import os
from typing import Any, Self

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..kinematics._rigid import rotation_matrix
from ..numerics._arguments import as_host_numbers, check_finite, concrete
from ..numerics._host import Numbers, module_of, tree_to_jax
from ..numerics._rotations import exact_quaternion, exact_rotation
from ._geometry import Kind, UnitCore, convex_hull
from ._mesh_parts import convex_parts, triangles


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
    def _made(cls, kind: Kind, frame: str | None, *numbers: Numbers, hull: UnitCore | None = None) -> Self:
        return cls(kind, frame, *tree_to_jax(numbers), hull=hull)

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
        return cls._made(Kind.SEGMENT, frame, _vector(position, "position"), np.eye(3), _sizes(radius))

    @classmethod
    def capsule(
        cls, radius: ArrayLike | Array, start: ArrayLike | Array, end: ArrayLike | Array, *, frame: str | None = None
    ) -> Self:
        """Return all points within ``radius`` [m] of the segment between two points of the frame [m].

        Raises:
            ValueError: as in ``sphere``; start and end are one point.
        """
        return cls._made(Kind.SEGMENT, frame, *_along(radius, start, end, "capsule"))

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
            rotation: from its axes to the frame's, a matrix (3, 3) or a quaternion w x y z (4,).
            frame: of the robot; None: the world.

        Raises:
            ValueError: as in ``sphere``; ``rotation`` is no rotation.
        """
        sizes = _sizes(*_vector(half_sizes, "half_sizes"))
        return cls._made(Kind.BOX, frame, _vector(position, "position"), _rotation(rotation), sizes)

    @classmethod
    def cylinder(
        cls, radius: ArrayLike | Array, start: ArrayLike | Array, end: ArrayLike | Array, *, frame: str | None = None
    ) -> Self:
        """Return a cylinder of ``radius`` [m] between two points of the frame [m].

        A ``Scene`` takes it as it is, a ``CollisionAvoidanceLimit`` as the prism of 16 sides around it.

        Raises:
            ValueError: as in ``capsule``.
        """
        return cls._made(Kind.CYLINDER, frame, *_along(radius, start, end, "cylinder"))

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
        rotation = _turned_to(normal / _length(normal, "a normal"))
        return cls._made(Kind.PLANE, frame, _vector(point, "point"), rotation, np.zeros(3))

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
            rotation: from their axes to the frame's, as in ``box``.
            frame: of the robot; None: the world.

        Raises:
            ValueError: as in ``box``; the points lie in a plane.
        """
        hull = convex_hull(as_host_numbers(points, "points"))
        return cls._made(Kind.HULL, frame, _vector(position, "position"), _rotation(rotation), np.ones(3), hull=hull)

    @classmethod
    def mesh(
        cls,
        source: str | os.PathLike[str] | tuple[np.ndarray, np.ndarray],
        position: ArrayLike | Array = (0.0, 0.0, 0.0),
        rotation: ArrayLike | Array | None = None,
        *,
        scale: float = 1.0,
        frame: str | None = None,
    ) -> tuple[CollisionShape, ...]:
        """Return the convex parts of a triangle mesh; a ``Scene`` takes them as one object.

        A mesh that is not convex is split by CoACD (the extra ``meshes``). Without it, its hull is taken.

        Args:
            source: path of a file (.stl, .obj, .dae, .msh), or vertices (n, 3) [m] and faces (m, 3).
            position: of the mesh's origin, in the frame [m]. (3,)
            rotation: as in ``box``.
            scale: factor of the vertices.
            frame: of the robot; None: the world.

        Raises:
            FileNotFoundError: no such file.
            TypeError: neither a path nor two arrays.
            ValueError: the file cannot be read, the arrays are no mesh, or all points lie in a plane.

        Warns:
            OsikWarning: the mesh is not convex, and its hull is taken.
        """
        vertices, faces = triangles(source)
        factor = as_host_numbers(scale, "scale")
        check_finite(factor, "scale")
        parts = convex_parts(vertices * factor, faces)
        return tuple(cls.convex(part, position, rotation, frame=frame) for part in parts)


def _along(radius: Any, start: Any, end: Any, what: str) -> tuple[Numbers, Numbers, Numbers]:
    """Return position, rotation and size of a shape whose axis goes from one point to another."""
    start, end = _vector(start, "start"), _vector(end, "end")
    length = _length(end - start, f"a {what}")
    return 0.5 * (start + end), _turned_to((end - start) / length), _sizes(radius, 0.5 * length)


def _vector(value: Any, what: str) -> Float[Numbers, "3"]:
    out = as_host_numbers(value, what)
    if out.shape != (3,):
        raise OsikValueError(f"{what} has shape {out.shape}, expected (3,)")
    return out


def _sizes(*sizes: Any) -> Float[Numbers, "3"]:
    """Return MuJoCo's sizes: the given ones, which have to be positive, then zeros."""
    for size in sizes:
        _check_positive(as_host_numbers(size, "a size"), "a size")
    return _vector([*sizes, 0.0, 0.0][:3], "sizes")


def _length(vector: Float[Numbers, "3"], what: str) -> Float[Numbers, ""]:
    length = module_of(vector).linalg.norm(vector)
    _check_positive(length, f"the length of {what}")
    return length


def _check_positive(value: Any, what: str) -> None:
    seen = concrete(value)
    if seen is not None and not (seen > 0.0).all():
        raise OsikValueError(f"{what} is {seen}; it has to be positive [m]")


def _rotation(value: Any) -> Float[Numbers, "3 3"]:
    if value is None:
        return np.eye(3)
    out = as_host_numbers(value, "rotation")
    if out.shape == (4,):
        return rotation_matrix(exact_quaternion(out, "rotation"))
    if out.shape != (3, 3):
        raise OsikValueError(f"rotation has shape {out.shape}, expected a matrix (3, 3) or a quaternion w x y z (4,)")
    return exact_rotation(out, "rotation")


def _turned_to(axis: Float[Numbers, "3"]) -> Float[Numbers, "3 3"]:
    """Return a rotation that takes z to a unit vector."""
    numbers = module_of(axis)
    steepest = numbers.eye(3, dtype=axis.dtype)[numbers.argmin(abs(axis))]
    side = numbers.cross(steepest, axis)
    side = side / numbers.linalg.norm(side)
    return numbers.stack([side, numbers.cross(axis, side), axis], -1)
