"""Profile of a robot hand, inferred from its kinematic tree: palm, fingers, knuckles and tips."""

from __future__ import annotations

import itertools
import re

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from ..kinematics import Kinematics, forward_kinematics
from ..kinematics._forward import home_kinematics
from ..robot import Robot
from ..robot._joint_selection import scalar_layout
from ._goals import Weights
from ._limbs import ORIGIN, Chain, find_end
from ._profile import Place, Profile, as_place, world_points
from ._roles import FINGERS

_PARTS = r"(?=j\d|base|hub|meta|knuck|prox|mid|dist)"
_WORDS = {
    "thumb": "thumb|(?:^|[ _])th" + _PARTS,
    "index": "index|fore_?finger|(?:^|[ _])ff" + _PARTS,
    "ring": "ring|(?:^|[ _])rf" + _PARTS,
    "little": "little|pinky|(?:^|[ _])lf" + _PARTS,
    "middle": "middle|(?:^|[ _])mf" + _PARTS,
}
"""Names of the bodies and joints of each finger, the middle one last: links of others are called middle too. The Shadow
hand's have two letters (``rh_FFJ4``).
"""
_BASE = r"palm|hand|wrist|base"
_HAND = r"hand|palm|finger|thumb|(?:^|_)f\d"
_TIPS = ("tip", "head|end|tool|tcp")
"""Names of frames at the end of a finger, the preferred ones first."""
_MOST_WRIST, _LEAST_FINGERS, _LEAST_JOINTS, _LARGEST = 2, 3, 2, 0.4
"""Bounds of what counts as a hand: two joints before the palm at most, three fingers of two joints at least, and joints
within 0.4 m of each other.
"""
_SAME = 2e-3
"""Joints nearer to each other than this [m] are one knuckle."""
_APART, _SIDE, _FLEXED = 1e-2, 5e-3, 0.3
"""Least distance between the last joints of two fingers of one branch [m], of the thumb from the middle of the other
knuckles along them [m], and the angle by which fingers are bent to see where the palm is [rad].
"""
_LIMB = 100.0
"""Weight of a hand's reaches. With a body's, posture pulls tips off by a millimetre, and the damping of the plan's
steps (1 at least) outweighs the rows of fingers: a tip out of reach ends the iterations before the others are there.
"""


def guess_hand(robot: Robot) -> Profile | None:
    """Return the profile of a robot hand with a fixed base, or None if the robot is none.

    Fingers are told by their names. Without names the thumb is the finger that points most away from the others, and
    the others are in order from its side; with the thumb in their middle, it is a right hand. The wrist is the palm's
    joint, else a frame of the palm that is about as far behind the middle knuckle as that finger is long, else the
    point there.
    """
    tree = robot.tree
    names = *tree.frame_names, *tree.joint_names
    if robot.floating_base or not any(re.search(_HAND, name, re.IGNORECASE) for name in names):
        return None
    kinematics = home_kinematics(robot)
    palm, chains = _palm(robot, kinematics)
    if not chains:
        return None
    keypoints: dict[str, Place] = {}
    points: dict[str, np.ndarray] = {}
    tips = [
        find_end(robot, kinematics, chain, len(chain.bodies) - 1, patterns=_TIPS, least_share=0.0) for chain in chains
    ]
    for finger, k in _named(robot, chains, [place for place, _ in tips], np.array([at for _, at in tips])).items():
        knuckles = _knuckles(chains[k])
        for joint, i in enumerate(knuckles, 1):
            keypoints[f"{finger}_{joint}"] = tree.body_names[chains[k].bodies[i]], ORIGIN
        keypoints[f"{finger}_4"] = tips[k][0]
        points |= {f"{finger}_1": chains[k].anchors[knuckles[0]], f"{finger}_4": tips[k][1]}
    wrist = _wrist(robot, kinematics, palm, points)
    return Profile(keypoints={"wrist": wrist, **keypoints}, pelvis=wrist[0], weights=Weights(limb=_LIMB))


def _palm(robot: Robot, kinematics: Kinematics) -> tuple[int, list[Chain]]:
    """Return the body that the most fingers begin at, the last of several, and the fingers; none if it is no hand."""
    tree, position = robot.tree, np.asarray(kinematics.body_position)
    own, found = _joints_of(robot), []
    above = own @ tree.descendants  # joints that move each body
    for palm in np.flatnonzero(above <= _MOST_WRIST).tolist():
        fingers = [bodies for child in _children(robot, palm) for bodies in _fingers(robot, own, position, child)]
        chains = [
            Chain(bodies, position[list(bodies)])
            for bodies in fingers
            if own[list(bodies)].sum() >= _LEAST_JOINTS and above[bodies[0]] - own[bodies[0]] <= _MOST_WRIST
        ]
        if _LEAST_FINGERS <= len(chains) <= len(FINGERS):
            at = np.concatenate([chain.anchors for chain in chains])
            found += [(palm, chains)] if np.ptp(at, axis=0).max() < _LARGEST else []
    first, most = max(found, key=lambda one: len(one[1]), default=(0, []))
    inside = [one for one in found if len(one[1]) == len(most) and tree.descendants[first, one[0]]]
    return max(inside, key=lambda one: above[one[0]], default=(first, most))


def _children(robot: Robot, body: int) -> list[int]:
    return [b for b, parent in enumerate(robot.tree.body_parents) if parent == body and b != body]


