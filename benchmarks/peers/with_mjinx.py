"""mjinx: MJX, its tasks and barriers, jaxopt's OSQP; one robot or a batch in one jitted program.

Its frame task has a Jacobian that finite differences do not confirm (0.1.1: the target's inverse times the frame's
inverse, where the frame itself belongs), so what it tracks is worse than its QPs are.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from mujoco import mjx

from ..device import device_bytes, device_name
from ..workload import DT, Workload
from ._mujoco import Coordinates
from ._peer import Device

jdc: Any = import_module("jax_dataclasses")
mjinx: Any = import_module("mjinx")  # in an environment of its own, where nothing checks types
for _part in ("problem", "components.tasks", "components.barriers", "solvers", "configuration"):
    import_module(f"mjinx.{_part}")


class Runner:
    """One robot, or a batch of them, in mjinx's closed loop.

    Args:
        work: what to do.
        precision: ``float64`` or ``float32``.
        batch: number of robots; None for one without a batch axis.
        resident: the configurations of all but the first lanes stay on the device.
        equations: how OSQP solves its equations; "lu" is eight times as fast on this workload as its default, "cg".
        iterations: of OSQP, at most; its default is 4,000.
    """

    packages = ("mjinx", "jaxopt", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy")

    def __init__(
        self,
        work: Workload,
        *,
        precision: str = "float32",
        batch: int | None = None,
        resident: int | None = None,
        equations: str = "lu",
        iterations: int = 4000,
    ) -> None:
        jax.config.update("jax_enable_x64", precision == "float64")
        self.work, self.resident = work, resident
        self.coordinates = Coordinates(work)
        self.model = mjx.put_model(self.coordinates.model)
        start = self.coordinates.own(work.start)
        self.problem = self._problem(start)
        self.solver = mjinx.solvers.LocalIKSolver(self.model, eq_qp_solve=equations, maxiter=iterations)
        step = self._step()
        self.program = jax.jit(step if batch is None else jax.vmap(step, in_axes=(0, 0, None)))
        self.q = jnp.asarray(start if batch is None else np.tile(start, (batch, 1)), float)
        self.fine: list[jax.Array] = []

    def step(self, hand: np.ndarray, com: np.ndarray) -> np.ndarray:
        """Targets, QP, integration in one program."""
        self.q, fine = self.program(self.q, hand.astype(self.q.dtype), com.astype(self.q.dtype))
        self.fine.append(fine)
        return np.asarray(self.q if self.resident is None else jax.block_until_ready(self.q)[: self.resident])

    def canonical(self, q: np.ndarray) -> np.ndarray:
        """From MuJoCo's coordinates."""
        return self.coordinates.canonical(q)

    def solved(self) -> float:
        """Share of the lanes and steps so far that OSQP calls solved."""
        return float(np.mean([np.mean(np.asarray(fine)) for fine in self.fine]))

    def device(self) -> Device:
        """JAX's."""
        return Device(device_name(), device_bytes())

    def _problem(self, start: np.ndarray) -> Any:
        work, c, gain = self.work, self.work.costs, 1.0 / DT
        speed = np.full(self.model.nv, 1e3)
        speed[self.coordinates.dofs] = work.velocity
        problem = mjinx.problem.Problem(self.model, v_min=-speed, v_max=speed)
        tasks = mjinx.components.tasks
        costs = {name: [c.foot] * 6 for name in work.feet} | {work.hand: [c.hand_position] * 3 + [c.hand_rotation] * 3}
        positions = [*work.foot_positions, work.hand_position]
        rotations = [*work.foot_rotations, work.hand_rotation]
        for (name, cost), p, R in zip(costs.items(), positions, rotations, strict=True):
            task = tasks.FrameTask(name, cost=cost, gain=gain, obj_name=name)
            task.target_frame = np.concatenate([p, self.coordinates.quaternion(R)])
            problem.add_component(task)
        if work.feet:
            com = tasks.ComTask("com", cost=c.com, gain=gain)
            com.target_com = work.com_start
            problem.add_component(com)
        base = dict(floating_base=work.floating)
        posture = tasks.JointTask("posture", cost=c.posture, gain=gain, mask=[1] * len(work.joints), **base)
        problem.add_component(posture)
        posture.target_q = start[7 if work.floating else 0 :]
        problem.add_component(mjinx.components.barriers.JointBarrier("limits", gain=gain, **base))
        return problem

    def _step(self) -> Callable[..., tuple[jax.Array, jax.Array]]:
        solver, given, memory = self.solver, self.problem.compile(), self.solver.init()
        rotation = SO3.from_matrix(jnp.asarray(self.work.hand_rotation, float))

        def step(q: jax.Array, hand: jax.Array, com: jax.Array) -> tuple[jax.Array, jax.Array]:
            with jdc.copy_and_mutate(given, validate=False) as aimed:
                aimed.components[self.work.hand].target_frame = SE3.from_rotation_and_translation(rotation, hand)
                if self.work.feet:
                    aimed.components["com"].target_com = com
            solution, _ = solver.solve(q, memory, aimed)
            q = mjinx.configuration.integrate(self.model, q, solution.v_opt, DT)
            return q, solution.status == _SOLVED

        return step


_SOLVED = 1
"""``jaxopt.BoxOSQP.SOLVED``."""
