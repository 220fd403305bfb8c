"""Names of a person's joints and limbs in retargeting; an animal on four legs has the same."""

import itertools
from collections.abc import Collection

SIDES = ("left", "right")
CHAINS = {"leg": ("hip", "knee", "ankle"), "arm": ("shoulder", "elbow", "wrist")}
"""The joints of each limb of a side, in order."""
LIMBS = tuple(
    (f"{side}_{first}", f"{side}_{second}")
    for roles in CHAINS.values()
    for side in SIDES
    for first, second in itertools.pairwise(roles)
)
"""Segments whose directions are tracked if the robot has them, from the first role to the second."""
LEGS = LIMBS[:4]
REACHES = tuple((f"{side}_{roles[0]}", f"{side}_{roles[-1]}") for side in SIDES for roles in CHAINS.values())
"""Limbs of a four-legged robot, each from its first joint to its foot."""
NEEDED = tuple(dict.fromkeys(role for limb in LIMBS for role in limb))
"""Roles that every clip must have."""
OPTIONAL = ("pelvis", "chest", "neck", "head", "left_heel", "left_toe", "right_heel", "right_toe")
STANDING = {
    ("left", "right"): ("left_heel", "left_toe", "right_heel", "right_toe"),
    ("left", "left_front", "right", "right_front"): tuple(end for _, end in REACHES),
}
"""Sorted names of a robot's feet, and the four points of a person whose contact with the floor they share."""
FINGERS = ("thumb", "index", "middle", "ring", "little")
HAND = ("wrist", *(f"{finger}_{joint}" for finger in FINGERS for joint in (1, 2, 3, 4)))
"""A hand's 21 keypoints: the wrist, and each finger from its first joint (1) to its tip (4)."""
FINGER_REACHES = tuple(("wrist", f"{finger}_4") for finger in FINGERS)
"""From the wrist to the tip of each finger."""

_TRUNK = (
    ("left_hip", "right_hip"),
    ("left_shoulder", "right_shoulder"),
    ("left_hip", "left_shoulder"),
    ("right_hip", "right_shoulder"),
    ("neck", "head"),
    ("left_heel", "left_toe"),
    ("right_heel", "right_toe"),
)


def bones(known: Collection[str]) -> list[tuple[str, str]]:
    """Return the bones of a stick figure between known roles."""
    fingers = [pair for limb in FINGER_REACHES for pair in itertools.pairwise(chain(limb))]
    return [(a, b) for a, b in (*LIMBS, *_TRUNK, *fingers) if a in known and b in known]


def chain(limb: tuple[str, str]) -> tuple[str, ...]:
    """Return the roles from the first end of a reach to the second, with the joints between."""
    first, last = limb
    if limb in FINGER_REACHES:
        return first, *(f"{last[:-1]}{joint}" for joint in (1, 2, 3, 4))
    side = last.split("_")[0]
    roles = next(([f"{side}_{role}" for role in roles] for roles in CHAINS.values() if last.endswith(roles[-1])), [])
    return tuple(roles) if roles[:1] == [first] else limb
