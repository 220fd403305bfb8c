"""What every peer is asked to do, as plain numbers: no library is loaded here but NumPy.

Configurations are canonical: base position, base quaternion (x y z w), then the joints in ``Workload.joints``' order; a
fixed base has joints alone. Square-root weights are what mink and pink call costs.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

DT = 0.005
"""One step [s]; every task asks for its whole error in one."""
EASED = 0.5
"""Seconds over which the hand's curve swells from nothing to its size."""
COM_SECONDS = 1.0
"""Seconds in which the centre of mass goes to its goal."""
RATES = 2.0 * np.pi * np.array([0.5, 0.75, 1.0])
"""Of the hand's curve, along x, y, z [rad/s]."""


@dataclass(frozen=True)
class Costs:
    """Square roots of the weights."""

    foot: float = 10.0
    com: float = 5.0
    hand_position: float = 2.0
    hand_rotation: float = 0.5
    posture: float = 0.05


@dataclass(frozen=True)
class Workload:
    """Feet stay, the hand follows a Lissajous curve with a fixed orientation, the centre of mass goes to its goal.

    Attributes:
        robot: its name here.
        urdf: the whole text, without meshes.
        floating: whether its base is free.
        root: link that the base is.
        joints: names, in the canonical order.
        start: canonical configuration. (nq,)
        feet: links that stay; with none, there is no task for the centre of mass.
        foot_positions, foot_rotations: where. (feet, 3), (feet, 3, 3)
        hand: link that moves.
        hand_position, hand_rotation: pose at the start. (3,), (3, 3)
        amplitude: of the hand's curve [m]. (3,)
        com_start, com_goal: of the centre of mass. (3,)
        position_lower, position_upper, velocity: limits of the joints. (joints,)
        costs: square roots of the weights.
    """

    robot: str
    urdf: str
    floating: bool
    root: str
    joints: tuple[str, ...]
    start: np.ndarray
    feet: tuple[str, ...]
    foot_positions: np.ndarray
    foot_rotations: np.ndarray
    hand: str
    hand_position: np.ndarray
    hand_rotation: np.ndarray
    amplitude: np.ndarray
    com_start: np.ndarray
    com_goal: np.ndarray
    position_lower: np.ndarray
    position_upper: np.ndarray
    velocity: np.ndarray
    costs: Costs = Costs()

    def hand_at(self, step: int, lanes: np.ndarray | int = 0) -> np.ndarray:
        """Target of the hand; lane 0 is the standard one, each other at another phase of the curve: (..., 3)."""
        t = step * DT
        phase = 2.4 * np.asarray(lanes)[..., None]
        return self.hand_position + _eased(t / EASED) * self.amplitude * np.sin(RATES * t + phase)

    def com_at(self, step: int) -> np.ndarray:
        """Target of the centre of mass, (3,)."""
        return self.com_start + _eased(step * DT / COM_SECONDS) * (self.com_goal - self.com_start)

    def to_json(self) -> str:
        """Text that ``from_json`` reads."""
        return json.dumps(asdict(self), default=lambda array: array.tolist())

    @classmethod
    def from_json(cls, text: str) -> Workload:
        """The workload of a text."""
        given: dict[str, Any] = json.loads(text)
        costs = Costs(**given.pop("costs"))
        for key, value in given.items():
            if isinstance(value, list):
                given[key] = tuple(value) if key in ("joints", "feet") else np.asarray(value)
        return cls(**given, costs=costs)


def _eased(s: float) -> float:
    s = min(s, 1.0)
    return s * s * (3.0 - 2.0 * s)
