"""Pairs of a robot's shapes that touch in every configuration, found by samples."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import jax
import mujoco
import numpy as np
from jaxtyping import Float

from ..kinematics._forward import kinematics_at
from ..robot import Robot
from ..robot._tree import HINGE, SLIDE
from ..robot.loading._poses import quaternion
from ._table import ConvexShape, ShapeKind, bounding_ball

SAMPLES = 1000
"""Number of configurations; a pair that is apart in 1 % of all is taken for always touching with a chance of 4e-5."""

_FAR = 100.0
"""Position limits beyond this [rad or m] are placeholders for none."""

_CONTACT = 1e-6
"""Distance below which shapes touch [m]."""

_GEOMS = {
    ShapeKind.SPHERE: mujoco.mjtGeom.mjGEOM_SPHERE,
    ShapeKind.CAPSULE: mujoco.mjtGeom.mjGEOM_CAPSULE,
    ShapeKind.CYLINDER: mujoco.mjtGeom.mjGEOM_CYLINDER,
    ShapeKind.BOX: mujoco.mjtGeom.mjGEOM_BOX,
    ShapeKind.HALF_SPACE: mujoco.mjtGeom.mjGEOM_PLANE,
    ShapeKind.HULL: mujoco.mjtGeom.mjGEOM_MESH,
}


def always_touching(
    robot: Robot, bodies: Sequence[int], shapes: Sequence[ConvexShape], pairs: Sequence[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Return the pairs that touch at the home configuration and at all of ``SAMPLES`` configurations.

    Most pairs are apart in one of the first configurations, so few distances are computed. The configurations are the
    same in each call.

    Args:
        robot: the robot.
        bodies: moving body of each shape.
        shapes: in their moving bodies.
        pairs: of shapes.
    """
    host = jax.tree.map(lambda leaf: np.asarray(leaf, float), robot)
    balls = [bounding_ball(shape) for shape in shapes]
    left, check = list(pairs), None
    for q in _configurations(host):
        if not left:
            break
        placed = kinematics_at(host, q)
        position, rotation = np.asarray(placed.body_position), np.asarray(placed.body_rotation)
        if check is None:
            centers = [position[b] + rotation[b] @ center for b, (center, _) in zip(bodies, balls, strict=True)]
            left = [(i, j) for i, j in left if np.linalg.norm(centers[i] - centers[j]) <= balls[i][1] + balls[j][1]]
            check = _Check(bodies, shapes, left)
        left = check.touching(position, rotation, left)
    return left


def _configurations(robot: Robot) -> Iterator[Float[np.ndarray, " nq"]]:
    """Yield the home configuration, then random ones of hinges and slides; free and ball joints stay at home."""
    tree, home = robot.tree, np.asarray(robot.q0)
    joints = [j for j in tree.independent if tree.joint_types[j] in (HINGE, SLIDE)]
    places = [tree.qpos_address[j] for j in joints]
    lower, upper = (
        np.asarray(limit)[[tree.dof_address[j] for j in joints]]
        for limit in (robot.position_lower, robot.position_upper)
    )
    lower, upper = np.where(lower < -_FAR, -np.pi, lower), np.where(upper > _FAR, np.pi, upper)
    yield home
    random = np.random.default_rng(0)
    for _ in range(SAMPLES):
        q = home.copy()
        q[places] = lower + random.random(len(joints)) * (upper - lower)
        yield q


class _Check:
    """Model of MuJoCo in which each moving body is posed freely, with the shapes of some pairs."""

    def __init__(self, bodies: Sequence[int], shapes: Sequence[ConvexShape], pairs: Sequence[tuple[int, int]]) -> None:
        spec = mujoco.MjSpec()
        used = sorted({k for pair in pairs for k in pair})
        self._bodies = sorted({bodies[k] for k in used})
        posed = {body: spec.worldbody.add_body(mocap=True) for body in self._bodies}
        for k in used:
            _add(spec, posed[bodies[k]], str(k), shapes[k])
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._geoms = {k: self._model.geom(str(k)).id for k in used}
        self._radii = {k: shapes[k].size[0] if shapes[k].kind is ShapeKind.HULL else 0.0 for k in used}

    def touching(
        self, position: Float[np.ndarray, "b 3"], rotation: Float[np.ndarray, "b 3 3"], pairs: Sequence[tuple[int, int]]
    ) -> list[tuple[int, int]]:
        """Return the pairs that touch with the moving bodies at these poses."""
        for place, body in enumerate(self._bodies):
            self._data.mocap_pos[place], self._data.mocap_quat[place] = position[body], quaternion(rotation[body])
        mujoco.mj_kinematics(self._model, self._data)
        return [pair for pair in pairs if self._distance(*pair) < _CONTACT]

    def _distance(self, first: int, second: int) -> float:
        around = self._radii[first] + self._radii[second]
        cutoff = around + 10.0 * _CONTACT
        found = mujoco.mj_geomDistance(self._model, self._data, self._geoms[first], self._geoms[second], cutoff, None)
        return found - around


def _add(spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, shape: ConvexShape) -> None:
    form = dict(size=shape.size)
    if shape.kind is ShapeKind.HULL:
        spec.add_mesh(name=name, uservert=shape.vertices.ravel())
        form = dict(meshname=name)
    elif shape.kind is ShapeKind.HALF_SPACE:
        form = dict(size=[0.0, 0.0, 1.0])  # MuJoCo asks for a spacing of its grid
    body.add_geom(name=name, type=_GEOMS[shape.kind], pos=shape.position, quat=quaternion(shape.rotation), **form)
