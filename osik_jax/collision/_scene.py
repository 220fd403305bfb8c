"""Scenes: convex shapes in the world and in the robot's hands, as arrays."""

from __future__ import annotations

import fnmatch
import os
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int
from numpy.typing import ArrayLike

from .._errors import OsikTypeError, OsikValueError, unknown_name
from ..kinematics._forward import kinematics_on_host
from ..kinematics._pose_forms import Pose, PoseLike, as_pose
from ..kinematics._rigid import compose, compose_poses, rotate
from ..numerics._arguments import check_count
from ..numerics._host import Numbers, is_traced, replaced_at, to_jax, tree_to_jax
from ..robot import Robot
from ..robot._made_for import check_robot
from ._geometry import Kind
from ._pairs import members
from ._shape import CollisionShape
from ._table import ConvexShape, RobotShapes, ShapeKind, ShapeTable, shape_table, table_shapes

_Shape = CollisionShape | ConvexShape


def check_scene(scene: Any, *, single: bool = False) -> None:
    """Raise TypeError unless this is a ``Scene``; with ``single``, ValueError for a stack of scenes."""
    if not isinstance(scene, Scene):
        raise OsikTypeError(f"scene is a {type(scene).__name__}; make an osik_jax.Scene of it: Scene({{name: shape}})")
    if single and scene.is_stack:
        raise OsikValueError("scene is a stack of scenes; give one scene, in world axes")


class Labels:
    """Names of a scene's rows; all are equal, so that a scene with other names compiles nothing.

    A function of ``jax.jit`` sees the names of the scene that it was traced with, so nothing reads them in there.

    Attributes:
        names: name of each shape; in a stack, those of each scene.
        objects: name of the object that each shape is a part of; likewise.
    """

    def __init__(self, names: tuple[Any, ...], objects: tuple[Any, ...]) -> None:
        self.names, self.objects = names, objects

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Labels)

    def __hash__(self) -> int:
        return 0


