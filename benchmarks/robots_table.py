"""The table of tested robots: what loads, how large it is, whether its poses are right, and how fast it is.

    python -m benchmarks.robots_table [--robots g1,panda] [--write]
    python -m benchmarks.robots_table --robots g1_mj_description  # any name of robot_descriptions, which clones it

Poses of all links at random configurations are compared with Pinocchio's (URDFs of example-robot-data) or MuJoCo C's
(embedded robots, and those of robot_descriptions).

A step is ``solve`` with ``WeightedQP`` and ``integrate`` for the pose of the last body, posture and
limits, in float64: the 20th percentile of its calls, which a busy machine disturbs little. Pin the process to one core
(``taskset -c 0``), as one robot is best run. ``--write`` writes docs/data/robots.csv.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pinocchio as pin

import osik_jax as osik
from osik_jax.runtime import configure_cpu

from .command_line import listed
from .data_file import DATA, DOCS, write_csv

PAGE, TABLE = DOCS / "robots.md", DATA / "robots.csv"
HEAD = ("robot", "base", "dofs", "mimic joints", "frames", "largest error of a pose", "one step [µs]")
CONFIGURATIONS = 4
TOLERANCE = 1e-12
"""The largest error of a pose that the page states [m, or entries of a rotation matrix]."""
CALLS = 400
DT = 0.005
PULL = 0.01
"""How far the body that a step moves is from its target [m]."""

ROBOTS: dict[str, tuple[str, bool]] = {
    "nao": ("", True),
    "arm7": ("", False),
    "a1": ("a1_description/urdf/a1.urdf", True),
    "alex": ("alex_description/urdf/alex_sake_hands.urdf", True),
    "allegro": ("allegro_hand_description/urdf/allegro_left_hand.urdf", False),
    "anymal_b": ("anymal_b_simple_description/robots/anymal.urdf", True),
    "anymal_b with kinova": ("anymal_b_simple_description/robots/anymal-kinova.urdf", True),
    "anymal_c": ("anymal_c_simple_description/urdf/anymal.urdf", True),
    "b1": ("b1_description/urdf/b1.urdf", True),
    "b1 with z1": ("b1_description/urdf/b1-z1.urdf", True),
    "baxter": ("baxter_description/urdf/baxter.urdf", False),
    "bolt": ("bolt_description/robots/bolt.urdf", True),
    "borinot": ("borinot_description/urdf/borinot_flying_arm_2.urdf", True),
    "centauro": ("centauro_description/urdf/centauro.urdf", True),
    "finger_edu": ("finger_edu_description/robots/finger_edu.urdf", False),
    "g1": ("g1_description/urdf/g1_29dof_rev_1_0.urdf", True),
    "g1 with hands": ("g1_description/urdf/g1_29dof_with_hand_rev_1_0.urdf", True),
    "go1": ("go1_description/urdf/go1.urdf", True),
    "go2": ("go2_description/urdf/go2.urdf", True),
    "hextilt": ("hextilt_description/urdf/hextilt_flying_arm_5.urdf", True),
    "human": ("human_description/robots/human.urdf", True),
    "hyq": ("hyq_description/robots/hyq_no_sensors.urdf", True),
    "icub": ("icub_description/robots/icub.urdf", True),
    "kinova": ("kinova_description/robots/kinova.urdf", False),
    "laikago": ("laikago_description/urdf/laikago.urdf", True),
    "panda": ("panda_description/urdf/panda.urdf", False),
    "pr2": ("pr2_description/urdf/pr2.urdf", True),
    "romeo": ("romeo_description/urdf/romeo.urdf", True),
    "simple_humanoid": ("simple_humanoid_description/urdf/simple_humanoid.urdf", True),
    "so100": ("so_arm_description/urdf/so100.urdf", False),
    "so101": ("so_arm_description/urdf/so101.urdf", False),
    "solo": ("solo_description/robots/solo.urdf", True),
    "solo12": ("solo_description/robots/solo12.urdf", True),
    "talos": ("talos_data/robots/talos_full_v2.urdf", True),
    "tiago": ("tiago_description/robots/tiago.urdf", True),
    "tiago_dual": ("tiago_description/robots/tiago_dual.urdf", True),
    "tiago_pro": ("tiago_pro_description/robots/tiago_pro.urdf", True),
    "ur3": ("ur_description/urdf/ur3_robot.urdf", False),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", False),
    "ur10": ("ur_description/urdf/ur10_robot.urdf", False),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", False),
    "z1": ("z1_description/urdf/z1.urdf", False),
}
"""The end of each file's path in example-robot-data, empty for embedded robots, and whether its base floats."""
OTHER = ("", True)
"""Of a robot that is in neither; its file says whether its base floats."""


