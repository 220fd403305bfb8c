"""Profile inferred from a robot's kinematic tree: legs, arms, knees, elbows, feet and capsules."""

from __future__ import annotations

import dataclasses
import itertools
import re

import mujoco
import numpy as np

from .._errors import OsikValueError, warn
from ..kinematics import Kinematics
from ..kinematics._forward import home_kinematics
from ..physics._world import contact_corners, sole_points
from ..robot import Robot
from ..robot._guesses import find_feet
from ..robot._mujoco import own_masses
from ..robot._tree import BALL, FREE, HINGE
from ..robot.loading._poses import rotation_matrix
from ._facing import by_name, facing_x
from ._hand import guess_hand
from ._limbs import ORIGIN, Chain, Limb, base_body, find_arm, find_chains, find_leg
from ._link_shapes import by_inertia, by_shapes, is_credible, shrunk
from ._places import JOINTS_APART, joints_between
from ._profile import Capsule, Foot, Place, Point, Profile, in_frame, world_points
from ._roles import CHAINS, FINGERS, LEGS, LIMBS, NEEDED, SIDES
from ._skeletons import shortened

# A foot without shapes, as shares of half the leg (ankle height: of the leg); the heel's share of its length.
_FOOT_LENGTH, _FOOT_WIDTH, _FOOT_HEIGHT, _HEEL = 0.36, 0.12, 0.08, 0.3
# Radii of capsules without inertias, as shares of the segment's length (trunk: of the shoulders' width), and the
# length of a hand as a share of the forearm.
_LEG_RADIUS, _ARM_RADIUS, _TRUNK_RADIUS = 0.18, 0.18, 0.3
_HAND = 0.6
_NO_ARM = r"head|neck|camera|wheel|caster|laser|antenna|tail"
"""Names of bodies at the ends of what is no arm."""
_LEAST_ARM = 4
"""Joints that two bodies have in common where they belong to one arm, at least: a trunk has three at most."""
_ARMS = ("left_arm", "right_arm")
_LEAST_MASS, _LEAST_SIZE, _THINNEST, _WIDE, _LONG, _SHELL = 3e-3, 1e-3, 0.1, 1.6, 1.15, 1.2
"""Thresholds of capsules: least link mass (share of the robot's), least half thickness [m] and least thickness over
length, width over thickness above which a trunk gets two capsules, and capsule length and radius over the inertia
ellipsoid's.
"""
# Gap that capsules have at home [m]: above the margin of ``Weights`` (5 mm), which would push them apart there.
_ROOM = 6e-3


