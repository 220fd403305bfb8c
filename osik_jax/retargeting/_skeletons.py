"""Assignment of a clip's joints to a person's roles, by common joint names or by a given mapping."""

from __future__ import annotations

import functools
import itertools
import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from .._errors import OsikValueError, unknown_name
from ._roles import CHAINS, FINGERS, HAND, NEEDED, OPTIONAL, SIDES

ROLES = (*NEEDED, *OPTIONAL, *HAND)
"""All roles: a person's joints and points in retargeting."""
_LIMB_WORDS = {
    "hip": "upleg upperleg thigh femur hip leg 足",
    "knee": "knee lowerleg lowleg calf shin tibia shank leg ひざ 膝",
    "ankle": "ankle talus foot calcn calcaneus 足首",
    "toe": "toebase toes toe bigtoe footindex ball toe0 toe11 foot ankleend footend つま先 足先",
    "heel": "heel かかと",
    "shoulder": "upperarm uparm uarm humerus arm shldr shoulder 腕",
    "elbow": "elbow forearm lowerarm lowarm farm ulna radius ひじ 肘",
    "wrist": "wrist hand forearmend lowerarmend elbowend 手首",
}
"""Words for each joint of a limb, the most specific first. Each joint of the clip gets one role. A word with two
meanings goes to the lower joint if a more specific word names the upper one: ``leg`` is Mixamo's shank (``upleg``,
``leg``) but SOMA's thigh (``leg``, ``shin``), and ``foot`` is SMPL's toe (``ankle``, ``foot``).
"""
_TRUNK_WORDS = {
    "pelvis": "pelvis hips hip hipcenter midhip spinebase root 下半身",
    "chest": "spine001 spine03 spine2 spine chest spine01 spine1 spinemid t12 torso upperback thorax spine05 上半身",
    "neck": "neck neck01 neck1 lowerneck shouldercenter spineshoulder thorax necknose 首",
    "head": "head 頭",
}
"""Words for each joint of the trunk, the preferred one first; ``_trunk`` handles exceptions."""
_SIDE_WORDS = {"left": ("left", "l", "左"), "right": ("right", "r", "右")}
_MIDDLE_WORDS = ("", "c", "center")
_SUFFIX = re.compile(r"(joint|jnt|bone)$")
_FIRST = re.compile(r"0*1(?=(left|l|左|right|r|右)?$)")
"""Number 1 of the first of several bones in a row, as in MakeHuman's ``upperleg01.L``."""
_MOST_NAMES = 20
_SAME = 1e-3
"""Two joints closer to each other than this share of the clip's largest distance from the mean joint are at one point.
"""

Part = tuple[str, str]
"""Side ("" for the trunk) and word of the tables."""


def find_roles(
    joint_names: tuple[str, ...],
    mapping: Mapping[str, str] | None = None,
    needed: Sequence[str] = NEEDED,
    positions: Float[np.ndarray, "F J 3"] | None = None,
) -> dict[str, str]:
    """Return the clip's joint for each of a person's roles.

    Names are compared without case and separators, with the word for the side (``left``, ``l``) before or after. A
    prefix common to all used names (``mixamorig:``, ``Character1_``, ``Bip01``) is ignored, and so is a word for joint
    at the end. A name without such a word goes first (CMU has ``LHipJoint`` in the pelvis, and ``LeftHip``), and a
    joint at one point with another limb joint goes last. ``mapping`` gives joints for roles, ``needed`` are those that
    have to be found. Without positions names alone count.
    """
    places = {} if positions is None else _places(joint_names, positions)
    roles = _by_name(joint_names, needed, places) if mapping is None else _checked(joint_names, mapping, needed)
    sided = [role for role in roles if role in needed or role.startswith(SIDES)]
    for a, b in itertools.combinations(sided, 2):
        if _spans(a, b) and _is_at(places, roles[a], roles[b]):
            raise OsikValueError(
                f"{a} ({roles[a]}) and {b} ({roles[b]}) are at one point in all frames; say which joint is which with "
                "mapping={role: joint}"
            )
    return roles


