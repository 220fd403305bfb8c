"""Collision-free inverse kinematics on recorded problems: answers for a judge, and the time of each call.

    python -m benchmarks.collision_free ROBOT ANSWERS.npz [--problems FILE.npz] [--sets box cage] [--count 10] [--batch]
                                        [--clearance 0.005] [--grow 0.015] [--key 0]

ROBOT is a name of ``osik_jax.load_robot``, or the path of a URDF. A problem is a scene of boxes and cylinders with a
configuration at the goal, at which the file's frames are where they are wanted. ANSWERS.npz gets ``set`` and ``index``
of each problem, ``q`` in the order of the file's joints, ``called`` (it is said to be there and free), ``impossible``
(shapes that the target places touch others in each configuration: a proof that none is free) and ``seconds``: of the
call from Python, one problem a call. ``--batch`` solves all problems in one call; each has the same share of its time.
``--grow`` makes half edges, radii and half lengths of all obstacles so much larger [m].

FILE.npz, by default ROBOT.npz in the folder that OSIK_PROBLEMS names or here, has ``head``, a JSON text (robot, sets,
names, joints, frames, held, allowed), a row for each problem (set, index, objects, goal), one for each object (kind,
name, size; pose is (7, objects): position, quaternion w x y z), and ``sizes``: half edges of boxes (kind 0), radius and
half length of cylinders (kind 1) [m].
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import osik_jax as osik
from osik_jax.kinematics._rigid import rotation_matrix

CAPACITY = 32
"""Shapes that a scene has room for."""


class Problem(NamedTuple):
    """A scene, and the configuration of the goal in the order of the file's joints."""

    set: str
    index: int
    scene: osik.Scene
    goal: np.ndarray


class Setting(NamedTuple):
    """A robot with the facts of its problems: frames, entries of q of the file's joints, pairs that may touch."""

    robot: osik.Robot
    frames: list[str]
    entries: list[int]
    srdf: str


def read(path: Path, grow: float = 0.0) -> tuple[dict[str, Any], Iterator[Problem]]:
    """Return the head of a file of problems, and the problems with obstacles that are larger by ``grow`` [m]."""
    with np.load(path) as opened:
        file = {name: opened[name] for name in opened.files}
    head = json.loads(str(file["head"]))
    file["sizes"] = np.asarray(file["sizes"], float) + grow
    return head, _problems(head, file)


def _problems(head: dict[str, Any], file: dict[str, np.ndarray]) -> Iterator[Problem]:
    ends = np.cumsum(file["objects"].astype(int))
    place, turn = file["pose"][:3].T.astype(float), np.asarray(rotation_matrix(file["pose"][3:].T.astype(float)))
    for k, end in enumerate(ends):
        shapes = {}
        for row in range(end - int(file["objects"][k]), end):
            size = file["sizes"][file["size"][row]].astype(float)
            name = f"{head['names'][file['name'][row]]}:{row}"
            shapes[name] = _shape(int(file["kind"][row]), size, place[row], turn[row])
        scene = osik.Scene(shapes, capacity=CAPACITY)
        yield Problem(head["sets"][file["set"][k]], int(file["index"][k]), scene, file["goal"][k])


def _shape(kind: int, size: np.ndarray, place: np.ndarray, turn: np.ndarray) -> osik.CollisionShape:
    if kind == 0:
        return osik.CollisionShape.box(size, place, turn)
    along = size[1] * turn[:, 2]
    return osik.CollisionShape.cylinder(size[0], place - along, place + along)


def setting(name: str, head: dict[str, Any]) -> Setting:
    """Return the robot with its held joints locked."""
    is_path = name.endswith((".urdf", ".xml"))

    def load(**options: Any) -> osik.Robot:
        return (
            osik.Robot.from_urdf(name, floating_base=False, **options) if is_path else osik.load_robot(name, **options)
        )

    held = {joint: value for joint, value in head["held"].items() if joint in load().tree.joint_names}
    robot = load(locked_joints=held)
    pairs = "".join(f'<disable_collisions link1="{a}" link2="{b}"/>' for a, b in head["allowed"])
    entries = [robot.joint_qpos_index(joint) for joint in head["joints"]]
    return Setting(robot, head["frames"], entries, f'<robot name="problems">{pairs}</robot>')


