"""Cost terms of one frame: residuals, Jacobians and weights of its goals at a configuration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..collision._distance import _across, _parameters, _rounded, _segment_parameters
from ..kinematics import Kinematics, forward_kinematics
from ..kinematics._forward import home_kinematics, independent_columns
from ..kinematics._rigid import cross, rotate
from ..robot import Robot
from ..robot._joint_selection import scalar_layout
from ..tasks._rotation import dot, rotation_log
from ._balance import mass_fractions, overhang
from ._facing import facing_at_home
from ._goals import Goals, Weights
from ._profile import Limb, Place, Profile, world_points
from ._roles import SIDES, chain

# Guard of a limb's direction: a shorter limb [m] has none.
SHORTEST = 1e-6
ORIGIN = "origin"
"""The world's origin as the first point of a reach: the second follows a path in the world."""
# Length of a standing leg over its stretched length, for robots whose legs are straight at home.
STANDING_SHARE = 0.85
# Pairs of capsules that get rows; the nearest ones are chosen in each iteration.
PAIRS = 12
CLEARANCE, SWINGING = 3e-3, 2e-3
"""Height that swinging soles keep above the floor [m], and the weight of this relative to contacts."""


class Body(eqx.Module):
    """Robot with its profile as arrays for the cost terms."""

    robot: Robot  # the robot
    offsets: Float[Array, "places 3"]  # position of each place in its frame [m]
    radii: Float[Array, " capsules"]  # radii of the capsules [m]
    # rotation matrices of pelvis, chest and feet at home, relative to the robot's forward, left and up axes
    home: Float[Array, "4 3 3"]
    lengths: Float[Array, " reaches"]  # nominal lengths of the reaches [m]
    rises: Float[Array, " corners"]  # heights of the corners above the floor in contact: radii of round feet [m]
    inside: Float[Array, ""] | None  # margin of the centre of mass inside the support polygon [m]; None: not bounded
    # frame of each place: keypoints, pelvis, torso, feet, corners, both ends of each capsule (static)
    frames: tuple[str, ...] = eqx.field(static=True)
    keys: tuple[str, ...] = eqx.field(static=True)  # the role of each keypoint (static)
    # first and second keypoint of each limb that is followed, the reaches last (static)
    limbs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    # indices into ``home`` of the orientations that are followed (static)
    turned: tuple[int, ...] = eqx.field(static=True)
    # the two places whose midpoint follows the root's path; empty if the base is fixed (static)
    roots: tuple[int, ...] = eqx.field(static=True)
    # number of the feet's corners: 8, or 0 without feet or with a fixed base (static)
    corners: int = eqx.field(static=True)
    rolls: bool = eqx.field(static=True)  # whether points in contact may move along the floor (static)
    # capsules kept above the floor: not the feet's, which have corners, nor capsules inside others (static)
    above: tuple[int, ...] = eqx.field(static=True)
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)  # pairs of capsules that are kept apart (static)

    @classmethod
    def of(
        cls,
        robot: Robot,
        profile: Profile,
        pairs: Sequence[tuple[int, int]],
        inside: float | None = None,
        touching: Sequence[Limb] = (),
    ) -> Body:
        """Return the arrays for a robot and a profile; capsules of ``pairs`` are kept apart.

        Balance keeps the margin ``inside`` [m]. Reaches ``touching``, of length 1 m, come after those of the profile;
        they may begin at ``ORIGIN``.
        """
        points = dict(profile.keypoints)
        if touching:
            points[ORIGIN] = robot.tree.body_names[0], (0.0, 0.0, 0.0)
        keys, free = tuple(points), robot.floating_base
        corners = profile.corners if free else ()
        places: list[Place] = [*points.values(), *((frame, (0.0, 0.0, 0.0)) for frame in profile.turned)]
        places += corners
        for capsule in profile.capsules:
            places += [(capsule.frame, capsule.start), (capsule.frame, capsule.end)]
        tree, capsules = robot.tree, profile.capsules
        feet = {tree.frame_bodies[tree.frame(foot.frame)] for foot in profile.feet.values()}
        outer = [i for i, own in enumerate(capsules) if not any(wider.hides(own) for wider in capsules)]
        above = [i for i in outer if tree.frame_bodies[tree.frame(capsules[i].frame)] not in feet]
        flat = [2 + i for i, side in enumerate(SIDES) if side in profile.feet and not profile.feet[side].radius]
        turned = [*([0] if free else []), *(flat if profile.walks else []), *([] if profile.torso is None else [1])]
        hips = (keys.index("left_hip"), keys.index("right_hip")) if profile.walks else (len(keys), len(keys))
        at_home = home_kinematics(robot)
        home = at_home.frame_poses(robot, profile.turned)[1]
        lengths = [*(reach_length(robot, profile, limb) for limb in profile.reached), *(1.0 for _ in touching)]
        return cls(
            robot=robot,
            offsets=jnp.array([point for _, point in places], robot.q0.dtype),
            radii=jnp.array([capsule.radius for capsule in profile.capsules], robot.q0.dtype),
            home=jnp.asarray(facing_at_home(robot, profile.across).T, home.dtype) @ home,
            lengths=jnp.array(lengths, robot.q0.dtype),
            rises=jnp.array(profile.rises[: len(corners)], robot.q0.dtype),
            inside=None if inside is None else jnp.asarray(inside, robot.q0.dtype),
            frames=tuple(frame for frame, _ in places),
            keys=keys,
            limbs=tuple((keys.index(a), keys.index(b)) for a, b in (*profile.followed, *touching)),
            turned=tuple(turned),
            roots=hips if free else (),
            corners=len(corners),
            rolls=profile.rolls,
            above=tuple(above if free else ()),
            pairs=tuple((int(i), int(j)) for i, j in pairs),
        )


