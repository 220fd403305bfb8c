"""Profile inferred from a robot's kinematic tree: legs, arms, knees, elbows, feet and capsules."""

from __future__ import annotations

import dataclasses
import itertools
import re

import mujoco
import numpy as np

from .._errors import OsikValueError
from ..kinematics import Kinematics
from ..kinematics._home import home_kinematics
from ..physics._world import contact_corners, sole_points
from ..robot import Robot
from ..robot._feet import find_feet
from ..robot._own_masses import own_masses
from ._body import JOINTS_APART, joints_between
from ._facing import by_name, facing_x
from ._limbs import ORIGIN, Chain, find_arm, find_chains, find_leg
from ._link_shapes import by_inertia, by_shapes, is_credible, shrunk
from ._profile import Capsule, Foot, Place, Point, Profile
from ._roles import SIDES

# A foot without shapes, as shares of half the leg (ankle height: of the leg); the heel's share of its length.
_FOOT_LENGTH, _FOOT_WIDTH, _FOOT_HEIGHT, _HEEL = 0.36, 0.12, 0.08, 0.3
# Radii of capsules without inertias, as shares of the segment's length (trunk: of the shoulders' width), and the
# length of a hand as a share of the forearm.
_LEG_RADIUS, _ARM_RADIUS, _TRUNK_RADIUS = 0.18, 0.18, 0.3
_HAND = 0.6
_LEAST_MASS, _LEAST_SIZE, _THINNEST, _WIDE, _LONG, _SHELL = 3e-3, 1e-3, 0.1, 1.6, 1.15, 1.2
"""Thresholds of capsules: least link mass (share of the robot's), least half thickness [m] and least thickness over
length, width over thickness above which a trunk gets two capsules, and capsule length and radius over the inertia
ellipsoid's.
"""
# Gap that capsules have at home [m]: above the margin of ``Weights`` (5 mm), which would push them apart there.
_ROOM = 6e-3


def guess_profile(robot: Robot) -> Profile:
    """Return the profile of a robot with two legs and two arms, as its tree and its home configuration show it.

    Feet are found by name (``foot``, ``sole``, ``ankle``, ``toe``), arms as the bodies that reach farthest to the
    sides. A knee or elbow is the joint that bends its limb far from both ends. A wrist is the last joint that moves the
    whole hand; if that is the elbow, the wrist is a fixed hand frame, or the far end of the link's mesh or mass. Soles
    are corner frames (``NAME_corner_0`` and so on), boxes or spheres of the feet; a foot without them gets a length
    after its leg. Check the profile, and save it with ``save_profile`` to edit it.

    Raises:
        ValueError: the base does not float, or two legs and two arms are not found.
    """
    if not robot.floating_base:
        raise OsikValueError(
            "a robot that is bolted down cannot walk as a person does: load it with floating_base=True"
        )
    kinematics, tree = home_kinematics(robot), robot.tree
    feet = find_feet(zip(tree.frame_names, tree.frame_bodies, strict=True), tree.body_parents)
    if len(feet) != 2:
        raise OsikValueError(f"two feet are needed, and {len(feet)} frames look like some: {', '.join(feet) or 'none'}")
    feet = by_name(sorted(feet, key=lambda name: -_y(kinematics.frame_pose(robot, name)[0])))
    robot = facing_x(robot, feet[0], feet[1])
    kinematics = home_kinematics(robot)
    legs = find_chains(robot, kinematics, [tree.frame_bodies[tree.frame(name)] for name in feet])
    used = {body for leg in legs for body in leg.bodies}
    arms = find_chains(robot, kinematics, _hands(robot, kinematics, used))
    keypoints: dict[str, Place] = {}
    for side, leg, arm in zip(SIDES, legs, arms, strict=True):
        bodies = dict(zip(("hip", "knee", "ankle"), find_leg(robot, kinematics, leg), strict=True))
        shoulder, elbow, wrist = find_arm(robot, kinematics, arm)
        bodies |= dict(shoulder=shoulder, elbow=elbow)
        keypoints |= {f"{side}_{role}": (tree.body_names[body], ORIGIN) for role, body in bodies.items()}
        keypoints[f"{side}_wrist"] = wrist
    trunk = tree.body_parents[arms[0].bodies[0]]
    root = tree.root
    found = Profile(
        keypoints=dict(sorted(keypoints.items())),
        pelvis=tree.body_names[root],
        torso=None if trunk == root else tree.body_names[trunk],
        feet={side: _foot(robot, kinematics, name, leg) for side, name, leg in zip(SIDES, feet, legs, strict=True)},
    )
    return Profile(found.keypoints, found.pelvis, found.torso, found.feet, _capsules(robot, kinematics, found))


