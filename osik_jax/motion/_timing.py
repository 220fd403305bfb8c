"""Timed motion along a path: the answer of ``retime``."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics._dense import full_precision
from ._cells import Cells
from ._motion import Motion, at_rest_outside, sample_times
from ._spline import Spline


class Timing(eqx.Module):
    """Least-time motion along a spline.

    Attributes:
        duration: of the motion [s]; with derivatives by waypoints and limits.
        path: the spline, by a parameter s from 0 to 1.
        progress: s as a function of time.
        limits: of speed, acceleration and jerk, infinite where there is none. (3, n)
        stretch: factor by which times were multiplied to keep limits between the grid's points too.
        joints: names of the joints (static).
    """

    duration: Float[Array, ""]
    path: Spline
    progress: Cells
    limits: Float[Array, "3 n"]
    stretch: Float[Array, ""]
    joints: tuple[str, ...] = eqx.field(default=(), static=True)

    def at(self, time: Float[Array, " T"]) -> Float[Array, "4 T n"]:
        """Return positions, velocities, accelerations and jerks at times [s]; at rest before 0 and after the end."""
        return _at(self.path, self.progress, time)

    def sample(self, dt: float) -> Motion:
        """Return the motion at times ``dt`` apart [s], the last of which is the end or just after it (outside jit)."""
        time = sample_times(float(self.duration), dt)
        q, v, a, _ = sampled(self, time)
        return Motion(*map(jnp.asarray, (time, q, v, a)), joints=self.joints)


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
