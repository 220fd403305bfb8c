"""Which shapes may meet: the pairs of a robot's geoms and added shapes, filtered by adjacency, masks and names."""

from __future__ import annotations

import fnmatch
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import mujoco

from .._errors import OsikTypeError, OsikValueError, unknown_name
from ..robot import Robot
from ..robot._tree import KinematicTree
from ._geometry import KINDS, Kind
from ._shape import CollisionShape

Patterns = Iterable[tuple[str, str]]


class Member(NamedTuple):
    """One shape, as far as it is known before any number is.

    Attributes:
        name: its own.
        aliases: the link and the moving body that it is fixed to, ``"world"`` for the world.
        kind: None where no distance to it can be computed.
        body: the moving body that it is fixed to.
        masks: MuJoCo's ``contype`` and ``conaffinity``; None: meets all.
        link: number of the model's body that it is fixed to; None for an added shape.
    """

    name: str
    aliases: tuple[str, ...]
    kind: Kind | None
    body: int
    masks: tuple[int, int] | None = None
    link: int | None = None

    @property
    def solid(self) -> bool:
        """Whether it is there to be met, rather than to be seen."""
        return self.masks is None or any(self.masks)


def members(robot: Robot, shapes: Mapping[str, CollisionShape]) -> list[Member]:
    """A robot's geoms in the model's order, then the added shapes.

    Raises:
        KeyError: a shape is fixed to a frame that does not exist.
        ValueError: a shape is called like a geom.
    """
    tree, model = robot.tree, robot.mj_model
    out = []
    for geom, (name, kind, body) in enumerate(zip(tree.geom_names, tree.geom_types, tree.geom_bodies, strict=True)):
        link = int(model.geom_bodyid[geom])
        called = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, link) or ""
        masks = int(model.geom_contype[geom]), int(model.geom_conaffinity[geom])
        out.append(Member(name, (called, tree.body_names[body]), KINDS.get(kind), body, masks, link))
    for name, shape in shapes.items():
        if name in tree.geom_names:
            raise OsikValueError(f"a shape is called {name!r}, and so is a geom of the robot; call it something else")
        body = 0 if shape.frame is None else tree.frame_bodies[tree.frame(shape.frame)]
        aliases = (shape.frame or tree.body_names[0], tree.body_names[body])
        out.append(Member(name, aliases, shape.kind, body))
    return out


def candidate_pairs(
    robot: Robot, scene: Sequence[Member], pairs: Patterns | None, exclude: Iterable[str | tuple[str, str]]
) -> list[tuple[int, int]]:
    """Pairs of members that can move against each other, are no neighbours, and are asked for.

    Raises:
        KeyError: a pattern matches nothing.
        ValueError: a geom that no distance can be computed to takes part, or nothing is left.
    """
    welds, parents = _welds(robot.tree)
    pairs = None if pairs is None else _checked(pairs)
    wanted = _default_pairs(scene) if pairs is None else _named_pairs(scene, pairs)
    excluded = _excluded(scene, exclude)
    unwanted = excluded | _model_excludes(robot, scene)
    found = []
    for i, j in sorted(wanted - unwanted):
        a, b = welds[scene[i].body], welds[scene[j].body]
        neighbours = a and b and (a == parents[b] or b == parents[a])
        if a != b and not neighbours and {scene[i].kind, scene[j].kind} != {Kind.PLANE}:
            found.append((i, j))
    for pattern in pairs or ():
        asked = _named_pairs(scene, [pattern]) - excluded
        if asked and asked.isdisjoint(found) and found:
            raise OsikValueError(
                f"pairs asks for {pattern!r}, none of which can be kept apart: what is on one body or on neighbouring "
                "ones, on two planes, or what the model's <exclude> names does not count"
            )
    odd = sorted({scene[k].name for pair in found for k in pair if scene[k].kind is None})
    if odd:
        raise OsikValueError(
            f"no distance to these geoms can be computed (height field or SDF); exclude them: {', '.join(odd)}"
        )
    if not found:
        solid = ", ".join(member.name for member in scene if member.solid) or "none"
        raise OsikValueError(
            "no pair of shapes is left to keep apart: those of the same or of neighbouring bodies, geoms that do not "
            f"collide (contype and conaffinity) and excluded ones do not count; what collides: {solid}"
        )
    return found