def _y(position) -> float:
    return float(position[1])


def _hands(robot: Robot, kinematics: Kinematics, used: set[int]) -> list[int]:
    """Return the outermost non-leg bodies that reach farthest to the left and to the right."""
    tree, position = robot.tree, np.asarray(kinematics.body_position)
    outermost = sorted(set(range(2, len(tree.body_parents))) - set(tree.body_parents) - used)
    named = [b for b in outermost if re.search(r"head|neck|camera", tree.body_names[b], re.IGNORECASE) is None]
    if len(named) < 2:
        raise OsikValueError(f"two arms are needed; bodies at ends of limbs: {[tree.body_names[b] for b in named]}")
    left, right = max(named, key=lambda b: position[b, 1]), min(named, key=lambda b: position[b, 1])
    if not position[left, 1] > 0.0 > position[right, 1]:
        raise OsikValueError(
            "no arm is on the left or on the right of the base; x has to be forward and y left at home"
        )
    return [left, right]


def _foot(robot: Robot, kinematics: Kinematics, frame: str, leg: Chain) -> Foot:
    """Return the sole's corners, else those of a foot sized after the leg (at height 0 of a frame called a sole)."""
    corners = _corners(robot, kinematics, frame)
    if len(corners) >= 4:
        ordered = corners[np.argsort(corners[:, 0])]
        return Foot(frame, *(_pair(part[np.argsort(-part[:, 1])]) for part in (ordered[:2], ordered[-2:])))
    length = float(np.linalg.norm(np.diff(leg.anchors, axis=0), axis=-1).sum())
    foot, width, height = _FOOT_LENGTH * length / 2, _FOOT_WIDTH * length / 2, _FOOT_HEIGHT * length
    height = 0.0 if "sole" in frame.lower() else height
    rear, front = -_HEEL * foot, (1.0 - _HEEL) * foot
    return Foot(frame, *(_pair(np.array([[x, width, -height], [x, -width, -height]])) for x in (rear, front)))


def _corners(robot: Robot, kinematics: Kinematics, frame: str) -> np.ndarray:
    """Return corner frames, else lower corners of boxes, else lowest points of spheres, in the frame [m]. (k, 3)."""
    for corners in (contact_corners(robot, frame), sole_points(robot, frame)):
        if len(corners):
            return corners
    tree, model = robot.tree, robot.mj_model
    body = tree.frame_bodies[tree.frame(frame)]
    balls = [
        geom
        for geom in range(model.ngeom)
        if tree.geom_bodies[geom] == body and model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE
    ]
    position, rotation = (np.asarray(x) for x in kinematics.frame_pose(robot, frame))
    turn, origin = np.asarray(kinematics.body_rotation[body]), np.asarray(kinematics.body_position[body])
    points = np.array([origin + turn @ np.asarray(robot.geom_position[g]) for g in balls]).reshape(-1, 3)
    points[:, 2] -= np.array([float(robot.geom_size[g, 0]) for g in balls])
    return (points - position) @ rotation


def _pair(points: np.ndarray) -> tuple[Point, Point]:
    (a, b, c), (d, e, f) = np.round(points, 6).tolist()
    return (a, b, c), (d, e, f)


