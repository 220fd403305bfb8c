"""Robot: the kinematic model as an immutable pytree."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Self

import jax
import mujoco
from jaxtyping import Array, ArrayLike, DTypeLike, Num

from .._whole_file import write_text
from ..numerics._arguments import float_dtype
from . import loading
from ._configuration import Home, check_configuration, home_configuration, with_joints
from ._describe import described
from ._model import RobotModel
from ._ranges import warn_of_far_joints
from ._replace import Factors, replaced_leaves, scaled_leaves
from .loading import LoadOptions, LockedJoints, PositionLimits


class Robot(RobotModel):
    """A robot's geometry, masses and limits.

    Configurations ``q`` (nq,) are in MuJoCo's qpos layout (a free joint is a position in the world and a unit
    quaternion w, x, y, z) without the entries of locked joints and mimic followers. Velocities ``v`` (nv,) live in the
    tangent space (a free joint is a linear velocity in world axes, then an angular velocity in body axes).

    All arrays are traced leaves: robots with the same tree and other link lengths, masses or limits can be stacked and
    vmapped over (``scaled``, ``osik_jax.stack``). ``mj_model`` is carried along unchanged; it does not follow edits of
    the leaves.

    Attributes:
        tree: names and topology (static).
        body_position: of each body in its parent [m]. (nbody, 3)
        body_quaternion: of each body in its parent, w x y z. (nbody, 4)
        body_mass: [kg]; what is fixed to the world does not count. (nbody,)
        body_com: centre of mass of each body in its own frame [m]. (nbody, 3)
        body_inertia: rotational inertia of each body about its centre of mass, in its own axes [kg m^2]. (nbody, 3, 3)
        joint_position: anchor of each joint in its body [m]. (njoint, 3)
        joint_axis: axis of each joint in its body. (njoint, 3)
        dof_armature: inertia that each dof's drive adds, MuJoCo's ``armature`` [kg m^2 or kg]. (full nv,)
        joint_reference: MuJoCo's qpos0, the joint values at which bodies sit as described. (full nq,)
        frame_position: of each named frame in its body [m]. (nframe, 3)
        frame_rotation: of each named frame in its body. (nframe, 3, 3)
        geom_position: of each of the model's geoms in its body [m]. (ngeom, 3)
        geom_rotation: of each geom in its body. (ngeom, 3, 3)
        geom_size: MuJoCo's sizes of each geom [m]; of a mesh, factors of its vertices. (ngeom, 3)
        qpos_offset: values of locked joints and offsets of followers, 0 elsewhere. (full nq,)
        position_lower: lower joint limits [rad or m], -inf where free. (nv,)
        position_upper: upper joint limits [rad or m], inf where free. The three entries of a ball joint are the
            greatest angle by which it may be turned from its reference, and those of ``position_lower`` minus that.
            (nv,)
        velocity_limit: greatest joint speeds [rad/s or m/s], inf where free. (nv,)
        acceleration_limit: greatest joint accelerations [rad/s^2 or m/s^2], inf where free. (nv,)
        q0: the robot's home configuration. (nq,)
    """

    @classmethod
    def from_urdf(
        cls,
        urdf: str | os.PathLike[str],
        *,
        floating_base: bool | None = None,
        velocity_limits: Mapping[str, float] | None = None,
        position_limits: PositionLimits | None = None,
        locked_joints: LockedJoints = (),
        home: Home | None = None,
        package_dirs: Iterable[str | os.PathLike[str]] = (),
        root: str | Sequence[str] | None = None,
    ) -> Robot:
        """Load a URDF. Boxes, spheres, cylinders and capsules are kept as geoms.

        Mesh files (DAE, STL, OBJ, MSH) are read when a picture or an avoidance of collisions needs them.

        Every link is a frame, with or without a joint of its own. Limits come from ``<limit>``: no ``<limit>`` means
        none, an absent ``lower`` or ``upper`` is 0 as the format has it, and a velocity of 0 or none means unknown,
        so unlimited. ``<safety_controller>`` is not read. A ``<mimic>`` joint is no coordinate of its own: it moves
        with its leader, whose limits its own limits narrow. Moving links without mass get 2e-15 kg in ``mj_model``:
        MuJoCo demands some. What is fixed to the world (the root link of an arm) does not count as the robot's mass.

        Args:
            urdf: path of the file, ``package://`` address, or the XML text itself. Lengths in metres, angles in
                radians.
            floating_base: ``True``: put a free joint, ``floating_base``, on the root link unless the URDF has a
                ``floating`` joint already (below a root link called ``world``: on the one link fixed to it).
                ``False``: the root link is fixed to the world, and ``floating`` joints are locked. ``None``: as the
                file says, if it does: a ``floating`` joint floats, and a root link called ``world`` is the world. A
                URDF that says neither floats if two of its outermost links are called like feet (sole, foot, ankle or
                toe), and is fixed to the world with an ``OsikWarning`` if not.
            velocity_limits: joint name (or glob) to greatest speed [rad/s or m/s]; wins over the file's.
            position_limits: joint name (or glob) to (lower, upper) [rad or m]; wins over the file's. Infinite: free.
            locked_joints: names or globs of joints to freeze at 0, or a mapping from them to the values to freeze at
                [rad or m]. A mimic joint is locked by locking its leader.
            home: what ``q0`` is, see ``with_home``. Default: zeros, brought inside the joints' ranges.
            package_dirs: folders that are ROS packages or hold some, for ``package://`` addresses. Then
                ``ROS_PACKAGE_PATH`` and ``AMENT_PREFIX_PATH`` are looked through, then the folders above the file.
            root: as in ``from_mjcf``.

        Raises:
            FileNotFoundError: no such file; the message says where it was looked for.
            ValueError: the XML or the model in it is broken or cannot be represented (``planar`` joints, several root
                links), or ``home`` does not fit; the message says where.
            KeyError: a mapping or ``locked_joints`` names a joint that does not exist.

        Warns:
            OsikWarning: the base is fixed because nothing in the file looks like feet, or a joint cannot move because
                its range is a single value.
        """
        options = LoadOptions(
            floating_base=floating_base,
            velocity_limits=velocity_limits,
            position_limits=position_limits,
            locked_joints=locked_joints,
            package_dirs=package_dirs,
            root=root,
            has_home=home is not None,
        )
        return cls._of(loading.from_urdf(urdf, options), home)

    @classmethod
    def from_mjcf(
        cls,
        mjcf: str | os.PathLike[str],
        *,
        floating_base: bool | None = None,
        velocity_limits: Mapping[str, float] | None = None,
        position_limits: PositionLimits | None = None,
        locked_joints: LockedJoints = (),
        home: Home | None = None,
        root: str | Sequence[str] | None = None,
    ) -> Robot:
        """Load an MJCF file or text.

        Active joint equality constraints that are linear become exact mimic joints, those without a second joint lock
        the first; an ``EqualityConstraintTask`` keeps ``connect``, ``weld`` and the other joint constraints. Tendons
        are not honoured. Where files of meshes, height fields or textures cannot be read, the geoms that need them are
        left out. Where the model does not compile for want of masses, moving bodies without get 2e-15 kg.
        ``fusestatic`` is not followed: it loses names.

        Args:
            mjcf: path of the file, or the XML text itself.
            floating_base: ``None``: as the file says. ``True``: put a free joint on the root body unless the model has
                one. ``False``: free joints are locked where the file has them.
            velocity_limits: joint name (or glob) to greatest speed [rad/s or m/s]; MJCF has no field for it. A custom
                numeric ``velocity_limit/JOINT`` in the file is read too.
            position_limits: as in ``from_urdf``.
            locked_joints: as in ``from_urdf``.
            home: what ``q0`` is, see ``with_home``: a keyframe's name or number, for instance. Default: the first
                keyframe, or ``qpos0`` where there is none, brought inside the joints' ranges.
            root: name of a body of the robot in a scene with other things that move, or names of several. The tree that
                it is in is the robot, whose mass, momentum and base count. Default: the tree with a joint that an
                actuator drives; if there is none, with a joint that has a range; else all that moves.

        Raises:
            FileNotFoundError: no such file.
            ValueError: the XML or the model in it is broken, a body takes its mass from a mesh that cannot be read, or
                ``home`` does not fit.
            KeyError: a mapping or ``locked_joints`` names a joint that does not exist, or ``home`` a keyframe.

        Warns:
            OsikWarning: a joint cannot move because its range is a single value. MuJoCo reads ``range="0 0"`` as no
                limit at all, and so does this.
        """
        options = LoadOptions(
            floating_base=floating_base,
            velocity_limits=velocity_limits,
            position_limits=position_limits,
            locked_joints=locked_joints,
            root=root,
            has_home=home is not None,
        )
        return cls._of(loading.from_mjcf(mjcf, options), home)

    @classmethod
    def from_mjmodel(
        cls,
        model: mujoco.MjModel,
        *,
        velocity_limits: Mapping[str, float] | None = None,
        position_limits: PositionLimits | None = None,
        locked_joints: LockedJoints = (),
        home: Home | None = None,
        root: str | Sequence[str] | None = None,
    ) -> Robot:
        """Make a robot of a compiled MuJoCo model.

        Args:
            model: the model.
            velocity_limits: joint name (or glob) to greatest speed [rad/s or m/s]; wins over custom numerics
                ``velocity_limit/JOINT`` of the model.
            locked_joints: as in ``from_urdf``; without a value, joints freeze at ``qpos0``.
            position_limits: as in ``from_urdf``.
            home: as in ``from_mjcf``.
            root: as in ``from_mjcf``.

        Raises:
            TypeError: ``model`` is no ``mujoco.MjModel``.
            ValueError: the model has no moving joint, or a range with lower > upper, or ``home`` does not fit.
            KeyError: a name in a mapping or ``locked_joints`` does not exist, or ``home`` names no keyframe.

        Warns:
            OsikWarning: a joint cannot move because its range is a single value.
        """
        options = LoadOptions(
            velocity_limits=velocity_limits,
            position_limits=position_limits,
            locked_joints=locked_joints,
            root=root,
            has_home=home is not None,
        )
        return cls._of(loading.from_mjmodel(model, options), home)

    @classmethod
    def _of(cls, model: RobotModel, home: Home | None) -> Self:
        """Return the robot of a model that was read, with another ``q0`` if one is given."""
        robot = cls(*(getattr(model, field.name) for field in dataclasses.fields(RobotModel)))
        return robot if home is None else robot.with_home(home)

    def __repr__(self) -> str:
        """Return a description of the robot in five lines."""
        return described(self)

    def configuration(self, joints: Mapping[str, float], *, base: Num[ArrayLike, " nq"] | None = None) -> Array:
        """Return ``q0`` (or ``base``) with named hinges and slides set; setting a follower moves its leader. (nq,).

        Raises:
            KeyError: no such joint, or it is locked.
            ValueError: a free or ball joint, which no single number sets; ``base`` is no configuration of this robot.

        Warns:
            OsikWarning: a joint is more than 0.5 rad or 0.5 m outside its range, as degrees are.
        """
        if base is not None:
            self.check_configuration(base, "base")
        q = with_joints(self, joints, base)
        if q.shape == (self.nq,):  # not a stack of robots
            warn_of_far_joints(self, q, "configuration")
        return q

    def with_home(self, home: Home) -> Self:
        """Return the robot with another ``q0``, the default target of tasks that are made for it.

        Works inside ``jit``, where values are not checked; nothing is compiled again.

        Args:
            home: a configuration (nq,), whose quaternions are normalised; a mapping from joint names to values, a
                number each [rad or m], or all entries of a free joint (7) or a ball (4), where joints that are not
                named keep their values of ``q0``; or the name or number of a keyframe of ``mj_model``.

        Raises:
            KeyError: no such joint or keyframe; the message lists those that exist.
            TypeError: nothing that a home can be.
            ValueError: a wrong length, not finite, or a quaternion of zeros.

        Warns:
            OsikWarning: a joint is outside its range, as a measured one may be; its value is kept. A keyframe's joints
                are brought to the ends of their ranges, as when the robot is loaded.
        """
        return dataclasses.replace(self, q0=home_configuration(self, home))

    def astype(self, dtype: DTypeLike) -> Self:
        """Return the robot in another precision, with every number cast.

        A robot has the precision that was in force when it was made. After ``jax_enable_x64`` was switched on or off,
        ``robot.astype(float)`` is the robot in the precision now in force; tasks, limits and schemes are to be made
        anew.

        Args:
            dtype: ``float`` (JAX's default), ``"float32"`` or ``"float64"``.

        Raises:
            TypeError: no floating-point type.
            ValueError: float64 while ``jax_enable_x64`` is off.
        """
        wanted = float_dtype(dtype, "a robot's numbers are")
        return jax.tree.map(lambda leaf: leaf.astype(wanted), self)

    def replace(self, **values: Any) -> Self:
        """Return the robot with other numbers, which are given by the names of bodies, joints, frames and geoms.

        ``robot.replace(body_position={"forearm_link": (-0.425, 0.0, 0.001)}, velocity_limit={"*": 1.0})``. Works inside
        ``jit``, ``grad`` and ``vmap``, where values are not checked; nothing is compiled again.

        Args:
            values: by array, one of those above. Each is either the whole array, or a mapping from names (or globs) to
                rows. Names are those of ``body_names`` for ``body_*``, of ``frame_names`` for ``frame_*``, and of
                joints for the other arrays, locked joints and followers included where the array has them. A hinge or
                slide has one number in the arrays over joints; a number for many joints by a glob is for these, and
                not for a floating base or a ball. ``q0`` takes what ``with_home`` takes.
                Axes are brought to length 1, quaternions and rotations that were rounded are made exact.

        Raises:
            KeyError: no such array or name; the message lists those that exist.
            TypeError: no numbers.
            ValueError: a wrong shape; a name given twice; not finite, a negative mass or rate, a lower limit above the
                upper one, no inertia, no rotation; an offset of a joint of q; a stack of robots.
        """
        return dataclasses.replace(self, **replaced_leaves(self, values))

    def scaled(self, *, length: Factors = 1.0, mass: Factors = 1.0) -> Robot:
        """Return the robot with longer or heavier links; limits, ``q0`` and ``mj_model`` are unchanged.

        A link is made longer from its own origin: the joints of its children, its centre of mass, its frames and its
        geoms move away by the factor, and its geoms grow by it. All of the way to a child grows, also what is across
        the link, such as an offset of the shoulder; ``replace`` sets one number. Masses are scaled by their own
        factors only, inertias by mass times length squared; drives stay. Factors may be traced:
        ``jax.vmap(lambda s: robot.scaled(length={"thigh": s}))(factors)`` is a batch of robots.

        Args:
            length: a factor for all links, or a mapping from body names or globs to factors; the others keep theirs.
            mass: likewise.

        Raises:
            KeyError: no such body; the message lists those that exist.
            ValueError: a body is given twice; a factor is not finite, or negative; a length's is 0.
        """
        return dataclasses.replace(self, **scaled_leaves(self, length, mass))

    def to_mjcf(self, path: str | os.PathLike[str] | None = None) -> str:
        """Return the robot as MJCF with its present numbers; write it to the file ``path`` if one is given.

        Locked joints are gone, their bodies posed at the locked values. Links that are fixed to others are one body
        with them and stay as frames. Mimic joints are joint equality constraints, velocity limits custom numerics
        ``velocity_limit/JOINT``, and ``q0`` is the keyframe ``home``. Frames that are no bodies are sites, or geoms
        where they were: simple shapes are kept, meshes are not, so the file needs no other. Equality constraints of an
        ``EqualityConstraintTask`` are kept, between sites ``equality_end/...`` that are no frames; those of locked
        joints are not. Actuators, sensors, tendons, other constraints and keyframes, contact pairs and exclusions, and
        the masses of what is fixed to the world are left out; bodies that locked joints leave fixed to the world count
        as such when the file is read. ``Robot.from_mjcf`` of the text is the same robot in all else.

        Raises:
            ValueError: a stack of robots, or numbers that MJCF has no place for: a joint limited on one side alone,
                limits that differ between the dofs of a free or ball joint, the frame of a body moved without it.
        """
        return _written(loading.to_mjcf(self), path)

    def to_urdf(self, path: str | os.PathLike[str] | None = None) -> str:
        """Return the robot as URDF with its present numbers; write it to the file ``path`` if one is given.

        The root link is ``world``. Each body is a link, and each frame that is no body a link on a fixed joint.
        Locked joints are gone. ``joint_reference`` (zero offsets) goes into the joints' origins, so the joints of the
        file have the values of ``q``. A joint whose anchor is off its body's origin gets a link in between. Boxes,
        spheres and cylinders are kept, capsules become those. Left out are meshes, ``q0``, ``dof_armature``, closed
        loops and the robot's effort limits, written as 0. An infinite limit of a slide is written as 1e9.

        Raises:
            ValueError: a stack of robots, or what URDF does not have: a ball joint, or a greatest speed or acceleration
                of 0.
        """
        return _written(loading.to_urdf(self), path)

    def check_configuration(self, q: Num[ArrayLike, " nq"] | Sequence[float], name: str = "q") -> None:
        """Raise ValueError if q has the wrong length, or (outside jit) is not finite or has a zero quaternion.

        The message calls it ``name``.
        """
        check_configuration(self, q, name)


def _written(text: str, path: str | os.PathLike[str] | None) -> str:
    """Return the text, written to the file if one is given."""
    if path is not None:
        write_text(path, text)
    return text
