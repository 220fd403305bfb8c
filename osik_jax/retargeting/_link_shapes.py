"""Size of links from their collision shapes, used where their inertias are not credible."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from .._errors import OsikError
from ..robot import Robot
from ..robot.loading._meshes import unread_points
from ..robot.loading._poses import rotation_matrix

_LIGHTEST, _DENSEST = 200.0, 20_000.0
"""Accepted link densities [kg/m^3]. The lightest link of G1, NAO, Talos, GR1T2 and GR3 has 210 (a Talos' head); no
metal used in robots exceeds 20,000.
"""

_USUAL = 1000.0
"""Density given to an ellipsoid that is too light for its size [kg/m^3]; over half of those robots' links are denser.
"""

_ROUND = 1e-6
"""Relative difference below which semi-axes count as equal."""

_GEOM = mujoco.mjtGeom
SHAPES = range(int(_GEOM.mjGEOM_SPHERE), int(_GEOM.mjGEOM_MESH) + 1)
"""Kinds of geoms with a size: sphere, capsule, ellipsoid, cylinder, box and mesh."""


class Extent(NamedTuple):
    """A box or ellipsoid in a body's frame: its centre [m], its axes in columns, and its half lengths [m]."""

    center: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    half: Float[np.ndarray, "3"]


def density(mass: float, half: Float[np.ndarray, "3"]) -> float:
    """Return the density [kg/m^3] of an ellipsoid of a mass [kg] with these semi-axes [m]."""
    return mass / max(4.0 / 3.0 * np.pi * float(np.prod(half)), 1e-12)


def is_credible(mass: float, half: Float[np.ndarray, "3"]) -> bool:
    """Return whether an ellipsoid of a mass [kg] with these semi-axes [m] is plausible as a robot link.

    Its density must be within ``_LIGHTEST`` and ``_DENSEST``, and it must not be a ball, because three equal moments of
    inertia are placeholders.
    """
    return _LIGHTEST <= density(mass, half) <= _DENSEST and np.ptp(half) > _ROUND * np.max(half)


def shrunk(mass: float, half: Float[np.ndarray, "3"]) -> float:
    """Return the factor on an ellipsoid's semi-axes [m] that gives it a plausible density.

    Placeholder inertias, or inertias about a point other than the centre of mass, belong to ellipsoids that are far too
    large for their mass.
    """
    found = density(mass, half)
    return (found / _USUAL) ** (1.0 / 3.0) if found < _LIGHTEST else 1.0


def by_inertia(model: mujoco.MjModel, body: int) -> Extent:
    """Return the solid ellipsoid of a body's inertia.

    An ellipsoid of semi-axes a, b, c and mass m turns about the first with ``m (b^2 + c^2) / 5``.
    """
    mass, inertia = float(model.body_mass[body]), model.body_inertia[body]
    half = np.sqrt(np.maximum(2.5 / mass * (inertia.sum() - 2.0 * inertia), 0.0))
    return Extent(model.body_ipos[body].copy(), rotation_matrix(model.body_iquat[body]), half)


def by_shapes(robot: Robot, body: int) -> Extent | None:
    """Return the box around a body's collision shapes, along their principal axes; None if there are none.

    Mesh files that the model does not contain are read from disk; unreadable files are left out.
    """
    model = robot.mj_model
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    geoms = np.flatnonzero(solid & (model.geom_bodyid == body) & np.isin(model.geom_type, SHAPES))
    clouds = [*(geom_points(model, int(geom)) for geom in geoms), *_unread_points(robot, body)]
    if not clouds:
        return None
    points = np.concatenate(clouds)
    middle = points.mean(0)
    axes = np.linalg.svd(points - middle, full_matrices=True)[2].T
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    along = (points - middle) @ axes
    low, high = along.min(0), along.max(0)
    return Extent(middle + axes @ (0.5 * (low + high)), axes, 0.5 * (high - low))


def geom_points(model: mujoco.MjModel, geom: int) -> Float[np.ndarray, "k 3"]:
    """Return the corners of the box around a geom, or the vertices of a mesh, in the body's frame [m]."""
    if model.geom_type[geom] == _GEOM.mjGEOM_MESH:
        mesh = model.mesh(model.geom_dataid[geom])
        first = int(mesh.vertadr[0])
        points = model.mesh_vert[first : first + int(mesh.vertnum[0])].astype(float)
    else:
        points = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), -1).reshape(-1, 3) * model.geom_aabb[geom, 3:]
    return model.geom_pos[geom] + points @ rotation_matrix(model.geom_quat[geom]).T


def _unread_points(robot: Robot, body: int) -> list[Float[np.ndarray, "k 3"]]:
    """Return the vertices of the collision meshes whose files the model does not hold, in the link's frame [m]."""
    model, out = robot.mj_model, []
    link = model.body(body).name
    for mesh in robot.holder.meshes:
        if mesh.link == link:
            try:
                points = unread_points(mesh)
            except (OSError, OsikError):
                continue
            out.append(np.array(mesh.position) + points @ np.array(mesh.rotation).T)
    return out