def _capsules(robot: Robot, kinematics: Kinematics, profile: Profile) -> tuple[Capsule, ...]:
    """Return capsules from the links' inertias; limbs without usable inertias get capsules from joint to joint."""
    tree = robot.tree
    seen = _massive(robot, (profile.pelvis, profile.torso), _frames_of_hands(robot, profile))
    bodies = {tree.frame_bodies[tree.frame(capsule.frame)] for capsule in seen}

    def is_seen(frame: str, end: str | None) -> bool:
        first = tree.frame_bodies[tree.frame(frame)]
        if end == profile.keypoints["left_shoulder"][0] and frame != end:  # the trunk carries both arms
            arms = [tree.frame_bodies[tree.frame(profile.keypoints[f"{side}_shoulder"][0])] for side in SIDES]
            return bool(
                bodies & set(np.flatnonzero(tree.descendants[first] & tree.descendants[:, arms].all(1)).tolist())
            )
        below = set(np.flatnonzero(tree.descendants[first]).tolist())
        last = None if end is None else tree.frame_bodies[tree.frame(end)]
        # a limb that ends in its own link has all bodies below that link
        behind = set() if last in (None, first) else set(np.flatnonzero(tree.descendants[last]).tolist())
        return bool(bodies & (below - behind))

    plain = _plain_capsules(kinematics, profile, robot)
    missing = [capsule for capsule, end in plain if not is_seen(capsule.frame, end)]
    soles = [kinematics.frame_pose(robot, frame) for frame, _ in profile.corners]
    floor = min(float((p + R @ np.array(x))[2]) for (p, R), (_, x) in zip(soles, profile.corners, strict=True))
    return _apart_at_home(robot, kinematics, [*seen, *missing], floor)


def _apart_at_home(robot: Robot, kinematics: Kinematics, capsules: list[Capsule], floor: float) -> tuple[Capsule, ...]:
    """Return capsules thinned where they reach below the soles, with thinner copies where they overlap at home.

    A pair that overlaps at home cannot be kept apart. Thinner copies (down to half the radius) take its place; the full
    capsules still keep other shapes away. A capsule below the soles would lift the feet. If half the radius is still
    too low, the capsule is left out.
    """
    tree, out = robot.tree, []
    bodies = [tree.frame_bodies[tree.frame(c.frame)] for c in capsules]
    poses = [kinematics.frame_pose(robot, c.frame) for c in capsules]
    axes = [[np.asarray(p) + np.asarray(R) @ np.array(x) for x in (c.start, c.end)]
            for c, (p, R) in zip(capsules, poses, strict=True)]  # fmt: skip
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
    elbows, wrists = ({tree.frame_bodies[tree.frame(profile.keypoints[f"{side}_{role}"][0])] for side in SIDES}
                      for role in ("elbow", "wrist"))  # fmt: skip
    wrists = sorted(wrists - elbows)  # without a wrist joint the hand belongs to the forearm
    turned = set(np.flatnonzero(tree.descendants[wrists].any(0)).tolist())
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
        spans = [middle - reach, middle + reach]
        if name not in trunk and by_file is None:
            spans += _spanned(model, body, along, radius, least)
        spans = _between_joints(model, body, along, radius, spans)
        aside_by = shell * half[wide] - radius
        for shift in (aside_by, -aside_by) if apart else (0.0,):
            centre = extent.center - middle * along + shift * aside
            ends = _pair(np.stack([centre + min(spans) * along, centre + max(spans) * along]))
            out.append(Capsule(name, *ends, round(radius, 6)))
    return out


def _between_joints(
    model: mujoco.MjModel, body: int, along: np.ndarray, radius: float, spans: list[float]
) -> list[float]:
    """Return a capsule's ends, limited to one radius beyond the link's joints if it is longer than wide between them.

    A link with limbs on both sides of its centre of mass ends at their joints.
    """
    children = [c for c in range(1, model.nbody) if model.body_parentid[c] == body and model.body_jntnum[c]]
    limbs = [float((model.body_pos[child] - model.body_ipos[body]) @ along) for child in children]
    ends = limbs + [float(-model.body_ipos[body] @ along)] * bool(model.body_jntnum[body])
    if not children or max(ends) - min(ends) < 2.0 * radius:
        return spans
    room = 0.0 if min(limbs) < 0.0 < max(limbs) else radius
    return [float(x) for x in np.clip(spans, min(ends) - room, max(ends) + room)]


