"""A long job: random reaching motions, their ends on disk; killed and started again, it goes on where it was.

    python -m benchmarks.job FOLDER [--steps 1e8] [--robot g1] [--length 100] [--chunk 8192] [--precision float64]

Each lane is a motion of so many steps of the loop of ``benchmarks.throughput``, from arms somewhere in the middle of
their ranges to a point within 10 cm of the hand's home. Lanes are drawn chunk by chunk, split over all devices (on a
CPU, one for each core), and what is kept of each is where it ended, how far off its hand was, and whether all of its
steps were SOLVED.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import osik_jax as osik
from osik_jax import scaling
from osik_jax.runtime import configure_cpu

from .descriptions import ROBOTS
from .processes import cores
from .throughput import DT, PRECISIONS, Setting, arm_angles, setting

REACH = 0.1
"""[m] along each axis, at most."""
SEED = 0


def motion(length: int) -> Any:
    """The function of one lane: a start and a target to what is kept of its motion."""

    def lane(own: tuple[jax.Array, jax.Array], robot: Any, tasks: Any, limits: Any) -> dict[str, jax.Array]:
        start, point = own
        hand = tasks["hand"]
        aimed = tasks | {"hand": hand.replace(target=(point, hand.target[1]))}
        run = osik.rollout(robot, start, aimed, scheme=osik.WeightedQP(), limits=limits, dt=DT, steps=length)
        end = osik.forward_kinematics(robot, run.q[-1]).frame_pose(robot, hand.frame)[0]
        solved = (run.solution.status == osik.Status.SOLVED).all()
        return dict(q=run.q[-1], error=jnp.linalg.norm(end - point), solved=solved)

    return lane


def drawn(given: Setting, robot: str) -> Any:
    """Starts and targets of lanes by their numbers, the same in every run."""
    hand = given.tasks["hand"]
    assert isinstance(hand, osik.FrameTask)
    starts, home = arm_angles(given.robot, ROBOTS[robot].arms)[0], np.asarray(hand.target[0])
    dtype = given.robot.q0.dtype

    def batch(start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng([SEED, start])
        where = starts[rng.integers(len(starts), size=stop - start)]
        points = home + REACH * rng.uniform(-1.0, 1.0, (stop - start, 3))
        return where.astype(dtype), points.astype(dtype)

    return batch


def main() -> None:
    """Runs what is missing, and says what there is."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.job", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--steps", type=float, default=1e8, help="of all robots together")
    parser.add_argument("--robot", default="g1", choices=sorted(ROBOTS))
    parser.add_argument("--length", type=int, default=100, help="of a motion")
    parser.add_argument("--chunk", type=int, default=8192, help="motions at a time")
    parser.add_argument("--precision", default="float64", choices=PRECISIONS)
    given = parser.parse_args()
    if len(cores()) > 1:
        jax.config.update("jax_num_cpu_devices", len(cores()))
    jax.config.update("jax_enable_x64", given.precision == "float64")
    loop, count = setting(given.robot), int(given.steps / given.length)
    started = time.time()  # as files are dated
    saved = scaling.run_in_chunks(
        scaling.sharded(motion(given.length), in_axes=(0, None, None, None)),
        drawn(loop, given.robot),
        count=count,
        chunk=given.chunk,
        shared=(loop.robot, loop.tasks, loop.limits),
        out=given.folder,
        label=f"{given.length} steps of benchmarks.job",
    )
    seconds = time.time() - started
    new = sum(path.stat().st_mtime >= started for path in given.folder.glob("*.npz"))
    ran = min(new * given.chunk, count)
    found = saved.read(["error", "solved"])
    print(
        f"{ran * given.length:,} steps in {seconds:.0f} s; of {count:,} motions {found['solved'].mean():.2%} SOLVED "
        f"throughout, hands {1e3 * np.median(found['error']):.2f} mm off at the end (median)"
    )


if __name__ == "__main__":
    configure_cpu()
    main()