def guess_profile(robot: Robot) -> Profile:
    """Return the profile of a robot with limbs of a person, as its tree and its home configuration show it.

    Feet are found by name (``foot``, ``sole``, ``ankle``, ``toe``), arms as the bodies that reach farthest to the
    sides. A knee or elbow is the joint that bends its limb far from both ends. A wrist is the last joint that moves
    the whole hand; if that is the elbow, the wrist is a fixed hand frame, or the far end of the link's mesh or
    mass. Soles are corner frames (``NAME_corner_0`` and so on), boxes or spheres of the feet; a foot without them
    gets a length after its leg, or is a point where no joint moves it beside the shank. Check the profile, and save
    it with ``save_profile`` to edit it.

    A robot may lack legs or arms, and its arms may end at the elbow. With a fixed base its limbs follow the
    person's beside the trunk. A free base stands on two feet, on four, or on wheels (bodies called ``wheel`` or
    ``caster``). On four feet, legs follow those of a person or an animal on all fours; where there are arms too,
    these follow and the feet stay where they are. An ``OsikWarning`` says what is found where that is not two legs
    and two arms (``describe_profile``). A hand with a fixed base has fingers instead of limbs.

    Raises:
        ValueError: neither two legs nor two arms are found, or a free base has neither feet nor wheels.
    """
    tree = robot.tree
    hand = guess_hand(robot)
    if hand is not None:
        warn(f"a profile is guessed: {describe_profile(robot, hand)}")
        return hand
    robot, kinematics, feet = _facing_feet(robot)
    bodies = [tree.frame_bodies[tree.frame(name)] for name in feet.values()]
    legs = dict(zip(feet, find_chains(robot, kinematics, bodies), strict=True))
    arms = _arms(robot, kinematics, {body for leg in legs.values() for body in leg.bodies})
    if not (arms or legs):
        raise OsikValueError(
            "neither two arms nor legs of a person are found. A robot that is bolted down needs two arms, one to the "
            "left and one to the right at home (x forward, y left); one with legs has to be loaded with "
            "floating_base=True. Else give a profile"
        )
    keypoints: dict[str, Place] = {}
    found: dict[str, Limb] = {name: find_arm(robot, kinematics, arm) for name, arm in arms.items()}
    for name, leg in legs.items() if len(legs) == 2 or not arms else ():
        found[name] = find_leg(robot, kinematics, leg, feet[name], pointed=len(legs) == 4)
    for name, limb in found.items():
        side, part = name.split("_")[0], "arm" if name in arms or name.endswith("_front") else "leg"
        places = zip(CHAINS[part], limb, strict=True)
        keypoints |= {f"{side}_{role}": place for role, place in places if place is not None}
    soles = {name: _foot(robot, kinematics, feet[name], leg, found.get(name)) for name, leg in legs.items()}
    if robot.floating_base and not legs:
        soles = _wheels(robot, kinematics)
    profile = Profile(
        keypoints=dict(sorted(keypoints.items())),
        pelvis=tree.frame_names[tree.frame_bodies.index(base_body(robot))],
        torso=_torso(robot, list(arms.values())),
        feet=soles if robot.floating_base else {},
        rolls=robot.floating_base and not legs,
    )
    profile = dataclasses.replace(profile, capsules=_capsules(robot, kinematics, profile))
    if set(profile.keypoints) != set(NEEDED):
        warn(f"a profile is guessed: {describe_profile(robot, profile)}")
    return profile


def describe_profile(robot: Robot, profile: Profile) -> str:
    """Say in words what of a person the robot's profile has, what it lacks, and which joints follow nothing."""
    tree, parts = robot.tree, _fingers_found(profile) if profile.is_hand else _limbs_found(profile)
    if not robot.floating_base:
        parts.append("the base is fixed")
    else:
        parts.append("wheels that roll anywhere" if profile.rolls else f"{len(profile.feet)} feet")
        parts += [] if profile.walks or profile.rolls else ["the feet stay where they are"]
    if not profile.is_hand:
        parts.append("a trunk that does not turn" if profile.torso is None else f"a trunk that turns {profile.torso}")
    bodies = [tree.frame_bodies[tree.frame(frame)] for frame in profile.frames]
    moved = set(np.flatnonzero(tree.descendants[:, bodies].any(1)).tolist())
    idle = [
        name
        for name, body, kind in zip(tree.joint_names, tree.joint_bodies, tree.joint_types, strict=True)
        if kind != FREE and body not in moved and name in robot.joint_names
    ]
    return "; ".join(parts) + (f"; joints that move nothing of it stay at home: {shortened(idle)}" if idle else "")


def _limbs_found(profile: Profile) -> list[str]:
    """Say how far each limb goes."""
    parts = []
    for side in SIDES:
        for part, roles in CHAINS.items():
            known = [role for role in roles if f"{side}_{role}" in profile.keypoints]
            ends = [role for role in roles if role not in known]
            end = f" (no {ends[0]})" if ends else ""
            parts.append(f"{side} {part} to the {known[-1]}{end}" if known else f"no {side} {part}")
    return parts


def _fingers_found(profile: Profile) -> list[str]:
    """Say where the tip of each finger is."""
    tips = {finger: profile.keypoints.get(f"{finger}_4") for finger in FINGERS}
    return [f"no {finger}" if tip is None else f"{finger} to {tip[0]}" for finger, tip in tips.items()]