def reach_length(robot: Robot, profile: Profile, limb: Limb) -> float:
    """Return the nominal length of a reach [m]: that at home, at most ``STANDING_SHARE`` of the stretched limb."""
    known = [profile.keypoints[role] for role in chain(limb) if role in profile.keypoints]
    points = world_points(robot, home_kinematics(robot), known)
    stretched = float(np.linalg.norm(np.diff(points, axis=0), axis=-1).sum())
    bent = min(float(np.linalg.norm(points[-1] - points[0])), STANDING_SHARE * stretched)
    return stretched if profile.is_hand else bent


class Joints(NamedTuple):
    """Residuals and weights of single hinges and slides: of goals (soft) and of bounds (stiff). (nv,) each."""

    soft: Float[Array, " nv"]
    soft_weight: Float[Array, " nv"]
    stiff: Float[Array, " nv"]
    stiff_weight: Float[Array, " nv"]


class FrameRows(NamedTuple):
    """Cost terms of one frame; the cost is half the weighted sum of squared residuals."""

    residual: Float[Array, " m"]  # residuals of goals and bounds
    jacobian: Float[Array, "m nv"]  # derivative of ``residual``
    soft: Float[Array, " m"]  # weights of goals, 0 in the rows of bounds
    stiff: Float[Array, " m"]  # weights of bounds, 0 in the rows of goals
    joints: Joints  # terms of single joints
    stance: Float[Array, "8"]  # x and y of the four points of ``Profile.standing`` [m], 0 without feet
    stance_jacobian: Float[Array, "8 nv"]  # derivative of ``stance``


class Bounds(NamedTuple):
    """Joint bounds of a plan. (nv,) each."""

    lower: Float[Array, " nv"]  # lower end of the range [rad or m], -inf without one
    upper: Float[Array, " nv"]  # upper end of the range [rad or m], inf without one
    step: Float[Array, " nv"]  # largest change per frame [rad or m]
    change: Float[Array, " nv"]  # largest change of that step between two frames [rad or m]


class _Motion(NamedTuple):
    """Velocity of the bodies per unit rate of each dof, taken at a common origin.

    A direction n at a point p of a body has the rate ``n . (linear + angular x (p - origin))`` for a dof that moves the
    body.
    """

    origin: Float[Array, "3"]
    columns: Float[Array, "nvfull 6"]

    @classmethod
    def of(cls, robot: Robot, kinematics: Kinematics) -> _Motion:
        origin = kinematics.body_position[robot.tree.root]
        linear = kinematics.dof_linear + cross(kinematics.dof_anchor - origin, kinematics.dof_angular)
        return cls(origin, jnp.concatenate([linear, kinematics.dof_angular], -1))

    def rates(self, moves: Array | np.ndarray, direction: Float[Array, "m 3"], point: Float[Array, "m 3"]) -> Array:
        """Return the rates of points along directions; ``moves`` marks the dofs that move each point. (m, nvfull)."""
        return self._times(moves, jnp.concatenate([direction, cross(point - self.origin, direction)], -1))

    def turns(self, moves: Array | np.ndarray, axis: Float[Array, "m 3"]) -> Array:
        """Return the angular rates about axes. (m, nvfull)."""
        return self._times(moves, jnp.concatenate([jnp.zeros_like(axis), axis], -1))

    def _times(self, moves, wrench: Float[Array, "m 6"]) -> Array:
        return jnp.where(moves, jnp.matmul(wrench, self.columns.T, precision="highest"), 0.0)


