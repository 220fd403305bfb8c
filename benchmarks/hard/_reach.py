"""How far a hand can go in a direction while the robot stands as it stands."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from scipy.optimize import minimize

from ..robots import pinocchio_model
from ..workload import Workload


def farthest(work: Workload, direction: np.ndarray) -> np.ndarray:
    """The hand's farthest place along a unit vector: feet and centre of mass stay, joints keep their ranges; (3,).

    No place that the hand can have is farther along it, so the point ``a`` ahead of this one is ``a`` out of reach.
    It is a local maximum, found by SLSQP from the start over the tangent space there.

    Raises:
        RuntimeError: the search has not ended well.
    """
    search = Search(work, np.asarray(direction, float))
    found = minimize(
        search.height,
        np.zeros(search.model.nv),
        jac=search.slope,
        bounds=search.bounds(),
        constraints=dict(type="eq", fun=search.slips, jac=search.slip_slopes) if work.feet else (),
        method="SLSQP",
        options=dict(maxiter=500, ftol=1e-10),
    )
    slip = np.abs(search.slips(found.x)).max() if work.feet else 0.0
    if not found.success or slip > 1e-6:
        raise RuntimeError(f"the reach of {work.robot} was not found: {found.message}, feet off by {slip:.1e}")
    return search.hand(found.x)


class Search:
    """Functions of a step x from the start, and their derivatives."""

    def __init__(self, work: Workload, direction: np.ndarray) -> None:
        self.work, self.direction = work, direction
        self.model = pinocchio_model(work.urdf, work.floating)
        self.data = self.model.createData()
        self.frames = [self.model.getFrameId(name) for name in (work.hand, *work.feet)]
        self.places = [pin.SE3(R, p) for R, p in zip(work.foot_rotations, work.foot_positions, strict=True)]

    def bounds(self) -> list[tuple[float | None, float | None]]:
        """Of x: the joints' ranges, none for the base."""
        work, base = self.work, 7 if self.work.floating else 0
        low, high = (side - work.start[base:] for side in (work.position_lower, work.position_upper))
        free = [(None, None)] * (self.model.nv - len(low))
        return [*free, *zip(low, high, strict=True)]

    def hand(self, x: np.ndarray) -> np.ndarray:
        """Where the hand is."""
        self._move(x)
        return self.data.oMf[self.frames[0]].translation.copy()

    def height(self, x: np.ndarray) -> float:
        """Minus the hand's place along the direction."""
        return -float(self.direction @ self.hand(x))

    def slope(self, x: np.ndarray) -> np.ndarray:
        """Derivative of ``height``."""
        return -self.direction @ self.hand_slopes(x)

    def hand_slopes(self, x: np.ndarray) -> np.ndarray:
        """Derivative of ``hand``."""
        moved = self._move(x)
        return pin.getFrameJacobian(self.model, self.data, self.frames[0], pin.LOCAL_WORLD_ALIGNED)[:3] @ moved

    def slips(self, x: np.ndarray) -> np.ndarray:
        """How far the feet and the centre of mass are from their places."""
        self._move(x)
        feet = [pin.log6(place.actInv(self.data.oMf[i])).vector for place, i in self._feet()]
        return np.concatenate([*feet, self.data.com[0] - self.work.com_start])

    def feet_off(self, x: np.ndarray) -> float:
        """The larger distance of a foot from its place [m]."""
        self._move(x)
        return max(float(np.linalg.norm(self.data.oMf[i].translation - place.translation)) for place, i in self._feet())

    def slip_slopes(self, x: np.ndarray) -> np.ndarray:
        """Derivative of ``slips``."""
        moved = self._move(x)
        rows = [
            pin.Jlog6(place.actInv(self.data.oMf[i])) @ pin.getFrameJacobian(self.model, self.data, i, pin.LOCAL)
            for place, i in self._feet()
        ]
        return np.concatenate([*rows, pin.jacobianCenterOfMass(self.model, self.data)]) @ moved

    def _feet(self) -> list[tuple[pin.SE3, int]]:
        return list(zip(self.places, self.frames[1:], strict=True))

    def _move(self, x: np.ndarray) -> np.ndarray:
        """Puts the robot there; the derivative of its configuration by x, in the tangent space there."""
        q = pin.integrate(self.model, self.work.start, x)
        pin.computeJointJacobians(self.model, self.data, q)
        pin.centerOfMass(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)
        return pin.dIntegrate(self.model, self.work.start, x, pin.ArgumentPosition.ARG1)