def _facing_feet(robot: Robot) -> tuple[Robot, Kinematics, dict[str, str]]:
    """Return the robot turned to face x, its home kinematics, and its feet by their names in a profile (empty: none).

    Raises:
        ValueError: frames that look like feet are neither two nor four, and the base is free.
    """
    tree = robot.tree
    names = find_feet(zip(tree.frame_names, tree.frame_bodies, strict=True), tree.body_parents)
    kinematics = home_kinematics(robot)
    if not names or (len(names) not in (2, 4) and not robot.floating_base):
        return robot, kinematics, {}
    if len(names) not in (2, 4):
        raise OsikValueError(f"two or four feet are needed, and {len(names)} frames look like some: {', '.join(names)}")

    def at(name: str) -> np.ndarray:
        return np.asarray(kinematics.frame_pose(robot, name)[0])

    lefts = sorted(names, key=lambda name: -at(name)[1])[: len(names) // 2]
    pairs = []
    for left in lefts:
        distances = {other: float(np.linalg.norm(at(other) - at(left))) for other in names if other not in lefts}
        pairs.append(by_name([left, min(distances, key=distances.__getitem__)]))
    robot = facing_x(robot, (pairs[0][0], pairs[0][1]))
    kinematics = home_kinematics(robot)
    out = {}
    for row, pair in zip(("", "_front"), sorted(pairs, key=lambda pair: at(pair[0])[0]), strict=False):
        out |= {f"{side}{row}": name for side, name in zip(SIDES, pair, strict=True)}
    return robot, kinematics, dict(sorted(out.items()))


def _arms(robot: Robot, kinematics: Kinematics, used: set[int]) -> dict[str, Chain]:
    """Return the arms by side: the non-leg bodies that reach farthest to the left and to the right, heads left out.

    A single arm is the right one, of a robot that has legs, a head or wheels.
    """
    tree, position, base = robot.tree, np.asarray(kinematics.body_position), base_body(robot)
    leaves = set(range(2 if robot.floating_base else 1, len(tree.body_parents))) - set(tree.body_parents) - used
    ends = [b for b in sorted(leaves) if re.search(_NO_ARM, tree.body_names[b], re.IGNORECASE) is None]
    if not ends:
        return {}
    left, right = max(ends, key=lambda b: position[b, 1]), min(ends, key=lambda b: position[b, 1])
    # fingers of one hand have an arm in common
    shared = set(np.flatnonzero(tree.descendants[:, left] & tree.descendants[:, right]).tolist()) - {0, base}
    try:
        if len(shared) >= _LEAST_ARM:
            left = right = max(ends, key=lambda b: float(np.linalg.norm(position[b] - position[base])))
        if position[left, 1] > 0.0 > position[right, 1]:
            return dict(zip(_ARMS, find_chains(robot, kinematics, [left, right], 2), strict=True))
        if left == right and (used or len(ends) < len(leaves)):
            return {_ARMS[1]: find_chains(robot, kinematics, [left])[0]}
    except OsikValueError:
        pass  # too few joints: ears, wipers
    return {}


def _torso(robot: Robot, arms: list[Chain]) -> str | None:
    """Return the body that the arms hang from, where a joint turns it; None: there is none."""
    tree = robot.tree
    base = base_body(robot)
    trunk = tree.body_parents[arms[0].bodies[0]] if arms else base
    turning = [j for j, kind in enumerate(tree.joint_types) if kind in (HINGE, BALL) and j not in tree.locked]
    turned = {tree.joint_bodies[joint] for joint in turning} - {0, base}
    return tree.body_names[trunk] if any(tree.descendants[body, trunk] for body in turned) else None


def _wheels(robot: Robot, kinematics: Kinematics) -> dict[str, Foot]:
    """Return the two halves of the rectangle that wheels stand on, at the height of their lowest point, as feet."""
    tree = robot.tree
    wheels = [b for b, name in enumerate(tree.body_names) if re.search(r"wheel|caster", name, re.IGNORECASE)]
    if not wheels:
        raise OsikValueError(
            "nothing holds the robot's base: it has no feet and no wheels that are called so. Load it with "
            "floating_base=False"
        )
    at = np.asarray(kinematics.body_position)[wheels]
    radii = np.zeros(len(wheels))
    for geom, body in enumerate(tree.geom_bodies):
        if body in wheels:
            radii[wheels.index(body)] = max(radii[wheels.index(body)], float(robot.geom_size[geom, 0]))
    root = tree.body_names[tree.root]
    # without shapes, the floor is where the root is: base_footprint and its like
    low = float(
        (at[:, 2] - radii if radii.any() else np.append(at[:, 2], kinematics.frame_pose(robot, root)[0][2])).min()
    )
    rear, front = float(at[:, 0].min()), float(at[:, 0].max())
    wide = float(np.abs(at[:, 1]).max())
    front, rear = (front, rear) if front - rear > wide else (rear + wide, rear - wide)
    feet = {}
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        edges = sorted((0.5 * sign * wide, sign * wide), reverse=True)
        heel, toe = (np.array([[x, y, low] for y in edges]) for x in (rear, front))
        heel, toe = (_pair(in_frame(robot, kinematics, root, end)) for end in (heel, toe))
        feet[side] = Foot(root, heel, toe)
    return feet


def _foot(robot: Robot, kinematics: Kinematics, frame: str, leg: Chain, limb: Limb | None) -> Foot:
    """Return the sole's corners, else those of a foot sized after the leg (at height 0 of a frame called a sole).

    A foot that no joint moves beside the shank is a ball about its frame, as large as the sphere that is there.
    """
    if limb is None or limb.end == (frame, ORIGIN):
        return _ball(robot, kinematics, frame)
    corners = _corners(robot, kinematics, frame)
    if len(corners) >= 4:
        ordered = corners[np.argsort(corners[:, 0])]
        heel, toe = (_pair(part[np.argsort(-part[:, 1])]) for part in (ordered[:2], ordered[-2:]))
        return Foot(frame, heel, toe)
    length = float(np.linalg.norm(np.diff(leg.anchors, axis=0), axis=-1).sum())
    foot, width, height = _FOOT_LENGTH * length / 2, _FOOT_WIDTH * length / 2, _FOOT_HEIGHT * length
    height = 0.0 if "sole" in frame.lower() else height
    rear, front = -_HEEL * foot, (1.0 - _HEEL) * foot
    heel, toe = (_pair(np.array([[x, width, -height], [x, -width, -height]])) for x in (rear, front))
    return Foot(frame, heel, toe)


def _ball(robot: Robot, kinematics: Kinematics, frame: str) -> Foot:
    """Return a round foot: the sphere nearest to a frame on its body, or the frame as a point."""
    balls = [(in_frame(robot, kinematics, frame, at), radius) for at, radius in _spheres(robot, kinematics, frame)]
    at, radius = min(balls, key=lambda ball: float(np.linalg.norm(ball[0])), default=(np.zeros(3), 0.0))
    if np.linalg.norm(at) > 2.0 * radius:
        at, radius = np.zeros(3), 0.0
    point = _pair(np.tile(at, (2, 1)))
    return Foot(frame, point, point, round(radius, 6))


def _spheres(robot: Robot, kinematics: Kinematics, frame: str) -> list[tuple[np.ndarray, float]]:
    """Return the centres [m] in the world and the radii [m] of the spheres of a frame's body."""
    tree, model = robot.tree, robot.mj_model
    body = tree.frame_bodies[tree.frame(frame)]
    turn, origin = np.asarray(kinematics.body_rotation[body]), np.asarray(kinematics.body_position[body])
    return [
        (origin + turn @ np.asarray(robot.geom_position[geom]), float(robot.geom_size[geom, 0]))
        for geom in range(model.ngeom)
        if tree.geom_bodies[geom] == body and model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE
    ]


def _corners(robot: Robot, kinematics: Kinematics, frame: str) -> np.ndarray:
    """Return corner frames, else lower corners of boxes, else lowest points of spheres, in the frame [m]. (k, 3)."""
    for corners in (contact_corners(robot, frame), sole_points(robot, frame)):
        if len(corners):
            return corners
    lowest = [at - [0.0, 0.0, radius] for at, radius in _spheres(robot, kinematics, frame)]
    return in_frame(robot, kinematics, frame, np.array(lowest).reshape(-1, 3))


def _pair(points: np.ndarray) -> tuple[Point, Point]:
    (a, b, c), (d, e, f) = np.round(points, 6).tolist()
    return (a, b, c), (d, e, f)


def _capsules(robot: Robot, kinematics: Kinematics, profile: Profile) -> tuple[Capsule, ...]:
    """Return capsules from the links' inertias; limbs without usable inertias get capsules from joint to joint."""
    tree = robot.tree
    seen = _massive(robot, (profile.pelvis, profile.torso), _frames_of_hands(robot, profile))
    bodies = [tree.frame_bodies[tree.frame(capsule.frame)] for capsule in seen]
    shoulders = [profile.keypoints[f"{side}_shoulder"][0] for side in SIDES if f"{side}_shoulder" in profile.keypoints]

    def is_seen(frame: str, end: str | None) -> bool:
        first = tree.frame_bodies[tree.frame(frame)]
        last = first if end is None else tree.frame_bodies[tree.frame(end)]
        part = tree.descendants[first]
        if end in shoulders and frame not in shoulders:  # the trunk carries both arms
            arms = [tree.frame_bodies[tree.frame(shoulder)] for shoulder in shoulders]
            part = part & tree.descendants[:, arms].all(1)
        elif last != first:  # a limb that ends in its own link has all bodies below that link
            part = part & ~tree.descendants[last]
        return bool(part[bodies].any())

    plain = _plain_capsules(kinematics, profile, robot)
    missing = [capsule for capsule, end in plain if not is_seen(capsule.frame, end)]
    floor = -np.inf
    if profile.corners:
        floor = float((world_points(robot, kinematics, profile.corners)[:, 2] - profile.rises).min())
    return _apart_at_home(robot, kinematics, [*seen, *missing], floor)


def _apart_at_home(robot: Robot, kinematics: Kinematics, capsules: list[Capsule], floor: float) -> tuple[Capsule, ...]:
    """Return capsules thinned where they reach below the soles, with thinner copies where they overlap at home.

    A pair that overlaps at home cannot be kept apart. Thinner copies (down to half the radius) take its place; the full
    capsules still keep other shapes away. A capsule below the soles would lift the feet. If half the radius is still
    too low, the capsule is left out.
    """
    tree, out = robot.tree, []
    bodies = [tree.frame_bodies[tree.frame(c.frame)] for c in capsules]
    ends = [(c.frame, point) for c in capsules for point in (c.start, c.end)]
    axes = world_points(robot, kinematics, ends).reshape(-1, 2, 3) if ends else np.zeros((0, 2, 3))
    share = np.ones(len(capsules))
    for i, j in itertools.combinations(range(len(capsules)), 2):
        if joints_between(robot, bodies[i], bodies[j]) < JOINTS_APART:
            continue
        between = _between(*axes[i], *axes[j]) - _ROOM
        most = between / (capsules[i].radius + capsules[j].radius)
        if 0.5 < most < 1.0:
            share[[i, j]] = np.minimum(share[[i, j]], most)
    for capsule, ends, factor in zip(capsules, axes, share, strict=True):
        above = (min(float(end[2]) for end in ends) - floor - _ROOM) / capsule.radius
        if above > 0.5:
            for most in dict.fromkeys((1.0, float(factor))):
                out.append(dataclasses.replace(capsule, radius=round(min(most, above) * capsule.radius, 6)))
    return tuple(out)


def _between(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> float:
    """Return the distance between two segments a-b and c-d, sampled at 33 points of each [m]."""
    along = np.linspace(0.0, 1.0, 33)[:, None]
    first, second = a + along * (b - a), c + along * (d - c)
    return float(np.linalg.norm(first[:, None] - second[None], axis=-1).min())


def _frames_of_hands(robot: Robot, profile: Profile) -> set[str]:
    """Return the frames moved by the wrists' last joints."""
    tree = robot.tree
    at = {role: tree.frame_bodies[tree.frame(frame)] for role, (frame, _) in profile.keypoints.items()}
    elbows, wrists = ({body for role, body in at.items() if role.endswith(end)} for end in ("elbow", "wrist"))
    hands = np.array(sorted(wrists - elbows), int)  # without a wrist joint the hand belongs to the forearm
    turned = set(np.flatnonzero(tree.descendants[hands].any(0)).tolist())
    return {name for name, body in zip(tree.frame_names, tree.frame_bodies, strict=True) if body in turned}


def _massive(robot: Robot, trunk: tuple[str | None, ...], hands: set[str]) -> list[Capsule]:
    """Return one capsule per link from its inertia ellipsoid; a wide trunk gets two side by side.

    Capsules are wider than the ellipsoid because a link's mass is inside its shell: a G1's thighs by 11 %, its hands by
    30 %. Links are as wide as the mean of the ellipsoid's width and thickness. Hands are as wide as the width: they are
    flat, and thumbs and fingers touch first. Two thin capsules side by side cover a hand worse, and hands then slip
    past each other.

    A link without a credible ellipsoid takes the size of its collision shapes. Without shapes the ellipsoid is shrunk
    if it is too light; a trunk gets no capsule then.
    """
    model, masses, out = robot.mj_model, own_masses(robot), []
    names, least = set(robot.frame_names), _LEAST_MASS * float(masses.sum())
    for body in range(1, model.nbody):
        name = str(model.body(body).name)
        if name not in names or not masses[body] > least:
            continue
        extent, shell = by_inertia(model, body), _SHELL
        credible = is_credible(masses[body], extent.half)
        by_file = None if credible else by_shapes(robot, body)
        if by_file is not None:
            extent, shell = by_file, 1.0
        elif name in trunk and not credible:
            continue
        half = extent.half if by_file is not None else extent.half * shrunk(masses[body], extent.half)
        long, wide, thin = np.argsort(-half)
        if not half[thin] > max(_LEAST_SIZE, _THINNEST * half[long]):
            continue
        apart = name in trunk and half[wide] > _WIDE * half[thin]
        across = half[wide] if name in hands else 0.5 * (half[wide] + half[thin])
        radius = shell * float(half[thin] if apart else across)
        along, aside = extent.axes[:, long], extent.axes[:, wide]
        reach = max(float((_LONG if by_file is None else 1.0) * half[long] - radius), 0.05 * radius)
        middle = float((extent.center - model.body_ipos[body]) @ along)
        spans, carried = [middle - reach, middle + reach], _carried_joints(model, body, along)
        if name not in trunk and by_file is None:
            spans += [float(np.copysign(max(abs(end) - radius, 0.0), end)) for end in carried]
            spans += [float((joint - model.body_ipos[body]) @ along) for joint in _own_joint(model, body, least)]
        if carried:
            own = [float(-model.body_ipos[body] @ along)] * bool(model.body_jntnum[body])
            spans = _between_joints(carried, own, radius, spans)
        aside_by = shell * half[wide] - radius
        for shift in (aside_by, -aside_by) if apart else (0.0,):
            centre = extent.center - middle * along + shift * aside
            ends = _pair(np.stack([centre + min(spans) * along, centre + max(spans) * along]))
            out.append(Capsule(name, *ends, round(radius, 6)))
    return out


def _carried_joints(model: mujoco.MjModel, body: int, along: np.ndarray) -> list[float]:
    """Return where the joints of a body's children are along an axis through its centre of mass [m]."""
    children = [c for c in range(1, model.nbody) if model.body_parentid[c] == body and model.body_jntnum[c]]
    return [float((model.body_pos[child] - model.body_ipos[body]) @ along) for child in children]


def _between_joints(carried: list[float], own: list[float], radius: float, spans: list[float]) -> list[float]:
    """Return a capsule's ends, limited to one radius beyond the link's joints if it is longer than wide between them.

    A link with limbs on both sides of its centre of mass ends at their joints.
    """
    ends = carried + own
    if max(ends) - min(ends) < 2.0 * radius:
        return spans
    room = 0.0 if min(carried) < 0.0 < max(carried) else radius
    return [float(x) for x in np.clip(spans, min(ends) - room, max(ends) + room)]


def _own_joint(model: mujoco.MjModel, body: int, least: float) -> list[np.ndarray]:
    """Return the position of the joint that moves a body, in its frame [m]; empty if it is fixed to a heavy body.

    The housing around a joint belongs to the body it moves. Beside a heavy motor at the other end it is too light to
    show in the ellipsoid. If the body is fixed to one lighter than ``least`` [kg], which gets no capsule, that one's
    joint counts.
    """
    at, turn, fixed = np.zeros(3), np.eye(3), body
    while not model.body_jntnum[fixed]:
        parent = int(model.body_parentid[fixed])
        if not parent or model.body_mass[parent] > least:
            return []
        turn = turn @ rotation_matrix(model.body_quat[fixed]).T
        at = at - turn @ model.body_pos[fixed]
        fixed = parent
    return [at]


def _plain_capsules(kinematics: Kinematics, profile: Profile, robot: Robot) -> list[tuple[Capsule, str | None]]:
    """Return capsules from joint to joint for limbs, longer ones for hands, and one trunk capsule.

    Each comes with the frame where the part it stands for ends; None if that is the limb's end.
    """

    def capsule(frame: str, start: np.ndarray, end: np.ndarray, radius: float) -> Capsule:
        return Capsule(frame, *_pair(in_frame(robot, kinematics, frame, np.stack([start, end]))), round(radius, 6))

    out, known = [], profile.keypoints
    at = dict(zip(known, world_points(robot, kinematics, [*known.values()]), strict=True))
    for side in SIDES:
        for a, b in (limb for limb in LIMBS if limb[0].startswith(side) and set(limb) <= set(known)):
            length = float(np.linalg.norm(at[b] - at[a]))
            radius = (_LEG_RADIUS if (a, b) in LEGS else _ARM_RADIUS) * length
            inset = radius / length * (at[b] - at[a])
            out.append((capsule(known[a][0], at[a] + inset, at[b] - 0.5 * inset, radius), known[b][0]))
        if f"{side}_wrist" in known and len(profile.feet) != 4:
            wrist = at[f"{side}_wrist"]
            forearm = wrist - at[f"{side}_elbow"]
            radius = 1.2 * _ARM_RADIUS * float(np.linalg.norm(forearm))
            out.append((capsule(known[f"{side}_wrist"][0], wrist, wrist + _HAND * forearm, radius), None))
    if not {f"{side}_{role}" for side in SIDES for role in ("shoulder", "hip")} <= set(known):
        return out
    top, bottom = (0.5 * (at[f"left_{role}"] + at[f"right_{role}"]) for role in ("shoulder", "hip"))
    radius = _TRUNK_RADIUS * float(np.linalg.norm(at["left_shoulder"] - at["right_shoulder"]))
    up = radius * (top - bottom) / np.linalg.norm(top - bottom)
    trunk = capsule(profile.torso or profile.pelvis, bottom + 1.5 * up, top - 0.5 * up, radius)
    return [*out, (trunk, known["left_shoulder"][0])]