def targets(own: Setting, goals: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return positions (n, 3) and rotations (n, 3, 3) of the frames at the goals (n, joints)."""
    q = np.tile(np.asarray(own.robot.q0), (len(goals), 1))
    q[:, own.entries] = goals
    robot, frames = own.robot, own.frames
    placed = jax.vmap(lambda q: [osik.forward_kinematics(robot, q).frame_pose(robot, f) for f in frames])(q)
    return {f: (np.asarray(place), np.asarray(turn)) for f, (place, turn) in zip(own.frames, placed, strict=True)}


def arguments(description: str | None, out: str) -> argparse.ArgumentParser:
    """Return the options that say which problems are solved and how; ``out`` is the name of the file of answers."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot")
    parser.add_argument(out, type=Path)
    parser.add_argument("--problems", type=Path)
    parser.add_argument("--sets", nargs="*")
    parser.add_argument("--count", type=int, help="problems of each set; default: all")
    parser.add_argument("--batch", action="store_true", help="all problems in one call")
    parser.add_argument("--clearance", type=float, default=0.0)
    parser.add_argument("--key", type=int, default=0)
    return parser


def main() -> None:
    """Solve the problems that the command line names."""
    parser = arguments(__doc__, "answers")
    parser.add_argument("--grow", type=float, default=0.0)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    osik.runtime.configure_cpu()
    folder = Path(os.environ.get("OSIK_PROBLEMS", "."))
    head, problems = read(given.problems or folder / f"{given.robot}.npz", given.grow)
    kept: dict[str, list[Problem]] = {}
    for problem in problems:
        own = kept.setdefault(problem.set, [])
        if (not given.sets or problem.set in given.sets) and (given.count is None or len(own) < given.count):
            own.append(problem)
    chosen = [problem for own in kept.values() for problem in own]
    q, called, impossible, seconds, first = solve(setting(given.robot, head), chosen, given)
    np.savez(
        given.answers,
        set=np.array([problem.set for problem in chosen]),
        index=np.array([problem.index for problem in chosen]),
        q=q,
        called=called,
        impossible=impossible,
        seconds=seconds,
    )
    ms = 1e3 * seconds
    print(
        f"{len(chosen)} problems, called free {100 * called.mean():.2f} %, "
        f"impossible {100 * impossible.mean():.2f} %; a call: median {np.median(ms):.3f} ms, "
        f"99 % {np.quantile(ms, 0.99):.2f} ms, longest {ms.max():.1f} ms; first call {first:.2f} s"
    )


def solve(own: Setting, problems: list[Problem], given: Any) -> tuple[Any, ...]:
    """Return q (n, joints), whether each is called free or impossible, and seconds of each call and of the first."""
    options: dict[str, Any]
    poses, options = targets(own, np.array([problem.goal for problem in problems])), {"srdf": own.srdf}
    options |= dict(clearance=given.clearance, key=given.key)

    def call(poses: Any, scene: osik.Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        start = time.perf_counter()
        found = osik.inverse_kinematics(own.robot, poses, scene=scene, **options)
        q, called = np.asarray(found.q), np.asarray(found.converged)
        seconds = time.perf_counter() - start
        return q[..., own.entries], called, np.isin(np.asarray(found.obstruction), (1, 2)), seconds

    def one(k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        return call({f: (place[k], turn[k]) for f, (place, turn) in poses.items()}, problems[k].scene)

    if given.batch:
        scenes = osik.Scene.stack([problem.scene for problem in problems])
        first = call(poses, scenes)[-1]
        q, called, impossible, seconds = call(poses, scenes)
        print(f"{len(problems)} problems in one call: {seconds:.3f} s")
        return q, called, impossible, np.full(len(problems), seconds / len(problems)), first
    first = one(0)[-1]
    found = (np.array(one_kind) for one_kind in zip(*(one(k) for k in range(len(problems))), strict=True))
    return *found, first


if __name__ == "__main__":
    main()
