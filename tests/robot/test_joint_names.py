"""Names of joints by convention, and spellings of the same: which joint of a clip is which of a person's."""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from refusals import refuses

from benchmarks.data_file import read_csv
from osik_jax.retargeting._roles import NEEDED
from osik_jax.retargeting._skeletons import find_roles

LEGS_AND_ARMS = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
LEFT_RIGHT, CAPITAL, LETTER, SMALL = ("left", "right"), ("Left", "Right"), ("L", "R"), ("l", "r")
_, ROWS = read_csv(Path(__file__).parents[1] / "data" / "joint_names.csv")
CONVENTIONS = {name: ((left, right), *names) for name, left, right, *names in ROWS}


def joints_of(convention, spelled=lambda name: name, form=None, words=None):
    """Names of a convention, and the roles that they have.

    Args:
        convention: its name.
        spelled: how a name is changed.
        form: where the word for the side stands, with ``side`` and ``name``; None: as the convention has it.
        words: for left and right; None: the convention's.
    """
    own, limbs, others, trunk = CONVENTIONS[convention]
    chest, *rest = trunk.split()
    roles = {} if chest == "-" else {"chest": spelled(chest)}
    names = [*roles.values(), *map(spelled, rest)]
    for side, word in zip(("left", "right"), own if words is None else words, strict=True):

        def named(names, word=word):
            if form is None:
                return [spelled(name.replace("*", word)) for name in names.split()]
            without = [name.replace("*_", "").replace("*", "").rstrip("._") for name in names.split()]
            return [spelled(form.format(side=word, name=name)) for name in without]

        roles |= {f"{side}_{role}": name for role, name in zip(LEGS_AND_ARMS, named(limbs), strict=True)}
        names += [*named(limbs), *named(others)]
    return tuple(dict.fromkeys(names)), roles


def assert_found(names, roles, positions=None):
    found = find_roles(names, positions=positions)
    assert {role: found.get(role) for role in (*NEEDED, "chest")} == {"chest": None} | roles


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_conventions_of_names_are_known(convention):
    names, roles = joints_of(convention)
    assert set(NEEDED) <= set(roles)
    assert_found(names, roles)
    assert_found(names[::-1], roles)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_spellings_of_a_convention_are_known(convention):
    spellings = (
        str.upper,
        str.lower,
        lambda name: re.sub("[_. ]", "", name),
        lambda name: re.sub("(?<=[a-z])(?=[A-Z])|_", "-", name),
        *(form.format for form in ("mixamorig:{}", "Character1_{}", "Skel 2|{}", "DEF-{}", "{}_jnt")),
    )
    for spelled in spellings:
        assert_found(*joints_of(convention, spelled))


@pytest.mark.parametrize("convention", [name for name in CONVENTIONS if not name.startswith("MMD")])
def test_the_word_for_the_side_stands_before_or_after(convention):
    forms = ("{side}{name}", "{side}_{name}", "{side} {name}", "{name}_{side}", "{name}{side}", "{name}.{side}")
    for form, sides in itertools.product(forms, (CAPITAL, LEFT_RIGHT, LETTER, SMALL)):
        assert_found(*joints_of(convention, form=form, words=sides))


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_joints_at_one_point_do_not_change_what_a_convention_means(convention):
    """All joints that are none of a limb's are in the pelvis, and so is a joint called as each limb's joint."""
    names, roles = joints_of(convention)
    limbs = [roles[role] for role in NEEDED]
    spare = [name for name in (f"{name}Joint" for name in limbs) if name not in names]
    names = tuple([*spare, *names])
    positions = np.zeros((2, len(names), 3))
    for name in limbs:
        positions[:, names.index(name)] = np.random.default_rng(limbs.index(name)).normal(size=3)
    found = find_roles(names, positions=positions)
    assert {role: found[role] for role in NEEDED} == {role: roles[role] for role in NEEDED}
    # the spare ones are apart as well, or are all there is
    rng = np.random.default_rng(0)
    assert_found(names, roles, rng.normal(size=positions.shape))
    only = tuple(name for name in names if name not in limbs)
    apart = find_roles(only, positions=rng.normal(size=(2, len(only), 3)))
    assert {role: apart[role] for role in NEEDED} == {role: f"{roles[role]}Joint" for role in NEEDED}
    with pytest.raises(ValueError, match="are at one point in all frames; say which joint is which"):
        find_roles(only, positions=np.zeros((2, len(only), 3)))


def test_the_error_names_what_is_found_and_what_is_not():
    names, roles = joints_of("Mixamo", "mixamorig:{}".format)
    fingers = tuple(
        f"mixamorig:{side}Hand{finger}{k}" for side in CAPITAL for finger in ("Index", "Ring") for k in range(9)
    )
    gone = (roles["left_wrist"], roles["right_knee"])
    with pytest.raises(ValueError, match="no right_knee, left_wrist that can be told by name") as error:
        find_roles(tuple(name for name in names if name not in gone) + fingers)
    text = str(error.value)
    assert "right_elbow=mixamorig:RightForeArm" in text and "left_hip=mixamorig:LeftUpLeg" in text
    assert "LeftHandIndex0" in text and "more" in text and "mapping={role: joint}" in text
    assert len(text) < 10 * 120
    refuses(ValueError, "found: none; other joints: a, b; ", find_roles, ("a", "b"))
    refuses(ValueError, "other joints: none", find_roles, ())
