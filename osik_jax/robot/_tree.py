"""Static structure of a robot: hashed, compared and never traced."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

import jax
import mujoco
import numpy as np
from jaxtyping import ArrayLike, Num

from .._errors import OsikKeyError, OsikValueError, unknown_name
from ._load_report import LoadReport

FREE, BALL, SLIDE, HINGE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "BALL", "SLIDE", "HINGE")
)
QPOS_WIDTH = {FREE: 7, BALL: 4, SLIDE: 1, HINGE: 1}
DOF_WIDTH = {FREE: 6, BALL: 3, SLIDE: 1, HINGE: 1}


@dataclasses.dataclass(frozen=True)
class UnreadMesh:
    """Collision mesh of a URDF, whose file is read when distances to it are needed."""

    name: str  # its own; empty where it has none
    link: str  # name of its link
    file: str  # its address, as the URDF has it
    scale: tuple[float, ...]  # of the file's numbers along x, y and z
    position: tuple[float, ...]  # of the shape in its link [m]
    rotation: tuple[tuple[float, ...], ...]  # from the shape's axes to the link's, row by row
    beside: str | None  # path of the URDF, which relative addresses start from; None for a text
    folders: tuple[str, ...]  # where packages are looked for first


@dataclasses.dataclass(frozen=True, eq=False)
class ModelHolder:
    """Sources of a robot: its MuJoCo model, and the collision meshes that the model does not hold.

    Two holders are equal if their models have equal content, so a function of ``jax.jit`` is compiled anew for a robot
    of another file. What a function reads from the model while it is traced is then that robot's own.
    """

    model: mujoco.MjModel | None  # the MuJoCo model; None in a stack of robots whose models differ
    # what the file asks for and the robot does not keep
    report: LoadReport = dataclasses.field(default_factory=LoadReport)
    # collision meshes whose files are not read; they are the last of the tree's geoms
    meshes: tuple[UnreadMesh, ...] = dataclasses.field(default=(), repr=False)
    # visual shapes of a URDF, an ``UnreadLook`` of ``loading``, read when they are drawn; None: those of the model
    look: Any = dataclasses.field(default=None, repr=False)
    # URDF file, whose SRDF is looked for beside it; None: the robot was made from a text or an MJCF
    path: Path | None = dataclasses.field(default=None, repr=False)

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        if not isinstance(other, ModelHolder) or (self.meshes, self.report) != (other.meshes, other.report):
            return False
        return self.model is other.model or self._content == other._content

    def __hash__(self) -> int:
        """Return a hash of sizes alone, because every call of a jitted function needs it."""
        model = self.model
        return hash(None if model is None else (model.nq, model.nv, model.nbody, model.ngeom, len(self.meshes)))

    @cached_property
    def _content(self) -> bytes:
        """Return a digest of the whole model."""
        if self.model is None:
            return b""
        buffer = np.empty(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, buffer)
        return hashlib.blake2b(buffer.tobytes(), digest_size=16).digest()


_Arrays = TypeVar("_Arrays")


class cached_arrays(Generic[_Arrays]):
    """Variant of ``cached_property`` for NumPy arrays: computed once, and copied at each access.

    JAX remembers in which precision it has read an array object. Where ``jax_enable_x64`` changes while a robot lives,
    an object that was read before would have the wrong one.
    """

    def __init__(self, compute: Callable[[Any], _Arrays]):
        self.compute, self.name, self.__doc__ = compute, f"_cached_{compute.__name__}", compute.__doc__

    def __get__(self, tree: Any, owner: type | None = None) -> _Arrays:
        """Return a copy of the arrays; they are computed on the first access."""
        if tree is None:
            return cast(_Arrays, self)
        if self.name not in tree.__dict__:
            tree.__dict__[self.name] = self.compute(tree)
        return jax.tree.map(np.copy, tree.__dict__[self.name])


@dataclasses.dataclass(frozen=True)
class KinematicTree:
    """Names and topology of a robot. Two robots with equal trees can be stacked and vmapped over.

    Joints are all of the MuJoCo model's, in its order. A joint is *independent* (it owns entries of ``q`` and ``v``),
    a *follower* (``q_follower = multiplier * q_leader + offset``) or *locked* (its value is a constant). Links without
    a joint are fused into the body they are fixed to and stay as frames. Geoms are the MuJoCo model's, in its order,
    then the collision meshes that it does not hold (``ModelHolder.meshes``).
    """

    body_names: tuple[str, ...]  # name of each moving body; body 0 is the world
    body_parents: tuple[int, ...]  # index of each body's parent (0 for the world itself)
    joint_names: tuple[str, ...]
    joint_types: tuple[int, ...]  # MuJoCo's joint types
    joint_bodies: tuple[int, ...]  # the body that each joint moves
    frame_names: tuple[str, ...]  # every name that can be asked for: bodies, URDF links, sites, geoms
    frame_bodies: tuple[int, ...]  # the body that each frame is fixed to
    geom_names: tuple[str, ...] = ()
    geom_types: tuple[int, ...] = ()  # MuJoCo's geom types
    geom_bodies: tuple[int, ...] = ()  # the body that each geom is fixed to
    followers: tuple[tuple[int, int, float], ...] = ()  # (follower, leader, multiplier), hinges and slides only
    locked: tuple[int, ...] = ()  # locked joints
    # topmost bodies of each tree of the scene that may be the robot; empty: all that moves is one robot
    robots: tuple[tuple[int, ...], ...] = ()

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        """Return the hash, computed once because every call of a jitted function needs it."""
        return hash(tuple(getattr(self, field.name) for field in dataclasses.fields(self)))

    @cached_property
    def independent(self) -> tuple[int, ...]:
        """Return joints that own entries of q and v."""
        dependent = {f for f, _, _ in self.followers} | set(self.locked)
        return tuple(j for j in range(len(self.joint_names)) if j not in dependent)

    @cached_property
    def dof_owners(self) -> str:
        """Return the names of the joints that own entries of v, in its order; a task's robot must have the same."""
        return ", ".join(self.joint_names[j] for j in self.independent)

    @cached_arrays
    def full_qpos_address(self) -> np.ndarray:
        """Return the index of each joint in the MuJoCo model's qpos, then one past the end."""
        return np.cumsum([0, *(QPOS_WIDTH[t] for t in self.joint_types)])

    @cached_arrays
    def full_dof_address(self) -> np.ndarray:
        """Return the index of each joint in the MuJoCo model's qvel, then one past the end."""
        return np.cumsum([0, *(DOF_WIDTH[t] for t in self.joint_types)])

    @cached_arrays
    def own_qpos(self) -> np.ndarray:
        """Return the index in the MuJoCo model's qpos of each entry of q. (nq,)."""
        joints = np.repeat(np.arange(len(self.joint_types)), [QPOS_WIDTH[t] for t in self.joint_types])
        return np.flatnonzero(np.isin(joints, self.independent))

    @cached_arrays
    def own_dofs(self) -> np.ndarray:
        """Return the index in the MuJoCo model's qvel of each entry of v. (nv,)."""
        return np.flatnonzero(np.isin(self.dof_joint, self.independent))

    @cached_property
    def qpos_address(self) -> dict[int, int]:
        """Return the index in q of each independent joint."""
        return self._addresses(QPOS_WIDTH)

    @cached_property
    def dof_address(self) -> dict[int, int]:
        """Return the index in v of each independent joint."""
        return self._addresses(DOF_WIDTH)

    def _addresses(self, width: Mapping[int, int]) -> dict[int, int]:
        widths = [width[self.joint_types[j]] for j in self.independent]
        return dict(zip(self.independent, np.cumsum([0, *widths])[:-1].tolist(), strict=True))

    def dofs(self, joint: int) -> slice:
        """Return the entries of v of an independent joint."""
        start = self.dof_address[joint]
        return slice(start, start + DOF_WIDTH[self.joint_types[joint]])

    @cached_property
    def quaternions(self) -> tuple[int, ...]:
        """Return the index in q of the first entry of each quaternion."""
        ends = ((at + QPOS_WIDTH[self.joint_types[joint]], joint) for joint, at in self.qpos_address.items())
        return tuple(end - 4 for end, joint in ends if self.joint_types[joint] in (FREE, BALL))

    @cached_property
    def nq(self) -> int:
        """Return the length of q."""
        return sum(QPOS_WIDTH[self.joint_types[j]] for j in self.independent)

    @cached_property
    def nv(self) -> int:
        """Return the length of v."""
        return sum(DOF_WIDTH[self.joint_types[j]] for j in self.independent)

    @cached_arrays
    def turning(self) -> np.ndarray:
        """Return which entries of v rotate a body; slides and a base's translation bend no path. (nv,), bool."""
        parts = {FREE: [False] * 3 + [True] * 3, BALL: [True] * 3, SLIDE: [False], HINGE: [True]}
        return np.array([turns for j in self.independent for turns in parts[self.joint_types[j]]], bool)

    @cached_arrays
    def qpos_source(self) -> tuple[np.ndarray, np.ndarray]:
        """Return ``(index, coefficient)``: full qpos = coefficient * q[index] + offset (coefficient 0 where locked)."""
        n = int(self.full_qpos_address[-1])
        index, coefficient = np.zeros(n, int), np.zeros(n)
        index[self.own_qpos], coefficient[self.own_qpos] = np.arange(self.nq), 1.0
        for follower, leader, multiplier in self.followers:
            index[self.full_qpos_address[follower]] = self.qpos_address[leader]
            coefficient[self.full_qpos_address[follower]] = multiplier
        return index, coefficient

    @cached_arrays
    def dof_columns(self) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
        """Return the terms that sum full Jacobian columns to columns of v: ``sum of J_full[:, index] * coefficient``.

        The first pair takes each independent joint's own columns; each further pair adds one follower to its leader.
        """
        terms = [(self.own_dofs, np.ones(self.nv))]
        for follower, leader, multiplier in self.followers:
            dof = self.dof_address[leader]
            free = next((term for term in terms[1:] if term[1][dof] == 0.0), None)
            if free is None:
                free = np.zeros(self.nv, int), np.zeros(self.nv)
                terms.append(free)
            free[0][dof], free[1][dof] = self.full_dof_address[follower], multiplier
        return tuple(terms)

    @cached_arrays
    def dof_joint(self) -> np.ndarray:
        """Return the joint that each full dof belongs to."""
        return np.repeat(np.arange(len(self.joint_types)), [DOF_WIDTH[t] for t in self.joint_types])

    @cached_arrays
    def dof_body(self) -> np.ndarray:
        """Return the body that each full dof moves."""
        return np.asarray(self.joint_bodies, int)[self.dof_joint]

    @cached_arrays
    def parents(self) -> np.ndarray:
        """Return ``body_parents`` as an array, of JAX's integers in either precision."""
        return np.asarray(self.body_parents, np.int32)

    @cached_property
    def reference_body(self) -> int:
        """Return the first moving body (else the world), about whose origin points are summed to keep digits."""
        return min(1, len(self.body_parents) - 1)

    @cached_property
    def tops(self) -> tuple[int, ...]:
        """Return topmost bodies of the robot; raise ValueError if several trees of the scene may be the robot."""
        if len(self.robots) > 1:
            found = ", ".join(self.body_names[tops[0]] for tops in self.robots)
            raise OsikValueError(
                f"the scene has {len(self.robots)} trees that may be the robot, and the centre of mass, the momentum "
                f"and the base are one robot's. Name a body of it when the scene is loaded, root=NAME, or several of "
                f"them for all; trees: {found}"
            )
        return self.robots[0] if self.robots else self._below_the_world

    @cached_property
    def root(self) -> int:
        """Return the first body of the robot that moves, or the world where nothing moves; ValueError as ``tops``."""
        return self.tops[0] if self.tops else 0

    @cached_arrays
    def is_own(self) -> np.ndarray:
        """Return which bodies belong to the robot and not to the scene; ValueError as ``tops``. (nbody,), bool."""
        return np.asarray(self.descendants[list(self.tops)].any(0))

    @cached_property
    def free_bases(self) -> tuple[int, ...]:
        """Return the free joints, not locked, of the robot's base; those of all robots if several may be meant."""
        tops = {top for tops in self.robots for top in tops} or set(self._below_the_world)
        return tuple(j for j in self.independent if self.joint_types[j] == FREE and self.joint_bodies[j] in tops)

    @cached_property
    def _below_the_world(self) -> tuple[int, ...]:
        return tuple(body for body, parent in enumerate(self.body_parents) if body and not parent)

    @cached_arrays
    def doublings(self) -> np.ndarray:
        """Return each body's parent, then its ancestor 2, 4, ... levels up, until all are the world. (k, nbody)."""
        rounds, above = [], self.parents
        while above.any():
            rounds.append(above)
            above = above[above]
        return np.array(rounds, int).reshape(-1, len(self.parents))

    @cached_arrays
    def descendants(self) -> np.ndarray:
        """Return an array in which ``[a, b]`` says whether body b is a or below it. (nbody, nbody), bool."""
        n = len(self.body_parents)
        below = np.eye(n, dtype=bool)
        for body in range(n - 1, 0, -1):
            below[self.body_parents[body]] |= below[body]
        return below

    @cached_arrays
    def moves(self) -> np.ndarray:
        """Return an array in which ``[b, i]`` says whether full dof i moves body b. (nbody, full nv), bool."""
        return self.descendants[self.dof_body].T

    def frame(self, name: str) -> int:
        """Return the index of a frame; raise KeyError with the existing frames if there is no such frame."""
        try:
            return self._frame_index[name]
        except (KeyError, TypeError):
            raise unknown_name("frame", name, self.frame_names) from None

    def joint(self, name: str) -> int:
        """Return the index of any joint; raise KeyError with the existing joints if there is no such joint."""
        try:
            return self._joint_index[name]
        except (KeyError, TypeError):
            raise unknown_name("joint", name, self.joint_names) from None

    def owner(self, name: str) -> int:
        """Return the independent joint that moves a joint: its leader, or itself; raise KeyError if it is locked."""
        joint = self.joint(name)
        if joint in self.locked:
            names = (self.joint_names[j] for j in self.independent if self.joint_types[j] != FREE)
            raise OsikKeyError(f"joint {name!r} is locked, so it has no place in q; joints: {', '.join(names)}")
        return {follower: leader for follower, leader, _ in self.followers}.get(joint, joint)

    @cached_property
    def _frame_index(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.frame_names)}

    @cached_property
    def _joint_index(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.joint_names)}


def check_shape(tree: KinematicTree, q: Num[ArrayLike, " nq"] | Sequence[float], name: str) -> None:
    """Raise ValueError unless q has the shape of one configuration."""
    if np.shape(q) != (tree.nq,):
        raise OsikValueError(
            f"{name} has shape {np.shape(q)}, this robot's configurations have shape ({tree.nq},): {tree.dof_owners}. "
            "Batch with jax.vmap."
        )