class Row(NamedTuple):
    """A robot's line in the table; errors in metres or entries of rotation matrices, the step in seconds."""

    name: str
    floating: bool
    dofs: int
    followers: int
    frames: int
    error: float
    step: float

    def cells(self) -> tuple[str, ...]:
        """Return the texts of the columns in ``HEAD``."""
        base = "floating" if self.floating else "fixed"
        sizes = str(self.dofs), str(self.followers), str(self.frames)
        return self.name, base, *sizes, f"{self.error:.0e}", f"{1e6 * self.step:.0f}"


def file_of(name: str) -> Path:
    """The URDF of a robot of example-robot-data.

    Raises:
        FileNotFoundError: example-robot-data is not installed, or does not have it.
    """
    files = importlib.metadata.files("example-robot-data") or []
    found = [file for file in files if str(file).endswith(ROBOTS[name][0])]
    if len(found) != 1:
        raise FileNotFoundError(f"{len(found)} files of example-robot-data end in {ROBOTS[name][0]!r}, not one")
    return Path(str(found[0].locate()))


def load(name: str) -> osik.Robot:
    """A robot of the table, or of robot_descriptions."""
    ending, floating = ROBOTS.get(name, OTHER)
    return osik.Robot.from_urdf(file_of(name), floating_base=floating) if ending else osik.load_robot(name)


def pose_error(name: str, robot: osik.Robot) -> float:
    """The largest difference to the poses that Pinocchio, or MuJoCo C, has at random configurations."""
    rng, q = np.random.default_rng(7), np.tile(np.asarray(robot.q0), (CONFIGURATIONS, 1))
    first = 7 if robot.floating_base else 0
    q[:, first:] = rng.uniform(-np.pi, np.pi, (CONFIGURATIONS, robot.nq - first))
    if robot.floating_base:
        base = np.concatenate([rng.uniform(-1.0, 1.0, (CONFIGURATIONS, 3)), rng.normal(size=(CONFIGURATIONS, 4))], 1)
        base[:, 3:] /= np.linalg.norm(base[:, 3:], axis=1, keepdims=True)
        q[:, :7] = base
    names, poses = _pinocchio_poses(name, robot, q) if ROBOTS.get(name, OTHER)[0] else _mujoco_poses(robot, q)

    @jax.jit
    @jax.vmap
    def ours(q: jax.Array) -> tuple[jax.Array, jax.Array]:
        return osik.forward_kinematics(robot, q).frame_poses(robot, names)

    return max(float(np.abs(a - b).max()) for a, b in zip(ours(jnp.asarray(q)), poses, strict=True))


def _pinocchio_poses(name: str, robot: osik.Robot, q: np.ndarray) -> tuple[tuple[str, ...], tuple[np.ndarray, ...]]:
    """Links, and their positions and rotations."""
    base = (pin.JointModelFreeFlyer(),) if robot.floating_base else ()
    model = pin.buildModelFromUrdf(str(file_of(name)), *base)
    data = model.createData()
    frames = [k for k, frame in enumerate(model.frames) if frame.type == pin.FrameType.BODY]
    places = []
    for row in q:
        values = _joint_values(robot, row)
        pin.framesForwardKinematics(model, data, _pinocchio_configuration(model, values))
        places.append([data.oMf[k].homogeneous.copy() for k in frames])
    poses = np.array(places)
    return tuple(model.frames[k].name for k in frames), (poses[..., :3, 3], poses[..., :3, :3])


