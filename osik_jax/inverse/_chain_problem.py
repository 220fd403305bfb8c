"""Searches for poses of frames: set-up from frames, limits and tolerances, and evaluation of the answers."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..core import _cuda
from ..execution._platform import cuda_is_default
from ..robot import Robot
from ..robot._joint_selection import dof_names, scalar_layout
from ._chain import Chain, Layout, chain_kinematics, chain_layout, make_chain
from ._chain_search import ChainSearch, Goal, lanes_last
from ._fixed import at_solution
from ._implicit import errors_at
from ._pool import Errors, Pace
from ._seeds import shift_of, starting_box
from ._solution import InverseKinematicsSolution
from ._turns import one_turn

_ROUNDOFF = 64.0
"""Machine epsilons, of the robot's size, by which computed errors may be off."""
_ENOUGH = 0.01
"""Score at which a search is done; the next step would be a rounding."""
_RADIAN = 0.1
"""Length that a radian counts as, relative to the length of the chain."""
_STOPPED = 1e-3
"""A joint is stopped by its limit where the gradient is at least this, relative to its largest value for the error."""
_SWEEPS = 4
"""Passes over the slides for the nearest point of what they reach; one is exact where they are at right angles."""


class Settings(NamedTuple):
    """Numbers of a search, all traced.

    Attributes:
        home: what entries of q have that move no frame, and where search 0 of a warm start begins. (nq,)
        lower: limits of each entry of v. (nv,)
        upper: (nv,)
        key: of the starts.
        tolerance: of position [m] and orientation [rad]. (2,)
        seeds: number of searches that ``nearest`` spreads out. ()
        parts: what else a search is made of.
    """

    home: Float[Array, " nq"]
    lower: Float[Array, " nv"]
    upper: Float[Array, " nv"]
    key: Any
    tolerance: Float[Array, "2"]
    seeds: Int[Array, ""] | int
    parts: Any = None


class ChainRoute(NamedTuple):
    """Problem of poses of frames whose chains have hinges and slides only; hashable.

    Attributes:
        frames: names.
        rows: of each frame, those that count: x, y, z, rotation about x, y, z.
        by_core: whether the compiled core takes the steps where it is installed: not in a user's program, which may be
            exported.
    """

    frames: tuple[str, ...]
    rows: tuple[tuple[bool, ...], ...]
    by_core: bool = True

    @property
    def starts_anew(self) -> bool:
        """Return whether the search for the least error starts anew, and is part of traced programs."""
        return True

    @property
    def pace(self) -> Pace:
        """Return the rhythm of its searches: a kernel on a GPU ends each by itself, and launching it takes longest."""
        return Pace(16, 20) if self.by_core and cuda_is_default() and _cuda.installed() else Pace()

    def search(self, robot: Robot, settings: Settings, *, warm: bool, near: bool) -> ChainSearch:
        """Return the search for these frames."""
        return chain_search(robot, self, settings, warm=warm, near=near)

    def beyond(self, search: ChainSearch, goal: Goal) -> Float[Array, " targets"]:
        """Return a lower bound on the distance from each target to the workspace [m]; 0 where it may be inside."""
        return _beyond(search, goal)

    def entries(self, robot: Robot) -> np.ndarray:
        """Return the entries of q that a search moves."""
        return np.array(chain_layout(robot.tree, self.frames).dofs, int)

    def asked(self, settings: Settings) -> dict[str, tuple[bool, ...]]:
        """Return which rows of each frame are used."""
        del settings
        return dict(zip(self.frames, self.rows, strict=True))

    def turning(self, robot: Robot, settings: Settings) -> np.ndarray:
        """Return whether a whole turn of each of these entries changes no pose."""
        return np.array(turning(chain_layout(robot.tree, self.frames)))

    def answer(self, robot: Robot, search: ChainSearch, goal: Goal, x: Array, seed: Array, steps: Array) -> Any:
        """Return the answer for many targets: errors computed anew, with the derivative of a solution."""
        return answer(robot, self, search, goal, x, seed, steps)