def _spanned(model: mujoco.MjModel, body: int, along: np.ndarray, radius: float, least: float) -> list[float]:
    """Return the positions along a capsule's axis of the joint that moves a body and of its children's joints [m].

    The housing around a joint belongs to the body it moves. Beside a heavy motor at the other end it is too light to
    show in the ellipsoid. If the body is fixed to one lighter than ``least`` [kg], which gets no capsule, that one's
    joint counts.
    """
    own = [joint - model.body_ipos[body] for joint in _own_joint(model, body, least)]
    children = [c for c in range(1, model.nbody) if model.body_parentid[c] == body and model.body_jntnum[c]]
    ends = [float((model.body_pos[child] - model.body_ipos[body]) @ along) for child in children]
    short = [float(np.copysign(max(abs(end) - radius, 0.0), end)) for end in ends]
    return [float(anchor @ along) for anchor in own] + short


def _own_joint(model: mujoco.MjModel, body: int, least: float) -> list[np.ndarray]:
    """Return the position of the joint that moves a body, in its frame [m]; empty if it is fixed to a heavy body."""
    at, turn, fixed = np.zeros(3), np.eye(3), body
    while not model.body_jntnum[fixed]:
        parent, own = int(model.body_parentid[fixed]), np.zeros(9)
        if not parent or model.body_mass[parent] > least:
            return []
        mujoco.mju_quat2Mat(own, model.body_quat[fixed])
        turn = turn @ own.reshape(3, 3).T
        at = at - turn @ model.body_pos[fixed]
        fixed = parent
    return [at]


def _plain_capsules(kinematics: Kinematics, profile: Profile, robot: Robot) -> list[tuple[Capsule, str | None]]:
    """Return capsules from joint to joint for limbs, longer ones for hands, and one trunk capsule.

    Each comes with the frame where the part it stands for ends; None if that is the limb's end.
    """

    def place(role: str) -> np.ndarray:
        frame, point = profile.keypoints[role]
        position, rotation = kinematics.frame_pose(robot, frame)
        return np.asarray(position) + np.asarray(rotation) @ np.array(point)

    def inside(frame: str, start: np.ndarray, end: np.ndarray) -> tuple[Point, Point]:
        position, rotation = (np.asarray(x) for x in kinematics.frame_pose(robot, frame))
        return _pair((np.stack([start, end]) - position) @ rotation)

    out = []
    for side in SIDES:
        for a, b, ratio in (
            ("hip", "knee", _LEG_RADIUS),
            ("knee", "ankle", _LEG_RADIUS),
            ("shoulder", "elbow", _ARM_RADIUS),
            ("elbow", "wrist", _ARM_RADIUS),
        ):
            start, end = place(f"{side}_{a}"), place(f"{side}_{b}")
            length = float(np.linalg.norm(end - start))
            radius = ratio * length
            along = (end - start) / length
            frame = profile.keypoints[f"{side}_{a}"][0]
            ends = inside(frame, start + radius * along, end - 0.5 * radius * along)
            out.append((Capsule(frame, *ends, round(radius, 6)), profile.keypoints[f"{side}_{b}"][0]))
        elbow, wrist = place(f"{side}_elbow"), place(f"{side}_wrist")
        radius = 1.2 * _ARM_RADIUS * float(np.linalg.norm(wrist - elbow))
        frame = profile.keypoints[f"{side}_wrist"][0]
        ends = inside(frame, wrist, wrist + _HAND * (wrist - elbow))
        out.append((Capsule(frame, *ends, round(radius, 6)), None))
    shoulders, hips = ([place(f"{side}_{role}") for side in SIDES] for role in ("shoulder", "hip"))
    top, bottom = 0.5 * (shoulders[0] + shoulders[1]), 0.5 * (hips[0] + hips[1])
    radius = _TRUNK_RADIUS * float(np.linalg.norm(shoulders[0] - shoulders[1]))
    trunk = profile.torso or profile.pelvis
    up = (top - bottom) / np.linalg.norm(top - bottom)
    ends = inside(trunk, bottom + 1.5 * radius * up, top - 0.5 * radius * up)
    arm = profile.keypoints["left_shoulder"][0]
    return [*out, (Capsule(trunk, *ends, round(radius, 6)), arm)]
