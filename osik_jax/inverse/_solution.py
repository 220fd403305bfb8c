"""Answers of inverse kinematics, and the reasons of a failure."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._errors import OsikValueError

_NEAR = 5e-3
"""Pairs that are nearer than this to what they may be are told of [m]."""


class InverseKinematicsSolution(eqx.Module):
    """Answer of inverse kinematics: the configuration found, or the best one; many targets have a leading axis.

    Attributes:
        q: the best configuration, its joints within their limits exactly. (..., nq)
        converged: whether every error at q is within its tolerance. (...)
        position_error: the largest distance of a frame from its target [m]. (...)
        orientation_error: the largest angle of a frame to its target [rad]. (...)
        seed: number of the search that found q. (...)
        steps: that were taken for the target, all searches together. (...)
        residual: of each frame, ``[p - p*, log(R R*')]``, world axes [m, rad], 0 in the rows not asked for; of each
            task, the error of its rows, or of an inequality how far it is outside. {name: (..., m)}
        at_limit: of each entry of v, -1 or 1 where its joint stands at its lower or upper limit and a step past it
            would reduce the error; else 0. (..., nv)
        beyond_reach: how far the target is at least from all that the frame could ever reach, from the lengths of the
            links and the travel of slides alone [m]: more than 0 proves that there is no solution. (...)
        solutions: with ``all=True``, the distinct solutions: ``q``, then the other branches, then copies of these by
            whole turns of joints whose limits allow it. Each branch is as near to ``q0`` as whole turns bring it. Rows
            from ``count`` on are NaN. (..., seeds, nq)
        count: with ``all=True``, how many there are. (...)
        branches: with ``all=True``, how many differ by more than whole turns: the first rows of ``solutions``. (...)
        isolated: with ``all=True``, of each branch whether it is an isolated point: every motion of the joints leads
            off the targets. The others are samples of a continuum; False from ``branches`` on. (..., seeds)
        base_moved: with tasks, or poses of frames that a free base carries: how far the base is from where it is in
            ``q0``, its origin [m] and its axes [rad], the largest of several. None for a robot without one. (..., 2)
        clearance: with a scene, the signed distance of the nearest pair [m]; with a ``CollisionAvoidanceLimit``, that
            less ``minimum_distance``. (...)
        nearest_pair: number of that pair in ``pairs``. (...)
        obstruction: with a scene, why no free configuration is found: 0 if one is, or no solution at all; 1 if shapes
            touch that no joint of the frames moves; 2 if an obstacle stands where the target puts the frame's body, so
            that there is none; 3 if something touches in all solutions found. (...)
        joints: names of the joints, for each entry of v (static).
        pairs: names of the shapes that are kept apart (static).
        advice: what to ask for instead, where frames have more rows than joints carry them (static).
    """

    q: Float[Array, "*n nq"]
    converged: Bool[Array, "*n"]
    position_error: Float[Array, "*n"]
    orientation_error: Float[Array, "*n"]
    seed: Int[Array, "*n"]
    steps: Int[Array, "*n"]
    residual: dict[str, Float[Array, "*n m"]]
    at_limit: Int[Array, "*n nv"]
    beyond_reach: Float[Array, "*n"]
    solutions: Float[Array, "*n seeds nq"] | None = None
    count: Int[Array, "*n"] | None = None
    branches: Int[Array, "*n"] | None = None
    isolated: Bool[Array, "*n seeds"] | None = None
    base_moved: Float[Array, "*n 2"] | None = None
    clearance: Float[Array, "*n"] | None = None
    nearest_pair: Int[Array, "*n"] | None = None
    obstruction: Int[Array, "*n"] | None = None
    joints: tuple[str, ...] = eqx.field(default=(), static=True)
    pairs: tuple[tuple[str, str], ...] = eqx.field(default=(), static=True)
    advice: tuple[str, ...] = eqx.field(default=(), static=True)

    def explain(self, index: int | None = None) -> str:
        """Return the answer for one target in words: its errors, and what stops the robot if the target is not met.

        Args:
            index: of the target, where there are many.

        Raises:
            ValueError: there are many targets and no index, or one alone and an index.
            IndexError: there is no such target.
        """
        many = np.ndim(self.converged) > 0
        if many != (index is not None):
            count = len(np.asarray(self.converged)) if many else 1
            raise OsikValueError(
                f"explain({'' if index is None else index}): there are {count} targets; give one's number"
            )
        pick = (lambda a: np.asarray(a)) if index is None else (lambda a: np.asarray(a)[index])
        errors = f"{pick(self.position_error):.3g} m and {pick(self.orientation_error):.3g} rad off"
        if self.base_moved is not None and (moved := pick(self.base_moved)).any():
            errors += f", with the base {moved[0]:.3g} m and {moved[1]:.3g} rad from q0"
        if pick(self.converged):
            return f"found, {errors} (search {pick(self.seed)})"
        lines = [f"not found in {pick(self.steps)} steps; the best configuration is {errors}"]
        lines += [f"  {name}: {_miss(pick(residual))}" for name, residual in self.residual.items()]
        return "\n".join([*lines, *(f"  {reason}" for reason in self._reasons(pick))])

    def _reasons(self, pick: Callable[[Any], np.ndarray]) -> list[str]:
        """Return the reasons that stop the robot, one line each."""
        beyond, at_limit = float(pick(self.beyond_reach)), pick(self.at_limit)
        sides = {-1: "lower", 1: "upper"}
        reasons = [f"{self.joints[i]} is at its {sides[int(at_limit[i])]} limit" for i in np.flatnonzero(at_limit)]
        if beyond > 0.0:
            return [f"out of reach: at least {beyond:.3g} m too far away, even with all links in one line", *reasons]
        if self.clearance is not None and self.nearest_pair is not None:
            pair, gap = self.pairs[int(pick(self.nearest_pair))], round(float(pick(self.clearance)), 6) + 0.0
            if self.obstruction is not None and pick(self.obstruction) > 0:
                return [_obstruction(int(pick(self.obstruction)), *pair, gap)]
            if gap < _NEAR:
                reasons.append(f"{pair[0]} and {pair[1]} are {gap:+.3g} m from as near as they may be")
        reasons += self.advice
        return reasons or ["no limit stops a joint: the links are stretched, folded or turned as far as they go"]


def _obstruction(reason: int, one: str, other: str, gap: float) -> str:
    """Return why no configuration is free; ``reason``: of ``InverseKinematicsSolution.obstruction``."""
    how = f"{one} and {other} overlap by {-gap:.3g} m" if gap < 0.0 else f"{one} and {other} are {gap:.3g} m apart"
    return {
        1: f"{how} where q0 puts them, and no joint of these frames moves them apart: change q0 or the scene, or allow "
        "the pair by srdf=",
        2: f"{how} wherever the target is met: an obstacle stands around the target, so no configuration is free",
        3: f"something is in the way in every solution found; in the best one {how}",
    }[reason]


def with_fields(solution: InverseKinematicsSolution, **fields: Any) -> InverseKinematicsSolution:
    """Return a copy with other fields; ``dataclasses.replace`` takes as long as a search."""
    new = object.__new__(type(solution))
    for name, value in {**vars(solution), **fields}.items():
        object.__setattr__(new, name, value)
    return new


def _miss(residual: np.ndarray) -> str:
    """Return a residual as text."""
    numbers = " ".join(f"{value:+.3g}" for value in residual)
    return f"{numbers} from the target" + (" (x y z [m], rotation about x y z [rad])" if len(residual) == 6 else "")