class _Rows(NamedTuple):
    """Rows of a frame: residuals, derivatives by all dofs of the model, and weights."""

    residual: Float[Array, " m"]
    rates: Float[Array, "m nvfull"]
    weight: Float[Array, " m"]


def _joined(rows: Sequence[_Rows]) -> _Rows:
    return _Rows(*(jnp.concatenate(column) for column in zip(*rows, strict=True)))


def frame_rows(body: Body, q: Float[Array, " nq"], goals: Goals, weights: Weights, bounds: Bounds) -> FrameRows:
    """Return all cost terms of one frame, and its contact points."""
    robot = body.robot
    kinematics = forward_kinematics(robot, q)
    k, first = len(body.keys), len(body.keys) + 4 + body.corners
    points, rotations, moves = _placed(body, kinematics)
    place = _Places(points, rotations[k : k + 4], moves, _Motion.of(robot, kinematics))
    turns = (goals.pelvis, weights.pelvis), (goals.torso, weights.torso), *((foot, weights.foot) for foot in goals.feet)
    soft = [_limbs(place, body, goals, weights)]
    soft += [_root(place, body.roots, goals, weights)] if body.roots else []
    soft += [_turn(place, k, i, dot(turns[i][0], body.home[i]), turns[i][1]) for i in body.turned]
    corners = slice(k + 4, first)
    stiff = [_soles(place, corners, body.rises, goals.contact, weights.stance)] if body.corners else []
    if body.above:
        stiff.append(_floor(place, first, body, weights.stance))
    if body.pairs:
        stiff.append(_apart(place, first, body, weights))
    if body.inside is not None:
        stiff.append(_balanced(place, corners, kinematics, robot, goals.contact, body.inside, weights.balance))
    wishes = _joined(soft)
    needs = _joined(stiff) if stiff else jax.tree.map(lambda row: row[:0], wishes)
    stance, along = jnp.zeros(8, q.dtype), jnp.zeros((8, wishes.rates.shape[1]), q.dtype)
    if body.corners:
        stance, along = _stance(place, corners)
    rates = independent_columns(robot.tree, jnp.concatenate([wishes.rates, needs.rates, along]))
    return FrameRows(
        residual=jnp.concatenate([wishes.residual, needs.residual]),
        jacobian=rates[:-8],
        soft=jnp.concatenate([wishes.weight, jnp.zeros_like(needs.weight)]),
        stiff=jnp.concatenate([jnp.zeros_like(wishes.weight), needs.weight]),
        joints=_joints(robot, q, weights, bounds),
        stance=stance,
        stance_jacobian=rates[-8:],
    )


def soles(body: Body, kinematics: Kinematics) -> tuple[Float[Array, "8 3"], Float[Array, "8 3 nv"]]:
    """Return the lowest points of the soles' corners in the world [m], and their derivatives."""
    robot, first = body.robot, len(body.keys) + 4
    points, _, moves = _placed(body, kinematics, slice(first, first + 8))
    points = points.at[:, 2].add(-body.rises)
    axes = jnp.tile(jnp.eye(3, dtype=points.dtype), (8, 1))
    rates = _Motion.of(robot, kinematics).rates(np.repeat(moves, 3, 0), axes, jnp.repeat(points, 3, 0))
    return points, independent_columns(robot.tree, rates).reshape(8, 3, -1)


def _placed(
    body: Body, kinematics: Kinematics, part: slice = slice(None)
) -> tuple[Float[Array, "k 3"], Float[Array, "k 3 3"], np.ndarray]:
    """Return places in the world [m], the rotations of their frames, and the dofs that move their bodies."""
    frames, tree = body.frames[part], body.robot.tree
    names = tuple(dict.fromkeys(frames))
    index = np.array([names.index(name) for name in frames])
    positions, rotations = kinematics.frame_poses(body.robot, names)
    points = positions[index] + rotate(rotations[index], body.offsets[part])
    return points, rotations[index], tree.moves[np.array([tree.frame_bodies[tree.frame(name)] for name in frames])]


class _Places(NamedTuple):
    """World points, orientations of trunk and feet, and the dofs that move each point's body."""

    points: Float[Array, "k 3"]
    rotations: Float[Array, "4 3 3"]
    moves: np.ndarray
    motion: _Motion


