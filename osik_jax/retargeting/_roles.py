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
    return [(a, b) for a, b in (*LIMBS, *_TRUNK) if a in known and b in known]
