"""The masses of a MuJoCo model that are the robot's own."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ._model import RobotModel
from .loading._mjmodel import element_names


def own_masses(robot: RobotModel) -> Float[np.ndarray, " bodies"]:
    """Return the mass [kg] of each body of ``mj_model``, 0 where it is fixed to the world or not the robot's.

    Raises:
        ValueError: the scene has several trees that may be the robot.
    """
    model = robot.mj_model
    names = element_names(model, "body")
    roots = {int(model.body_rootid[names.index(robot.tree.body_names[top])]) for top in robot.tree.tops}
    own = np.isin(model.body_rootid, sorted(roots)) & (model.body_weldid != 0)
    return np.where(own, model.body_mass, 0.0)
