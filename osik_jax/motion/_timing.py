"""Timed motion along a path: the answer of ``retime``."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._errors import OsikValueError
from ..numerics._arguments import as_floats
from ..numerics._dense import full_precision
from ._cells import Cells
from ._motion import Motion, at_rest_outside, one_axis, sample_times
from ._spline import Spline

_KINDS = "speed", "acceleration", "jerk"


class SlowPart(NamedTuple):
    """Part of a motion on which the tool is slower than wanted.

    Attributes:
        start, end: times [s].
        slowest: least speed of the tool there [m/s].
        joint: name or number of the joint that is nearest to a limit there, on average.
        limit: "speed", "acceleration" or "jerk".
    """

    start: float
    end: float
    slowest: float
    joint: str
    limit: str


class Timing(eqx.Module):
    """Least-time motion along a spline.

    Attributes:
        duration: of the motion [s]; with derivatives by waypoints and limits.
        path: the spline, by a parameter s from 0 to 1.
        progress: s as a function of time.
        limits: of speed, acceleration and jerk, infinite where there is none. (3, n)
        stretch: factor by which times were multiplied to keep limits between the grid's points too.
        wanted: wanted speed of the tool [m/s], None without one.
        joints: names of the joints (static).
    """

    duration: Float[Array, ""]
    path: Spline
    progress: Cells
    limits: Float[Array, "3 n"]
    stretch: Float[Array, ""]
    wanted: Float[Array, ""] | None = None
    joints: tuple[str, ...] = eqx.field(default=(), static=True)

    def at(self, time: Float[ArrayLike, " T"]) -> Float[Array, "4 T n"]:
        """Return positions, velocities, accelerations and jerks at times [s]; at rest before 0 and after the end."""
        return _at(self.path, self.progress, as_floats(one_axis(time)))

    def sample(self, dt: float) -> Motion:
        """Return the motion at times ``dt`` apart [s], the last of which is the end or just after it (outside jit)."""
        time = sample_times(float(self.duration), dt)
        q, v, a, _ = sampled(self, time)
        return Motion(*map(jnp.asarray, (time, q, v, a)), joints=self.joints)

    def slow_parts(self, tool_speed: Float[np.ndarray, " T"], time: Float[np.ndarray, " T"]) -> list[SlowPart]:
        """Return where the tool is slower than wanted by 1 %, and the limit that is nearest there.

        Args:
            tool_speed: of the tool [m/s].
            time: of those speeds [s].
        """
        if self.wanted is None:
            raise OsikValueError("no speed was wanted: give retime(..., speed=) or follow(..., speed=)")
        slow = np.append(tool_speed < 0.99 * float(self.wanted), False)
        ends = np.flatnonzero(np.diff(np.append(False, slow).astype(int)))
        used = np.abs(sampled(self, time)[1:]) / np.asarray(self.limits)[:, None]
        return [self._slow_part(used[:, a:b], tool_speed[a:b], time[a:b]) for a, b in ends.reshape(-1, 2)]

    def _slow_part(self, used: np.ndarray, speed: np.ndarray, time: np.ndarray) -> SlowPart:
        kind, joint = np.unravel_index(int(used.mean(axis=1).argmax()), used.shape[::2])
        name = self.joints[joint] if self.joints else str(joint)
        return SlowPart(float(time[0]), float(time[-1]), float(speed.min()), name, _KINDS[int(kind)])


def by_progress(states: Float[Array, "4 T n"], progress: Float[Array, "4 T"]) -> Float[Array, "4 T n"]:
    """Return positions, velocities, accelerations and jerks, by a path's derivatives by s and those of s by time."""
    q, q1, q2, q3 = states
    s1, s2, s3 = progress[1:, :, None]
    return jnp.stack([q, q1 * s1, q2 * s1**2 + q1 * s2, q3 * s1**3 + 3.0 * q2 * s1 * s2 + q1 * s3])


@jax.jit
@full_precision
def _at(path: Spline, progress: Cells, time: Float[Array, " T"]) -> Float[Array, "4 T n"]:
    moved = progress.at(time)
    states = by_progress(path.derivatives(moved[0]), moved)
    return at_rest_outside(states, time, progress.start[0], progress.start[-1])


def sampled(timing: Timing, time: np.ndarray) -> Float[np.ndarray, "4 T n"]:
    """Return the states at times as NumPy arrays; few lengths are compiled."""
    size = max(256, 1 << (len(time) - 1).bit_length())
    return np.asarray(timing.at(jnp.asarray(np.pad(time, (0, size - len(time)), mode="edge"))))[:, : len(time)]
