"""Names of a person's joints and limbs in retargeting."""

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
"""Segments whose directions are tracked, from the first role to the second."""
SIDES = ("left", "right")
NEEDED = tuple(dict.fromkeys(role for limb in LIMBS for role in limb))
"""Roles that every clip must have."""
OPTIONAL = ("pelvis", "chest", "neck", "head", "left_heel", "left_toe", "right_heel", "right_toe")
