"""Description of a robot in five lines."""

from __future__ import annotations

import numpy as np
from jax.core import Tracer

from ._model import RobotModel
from ._tree import FREE

_NAMES_SHOWN = 4


def described(robot: RobotModel) -> str:
    """Return name, sizes and base, joints, frames, masses and limits as lines, without traced or batched numbers."""
    tree = robot.tree
    base = "floating base" if robot.floating_base else "fixed base"
    batch = np.shape(robot.q0)[:-1]
    many = f", a stack of {' x '.join(map(str, batch))}" if batch else ""
    lines = [
        f"Robot {model_name(robot)!r}: nq {robot.nq}, nv {robot.nv}, {base}{many}",
        f"{len(robot.joint_names)} joints: {_some(robot.joint_names)}{_not_free(robot)}",
        f"{len(tree.frame_names)} frames of {len(robot.body_names)} bodies: {_some(robot.body_names)}",
        f"mass {_mass(robot)}",
        f"limits: {_limited(robot)}",
    ]
    return "\n  ".join(lines)


def model_name(robot: RobotModel) -> str:
    """Return the robot's name in its file; empty if it has none, or for robots of different files."""
    return "" if robot.holder.model is None else robot.mj_model.names.split(b"\0")[0].decode(errors="replace")


def _some(names: tuple[str, ...]) -> str:
    return ", ".join(names[:_NAMES_SHOWN]) + (", ..." if len(names) > _NAMES_SHOWN else "")


def _not_free(robot: RobotModel) -> str:
    counts = {"mimic": len(robot.mimic_joints), "locked": len(robot.locked_joints)}
    return "".join(f"; {count} {kind}" for kind, count in counts.items() if count)


def _mass(robot: RobotModel) -> str:
    if isinstance(robot.body_mass, Tracer) or np.ndim(robot.body_mass) > 1:
        return "of each robot its own"
    own = np.asarray(robot.body_mass)[robot.tree.is_own] if len(robot.tree.robots) <= 1 else robot.body_mass[1:]
    return f"{np.sum(own):.4g} kg"


def _limited(robot: RobotModel) -> str:
    """Return a phrase that counts the dofs with a range and the dofs with a speed limit."""
    own = (robot.position_lower, robot.position_upper, robot.velocity_limit)
    if any(isinstance(array, Tracer) or np.ndim(array) > 1 for array in own):
        return "of each robot its own"
    ranged = np.isfinite(own[0]) | np.isfinite(own[1])
    total = robot.nv - 6 * sum(robot.tree.joint_types[j] == FREE for j in robot.tree.independent)
    return f"{ranged.sum()} ranges and {np.isfinite(own[2]).sum()} speeds of {total} joint coordinates"
