"""Which of a clip's joints are which of a person's: names that files use, and a mapping of one's own."""

from __future__ import annotations

import re
from collections.abc import Mapping

from .._errors import OsikValueError, unknown_name
from ._person import NEEDED, OPTIONAL

ROLES = (*NEEDED, *OPTIONAL)
"""A person's joints and points, as retargeting calls them."""


def _sided(table: Mapping[str, str], left: str, right: str) -> dict[str, tuple[str, ...]]:
    """Both sides of a table of names, in which ``*`` is where the word for the side stands."""
    sides = {"left": left, "right": right}
    return {
        f"{side}_{role}": tuple(name.replace("*", word) for name in names.split())
        for side, word in sides.items()
        for role, names in table.items()
    }


def _trunk(**names: str) -> dict[str, tuple[str, ...]]:
    return {role: tuple(found.split()) for role, found in names.items()}


_LIMBS = {name: f"*{name}" for name in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")}
_BVH = dict(
    hip="*upleg", knee="*leg", ankle="*foot", toe="*toebase *toe *footend",
    shoulder="*arm", elbow="*forearm", wrist="*hand",
)  # fmt: skip
_RIGIFY = dict(
    hip="thigh*", knee="shin*", ankle="foot*", toe="toe* foot*end",
    shoulder="upperarm*", elbow="forearm*", wrist="hand* forearm*end",
)  # fmt: skip
_UNREAL = dict(
    hip="thigh*", knee="calf*", ankle="foot*", toe="ball* foot*end",
    shoulder="upperarm*", elbow="lowerarm*", wrist="hand*",
)  # fmt: skip
PRESETS: dict[str, dict[str, tuple[str, ...]]] = {
    "roles": {role: (role.replace("_", ""),) for role in ROLES},
    "smpl": {
        **_sided({**_LIMBS, "toe": "*foot"}, "left", "right"),
        **_trunk(pelvis="pelvis", chest="spine2", neck="neck", head="head"),
    },
    "smpl short": {
        **_sided({**_LIMBS, "toe": "*toe"}, "l", "r"),
        **_trunk(pelvis="pelvis", chest="spine", neck="neck", head="head"),
    },
    "bvh": {**_sided(_BVH, "left", "right"), **_trunk(pelvis="hips", chest="spine", neck="neck", head="head")},
    "rigify": {
        **_sided(_RIGIFY, "l", "r"),
        **_trunk(pelvis="pelvis spine", chest="spine001", neck="neck", head="head"),
    },
    "unreal": {**_sided(_UNREAL, "l", "r"), **_trunk(pelvis="pelvis", chest="spine01", neck="neck01", head="head")},
    "deepmimic": {
        **_sided({**_LIMBS, "heel": "*heel", "toe": "*toe *ankleend"}, "left", "right"),
        **_trunk(pelvis="root hips", chest="chest", neck="neck", head="head"),
    },
}
"""Role to a clip's names of it, the first that there is, in small letters and without signs.

``bvh``: those of the CMU database, of Mixamo and of many other BVH files; ``rigify``: of Blender's; ``deepmimic``: of
BVH files that say ankle for the shank's end too.
"""


def find_roles(joint_names: tuple[str, ...], mapping: Mapping[str, str] | None = None) -> dict[str, str]:
    """Of each of a person's joints, what the clip calls it.

    Args:
        joint_names: the clip's.
        mapping: role (``ROLES``) to a name of the clip's, where they are not to be guessed.

    Raises:
        KeyError: the mapping has a role or a joint that does not exist.
        ValueError: joints that retargeting needs are not found; the message says which, and what there is.
    """
    if mapping is not None:
        return _checked(joint_names, mapping)
    plain = {_plain(name): name for name in joint_names}
    found = [
        {
            role: plain[there[0]]
            for role, names in preset.items()
            if (there := [name for name in names if name in plain])
        }
        for preset in PRESETS.values()
    ]
    best = max(found, key=lambda roles: (sum(role in roles for role in NEEDED), len(roles)))
    _check_complete(joint_names, best)
    return best


def _plain(name: str) -> str:
    """A name in small letters, without signs and without what tools put before it."""
    return re.sub(r"[^a-z0-9]", "", re.sub(r"^mixamorig\d*", "", name.split(":")[-1].lower()))


def _checked(joint_names: tuple[str, ...], mapping: Mapping[str, str]) -> dict[str, str]:
    for role, name in mapping.items():
        if role not in ROLES:
            raise unknown_name("role", role, ROLES)
        if name not in joint_names:
            raise unknown_name("joint of the clip", name, joint_names)
    _check_complete(joint_names, mapping)
    return dict(mapping)


def _check_complete(joint_names: tuple[str, ...], roles: Mapping[str, str]) -> None:
    missing = [role for role in NEEDED if role not in roles]
    if missing:
        raise OsikValueError(
            f"the clip has no {', '.join(missing)} that can be told by name; say which joint is which with "
            f"mapping={{role: joint}}; joints: {', '.join(joint_names)}"
        )
