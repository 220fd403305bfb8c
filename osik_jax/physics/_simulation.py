"""Simulation of a robot in MuJoCo with servo targets."""

from __future__ import annotations

import math

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from .._errors import OsikValueError, unknown_name
from ..robot._mujoco import mujoco_frame_pose, robot_com
from ._world import World

FALL_TILT, FALL_HEIGHT = math.radians(45.0), 0.6
"""A robot has fallen whose base has turned by more from upright, or is lower than this part of its first height."""


class Simulation:
    """World with its state, stepped by MuJoCo's C code on the host and changed in place.

    ``data`` is MuJoCo's own, for all that has no method here; ``mujoco.viewer`` takes ``model`` and ``data``.

    Attributes:
        world: what is simulated.
        data: its state.
    """

    def __init__(self, world: World, q: Float[np.ndarray, " nq"] | Array | None = None) -> None:
        self.world = world
        self.data = mujoco.MjData(world.model)
        tree = world.robot.tree
        self._sensed = tree.own_qpos
        self._targets = np.array([tree.qpos_address[tree.joint(name)] for name in world.servos], int)
        self._points = [g for foot in world.feet for g in world.contact_geoms(foot)]
        self.reset(world.robot.q0 if q is None else q)

    @property
    def model(self) -> mujoco.MjModel:
        """Return the world's MuJoCo model."""
        return self.world.model

    @property
    def time(self) -> float:
        """Return the time since the reset [s]."""
        return float(self.data.time)

    def reset(self, q: Float[np.ndarray, " nq"] | Array) -> None:
        """Put the robot and its servos at a configuration, at rest.

        Raises:
            ValueError: q has the wrong length or is not finite.
        """
        robot = self.world.robot
        wanted = jnp.asarray(q)
        robot.check_configuration(wanted)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = np.asarray(robot.mujoco_qpos(wanted))
        self.data.ctrl[:] = np.asarray(q)[self._targets]
        mujoco.mj_forward(self.model, self.data)
        self._upright = self._base()

    def _base(self) -> tuple[float, np.ndarray]:
        """Return the height of the robot's base over the floor [m], and the world's vertical in its axes.

        Of a fixed base: 1 and up.
        """
        free = self.world.robot.tree.free_bases
        if not free:
            return 1.0, np.array([0.0, 0.0, 1.0])
        body = self.model.jnt_bodyid[free[0]]
        return float(self.data.xpos[body, 2]) - self.world.floor, self.data.xmat[body].reshape(3, 3)[2].copy()

    def fallen(self) -> bool:
        """Return whether the base tilts by over 45 degrees since the reset, or has lost 40 % of its height.

        Never true of a robot that is bolted down.
        """
        (height, up), (first, upright) = self._base(), self._upright
        return bool(up @ upright < math.cos(FALL_TILT) or height < FALL_HEIGHT * first)

    def sense(self) -> Float[np.ndarray, " nq"]:
        """Return the configuration: base and joints, without noise. A mimic joint is read at its leader. (nq,)."""
        return self.data.qpos[self._sensed]

    def step(self, command: Float[np.ndarray, " nq"] | Array, duration: float) -> None:
        """Simulate for some time with the given servo targets.

        Args:
            command: configuration of the servo targets; its base entries are ignored. (nq,)
            duration: [s], a whole number of the world's timesteps.

        Raises:
            ValueError: ``duration`` is no whole number of timesteps, or the command is not finite.
        """
        targets = np.asarray(command)[self._targets]
        if not np.isfinite(targets).all():
            spoiled = [name for name, value in zip(self.world.servos, targets, strict=True) if not np.isfinite(value)]
            raise OsikValueError(f"the command of {', '.join(spoiled)} is not finite")
        self.data.ctrl[:] = targets
        mujoco.mj_step(self.model, self.data, self._substeps(duration))
        mujoco.mj_forward(self.model, self.data)

    def _substeps(self, duration: float) -> int:
        steps = duration / self.model.opt.timestep
        if not (steps > 0.5 and math.isclose(steps, round(steps), rel_tol=1e-6)):
            raise OsikValueError(f"{duration} s is no whole number of timesteps of {self.model.opt.timestep} s")
        return round(steps)

    def push(self, body: str, force: tuple[float, float, float]) -> None:
        """Apply a force at a body's centre of mass, in world axes [N], until it is set anew or the simulation is reset.

        Raises:
            KeyError: no such body; the message lists those that exist.
        """
        index = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, body)
        if index <= 0:
            raise unknown_name("body", body, tuple(self.model.body(b).name for b in range(1, self.model.nbody)))
        self.data.xfrc_applied[index, :3] = force

    def effort(self) -> Float[np.ndarray, " n"]:
        """Return the force or torque of each servo [N m or N], in the order of ``world.servos``. (n,)."""
        return self.data.actuator_force.copy()

    def frame_pose(self, frame: str) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
        """Return position [m] and rotation of a frame of the robot.

        Raises:
            KeyError: no such frame.
        """
        return mujoco_frame_pose(self.world.robot, self.data, frame)

    def com(self) -> Float[np.ndarray, "3"]:
        """Return the centre of mass [m] of the robot. (3,)."""
        return robot_com(self.world.robot, self.data)

    def contact_points(self) -> Float[np.ndarray, "k 3"]:
        """Return the contact points of all feet in the world [m], in the order of the feet. (k, 3)."""
        radius = self.model.geom_size[self._points, :1]
        return self.data.geom_xpos[self._points] - radius * np.array([0.0, 0.0, 1.0])

    def contact_forces(self) -> Float[np.ndarray, "k 3"]:
        """Return the force of the floor on each contact point [N], world axes. (k, 3)."""
        out, wrench = np.zeros((len(self._points), 3)), np.zeros(6)
        row = {geom: k for k, geom in enumerate(self._points)}
        for c, contact in enumerate(self.data.contact):
            mujoco.mj_contactForce(self.model, self.data, c, wrench)
            force = contact.frame.reshape(3, 3).T @ wrench[:3]
            first, second = (row.get(int(g)) for g in contact.geom)
            if second is not None:
                out[second] += force
            elif first is not None:
                out[first] -= force
        return out
