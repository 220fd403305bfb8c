"""Searches for poses of frames: set-up from frames, limits and tolerances, and evaluation of the answers."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt

from ..robot import Robot
from ..robot._joint_selection import dof_names, dof_of_entries
from ..tasks import Task
from ._chain import Chain, Layout, chain_layout, make_chain
from ._chain_search import ChainSearch, Goal, lanes_last
from ._implicit import attached, errors_at
from ._pool import Errors
from ._reach import ROUNDOFF, Reach, beyond, norm, reaches
from ._seeds import shift_of, starting_box
from ._solution import InverseKinematicsSolution
from ._turns import starting_range

ENOUGH = 0.01
"""Score at which a search is done; the next step would be a rounding."""
_RADIAN = 0.1
"""Length that a radian counts as, relative to the length of the chain."""
STOPPED = 1e-3
"""A joint is stopped by its limit where the gradient is at least this, relative to its largest value for the error."""


class Settings(NamedTuple):
    """Numbers of a search, all traced."""

    home: Float[Array, " nq"]  # what entries of q have that move no frame, and where search 0 of a warm start begins
    lower: Float[Array, " nv"]  # limits of each entry of v
    upper: Float[Array, " nv"]
    key: Any  # of the starts
    tolerance: Float[Array, "2"]  # of position [m] and orientation [rad]
    seeds: Int[Array, ""] | int  # number of searches that ``nearest`` spreads out
    parts: Any = None  # what else a search is made of


class ChainRoute(NamedTuple):
    """Problem of poses of frames whose chains have hinges and slides only; hashable."""

    frames: tuple[str, ...]  # names
    rows: tuple[tuple[bool, ...], ...]  # of each frame, those that count: x, y, z, rotation about x, y, z
    # whether the compiled core takes the steps where it is installed: not in a user's program, which may be exported
    by_core: bool = True

    @property
    def starts_anew(self) -> bool:
        """Return whether the search for the least error starts anew, and is part of traced programs."""
        return True

    def search(self, robot: Robot, settings: Settings, *, warm: bool, near: bool) -> ChainSearch:
        """Return the search for these frames."""
        own = carried(robot, settings.lower, settings.upper, frames=self.frames)
        shift = shift_of(settings.key, len(own.lower))
        return search_of(own, self, settings.home, shift, settings.tolerance, settings.seeds, warm=warm, near=near)

    def beyond(self, search: ChainSearch, goal: Goal) -> Float[Array, " targets"]:
        """Return a lower bound on the distance from each target to the workspace [m]; 0 where it may be inside."""
        asked: Any = np.array(self.rows)[:, :3].all(-1)
        return beyond(search.reaches, goal.position, asked)

    def entries(self, robot: Robot) -> np.ndarray:
        """Return the entries of q that a search moves."""
        return np.array(chain_layout(robot.tree, self.frames).dofs, int)

    def asked(self, settings: Settings) -> dict[str, tuple[bool, ...]]:
        """Return which rows of each frame are used."""
        return dict(zip(self.frames, self.rows, strict=True))

    def held(self, settings: Settings) -> dict[str, Task]:
        """Return no tasks: poses tie no joints together."""
        return {}

    def turning(self, robot: Robot, settings: Settings) -> np.ndarray:
        """Return whether a whole turn of each of these entries changes no pose."""
        return np.array(turning(chain_layout(robot.tree, self.frames)))

    def answer(self, robot: Robot, search: ChainSearch, goal: Goal, x: Array, seed: Array, steps: Array) -> Any:
        """Return the answer for many targets: errors computed anew, with the derivative of a solution."""
        x = search.unwound(jax.lax.stop_gradient(search).polished(x, jax.lax.stop_gradient(goal)))
        return answer(robot, self, search, goal, x, seed, steps)


class Carried(NamedTuple):
    """Numbers of a search that depend on the robot and its limits alone."""

    chain: Chain  # geometry
    lower: Float[Array, " n"]  # limits of the chain's coordinates, -inf where free
    upper: Float[Array, " n"]
    reaches: list[Reach]  # bounds on where each frame gets
    # the greatest distance that a frame gets from its root and its slides' travel [m]; may be infinite
    length: Float[Array, ""]


def carried(
    robot: Robot, lower: Float[Array, " nv"], upper: Float[Array, " nv"], *, frames: tuple[str, ...]
) -> Carried:
    """Return what a search for poses of these frames needs of the robot and the limits of its joints."""
    layout = chain_layout(robot.tree, frames)
    chain, dofs = make_chain(robot, frames, layout), dof_of_entries(robot)[np.array(layout.dofs, int)]
    lower, upper = lower[dofs], upper[dofs]
    found = reaches(chain, *starting_box(lower, upper))
    length = jnp.max(jnp.stack([reach.length + jnp.sum(norm(reach.slides)) for reach in found]))
    return Carried(chain, lower, upper, found, jax.lax.stop_gradient(length))


def search_of(
    own: Carried,
    route: ChainRoute,
    home: Float[Array, " nq"],
    shift: UInt[Array, " n"],
    tolerance: Float[Array, "2"],
    seeds: Int[Array, ""] | int,
    *,
    warm: bool,
    near: bool,
) -> ChainSearch:
    """Return the search with its parts; arguments as in ``Settings`` and ``ChainSearch``."""
    chain, lower, upper, _, length = own
    layout = chain.layout
    first = jnp.clip(home[np.array(layout.dofs, int)], lower, upper)
    turns, hinges = turning(layout), [layout.hinges[layout.entries.index(dof)] for dof in layout.dofs]
    low, high = starting_range(*starting_box(lower, upper), first, np.where(hinges, np.pi, 1.0), turns)
    return ChainSearch(
        rows=route.rows,
        by_core=route.by_core,
        turns=turns,
        chain=chain,
        lower=lower,
        upper=upper,
        reaches=jax.lax.stop_gradient(own.reaches),
        low=low,
        high=high,
        first=first,
        home=home,
        warm=warm,
        near=near,
        seeds=jnp.asarray(seeds, first.dtype),
        shift=shift,
        # links in one point have no length, but the steps' damping needs one
        length=jax.lax.stop_gradient(jnp.maximum(_RADIAN * jnp.where(jnp.isfinite(length), length, 1.0), tolerance[0])),
        tolerance=allowed(tolerance, length),
        enough=jnp.asarray(ENOUGH, first.dtype),
    )


def allowed(tolerance: Float[Array, "2"], length: Float[Array, ""]) -> Float[Array, "2"]:
    """Return the tolerances less the possible rounding, so that a converged answer holds in exact numbers too."""
    size = jnp.stack([jnp.where(jnp.isfinite(length), length, 1.0), jnp.ones_like(length)])
    hidden = ROUNDOFF * float(jnp.finfo(tolerance.dtype).eps) * size
    # a tolerance near roundoff keeps a quarter of itself, or no search could end
    return jnp.maximum(tolerance - hidden, 0.25 * tolerance)


def turning(layout: Layout) -> tuple[bool, ...]:
    """Return whether a whole turn of each coordinate brings every joint that it moves to the same place."""
    moved = [[j for j, entry in enumerate(layout.entries) if entry == dof] for dof in layout.dofs]
    return tuple(all(layout.hinges[j] and layout.factors[j] % 1.0 == 0.0 for j in own) for own in moved)


def answer(
    robot: Robot,
    route: ChainRoute,
    search: ChainSearch,
    goal: Goal,
    x: Float[Array, "targets n"],
    seed: Int[Array, " targets"],
    steps: Int[Array, " targets"],
) -> InverseKinematicsSolution:
    """Return the answer for many targets: errors computed anew, with the derivative of a solution."""
    x = jax.vmap(attached, in_axes=(0, None, 0))(jax.lax.stop_gradient(x), search, goal)
    fixed_search, fixed_goal = jax.lax.stop_gradient((search, goal))
    residual, active, errors = _evaluated(fixed_search, jax.lax.stop_gradient(x).T, lanes_last(fixed_goal))
    converged = errors.score <= 1.0
    sizes = jnp.stack([errors.position, errors.orientation], 1)
    sizes = jax.vmap(errors_at, in_axes=(0, 0, None, 0))(sizes, x, search, goal)
    coordinates = np.array(search.chain.layout.dofs, int)
    whole = jnp.broadcast_to(search.home, (len(x), robot.nq)).at[:, coordinates].set(x)
    at_limit = jnp.zeros((len(x), robot.nv), jnp.int32)
    return InverseKinematicsSolution(
        q=whole,
        converged=converged,
        position_error=sizes[:, 0],
        orientation_error=sizes[:, 1],
        seed=seed,
        steps=steps,
        residual={name: jnp.moveaxis(residual[at], -1, 0) for at, name in enumerate(route.frames)},
        at_limit=at_limit.at[:, dof_of_entries(robot)[coordinates]].set(active.T),
        beyond_reach=route.beyond(fixed_search, fixed_goal),
        joints=tuple(dof_names(robot)),
    )


def _evaluated(search: ChainSearch, x: Float[Array, "n lanes"], goal: Goal) -> tuple[Array, Array, Errors]:
    """Return the residual of each frame (frames, 6, lanes), the limits that stop it (n, lanes), and the errors."""
    error, matrix, errors = search.linearised(x, goal)
    gradient = jnp.sum(matrix * error[:, None], 0)
    most = jnp.sqrt(jnp.sum(matrix**2, 0)) * jnp.sqrt(errors.cost)
    stopped = jnp.abs(gradient) > STOPPED * most
    low, high = (x <= search.lower[:, None]) & (gradient > 0.0), (x >= search.upper[:, None]) & (gradient < 0.0)
    return search.by_frame(error), jnp.where(stopped, high.astype(jnp.int32) - low.astype(jnp.int32), 0), errors
