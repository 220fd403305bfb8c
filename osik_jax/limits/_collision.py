"""Collision avoidance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, Literal, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikTypeError, OsikValueError, unknown_name, warn
from ..collision._core import require_core
from ..collision._distance import Nearest
from ..collision._geometry import Kind, UnitCore, padded
from ..collision._near_rows import KeptShapes, all_distances, kept_shapes, near_rows, pair_names
from ..collision._pair_layout import Hulls, PairLayout, Placed, grouped, nearest, place, read_hulls, separation_jacobian
from ..collision._pairs import Member, Patterns, candidate_pairs, exact_pairs, members
from ..collision._robot_shapes import Given, robot_shapes
from ..collision._scene import Scene, check_scene
from ..collision._shape import CollisionShape
from ..kinematics import Kinematics
from ..kinematics._forward import home_kinematics
from ..numerics._arguments import as_scalar, as_vector, concrete
from ..numerics._guarded import at_most_inverse
from ..numerics._host import Numbers, is_traced, to_jax, tree_to_jax
from ..robot import Robot
from ._box import Limit, LimitRows, Time


class CollisionAvoidanceLimit(Limit):
    """Limit that keeps the robot's geoms a distance from each other and from the world.

    Each pair has the signed distance d between its shapes, the unit normal n from one to the other and the Jacobians of
    the nearest points a and b. The ``max_pairs`` pairs with the shortest time to contact, with all joints equally fast,
    give a row each:

        n' (J_b - J_a) v >= -min(gain, 1 / dt) (d - minimum_distance)           where d < detection_distance

    A pair nearer than ``minimum_distance`` parts at no more than ``recovery_speed``. Rows are those of the start of a
    step. Over the step, turning shapes come nearer by about ``(omega dt)**2 r / 2`` more than the rows allow, with
    their relative angular velocity omega and the distance r of the nearest point from its axis. Choose
    ``minimum_distance`` accordingly. The other pairs are free for the step.

    Geoms: planes, spheres, capsules, boxes, cylinders (as prisms of 16 sides around them), ellipsoids (as polyhedra of
    42 corners around them, up to 7 % larger) and meshes (as their convex hulls). Height fields and SDFs have no
    distance. Default pairs are those that MuJoCo would let collide, by the masks ``contype`` and ``conaffinity`` and
    the model's ``<exclude>``. Pairs of one body, or of bodies with one joint between them, are left out; locked joints
    do not count as joints.

    The distance is exact and once differentiable, except where faces or edges come to lie flat on each other: there the
    nearest points jump. If a mesh or an ellipsoid overlaps another shape, the depth is overestimated where edges cross.

    Args:
        robot: the robot.
        scene: obstacles, as of ``inverse_kinematics``. The ``max_pairs`` nearest pairs that are nearer than
            ``detection_distance`` then give the rows, by the exact distances of the convex shapes, and the core finds
            them. The robot's own shapes are kept apart too; ``Scene({})`` for these alone. It goes without
            ``pairs``, ``exclude`` and ``shapes``.
        srdf: with a scene: pairs that may touch, as for ``inverse_kinematics``.
        pairs: pairs to keep apart: names or globs of geoms, shapes, links or bodies (``"world"``), such as
            ``[("*hand*", "torso")]``. Masks then do not count, and pairs given by names, not by a glob, are kept
            however near they are. None: all default pairs.
        exclude: names or globs of shapes, links or bodies to leave out, or pairs of them.
        shapes: obstacles, and shapes of links without geoms, by name. They are kept off all geoms with masks.
        minimum_distance: least distance [m]; may be negative.
        detection_distance: distance beyond which a pair is free [m].
        gain: rate of the approach to ``minimum_distance`` [1/s]; more than 1 / dt counts as 1 / dt.
        recovery_speed: greatest speed at which pairs that are too near must part [m/s]. 0: they must not come nearer.
        q0_distance: pairs nearer than this at ``q0`` are left out [m], such as soles on the floor, or links whose geoms
            overlap by construction; ``left_out`` has them. ``-inf``: no pair is left out. None: ``minimum_distance``,
            but pairs that ``pairs`` gives by name are kept.
        max_pairs: number of rows (static).

    Raises:
        KeyError: a name matches nothing.
        OsikError: a scene without the compiled core, or on a GPU.
        TypeError: no scene, or a scene together with ``pairs``, ``exclude`` or ``shapes``.
        ValueError: no pair is left, a stack of scenes, or a number or shape does not fit.

    Warns:
        OsikWarning: pairs are left out because they are too near at ``q0``.

    Attributes:
        left_out: names of the shapes of the pairs that are not kept apart because they are too near at ``q0`` (static).
    """

    kind: ClassVar[Literal["velocity", "position"]] = "velocity"
    sees_places: ClassVar[bool] = True
    minimum_distance: Float[Array, ""]
    detection_distance: Float[Array, ""]
    gain: Float[Array, ""]
    recovery_speed: Float[Array, ""]
    shapes: Placed
    hulls: UnitCore | None
    layout: PairLayout = eqx.field(static=True, repr=False)
    scene: Scene | None
    kept: KeptShapes | None = eqx.field(static=True, repr=False)
    max_pairs: int = eqx.field(static=True)
    left_out: tuple[tuple[str, str], ...] = eqx.field(static=True)

    def __init__(
        self,
        robot: Robot,
        *,
        scene: Scene | None = None,
        srdf: Given = None,
        pairs: Patterns | None = None,
        exclude: Iterable[str | tuple[str, str]] = (),
        shapes: Mapping[str, CollisionShape] | None = None,
        minimum_distance: ArrayLike | Array = 0.01,
        detection_distance: ArrayLike | Array = 0.25,
        gain: ArrayLike | Array = 20.0,
        recovery_speed: ArrayLike | Array = 0.5,
        q0_distance: float | None = None,
        max_pairs: int = 20,
    ):
        if isinstance(max_pairs, bool) or not isinstance(max_pairs, int) or max_pairs < 1:
            raise OsikValueError(f"max_pairs is {max_pairs!r}; it is the number of rows, an integer from 1 up")
        dtype = robot.q0.dtype
        self.minimum_distance = _number(minimum_distance, "minimum_distance", dtype)
        self.detection_distance = _number(detection_distance, "detection_distance", dtype)
        self.gain = _number(gain, "gain", dtype)
        self.recovery_speed = _number(recovery_speed, "recovery_speed", dtype)
        self._check()
        self.scene, self.kept = (scene if scene is None else tree_to_jax(scene)), None
        if scene is not None or srdf is not None:
            self._keep_off(robot, srdf, q0_distance, max_pairs, pairs is None and shapes is None and not exclude)
            return
        shapes, pairs = dict(shapes or {}), None if pairs is None else list(pairs)
        found = members(robot, shapes)
        possible = candidate_pairs(robot, found, pairs, exclude)
        hulls, possible = read_hulls(robot, found, shapes, possible)
        least = self.minimum_distance if q0_distance is None else q0_distance
        named = exact_pairs(found, pairs) if q0_distance is None else set()
        kept, near = _apart_at_home(robot, found, shapes, hulls, possible, least, named)
        self.left_out = tuple((found[i].name, found[j].name) for i, j in near)
        if q0_distance is None and near:
            _warn_of_left_out(_shown(found, near), self.minimum_distance)
        self.layout, self.shapes, self.hulls = _assembled(robot, found, shapes, hulls, kept)
        self.max_pairs = min(max_pairs, len(kept))

    def _keep_off(self, robot: Robot, srdf: Given, q0_distance: float | None, max_pairs: int, alone: bool) -> None:
        """Keep the exact shapes of the robot off each other and off the scene."""
        if self.scene is None:
            raise OsikTypeError(
                "srdf goes with a scene: give scene=osik_jax.Scene({}) for the robot's own shapes alone"
            )
        if not alone:
            raise OsikTypeError(
                "scene goes without pairs, exclude and shapes: obstacles are in the scene; srdf and scene.allow say "
                "what may touch"
            )
        require_core("a CollisionAvoidanceLimit with a scene", on_gpu=True)
        check_one_scene(self.scene)
        least = concrete(self.minimum_distance) if q0_distance is None else q0_distance
        if least is None:
            raise OsikTypeError("which pairs are apart at q0 cannot be told from traced numbers; give q0_distance=-inf")
        kept = kept_shapes(robot, robot_shapes(robot, srdf), least=float(least))
        if q0_distance is None and kept.left_out:
            _warn_of_left_out(", ".join(map("-".join, kept.left_out)), self.minimum_distance)
        self.kept, self.left_out, self.max_pairs = kept, kept.left_out, max_pairs
        self.layout, self.shapes, self.hulls = _assembled(robot, [], {}, {}, [])

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Return the names of the shapes of each pair that is kept apart, in the order of ``distances``."""
        return self.layout.pair_names if self.kept is None or self.scene is None else pair_names(self.kept, self.scene)

    def distances(self, robot: Robot, kinematics: Kinematics) -> Float[Array, " pairs"]:
        """Return signed distances [m] of all ``pairs``, negative where they overlap."""
        if self.kept is None or self.scene is None:
            return _distances(self, robot, kinematics)
        return all_distances(self.kept, kinematics, self.scene)

    def sought(self, robot: Robot) -> Limit:
        """Return the limit with a gain of 1."""
        del robot
        return self.replace(gain=1.0)

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"], dt: Time) -> LimitRows:
        """Return lower bounds [m/s] on the rates of distances that could vanish soonest; -inf where free."""
        del q
        if self.kept is not None and self.scene is not None:
            jacobian, lower = near_rows(self.kept, kinematics, self.scene, self.numbers(dt), self.max_pairs)
            return LimitRows(jacobian, lower, jnp.full_like(lower, jnp.inf))
        near = self._nearest(robot, kinematics)
        jacobian = separation_jacobian(robot.tree, kinematics, near, self.layout.pair_bodies)
        gap = near.distance - self.minimum_distance
        soonest = jax.lax.top_k(-_time_to_meet(gap, jacobian), self.max_pairs)[1]
        # with a gain of 1 / dt one step closes the gap; a negative gap asks to part at no more than the recovery speed
        lower = jnp.minimum(-at_most_inverse(self.gain, dt) * gap, self.recovery_speed)
        lower = jnp.where(near.distance < self.detection_distance, lower, -jnp.inf)[soonest]
        return LimitRows(jacobian[soonest], lower, jnp.full_like(lower, jnp.inf))

    @property
    def replaceable(self) -> tuple[str, ...]:
        """Return names that ``replace`` takes; for shapes use ``moved``."""
        return _NUMBERS if self.scene is None else (*_NUMBERS, "scene")

    def numbers(self, dt: Time) -> Float[Numbers, "5"]:
        """Return what the core reads of the limit (``AvoidanceNumbers``), by NumPy unless traced."""
        own = *(getattr(self, name) for name in _NUMBERS), dt
        numbers = jnp if is_traced(own) else np
        return numbers.stack([numbers.asarray(number, self.gain.dtype) for number in own])

    def _convert(self, name: str, value: Any) -> Any:
        if name == "scene":
            check_one_scene(value)
            return value
        return _number(value, name, self.gain.dtype)

    def moved(
        self,
        shape: str,
        *,
        position: ArrayLike | Array | None = None,
        rotation: ArrayLike | Array | None = None,
        size: ArrayLike | Array | None = None,
    ) -> Self:
        """Return the same limit with one of the added shapes somewhere else, or of another size.

        Works inside ``jit``; nothing is compiled again. The rows take obstacles as standing still.

        Args:
            shape: its name.
            position: in its frame [m]; see ``CollisionShape``. (3,)
            rotation: (3, 3)
            size: [m]; see ``CollisionShape``. (3,)

        Raises:
            KeyError: no added shape of this name takes part; the message lists those that do.
            ValueError: a wrong shape.
        """
        if self.scene is not None:
            raise OsikTypeError(f"{shape!r} is moved in the scene: limit.replace(scene=scene.moved({shape!r}, pose))")
        added = self.layout.names[len(self.layout.geoms) :]
        if shape not in added:
            raise unknown_name("added shape", shape, added)
        place, given = added.index(shape), dict(position=position, rotation=rotation, size=size)
        changes = {name: value for name, value in given.items() if value is not None}
        if not changes:
            return self
        new = []
        for name, value in changes.items():
            old = getattr(self.shapes, name)
            new.append(old.at[place].set(as_vector(value, old.shape[1:], name, old.dtype)))
        return eqx.tree_at(lambda limit: [getattr(limit.shapes, name) for name in changes], self, new)

    def _nearest(self, robot: Robot, kinematics: Kinematics) -> Nearest:
        return nearest(self.layout, place(self.layout, robot, kinematics, self.shapes), self.hulls)

    def _check(self) -> None:
        least, most = concrete(self.minimum_distance), concrete(self.detection_distance)
        if least is not None and most is not None and not (most > least).all():
            raise OsikValueError(f"detection_distance is {most}; it has to be more than minimum_distance, {least}")


