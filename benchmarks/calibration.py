"""Table of docs/data/measurements.md: calibrations of random robots, beside their truth and beside SciPy.

    python -m benchmarks.calibration

Each case draws a robot, configurations and noise. Coverage is the share of numbers within 3 of their own deviations (a
normal law: 99.73 %). The deviation of (fit - truth) / sigma shows whether sigma is right (1).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import scipy

import osik_jax as osik
from osik_jax import calibration as cal
from osik_jax.calibration._calibrate import rows_at
from osik_jax.calibration._setup import Setup, make_setup
from osik_jax.calibration._unknowns import apply, parameters_of
from osik_jax.robot._joint_selection import scalar_layout

CASES = 200
ARM = "right_shoulder_", "right_elbow_", "right_wrist_"
LOOKING = {"shoulder_lift_joint": -1.6, "elbow_joint": 1.6, "wrist_1_joint": -1.6, "wrist_2_joint": -1.57}
BOARD = 0.06 * np.array([(x, y, 0.0) for x in (-1, 1) for y in (-1, 1)])
FOCUS = (600.0, 600.0, 320.0, 240.0)


@dataclasses.dataclass(frozen=True)
class Study:
    """One kind of calibration.

    Attributes:
        robot: loads the robot.
        measurements: from configurations (n, nq), with readings that are replaced.
        unknowns: what is to be found.
        frames: fixed frames.
        spread: deviation of the truth from the file [m or rad].
        width: configurations are drawn up to this from q0 [rad]; None: in the middle 60 % of the joints' ranges.
        readings: number of configurations.
    """

    robot: Callable[[], osik.Robot]
    measurements: Callable[[jax.Array], tuple[cal.Measurement, ...]]
    unknowns: tuple[cal.Unknown, ...]
    frames: dict[str, cal.FixedFrame] = dataclasses.field(default_factory=dict)
    spread: float = 5e-3
    width: float | None = None
    readings: int = 40


def _g1() -> osik.Robot:
    names = osik.load_robot("g1").tree.joint_names
    return osik.load_robot("g1", locked_joints=[name for name in names if not name.startswith(ARM)])


def _points(frame: str, q: jax.Array, sigma: float = 2e-4) -> tuple[cal.Measurement, ...]:
    return (cal.Points(frame, q, jnp.zeros((len(q), 3)), sigma=sigma),)


def _panda(q: jax.Array) -> tuple[cal.Measurement, ...]:
    rotation = jnp.broadcast_to(jnp.eye(3), (len(q), 3, 3))
    return (cal.Poses("panda_hand", q, jnp.zeros((len(q), 3)), rotation, sigma=5e-4, sigma_rotation=2e-3),)


def _so101(q: jax.Array) -> tuple[cal.Measurement, ...]:
    frame, half = "gripper_frame_link", len(q) // 2
    contacts = cal.PlaneContacts(frame, "table", q[half:], sigma=1e-3)
    return cal.Distances(frame, "post", q[:half], jnp.zeros(half), sigma=1e-3), contacts


def _hand_eye(q: jax.Array) -> tuple[cal.Measurement, ...]:
    n = len(q) // 4
    point = jnp.tile(jnp.asarray(BOARD), (n, 1))
    q = jnp.repeat(q[:n], 4, 0)
    return (cal.Pixels("board", "camera", q, jnp.zeros((4 * n, 2)), FOCUS, point=point, sigma=0.3),)


STUDIES = {
    "Panda, poses: offsets, tool": Study(
        lambda: osik.load_robot("panda", locked_joints=("panda_finger_joint*",)),
        _panda,
        (cal.Unknown("joint_offset"), cal.Unknown("frame_position", "panda_hand")),
    ),
    "UR5, points: offsets, lengths, tool": Study(
        lambda: osik.load_robot("ur5"),
        partial(_points, "tool0"),
        (
            cal.Unknown("joint_offset", ("shoulder_*", "elbow_*", "wrist_[12]*")),
            cal.Unknown("body_position", ("shoulder_link", "forearm_link", "wrist_1_link"), axes="z"),
            cal.Unknown("joint_axis", "elbow_joint"),
            cal.Unknown("frame_position", "tool0"),
        ),
    ),
    "SO-101, distances and a plane": Study(
        lambda: osik.load_robot("so101", locked_joints=("gripper",)),
        _so101,
        (
            cal.Unknown("joint_offset", ("shoulder_lift", "elbow_flex", "wrist_flex")),
            cal.Unknown("frame_position", "post"),
            cal.Unknown("frame_position", "table", axes="z"),
            cal.Unknown("frame_rotation", "table", axes="xy"),
        ),
        {"post": cal.FixedFrame(position=(0.35, 0.2, 0.1)), "table": cal.FixedFrame(position=(0.0, 0.0, -0.02))},
        readings=80,
    ),
    "G1's arm, points: offsets, base": Study(
        _g1,
        partial(_points, "right_rubber_hand"),
        (
            cal.Unknown(
                "joint_offset", ("right_shoulder_roll*", "right_shoulder_yaw*", "right_elbow*", "right_wrist_roll*")
            ),
            cal.Unknown("base_position"),
            cal.Unknown("base_rotation"),
        ),
    ),
    "hand-eye camera, pixels: camera, board": Study(
        lambda: osik.load_robot("ur5").with_home(LOOKING),
        _hand_eye,
        (
            cal.Unknown("frame_position", "camera"),
            cal.Unknown("frame_rotation", "camera"),
            cal.Unknown("frame_position", "board"),
            cal.Unknown("frame_rotation", "board"),
        ),
        {"camera": cal.FixedFrame("tool0", (0.0, 0.05, 0.04)), "board": cal.FixedFrame(position=(0.48, 0.11, -0.3))},
        width=0.35,
        readings=100,
    ),
}


def draw_configurations(robot: osik.Robot, study: Study, rng: np.random.Generator, cases: int) -> np.ndarray:
    """Return configurations (cases, readings, nq)."""
    is_scalar, index = scalar_layout(robot)
    low, high = (np.asarray(bound)[is_scalar] for bound in (robot.position_lower, robot.position_upper))
    middle, half = (low + high) / 2, np.minimum(0.6 * (high - low) / 2, 2.5)
    home = np.asarray(robot.q0)
    if study.width is not None:
        middle, half = home[index[is_scalar]], study.width
    q = np.tile(home, (cases, study.readings, 1))
    q[..., index[is_scalar]] = middle + half * rng.uniform(-1, 1, (cases, study.readings, len(low)))
    return q


def read(measurement: cal.Measurement, setup: Setup, key: jax.Array, outliers: float = 0.0) -> cal.Measurement:
    """Return the readings of a true setup with normal noise; of outliers it is 100 times as large."""
    first, second = jax.random.split(key)
    sizes = measurement.deviations()
    wild = jax.random.uniform(first, (len(sizes), 1)) < outliers
    noise = jax.random.normal(second, sizes.shape) * sizes * jnp.where(wild, 100.0, 1.0)
    seen = measurement.predicted(setup)
    if isinstance(measurement, cal.Poses):
        turned = seen[1] @ jax.vmap(lambda v: jaxlie.SO3.exp(v).as_matrix())(noise[:, 3:])
        return eqx.tree_at(lambda m: m.readings, measurement, (seen[0] + noise[:, :3], turned))
    return eqx.tree_at(lambda m: m.readings, measurement, seen + noise.reshape(seen.shape))


def cases_of(
    study: Study, cases: int, *, outliers: float = 0.0, loss: str = "squared", seed: int = 0
) -> dict[str, np.ndarray]:
    """Return truth, fit and deviation (cases, p) of random cases, and whether each converged and was of full rank."""
    robot, rng = study.robot(), np.random.default_rng(seed)
    setup = make_setup(robot, study.frames, None)
    parameters, _ = parameters_of(setup, study.unknowns)
    truth = study.spread * rng.normal(size=(cases, len(parameters)))
    q = draw_configurations(robot, study, rng, cases)

    @jax.jit
    @jax.vmap
    def run(truth: jax.Array, q: jax.Array, key: jax.Array) -> tuple[jax.Array, ...]:
        true = apply(setup, parameters, truth)
        measurements = study.measurements(q)
        keys = jax.random.split(key, len(measurements))
        seen = [read(one, true, key, outliers) for one, key in zip(measurements, keys, strict=True)]
        found = cal.calibrate(robot, seen, study.unknowns, frames=study.frames, loss=loss)
        return found.vector, found.deviation, found.converged, found.observable.all(-1), found.iterations

    found = run(jnp.asarray(truth), jnp.asarray(q), jax.random.split(jax.random.key(seed), cases))
    names = "fit", "sigma", "converged", "full_rank", "iterations"
    return {"truth": truth, **dict(zip(names, map(np.asarray, found), strict=True))}


def coverage(cases: dict[str, np.ndarray]) -> tuple[float, float]:
    """Return the share of numbers within 3 deviations of the truth, and the deviation of their errors over sigma."""
    z = (cases["fit"] - cases["truth"]) / cases["sigma"]
    return float((np.abs(z) < 3.0).mean()), float(z.std())


def cost_of_outliers(study: Study, clean: dict[str, np.ndarray]) -> float:
    """Return the root mean square error with 20 % outliers by a robust loss over that of clean cases; a median."""
    robust = cases_of(study, len(clean["fit"]), outliers=0.2, loss="geman_mcclure")
    errors = [np.sqrt(((found["fit"] - found["truth"]) ** 2).mean(0)) for found in (robust, clean)]
    return float(np.median(errors[0] / errors[1]))


def still_wrist(cases: int) -> tuple[int, int]:
    """Return in how many cases of a UR5 with a still fifth joint at 0 d4 and d6 are named, and how many there were."""
    robot, rng, named = osik.load_robot("ur5"), np.random.default_rng(1), 0
    both = [cal.Unknown("body_position", "wrist_2_link", axes="y"), cal.Unknown("frame_position", "tool0", axes="y")]
    unknowns = [cal.Unknown("body_position", ("shoulder_link", "wrist_1_link"), axes="z"), *both]
    names = {f"{unknown.quantity}[{unknown.names}].y" for unknown in both}
    poses = jax.jit(jax.vmap(lambda q: osik.forward_kinematics(robot, q).frame_pose(robot, "tool0")[0]))
    for _ in range(cases):
        q = rng.uniform(-2.0, 2.0, (20, 6)) * [1, 1, 1, 1, 0, 1]
        seen = np.asarray(poses(q)) + 2e-4 * rng.normal(size=(20, 3))
        lost = cal.calibrate(robot, cal.Points("tool0", q, seen, sigma=2e-4), unknowns).unobservable
        named += [set(one.coefficients) for one in lost] == [names]
    return named, cases


def beside_scipy(study: Study) -> tuple[float, float, float]:
    """Return the distance of our optimum from SciPy's in deviations, and the times of both [s], compiled before."""
    robot, rng = study.robot(), np.random.default_rng(2)
    setup = make_setup(robot, study.frames, None)
    parameters, _ = parameters_of(setup, study.unknowns)
    true = apply(setup, parameters, jnp.asarray(study.spread * rng.normal(size=len(parameters))))
    measurements = study.measurements(jnp.asarray(draw_configurations(robot, study, rng, 1)[0]))
    seen = [read(one, true, jax.random.key(k)) for k, one in enumerate(measurements)]
    rows = jax.jit(lambda x: jnp.concatenate([part.ravel() for part in rows_at(setup, seen, parameters, x)]))
    options = dict(x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)  # differences of its own

    def ours() -> cal.Calibration:
        return jax.block_until_ready(cal.calibrate(robot, seen, study.unknowns, frames=study.frames))

    def theirs() -> np.ndarray:
        return scipy.optimize.least_squares(lambda x: np.asarray(rows(x)), np.zeros(len(parameters)), **options).x

    found, other = ours(), theirs()
    own, other_time = (min(_timed(run) for _ in range(5)) for run in (ours, theirs))
    apart = np.abs((np.asarray(found.vector) - other) / np.asarray(found.deviation)).max()
    return float(apart), own, other_time


def _timed(run: Callable[[], object]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def main() -> None:
    """Print the tables."""
    jax.config.update("jax_enable_x64", True)
    head = (
        "case",
        "numbers",
        "within 3 sigma",
        "errors / sigma",
        "20 % outliers",
        "SciPy apart [sigma]",
        "ours, SciPy [ms]",
    )
    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for name, study in STUDIES.items():
        found = cases_of(study, CASES)
        assert found["converged"].all() and found["full_rank"].all()
        inside, deviation = coverage(found)
        cost = cost_of_outliers(study, found)
        apart, own, other = beside_scipy(study)
        cells = len(found["fit"][0]), f"{100 * inside:.2f} %", f"{deviation:.3f}", f"{cost:.2f} times"
        times = f"{1e3 * own:.1f}, {1e3 * other:.1f}"
        print(f"| {name} | {' | '.join(map(str, cells))} | {apart:.1e} | {times} |", flush=True)
    print("UR5 with a still fifth joint at 0, d4 and d6 named: {} of {}".format(*still_wrist(CASES)))


if __name__ == "__main__":
    main()
