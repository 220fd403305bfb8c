"""Forward kinematics, frame Jacobians, centre of mass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Num

from .._errors import OsikTypeError, OsikValueError
from ..core import _cuda
from ..execution._backends import Backend, takes
from ..execution._computed import by_kernel
from ..execution._platform import cuda_is_default
from ..numerics._host import Numbers, is_traced, module_of, to_jax
from ..robot import Robot
from ..robot._configuration import check_configuration
from ..robot._made_for import check_robot
from ..robot._tree import BALL, FREE, HINGE, SLIDE, KinematicTree
from ..robot.loading._mjmodel import LEAST_MASS
from . import _kernels
from ._composition import world_poses
from ._joints import dof_kinds, joint_transforms
from ._rigid import compose_poses, cross, rotate

Moving = tuple[Float[Array, "k 3"], Float[Array, "k 3 3"], Float[Array, "k 6 nv"]]


class Kinematics(eqx.Module):
    """Poses of all bodies and axes of all dofs at one configuration, in world axes.

    Attributes:
        body_position: origin of each body [m]. (nbody, 3)
        body_rotation: from each body's axes to the world's. (nbody, 3, 3)
        dof_linear: direction in which each dof translates its body, 0 for rotations. (full nv, 3)
        dof_angular: axis about which each dof turns its body, 0 for translations. (full nv, 3)
        dof_anchor: a point on that axis [m]. (full nv, 3)
        backend: backend of these arrays, and of Jacobians made from them; see ``WeightedQP.backend`` (static).
    """

    body_position: Float[Numbers, "nbody 3"]
    body_rotation: Float[Numbers, "nbody 3 3"]
    dof_linear: Float[Numbers, "nvfull 3"]
    dof_angular: Float[Numbers, "nvfull 3"]
    dof_anchor: Float[Numbers, "nvfull 3"]
    backend: Backend = eqx.field(default="jax", static=True)

    def frame_pose(self, robot: Robot, name: str) -> tuple[Float[Numbers, "3"], Float[Numbers, "3 3"]]:
        """Return the pose of a body, link, site or geom, in the form of a task's target.

        Args:
            robot: the robot.
            name: one of ``robot.frame_names``.

        Returns:
            The position of the frame's origin in the world [m], (3,), and the rotation from its axes to the world's,
            (3, 3).

        Raises:
            KeyError: no such frame.
        """
        poses = _poses_of(robot, self, (name,))
        return _first(poses) if module_of(poses[0]) is np else _one(poses)

    def frame_poses(self, robot: Robot, names: Sequence[str]) -> tuple[Float[Numbers, "k 3"], Float[Numbers, "k 3 3"]]:
        """Return positions and rotations of several frames.

        Raises:
            KeyError: no such frame.
        """
        return _poses_of(robot, self, names)


def _first(arrays: Any) -> Any:
    """Return the first of each array's rows."""
    return jax.tree.map(lambda a: a[0], arrays)


_one = jax.jit(_first)


# functions in place of methods: Equinox copies its object at each call of a method
def _poses_of(robot: Robot, kinematics: Kinematics, names: Sequence[str]) -> tuple[Numbers, Numbers]:
    frames = tuple(robot.tree.frame(name) for name in names)
    poses, fixed = (kinematics.body_position, kinematics.body_rotation), (robot.frame_position, robot.frame_rotation)
    if module_of(poses[0]) is np and not is_traced(fixed):
        return _place_frames(robot.tree, frames, *map(np.asarray, (*poses, *fixed)))
    return _frame_poses(robot.tree, frames, *poses, *fixed)


def _place_frames(
    tree: KinematicTree, frames: tuple[int, ...], position: Numbers, rotation: Numbers, offset: Numbers, turn: Numbers
) -> tuple[Float[Numbers, "k 3"], Float[Numbers, "k 3 3"]]:
    ids = np.array(frames, int)
    bodies = np.asarray(tree.frame_bodies, int)[ids]
    return compose_poses((position[bodies], rotation[bodies]), (offset[ids], turn[ids]))


_frame_poses = jax.jit(_place_frames, static_argnums=(0, 1), inline=True)