def chain_search(robot: Robot, route: ChainRoute, settings: Settings, *, warm: bool, near: bool) -> ChainSearch:
    """Return the search for configurations of a robot whose frames hinges and slides carry."""
    frames, rows, by_core = route
    layout = chain_layout(robot.tree, frames)
    chain = make_chain(robot, frames, layout)
    coordinates = np.array(layout.dofs, int)
    dofs = dof_of_entries(robot)[coordinates]
    lower, upper = settings.lower[dofs], settings.upper[dofs]
    first = jnp.clip(settings.home[coordinates], lower, upper)
    box, turns = starting_box(lower, upper), turning(layout)
    low, high = _starts(layout, turns, *box, first)
    found = jax.lax.stop_gradient(reaches(chain, first, *box))
    length = jnp.max(jnp.stack([reach.length + jnp.sum(_norm(reach.slides)) for reach in found]))
    return ChainSearch(
        rows=rows,
        by_core=by_core,
        turns=turns,
        chain=chain,
        lower=lower,
        upper=upper,
        low=low,
        high=high,
        first=first,
        home=settings.home,
        warm=warm,
        near=near,
        seeds=jnp.asarray(settings.seeds, first.dtype),
        shift=shift_of(settings.key, len(coordinates)),
        # links in one point have no length, but the steps' damping needs one
        length=jax.lax.stop_gradient(
            jnp.maximum(_RADIAN * jnp.where(jnp.isfinite(length), length, 1.0), settings.tolerance[0])
        ),
        tolerance=allowed(settings.tolerance, length),
        enough=jnp.asarray(_ENOUGH, first.dtype),
    )


def allowed(tolerance: Float[Array, "2"], length: Float[Array, ""]) -> Float[Array, "2"]:
    """Return the tolerances less the possible rounding, so that a converged answer holds in exact numbers too."""
    size = jnp.stack([jnp.where(jnp.isfinite(length), length, 1.0), jnp.ones_like(length)])
    hidden = _ROUNDOFF * float(jnp.finfo(tolerance.dtype).eps) * size
    # a tolerance near roundoff keeps a quarter of itself, or no search could end
    return jnp.maximum(tolerance - hidden, 0.25 * tolerance)


def dof_of_entries(robot: Robot) -> np.ndarray:
    """Return the entry of v of each entry of q, of hinges and slides. (nq,)."""
    scalar, index = scalar_layout(robot)
    out = np.zeros(robot.nq, int)
    out[index[scalar]] = np.flatnonzero(scalar)
    return out


def turning(layout: Layout) -> tuple[bool, ...]:
    """Return whether a whole turn of each coordinate brings every joint that it moves to the same place."""
    moved = [[j for j, entry in enumerate(layout.entries) if entry == dof] for dof in layout.dofs]
    return tuple(all(layout.hinges[j] and layout.factors[j] % 1.0 == 0.0 for j in own) for own in moved)


def _starts(layout: Layout, turns: tuple[bool, ...], lower: Array, upper: Array, first: Array) -> tuple[Array, Array]:
    """Return finite ranges for the starts of searches: the limits, one turn, or 1 m around the first configuration."""
    hinge = np.array([layout.hinges[layout.entries.index(dof)] for dof in layout.dofs])
    width = np.where(hinge, np.pi, 1.0)
    free = jnp.isinf(lower) | jnp.isinf(upper)
    low = jnp.where(free, jnp.maximum(first - width, lower), lower)
    high = jnp.where(free, jnp.minimum(first + width, upper), upper)
    once, again = one_turn(lower, upper, first)
    # beyond a whole turn, starts would repeat the same poses
    wide = np.array(turns) & (upper - lower > 2.0 * np.pi)
    return jnp.where(wide, once, low).astype(first.dtype), jnp.where(wide, again, high).astype(first.dtype)


class Reach(NamedTuple):
    """Bound on where a chain of links brings a frame: within ``length`` of ``root``, which slides move.

    Attributes:
        root: the first hinge's position with the slides before it in the middle of their ranges [m]. (3,)
        slides: half the travel of each of these slides, along its direction in the world [m]. (k, 3)
        length: of the links from there to the frame, with the slides among them drawn out [m]. ()
    """

    root: Float[Array, "3"]
    slides: Float[Array, "k 3"]
    length: Float[Array, ""]


def reaches(chain: Chain, x: Array, lower: Array, upper: Array) -> list[Reach]:
    """Return the reach of each frame, which does not depend on the configuration x."""
    kinematics, layout = chain_kinematics(chain, x[:, None]), chain.layout
    axis, anchor = kinematics.axis[..., 0], kinematics.anchor[..., 0]
    middle, half = 0.5 * (lower + upper) - x, 0.5 * (upper - lower)
    found = []
    for at, carried in enumerate(layout.carries):
        path = np.flatnonzero(carried).tolist()
        hinges = [j for j in path if layout.hinges[j]]
        points = [*(anchor[j] for j in hinges), kinematics.position[at, :, 0]]
        before = [points[0], *(after - here for here, after in pairwise(points))]
        travels: list[list[Array]] = [[] for _ in before]
        for j in path:
            if not layout.hinges[j] and layout.entries[j] >= 0:
                segment, entry = sum(hinge < j for hinge in hinges), layout.dofs.index(layout.entries[j])
                before[segment] = before[segment] + layout.factors[j] * middle[entry] * axis[j]
                travels[segment].append(abs(layout.factors[j]) * half[entry] * axis[j])
        links = [_norm(own) for own in before[1:]] + [_norm(own) for travel in travels[1:] for own in travel]
        slides = jnp.array(travels[0], x.dtype).reshape(-1, 3)
        found.append(Reach(before[0], slides, sum(links, jnp.zeros((), x.dtype))))
    return found


