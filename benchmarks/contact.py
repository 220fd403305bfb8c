"""What stands, found under noise, beside the same clips without: python -m benchmarks.contact CLIP... [--help].

Clips are what ``load_motion`` reads; what they say of standing and of the floor is left out, and compared with in a
second pair of columns. White noise goes on every joint. Shares are of frames and of heels and toes: of those found that
stand (precision), and of those that stand that are found (recall).
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from osik_jax.retargeting import HumanMotion, load_motion
from osik_jax.retargeting._person import read_person
from osik_jax.retargeting._skeletons import find_roles


def spoiled(motion: HumanMotion, noise: float, tilt: float, drift: float, seed: int) -> HumanMotion:
    """A clip with noise [m] on each coordinate, on a floor that tilts along x [rad] and drifts [m/s], unlabelled."""
    positions = motion.positions + noise * np.random.default_rng(seed).standard_normal(motion.positions.shape)
    time = np.arange(motion.frames)[:, None] / motion.fps
    positions[..., 2] += np.tan(tilt) * motion.positions[..., 0] + drift * time
    return dataclasses.replace(motion, positions=positions, rotations=None, contact=None, ground=None)


def standing(motion: HumanMotion) -> Bool[np.ndarray, "F 4"]:
    """What is found to stand."""
    return read_person(motion, find_roles(motion.joint_names)).contact


def shares(found: np.ndarray, true: np.ndarray) -> str:
    """Precision and recall."""
    both = float((found & true).sum())
    return f"{both / max(found.sum(), 1):.2f} {both / max(true.sum(), 1):.2f}"


def main() -> None:
    """Prints a line a rate, noise and floor, and one a clip with ``--clips``."""
    parser = argparse.ArgumentParser(description="What stands, found under noise.")
    parser.add_argument("paths", nargs="+", type=Path, metavar="CLIP")
    parser.add_argument("--fps", nargs="+", type=float, default=[30.0], help="rates, by straight lines between frames")
    parser.add_argument("--noise", nargs="+", type=float, default=[0.0, 0.002, 0.005, 0.01], help="[m]")
    parser.add_argument("--tilt", type=float, default=0.0, help="of the floor [deg]")
    parser.add_argument("--drift", type=float, default=0.0, help="of the floor's height [m/s]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--clips", action="store_true", help="a line for each clip too")
    parser.add_argument("--out", type=Path, help="folder for the clips that this makes, without labels, as .npz")
    options = parser.parse_args()
    motions = [load_motion(path) for path in options.paths]
    for fps in options.fps:
        for noise in options.noise:
            found, plain, own = [], [], []
            for motion in (motion.resampled(fps) for motion in motions):
                seen = spoiled(motion, noise, np.radians(options.tilt), options.drift, options.seed)
                if options.out is not None:
                    options.out.mkdir(parents=True, exist_ok=True)
                    file = options.out / f"{motion.name}_{fps:g}_{1e3 * noise:g}.npz"
                    np.savez(file, fps=fps, positions=seen.positions, joint_names=seen.joint_names)
                found.append(standing(seen))
                plain.append(standing(spoiled(motion, 0.0, 0.0, 0.0, 0)))
                own.append(plain[-1] if motion.contact is None else motion.contact)
                if options.clips:
                    print(f"{motion.name:16s} {shares(found[-1], plain[-1])}   {shares(found[-1], own[-1])}")
            all_found, all_plain, all_own = (np.concatenate(flags) for flags in (found, plain, own))
            print(
                f"{fps:g} Hz, {1e3 * noise:g} mm: precision and recall {shares(all_found, all_plain)}, "
                f"of the clips' own labels {shares(all_found, all_own)}"
            )


if __name__ == "__main__":
    main()