def check_kinematics(robot: Robot, kinematics: Any) -> None:
    """Raise TypeError unless it is a ``Kinematics``, ValueError for a batch, or other numbers of bodies or dofs."""
    if not isinstance(kinematics, Kinematics):
        raise OsikTypeError(
            f"kinematics is a {type(kinematics).__name__}; it is what forward_kinematics(robot, q) returns"
        )
    sizes = [jnp.shape(a) for a in (kinematics.body_position, kinematics.dof_linear)]
    own = [(len(robot.tree.body_names), 3), (len(robot.tree.dof_body), 3)]
    if [len(size) for size in sizes] != [2, 2]:
        raise OsikValueError(
            f"kinematics has body_position of shape {sizes[0]}, this robot's {own[0]}. Batch with jax.vmap."
        )
    if sizes != own:
        raise OsikValueError(
            f"kinematics has {sizes[0][0]} bodies and {sizes[1][0]} dofs, this robot {own[0][0]} and {own[1][0]}: "
            "it is that of another robot"
        )


def forward_kinematics(robot: Robot, q: Num[ArrayLike, " nq"] | Sequence[float]) -> Kinematics:
    """Return the poses of all bodies and motion axes of all dofs at configuration q, compiled on first use.

    Quaternions are normalised first.

    Raises:
        TypeError: robot is no Robot.
        ValueError: q has the wrong length, or (outside jit) is not finite or holds a quaternion of zeros; robot is a
            stack of robots.
    """
    check_robot(robot, "forward_kinematics(robot, q)")
    check_configuration(robot, q, "q")
    return _forward_kinematics(robot, jnp.asarray(q))


def kinematics_at(robot: Robot, q: Float[Numbers, " nq"]) -> Kinematics:
    local = joint_transforms(robot, robot.mujoco_qpos(q))
    position, rotation = world_poses(robot.tree, local.position, local.rotation)
    joint_parents = robot.tree.parents[np.asarray(robot.tree.joint_bodies, int)]
    turn = rotation[joint_parents]
    anchor = position[joint_parents] + rotate(turn, local.anchor)
    linear, angular = _motion_axes(robot.tree, rotate(turn, local.axis), rotation)
    anchor = anchor[robot.tree.dof_joint]
    if module_of(q) is jnp and cuda_is_default():  # or XLA gathers them anew in each Jacobian
        linear, angular, anchor = jax.lax.optimization_barrier((linear, angular, anchor))
    return Kinematics(position, rotation, linear, angular, anchor)


_forward_kinematics = jax.jit(kinematics_at)


def kinematics_by(backend: Backend, robot: Robot, q: Float[Array, " nq"]) -> Kinematics:
    """Return ``forward_kinematics`` by the compiled core if possible; Jacobians of the result use the same backend."""
    if not takes(backend, "core", fits=True) or (cuda_is_default() and not _cuda.installed()):
        return forward_kinematics(robot, q)
    check_configuration(robot, q, "q")
    return Kinematics(*_bodies(robot, q), backend=backend)


def frame_jacobian(robot: Robot, kinematics: Kinematics, name: str | Sequence[str]) -> Float[Array, "*k 6 nv"]:
    """Return the jacobian of a frame: [linear; angular] velocity = J v, world axes, at the frame's origin.

    Args:
        robot: the robot.
        kinematics: of its configuration.
        name: of the frame; a sequence of k names gives (k, 6, nv).

    Raises:
        KeyError: no such frame.
        TypeError: ``kinematics`` is something else, such as a configuration.
        ValueError: it is a batch, or has other numbers of bodies or dofs than the robot.
    """
    if isinstance(name, str):
        return _one(frame_jacobian(robot, kinematics, (name,)))
    check_kinematics(robot, kinematics)
    return _frame_jacobians(robot, kinematics, tuple(robot.tree.frame(one) for one in name))


@partial(jax.jit, static_argnums=2)
def _frame_jacobians(robot: Robot, kinematics: Kinematics, frames: tuple[int, ...]) -> Float[Array, "k 6 nv"]:
    ids = np.array(frames, int)
    bodies = np.asarray(robot.tree.frame_bodies, int)[ids]
    points = kinematics.body_position[bodies] + rotate(kinematics.body_rotation[bodies], robot.frame_position[ids])
    mask = robot.tree.moves[bodies][:, None, :]
    axis = kinematics.dof_angular.T
    linear = kinematics.dof_linear.T + cross(axis, points[:, :, None] - kinematics.dof_anchor.T, along=-2)
    columns = jnp.concatenate([linear, jnp.broadcast_to(axis, linear.shape)], -2)
    return independent_columns(robot.tree, jnp.where(mask, columns, 0.0))


