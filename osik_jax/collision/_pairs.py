"""Pairs of shapes that may meet: a robot's geoms and added shapes, filtered by adjacency, masks and names."""

from __future__ import annotations

import fnmatch
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import mujoco

from .._errors import OsikTypeError, OsikValueError, unknown_name
from ..robot import Robot
from ..robot._tree import KinematicTree
from ..robot.loading._mjmodel import element_names
from ._geometry import KINDS, Kind
from ._shape import CollisionShape

Patterns = Iterable[tuple[str, str]]


class Member(NamedTuple):
    """Static properties of one shape.

    Attributes:
        name: name of the shape.
        aliases: names of the link and of the moving body that it is fixed to, ``"world"`` for the world.
        kind: None if no distance to it can be computed.
        body: the moving body that it is fixed to.
        link: number of the model's body that it is fixed to.
        masks: MuJoCo's ``contype`` and ``conaffinity``; None: meets all.
        added: whether it is an added shape rather than a geom of the robot.
    """

    name: str
    aliases: tuple[str, ...]
    kind: Kind | None
    body: int
    link: int
    masks: tuple[int, int] | None = None
    added: bool = False

    @property
    def label(self) -> str:
        """Return the shape's name for messages, with its link unless the name is that of the link."""
        return self.name if self.added or self.name in self.aliases else f"{self.name} (of {self.aliases[0]})"

    @property
    def solid(self) -> bool:
        """Return whether the shape takes part in collisions, and is not only visual."""
        return self.masks is None or any(self.masks)


def members(robot: Robot, shapes: Mapping[str, CollisionShape]) -> list[Member]:
    """Return a robot's geoms in the model's order, then the added shapes.

    Raises:
        KeyError: a shape is fixed to a frame that does not exist.
        ValueError: a shape has the name of a geom.
    """
    tree, model = robot.tree, robot.mj_model
    bodies = element_names(model, "body")
    links = [*model.geom_bodyid.tolist(), *(bodies.index(mesh.link) for mesh in robot.holder.meshes)]
    masks = [*zip(model.geom_contype.tolist(), model.geom_conaffinity.tolist(), strict=True)]
    masks += [(1, 1)] * len(robot.holder.meshes)
    geoms = zip(tree.geom_names, tree.geom_types, tree.geom_bodies, links, masks, strict=True)
    out = [
        Member(name, (bodies[link], tree.body_names[body]), KINDS.get(kind), body, link, meets)
        for name, kind, body, link, meets in geoms
    ]
    for name, shape in shapes.items():
        if name in tree.geom_names:
            raise OsikValueError(f"a shape is called {name!r}, and so is a geom of the robot; call it something else")
        body = 0 if shape.frame is None else tree.frame_bodies[tree.frame(shape.frame)]
        aliases = (shape.frame or tree.body_names[0], tree.body_names[body])
        out.append(Member(name, aliases, shape.kind, body, _link_of_frame(model, bodies, shape.frame), added=True))
    return out


def _link_of_frame(model: mujoco.MjModel, bodies: Sequence[str], frame: str | None) -> int:
    """Return the model's body that a frame is fixed to: its own, or that of the site or geom."""
    if frame is None or frame in bodies:
        return 0 if frame is None else bodies.index(frame)
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, frame.removeprefix("site:"))
    if site >= 0 and not frame.startswith("geom:"):
        return int(model.site_bodyid[site])
    return int(model.geom_bodyid[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, frame.removeprefix("geom:"))])


def candidate_pairs(
    robot: Robot, scene: Sequence[Member], pairs: Patterns | None, exclude: Iterable[str | tuple[str, str]]
) -> list[tuple[int, int]]:
    """Return the requested pairs of members that can move relative to each other and are not neighbours.

    A pair that ``pairs`` gives by names rather than by a glob may be neighbours, or excluded by the model.

    Raises:
        KeyError: a pattern matches nothing.
        ValueError: no distance to a geom can be computed, or no pair is left.
    """
    pairs = None if pairs is None else _checked(pairs)
    wanted = _default_pairs(scene) if pairs is None else _named_pairs(scene, pairs)
    excluded = _excluded(scene, exclude)
    named = exact_pairs(scene, pairs)
    found = _movable(robot, scene, wanted - excluded - (_model_excludes(robot, scene) - named), named)
    for pattern in pairs or ():
        asked = _named_pairs(scene, [pattern]) - excluded
        if asked and asked.isdisjoint(found) and found:
            raise OsikValueError(
                f"pairs asks for {pattern!r}, none of which can be kept apart: what is on one body, fixed to the world "
                "on both sides, or on two planes does not count, and by globs neither do neighbouring bodies nor what "
                "the model's <exclude> names"
            )
    refuse_without_distance(scene[k] for pair in found for k in pair)
    if not found:
        solid = ", ".join(member.label for member in scene if member.solid) or "none"
        raise OsikValueError(
            "no pair of shapes is left to keep apart: those of the same or of neighbouring bodies, geoms that do not "
            f"collide (contype and conaffinity) and excluded ones do not count; what collides: {solid}"
        )
    return found


