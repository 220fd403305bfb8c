"""Names of a person's joints and limbs, as retargeting calls them."""

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
"""The segments whose directions are followed: from the first role to the second."""
SIDES = ("left", "right")
NEEDED = tuple(dict.fromkeys(role for limb in LIMBS for role in limb))
"""Roles that every person has."""
OPTIONAL = ("pelvis", "chest", "neck", "head", "left_heel", "left_toe", "right_heel", "right_toe")