def _checked(pairs: Patterns) -> list[tuple[str, str]]:
    """The pairs of names, if that is what they are."""
    checked: list[Any] = [pairs] if isinstance(pairs, str) else list(pairs)
    for pair in checked:
        if not isinstance(pair, tuple | list) or len(pair) != 2 or not all(isinstance(name, str) for name in pair):
            raise OsikTypeError(f"pairs is a sequence of pairs of names, such as [('hand', 'torso')]; got {pairs!r}")
    return [(first, second) for first, second in checked]


def _default_pairs(scene: Sequence[Member]) -> set[tuple[int, int]]:
    """What MuJoCo would let collide."""
    return {
        (i, j) for (i, a), (j, b) in itertools.combinations(enumerate(scene), 2) if a.solid and b.solid and _meet(a, b)
    }


def _meet(a: Member, b: Member) -> bool:
    if a.masks is None or b.masks is None:
        return True
    return bool(a.masks[0] & b.masks[1] or b.masks[0] & a.masks[1])


def exact_pairs(scene: Sequence[Member], patterns: Patterns | None) -> set[tuple[int, int]]:
    """Of the pairs that are asked for, those that are asked for by their names rather than by globs."""
    names = {name for member in scene for name in (member.name, *member.aliases)}
    return _named_pairs(scene, [pair for pair in patterns or () if names.issuperset(pair)])


def _named_pairs(scene: Sequence[Member], patterns: Patterns) -> set[tuple[int, int]]:
    out = set()
    for first, second in patterns:
        for i, j in itertools.product(_match(scene, first), _match(scene, second)):
            if i != j:
                out.add((min(i, j), max(i, j)))
    return out


def _excluded(scene: Sequence[Member], exclude: Iterable[str | tuple[str, str]]) -> set[tuple[int, int]]:
    if isinstance(exclude, str):
        raise OsikTypeError(f"exclude is a sequence of names and pairs of names, not one string: use ({exclude!r},)")
    patterns = [(one, "*") if isinstance(one, str) else one for one in exclude]
    return _named_pairs(scene, patterns)


def _match(scene: Sequence[Member], pattern: str) -> list[int]:
    """Members called ``pattern``, or on a body or link called so, or else that match it as a glob.

    Of a body or link, those that are there to be met.
    """
    for fits in (str.__eq__, fnmatch.fnmatchcase):
        found = [
            k
            for k, member in enumerate(scene)
            if fits(member.name, pattern) or (member.solid and any(fits(alias, pattern) for alias in member.aliases))
        ]
        if found:
            return found
    seen = [member.name for member in scene if pattern in member.aliases]
    if seen:
        raise OsikValueError(
            f"nothing of {pattern!r} is there to be met: contype and conaffinity of its geoms are 0. Name the geoms "
            f"themselves to keep them apart ({', '.join(seen)}), or add shapes to it"
        )
    names = {name: None for member in scene for name in (member.name, *member.aliases) if name}
    raise unknown_name("geom, shape or body", pattern, tuple(names))


def _model_excludes(robot: Robot, scene: Sequence[Member]) -> set[tuple[int, int]]:
    """The model's own ``<exclude>`` elements."""
    pairs = {frozenset(divmod(int(signature), 1 << 16)) for signature in robot.mj_model.exclude_signature}
    return {
        (i, j)
        for (i, a), (j, b) in itertools.combinations(enumerate(scene), 2)
        if pairs and a.link is not None and b.link is not None and frozenset((a.link, b.link)) in pairs
    }


def _welds(tree: KinematicTree) -> tuple[list[int], list[int]]:
    """Of each body the one that it cannot move against (locked joints do not move), and of each that one's parent."""
    moving = {tree.joint_bodies[j] for j in range(len(tree.joint_names)) if j not in tree.locked}
    welds: list[int] = []
    for body, parent in enumerate(tree.body_parents):
        welds.append(body if body in moving or body == 0 else welds[parent])
    return welds, [welds[tree.body_parents[weld]] for weld in range(len(welds))]