class Scene(eqx.Module):
    """Convex shapes that a robot keeps away from, in the world and in its hands.

    A scene is a pytree of arrays with room for ``capacity`` shapes. Another scene with the same room compiles nothing,
    whatever its shapes and names are. ``Scene.stack`` gives the arrays a leading axis, for a scene for each target.

    Inside ``jit`` its arrays are traced like any others, and its names are unknown there: what goes by name (``moved``,
    ``attach``, ``allow``) is called outside.

    Args:
        shapes: name to ``CollisionShape`` in the world, or to several that are one object, such as the parts that
            ``CollisionShape.mesh`` returns.
        capacity: number of shapes that there is room for; None: the next power of two.
        vertex_capacity: the same for the vertices of all hulls.

    Raises:
        TypeError: something else than shapes by name, or traced numbers.
        ValueError: more shapes than the capacity, a shape in a robot's frame, or numbers that are not finite.

    Attributes:
        table: the shapes; those that a body holds are in the body's axes. Rows without a shape are ``ABSENT``.
        body: moving body (``robot.tree.body_names``) that holds each shape; -1: none, it is in the world. (k,)
        contact: whether each shape may touch what each of ``partners`` matches. (k, m)
        among: whether each shape may touch each other one, if a body holds one of them. (k, k)
        partners: names or globs of the robot's shapes and links that something may touch (static).
    """

    table: ShapeTable
    body: Int[Array, "*n k"]
    contact: Bool[Array, "*n k m"]
    among: Bool[Array, "*n k k"]
    partners: tuple[str, ...] = eqx.field(static=True)
    labels: Labels = eqx.field(static=True, repr=False)

    def __init__(
        self,
        shapes: Mapping[str, _Shape | Sequence[_Shape]] | None = None,
        *,
        capacity: int | None = None,
        vertex_capacity: int | None = None,
    ):
        objects = {name: _convex_shapes(name, given) for name, given in _items(shapes)}
        rows = [
            (f"{name}:{k}" if len(one) > 1 else name, name) for name, one in objects.items() for k in range(len(one))
        ]
        table = shape_table([shape for parts in objects.values() for shape in parts])
        room = _room("capacity", "shapes", capacity, len(rows))
        vertices = _room("vertex_capacity", "vertices of hulls", vertex_capacity, len(table.vertices))
        free = np.full(room, -1, np.int32), np.zeros((room, 0), bool), np.zeros((room, room), bool)
        self.table, self.body, self.contact, self.among = tree_to_jax((_padded(table, room, vertices), *free))
        self.partners = ()
        self.labels = Labels(tuple(name for name, _ in rows), tuple(name for _, name in rows))

    @classmethod
    def from_file(
        cls, path: str | os.PathLike[str], *, capacity: int | None = None, vertex_capacity: int | None = None
    ) -> Scene:
        """Read a MuJoCo XML, a URDF, or a scene of MoveIt: ``.yaml``, or the text format ``.scene``.

        XML: all shapes that collide, each link or body an object, with joints where they are at the start (0, or
        ``qpos0``). MoveIt: the collision objects, and the pairs of an object and a link that may touch.

        Args:
            path: of the file; meshes are looked for beside it.
            capacity: as in ``Scene``.
            vertex_capacity: as in ``Scene``.

        Raises:
            FileNotFoundError: no such file.
            ImportError: a ``.yaml`` file without PyYAML (the extra ``scenes``).
            ValueError: a file of another kind, or broken, or more shapes than the capacity.

        Warns:
            OsikWarning: something of the file is not kept, such as attached objects.
        """
        from ._scene_files import read_scene  # readers that few programs need

        objects, allowed = read_scene(path)
        scene = cls(objects, capacity=capacity, vertex_capacity=vertex_capacity)
        return scene.allow(*allowed) if allowed else scene

    @classmethod
    def stack(cls, scenes: Sequence[Scene]) -> Scene:
        """Return scenes with a leading axis, with room for the largest of them; ``stack[i]`` is one of them.

        Raises:
            TypeError: a scene is traced.
            ValueError: there is none, or one is a stack.
        """
        if not scenes:
            raise OsikValueError("there is no scene to stack")
        for scene in scenes:
            check_scene(scene)
            scene._check_single("Scene.stack")
        room = max(scene.capacity for scene in scenes)
        vertices = max(len(scene.table.vertices) for scene in scenes)
        partners = tuple(dict.fromkeys(name for scene in scenes for name in scene.partners))
        alike = [scene._enlarged(room, vertices, partners) for scene in scenes]
        made = tree_to_jax(jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *alike))
        labels = Labels(tuple(s.labels.names for s in alike), tuple(s.labels.objects for s in alike))
        return _with(made, labels=labels)

    def __getitem__(self, number: int) -> Scene:
        """Return one scene of a stack."""
        if not self.is_stack:
            raise OsikTypeError("this is one scene and no stack of scenes: its shapes are in scene.table")
        one = jax.tree.map(lambda leaf: leaf[number], self)
        return _with(one, labels=Labels(self.labels.names[number], self.labels.objects[number]))

    @property
    def is_stack(self) -> bool:
        """Return whether the arrays have a leading axis."""
        return self.table.kind.ndim > 1

    @property
    def capacity(self) -> int:
        """Return the number of shapes that there is room for."""
        return self.table.kind.shape[-1]

    @property
    def names(self) -> tuple[Any, ...]:
        """Return the names of the shapes, in the order of the rows; in a stack, the names of each scene."""
        return self.labels.names

    def __repr__(self) -> str:
        if self.is_stack:
            return f"Scene.stack of {self.table.kind.shape[0]} scenes with room for {self.capacity} shapes"
        return f"Scene of {len(self.names)} shapes, room for {self.capacity}: {', '.join(self.names)}"

    def moved(self, name: str, pose: PoseLike) -> Scene:
        """Return the scene with an object somewhere else. Nothing is compiled anew; the pose may be traced.

        Args:
            name: of the object, or of one of its shapes.
            pose: of the shape, or of the object's first shape; the others keep their places relative to it. In the
                axes of the body that holds it, else in the world.

        Raises:
            KeyError: no such name; the message lists all.
            TypeError: the scene is traced.
            ValueError: not a pose.
        """
        rows = self._rows(name, "moved")
        numbers = jnp if is_traced((self, pose)) else np
        position, rotation = (numbers.asarray(part)[rows] for part in (self.table.position, self.table.rotation))
        wanted = as_pose(pose, self.table.position.dtype, numbers=numbers, what=f"the pose of {name!r}")
        turn = compose(wanted[1], rotation[0].T)
        return self._placed(rows, (wanted[0] + rotate(turn, position - position[0]), compose(turn, rotation)))

    def attach(
        self,
        name: str,
        robot: Robot,
        frame: str,
        *,
        q: ArrayLike | Array | None = None,
        touch: str | Sequence[str] = (),
    ) -> Scene:
        """Return the scene with an object held by a frame of the robot, so that it moves with the frame.

        Args:
            name: of the object, or of one of its shapes.
            robot: the robot.
            frame: of the robot, such as its hand.
            q: configuration of the robot at which the object is where the scene has it. (nq,) None: the object's pose
                is in the axes of the frame.
            touch: a name or glob, or several, of links that it may touch, such as fingers. What is on the frame's own
                body may always be touched.

        Raises:
            KeyError: no such name or frame.
            TypeError: the scene is traced, or the robot is no ``Robot``.
            ValueError: a body holds the object already; or not a configuration.
        """
        check_robot(robot, "Scene.attach(name, robot, frame)")
        rows, touch = self._rows(name, "attach"), (touch,) if isinstance(touch, str) else touch
        if (np.asarray(self.body)[rows] >= 0).any():
            raise OsikValueError(f"{name!r} is held already; detach it first")
        body = robot.tree.frame_bodies[robot.tree.frame(frame)]
        hold = _frame_in_body(robot, frame) if q is None else _inverse(_body_pose(robot, body, q))
        held = _with(
            self._placed(rows, compose_poses(hold, self._poses(rows))), body=replaced_at(self.body, rows, body)
        )
        own = {part.aliases[0] for part in members(robot, {}) if part.solid and part.body == body}
        return held.allow(*((name, _quoted(link)) for link in sorted(own)), *((name, link) for link in touch))

    def detach(self, name: str, robot: Robot, q: ArrayLike | Array) -> Scene:
        """Return the scene with a held object in the world, where it is with the robot at q (nq,).

        What it may touch stays as it is.

        Raises:
            KeyError: no such name.
            TypeError: the scene is traced.
            ValueError: no body holds the object, or not a configuration.
        """
        check_robot(robot, "Scene.detach(name, robot, q)")
        rows = self._rows(name, "detach")
        body = int(np.asarray(self.body)[rows[0]])
        if body < 0:
            raise OsikValueError(f"no body holds {name!r}, so it cannot be detached")
        world = self._placed(rows, compose_poses(_body_pose(robot, body, q), self._poses(rows)))
        return _with(world, body=replaced_at(self.body, rows, -1))

    def allow(self, *pairs: tuple[str, str]) -> Scene:
        """Return the scene with pairs that may touch.

        Args:
            pairs: name or glob of objects or shapes, and one of the robot's links or shapes, or of other objects:
                ``scene.allow(("can1", "panda_*finger"), ("can1", "table"))``. What matches no object is looked for
                among the robot's names when the scene is used. A name that exists stands for itself, not for a glob.

        Raises:
            KeyError: the first name of a pair matches nothing.
            TypeError: not pairs of names, or the scene is traced.
        """
        self._check_single("allow")
        contact, among, partners = np.asarray(self.contact), np.array(self.among), list(self.partners)
        for pair in pairs:
            if not isinstance(pair, tuple | list) or len(pair) != 2 or not all(isinstance(name, str) for name in pair):
                raise OsikTypeError(f"allow takes pairs of names, such as ('can', 'panda_*finger'); got {pair!r}")
            rows, others = self._rows(pair[0], "allow"), self._matching(pair[1])
            among[np.ix_(rows, others)] = among[np.ix_(others, rows)] = True
            if pair[1] not in partners:
                partners.append(pair[1])
                contact = np.pad(contact, ((0, 0), (0, 1)))
            contact[rows, partners.index(pair[1])] = True
        return _with(self, contact=to_jax(contact), among=to_jax(among), partners=tuple(partners))

    def contacts(self, shapes: RobotShapes) -> Bool[Numbers, "*n k r"]:
        """Return whether each shape of the scene may touch each shape of a robot, as ``allow`` and ``attach`` say."""
        if not self.partners:
            return np.zeros((*self.contact.shape[:-1], len(shapes.names)), bool)
        own = [*zip(shapes.names, shapes.links, strict=True)]
        found = [_matches(own, partner) for partner in self.partners]
        matches = np.array(found, bool).reshape(len(self.partners), len(own))
        numbers = jnp if is_traced(self) else np
        return (numbers.asarray(self.contact)[..., None] & matches).any(-2)

    def _check_single(self, what: str) -> None:
        if is_traced(self):
            raise OsikTypeError(f"{what}: the names of a traced scene are unknown; call it outside of jit")
        if self.is_stack:
            raise OsikValueError(f"{what}: this is a stack of scenes; change its scenes before they are stacked")

    def _matching(self, pattern: str) -> np.ndarray:
        return np.flatnonzero(_matches([*zip(self.labels.names, self.labels.objects, strict=True)], pattern))

    def _rows(self, pattern: str, what: str) -> np.ndarray:
        self._check_single(what)
        rows = self._matching(pattern)
        if not len(rows):
            raise unknown_name("shape", pattern, tuple(dict.fromkeys((*self.labels.objects, *self.names))))
        return rows

    def _poses(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(self.table.position, float)[rows], np.asarray(self.table.rotation, float)[rows]

    def _placed(self, rows: np.ndarray, poses: tuple[Any, Any]) -> Scene:
        """Return the scene with other poses of some rows."""
        old = self.table.position, self.table.rotation
        position, rotation = tree_to_jax(
            [replaced_at(whole, rows, some) for whole, some in zip(old, poses, strict=True)]
        )
        return _with(self, table=self.table._replace(position=position, rotation=rotation))

    def _enlarged(self, room: int, vertices: int, partners: tuple[str, ...]) -> Scene:
        """Return the scene with more room, and with columns of ``contact`` for all of these partners."""
        more = room - self.capacity
        contact = np.zeros((room, len(partners)), bool)
        contact[: self.capacity, [partners.index(name) for name in self.partners]] = np.asarray(self.contact)
        return _with(
            self,
            table=_padded(jax.tree.map(np.asarray, self.table), room, vertices),
            body=np.pad(np.asarray(self.body), (0, more), constant_values=-1),
            contact=contact,
            among=np.pad(np.asarray(self.among), (0, more)),
            partners=partners,
        )


def _with(scene: Scene, **changes: Any) -> Any:
    """Return the scene with other fields; ``dataclasses.replace`` would call ``__init__``."""
    made = object.__new__(type(scene))
    for name in ("table", "body", "contact", "among", "partners", "labels"):
        object.__setattr__(made, name, changes.get(name, getattr(scene, name)))
    return made


def with_objects(scene: Scene, objects: Mapping[str, Sequence[ConvexShape]]) -> Scene:
    """Return the scene with more objects, in the world; they may touch nothing."""
    rows = [(f"{name}:{k}", name) for name, parts in objects.items() for k in range(len(parts))]
    kept = table_shapes(jax.tree.map(np.asarray, scene.table))[: len(scene.names)]
    table = shape_table([*kept, *(shape for parts in objects.values() for shape in parts)])
    room = max(_room("", "", None, len(table.kind)), scene.capacity)
    vertices = max(_room("", "", None, len(table.vertices)), len(scene.table.vertices))
    names, owners = zip(*rows, strict=True)
    labels = Labels((*scene.names, *names), (*scene.labels.objects, *owners))
    larger = scene._enlarged(room, vertices, scene.partners)
    return _with(larger, table=_padded(table, room, vertices), labels=labels)


def _items(shapes: Any) -> list[tuple[str, Any]]:
    if shapes is None:
        return []
    if not isinstance(shapes, Mapping) or not all(isinstance(name, str) for name in shapes):
        raise OsikTypeError(f"shapes is {type(shapes).__name__}; a scene takes a dictionary, name to CollisionShape")
    return list(shapes.items())


def _convex_shapes(name: str, given: Any) -> list[ConvexShape]:
    """Return an object's shapes, checked."""
    parts = [given] if isinstance(given, CollisionShape | ConvexShape) else given
    if not isinstance(parts, Sequence) or not all(isinstance(part, CollisionShape | ConvexShape) for part in parts):
        raise OsikTypeError(f"{name!r} is {type(given).__name__}; a scene takes CollisionShapes, or sequences of them")
    made = []
    for part in parts:
        if isinstance(part, CollisionShape):
            if is_traced(part):
                raise OsikTypeError(f"{name!r} is traced: make the scene outside of jit, and move the shape in there")
            if part.frame is not None:
                raise OsikValueError(f"{name!r} is in the frame {part.frame!r}; make it in the world, then attach it")
            part = _added_shape(part)
        if not all(np.isfinite(numbers).all() for numbers in part[1:]):
            raise OsikValueError(f"{name!r} has numbers that are not finite")
        made.append(part)
    return made


def _added_shape(shape: CollisionShape) -> ConvexShape:
    """Return a user's shape in its frame; its numbers are concrete."""
    size, position, rotation = (np.asarray(part, float) for part in (shape.size, shape.position, shape.rotation))
    if shape.hull is not None:
        radius = np.array([float(shape.hull.radius) * abs(size).max(), 0.0, 0.0])
        return ConvexShape(ShapeKind.HULL, radius, position, rotation, np.asarray(shape.hull.vertices, float) * size)
    kinds = {Kind.BOX: ShapeKind.BOX, Kind.CYLINDER: ShapeKind.CYLINDER, Kind.PLANE: ShapeKind.HALF_SPACE}
    round_kind = ShapeKind.CAPSULE if size[1] > 0.0 else ShapeKind.SPHERE
    return ConvexShape(kinds.get(shape.kind, round_kind), size, position, rotation)


def _room(argument: str, what: str, given: int | None, count: int) -> int:
    """Return the capacity that is given, or the next power of two."""
    if given is None:
        return 1 << (count - 1).bit_length() if count else 0
    check_count(argument, given, least=0)
    if count > given:
        raise OsikValueError(f"the scene has {count} {what}, and its {argument} is {given}; give more, or None")
    return given


def _padded(table: ShapeTable, room: int, vertices: int) -> ShapeTable:
    """Return the table with absent rows and zeros behind its vertices."""
    more = room - len(table.kind)
    eyes = np.broadcast_to(np.eye(3), (more, 3, 3))
    padded = {name: np.pad(rows, ((0, more), *[(0, 0)] * (rows.ndim - 1))) for name, rows in table._asdict().items()}
    padded["rotation"] = np.concatenate([table.rotation, eyes])
    padded["vertices"] = np.pad(table.vertices, ((0, vertices - len(table.vertices)), (0, 0)))
    return ShapeTable(**padded)


def _matches(named: Sequence[tuple[str, ...]], pattern: str) -> list[bool]:
    """Return which things have the pattern as a name; if none has it, which have a name that matches it as a glob."""
    exact = [pattern in names for names in named]
    return exact if any(exact) else [any(fnmatch.fnmatchcase(name, pattern) for name in names) for names in named]


def _quoted(name: str) -> str:
    """Return a glob that matches a name alone."""
    return "".join(f"[{sign}]" if sign in "*?[" else sign for sign in name)


def _frame_in_body(robot: Robot, frame: str) -> Pose:
    number = robot.tree.frame(frame)
    return np.asarray(robot.frame_position[number], float), np.asarray(robot.frame_rotation[number], float)


def _body_pose(robot: Robot, body: int, q: Any) -> Pose:
    robot.check_configuration(q)
    placed = kinematics_on_host(robot, np.asarray(q))
    return np.asarray(placed.body_position[body], float), np.asarray(placed.body_rotation[body], float)


def _inverse(pose: Pose) -> Pose:
    return -rotate(pose[1].T, pose[0]), pose[1].T
