"""Where weights balance: how far feet give way to a hand that is out of reach, whatever damps the way there."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.optimize import minimize

from ..robots import workload
from ..workload import Workload
from ._cases import cases, without_turning
from ._reach import Search
from ._results import ON_FEET

_RUNS = 6
"""Of the search, each from where the last one ended."""


def balances() -> Iterator[list[str]]:
    """Cells of a table's lines, the headings first: of the worst of three directions, in mm."""
    yield ["robot", "posture", "feet off [mm]", "centre of mass off [mm]", "hand off [mm]"]
    for robot in ON_FEET:
        for posture in (True, False):
            work = without_turning(workload(robot), posture=posture)
            held = [balance(work, case.hand[0]) for case in cases(work) if case.name == "beyond"]
            worst = 1e3 * np.max(held, axis=0)
            yield [robot, "yes" if posture else "no", *(f"{off:.2g}" for off in worst[:2]), f"{worst[2]:.0f}"]


def balance(work: Workload, target: np.ndarray) -> tuple[float, float, float]:
    """How far the worse foot, the centre of mass and the hand are off where the tasks' cost is least [m].

    The cost is half the sum of weight times squared error, as the tasks of a step with one gain have it; joints keep
    their ranges. Found by L-BFGS-B from the start over the tangent space there: a local minimum.

    Args:
        work: robot and weights; of the hand the position alone counts.
        target: of the hand, in the world [m]. (3,)
    """
    search, costs = Search(work, np.zeros(3)), work.costs
    joints = slice(search.model.nv - len(work.position_lower), None)

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        slip, slopes = search.slips(x), search.slip_slopes(x)
        weight = np.repeat([costs.foot, costs.com], [len(slip) - 3, 3])
        off, jacobian = search.hand(x) - target, search.hand_slopes(x)
        error = np.concatenate([weight * slip, costs.hand_position * off, costs.posture * x[joints]])
        slope = slopes.T @ (weight**2 * slip) + costs.hand_position**2 * jacobian.T @ off
        slope[joints] += costs.posture**2 * x[joints]
        return 0.5 * float(error @ error), slope

    x, options = np.zeros(search.model.nv), dict(maxiter=20000, maxfun=40000, ftol=1e-16, gtol=1e-10)
    for _ in range(_RUNS):
        x = minimize(cost, x, jac=True, bounds=search.bounds(), method="L-BFGS-B", options=options).x
    com, hand = search.slips(x)[-3:], search.hand(x) - target
    return search.feet_off(x), float(np.linalg.norm(com)), float(np.linalg.norm(hand))