def moving_frames(robot: Robot, kinematics: Kinematics, names: Sequence[str]) -> Moving:
    """Return positions (k, 3), rotations (k, 3, 3) and Jacobians (k, 6, nv) of several frames."""
    if kinematics.backend == "jax":
        return *kinematics.frame_poses(robot, names), frame_jacobian(robot, kinematics, names)
    for name in names:
        robot.tree.frame(name)
    return _moving_frames(robot, replace(kinematics, backend="jax"), names=tuple(names))


def center_of_mass(robot: Robot, kinematics: Kinematics, subtree: str | None = None) -> Float[Numbers, "3"]:
    """Return the centre of mass in the world [m], of the robot or of the body ``subtree`` with its descendants.

    Bodies fixed to the world (an arm's base) do not count, as in Pinocchio and unlike MuJoCo; nor do loose bodies of a
    scene. A frame that is not a body stands for the moving body that carries it.

    Raises:
        KeyError: no such body.
        ValueError: the subtree has no mass, or the scene has several trees that may be the robot.
    """
    check_kinematics(robot, kinematics)
    arrays = body_masses(robot, subtree), robot.body_com, kinematics.body_position, kinematics.body_rotation
    if module_of(kinematics.body_position) is np and not is_traced(arrays):
        return _mean(*map(np.asarray, arrays))
    return _center(*arrays)


def _mean(mass: Numbers, center: Numbers, position: Numbers, rotation: Numbers) -> Float[Numbers, "3"]:
    return _moments(mass, center, position, rotation).sum(0) / mass.sum()


_center = jax.jit(_mean, inline=True)


def com_jacobian(robot: Robot, kinematics: Kinematics, subtree: str | None = None) -> Float[Array, "3 nv"]:
    """Return the jacobian of ``center_of_mass``: its velocity in world axes = J v.

    Raises:
        KeyError, ValueError: as in ``center_of_mass``.
    """
    check_kinematics(robot, kinematics)
    return _com_jacobian(_with_masses(robot, subtree), kinematics)


def moving_center(
    robot: Robot, kinematics: Kinematics, subtree: str | None = None
) -> tuple[Float[Array, "3"], Float[Array, "3 nv"]]:
    """Return ``center_of_mass`` and ``com_jacobian``."""
    alone = _with_masses(robot, subtree)
    if kinematics.backend == "jax":
        return _center_and_jacobian(alone, kinematics)
    return _moving_center(alone, replace(kinematics, backend="jax"))


def _with_masses(robot: Robot, subtree: str | None) -> Robot:
    """Return the robot with the masses of ``body_masses``."""
    mass = body_masses(robot, subtree)
    return robot if mass is robot.body_mass else eqx.tree_at(lambda robot: robot.body_mass, robot, mass)


def _center_and_jacobian(robot: Robot, kinematics: Kinematics) -> tuple[Float[Array, "3"], Float[Array, "3 nv"]]:
    """Return the centre of all masses, and its Jacobian."""
    mass, poses = robot.body_mass, (kinematics.body_position, kinematics.body_rotation)
    moment = _moments(mass, robot.body_com, *poses)
    carried = jnp.asarray(robot.tree.moves, mass.dtype)
    mass_below, moment_below = (jnp.matmul(a.T, carried, precision="highest") for a in (mass, moment))
    arm = moment_below - mass_below * kinematics.dof_anchor.T
    columns = mass_below * kinematics.dof_linear.T + cross(kinematics.dof_angular.T, arm, along=-2)
    center = jnp.sum(moment, 0) / jnp.sum(mass)
    return center, independent_columns(robot.tree, columns / jnp.sum(mass))


@jax.jit
def _com_jacobian(robot: Robot, kinematics: Kinematics) -> Float[Array, "3 nv"]:
    return _center_and_jacobian(robot, kinematics)[1]


def independent_columns(tree: KinematicTree, jacobian: Float[Array, "... nvfull"]) -> Float[Array, "... nv"]:
    """Return columns for v from columns for all dofs: locked dofs are left out, followers are added to leaders."""
    (own, _), *followers = tree.dof_columns
    reduced = jacobian if len(own) == jacobian.shape[-1] else jacobian[..., own]
    for index, coefficient in followers:
        reduced = reduced + jacobian[..., index] * coefficient
    return reduced


