"""Computation of a reachability map for a robot and a frame."""

from __future__ import annotations

import os
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from .._progress import Progress
from ..collision import Scene
from ..collision._robot_shapes import Given, robot_shapes
from ..collision._scene import check_scene
from ..control._checks import check_setting, checked_limits
from ..inverse import inverse_kinematics
from ..inverse._inverse_kinematics import checked_tolerances
from ..inverse._poses import read_poses
from ..limits import Limits
from ..numerics._arguments import check_count
from ..robot import Robot
from ..scaling import run_in_chunks
from ._frame import Frame, read_frame
from ._grid import Grid, around, checked_grid, spread, spread_rotations
from ._map import ReachabilityMap

_POSES = 16_384
"""Poses in a chunk: some seconds of work, and enough to fill the cores."""


def reachability_map(
    robot: Robot,
    frame: str,
    *,
    grid: Grid | int = 20_000,
    orientations: int | ArrayLike | Array = 64,
    limits: Limits | None = None,
    seeds: int = 64,
    key: int = 0,
    position_tolerance: float = 1e-3,
    orientation_tolerance: float = 1e-2,
    scene: Scene | None = None,
    clearance: float = 0.0,
    srdf: Given = None,
    out: str | os.PathLike[str] | None = None,
    progress: Progress = True,
) -> ReachabilityMap:
    """Return the share of orientations that a frame reaches at each position of a grid, and its best manipulability.

    Each pose is searched for as in ``inverse_kinematics``, joints within their limits; positions that are proven to be
    beyond the links' lengths are not. So what is reached is certain, and what is not was not found by ``seeds``
    searches. The answer is the same each time, for the same arguments.

    Args:
        robot: the robot.
        frame: name of a body, link, site or geom that hinges and slides carry.
        grid: coordinates of the positions along x, y and z, world axes, increasing [m]; or about how many positions to
            put around all that the frame gets to, with one spacing and a margin.
        orientations: how many, spread evenly; or which: matrices (m, 3, 3), frame axes to world
            axes, or quaternions w x y z (m, 4).
        limits: as in ``inverse_kinematics``.
        seeds: searches for a pose, at most.
        key: an integer: other starts of the searches.
        position_tolerance: largest distance from a position [m].
        orientation_tolerance: largest angle to an orientation [rad].
        scene: obstacles: a pose is reached where the robot touches neither them nor itself, as in
            ``inverse_kinematics``.
        clearance: smallest distance of all pairs of shapes, with a scene [m].
        srdf: pairs that may touch, with a scene.
        out: folder for what is finished, as in ``run_in_chunks``: called again with the same arguments, a job that was
            killed goes on where it was. Default: none.
        progress: whether to show a bar; or a function of the number of positions that are done and of all. Those that
            are proven out of reach are not counted.

    Returns:
        A map, as NumPy arrays.

        - ``frame``: its name.
        - ``x``, ``y``, ``z``: coordinates of the positions, world axes [m]. (nx,), (ny,), (nz,)
        - ``positions``: the positions [m]. (nx, ny, nz, 3)
        - ``rotations``: orientations that were asked for, frame axes to world axes. (m, 3, 3)
        - ``reached``: whether a configuration was found for each pose. (nx, ny, nz, m)
        - ``share``: share of the orientations that are reached at each position. (nx, ny, nz)
        - ``beyond_reach``: lower bound on the distance from the position to the workspace, from the lengths of the
            links [m]: above 0 it proves that the position is out of reach. (nx, ny, nz)
        - ``manipulability``: largest index of Yoshikawa among the configurations found at the position, of the six rows
            of the frame's Jacobian, or of its columns if there are fewer; NaN if none is found. (nx, ny, nz)
        - ``q``: the configuration with this index; NaN if none is found. (nx, ny, nz, nq)
        - ``links``: positions at home of the joints of the frame's chain, and of the frame [m]. (k, 3)
        - ``save(path)`` writes the map for ``load_map``. ``figure(at=None)`` returns a matplotlib figure of slices
            across x, y and z through a point, by default where most is reached.

    Raises:
        KeyError: no such frame; the message lists those that exist.
        TypeError: no robot, grid, orientations or limits.
        ValueError: a frame that is not carried by hinges and slides alone, a grid that does not increase, rotations
            that are none, or numbers out of range; a folder with another map in it.
        OSError: the folder cannot be written to.
    """
    check_setting("reachability_map(robot, frame)", robot, None, 1.0)
    check_count("seeds", seeds)
    check_count("key", key, least=0)
    checked_tolerances(position_tolerance, orientation_tolerance, robot.q0.dtype)
    if scene is not None:
        check_scene(scene, single=True)
    limits = checked_limits(robot, limits)
    own = read_frame(robot, frame, limits, key)
    axes = around(own, grid) if isinstance(grid, int | np.integer) else checked_grid(grid)
    rotations = _rotations(robot, frame, orientations)
    positions = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    beyond = np.asarray(own.beyond_reach(jnp.asarray(positions, robot.q0.dtype)))
    near = beyond <= 0.0
    tolerances = dict(position_tolerance=position_tolerance, orientation_tolerance=orientation_tolerance)
    settings = dict(limits=limits, seeds=seeds, key=key, scene=scene, clearance=clearance, **tolerances)
    # the pairs take part in what tells one job from another
    pairs = None if scene is None else np.array(robot_shapes(robot, srdf).pairs)
    found = _run(own, positions[near], rotations, settings, (srdf, pairs), out, progress)
    shape = tuple(len(axis) for axis in axes)

    return ReachabilityMap(
        frame=frame,
        **dict(zip("xyz", axes, strict=True)),
        rotations=rotations,
        reached=spread(found["reached"], near, False).reshape(*shape, -1),
        beyond_reach=beyond.reshape(shape),
        manipulability=spread(found["manipulability"], near, np.nan).reshape(shape),
        q=spread(found["q"], near, np.nan).reshape(*shape, -1),
        links=np.asarray(own.links()),
    )