def _joint_values(robot: osik.Robot, q: np.ndarray) -> dict[str, np.ndarray]:
    """Of every joint in MuJoCo's layout, followers included; the base by Pinocchio's name for it."""
    values = np.split(np.asarray(robot.mujoco_qpos(jnp.asarray(q))), robot.tree.full_qpos_address[1:-1])
    return {"root_joint" if v.size == 7 else name: v for name, v in zip(robot.tree.joint_names, values, strict=True)}


def _pinocchio_configuration(model: pin.Model, values: dict[str, np.ndarray]) -> np.ndarray:
    out = pin.neutral(model)
    for name, joint in list(zip(model.names, model.joints, strict=True))[1:]:
        value = values[name]
        if joint.nq == 7:
            value = np.concatenate([value[:3], value[4:], value[3:4]])  # its quaternions have w last
        elif joint.nq == 2:
            value = np.concatenate([np.cos(value), np.sin(value)])  # its unbounded joints are points of a circle
        out[joint.idx_q : joint.idx_q + joint.nq] = value
    return out


def _mujoco_poses(robot: osik.Robot, q: np.ndarray) -> tuple[tuple[str, ...], tuple[np.ndarray, ...]]:
    """Bodies that have names, and their positions and rotations."""
    model = robot.mj_model
    bodies = [b for b in range(model.nbody) if model.body(b).name in robot.frame_names]
    data, places, axes = mujoco.MjData(model), [], []
    for row in q:
        data.qpos[:] = robot.mujoco_qpos(jnp.asarray(row))
        mujoco.mj_kinematics(model, data)
        places.append(data.xpos[bodies])
        axes.append(data.xmat[bodies].reshape(-1, 3, 3))
    return tuple(model.body(b).name for b in bodies), (np.array(places), np.array(axes))


def step_seconds(robot: osik.Robot) -> float:
    """Of one step towards a target beside the last body's pose."""
    hand = osik.FrameTask(robot, robot.body_names[-1])
    position, rotation = hand.target
    tasks = {
        "hand": hand.replace(target=(position + PULL, rotation)),
        "posture": osik.PostureTask(robot, weight=1e-3),
    }
    limits, scheme = (osik.ConfigurationLimit(robot), osik.VelocityLimit(robot)), osik.WeightedQP()

    @jax.jit
    def step(q: jax.Array) -> jax.Array:
        return osik.integrate(robot, q, osik.solve(robot, q, tasks, scheme=scheme, limits=limits, dt=DT).velocity, DT)

    q, seconds = jax.block_until_ready(step(robot.q0)), []
    for _ in range(CALLS):
        started = time.perf_counter()
        jax.block_until_ready(step(q))
        seconds.append(time.perf_counter() - started)
    return float(np.percentile(seconds, 20))


def row(name: str) -> Row:
    """Loads and measures a robot."""
    robot = load(name)
    sizes = robot.floating_base, robot.nv, len(robot.mimic_joints), len(robot.frame_names)
    return Row(name, *sizes, error=pose_error(name, robot), step=step_seconds(robot))


def main() -> None:
    """Prints the table line by line, and writes it where asked to."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.robots_table", description=__doc__)
    parser.add_argument("--robots", type=listed(str), default=tuple(ROBOTS), help="names, of robot_descriptions too")
    parser.add_argument("--write", action="store_true", help="write docs/data/robots.csv")
    given = parser.parse_args()
    if given.write and set(given.robots) != set(ROBOTS):
        parser.error("--write is for the table of all robots")
    jax.config.update("jax_enable_x64", True)
    rows = []
    for name in given.robots:
        rows.append(row(name))
        print(*rows[-1].cells(), sep=", ", flush=True)
        jax.clear_caches()
    if given.write:
        write_csv(TABLE, HEAD, [one.cells() for one in rows])


if __name__ == "__main__":
    configure_cpu()
    main()
