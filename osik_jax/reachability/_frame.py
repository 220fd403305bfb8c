"""A frame's workspace without any search: positions at random configurations, and a bound from link lengths."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._errors import OsikValueError
from ..inverse._chain import chain_kinematics, is_plain, jacobian
from ..inverse._chain_problem import ChainRoute, Settings
from ..inverse._chain_search import ChainSearch, Goal
from ..inverse._inverse_kinematics import joint_box
from ..limits import Limit
from ..robot import Robot
from ..tasks._manipulability import volume


class Frame(eqx.Module):
    """Frame whose kinematic chain has hinge and slide joints only."""

    robot: Robot  # the robot
    name: str = eqx.field(static=True)  # of the frame
    settings: Settings  # limits of the joints, and where those stay that do not carry it

    @eqx.filter_jit
    def sampled_positions(self, count: int) -> Float[Array, "count 3"]:
        """Return the frame's positions [m] at configurations that fill the joints' ranges evenly."""
        number = jnp.arange(count, dtype=jnp.int32)
        angles = self._search.begin(number, None).T  # pyright: ignore[reportArgumentType]
        return chain_kinematics(self._search.chain, angles).position[0].T

    @eqx.filter_jit
    def beyond_reach(self, positions: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Return a lower bound on the distance from each position to the workspace [m]; 0 where it may be inside."""
        turns: Any = jnp.broadcast_to(jnp.eye(3, dtype=positions.dtype), (len(positions), 1, 3, 3))
        return self._route.beyond(self._search, Goal(positions[:, None], turns))

    @eqx.filter_jit
    def manipulability(self, q: Float[Array, "n nq"]) -> Float[Array, " n"]:
        """Return Yoshikawa's index sqrt(det(J J')) of configurations, or sqrt(det(J' J)) if J has fewer columns."""
        chain = self._search.chain
        angles = q.T[np.array(chain.layout.dofs, int)]
        matrix = jnp.moveaxis(jacobian(chain, chain_kinematics(chain, angles))[0], -1, 0)
        rows = matrix if matrix.shape[1] <= matrix.shape[2] else jnp.swapaxes(matrix, 1, 2)
        return jax.vmap(partial(volume, log=False))(rows)

    @eqx.filter_jit
    def links(self) -> Float[Array, "k 3"]:
        """Return the positions at home of the joints of the frame's chain, and of the frame [m]."""
        placed = chain_kinematics(self._search.chain, self._search.first[:, None])
        return jnp.concatenate([placed.anchor[..., 0], placed.position[..., 0]])

    @property
    def _route(self) -> ChainRoute:
        return ChainRoute((self.name,), ((True,) * 6,))

    @property
    def _search(self) -> ChainSearch:
        return self._route.search(self.robot, self.settings, warm=False, near=False)


def read_frame(robot: Robot, name: str, limits: Sequence[Limit] | None, key: int) -> Frame:
    """Return a robot's frame, checked."""
    robot.tree.frame(name)
    if not is_plain(robot.tree, (name,)):
        raise OsikValueError(
            f"{name!r} is not carried by hinges and slides alone: what moves freely gets everywhere, and what no joint "
            "moves gets nowhere. Of a robot with a free base, load it bolted down (floating_base=False, --base fixed)"
        )
    lower, upper = joint_box(robot, None if limits is None else tuple(limits))
    return Frame(robot, name, Settings(robot.q0, lower, upper, key, jnp.ones(2, robot.q0.dtype), 1))
