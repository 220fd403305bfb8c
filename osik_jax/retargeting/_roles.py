"""Names of a person's joints and limbs in retargeting; an animal on four legs has the same."""

LIMBS = (
    ("left_hip", "left_knee"),
    ("left_knee", "left_ankle"),
    ("right_hip", "right_knee"),
    ("right_knee", "right_ankle"),
    ("left_shoulder", "left_elbow"),
    ("left_elbow", "left_wrist"),
    ("right_shoulder", "right_elbow"),
    ("right_elbow", "right_wrist"),
)
"""Segments whose directions are tracked if the robot has them, from the first role to the second."""
LEGS = LIMBS[:4]
REACHES = (
    ("left_hip", "left_ankle"),
    ("left_shoulder", "left_wrist"),
    ("right_hip", "right_ankle"),
    ("right_shoulder", "right_wrist"),
)
"""Limbs of a four-legged robot, each from its first joint to its foot."""
SIDES = ("left", "right")
CHAINS = {"leg": ("hip", "knee", "ankle"), "arm": ("shoulder", "elbow", "wrist")}
"""The joints of each limb of a side, in order."""
NEEDED = tuple(dict.fromkeys(role for limb in LIMBS for role in limb))
"""Roles that every clip must have."""
OPTIONAL = ("pelvis", "chest", "neck", "head", "left_heel", "left_toe", "right_heel", "right_toe")
STANDING = {
    ("left", "right"): ("left_heel", "left_toe", "right_heel", "right_toe"),
    ("left", "left_front", "right", "right_front"): tuple(end for _, end in REACHES),
}
"""Sorted names of a robot's feet, and the four points of a person whose contact with the floor they share."""