def check_one_scene(scene: Any) -> None:
    """Raise TypeError unless this is a scene, ValueError if it is a stack of scenes."""
    check_scene(scene)
    if scene.is_stack:
        raise OsikValueError(
            "scene is a stack of scenes, and a limit has one; take them apart with "
            "jax.vmap(lambda scene: limit.replace(scene=scene))(scenes)"
        )


def _time_to_meet(gap: Float[Array, " pairs"], jacobian: Float[Array, "pairs nv"]) -> Float[Array, " pairs"]:
    """Return the time until pairs are too near [s], with each dof at 1 rad/s or m/s in the worst direction."""
    # the choice of pairs is discrete and has no derivative
    gap, jacobian = jax.lax.stop_gradient((gap, jacobian))
    return gap / (jnp.sum(jnp.abs(jacobian), -1) + _SLOWEST)


_SLOWEST = 1e-3
"""[m/s]; orders pairs that nothing brings nearer."""

_NUMBERS = ("minimum_distance", "detection_distance", "gain", "recovery_speed")


def _number(value: ArrayLike | Array, name: str, dtype: Any) -> Float[Array, ""]:
    """Return a scalar leaf; distances may be negative."""
    if not name.endswith("distance"):
        return as_scalar(value, name, dtype)
    out = as_vector(value, (), name, dtype)
    seen = concrete(out)
    if seen is not None and not np.isfinite(seen).all():
        raise OsikValueError(f"{name} is {seen}; it has to be finite [m]")
    return out