def _places(joint_names: tuple[str, ...], positions: Float[np.ndarray, "F J 3"]) -> dict[str, np.ndarray]:
    """Return the positions of each joint by name, over the clip's largest distance from the mean joint. (F, 3) each."""
    beside = positions - positions.mean(1, keepdims=True)
    return dict(zip(joint_names, np.moveaxis(beside / max(np.abs(beside).max(), 1e-12), 1, 0), strict=True))


def _spans(a: str, b: str) -> bool:
    """Return whether two landmarks give a direction: joints of one limb, left and right joints, or a hand's."""
    (side, _, part), (other, _, second) = a.partition("_"), b.partition("_")
    arms = [joint in CHAINS["arm"] for joint in (part, second)]
    return side not in SIDES or part == second or (side == other and arms[0] == arms[1])


def _is_at(places: Mapping[str, np.ndarray], a: str, b: str) -> bool:
    """Return whether two joints are at one point in all frames; False if their places are unknown."""
    return a in places and float(np.abs(places[a] - places[b]).max()) < _SAME


def _by_name(joint_names: tuple[str, ...], needed: Sequence[str], places: Mapping[str, np.ndarray]) -> dict[str, str]:
    """Return the clip's joint for each role that its names tell, with the bone lengths that ``places`` show."""
    if "wrist" in needed:
        fingers = {role: name for name in joint_names for role, word in _hand_words() if _plain(name).endswith(word)}
        _check_complete(joint_names, fingers, needed)
        return fingers
    groups: dict[str, dict[Part, list[str]]] = {}
    for name in sorted(joint_names, key=lambda name: _plain(name) != _letters(name)):
        for prefix, part in _readings(_plain(name)):
            groups.setdefault(prefix, {}).setdefault(part, []).append(name)
    best: dict[str, str] = {}
    for own in (places, {}):  # names alone come last: the caller then tells two joints at one point
        found = [_assigned(groups[prefix], own) for prefix in sorted(groups, key=len)]
        best = max(found, key=lambda roles: (sum(role in roles for role in needed), len(roles)), default={})
        if set(needed) <= set(best):
            return best
    _check_complete(joint_names, best, needed)
    return best


def _letters(name: str) -> str:
    """Return a name in lower case, without separators."""
    return "".join(c for c in unicodedata.normalize("NFKC", name).lower() if c.isalnum())


def _plain(name: str) -> str:
    """Return a name in lower case, without separators and without a trailing word for joint."""
    return _SUFFIX.sub("", _letters(name))


@functools.cache
def _spellings() -> dict[str, Part]:
    """Return all spellings of the tables' words: each word with its side before or after it."""
    out: dict[str, Part] = {}
    for side, word in ((side, word) for side in SIDES for word in _limb_words()):
        stem = word.removesuffix("end")
        end = word[len(stem) :]
        for own in _SIDE_WORDS[side]:
            out |= {f"{own}{word}": (side, word), f"{word}{own}": (side, word), f"{stem}{own}{end}": (side, word)}
    for word in (word for words in _TRUNK_WORDS.values() for word in words.split()):
        out |= {spelling: ("", word) for own in _MIDDLE_WORDS for spelling in (f"{own}{word}", f"{word}{own}")}
    return out


@functools.cache
def _hand_words() -> tuple[tuple[str, str], ...]:
    """Return the ways to write the keypoints of a hand, with their roles: index_1, MediaPipe's index_finger_mcp."""
    out = [("wrist", "wrist")]
    for finger in FINGERS:
        parts = ("cmc", "mcp", "ip", "tip") if finger == "thumb" else ("mcp", "pip", "dip", "tip")
        for word in (finger, "pinky") if finger == "little" else (finger,):
            for joint, part in enumerate(parts, 1):
                out += [(f"{finger}_{joint}", w) for w in (f"{word}{joint}", f"{word}{part}", f"{word}finger{part}")]
    return tuple(out)


