"""Measurements: what an instrument reads at several configurations, and what a setup predicts."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num

from .._errors import OsikTypeError, OsikValueError
from ..kinematics._rigid import compose, rotate
from ..numerics._arguments import as_array, as_vector, check_count, check_finite, concrete
from ..numerics._rotations import exact_rotation
from ..tasks._rotation import rotation_log
from ._setup import Setup, poses_at

Sigma = Num[ArrayLike, " n"] | float
_NEAREST = 1e-9
"""Least distance and depth [m]: a guard of divisions."""


class Measurement(eqx.Module):
    """Readings of one kind at n configurations; base of the kinds below.

    Attributes:
        frame: name of the frame that is measured: of the robot, or a fixed frame (static).
        q: configuration of each reading, as the encoders read it. (n, nq)
        sigma: standard deviation of the noise of each reading. (n,)

    Raises:
        ValueError: no readings, wrong shapes, not finite, no rotations, a sigma that is not positive.
    """

    frame: str = eqx.field(static=True)
    q: Float[Array, "n nq"]
    sigma: Float[Array, " n"]

    rows = 1
    """Rows of one reading."""
    unit = "m"
    """Unit of the rows."""
    shared = ()
    """Names of the arrays that all readings share."""
    read: ClassVar[tuple[str, ...]] = ()
    """Names of the fields with what was read."""
    also = ""
    """Name of the field that names a second frame."""

    def _common(self, frame: str, q: Any, sigma: Any, readings: int) -> None:
        check_count("the number of readings", readings)
        self.frame, self.q = frame, _array(q, "q", (readings, None))
        self.sigma = _sigma(sigma, "sigma", readings)

    @property
    def frames(self) -> tuple[str, ...]:
        """Return the names of all frames that are needed."""
        return (self.frame, getattr(self, self.also)) if self.also else (self.frame,)

    @property
    def readings(self) -> Any:
        """Return what was read: an array (n, ...), or several."""
        values = tuple(getattr(self, name) for name in self.read)
        return values[0] if len(values) == 1 else values

    @abc.abstractmethod
    def predicted(self, setup: Setup) -> Any:
        """Return what a setup predicts, as ``readings``."""

    def differences(self, predicted: Any, read: Any) -> Float[Array, "n k"]:
        """Return predicted minus read, row by row [m, rad or pixels]."""
        return (predicted - read).reshape(len(self.q), -1)

    def deviations(self) -> Float[Array, "n k"]:
        """Return the standard deviation of each row of the differences."""
        return jnp.broadcast_to(self.sigma[:, None], (len(self.q), self.rows))


class Points(Measurement):
    """Positions of a point of a frame in the world: a laser tracker, a motion capture, tips on known spots.

    Attributes:
        position: where the point was [m]. (n, 3)
        point: the point in the frame [m]. (3,)
    """

    position: Float[Array, "n 3"]
    point: Float[Array, "3"]
    rows = 3
    shared = ("point",)
    read = ("position",)

    def __init__(
        self,
        frame: str,
        q: Num[ArrayLike, "n nq"],
        position: Num[ArrayLike, "n 3"],
        *,
        sigma: Sigma = 1e-3,
        point: Num[ArrayLike, "3"] | Sequence[float] = (0.0, 0.0, 0.0),
    ):
        self.position, self.point = _array(position, "position", (None, 3)), _array(point, "point", (3,))
        self._common(frame, q, sigma, len(self.position))

    def predicted(self, setup: Setup) -> Array:
        """Return the positions of the point. (n, 3)."""
        ((position, rotation),) = poses_at(setup, self.q, self.frame)
        return position + rotate(rotation, self.point)


class Poses(Measurement):
    """Poses of a frame in the world.

    Attributes:
        position: its origin [m]. (n, 3)
        rotation: from its axes to the world's. (n, 3, 3)
        sigma_rotation: standard deviation of the noise about each axis [rad]. (n,)
    """

    position: Float[Array, "n 3"]
    rotation: Float[Array, "n 3 3"]
    sigma_rotation: Float[Array, " n"]
    rows = 6
    read = ("position", "rotation")
    unit = "m, rad"

    def __init__(
        self,
        frame: str,
        q: Num[ArrayLike, "n nq"],
        position: Num[ArrayLike, "n 3"],
        rotation: Num[ArrayLike, "n 3 3"],
        *,
        sigma: Sigma = 1e-3,
        sigma_rotation: Sigma = 1e-3,
    ):
        self.position = _array(position, "position", (None, 3))
        self.rotation = exact_rotation(_array(rotation, "rotation", (len(self.position), 3, 3)), "rotation")
        self.sigma_rotation = _sigma(sigma_rotation, "sigma_rotation", len(self.position))
        self._common(frame, q, sigma, len(self.position))

    def predicted(self, setup: Setup) -> tuple[Array, Array]:
        """Return the poses of the frame."""
        return poses_at(setup, self.q, self.frame)[0]

    def differences(self, predicted: tuple[Array, Array], read: tuple[Array, Array]) -> Array:
        """Return differences of position [m], and rotation vectors in the frame that was read [rad]. (n, 6)."""
        turn = jax.vmap(rotation_log)(compose(read[1].mT, predicted[1]))
        return jnp.concatenate([predicted[0] - read[0], turn], -1)

    def deviations(self) -> Array:
        """Return the standard deviations of position and rotation. (n, 6)."""
        return jnp.repeat(jnp.stack([self.sigma, self.sigma_rotation], -1), 3, -1)


class Distances(Measurement):
    """Distances between the origins of two frames, or of one frame at two configurations: ball bars, tape measures.

    Attributes:
        other: name of the other frame; it may be a fixed frame of the world (static).
        distance: what was read [m]. (n,)
        other_q: configuration at which the other frame is; ``q`` unless given. (n, nq)
    """

    other: str = eqx.field(static=True)
    distance: Float[Array, " n"]
    other_q: Float[Array, "n nq"]
    also = "other"
    read = ("distance",)

    def __init__(
        self,
        frame: str,
        other: str,
        q: Num[ArrayLike, "n nq"],
        distance: Num[ArrayLike, " n"],
        *,
        other_q: Num[ArrayLike, "n nq"] | None = None,
        sigma: Sigma = 1e-3,
    ):
        self.other, self.distance = other, _array(distance, "distance", (None,))
        self._common(frame, q, sigma, len(self.distance))
        self.other_q = self.q if other_q is None else _array(other_q, "other_q", self.q.shape)

    def predicted(self, setup: Setup) -> Array:
        """Return the distances [m]. (n,)."""
        ((first, _),), ((second, _),) = poses_at(setup, self.q, self.frame), poses_at(setup, self.other_q, self.other)
        return jnp.sqrt(jnp.maximum(((first - second) ** 2).sum(-1), _NEAREST**2))


class PlaneContacts(Measurement):
    """Contacts of a frame's origin with a plane: a tip that touches a table, or feelers of known thickness on it.

    Attributes:
        plane: name of a fixed frame; the plane is its x and y axes, and z points away from it (static).
        height: of the frame's origin over the plane [m]. (n,)
    """

    plane: str = eqx.field(static=True)
    height: Float[Array, " n"]
    also = "plane"
    read = ("height",)

    def __init__(
        self,
        frame: str,
        plane: str,
        q: Num[ArrayLike, "n nq"],
        *,
        height: Num[ArrayLike, " n"] | float = 0.0,
        sigma: Sigma = 1e-3,
    ):
        readings = len(_array(q, "q", (None, None)))
        self.plane, self.height = plane, as_vector(height, (readings,), "height", float)
        check_finite(self.height, "height")
        self._common(frame, q, sigma, readings)

    def predicted(self, setup: Setup) -> Array:
        """Return the heights over the plane [m]. (n,)."""
        (point, _), (origin, axes) = poses_at(setup, self.q, self.frame, self.plane)
        return ((point - origin) * axes[..., 2]).sum(-1)


class Pixels(Measurement):
    """Pixels at which a camera sees a marker, whose frame is ``frame``; lenses are undistorted before.

    Attributes:
        sigma: standard deviation of each reading [pixels]. (n,)
        camera: name of the camera's frame, whose z axis looks forward, x to the right and y down (static).
        pixel: columns and rows [pixels]. (n, 2)
        intrinsics: focal lengths and principal point, fx, fy, cx, cy [pixels]. (4,)
        point: the marker in its frame [m]: a corner of a board; one (3,) may be given for all readings. (n, 3)
    """

    camera: str = eqx.field(static=True)
    pixel: Float[Array, "n 2"]
    intrinsics: Float[Array, "4"]
    point: Float[Array, "n 3"]
    rows = 2
    unit = "pixels"
    shared = ("intrinsics",)
    also = "camera"
    read = ("pixel",)

    def __init__(
        self,
        frame: str,
        camera: str,
        q: Num[ArrayLike, "n nq"],
        pixel: Num[ArrayLike, "n 2"],
        intrinsics: Num[ArrayLike, "4"] | Sequence[float],
        *,
        point: Num[ArrayLike, "*n 3"] | Sequence[float] = (0.0, 0.0, 0.0),
        sigma: Sigma = 1.0,
    ):
        self.camera, self.pixel = camera, _array(pixel, "pixel", (None, 2))
        self.intrinsics = _array(intrinsics, "intrinsics", (4,))
        points = as_array(point, "point", self.pixel.dtype)
        points = jnp.tile(points, (len(self.pixel), 1)) if points.size == 3 else points
        self.point = _array(points, "point", (len(self.pixel), 3))
        self._common(frame, q, sigma, len(self.pixel))

    def predicted(self, setup: Setup) -> Array:
        """Return the pixels (n, 2); a marker behind the camera is mirrored to its front, far out."""
        (origin, turn), (eye, axes) = poses_at(setup, self.q, self.frame, self.camera)
        seen = rotate(axes.mT, origin + rotate(turn, self.point) - eye)
        depth = jnp.maximum(jnp.abs(seen[:, 2:]), _NEAREST)
        return self.intrinsics[2:] + self.intrinsics[:2] * seen[:, :2] / depth


def _array(value: Any, what: str, shape: tuple[int | None, ...]) -> Array:
    """Return a finite array; None stands for any length."""
    out = as_array(value, what, float)
    if out.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, out.shape, strict=True)):
        wanted = ", ".join("n" if n is None else str(n) for n in shape)
        raise OsikValueError(f"{what} has shape {out.shape}, expected ({wanted}). Batch with jax.vmap.")
    check_finite(out, what)
    return out


def _sigma(value: Any, what: str, readings: int) -> Float[Array, " n"]:
    out = as_array(value, what, float)
    seen = concrete(out)
    if out.shape not in ((), (readings,)):
        raise OsikValueError(f"{what} has shape {out.shape}, expected ({readings},) or one number for all readings")
    if seen is not None and not ((seen > 0.0).all() and (seen < float("inf")).all()):
        raise OsikValueError(f"{what} is {seen}; it is a standard deviation, a positive number")
    return jnp.broadcast_to(out, (readings,))


def check_measurements(setup: Setup, measurements: Any) -> tuple[Measurement, ...]:
    """Return measurements as a tuple, checked."""
    given = tuple(measurements) if isinstance(measurements, Iterable) else (measurements,)
    if not given:
        raise OsikValueError("there are no measurements: give at least one, such as calibration.Points(...)")
    for one in given:
        if not isinstance(one, Measurement):
            raise OsikTypeError(f"a measurement is a {type(one).__name__}; it is Points, Poses, Distances, or the like")
        for name in one.frames:
            setup.check(name)
        if one.q.shape[-1] != setup.robot.nq:
            raise OsikValueError(
                f"{type(one).__name__} have q of shape {one.q.shape}, expected (n, {setup.robot.nq}) for "
                f"{setup.robot.tree.dof_owners}"
            )
    return given


def reading_at(measurement: Measurement, q: Float[Array, "1 nq"]) -> Measurement:
    """Return the first reading as if it was taken at another configuration."""
    fields = (f.name for f in dataclasses.fields(measurement) if not f.metadata.get("static"))
    fields = [name for name in fields if name not in measurement.shared]
    moved = ("q", "other_q") if measurement.frame != measurement.frames[-1] else ("q",)
    rows = [q if name in moved else getattr(measurement, name)[:1] for name in fields]
    return eqx.tree_at(lambda m: [getattr(m, name) for name in fields], measurement, rows)