def _apart_at_home(
    robot: Robot,
    found: Sequence[Member],
    shapes: Mapping[str, CollisionShape],
    hulls: Hulls,
    possible: Sequence[tuple[int, int]],
    least: Float[Array, ""] | float,
    named: set[tuple[int, int]],
) -> tuple[list[tuple[int, int]], dict[tuple[int, int], float]]:
    """Return the pairs that are given by name or not nearer than ``least`` at q0, and the distances [m] of the rest."""
    if (isinstance(least, float) and least == -np.inf) or named.issuperset(possible):
        return list(possible), {}
    scene, added, cores = _assembled(robot, found, shapes, hulls, possible)
    distances = concrete(_home_distances(robot, scene, added, cores)), concrete(least)
    if distances[0] is None or distances[1] is None:
        raise OsikTypeError("which pairs are apart at q0 cannot be told from traced numbers; give q0_distance=-inf")
    taking_part = _taking_part(possible)
    apart = {
        tuple(sorted((taking_part[i], taking_part[j]))): float(distance)
        for (i, j), distance in zip(scene.pairs, distances[0], strict=True)
    }
    near = {pair: apart[pair] for pair in possible if pair not in named and apart[pair] < distances[1]}
    if len(near) == len(possible):
        raise OsikValueError(
            f"all {len(possible)} pairs are nearer than {least} m at q0; a smaller q0_distance keeps them: "
            f"{_shown(found, near)}"
        )
    return [pair for pair in possible if pair not in near], near