def _norm(vector: Float[Array, "... 3"]) -> Float[Array, "..."]:
    return jnp.sqrt(jnp.sum(vector**2, -1))


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
    x = search.unwound(jax.lax.stop_gradient(search).polished(x, jax.lax.stop_gradient(goal)))
    x = jax.vmap(at_solution, in_axes=(None, 0, 0))(search, goal, x)
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
        beyond_reach=_beyond(fixed_search, fixed_goal),
        joints=tuple(dof_names(robot)),
    )


def _evaluated(search: ChainSearch, x: Float[Array, "n lanes"], goal: Goal) -> tuple[Array, Array, Errors]:
    """Return the residual of each frame (frames, 6, lanes), the limits that stop it (n, lanes), and the errors."""
    error, matrix, errors = search.linearised(x, goal)
    rows = np.array(search.rows)
    scale = jnp.where(np.arange(6) < 3, 1.0, search.length)[None].repeat(len(rows), 0)[rows]
    residual = jnp.zeros((*rows.shape, x.shape[-1]), x.dtype).at[np.nonzero(rows)].set(error / scale[:, None])
    gradient = jnp.sum(matrix * error[:, None], 0)
    most = jnp.sqrt(jnp.sum(matrix**2, 0)) * jnp.sqrt(errors.cost)
    stopped = jnp.abs(gradient) > _STOPPED * most
    low, high = (x <= search.lower[:, None]) & (gradient > 0.0), (x >= search.upper[:, None]) & (gradient < 0.0)
    return residual, jnp.where(stopped, high.astype(jnp.int32) - low.astype(jnp.int32), 0), errors


def _beyond(search: ChainSearch, goal: Goal) -> Float[Array, " targets"]:
    """Return a lower bound on the distance from each target to the workspace, 0 where it may be inside."""
    found = reaches(search.chain, search.first, *starting_box(search.lower, search.upper))
    away = jnp.stack([_outside(reach, goal.position[:, at]) for at, reach in enumerate(found)], -1)
    asked = np.array(search.rows)[:, :3].all(-1)
    return jnp.maximum(jnp.max(jnp.where(jnp.isfinite(away) & asked, away, 0.0), -1), 0.0)


def _outside(reach: Reach, position: Float[Array, "targets 3"]) -> Float[Array, " targets"]:
    """Return a lower bound on the distance from each position to all that is within reach; not finite for none.

    The root moves in a convex set. In any direction a position is away from that set by at least as much as it is
    further than the set's furthest point.
    """
    way = position - reach.root
    shares = [jnp.zeros_like(way[:, 0])] * len(reach.slides)
    for _ in range(_SWEEPS):
        for at, slide in enumerate(reach.slides):
            left = _left(way, reach.slides, shares) + shares[at][:, None] * slide
            square = jnp.sum(slide**2)
            nearest = jnp.sum(left * slide, -1) / jnp.where(square > 0.0, square, 1.0)
            shares[at] = jnp.clip(nearest, -1.0, 1.0)
    left = _left(way, reach.slides, shares)
    distance = _norm(left)
    direction = left / jnp.where(distance > 0.0, distance, 1.0)[:, None]
    furthest = sum((jnp.abs(jnp.sum(direction * slide, -1)) for slide in reach.slides), reach.length)
    # rounded up, so that a target on the boundary is never called out of reach; positions round by their own size
    rounding = _ROUNDOFF * float(jnp.finfo(way.dtype).eps) * (furthest + jnp.max(jnp.abs(reach.root), -1))
    return jnp.sum(direction * way, -1) - (furthest + rounding)


def _left(way: Float[Array, "targets 3"], slides: Array, shares: list[Array]) -> Float[Array, "targets 3"]:
    """Return the way that is left after a share of each slide's travel."""
    return way - sum((share[:, None] * slide for share, slide in zip(shares, slides, strict=True)), jnp.zeros_like(way))