def _motion_axes(
    tree: KinematicTree, axis: Float[Numbers, "njoint 3"], rotation: Float[Numbers, "nbody 3 3"]
) -> tuple[Float[Numbers, "nvfull 3"], Float[Numbers, "nvfull 3"]]:
    """Return the linear and angular direction of each dof, in the world: MuJoCo's tangent convention."""
    xp, (kinds, number) = module_of(axis), dof_kinds(tree)
    hinge, slide = kinds == HINGE, kinds == SLIDE
    translates = (kinds == FREE) & (number < 3)
    turns = (kinds == BALL) | ((kinds == FREE) & (number >= 3))
    own = axis[tree.dof_joint]
    angular = xp.where(hinge[:, None], own, 0.0)
    linear = xp.where(slide[:, None], own, 0.0) + np.eye(3)[number % 3] * translates[:, None]
    if turns.any():
        angular = xp.where(turns[:, None], rotation[tree.dof_body, :, number % 3], angular)
    return linear, angular


def _moments(mass: Numbers, center: Numbers, position: Numbers, rotation: Numbers) -> Float[Numbers, "nbody 3"]:
    """Return each body's mass times its centre of mass in the world [kg m]."""
    return mass[:, None] * (position + rotate(rotation, center))


def body_masses(robot: Robot, subtree: str | None = None) -> Float[Array, " nbody"]:
    """Return the mass of each body [kg], 0 outside the subtree, or outside the robot."""
    mass, tree = robot.body_mass, robot.tree
    if subtree is None:
        own = tree.is_own
        if not isinstance(mass, Tracer) and not np.asarray(mass)[..., own].sum() > LEAST_MASS * len(own):
            raise OsikValueError(
                "the robot has no mass, so it has no centre of mass, momentum or kinetic energy: "
                "give a link of its file an inertial"
            )
        return mass if own[1:].all() else _masked(mass, own)
    below = tree.descendants[tree.frame_bodies[tree.frame(subtree)]]
    if not isinstance(mass, Tracer) and not np.asarray(mass)[below].sum() > 0.0:
        raise OsikValueError(f"the subtree of {subtree!r} has no mass, so it has no centre of mass")
    return _masked(mass, below)


def _masked(mass: Float[Array, " nbody"], own: np.ndarray) -> Float[Array, " nbody"]:
    """Return the masses, 0 where a body is not own."""
    return jnp.where(own, mass, 0.0) if isinstance(mass, Tracer) else to_jax(np.where(own, np.asarray(mass), 0.0))


def _fields(robot: Robot, q: Float[Array, " nq"]) -> tuple[Array, ...]:
    """Return the arrays of the kinematics."""
    return tuple(jax.tree.leaves(forward_kinematics(robot, q)))


def _frames_by_kernel(
    call: _kernels.Call, robot: Robot, kinematics: Kinematics, *, names: tuple[str, ...]
) -> tuple[Array, Array, Array]:
    return _kernels.moving_frames(call, robot, kinematics, [robot.tree.frame(name) for name in names])


_bodies = by_kernel(_fields, _kernels.bodies)
_moving_frames = by_kernel(moving_frames, _frames_by_kernel)
_moving_center = by_kernel(_center_and_jacobian, _kernels.center_of_mass)


def home_kinematics(robot: Robot) -> Kinematics:
    """Return the kinematics at the robot's home configuration: arrays of NumPy, unless the robot is traced."""
    return kinematics_on_host(robot, robot.q0)


def kinematics_on_host(robot: Robot, q: Float[Numbers, " nq"]) -> Kinematics:
    """Return ``forward_kinematics`` as arrays of NumPy, or of JAX if the robot or q is traced."""
    if is_traced((robot, q)):
        return forward_kinematics(robot, q)
    check_robot(robot, "forward_kinematics(robot, q)")
    check_configuration(robot, q, "q")
    host = jax.tree.map(lambda leaf: np.asarray(leaf, float), robot)
    found = kinematics_at(host, np.asarray(q, float))
    return jax.tree.map(lambda leaf: leaf.astype(robot.q0.dtype), found)
