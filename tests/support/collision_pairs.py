"""Names of pairs of shapes, hulls of coal, and distances of MuJoCo."""

from __future__ import annotations

import coal
import mujoco
import numpy as np

import osik_jax as osik
from osik_jax.robot.loading._meshes import unread_points
from osik_jax.robot.loading._poses import quaternion


def named(limit: osik.CollisionAvoidanceLimit) -> set[frozenset[str]]:
    """The pairs of a limit."""
    return {frozenset(pair) for pair in limit.pairs}


def pair_set(*pairs: str) -> set[frozenset[str]]:
    """Pairs given as texts of two names."""
    return {frozenset(pair.split()) for pair in pairs}


def coal_hull(points: np.ndarray) -> coal.ConvexBase:
    listed = coal.StdVec_Vec3s()
    for point in np.asarray(points, float):
        listed.append(point)
    return coal.Convex.convexHull(listed, True, "")


def mujoco_distances(robot: osik.Robot, q: np.ndarray, pairs: tuple[tuple[str, str], ...]) -> np.ndarray:
    """Distances [m] of pairs of a robot's shapes by MuJoCo, whose model gets the meshes that the robot has not read."""
    spec, tree = mujoco.MjSpec.from_string(robot.to_mjcf()), robot.tree
    for geom in list(spec.geoms):
        spec.delete(geom)
    for k, name in enumerate(tree.geom_names):
        size = np.asarray(robot.geom_size[k])
        form = dict(size=size)
        if tree.geom_types[k] == mujoco.mjtGeom.mjGEOM_MESH:
            points = unread_points(robot.holder.meshes[k - robot.mj_model.ngeom])
            spec.add_mesh(name=name, uservert=(points * size).ravel())
            form = dict(meshname=name)
        place = dict(pos=np.asarray(robot.geom_position[k]), quat=quaternion(np.asarray(robot.geom_rotation[k])))
        body = spec.body(tree.body_names[tree.geom_bodies[k]])
        body.add_geom(name=name, type=mujoco.mjtGeom(tree.geom_types[k]), mass=0.0, **form, **place)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = np.asarray(robot.mujoco_qpos(q))
    mujoco.mj_kinematics(model, data)
    numbers = [[model.geom(name).id for name in pair] for pair in pairs]
    return np.array([mujoco.mj_geomDistance(model, data, *pair, 9.0, None) for pair in numbers])