def _rotations(robot: Robot, frame: str, given: int | ArrayLike | Array) -> Float[np.ndarray, "m 3 3"]:
    if isinstance(given, int | np.integer):
        check_count("orientations", given)
        return spread_rotations(int(given)).astype(robot.q0.dtype)
    shape = np.shape(given)
    if shape[1:] not in ((3, 3), (4,)) or not shape[0]:
        raise OsikValueError(
            f"orientations have shape {shape}; they are matrices (m, 3, 3), or quaternions w x y z (m, 4)"
        )
    goal, _, _ = read_poses(robot, {frame: (np.zeros((shape[0], 3)), given)})
    return np.asarray(goal.rotation[:, 0])


def _run(
    frame: Frame,
    positions: Float[np.ndarray, "n 3"],
    rotations: Float[np.ndarray, "m 3 3"],
    settings: dict[str, Any],
    kept_apart: tuple[Given, Any],
    out: Any,
    progress: Progress,
) -> dict[str, np.ndarray]:
    """Return the reached orientations at the positions, computed in chunks."""
    count, dtype = len(rotations), frame.robot.q0.dtype
    like = {"reached": (np.bool_, (count,)), "manipulability": (dtype, ()), "q": (dtype, (frame.robot.nq,))}
    if not len(positions):
        return {name: np.zeros((0, *shape), kind) for name, (kind, shape) in like.items()}

    srdf, pairs = kept_apart

    def run(positions: Any, robot: Robot, rotations: Any, settings: dict[str, Any], pairs: Any) -> dict[str, Any]:
        del pairs
        if isinstance(positions, Tracer):  # only the shapes are asked for
            return {name: jnp.zeros((len(positions), *shape), kind) for name, (kind, shape) in like.items()}
        return _reached(frame, positions, rotations, dict(settings, srdf=srdf))

    found = run_in_chunks(
        run,
        positions,
        chunk=max(min(_POSES // count, len(positions)), 1),
        shared=(frame.robot, rotations, settings, pairs),
        out=out,
        label=f"reachability of {frame.name}",
        progress=progress,
        unit="positions",
    )
    return found if out is None else found[:]


def _reached(frame: Frame, positions: np.ndarray, rotations: np.ndarray, settings: dict[str, Any]) -> dict[str, Any]:
    """Return which orientations are reached at each position, and the most manipulable of their configurations."""
    count, number = len(positions), len(rotations)
    poses = np.repeat(positions, number, 0), np.tile(rotations, (count, 1, 1))
    found = inverse_kinematics(frame.robot, {frame.name: poses}, restarts=0, closest=False, **settings)
    reached = np.asarray(found.converged).reshape(count, number)
    index = np.where(reached, np.asarray(frame.manipulability(found.q)).reshape(count, number), -1.0)
    best, some = index.argmax(1), np.any(reached, 1)
    q = np.asarray(found.q).reshape(count, number, -1)[np.arange(count), best]
    return {
        "reached": reached,
        "manipulability": np.where(some, index.max(1), np.nan).astype(frame.robot.q0.dtype),
        "q": np.where(some[:, None], q, np.nan),
    }
