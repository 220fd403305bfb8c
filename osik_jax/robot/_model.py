"""Names and numbers of a robot as read from a file, and properties derived from them."""

from __future__ import annotations

import equinox as eqx
import mujoco
from jaxtyping import Array, ArrayLike, Float, Num

from .._errors import OsikValueError
from ..numerics._host import Numbers, module_of
from ._load_report import LoadReport
from ._tree import FREE, KinematicTree, ModelHolder, check_shape


class RobotModel(eqx.Module):
    """Names and numbers of a robot, as returned by ``loading``; base of ``Robot``, which documents them."""

    tree: KinematicTree = eqx.field(static=True)
    body_position: Float[Array, "nbody 3"]
    body_quaternion: Float[Array, "nbody 4"]
    body_mass: Float[Array, " nbody"]
    body_com: Float[Array, "nbody 3"]
    body_inertia: Float[Array, "nbody 3 3"]
    joint_position: Float[Array, "njoint 3"]
    joint_axis: Float[Array, "njoint 3"]
    dof_armature: Float[Array, " nvfull"]
    joint_reference: Float[Array, " nqfull"]
    frame_position: Float[Array, "nframe 3"]
    frame_rotation: Float[Array, "nframe 3 3"]
    geom_position: Float[Array, "ngeom 3"]
    geom_rotation: Float[Array, "ngeom 3 3"]
    geom_size: Float[Array, "ngeom 3"]
    qpos_offset: Float[Array, " nqfull"]
    position_lower: Float[Array, " nv"]
    position_upper: Float[Array, " nv"]
    velocity_limit: Float[Array, " nv"]
    acceleration_limit: Float[Array, " nv"]
    q0: Float[Array, " nq"]
    holder: ModelHolder = eqx.field(static=True, repr=False)

    @property
    def nq(self) -> int:
        """Return the length of q."""
        return self.tree.nq

    @property
    def nv(self) -> int:
        """Return the length of v."""
        return self.tree.nv

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Return independent joints in the order of v, free joints left out."""
        return tuple(self.tree.joint_names[j] for j in self.tree.independent if self.tree.joint_types[j] != FREE)

    @property
    def body_names(self) -> tuple[str, ...]:
        """Return moving bodies, in the order of ``body_mass`` and other arrays over bodies; entry 0 is the world."""
        return self.tree.body_names[1:]

    @property
    def frame_names(self) -> tuple[str, ...]:
        """Return the names of all frames: bodies, URDF links (fused or not), sites and geoms."""
        return self.tree.frame_names

    @property
    def mimic_joints(self) -> dict[str, tuple[str, float]]:
        """Return followers: name to (leader, multiplier)."""
        names = self.tree.joint_names
        return {names[f]: (names[leader], m) for f, leader, m in self.tree.followers}

    @property
    def locked_joints(self) -> tuple[str, ...]:
        """Return the names of the joints frozen at load time."""
        return tuple(self.tree.joint_names[j] for j in self.tree.locked)

    @property
    def floating_base(self) -> bool:
        """Return whether the robot's base is a free joint that is not locked; loose bodies of a scene do not count."""
        return bool(self.tree.free_bases)

    @property
    def mj_model(self) -> mujoco.MjModel:
        """Return the MuJoCo model that the robot was made from; see ``mujoco_qpos`` for its configurations.

        Raises:
            ValueError: the robot is a stack of robots whose models differ.
        """
        if self.holder.model is None:
            raise OsikValueError(
                "this is a stack of robots of different files, so it has no single mj_model: take it from one robot"
            )
        return self.holder.model

    @property
    def load_report(self) -> LoadReport:
        """Return the elements of the file that the robot does not keep, with the replacement of each."""
        return self.holder.report

    def joint_qpos_index(self, name: str) -> int:
        """Return the index in q of a joint's first value; a follower has its leader's.

        Raises:
            KeyError: no such joint, or it is locked.
        """
        return self.tree.qpos_address[self.tree.owner(name)]

    def joint_dof_index(self, name: str) -> int:
        """Return the index in v of a joint's first velocity; a follower has its leader's.

        Raises:
            KeyError: no such joint, or it is locked.
        """
        return self.tree.dof_address[self.tree.owner(name)]

    def mujoco_qpos(self, q: Num[ArrayLike, " nq"]) -> Float[Numbers, " nqfull"]:
        """Return the configuration of ``mj_model``: q with locked and follower joints filled in. (full nq,).

        Raises:
            ValueError: q has another shape than this robot's configurations.
        """
        check_shape(self.tree, q, "q")
        index, coefficient = self.tree.qpos_source
        return module_of(self.qpos_offset).asarray(q)[index] * coefficient + self.qpos_offset