def _limbs(place: _Places, body: Body, goals: Goals, weights: Weights) -> _Rows:
    """Return the error of each limb's direction, ``d - u``, with ``d' = (I - d d^T) / length (J_b - J_a)``.

    A reach has the vector over its nominal length in place of d, with ``d' = (J_b - J_a) / length``.
    """
    first, second = (np.array([limb[i] for limb in body.limbs]) for i in range(2))
    across = place.points[second] - place.points[first]
    reaches = body.lengths.shape[-1]
    length = jnp.linalg.norm(across, axis=-1)
    length = length.at[len(length) - reaches :].set(body.lengths) if reaches else length
    length = jnp.maximum(length, SHORTEST)[:, None]
    direction = across / length
    directed = (np.arange(len(first)) < len(first) - reaches)[:, None, None]
    sideways = jnp.eye(3, dtype=length.dtype) - directed * direction[:, :, None] * direction[:, None]
    sideways = (sideways / length[..., None]).reshape(-1, 3)
    ends = [place.motion.rates(place.moves[i], sideways, place.points[i]) for i in (first.repeat(3), second.repeat(3))]
    residual = (direction - goals.directions).ravel()
    weight = jnp.concatenate([jnp.ones(len(first) - reaches, residual.dtype), goals.held])
    return _Rows(residual, ends[1] - ends[0], weights.limb * jnp.repeat(weight, 3))


def _turn(place: _Places, first: int, i: int, wanted: Float[Array, "3 3"], weight: Float[Array, ""]) -> _Rows:
    """Return the rows of an orientation: the rotation vector from the wanted axes to the frame's axes [rad]."""
    axes = jnp.eye(3, dtype=wanted.dtype)
    rates = place.motion.turns(place.moves[np.full(3, first + i)], axes)
    return _Rows(rotation_log(dot(place.rotations[i], wanted.T)), rates, jnp.full(3, weight))


def _root(place: _Places, roots: tuple[int, ...], goals: Goals, weights: Weights) -> _Rows:
    both, axes = np.repeat(roots, 3), jnp.tile(0.5 * jnp.eye(3, dtype=place.points.dtype), (2, 1))
    rates = place.motion.rates(place.moves[both], axes, place.points[both]).reshape(2, 3, -1).sum(0)
    return _Rows(place.points[np.array(roots)].mean(0) - goals.root, rates, weights.root)


def _heights(place: _Places, some: slice | np.ndarray) -> tuple[Array, Array]:
    """Return the heights of points [m] and their rates."""
    points = place.points[some]
    up = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0], points.dtype), points.shape)
    return points[:, 2], place.motion.rates(place.moves[some], up, points)


def _soles(place: _Places, corners: slice, rises: Array, contact: Float[Array, "4"], weight: Float[Array, ""]) -> _Rows:
    """Return the rows of the sole corners: height 0 in contact, at least a clearance otherwise.

    Corners without contact weigh less, because their rows switch on and off between iterations; so a swinging foot may
    come a little nearer to the floor than the clearance.
    """
    height, rates = _heights(place, corners)
    stands = jnp.repeat(contact, 2) > 0.5
    gap = height - rises - jnp.where(stands, 0.0, CLEARANCE)
    return _Rows(gap, rates, jnp.where(stands, weight, jnp.where(gap < 0.0, SWINGING * weight, 0.0)))


def _stance(place: _Places, corners: slice) -> tuple[Array, Array]:
    """Return x and y of the midpoints of heels and toes [m], and their rates. (8,), (8, nvfull)."""
    points = place.points[corners].reshape(4, 2, 3).mean(1)
    axes = jnp.tile(jnp.eye(3, dtype=points.dtype)[:2], (4, 1))
    moves = np.repeat(place.moves[corners][::2], 2, 0)
    return points[:, :2].ravel(), place.motion.rates(moves, axes, jnp.repeat(points, 2, 0))


def _floor(place: _Places, first: int, body: Body, weight: Float[Array, ""]) -> _Rows:
    """Return the rows that keep the ends of capsules above the floor."""
    above = np.array(body.above)
    height, rates = _heights(place, first + np.stack([2 * above, 2 * above + 1], 1).ravel())
    gap = height - jnp.repeat(body.radii[above], 2) - CLEARANCE
    return _Rows(gap, rates, jnp.where(gap < 0.0, SWINGING * weight, 0.0))


