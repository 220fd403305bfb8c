"""What one configuration has to do with one frame's goals: residuals, their Jacobians and weights."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._home import home_kinematics
from .._joint_selection import scalar_layout
from ..collision._scene import separation_jacobian
from ..kinematics import Kinematics, forward_kinematics, frame_jacobians
from ..kinematics._rigid import cross, rotate
from ..limits import CollisionAvoidanceLimit
from ..robot import Robot
from ..tasks._rotation import dot, rotation_log
from ._goals import Goals, Weights
from ._person import LIMBS
from ._profile import Place, Profile

_SHORTEST = 1e-6
_PAIRS = 12


class Body(eqx.Module):
    """A robot with its profile, in the form that is computed with.

    Attributes:
        robot: the robot.
        offsets: of each place in its frame [m]. (places, 3)
        radii: of the capsules but the feet's, which have their corners [m]. (capsules,)
        apart: what keeps shapes apart; None: nothing does.
        home: how pelvis, chest and feet are turned at home, where the person's axes are the world's. (4, 3, 3)
        frames: of each place: keypoints, pelvis, torso, feet, corners, both ends of each of these capsules (static).
        keys: the role of each keypoint (static).
        bends: whether the trunk bends (static).
    """

    robot: Robot
    offsets: Float[Array, "places 3"]
    radii: Float[Array, " capsules"]
    apart: CollisionAvoidanceLimit | None
    home: Float[Array, "4 3 3"]
    frames: tuple[str, ...] = eqx.field(static=True)
    keys: tuple[str, ...] = eqx.field(static=True)
    bends: bool = eqx.field(static=True)

    @classmethod
    def of(cls, robot: Robot, profile: Profile, apart: CollisionAvoidanceLimit | None) -> Body:
        """The robot with this profile."""
        origin = (0.0, 0.0, 0.0)
        places: list[Place] = list(profile.keypoints.values())
        places += [(profile.pelvis, origin), (profile.torso or profile.pelvis, origin)]
        places += [(profile.feet[side].frame, origin) for side in ("left", "right")]
        places += profile.corners
        turned = [frame for frame, _ in places[len(profile.keypoints) : len(profile.keypoints) + 4]]
        feet = {robot.tree.frame_bodies[robot.tree.frame(foot.frame)] for foot in profile.feet.values()}
        above = [c for c in profile.capsules if robot.tree.frame_bodies[robot.tree.frame(c.frame)] not in feet]
        for capsule in above:
            places += [(capsule.frame, capsule.start), (capsule.frame, capsule.end)]
        return cls(
            robot=robot,
            offsets=jnp.array([point for _, point in places], robot.q0.dtype),
            radii=jnp.array([capsule.radius for capsule in above], robot.q0.dtype),
            apart=apart,
            home=home_kinematics(robot).frame_poses(robot, turned)[1],
            frames=tuple(frame for frame, _ in places),
            keys=tuple(profile.keypoints),
            bends=profile.torso is not None,
        )


class Rows(NamedTuple):
    """Residuals with their Jacobians; what is minimised is half the weighted sum of squares."""

    residual: Float[Array, " m"]
    jacobian: Float[Array, "m nv"]
    weight: Float[Array, " m"]


class Stance(NamedTuple):
    """Where heels and toes are in the plane of the floor."""

    point: Float[Array, "4 2"]
    jacobian: Float[Array, "4 2 nv"]


class FrameRows(NamedTuple):
    """What one frame asks for: wishes, bounds that have to hold, and where heels and toes are."""

    soft: Rows
    stiff: Rows
    stance: Stance


class Bounds(NamedTuple):
    """What joints may do. (nv,) each.

    Attributes:
        lower: end of the range [rad or m], -inf where there is none.
        upper: the other end.
        step: greatest change from one frame to the next [rad or m].
        change: greatest change of that from frame to frame [rad or m].
    """

    lower: Float[Array, " nv"]
    upper: Float[Array, " nv"]
    step: Float[Array, " nv"]
    change: Float[Array, " nv"]


def frame_rows(body: Body, q: Float[Array, " nq"], goals: Goals, weights: Weights, bounds: Bounds) -> FrameRows:
    """All rows of one frame, and its standing points."""
    robot = body.robot
    kinematics = forward_kinematics(robot, q)
    names = tuple(dict.fromkeys(body.frames))
    index = np.array([names.index(name) for name in body.frames])
    positions, rotations = kinematics.frame_poses(robot, names)
    jacobians = frame_jacobians(robot, kinematics, names)
    arms = rotate(rotations[index], body.offsets)
    points = positions[index] + arms
    turning = jacobians[index, 3:]
    moving = jacobians[index, :3] + cross(turning, arms[:, :, None], along=-2)
    place = _Places(points, moving, rotations[index], turning)
    k = len(body.keys)
    corners = slice(k + 4, k + 12)
    soft = [
        _limbs(place, body.keys, goals, weights),
        _turn(place, k, dot(goals.pelvis, body.home[0]), weights.pelvis),
        _root(place, body.keys, goals, weights),
        *(_turn(place, k + 2 + i, dot(goals.feet[i], body.home[2 + i]), weights.foot) for i in range(2)),
        _posture(robot, q, weights),
    ]
    if body.bends:
        soft.append(_turn(place, k + 1, dot(goals.torso, body.home[1]), weights.torso))
    stiff = [
        _soles(points[corners, 2], moving[corners, 2], goals.contact, weights.stance),
        _ranges(robot, q, weights, bounds),
    ]
    if len(body.radii):
        stiff.append(_floor(points[k + 12 :, 2], moving[k + 12 :, 2], jnp.repeat(body.radii, 2), weights.stance))
    if body.apart is not None:
        stiff.append(_apart(body, kinematics, weights))
    means = (points[corners].reshape(4, 2, 3).mean(1), moving[corners].reshape(4, 2, 3, -1).mean(1))
    return FrameRows(_stacked(soft), _stacked(stiff), Stance(means[0][:, :2], means[1][:, :2]))


def _stacked(parts: list[Rows]) -> Rows:
    return Rows(*(jnp.concatenate(column) for column in zip(*parts, strict=True)))


class _Places(NamedTuple):
    """Points, how they move, and the frames that they are fixed to."""

    points: Float[Array, "k 3"]
    moving: Float[Array, "k 3 nv"]
    rotations: Float[Array, "k 3 3"]
    turning: Float[Array, "k 3 nv"]


def _limbs(place: _Places, keys: tuple[str, ...], goals: Goals, weights: Weights) -> Rows:
    """Direction of each limb less the person's: ``d - u``, with ``d' = (I - d d^T) / length (J_b - J_a)``."""
    first, second = (np.array([keys.index(limb[i]) for limb in LIMBS]) for i in range(2))
    across = place.points[second] - place.points[first]
    length = jnp.maximum(jnp.linalg.norm(across, axis=-1, keepdims=True), _SHORTEST)
    direction = across / length
    rate = (place.moving[second] - place.moving[first]) / length[..., None]
    rate = rate - direction[:, :, None] * jnp.sum(direction[:, :, None] * rate, 1, keepdims=True)
    residual = (direction - goals.directions).ravel()
    return Rows(residual, rate.reshape(-1, rate.shape[-1]), jnp.full(residual.shape, weights.limb))


def _turn(place: _Places, i: int, wanted: Float[Array, "3 3"], weight: Float[Array, ""]) -> Rows:
    """The rotation vector from the wanted axes to a frame's."""
    return Rows(rotation_log(dot(place.rotations[i], wanted.T)), place.turning[i], jnp.full(3, weight))