def _warn_of_left_out(shown: str, least: Float[Array, ""]) -> None:
    warn(
        f"these pairs are not kept apart, for at q0 they are nearer than {float(least):g} m: {shown}. Say what is "
        f"meant: their names in pairs keep them, q0_distance=-inf keeps all, exclude or q0_distance={float(least):g} "
        "leaves them out"
    )


def _shown(found: Sequence[Member], near: Mapping[tuple[int, int], float]) -> str:
    """Return pairs with their distances, as text for messages."""
    return ", ".join(f"{found[i].label}-{found[j].label} ({d:.3g} m)" for (i, j), d in near.items())


def _home_distances(robot: Robot, scene: PairLayout, added: Placed, hulls: UnitCore | None) -> Float[Array, " pairs"]:
    @jax.jit
    def distances(robot: Robot, kinematics: Kinematics, added: Placed, hulls: UnitCore | None) -> Array:
        return nearest(scene, place(scene, robot, kinematics, added), hulls).distance

    return distances(robot, home_kinematics(robot), added, hulls)


def _assembled(
    robot: Robot,
    found: Sequence[Member],
    shapes: Mapping[str, CollisionShape],
    hulls: Hulls,
    pairs: Sequence[tuple[int, int]],
) -> tuple[PairLayout, Placed, UnitCore | None]:
    """Return the scene of some pairs of members, its added shapes and its hulls."""
    taking_part = _taking_part(pairs)
    number = {k: n for n, k in enumerate(taking_part)}
    geoms = [k for k in taking_part if not found[k].added]
    added = [found[k].name for k in taking_part[len(geoms) :]]
    kinds = [Kind(found[k].kind) for k in taking_part]
    hulled = [k for k, kind in zip(taking_part, kinds, strict=True) if kind is Kind.HULL]
    scene = PairLayout(
        names=tuple(found[k].name for k in taking_part),
        kinds=tuple(kinds),
        bodies=tuple(found[k].body for k in taking_part),
        geoms=tuple(geoms),
        frames=tuple(robot.tree.frame(shapes[name].frame or robot.tree.body_names[0]) for name in added),
        hulls=tuple(hulled.index(k) if k in hulled else 0 for k in taking_part),
        groups=grouped(kinds, [(number[i], number[j]) for i, j in pairs]),
    )
    dtype = robot.q0.dtype
    placed = Placed(
        *(_stacked([getattr(shapes[name], field) for name in added], like, dtype) for field, like in _PLACED)
    )
    cores = padded([hulls[k] for k in hulled]) if hulled else None
    return scene, placed, jax.tree.map(lambda rows: to_jax(rows, dtype), cores)


_PLACED = (("position", (3,)), ("rotation", (3, 3)), ("size", (3,)))


def _stacked(values: Sequence[Array], shape: tuple[int, ...], dtype: Any) -> Array:
    return to_jax(values if values else np.zeros((0, *shape)), dtype)


def _taking_part(pairs: Sequence[tuple[int, int]]) -> list[int]:
    return sorted({k for pair in pairs for k in pair})


@jax.jit
def _distances(limit: CollisionAvoidanceLimit, robot: Robot, kinematics: Kinematics) -> Float[Array, " pairs"]:
    return limit._nearest(robot, kinematics).distance