@functools.cache
def _limb_words() -> frozenset[str]:
    return frozenset(word for words in _LIMB_WORDS.values() for word in words.split())


def _readings(plain: str) -> Iterator[tuple[str, Part]]:
    """Yield the possible readings of a name: a prefix, and the part named by the rest."""
    spellings, first = _spellings(), _FIRST.sub("", plain)
    for start in range(len(plain)):
        part = spellings.get(plain[start:])
        if part is None and first != plain:
            part = spellings.get(first[start:])
            part = part if part is not None and part[0] else None  # the trunk's words have their numbers
        if part is not None:
            yield plain[:start], part
    for own, side in ((own, side) for side, words in _SIDE_WORDS.items() for own in words if plain.startswith(own)):
        for start in range(len(own) + 1, len(first)):  # the side stands before the prefix
            if first[start:] in _limb_words():
                yield first[len(own) : start], (side, first[start:])


def _assigned(parts: Mapping[Part, Sequence[str]], places: Mapping[str, np.ndarray]) -> dict[str, str]:
    """Assign to each role the first of its words that is not taken and has a joint apart from the other limb joints."""
    roles: dict[str, str] = {}
    for side in SIDES:
        other = [name for (own, _), names in parts.items() if own not in ("", side) for name in names]
        taken: dict[str, str] = {}
        for role, words in _LIMB_WORDS.items():
            for word in (word for word in words.split() if word not in taken):
                apart = [*other, *taken.values()]
                free = [n for n in parts.get((side, word), ()) if not any(_is_at(places, n, o) for o in apart)]
                if free:
                    roles[f"{side}_{role}"] = taken[word] = free[0]
                    break
    return roles | _trunk({word: names[0] for (side, word), names in parts.items() if not side})


def _trunk(parts: Mapping[str, str]) -> dict[str, str]:
    """Assign to each trunk role the first of its words that occurs."""
    words = {role: words.split() for role, words in _TRUNK_WORDS.items()}
    if "spine001" in parts:  # Blender's Rigify: its spine is the pelvis
        words["pelvis"].insert(0, "spine")
    if "spine05" not in parts:  # of MakeHuman's and Unreal's five the third, of Unreal's three the first
        words["chest"].remove("spine03")
    if "spine" in parts:  # SMPL has spine1 to spine3, Mixamo spine, spine1 and spine2
        words["chest"].remove("spine2")
    roles: dict[str, str] = {}
    for role, own in words.items():
        found = [parts[word] for word in own if word in parts and parts[word] not in roles.values()]
        roles |= {role: found[0]} if found else {}
    return roles


def _checked(joint_names: tuple[str, ...], mapping: Mapping[str, str], needed: Sequence[str]) -> dict[str, str]:
    for role, name in mapping.items():
        if role not in ROLES:
            raise unknown_name("role", role, ROLES)
        if name not in joint_names:
            raise unknown_name("joint of the clip", name, joint_names)
    _check_complete(joint_names, mapping, needed)
    return dict(mapping)


def _check_complete(joint_names: tuple[str, ...], roles: Mapping[str, str], needed: Sequence[str]) -> None:
    missing = [role for role in needed if role not in roles]
    if missing:
        found = ", ".join(f"{role}={name}" for role, name in roles.items()) or "none"
        others = [name for name in joint_names if name not in roles.values()]
        raise OsikValueError(
            f"the clip has no {', '.join(missing)} that can be told by name; found: {found}; other joints: "
            f"{shortened(others, _MOST_NAMES) or 'none'}; say which joint is which with mapping={{role: joint}}"
        )


def shortened(names: Sequence[str], most: int = 8) -> str:
    """Return names joined by commas, ``most`` of them and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