def _fingers(robot: Robot, own: np.ndarray, position: np.ndarray, body: int) -> list[tuple[int, ...]]:
    """Return the bodies with joints of the fingers from a body on: of each branch, or of the one with the most joints.

    A branch has two joints or more, and ends apart from the others; else it is a bar of a finger's mechanism.
    """
    below = [bodies for child in _children(robot, body) for bodies in _fingers(robot, own, position, child)]
    fingers = [bodies for bodies in below if own[list(bodies)].sum() >= _LEAST_JOINTS]
    ends = [position[bodies[-1]] for bodies in fingers]
    if len(ends) > 1 and min(_away(a, b) for a, b in itertools.combinations(ends, 2)) > _APART:
        return fingers
    return [((body,) if own[body] else ()) + max(below, key=lambda bodies: own[list(bodies)].sum(), default=())]


def _joints_of(robot: Robot) -> np.ndarray:
    """Return the number of joints of each body. (bodies,)."""
    return np.bincount(np.asarray(robot.tree.joint_bodies, int), minlength=len(robot.tree.body_parents))


def _named(robot: Robot, chains: list[Chain], places: list[Place], tips: np.ndarray) -> dict[str, int]:
    """Return the index of each finger's chain, in the order of ``FINGERS``; ``places`` are those of the tips."""
    tree, found = robot.tree, {}
    parts = [[*(tree.body_names[b] for b in chain.bodies), tip] for chain, (tip, _) in zip(chains, places, strict=True)]
    for chain, names in zip(chains, parts, strict=True):
        names += [n for n, body in zip(tree.joint_names, tree.joint_bodies, strict=True) if body in chain.bodies]
    for finger, word in _WORDS.items():
        own = [k for k, names in enumerate(parts) if re.search(word, " ".join(names), re.IGNORECASE)]
        left = [k for k in own if k not in found.values()]
        found |= {finger: left[0]} if len(left) == 1 else {}
    if len(found) == len(chains):
        return {finger: found[finger] for finger in FINGERS if finger in found}
    first = np.array([chain.anchors[0] for chain in chains])
    along = (tips - first) / np.maximum(np.linalg.norm(tips - first, axis=-1, keepdims=True), _SAME)
    thumb = int(np.argmin((along @ along.T).sum(1)))
    others = [k for k in range(len(chains)) if k != thumb]
    from_middle = first - first[others].mean(0)
    across = np.linalg.svd(from_middle[others])[2][0]
    towards = across @ from_middle[thumb]
    if abs(towards) < _SIDE:
        bends = _bent(robot, [places[k] for k in others]) - tips[others]
        towards = np.cross(across, along[others].sum(0)) @ bends.sum(0)
    side = from_middle @ (across if towards >= 0.0 else -across)
    return dict(zip(FINGERS, [thumb, *sorted(others, key=lambda k: -side[k])], strict=False))


def _bent(robot: Robot, places: list[Place]) -> np.ndarray:
    """Return points in the world [m] with all hinges turned from home into the larger part of their ranges. (k, 3)."""
    scalar, index = scalar_layout(robot)
    hinges, q = scalar & np.asarray(robot.tree.turning), np.array(robot.q0)
    room = np.asarray(robot.position_upper) + np.asarray(robot.position_lower) - 2.0 * q[index]
    q[index[hinges]] += _FLEXED * np.sign(np.where(np.isfinite(room), room, 0.0))[hinges]
    return world_points(robot, forward_kinematics(robot, jnp.asarray(q)), places)


def _away(a: ArrayLike, b: ArrayLike) -> float:
    return float(np.linalg.norm(np.subtract(a, b)))


def _knuckles(chain: Chain) -> list[int]:
    """Return the indices of the last three joints of a finger that are at different places."""
    apart = [i for i, at in enumerate(chain.anchors) if not i or _away(at, chain.anchors[i - 1]) > _SAME]
    return apart[-3:]


def _wrist(robot: Robot, kinematics: Kinematics, palm: int, points: dict[str, np.ndarray]) -> Place:
    """Return the wrist as a place on the palm."""
    finger = next(name for name in ("middle", "index", "ring") if f"{name}_1" in points)
    knuckle, along = points[f"{finger}_1"], points[f"{finger}_4"] - points[f"{finger}_1"]
    if _joints_of(robot)[palm]:
        return _frame(robot, palm), ORIGIN
    names = zip(robot.tree.frame_names, robot.tree.frame_bodies, strict=True)
    fingers = re.compile("|".join(_WORDS.values()), re.IGNORECASE)
    named = [name for name, body in names if body == palm and re.search(_BASE, name, re.IGNORECASE)]
    named = [name for name in named if not fingers.search(name)]
    length, at = float(np.linalg.norm(along)), {name: kinematics.frame_pose(robot, name)[0] for name in named}
    far = {name: _away(position, knuckle) for name, position in at.items()}
    behind = {name: _away(at[name], knuckle - along) for name in named if far[name] > 0.5 * length}
    nearest = min(behind, key=lambda name: behind[name], default="")
    if nearest and behind[nearest] < 0.5 * length:
        return nearest, ORIGIN
    frame = min(far, key=lambda name: far[name], default=_frame(robot, palm))
    return as_place(robot, kinematics, frame, knuckle - along)


def _frame(robot: Robot, body: int) -> str:
    """Return the frame of a body."""
    return robot.tree.frame_names[robot.tree.frame_bodies.index(body)]