def _root(place: _Places, keys: tuple[str, ...], goals: Goals, weights: Weights) -> Rows:
    hips = np.array([keys.index("left_hip"), keys.index("right_hip")])
    return Rows(place.points[hips].mean(0) - goals.root, place.moving[hips].mean(0), weights.root)


def _soles(
    height: Float[Array, "8"], rate: Float[Array, "8 nv"], contact: Float[Array, "4"], weight: Float[Array, ""]
) -> Rows:
    """Corners that stand are at height 0, the others not below."""
    stands = jnp.repeat(contact, 2) > 0.5
    return Rows(height, rate, jnp.where(stands | (height < 0.0), weight, 0.0))


def _floor(
    height: Float[Array, " k"], rate: Float[Array, "k nv"], radius: Float[Array, " k"], weight: Float[Array, ""]
) -> Rows:
    """Ends of capsules not below the floor."""
    gap = height - radius
    return Rows(gap, rate, jnp.where(gap < 0.0, 0.1 * weight, 0.0))


def _posture(robot: Robot, q: Float[Array, " nq"], weights: Weights) -> Rows:
    """Joints near home."""
    dofs, position, jacobian = _joints(robot, q)
    home = _joints(robot, robot.q0)[1]
    return Rows(position - home, jacobian, jnp.full(len(dofs), weights.posture))


def _ranges(robot: Robot, q: Float[Array, " nq"], weights: Weights, bounds: Bounds) -> Rows:
    """Joints inside their ranges."""
    dofs, position, jacobian = _joints(robot, q)
    outside = position - jnp.clip(position, bounds.lower[dofs], bounds.upper[dofs])
    return Rows(outside, jacobian, jnp.where(outside != 0.0, weights.limit, 0.0))


def _joints(robot: Robot, q: Float[Array, " nq"]) -> tuple[np.ndarray, Array, Array]:
    """The dofs that are hinges or slides, where they are, and their rows of the identity."""
    scalar, index = scalar_layout(robot)
    dofs = np.flatnonzero(scalar)
    return dofs, q[index[dofs]], jnp.eye(robot.nv, dtype=q.dtype)[dofs]


def _apart(body: Body, kinematics: Kinematics, weights: Weights) -> Rows:
    """The pairs of shapes that are nearest, where they are nearer than the margin."""
    assert body.apart is not None
    near = body.apart._nearest(body.robot, kinematics)
    nearest_ones = jax.lax.top_k(-near.distance, min(_PAIRS, len(near.distance)))[1]
    near = jax.tree.map(lambda a: a[nearest_ones], near)
    bodies = jnp.asarray(body.apart.scene.pair_bodies)[nearest_ones]
    rate = separation_jacobian(body.robot.tree, kinematics, near, bodies)
    gap = near.distance - weights.margin
    return Rows(gap, rate, jnp.where(gap < 0.0, weights.apart, 0.0))
