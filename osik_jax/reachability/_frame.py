"""A frame's workspace without any search: positions at random configurations, and a bound from link lengths."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

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


class Frame(NamedTuple):
    """Frame whose kinematic chain has hinge and slide joints only.

    Attributes:
        robot: the robot.
        name: of the frame.
        settings: limits of the joints, and where those stay that do not carry it.
    """

    robot: Robot
    name: str
    settings: Settings

    def sampled_positions(self, count: int) -> Float[np.ndarray, "count 3"]:
        """Return the frame's positions [m] at configurations that fill the joints' ranges evenly."""
        return np.asarray(_sampled(self.robot, self.settings, jnp.arange(count, dtype=jnp.int32), route=self._route))

    def beyond_reach(self, positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return a lower bound on the distance from each position to the workspace [m]; 0 where it may be inside."""
        given = jnp.asarray(positions, self.robot.q0.dtype)
        return np.asarray(_beyond(self.robot, self.settings, given, route=self._route))

    def manipulability(self, q: Float[Array, "n nq"]) -> Float[np.ndarray, " n"]:
        """Return Yoshikawa's index of configurations, for the motions that this number of joints can make."""
        return np.asarray(_manipulability(self.robot, self.settings, q, route=self._route))

    def links(self) -> Float[np.ndarray, "k 3"]:
        """Return the positions at home of the joints of the frame's chain, and of the frame [m]."""
        return np.asarray(_links(self.robot, self.settings, route=self._route))

    @property
    def _route(self) -> ChainRoute:
        return ChainRoute((self.name,), ((True,) * 6,))


def read_frame(robot: Robot, name: str, limits: Sequence[Limit] | None, key: int) -> Frame:
    """Return a robot's frame, checked.

    Raises:
        KeyError: no such frame; the message lists those that exist.
        ValueError: no joint carries it, or one that moves freely.
    """
    robot.tree.frame(name)
    if not is_plain(robot.tree, (name,)):
        raise OsikValueError(
            f"{name!r} is not carried by hinges and slides alone: what moves freely gets everywhere, and what no joint "
            "moves gets nowhere. Of a robot with a free base, load it bolted down (floating_base=False, --base fixed)"
        )
    lower, upper = joint_box(robot, None if limits is None else tuple(limits))
    return Frame(robot, name, Settings(robot.q0, lower, upper, key, jnp.ones(2, robot.q0.dtype), 1))


def _search(robot: Robot, settings: Settings, route: ChainRoute) -> ChainSearch:
    return route.search(robot, settings, warm=False, near=False)


@partial(jax.jit, static_argnames="route")
def _sampled(robot: Robot, settings: Settings, number: Array, *, route: ChainRoute) -> Array:
    search = _search(robot, settings, route)
    return chain_kinematics(search.chain, search.begin(number, None).T).position[0].T  # pyright: ignore[reportArgumentType]


@partial(jax.jit, static_argnames="route")
def _beyond(robot: Robot, settings: Settings, positions: Array, *, route: ChainRoute) -> Array:
    turns: Any = jnp.broadcast_to(jnp.eye(3, dtype=positions.dtype), (len(positions), 1, 3, 3))
    return route.beyond(_search(robot, settings, route), Goal(positions[:, None], turns))


@partial(jax.jit, static_argnames="route")
def _manipulability(robot: Robot, settings: Settings, q: Array, *, route: ChainRoute) -> Array:
    """Return sqrt(det(J J')) for each configuration, or sqrt(det(J' J)) if J has fewer columns than rows."""
    chain = _search(robot, settings, route).chain
    matrix = jnp.moveaxis(jacobian(chain, chain_kinematics(chain, q.T[np.array(chain.layout.dofs, int)]))[0], -1, 0)
    rows = matrix if matrix.shape[1] <= matrix.shape[2] else jnp.swapaxes(matrix, 1, 2)
    return jax.vmap(partial(volume, log=False))(rows)


@partial(jax.jit, static_argnames="route")
def _links(robot: Robot, settings: Settings, *, route: ChainRoute) -> Array:
    search = _search(robot, settings, route)
    placed = chain_kinematics(search.chain, search.first[:, None])
    return jnp.concatenate([placed.anchor[..., 0], placed.position[..., 0]])