def _balanced(
    place: _Places,
    corners: slice,
    kinematics: Kinematics,
    robot: Robot,
    contact: Float[Array, "4"],
    inside: Float[Array, ""],
    weight: Float[Array, ""],
) -> _Rows:
    """Return the row that keeps the centre of mass inside the support polygon; its weight is 0 in single support.

    The derivative leaves out the change of the direction: the distance is a maximum over directions, so that to first
    order it does not depend on it.
    """
    fractions = mass_fractions(robot)[:, None]
    centers = kinematics.body_position + rotate(kinematics.body_rotation, robot.body_com)
    at, both = jnp.sum(fractions * centers, 0), jnp.max(contact[:2]) * jnp.max(contact[2:]) > 0.5
    # in single support all corners count, which keeps the numbers of the unused row finite
    stands = jnp.where(both, jnp.repeat(contact > 0.5, 2), 1.0)
    found = overhang(at[:2], place.points[corners][:, :2], stands)
    direction = jnp.append(found.direction, 0.0)
    parts = [place.motion.rates(robot.tree.moves, fractions * direction, centers)]
    coefficients = found.coefficients[:, None]
    parts.append(place.motion.rates(place.moves[corners], -coefficients * direction, place.points[corners]))
    gap = found.distance + jnp.minimum(inside, found.width / 3.0)
    rates = jnp.concatenate(parts).sum(0, keepdims=True)
    return _Rows(gap[None], rates, jnp.where(both & (gap > 0.0), weight, 0.0)[None])


def _joints(robot: Robot, q: Float[Array, " nq"], weights: Weights, bounds: Bounds) -> Joints:
    """Return the terms of joint positions: near home (soft) and inside ranges (stiff)."""
    scalar, index = scalar_layout(robot)
    position = jnp.where(scalar, q[index], 0.0)
    outside = jnp.where(scalar, position - jnp.clip(position, bounds.lower, bounds.upper), 0.0)
    return Joints(
        soft=jnp.where(scalar, position - robot.q0[index], 0.0),
        soft_weight=jnp.where(scalar, weights.posture, 0.0),
        stiff=outside,
        stiff_weight=jnp.where(outside != 0.0, weights.limit, 0.0),
    )


def _apart(place: _Places, first: int, body: Body, weights: Weights) -> _Rows:
    """Return rows for the nearest pairs of capsules; only pairs closer than the margin have weight."""
    pairs = np.array(body.pairs)
    axes = place.points[first:].reshape(-1, 2, 3)
    start, along = axes[:, 0], axes[:, 1] - axes[:, 0]
    chosen = jax.lax.top_k(-_ways(start - place.motion.origin, along, body.radii, pairs), min(PAIRS, len(pairs)))[1]
    a, b = jnp.asarray(pairs)[chosen].T
    s, t = jax.vmap(_segment_parameters)(along[a], along[b], start[a] - start[b])
    on_a, on_b = start[a] + s[:, None] * along[a], start[b] + t[:, None] * along[b]
    middle = start + 0.5 * along
    sideways = jax.vmap(_across)(along[a], along[b], middle[b] - middle[a])
    near = jax.vmap(_rounded)(on_a, on_b, body.radii[a], body.radii[b], sideways)
    moves = jnp.asarray(place.moves[first::2][pairs])[chosen]
    rates = [place.motion.rates(moves[:, i], near.normal, p) for i, p in enumerate((near.point_a, near.point_b))]
    gap = near.distance - weights.margin
    return _Rows(gap, rates[1] - rates[0], jnp.where(gap < 0.0, weights.apart, 0.0))


def _ways(
    start: Float[Array, "k 3"], along: Float[Array, "k 3"], radii: Float[Array, " k"], pairs: np.ndarray
) -> Float[Array, " pairs"]:
    """Return distances between capsules in single precision [m]: sufficient for a selection, and several times as fast.

    Computed from the products of all vectors with all, which for a batch of frames is one matrix product.
    """
    vectors = jnp.concatenate([along, start]).astype(jnp.float32)
    products, (a, b), k = dot(vectors, vectors.T), pairs.T, len(along)
    aa, bb, ab = products[a, a], products[b, b], products[a, b]
    ao, bo = products[a, k + a] - products[a, k + b], products[b, k + a] - products[b, k + b]
    oo = products[k + a, k + a] + products[k + b, k + b] - 2.0 * products[k + a, k + b]
    s, t = _parameters(aa, bb, ab, ao, bo)
    square = oo + s * (s * aa + 2.0 * (ao - t * ab)) + t * (t * bb - 2.0 * bo)
    return jnp.sqrt(jnp.maximum(square, 0.0)) - (radii[a] + radii[b]).astype(jnp.float32)