def own_pairs(robot: Robot, scene: Sequence[Member]) -> list[tuple[int, int]]:
    """Return the pairs of a robot's geoms that ``candidate_pairs`` has by default; there may be none."""
    return _movable(robot, scene, _default_pairs(scene) - _model_excludes(robot, scene), set())


def moves(robot: Robot, scene: Sequence[Member]) -> list[bool]:
    """Return whether each shape moves, and is not fixed to the world by fixed or locked joints."""
    rigid = _RigidParts(robot)
    return [rigid.part(member) > 0 for member in scene]


def refuse_without_distance(scene: Iterable[Member]) -> None:
    """Raise ValueError if no distance to one of these shapes can be computed."""
    odd = sorted({member.name for member in scene if member.kind is None})
    if odd:
        raise OsikValueError(
            f"no distance to these geoms can be computed (height field or SDF); exclude them: {', '.join(odd)}"
        )


def _movable(
    robot: Robot, scene: Sequence[Member], wanted: set[tuple[int, int]], named: set[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Return those of the wanted pairs that move relative to each other and are not neighbours, unless named."""
    rigid = _RigidParts(robot)
    found = []
    for i, j in sorted(wanted):
        a, b = rigid.part(scene[i]), rigid.part(scene[j])
        neighbours = (i, j) not in named and (a == rigid.parent(b) or b == rigid.parent(a))
        movable = a != b and max(a, b) > 0
        if movable and not neighbours and {scene[i].kind, scene[j].kind} != {Kind.PLANE}:
            found.append((i, j))
    return found


def _checked(pairs: Patterns) -> list[tuple[str, str]]:
    """Return pairs of names, or raise TypeError for anything else."""
    checked: list[Any] = [pairs] if isinstance(pairs, str) else list(pairs)
    for pair in checked:
        if not isinstance(pair, tuple | list) or len(pair) != 2 or not all(isinstance(name, str) for name in pair):
            raise OsikTypeError(f"pairs is a sequence of pairs of names, such as [('hand', 'torso')]; got {pairs!r}")
    return [(first, second) for first, second in checked]


def _default_pairs(scene: Sequence[Member]) -> set[tuple[int, int]]:
    """Return the pairs that MuJoCo would let collide."""
    return {
        (i, j) for (i, a), (j, b) in itertools.combinations(enumerate(scene), 2) if a.solid and b.solid and _meet(a, b)
    }


def _meet(a: Member, b: Member) -> bool:
    if a.masks is None or b.masks is None:
        return True
    return bool(a.masks[0] & b.masks[1] or b.masks[0] & a.masks[1])


def exact_pairs(scene: Sequence[Member], patterns: Patterns | None) -> set[tuple[int, int]]:
    """Return the pairs that are given by names, not by globs."""
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
    """Return the members with this name or on the body or link of this name, else those that match it as a glob.

    For a body or link, these are its solid members.
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
    """Return the pairs that the model's ``<exclude>`` elements name."""
    pairs = {frozenset(divmod(int(signature), 1 << 16)) for signature in robot.mj_model.exclude_signature}
    return {
        (i, j)
        for (i, a), (j, b) in itertools.combinations(enumerate(scene), 2)
        if pairs and not a.added and not b.added and frozenset((a.link, b.link)) in pairs
    }


class _RigidParts:
    """Rigid groups of shapes, and the groups that one joint moves against each other.

    A part is called by the number of its moving body in the tree, or, if it is fixed to the world, by minus the number
    of its first link below the world in the model. The world itself is part 0. Locked joints do not move.
    """

    def __init__(self, robot: Robot) -> None:
        self._model, self._welds = robot.mj_model, _welds(robot.tree)
        names = element_names(self._model, "body")
        self._parents = [self._above(robot.tree, body, names) for body in range(len(robot.tree.body_names))]

    def part(self, member: Member) -> int:
        """Return the part that a shape belongs to."""
        return self._part(member.body, member.link)

    def parent(self, part: int) -> int | None:
        """Return the part to which the joints of a moving part connect it; None for the world, or for a fixed part."""
        return self._parents[part] if part > 0 else None

    def _part(self, body: int, link: int) -> int:
        return self._welds[body] or -int(self._model.body_rootid[link])

    def _above(self, tree: KinematicTree, body: int, names: Sequence[str]) -> int | None:
        above = self._model.body_parentid[names.index(tree.body_names[body])]
        return self._part(tree.body_parents[body], above) or None


def _welds(tree: KinematicTree) -> list[int]:
    """Return for each body the body that it is rigidly attached to, through fixed and locked joints."""
    moving = {tree.joint_bodies[j] for j in range(len(tree.joint_names)) if j not in tree.locked}
    welds: list[int] = []
    for body, parent in enumerate(tree.body_parents):
        welds.append(body if body in moving or body == 0 else welds[parent])
    return welds
