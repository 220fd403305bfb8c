"""From a robot's profile to what is computed with: shapes that are kept apart, goals out of a person, a first guess."""

from __future__ import annotations

import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from .._home import home_kinematics
from ..collision import CollisionShape
from ..limits import CollisionAvoidanceLimit
from ..robot import Robot
from ._goals import Goals
from ._person import LIMBS, SIDES, Person
from ._profile import Profile
from ._terms import Bounds

JOINTS_APART = 3
_INSET, _SHARE = 1e-3, 0.98


def shapes_apart(robot: Robot, profile: Profile) -> CollisionAvoidanceLimit | None:
    """What keeps the profile's capsules apart: those with three joints and more between them that are apart at home."""
    shapes = {
        f"capsule {i}": CollisionShape.capsule(c.radius, c.start, c.end, frame=c.frame)
        for i, c in enumerate(profile.capsules)
    }
    bodies = [robot.tree.frame_bodies[robot.tree.frame(c.frame)] for c in profile.capsules]
    pairs = [
        (f"capsule {i}", f"capsule {j}")
        for i, j in itertools.combinations(range(len(bodies)), 2)
        if joints_between(robot, bodies[i], bodies[j]) >= JOINTS_APART
    ]
    if not pairs:
        return None
    return CollisionAvoidanceLimit(robot, pairs=pairs, shapes=shapes, minimum_distance=0.0, q0_distance=0.0)


def joints_between(robot: Robot, a: int, b: int) -> int:
    """How many joints are between two bodies along the tree."""
    parents = robot.tree.body_parents

    def chain(body: int) -> list[int]:
        out = [body]
        while out[-1] != parents[out[-1]]:
            out.append(parents[out[-1]])
        return out

    first, second = chain(a), chain(b)
    common = next(body for body in first if body in second)
    return first.index(common) + second.index(common)


def leg_length(robot: Robot, profile: Profile) -> float:
    """Thigh and shank at home, the mean of both legs [m]."""
    points = home_points(robot, profile)
    return 0.5 * float(sum(np.linalg.norm(points[b] - points[a]) for a, b in LIMBS[:4]))


def ankle_height(robot: Robot, profile: Profile) -> float:
    """How far the ankles are above the soles at home [m]."""
    points, kinematics = home_points(robot, profile), home_kinematics(robot)
    soles = []
    for frame, point in profile.corners:
        position, rotation = kinematics.frame_pose(robot, frame)
        soles.append(float((position + rotation @ jnp.array(point))[2]))
    ankles = [points[f"{side}_ankle"][2] for side in SIDES]
    return float(np.mean(ankles) - np.mean(soles))


def home_points(robot: Robot, profile: Profile) -> dict[str, Float[np.ndarray, "3"]]:
    """Where the keypoints are at home [m]."""
    kinematics, out = home_kinematics(robot), {}
    for role, (frame, point) in profile.keypoints.items():
        position, rotation = kinematics.frame_pose(robot, frame)
        out[role] = np.asarray(position) + np.asarray(rotation) @ np.array(point)
    return out


def goals_of(robot: Robot, profile: Profile, person: Person) -> Goals:
    """What a person asks of the robot: the path is scaled, and the ankles stand as high as the robot's do."""
    scale = leg_length(robot, profile) / person.leg if profile.scale is None else profile.scale
    root = scale * person.root
    root[:, 2] += ankle_height(robot, profile) - scale * person.ankle
    dtype = robot.q0.dtype
    return Goals(
        directions=jnp.asarray(person.directions, dtype),
        pelvis=jnp.asarray(person.pelvis, dtype),
        torso=jnp.asarray(person.torso, dtype),
        root=jnp.asarray(root, dtype),
        feet=jnp.asarray(person.feet, dtype),
        contact=jnp.asarray(person.contact, dtype),
        present=jnp.ones(len(root), dtype),
    )


def first_guess(robot: Robot, profile: Profile, goals: Goals) -> Float[Array, "F nq"]:
    """The home posture with the pelvis where and as the person's is."""
    points, kinematics = home_points(robot, profile), home_kinematics(robot)
    root = robot.tree.body_names[robot.tree.root]
    position, rotation = (np.asarray(x) for x in kinematics.frame_pose(robot, root))
    hips = 0.5 * (points["left_hip"] + points["right_hip"]) - position
    turn = np.asarray(goals.pelvis)
    q = np.tile(np.asarray(robot.q0), (len(turn), 1))
    q[:, :3] = np.asarray(goals.root) - turn @ hips
    q[:, 3:7] = Rotation.from_matrix(turn @ rotation).as_quat(scalar_first=True)
    return jnp.asarray(q, robot.q0.dtype)


def bounds_of(robot: Robot, acceleration: Float[Array, " nv"], dt: float) -> Bounds:
    """What joints may do in the plan: a little less than they can, so that the last pass has room."""
    lower, upper = robot.position_lower, robot.position_upper
    inset = jnp.minimum(_INSET, 0.01 * (upper - lower))
    return Bounds(
        lower=lower + inset,
        upper=upper - inset,
        step=_SHARE * robot.velocity_limit * dt,
        change=_SHARE * acceleration * dt**2,
    )
